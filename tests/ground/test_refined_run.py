"""A run that refined its poses: its figures, report, views and pictures are of the same poses, and read on a phone."""

import base64
import dataclasses
import importlib.util
import json
import re
import shutil
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imagecodecs
import numpy as np
import pytest
from scipy.ndimage import center_of_mass
from typer.testing import CliRunner

from ground import cli, frames_of, predicted_image, sensor_of, split
from ground.run import reconstruct as reconstructing
from ground.run.estimated_poses import read_estimate, write_estimate
from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.session.cameras import range_in_words
from ground.session.folder import open_session
from ground.show.report.document import write_report
from ground.show.viewer.source import Source
from ground.show.viewer.viewer import _compared
from obbgs_core.score.metrics import psnr_db
from obbgs_core.train import train
from tests.browser import as_url, chromium, opened
from tests.ground.test_telemetry_plots import packet, written
from tests.scenes import move_poses_in
from tests.small_sessions import BORESIGHT_RAD, SIZE_PX, erring_session, small_session

STEPS = {"steps": 60, "start.count": 400, "growth.max_gaussians": 600}
BRACKETS, HELD_OUT = 16, 6  # frames of the brackets 7 and 15
ZOOM = 5  # of make_picture, from 40 to 200 pixels
A_PIXEL = 1.0  # pictures from the tags are 6 pixels off
trained_on: list = []  # the frames of each training of `refined`


@pytest.fixture(scope="module")
def refined(tmp_path_factory) -> Path:
    """A session whose tags err by 6 pixels, with a run that refined its poses."""
    session = erring_session(tmp_path_factory.mktemp("refined") / "session", brackets=BRACKETS)
    with pytest.MonkeyPatch.context() as patch:
        move_poses_in(patch, 2)
        patch.setattr(reconstructing, "train", lambda *given: trained_on.append(given[0]) or train(*given))
        reconstruct(session, "run", "obbgs", STEPS | {"blind_reference": True})
    metrics = evaluate(session, "run")
    assert metrics["poses"].startswith("refined") and metrics["pose_error_tagged_px"] > 5
    assert metrics["pose_error_px"] < 0.5
    return session


def test_the_training_without_exposure_times_has_the_poses_from_which_both_models_are_seen(refined):
    estimate = read_estimate(refined / "runs" / "run")
    assert estimate is not None
    tagged, blind = trained_on[-2:]
    assert [frame.id for frame in blind] == estimate.frame_ids
    for frame, pose in zip(blind, estimate.estimated, strict=True):
        np.testing.assert_allclose(frame.world_to_camera.numpy(), pose, atol=1e-5)
    assert (
        max(abs(a.world_to_camera - b.world_to_camera).max() for a, b in zip(tagged, blind, strict=True))
        > 1e-3
    )


def without_truth(session: Path, folder: Path) -> Path:
    return Path(shutil.copytree(session, folder, ignore=shutil.ignore_patterns("truth")))


def held_out_section(session: Path) -> str:
    page = write_report(session, "run").read_text()
    return next(part for part in page.split("<section>") if part.startswith("<h2>Held-out views"))


def pictures_of(section: str) -> list[tuple[str, np.ndarray, str]]:
    """Return what each picture is (frame or truth, render, error), its bytes [H, W, 3] and its caption."""
    found = re.findall(r'<img alt="(\w+)" src="data:image/png;base64,([^"]*)"><figcaption>([^<]*)', section)
    return [(alt, imagecodecs.png_decode(base64.b64decode(png)), caption) for alt, png, caption in found]


def shift_px(one: np.ndarray, other: np.ndarray) -> float:
    """Return how far the light's centre in a picture of bytes [H, W, 3] is from that in another."""
    centres = [center_of_mass(picture[..., 0].astype(float)) for picture in (one, other)]
    return float(np.hypot(*np.subtract(*centres)))


@pytest.mark.parametrize(("key", "reference"), [("psnr_clean_db", "truth"), ("psnr_noisy_db", "frame")])
def test_the_reports_held_out_views_are_those_of_the_headline(refined, tmp_path, key, reference):
    """With truth and without: the dB under the pictures average to the headline, and renders match what is beside."""
    session = refined if reference == "truth" else without_truth(refined, tmp_path / "session")
    headline_db = evaluate(session, "run")[key]
    section = held_out_section(session)
    shown = pictures_of(section)
    rows = list(zip(*(shown[i::5] for i in range(5)), strict=True))
    assert len(rows) == HELD_OUT
    values_db = [float(render[2].removesuffix(" dB")) for _, render, *_ in rows]
    assert np.mean(values_db) == pytest.approx(headline_db, abs=0.051)  # captions have one digit
    assert f"its mean over all {HELD_OUT} frames is {headline_db:.2f} dB" in section
    for frame, render, error, blind, _ in rows:
        assert (frame[0], render[0], error[0]) == (reference, "render", "error")
        assert frame[1].max() > 50 and shift_px(frame[1], render[1]) < A_PIXEL
        assert (
            shift_px(frame[1], blind[1]) < A_PIXEL
        )  # trained without exposure times, seen from the same poses


def test_ranges_of_report_and_viewer_are_those_of_the_refined_poses(refined):
    page = write_report(refined, "run").read_text().replace("\N{NO-BREAK SPACE}", " ")
    frames = Source(refined / "runs" / "run").load().session.frames
    told = re.findall(r"frame (\d+), ([\d.,]+ m)", page)
    assert len(told) > 10
    by_number = {record.id: range_in_words(record) for record in frames}
    assert all(by_number[int(number)] == text for number, text in told)
    assert f"Bracket 7, {by_number[21]}" in page


PHONE_PX = 390
# words with a digit, and numbers with their deviation, that are broken between two lines, in tables and on cards
BROKEN_NUMBERS = """() => [...document.querySelectorAll("td.n, .card b")].flatMap(cell => {
  const text = cell.firstChild;
  return [...text.data.matchAll(/\\S*\\d\\S*(\\s±\\s\\S+)?/g)].filter(word => {
    const range = document.createRange();
    range.setStart(text, word.index);
    range.setEnd(text, word.index + word[0].length);
    return new Set([...range.getClientRects()].map(box => Math.round(box.top))).size > 1;
  }).map(word => word[0]);
})"""
# titles, notes and legends of the figures, as [text, left, top, right, bottom]
WORDS = """() => [...document.querySelectorAll(
  ".js-plotly-plot :is(.gtitle, .xtitle, .ytitle, .cbtitle text, .annotation-text), .js-plotly-plot .legend, " +
  "div.legend span"
)].map(words => [words.textContent, words.getBoundingClientRect()])
  .map(([text, box]) => [text, box.left, box.top, box.right, box.bottom])"""


def test_the_report_can_be_read_on_a_phone_and_begins_with_words(refined, tmp_path):
    """In the browser, 390 pixels wide: no number breaks, nothing covers a legend, figures of decisions are folded."""
    session = without_truth(refined, tmp_path / "session")
    written(session, *(packet(second, cpu_percent=second % 90) for second in range(20)))
    url = as_url(write_report(session, "run"))
    with chromium() as browser, opened(browser, url, PHONE_PX, 800) as page:
        page.wait_for_selector(".js-plotly-plot .xtitle")
        assert page.evaluate("document.documentElement.scrollWidth") == PHONE_PX
        assert page.evaluate(BROKEN_NUMBERS) == []
        words = page.evaluate(WORDS)
        assert {"known exposure", "cpu, %", "from the tagged pose"} <= {word[0] for word in words}
        assert [(a[0], b[0]) for a, b in combinations(words, 2) if overlap_px(a, b) > 1] == []
        assert not re.search("nats|BIC", page.locator("p.note").all_inner_texts()[1])
        decided = page.locator("dd", has_text="nats at a BIC penalty").first
        assert not decided.is_visible()
        page.get_by_text("What the training decided").click()
        assert decided.is_visible()


# figures and their titles that reach beyond the place that they have, by how many pixels
TOO_WIDE = """() => [...document.querySelectorAll(".js-plotly-plot")].flatMap(plot =>
  [...plot.querySelectorAll(".main-svg, .xtitle, .gtitle")].map(part => [
    part.textContent.slice(0, 40),
    part.getBoundingClientRect().right - plot.parentElement.parentElement.getBoundingClientRect().right,
  ])).filter(([_, px]) => px > 1)"""


@pytest.mark.parametrize("width_px", [1440, 1000])
def test_figures_that_stand_side_by_side_keep_to_their_places_from_the_first_look(
    refined, tmp_path, width_px
):
    """The first of a row is drawn while the page has no others yet, so as wide as the whole row."""
    session = without_truth(refined, tmp_path / "session")
    written(session, *(packet(second) for second in range(20)))
    with chromium() as browser, opened(browser, as_url(write_report(session, "run")), width_px, 900) as page:
        page.wait_for_selector(".js-plotly-plot .xtitle")
        page.wait_for_timeout(500)
        assert page.locator(".beside").count() == 2 and page.evaluate(TOO_WIDE) == []


def overlap_px(one: list, other: list) -> float:
    """Return how deep two boxes [text, left, top, right, bottom] lie in each other."""
    across = min(one[3], other[3]) - max(one[1], other[1])
    down = min(one[4], other[4]) - max(one[2], other[2])
    return min(across, down)


def test_the_viewer_compares_held_out_frames_from_the_poses_that_they_are_scored_from(refined):
    shown = Source(refined / "runs" / "run").load()
    placed: Any = SimpleNamespace(shown=shown)
    for record in shown.session.frames[21:24]:
        frame, model, _ = np.split(_compared(placed, record), 3, axis=1)
        assert frame.shape == (SIZE_PX, SIZE_PX, 3)
        assert shift_px(frame, model) < A_PIXEL
    trained = shown.session.frames[0]
    assert shown.compared(trained) is trained


def test_pictures_of_the_documents_are_of_the_scored_poses(refined, tmp_path):
    script("make_picture").main(refined, "run", tmp_path / "demo.png")
    picture = imagecodecs.imread(tmp_path / "demo.png")
    rows, columns = len(picture) // 200, picture.shape[1] // 200
    assert (rows, columns) == (3, 6)  # exposures; two brackets
    for row in np.split(picture, rows):
        for truth, render in (np.split(row, columns, axis=1)[:2], np.split(row, columns, axis=1)[3:5]):
            assert truth.max() > 50 and shift_px(truth, render) < ZOOM * A_PIXEL
    script("make_turntable").main(refined, "run", tmp_path / "turntable.gif")
    assert (tmp_path / "turntable.gif").read_bytes().startswith(b"GIF89a")


def test_an_exported_run_has_the_poses_that_go_with_its_model_and_all_readings(refined, tmp_path):
    """Its model shows the frames of the imported session as well as those that it was made of."""
    out, again = tmp_path / "out", tmp_path / "again"
    assert called("export", refined / "runs" / "run", "--format", "colmap", "--out", out) == {
        "train": 3 * BRACKETS - HELD_OUT,
        "val": 0,
        "test": HELD_OUT,
    }
    called("import", "--format", "nerfstudio", "--from", out, "--session", again, "--poses", "stated")
    before, after = open_session(refined), open_session(again)
    assert after.camera == before.camera and not after.navigation.sigmas.vector().any()
    shown = Source(refined / "runs" / "run").load()
    for was, now in zip(shown.session.frames, after.frames, strict=True):
        seen_from = shown.compared(was)
        np.testing.assert_allclose(now.world_to_camera, seen_from.world_to_camera, atol=1e-5)  # float32
        assert now.exposure_time_s == was.exposure_time_s
        assert 0 < now.covariance[3, 3] < (BORESIGHT_RAD / 10) ** 2  # what is left in doubt
        np.testing.assert_array_equal(after.dn(now), before.dn(was))
    _, held_out = split(after)
    sensor, scores = sensor_of(after.camera), []
    for record, frame in zip(held_out, frames_of(after, held_out), strict=True):
        image = predicted_image(shown.gaussians, after, record, sensor, record.exposure_time_s)
        scores.append(psnr_db(image, frame.dn / sensor.white_dn))
    assert np.mean(scores) == pytest.approx(evaluate(refined, "run")["psnr_noisy_db"], abs=0.01)


def test_frames_that_a_run_left_out_are_not_exported(refined, tmp_path):
    """A frame without a refined pose is not exported with a tag in its place."""
    session = Path(shutil.copytree(refined, tmp_path / "session"))
    path = session / "runs" / "run" / "poses_estimated.json"
    estimate = read_estimate(path.parent)
    assert estimate is not None
    kept = range(3, len(estimate.frame_ids))
    fewer = {name: [getattr(estimate, name)[i] for i in kept] for name in ("frame_ids", "brackets")}
    poses = {name: getattr(estimate, name)[3:] for name in ("tagged", "estimated")}
    write_estimate(path.parent, dataclasses.replace(estimate, **fewer, **poses))
    counts = called("export", session / "runs" / "run", "--out", tmp_path / "out")
    assert counts == {"train": 3 * BRACKETS - HELD_OUT - 3, "val": 0, "test": HELD_OUT}
    assert not (tmp_path / "out" / "transforms_val.json").exists()  # of no frames


def test_a_run_that_is_exported_imported_and_trained_again_is_the_same(tmp_path):
    """Frames, sensor, poses and split survive to the last bit that a training sees, so its figures are the same."""
    made, session, again = (
        small_session(tmp_path / "made", views=16),
        tmp_path / "session",
        tmp_path / "again",
    )
    called("export", made, "--out", tmp_path / "a")
    called("import", "--format", "nerf", "--from", tmp_path / "a", "--session", session, "--poses", "stated")
    reconstruct(session, "run", "obbgs", STEPS)
    called("export", session / "runs" / "run", "--format", "nerfstudio", "--out", tmp_path / "b")
    called(
        "import", "--format", "nerfstudio", "--from", tmp_path / "b", "--session", again, "--poses", "stated"
    )
    reconstruct(again, "run", "obbgs", STEPS)
    first, second = evaluate(session, "run"), evaluate(again, "run")
    for key in ("frames_trained", "frames_held_out", "gaussians"):
        assert second[key] == first[key]
    assert second["psnr_noisy_db"] == pytest.approx(first["psnr_noisy_db"], abs=0.3)


def called(*arguments) -> dict:
    """Return what a command of `ground` prints as JSON."""
    done = CliRunner().invoke(cli.app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def script(name: str) -> Any:
    """Return a script of docs/ as a module."""
    path = Path(__file__).parents[2] / "docs" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
