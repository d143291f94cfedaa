"""The report's page in a browser: its Gaussians against our renderer, its controls, narrow screens, no WebGL."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch

from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.run.runs import open_run
from ground.session.cameras import exposed
from ground.session.folder import read_header
from ground.show import turntable
from ground.show.pictures import tone
from ground.show.report.document import write_report
from ground.show.report.frames import frames_section, scored_section
from ground.show.splat_view import splat_view
from obbgs_core.io.ply import save_ply
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from tests.browser import as_url, chromium, opened, pixels
from tests.scenes import random_gaussians
from tests.session_frames import forget_session_facts

GOLDEN = Path(__file__).parents[1] / "golden" / "session"
QUICK = {"steps": 30, "start.count": 500, "growth.max_gaussians": 600, "published.sh_degree": 0}
CANVAS = '[data-part="canvas"]'


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shown") / "session"
    shutil.copytree(GOLDEN, folder)
    reconstruct(folder, "run", "obbgs", QUICK)
    evaluate(folder, "run")
    return folder


@pytest.fixture(scope="module")
def browser():
    with chromium() as made:
        yield made


def model(shading: str, footprint: str, sh_count: int, channels: int) -> Gaussians:
    """Return small Gaussians of all shapes, about 1 m around the origin, with a radiance that varies."""
    gaussians = random_gaussians(300, sh_count, channels)
    sh = torch.cat([1.5 + gaussians.sh[:, :1].abs(), 0.5 * gaussians.sh[:, 1:]], dim=1)
    means, ambient = gaussians.means * 0.4, torch.tensor(0.05)
    log_scales, psf = gaussians.log_scales + 0.3, torch.tensor(0.4)
    shading, _, shining = shading.partition(", ")
    changes = {"shading": shading, "ambient": ambient, "footprint": footprint, "psf_sigma_px": psf}
    if shining:  # each mirrors the Sun as well
        rng = torch.Generator().manual_seed(1)
        own = 4 if shading == "view" else 1  # numbers of a lobe: with an axis of its own, or along the normal
        lobes, peak = torch.randn(300, own, generator=rng), torch.linspace(3.0, 1.5, channels)
        changes |= {"lobes": lobes, "gloss": torch.cat([torch.tensor([0.3]), peak]).log()}
    if "Sun" in shining:  # of which the model knows where it stands still
        changes |= {"static_sun": torch.tensor([0.48, -0.6, 0.64])}
    return dataclasses.replace(gaussians, means=means, log_scales=log_scales, sh=sh, **changes)


def shown_by_us(page, run, gaussians: Gaussians) -> np.ndarray:
    """Return what our renderer makes of the page's camera, exposure and Sun, as bytes [H, W, 3]."""
    state = page.evaluate(
        "() => ({...splatViews[0].camera(), exposureS: splatViews[0].exposureS, sun: splatViews[0].sun().direction})"
    )
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = torch.tensor(state["rotation"]), torch.tensor(state["translation"])
    width, height, focal = state["width"], state["height"], state["focalPx"]
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cameras = Cameras(
        pose[None],
        K[None],
        width,
        height,
        sun_dir=torch.tensor([state["sun"]]),
        scale=state["scale"],
        background=run.session.background,
        psf_sigma_px=run.session.camera.psf_sigma_px,
    )
    radiance = render(gaussians, cameras).radiance[0]
    return tone(exposed(radiance, run.sensor, state["exposureS"]).numpy(), run.sensor, run.session.encoding)


def agreement_db(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((one.astype(float) / 255 - other / 255.0) ** 2) + 1e-12))


def still(page) -> None:
    """Stop the model's rotation and draw it."""
    page.evaluate("() => { splatViews[0].turning = false; splatViews[0].draw(); }")


@pytest.mark.parametrize(
    ("shading", "footprint", "sh_count", "channels"),
    [
        ("view", "camera", 1, 1),
        ("view, shining", "camera", 1, 3),
        ("view, shining under a known Sun", "camera", 1, 3),
        ("lambert, shining", "camera", 1, 1),
        ("view", "kerbl", 16, 3),
        ("view", "mip-splatting", 4, 1),
        ("sun", "camera", 4, 3),
        ("lambert", "camera", 1, 1),
        ("lambert", "camera", 4, 3),
    ],
)
def test_the_page_draws_what_our_renderer_draws(
    session, browser, tmp_path, shading, footprint, sh_count, channels
):
    gaussians = model(shading, footprint, sh_count, channels)
    run = dataclasses.replace(open_run(session, "run"), gaussians=gaussians)
    (tmp_path / "page.html").write_text(f"<!doctype html>{splat_view(run)}")
    with opened(browser, as_url(tmp_path / "page.html"), 420, 300) as page:
        still(page)
        for changed in (
            "",
            "splatViews[0].exposeFor(2e-4)",
            "splatViews[0].zoomBy(3); splatViews[0].turnBy(80, 9)",
        ):
            page.evaluate(f"() => {{ {changed}; splatViews[0].draw(); }}")
            theirs, ours = pixels(page, CANVAS), shown_by_us(page, run, gaussians)
            assert ours.mean() > 2 and ours.std() > 5  # there is something to see
            assert agreement_db(theirs, ours) > 40  # 51 to 65 dB were seen


def test_a_moving_sun_can_be_moved_and_shadows_follow(session, browser, tmp_path):
    run = open_run(session, "run")
    angles = np.linspace(0, 1.5, len(run.session.frames))
    frames = tuple(
        dataclasses.replace(frame, sun_dir_body=np.array([np.cos(a), np.sin(a), 0.3]))
        for frame, a in zip(run.session.frames, angles, strict=True)
    )
    gaussians = model("lambert", "camera", 1, 1)
    run = dataclasses.replace(
        run, session=dataclasses.replace(run.session, frames=frames), gaussians=gaussians
    )
    (tmp_path / "page.html").write_text(f"<!doctype html>{splat_view(run)}")
    with opened(browser, as_url(tmp_path / "page.html"), 420, 300) as page:
        still(page)
        seen = []
        for end in ("min", "max"):
            page.eval_on_selector(
                '[data-part="sun"]', f"e => {{ e.value = e.{end}; e.dispatchEvent(new Event('input')); }}"
            )
            still(page)
            seen.append(pixels(page, CANVAS))
            assert agreement_db(seen[-1], shown_by_us(page, run, gaussians)) > 40
        assert agreement_db(*seen) < 30


def test_the_controls_work_and_no_wheel_flies_into_the_model(session, browser, tmp_path):
    (tmp_path / "page.html").write_text(f"<!doctype html>{splat_view(open_run(session, 'run'))}")
    with opened(browser, as_url(tmp_path / "page.html"), 240, 460) as page:
        still(page)
        first = pixels(page, CANVAS)
        assert first.max() > 50
        page.hover(CANVAS)
        for _ in range(14):
            page.mouse.wheel(0, -120)
        page.wait_for_function("() => splatViews[0].zoom === 16")
        still(page)
        assert pixels(page, CANVAS).max() > 50  # not behind the model
        for _ in range(17):
            page.mouse.wheel(0, 120)
        page.wait_for_function("() => splatViews[0].zoom === 0.5")
        still(page)
        assert pixels(page, CANVAS).max() > 50
        page.mouse.down()
        page.mouse.move(30, 40)
        page.mouse.up()
        page.click('[data-part="reset"]')
        still(page)
        np.testing.assert_array_equal(pixels(page, CANVAS), first)
        page.click("[data-exposure]")  # the shortest
        still(page)
        assert pixels(page, CANVAS).mean() < first.mean()
        assert page.text_content('[data-part="exposed"]') == "0.05 ms"
        page.click('[data-part="turn"]')
        before = page.evaluate("() => splatViews[0].azimuth")
        page.wait_for_function(f"() => splatViews[0].azimuth !== {before}")
        page.click('[data-part="turn"]')
        still(page)
        with page.expect_download() as download:
            page.click('[data-part="save"]')
        saved = imagecodecs.png_decode(Path(download.value.path()).read_bytes())
        np.testing.assert_array_equal(saved[..., :3], pixels(page, CANVAS))


def test_the_report_fits_a_telephone(session, browser, tmp_path):
    """With a simulator's long facts: the six differences of two orbits stand in one cell."""
    session = Path(shutil.copytree(session, tmp_path / "session"))
    truth = session / "truth" / "truth.json"
    facts = json.loads(truth.read_text())
    orbit = "da -0.13, dlambda -7.99, dex -1.15, dey -0.91, dix 0.46, diy 0.90"
    truth.write_text(json.dumps(facts | {"simulation": {"navigation": {"orbit_error_m": orbit}}}))
    with opened(browser, as_url(write_report(session, "run")), 390, 800) as page:
        page.wait_for_selector(".main-svg")
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
        assert (
            page.eval_on_selector(".cards", "e => getComputedStyle(e).gridTemplateColumns.split(' ').length")
            == 1
        )


@pytest.mark.parametrize("width", [390, 1000, 1440])
def test_all_columns_of_pictures_are_seen_on_every_screen(session, browser, width):
    """In the browser: no picture of a grid lies beyond the edge of its section, nor behind a bar to scroll with."""
    with opened(browser, as_url(write_report(session, "run")), width, 800) as page:
        page.wait_for_selector(".main-svg")
        ends = page.evaluate("""() => [...document.querySelectorAll('.grid img')].map(image =>
            [image.getBoundingClientRect().right, image.closest('section').getBoundingClientRect().right,
             image.getBoundingClientRect().width])""")
        assert len(ends) >= 6 and all(right < edge and size >= 40 for right, edge, size in ends)
        assert page.locator(".scroll .grid").count() == 0
        words = page.evaluate("""() => [...document.querySelectorAll('.grid figcaption')].flatMap(caption =>
            [...caption.childNodes].filter(node => node.nodeType === Node.TEXT_NODE).flatMap(text =>
                [...text.data.matchAll(/[\\w.]+/g)].filter(word => {
                    const range = document.createRange();
                    range.setStart(text, word.index);
                    range.setEnd(text, word.index + word[0].length);
                    return range.getClientRects().length > 1;
                }).map(word => word[0])))""")
        assert words == [], "words that are broken between two lines"


def test_without_webgl_a_turntable_is_shown(session, browser):
    without = "HTMLCanvasElement.prototype.getContext = () => null"
    with opened(browser, as_url(write_report(session, "run")), before=without) as page:
        assert page.is_visible(".splats img") and page.is_visible(".splats .without")
        assert not page.is_visible(CANVAS) and not page.is_visible(".splats .controls")
        assert page.eval_on_selector(".splats img", "e => e.naturalWidth") == 360


def test_the_turntable_is_an_animation_of_our_renders(session):
    run = open_run(session, "run")
    cameras = turntable.circle(run.gaussians, run.session, 3, 60, 40)
    images = turntable.pictures(run.gaussians, run.session, run.sensor, 1e-4, cameras)
    assert images.shape == (3, 40, 60, 3) and all(image.max() > 50 for image in images)
    border = np.concatenate([images[:, 0], images[:, -1]], axis=1)
    assert border.mean() < images.mean() / 4  # the whole model is in the picture
    np.testing.assert_array_equal(imagecodecs.apng_decode(turntable.moving_png(images)), images[..., 0])


def test_a_large_model_keeps_its_strongest_gaussians(session, monkeypatch):
    monkeypatch.setattr("ground.show.splat_view.MOST_SPLATS", 100)
    run = open_run(session, "run")
    facts = splat_view(run).partition('data-part="model">')[2].partition("</script>")[0]
    assert json.loads(facts)["count"] == 100 < len(run.gaussians)


def test_gaussians_that_are_not_finite_are_left_out(session):
    run = open_run(session, "run")
    gaussians = run.gaussians
    gaussians.means[3, 1] = torch.nan
    facts = splat_view(run).partition('data-part="model">')[2].partition("</script>")[0]
    assert json.loads(facts)["count"] == len(gaussians) - 1


def with_automatic_brackets(session: Path, folder: Path, lost: tuple[int, ...] = ()) -> Path:
    """Return a copy of the session as if each bracket had exposure times of its own, without the lost frames."""
    shutil.copytree(session, folder)
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        line["exposure_time_s"] *= 1.0123 ** line["bracket"]
    kept = [line for line in lines if line["id"] not in lost]
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in kept))
    forget_session_facts(folder / "runs" / "run")
    return folder


def test_the_report_shows_every_frame_of_automatic_brackets_with_its_time(session, tmp_path):
    lost = open_run(session, "run").session.frames[1]  # of the first bracket, which is always shown
    run = open_run(with_automatic_brackets(session, tmp_path / "session", (lost.id,)), "run")
    page = frames_section(run)
    assert page.count("<img") == 3 * 6 - 1 and page.count("missing") == 1
    assert all(f"exposure {place}<" in page for place in (1, 2, 3)) and "exposure 4" not in page
    for record in (run.session.frames[0], run.session.frames[-1]):
        shown = f"{float(f'{1e3 * record.exposure_time_s:.4g}'):g} ms"
        away = f"{np.linalg.norm(record.position_body_m):.4g}"
        assert f"frame\N{NO-BREAK SPACE}{record.id}, {away}\N{NO-BREAK SPACE}m, {shown}" in page
    held_out = scored_section(run, None)
    assert held_out.count('alt="render"') == len(run.scored) == 6


def test_the_report_names_the_time_of_a_row_that_has_one(session):
    page = frames_section(open_run(session, "run"))
    assert page.count("<img") == 3 * 6 and "missing" not in page and "exposure 1" not in page
    assert [page.count(f">{shown} ms<") for shown in ("0.05", "0.1", "0.2")] == [1, 1, 1]
    assert page.count(" ms") == 3


def test_of_many_exposure_times_a_few_are_offered(session, tmp_path):
    run = open_run(with_automatic_brackets(session, tmp_path / "session"), "run")
    times_s = sorted({record.exposure_time_s for record in run.session.frames})
    offered = [float(text) for text in re.findall(r'data-exposure="([^"]+)"', splat_view(run))]
    assert len(times_s) == 48 and len(offered) == 6 and set(offered) <= set(times_s)
    assert (offered[0], offered[-1]) == (times_s[0], times_s[-1]) and offered == sorted(offered)


def imported(session: Path, folder: Path) -> Path:
    """Return a copy of the session as if its pictures were imported and stated no exposure times."""
    shutil.copytree(session, folder)
    header = read_header(folder) | {"imported_from": "nerf: elsewhere"}
    (folder / "session.json").write_text(json.dumps(header))
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        line |= {"exposure_time_s": 1.0, "sun_dir_body": [0.0, 0.0, 0.0]}
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    forget_session_facts(folder / "runs" / "run")
    return folder


def test_imported_pictures_are_not_told_what_only_a_pass_has(session, tmp_path):
    folder = imported(session, tmp_path / "session")
    run = folder / "runs" / "run"
    shutil.rmtree(folder / "truth")
    save_ply(random_gaussians(50, channels=3), run / "model.ply")
    page = write_report(folder, "run").read_text()
    body = re.sub(r"<(script|style).*?</\1>", "", page[page.index("<body>") :], flags=re.DOTALL)
    for absent in ("1000 ms", "the Sun", "on board", "Losses on the link", "Exposure histogram", " 0 m"):
        assert absent not in body.partition("Configuration and versions")[0], absent
    assert "pictures imported" in body and "Brightness" in body


def test_an_untrained_start_is_seen_whole():
    """The Gaussians of a start have an opacity of one half, which counted as invisible: the page stood within it."""
    solid = dataclasses.replace(random_gaussians(200, seed=3), opacity_logits=torch.full((200,), 3.0))
    start = dataclasses.replace(solid, opacity_logits=torch.zeros(200))
    assert turntable.extent(start)[1] == turntable.extent(solid)[1] != 1.0
    assert torch.equal(turntable.extent(start)[0], turntable.extent(solid)[0])
