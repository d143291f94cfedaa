"""Means, verdicts, gains and Pareto fronts that are worked out from rows, and the page made of them."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from compare.case import load_case
from compare.charts.charts import gain_figure, size_figures, speed_figures
from compare.charts.figures import _size, write_figures
from compare.charts.page import COLUMNS, write_page
from compare.charts.results import METRICS, UNJUDGED, Results, pareto, with_best
from compare.charts.severity import breaking, series_of
from compare.command import _line
from compare.grid.rows import Rows
from compare.references import black, noise
from compare.views import SHOWN, WORST, read_views, write_views
from ground.show.plots import ticks_1_2_5
from tests.browser import as_url, chromium, opened
from tests.commands import call
from tests.small_sessions import small_session


def row(method: str, condition: str = "as taken", target: str = "A", seed: int = 0, **figures) -> dict:
    made = {
        "method": method,
        "target": target,
        "seed": seed,
        "condition": condition,
        "size": 40,
        "steps_share": 1.0,
    }
    made |= {
        "digest": f"{method}-{condition}-{target}-{seed}",
        "commit": "abc1234",
        "command": "ground compare",
    }
    changes = {} if condition == "as taken" else {"changes": {"noise": 2.0}}
    return made | changes | figures


ROWS = [
    row("obbgs", psnr_clean_db=40.0, chamfer=0.02, seconds=60.0, gaussians=7000, bytes=420_000),
    row("obbgs", seed=1, psnr_clean_db=41.0, chamfer=0.03, seconds=62.0, gaussians=7200, bytes=430_000),
    row("3dgs", psnr_clean_db=30.0, chamfer=0.1, seconds=2000.0, gaussians=30_000, bytes=7_000_000),
    row("black", psnr_clean_db=26.0),
    row("untrained", psnr_clean_db=27.0, chamfer=0.025),
    row("obbgs", "noise x2", psnr_clean_db=38.0, chamfer=0.03, seconds=60.0),
    row("3dgs", "noise x2", psnr_clean_db=27.9),
    row("jiang2025", error="Diverged: the loss became nan"),
]


def test_means_are_over_seeds_and_references_stand_first():
    results = Results(ROWS)
    assert results.mean("obbgs", "A", "as taken", "psnr_clean_db") == pytest.approx(40.5)
    assert results.spread("obbgs", "A", "as taken", "psnr_clean_db") == pytest.approx(0.5**0.5)
    assert results.labels[:2] == ["black", "untrained"]
    assert results.trained == ["obbgs", "3dgs", "jiang2025"] and results.base == "as taken"


@pytest.mark.parametrize(
    ("label", "condition", "verdict"),
    [
        ("obbgs", "as taken", "holds"),
        ("obbgs", "noise x2", "shaken"),  # 2.5 dB less
        ("3dgs", "as taken", "holds"),
        ("3dgs", "noise x2", "fails"),  # 0.9 dB above the untrained start, as it was taken
        ("jiang2025", "as taken", "refused"),
        ("jiang2025", "noise x2", ""),
    ],
)
def test_verdicts(label, condition, verdict):
    assert Results(ROWS).verdict(label, condition)[0] == verdict


def test_the_worst_target_decides_a_verdict():
    rows = [row("obbgs", target=t, psnr_clean_db=v) for t, v in (("A", 40.0), ("B", 20.0))]
    rows += [row("black", target=t, psnr_clean_db=25.0) for t in "AB"]
    assert Results(rows).verdict("obbgs", "as taken")[0] == "fails"


def test_without_an_image_without_training_nothing_is_said_to_hold():
    rows = [of_noise("obbgs", times, score) for times, score in ((None, 12.0), (2.0, 11.5))]
    results = Results(rows)
    for condition in results.conditions:
        verdict, why = results.verdict("obbgs", condition)
        assert verdict == UNJUDGED and "no image without training was scored" in why
    point = breaking(results, "obbgs", series_of(results)[0])
    assert point is not None and (point.broken_at, point.held, point.is_judged) == ((), (), False)
    only_noisy = Results([rows[1], row("black", psnr_clean_db=5.0)])
    assert only_noisy.verdict("obbgs", "noise x2")[0] == UNJUDGED, "nothing to compare with"


def test_gains_are_positive_where_a_method_is_better():
    results = Results(ROWS)
    assert results.gain_base == "3dgs"
    assert results.gain("obbgs", "3dgs", "A", "psnr_clean_db") == pytest.approx(10.5)  # 40.5 against 30 dB
    assert results.gain("obbgs", "3dgs", "A", "chamfer") == pytest.approx(75.0)  # 0.025 of 0.1
    assert results.gain("obbgs", "3dgs", "A", "lpips") is None


def test_gains_are_told_in_the_unit_of_their_score_and_per_cent_are_of_errors_alone(tmp_path):
    told = {metric.key: metric.gain(1.25) for metric in METRICS}
    assert (told["psnr_clean_db"], told["lpips"], told["chamfer"]) == ("+1.25 dB", "+1.2 %", "+1.2 %")
    assert (told["ssim_clean"], told["completeness_centres"]) == ("+1.2500", "+1.2 points")
    figure = gain_figure(Results(ROWS), "obbgs", "3dgs")
    assert [row[0] for row in figure.data[0].text] == ["+10.50 dB", "+75.0 %"]
    assert [row[0] for row in figure.data[0].z] == [1, 1], "rows of other units are not compared by colour"


def test_speed_is_in_processor_time_where_all_trainings_have_it():
    made = {"psnr_clean_db": 40.0, "seconds": 60.0, "cpu_seconds": 50.0}
    point = {"share": 0.5, "seconds": 30.0, "psnr_clean_db": 38.0}
    rows = [row("obbgs", **made, curve=[point | {"cpu_seconds": 25.0}]), row("black", psnr_clean_db=20.0)]
    (figure,) = speed_figures(Results(rows), "A")
    assert figure.layout.xaxis.title.text == "processor time of training, s"
    assert [list(trace.x) for trace in figure.data[:2]] == [[25.0], [50.0]]
    other = row("3dgs", psnr_clean_db=30.0, seconds=90.0)  # of an older version
    (figure,) = speed_figures(Results([*rows, other]), "A")
    assert figure.layout.xaxis.title.text == "time of training by the clock, s"
    assert [list(trace.x) for trace in figure.data[:3]] == [[30.0], [60.0], [90.0]]


def test_a_method_that_comes_to_fit_the_noise_is_shown_with_the_best_point_of_its_curve():
    curve = [
        {"share": share, "psnr_clean_db": value} for share, value in ((0.1, 31.0), (0.5, 33.0), (1.0, 30.0))
    ]
    results = Results(
        [row("3dgs", psnr_clean_db=30.0, curve=curve), row("black", psnr_clean_db=26.0, curve=[])]
    )
    assert results.mean("3dgs", "A", "as taken", "psnr_best_db") == 33.0
    assert results.mean("black", "A", "as taken", "psnr_best_db") is None


def test_the_time_to_a_quality_is_read_off_the_curve_between_its_points():
    curve = [
        {"share": 0.1, "cpu_seconds": 2.0, "psnr_clean_db": 36.0, "f_02_surface": 50.0},
        {"share": 0.5, "cpu_seconds": 6.0, "psnr_clean_db": 40.0},
        {"share": 1.0, "cpu_seconds": 12.0, "psnr_clean_db": 39.0, "f_02_surface": 55.0},
    ]
    found = with_best(row("3dgs", curve=curve))
    assert (found["seconds_to_35_db"], found["seconds_to_38_db"], found["seconds_to_40_db"]) == (
        2.0,
        4.0,
        6.0,
    )
    assert "seconds_to_f60" not in found


def test_rows_of_other_contents_under_the_same_name_are_not_taken_for_seeds():
    rows = [row("3dgs", psnr_clean_db=v) | {"digest": d} for v, d in ((30.0, "old"), (20.0, "new"))]
    last = Results(rows)
    assert last.mean("3dgs", "A", "as taken", "psnr_clean_db") == 20.0 and last.replaced == 1
    assert last.spread("3dgs", "A", "as taken", "psnr_clean_db") is None
    asked = {"old": ("A", "as taken")}
    assert Results(rows, asked).mean("3dgs", "A", "as taken", "psnr_clean_db") == 30.0
    assert Results(ROWS).replaced == 0


def test_rows_stand_under_the_names_that_their_session_and_condition_have_today():
    rows = [row("3dgs", psnr_clean_db=v) | {"digest": d} for v, d in ((30.0, "moved"), (20.0, "new"))]
    asked = {"moved": ("A-old", "as taken"), "new": ("A", "as taken")}
    results = Results(rows, asked)
    assert results.replaced == 0 and results.targets == ["A-old", "A"]
    assert results.mean("3dgs", "A-old", "as taken", "psnr_clean_db") == 30.0
    assert results.mean("3dgs", "A", "as taken", "psnr_clean_db") == 20.0
    renamed = Results(rows, {"moved": ("A", "b"), "new": ("A", "a")})
    assert renamed.conditions == ["b", "a"] and renamed.replaced == 0


def of_noise(method: str, times: float | None, psnr_db: float, **figures) -> dict:
    made = row(method, "as taken" if times is None else f"noise x{times:g}", psnr_clean_db=psnr_db, **figures)
    return made if times is None else made | {"changes": {"noise": times}}


def test_a_method_breaks_at_the_mildest_condition_at_which_it_is_worse_than_no_model():
    scores = {None: 40.0, 0.5: 20.0, 2.0: 38.0, 4.0: 25.0, 8.0: 30.0}  # less noise is not severe
    rows = [of_noise("obbgs", times, score) for times, score in scores.items()]
    rows += [of_noise("3dgs", times, 30.0) for times in (None, 2.0, 4.0)]
    rows += [row("black", psnr_clean_db=24.0), row("mean", psnr_clean_db=26.0)]
    results = Results([*rows, row("obbgs", "eclipse", psnr_clean_db=1.0) | {"changes": {"eclipse": [0, 1]}}])
    (series,) = series_of(results)
    assert [value for value, _ in series.conditions] == [0.5, 1.0, 2.0, 4.0, 8.0]
    broken, held = breaking(results, "obbgs", series), breaking(results, "3dgs", series)
    assert broken is not None and (broken.broken_at, broken.held) == ((4.0,), ())
    assert broken.why == ("A: 25.00 dB, and 26.00 dB without any model",)
    assert held is not None and (held.broken_at, held.held) == ((), (4.0,))
    assert breaking(results, "black", series) is None  # no condition was asked of it
    impossible = [
        row("obbgs", "noise x2", error="CompareError: A has no truth") | {"changes": {"noise": 2.0}}
    ]
    results = Results([*impossible, of_noise("obbgs", None, 40.0), row("black", psnr_clean_db=24.0)])
    assert results.conditions == ["as taken", "noise x2"]
    assert breaking(results, "obbgs", series_of(results)[0]) is None  # that says nothing of the method


def test_a_model_of_another_shape_is_broken_however_good_its_pictures_are():
    rows = [of_noise("obbgs", times, 40.0, f_02_surface=f) for times, f in ((None, 80.0), (2.0, 49.0))]
    results = Results([*rows, row("black", psnr_clean_db=24.0)])
    point = breaking(results, "obbgs", series_of(results)[0])
    assert point is not None and point.broken_at == (2.0,) and "49.0 %" in point.why[0]


@pytest.mark.parametrize(
    ("key", "values", "order"),
    [
        ("frames", (24, 12), [["as taken", "24", "12"]]),
        ("response_gamma", (0.9, 1.1, 1.4), [["1", "0.9"], ["1", "1.1", "1.4"]]),
        ("exposure_ratios", ([1.0, 4.0, 16.0], [1.0, 1.0, 1.0]), [["1", "4"]]),
    ],
)
def test_conditions_are_walked_from_the_frames_as_taken_to_the_most_severe(key, values, order):
    rows = [row("obbgs", psnr_clean_db=40.0)]
    rows += [
        row("obbgs", f"{key} {value}", psnr_clean_db=30.0) | {"changes": {key: value}} for value in values
    ]
    (series,) = series_of(Results(rows))
    assert [[series.label(value) for value, _ in side] for side in series.outwards()] == order


def test_trainings_of_several_budgets_are_told_apart():
    rows = [
        row("3dgs", psnr_clean_db=30.0),
        row("3dgs", psnr_clean_db=20.0) | {"steps_share": 0.1, "digest": "x"},
    ]
    rows.append(row("3dgs", psnr_clean_db=20.0, largest=4000) | {"digest": "y"})
    rows.append(row("3dgs", psnr_clean_db=20.0, largest=4000) | {"steps_share": 0.5, "digest": "z"})
    assert Results(rows[:1]).label_of(rows[0]) == "3dgs"
    assert [Results(rows).label_of(each) for each in rows] == Results(rows).labels
    assert Results(rows).labels == [
        "3dgs (all steps)",
        "3dgs (10 % of the steps)",
        "3dgs (at most 4,000 Gaussians)",
        "3dgs (50 % of the steps and at most 4,000 Gaussians)",
    ]


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(-100, 100)), max_size=30))
def test_nothing_beats_a_point_of_the_pareto_front(points):
    front = pareto(points)
    for cost, score in points:
        assert any(c <= cost and s >= score for c, s in front)
    for cost, score in front:
        assert not any(c <= cost and s >= score and (c, s) != (cost, score) for c, s in points)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory) -> Path:
    """A folder with the rows above, and views of some of them."""
    out = tmp_path_factory.mktemp("comparison")
    case = load_case(small_session(tmp_path_factory.mktemp("session") / "A"))
    rows = Rows(out)
    for made in ROWS:
        if made["method"] in ("obbgs", "3dgs"):
            made = made | {
                "curve": [{"share": s, "seconds": 60 * s, "psnr_clean_db": 40 * s} for s in (0.5, 1.0)]
            }
            write_views(case, noise(case, case.training), out / "views" / f"{made['digest']}.npz")
        rows.add(made)
    write_views(case, black(case, case.training), out / "views" / "black-as taken-A-0.npz")
    return out


def test_the_kept_views_are_the_brightest_and_the_worst(comparison, tmp_path):
    case = load_case(small_session(tmp_path / "A"))
    images = [clean.clone() for clean in case.clean]
    images[0] += 0.1
    write_views(case, images, tmp_path / "views.npz")
    views = read_views(tmp_path / "views.npz")
    brightest = int(torch.tensor([clean.sum() for clean in case.clean]).argmax())
    assert views[SHOWN].frame == case.held_out[brightest].id
    assert views[WORST].frame == case.held_out[0].id and views[WORST].psnr_db == pytest.approx(20, abs=1e-3)
    half_precision = 5e-4
    np.testing.assert_allclose(views[WORST].image, images[0].numpy(), atol=half_precision)
    assert read_views(tmp_path / "none.npz") == {}


def test_the_page_shows_every_part(comparison):
    page = write_page(comparison).read_text()
    body = page[page.index("<body>") :]
    titles = (
        "Speed against accuracy",
        "Where methods fail",
        "Where each method breaks",
        "noise, times that of the camera",
        "Size against accuracy",
        "Worst views",
        "Side by side",
    )
    for words in (*titles, "Gains over 3dgs", "40.50", "No result: the loss became nan.", "abc1234"):
        assert words in body
    assert 'src="http' not in page and "<link" not in page
    note = re.search(r'<h2>Scores.*?<p class="note">(.*?)</p>', body)
    assert note is not None and len(note[1].split()) < 60  # what the columns mean is behind a fold
    assert "<summary>What the columns mean</summary>" in body and "Those of centres" in body


def test_the_page_counts_one_as_one_and_tells_what_it_left_out_and_what_ended_early(tmp_path):
    rows = Rows(tmp_path)
    rows.add(row("3dgs", psnr_clean_db=30.0) | {"digest": "old"})
    rows.add(row("3dgs", psnr_clean_db=31.0, converged=True) | {"digest": "new"})
    text = write_page(tmp_path).read_text()
    assert "1 row: 1 method, 1 target, 1 condition." in text and "1 more row is left out" in text
    assert "1 training ended early" in text
    rows.add(row("3dgs", psnr_clean_db=31.0) | {"digest": "newest"})
    text = write_page(tmp_path).read_text()
    assert "2 more rows are left out" in text and "No training ended early" in text


def test_the_page_shows_that_nothing_is_judged_without_an_image_without_training(tmp_path):
    rows = Rows(tmp_path)
    for made in (of_noise("obbgs", None, 40.0), of_noise("obbgs", 2.0, 39.0)):
        rows.add(made)
    text = write_page(tmp_path).read_text()
    assert '<td title="">not judged</td>' in text and "holds at" not in text


def test_pictures_name_their_method_and_a_section_without_content_goes(comparison, tmp_path):
    assert re.search(r"[a-z0-9]+, \d+\.\d dB</", write_page(comparison).read_text())
    rows = Rows(tmp_path)
    rows.add(row("black", psnr_clean_db=20.0))
    assert "Where methods fail" not in write_page(tmp_path).read_text()
    rows.add(row("black", "noise x2", error="CompareError: A has no truth"))
    page = write_page(tmp_path).read_text()
    assert (
        "refused; A: A has no truth" in page and '<td class="n">20.0</td>' in page
    )  # a reference is not judged


@pytest.fixture(scope="module")
def without_truth(tmp_path_factory) -> Path:
    """The same comparison of photographs: noisy PSNR only, and a condition that these sessions cannot fulfil."""
    out = tmp_path_factory.mktemp("photographs")
    rows = Rows(out)
    for made in ROWS:
        figures = {key: value for key, value in made.items() if key not in ("psnr_clean_db", "chamfer")}
        if "psnr_clean_db" in made:
            figures["psnr_noisy_db"] = made["psnr_clean_db"] - 3
            curve = [{"share": s, "seconds": 60 * s, "psnr_noisy_db": 37 * s} for s in (0.5, 1.0)]
            figures |= {"curve": curve} if "seconds" in made else {}
        else:
            figures["error"] = "CompareError: A has no truth, which a condition needs that exposes anew"
        rows.add(figures)
    return out


def test_without_truth_scores_charts_and_gains_are_of_noisy_frames(without_truth):
    results = Results(Rows(without_truth).rows.values())
    assert [metric.key for metric in results.known("A")] == ["psnr_noisy_db", "gaussians", "bytes", "seconds"]
    ((metric, values),) = results.gains("obbgs", "3dgs")
    assert metric.key == "psnr_noisy_db" and values == pytest.approx([37.5 - 27])
    assert results.verdict("3dgs", "noise x2")[0] == "fails" and results.gains("jiang2025", "3dgs") == []


def test_a_target_without_truth_beside_one_with_it_is_scored_by_its_noisy_frames():
    rows = [
        row("obbgs", psnr_clean_db=40.0, psnr_noisy_db=30.0),
        row("obbgs", target="B", psnr_noisy_db=20.0),
    ]
    results = Results(rows + [row("black", target=t, psnr_noisy_db=19.5) for t in "AB"])
    assert [results.score_of(t).key for t in "AB"] == ["psnr_clean_db", "psnr_noisy_db"]
    assert results.verdict("obbgs", "as taken") == (
        "fails",
        "B: 20.00 dB, +0.50 dB against the best image without training",
    )


# a program that returns the letters at which words of an element are broken between two lines
BROKEN_WORDS = """cell => [...cell.childNodes].filter(node => node.nodeType === Node.TEXT_NODE).flatMap(
  text => [...text.data.matchAll(/\\w+/g)].filter(word => {
    const range = document.createRange();
    range.setStart(text, word.index);
    range.setEnd(text, word.index + word[0].length);
    return new Set([...range.getClientRects()].map(box => Math.round(box.top))).size > 1;
  }).map(word => word[0]))"""


def test_long_names_of_methods_break_on_a_phone(comparison, tmp_path):
    name = "3dgs+exposure+hull+mask+l1+fast"
    shutil.copytree(comparison, tmp_path / "long")
    rows = tmp_path / "long" / "rows.jsonl"
    rows.write_text(rows.read_text().replace('"obbgs"', f'"{name}"'))
    path = write_page(tmp_path / "long")
    with chromium() as browser, opened(browser, as_url(path), 390, 800) as page:
        assert page.locator("figcaption", has_text=name).count()
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        widest = (
            "Math.max(...[...document.querySelectorAll('.scores td:first-child')].map(e => e.clientWidth))"
        )
        assert page.evaluate(widest) < 195
        named = "td:first-child, th, figcaption, .label, .legend span"
        assert page.evaluate(f"[...document.querySelectorAll('{named}')].flatMap({BROKEN_WORDS})") == []


LONG_NAMES = ("3dgs+exposure+hull+mask+l1+fast", "3dgs+affine+hull+mask+l1+fast")


@pytest.fixture(scope="module")
def partly_run(tmp_path_factory) -> Path:
    """A comparison of every figure, in which a method ran on one of two targets, and one made no pictures."""
    out = tmp_path_factory.mktemp("partly")
    rows = Rows(out)
    figures = {metric.key: 20.0 for metric in METRICS if not metric.key.endswith(("srgb", "srgb_db"))}
    for target in "AB":
        rows.add(row("obbgs", target=target, **figures))
        rows.add(row(LONG_NAMES[0], target=target, **figures | {"psnr_clean_db": 30.0}))
        rows.add(row("black", target=target, psnr_clean_db=10.0))
    rows.add(row(LONG_NAMES[1], **figures | {"psnr_clean_db": 50.0}))
    rows.add(row("obbgs", "noise x2", psnr_clean_db=18.0))
    rows.add(row("mvs", f_02_surface=80.0))
    rows.add(row("mvs", "noise x2", f_02_surface=80.0))
    rows.add(row("black", "noise x4", psnr_clean_db=10.0))
    return out


def test_gains_have_room_for_their_numbers_on_a_phone(tmp_path):
    rows = Rows(tmp_path)
    for number in range(6):
        for method, psnr_db in (("obbgs", 40.0), ("3dgs", 33.3)):
            rows.add(row(method, target=f"DSCOVR-{number}", psnr_clean_db=psnr_db, ssim_clean=0.9))
    with chromium() as browser, opened(browser, as_url(write_page(tmp_path)), 390, 800) as page:
        page.wait_for_selector(".heatmap-label text")
        texts = "[...document.querySelectorAll('.heatmap-label text')]"
        assert min(page.evaluate(f"{texts}.map(text => parseFloat(getComputedStyle(text).fontSize))")) >= 9
        assert page.evaluate("document.documentElement.scrollWidth") == 390


def test_a_method_with_a_surface_only_is_in_the_legend_of_its_curves_and_what_says_nothing_is_left_out(
    tmp_path,
):
    rows = Rows(tmp_path)
    for times in (None, 2.0):
        rows.add(of_noise("obbgs", times, 40.0, f_02_surface=80.0))
        surface = row("mvs", "as taken" if times is None else f"noise x{times:g}", f_02_surface=70.0)
        rows.add(surface if times is None else surface | {"changes": {"noise": times}})
    rows.add(row("obbgs", "believed", psnr_clean_db=40.0) | {"changes": {"believed_noise": 1.0}})
    text = write_page(tmp_path).read_text()
    part = text[text.index("Where each method breaks") : text.index("Where the rows come from")]
    legend = part[part.index('class="legend"') :].partition("</div>")[0]
    assert ">obbgs<" in legend and ">mvs<" in legend
    assert "noise, times that of the camera" in part and "noise that is believed" not in part


@pytest.mark.parametrize("width", [390, 1000, 1440])
def test_scores_read_on_every_screen_and_headers_stand_in_one_line(partly_run, width):
    with chromium() as browser, opened(browser, as_url(write_page(partly_run)), width, 900) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == width
        wide = (
            "[...document.querySelectorAll('.scores')].map(t => t.scrollWidth - t.parentElement.clientWidth)"
        )
        assert width == 390 or max(page.evaluate(wide)) <= 0, "no table of a screen scrolls"
        below = """[...document.querySelectorAll('.scores tr:first-child')].filter(r => r.clientHeight).map(row => {
            const ends = [...row.cells].map(cell => {
                const range = document.createRange(); range.selectNodeContents(cell);
                return Math.round(Math.max(...[...range.getClientRects()].map(box => box.bottom))); });
            return Math.max(...ends) - Math.min(...ends); })"""
        assert max(page.evaluate(below)) <= 1
        page.locator("summary", has_text="figures").first.click()
        figures = page.locator("details[open] table")
        assert figures.locator("tr").count() == len(METRICS) - 3 + 1  # without those of sRGB
        for name in LONG_NAMES:
            head = page.locator(".map th", has_text=name)
            assert head.count() == 1 and head.evaluate("e => e.scrollWidth <= e.clientWidth")


def test_what_was_not_run_is_said_and_does_not_win(partly_run):
    body = write_page(partly_run).read_text().replace("<wbr>", "")
    mean, of_a, of_b = (part.partition("<details>")[0] for part in re.split(r"<h3>", body)[1:4])
    assert f"{LONG_NAMES[1]} <small>(1 of 2 targets)</small>" in mean
    assert "<b>30.00</b>" in mean and "<b>50.00</b>" not in mean, (
        "the mean of fewer targets is another figure"
    )
    assert "<b>50.00</b>" in of_a and "Not run" not in of_a
    assert f"Not run on B: {LONG_NAMES[1]}, mvs." in of_b and of_b.count(LONG_NAMES[1]) == 1
    where = body[body.index("Where methods fail") :]
    assert "18.0 <small>(1 of 2)</small>" in where and ">no score<" in where and ">not run<" in where
    assert "noise x4" not in where[: where.index("</table>")], "nothing was reconstructed under it"


@pytest.mark.parametrize("folder", ["comparison", "without_truth"])
def test_the_page_is_one_column_on_a_phone_and_shows_no_empty_chart(folder, request):
    """In the browser: no error, nothing wider than the screen, a mark in every chart, names beside their colours."""
    path = write_page(request.getfixturevalue(folder))
    with chromium() as browser, opened(browser, as_url(path), 390, 800) as page:
        page.wait_for_selector(".legend")
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        charts = page.evaluate("""[...document.querySelectorAll('.js-plotly-plot')].map(chart => ({
            marks: chart.querySelectorAll('.scatterlayer .trace, .heatmaplayer image').length,
            left: chart.getBoundingClientRect().left, width: chart.getBoundingClientRect().width}))""")
        assert len(charts) >= 4 and all(chart["marks"] for chart in charts)
        assert len({round(chart["left"]) for chart in charts}) == 1
        legend = page.locator(".legend").first.inner_text()
        assert "obbgs" in legend and "3dgs" in legend
        body = page.locator("body").inner_text()
        assert "Gains over 3dgs" in body and "CompareError" not in body and "Diverged" not in body
        assert ("No truth is known" in body) == ("SSIM" not in body and "Chamfer" not in body)
        assert (
            page.evaluate(f"[...document.querySelectorAll('td:first-child')].flatMap({BROKEN_WORDS})") == []
        )


def test_a_row_without_a_result_is_not_explained_as_if_it_had_one(without_truth, tmp_path):
    shutil.copytree(without_truth, tmp_path / "page")
    rows = Rows(tmp_path / "page")
    rows.add(row("noise", error="CompareError: noise needs a session with its truth"))
    page = write_page(tmp_path / "page").read_text()
    assert "noise needs a session with its truth" in page and "the noisy frame itself" not in page


def test_one_of_a_kind_is_told_in_the_singular(tmp_path):
    rows = Rows(tmp_path)
    rows.add(row("noise", error="CompareError: noise needs a session with its truth"))
    assert "1 row: 1 method, 1 target, 1 condition." in write_page(tmp_path).read_text()


def test_a_method_with_several_budgets_is_counted_once(tmp_path):
    rows = Rows(tmp_path)
    for share in (0.1, 0.5, 1.0):
        rows.add(row("3dgs", psnr_clean_db=30.0) | {"steps_share": share, "digest": f"{share}"})
    assert "3 rows: 1 method, 1 target, 1 condition." in write_page(tmp_path).read_text()


def test_the_columns_that_are_shown_are_explained_without_truth_too(without_truth, partly_run):
    photographs, whole = (write_page(folder).read_text() for folder in (without_truth, partly_run))
    explained = [
        re.search("What the columns mean</summary>(.*?)</details>", text, re.DOTALL)
        for text in (photographs, whole)
    ]
    assert explained[0] is not None and explained[1] is not None
    assert "Noisy PSNR" in explained[0][1] and "kB are" in explained[0][1]
    assert "Clean" not in explained[0][1] and "Chamfer" not in explained[0][1]
    shown = [ends for ends, words in COLUMNS if words in explained[1][1]]
    assert len(shown) == len(COLUMNS) - 1, "all but sRGB"


def test_a_page_of_shortened_trainings_says_so(tmp_path):
    rows = Rows(tmp_path)
    rows.add(
        row("3dgs", psnr_clean_db=30.0, chamfer=0.1, seconds=2.0, gaussians=300, bytes=700, steps_share=0.1)
    )
    rows.add(row("2dgs", psnr_clean_db=30.0, largest=4000))
    limits = "Trainings with limits: 10 % of the steps (3dgs); at most 4,000 Gaussians (2dgs)."
    assert f"1 condition. {limits}" in write_page(tmp_path).read_text()


def test_figures_are_written_as_png(comparison):
    paths = write_figures(comparison)
    assert {path.name for path in paths} == {
        "failures.png", "size.png", "speed-A.png", "views-A.png", "gain-obbgs.png"
    }  # fmt: skip
    assert all(path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" for path in paths)


def test_figures_of_photographs_are_written_without_a_true_surface(without_truth):
    rows = Rows(without_truth)
    rows.add(row("obbgs", target="B", psnr_clean_db=40.0, chamfer=0.02, seconds=60.0))
    names = {path.name for path in write_figures(without_truth)}
    assert {"speed-A.png", "speed-B.png", "gain-obbgs.png"} <= names and "gain-jiang2025.png" not in names


def test_an_axis_says_its_numbers_also_where_all_values_are_nearly_alike():
    """Two models of 1,354 and 1,575 Gaussians: neither 1, 2 nor 5 times a power of ten lies between."""
    results = Results(
        [
            row("obbgs", target=target, psnr_clean_db=40.0, gaussians=count, bytes=60.0 * count)
            for target, count in (("A", 1354), ("B", 1575))
        ]
    )
    (page, _), (png, _) = size_figures(results), _size(results).axes
    for ticks in (page.layout.xaxis.tickvals, png.get_xticks()):
        inside = [tick for tick in ticks if 1354 <= tick <= 1575]
        assert 2 <= len(inside) <= 7
    assert page.layout.xaxis.ticktext[1] == "1,400"


def test_distances_on_a_logarithmic_axis_are_written_out():
    """Digits alone, as plotly writes them between powers of ten, do not say which power they are of."""
    axis = speed_figures(Results(ROWS), "A")[1].layout.yaxis
    assert axis.type == "log" and len(axis.ticktext) >= 2 and "0.1" in axis.ticktext
    assert [float(text) for text in axis.ticktext] == pytest.approx(axis.tickvals)


@given(st.lists(st.floats(1e-6, 1e9), min_size=2, max_size=5))
@example([1e-6, 1.0000000000000002e-06])
def test_ticks_are_few_rise_and_some_lie_between_the_values(values):
    ticks, low, high = ticks_1_2_5(values), min(values), max(values)
    assert ticks == sorted(set(ticks)) and ticks[0] > 0
    if high > 1.001 * low:
        assert 2 <= sum(0.999 * low <= tick <= 1.001 * high for tick in ticks) <= 48


def test_the_line_of_a_row_without_truth_has_the_psnr_against_the_noisy_frames():
    row = {"method": "mean", "target": "pass-12", "condition": "as taken", "seed": 0, "psnr_noisy_db": 27.371}
    assert _line(row) == "mean, pass-12, as taken, seed 0: 27.37 dB against the noisy frames"
    assert _line(row | {"psnr_clean_db": 30.0}) == "mean, pass-12, as taken, seed 0: 30.00 dB"
    refused = row | {"error": "CompareError: pass-12 has no truth"}
    assert _line(refused) == "mean, pass-12, as taken, seed 0: pass-12 has no truth"


def test_the_command_says_what_is_wrong_with_its_arguments(tmp_path):
    arguments = ["compare", str(tmp_path / "no"), "--out", str(tmp_path)]
    done = call("ground", *arguments)
    assert done.returncode == 1 and "is not a session" in done.stderr and "Traceback" not in done.stderr


def test_a_wrong_method_is_told_before_anything_is_read(tmp_path):
    done = call(
        "ground", "compare", str(tmp_path), "--methods", "obbgs,nonsense", "--out", str(tmp_path / "out")
    )
    assert done.returncode == 2 and "nonsense" in done.stderr
    assert "reading" not in done.stderr and not (tmp_path / "out").exists()
    for option, value, told, code in (
        ("--methods", "", "no method is named", 1),
        ("--workers", "x", "--workers: expected", 2),
    ):
        done = call("ground", "compare", str(tmp_path), option, value, "--out", str(tmp_path / "out"))
        assert done.returncode == code and told in done.stderr and len(done.stderr.splitlines()) == 1
