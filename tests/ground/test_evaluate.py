"""Which frames and pixels a run is scored on, how report and card name them, and damaged files."""

import json
import math
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import imagecodecs
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

from compare.case import load_case
from compare.validation import imaging
from ground.run import evaluate as scoring
from ground.run.card import chi2_explained, model_card
from ground.run.evaluate import evaluate
from ground.run.mesh_files import read_mesh_points
from ground.run.reconstruct import reconstruct
from ground.run.record import budget_told
from ground.run.scores import ScoredView, clean_scores
from ground.session.folder import SessionError
from ground.session.truth import read_points
from ground.show.report.document import write_report
from ground.show.summary import frames_row, model_rows
from obbgs_core.frames import cameras_of
from obbgs_core.io.ply import load_ply
from obbgs_core.methods.presets import preset
from obbgs_core.score.metrics import foreground_psnr_db, psnr_db
from obbgs_core.train.result import Exposing
from tests.commands import call

GOLDEN = Path(__file__).parents[1] / "golden" / "session"
QUICK = {"steps": 30, "start.count": 500, "growth.max_gaussians": 600, "published.sh_degree": 0}


def run_of(folder: Path, wanted=lambda frame: True) -> Path:
    """Return a copy of the golden session, with only the wanted frames, and a short run on it."""
    shutil.copytree(GOLDEN, folder / "session")
    lines = (GOLDEN / "frames.jsonl").read_text().splitlines()
    kept = [line for line in lines if wanted(json.loads(line))]
    (folder / "session" / "frames.jsonl").write_text("".join(line + "\n" for line in kept))
    reconstruct(folder / "session", "run", "obbgs", QUICK)
    return folder / "session"


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    return run_of(tmp_path_factory.mktemp("scored"))


def test_figures_of_training_frames_are_never_called_held_out(tmp_path):
    session = run_of(tmp_path, lambda frame: frame["bracket"] == 0)
    assert evaluate(session, "run")["scored_frames"] == "training"
    assert json.loads((session / "runs/run/metrics.json").read_text())["scored_frames"] == "training"
    card = (session / "runs/run/model_card.md").read_text()
    page = write_report(session, "run").read_text()
    body = page[page.index("<body>") :]
    for text in (card, body):
        assert "PSNR of training frames (nothing was held out)" in text
        assert "held-out" not in text.lower() and "never trained on" not in text


def test_figures_of_held_out_frames_are_called_so(session):
    assert evaluate(session, "run")["scored_frames"] == "held_out"
    card = (session / "runs/run/model_card.md").read_text()
    page = write_report(session, "run").read_text()
    body = page[page.index("<body>") :]
    for text in (card, body):
        assert "PSNR of held-out frames" in text and "training frames (" not in text


@pytest.mark.parametrize(("count", "by_exposure"), [(3, 3), (6, 6), (40, 0)])
def test_scores_by_exposure_time_are_given_where_these_are_few(count, by_exposure):
    picture, covered = torch.full((48, 48, 1), 0.5), torch.ones(48, 48)
    views = [ScoredView(picture, picture + 0.01 * i, covered, 1e-4 * (1 + i)) for i in range(count)]
    figures = clean_scores(views)
    assert sum(key.endswith("ms_db") for key in figures) == by_exposure
    assert {"psnr_clean_db", "psnr_clean_pooled_db", "psnr_clean_foreground_db"} <= set(figures)


def test_the_foreground_is_the_pixels_that_the_target_covers():
    """Three pixels of four are sky; the one that the target grazes counts as much as one that it fills."""
    truth = torch.tensor([[[0.5], [0.2]], [[0.0], [0.0]]])
    coverage = torch.tensor([[1.0, 0.004], [0.0, 0.0]])
    image = truth + torch.tensor([[[0.1], [0.1]], [[0.7], [0.7]]])
    unseen = (image, truth, torch.zeros(2, 2))
    assert foreground_psnr_db([(image, truth, coverage), unseen]) == pytest.approx(20, abs=1e-4)
    assert psnr_db(image, truth) < 7
    assert math.isnan(foreground_psnr_db([unseen]))


def test_a_run_and_a_comparison_score_the_same(session):
    metrics = evaluate(session, "run")
    case = load_case(session)
    image = imaging(load_ply(session / "runs/run/model.ply"), case.sensor, Exposing())
    figures = case.image_scores([image(cameras_of([f]), f.exposure_time_s) for f in case.held_out])
    figures.pop("psnr_noisy_db")  # a run's is from the tagged poses, a comparison's from the true ones
    assert {key: metrics[key] for key in figures} == pytest.approx(figures, abs=1e-4)
    assert {"psnr_clean_db", "psnr_clean_pooled_db", "psnr_clean_foreground_db", "ssim_clean"} <= set(figures)


def test_the_first_section_of_the_report_explains_chi2_and_shows_the_foreground(session):
    metrics = evaluate(session, "run")
    page = write_report(session, "run").read_text()
    cards = page[page.index('<div class="cards">') : page.index("<table>")]
    assert f"<b>{metrics['psnr_clean_foreground_db']:.2f} dB</b><span>clean PSNR of the foreground" in cards
    explained, card = chi2_explained(metrics["chi2"]), (session / "runs/run/model_card.md").read_text()
    assert explained in cards and explained in card
    assert 0 < metrics["chi2_held_out_both"] < metrics["chi2_held_out"]
    assert f"{metrics['chi2_held_out_both']:.2f} over noise and own error together" in card
    assert "<td>residual chi² of held-out frames: squared error" in page


@pytest.mark.parametrize(
    ("chi2", "told"),
    [(1.02, "1 is noise alone."), (28.0, "at 28 the model's own error is 5.2 times as large")],
)
def test_chi2_far_above_one_is_told_as_the_size_of_the_models_error(chi2, told):
    assert told in chi2_explained(chi2)


@pytest.mark.parametrize(("misfit", "told"), [(0.213, True), (None, False)])
def test_the_card_tells_the_models_own_error_where_it_was_learnt(session, misfit, told):
    metrics = json.loads((session / "runs" / "run" / "metrics.json").read_text()) | {"misfit": misfit}
    card = model_card("2026-07-21T00:00:00+00:00", metrics)
    assert ("own error, beside the noise: 21 % of the light" in card) == told
    card = model_card("2026-07-21T00:00:00+00:00", metrics | {"misfit_unseen_factor": 2.13})
    assert (
        "21 % of the light under Suns that it has not seen, 10 % under those of its frames" in card
    ) == told


def test_neither_card_nor_summary_tells_of_imported_pictures_what_only_a_pass_has(session):
    metrics = json.loads((session / "runs" / "run" / "metrics.json").read_text())
    metrics |= {"frames_imported": 47, "nominal_exposures": True, "shown_under_sun_dir_body": None}
    card = model_card("2026-07-21T00:00:00+00:00", metrics)
    assert "- Pictures imported: 47." in card
    assert not any(words in card for words in ("captured", "Exposure times", "Sun's direction"))
    label, used = frames_row(metrics)
    assert label == "pictures imported" and used.startswith("47, ")
    told = card + str(model_rows(metrics))
    assert "against the pictures as imported" in told and "noisy" not in told


def test_the_budget_says_that_it_was_raised_when_growth_went_on_beyond_it():
    grown = replace(preset("obbgs").growth, max_gaussians=325_041)
    result = SimpleNamespace(budget="at most 10,000 Gaussians", config=SimpleNamespace(growth=grown))
    assert "at most 10,000 Gaussians; raised to 325,041, as many as a picture can show" in budget_told(result)
    result.config.growth = replace(grown, max_gaussians=10_000)
    assert budget_told(result) == result.budget


@pytest.mark.parametrize(
    ("highlights", "told"), [({"alpha": 0.213, "peak_radiance": [2.0]}, True), (None, False)]
)
def test_the_card_tells_which_files_hold_the_highlights(session, highlights, told):
    metrics = json.loads((session / "runs" / "run" / "metrics.json").read_text()) | {"highlights": highlights}
    card = model_card("2026-07-21T00:00:00+00:00", metrics)
    assert (
        "mirrors the Sun in one lobe (GGX, alpha 0.21). model.ply and model.onnx hold them" in card
    ) == told


@pytest.mark.parametrize("chi2", [None, math.nan])
def test_a_run_without_chi2_or_onnx_has_its_card_and_report(session, tmp_path, chi2):
    shutil.copytree(session, tmp_path / "session")
    path = tmp_path / "session" / "runs" / "run" / "metrics.json"
    metrics = json.loads(path.read_text()) | {"chi2": chi2}
    del metrics["onnx_bytes"], metrics["onnx_parity_db"]
    path.write_text(json.dumps(metrics))
    page = write_report(tmp_path / "session", "run").read_text()
    card = model_card("2026-07-21T00:00:00+00:00", metrics)
    assert "model.onnx |" not in card and "ONNX renderer" not in page
    assert "mean squared residual" not in card + page


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "cannot be read"),
        (b'{"method": "obbgs", "gauss', "cannot be read"),
        (b"\xff\xfe", "cannot be read"),
        (b"[]", "should hold an object"),
        (b"{}", "expected method as a text, got None"),
        ("half", "expected gaussians as a whole number, got '600'"),
    ],
)
@pytest.mark.parametrize("read", [evaluate, write_report])
def test_damaged_metrics_are_named_by_their_file(session, tmp_path, content, told, read):
    shutil.copytree(session, tmp_path / "session")
    path = tmp_path / "session" / "runs" / "run" / "metrics.json"
    if content == "half":
        content = json.dumps(json.loads(path.read_text()) | {"gaussians": "600"}).encode()
    path.write_bytes(content)
    with pytest.raises(SessionError) as caught:
        read(tmp_path / "session", "run")
    assert str(path) in str(caught.value) and told in str(caught.value)


def test_a_run_without_its_model_is_named(session, tmp_path):
    shutil.copytree(session, tmp_path / "session")
    (tmp_path / "session" / "runs" / "run" / "model.ply").unlink()
    with pytest.raises(SessionError, match=r"has lost its model\.ply: make the run again"):
        evaluate(tmp_path / "session", "run")


def brighter(folder: Path) -> str:
    """Change a picture of a session, and return what the error calls it."""
    path = sorted((folder / "frames").iterdir())[3]
    dn = imagecodecs.png_decode(path.read_bytes())
    path.write_bytes(bytes(imagecodecs.png_encode(dn // 2, level=1)))
    return r"\(pictures\)"


def longer(folder: Path) -> str:
    """Change an exposure time."""
    lines = (folder / "frames.jsonl").read_text().splitlines()
    first = json.loads(lines[0])
    lines[0] = json.dumps(first | {"exposure_time_s": 2 * first["exposure_time_s"]})
    (folder / "frames.jsonl").write_text("\n".join(lines) + "\n")
    return r"\(frames\.jsonl\)"


@pytest.mark.parametrize("change", [brighter, longer])
def test_a_session_that_has_changed_since_the_run_scores_nothing(session, tmp_path, change):
    folder = Path(shutil.copytree(session, tmp_path / "session"))
    metrics = evaluate(folder, "run")
    told = change(folder)
    for used in (evaluate, write_report):
        with pytest.raises(SessionError, match=rf"has changed since run was made of it {told}, ") as error:
            used(folder, "run")
    remedy = shlex.split(str(error.value).split("`")[1])
    assert remedy == ["ground", "reconstruct", "--session", str(folder), "--name", "run", "--overwrite"]
    assert json.loads((folder / "runs" / "run" / "metrics.json").read_text()) == metrics


def test_a_session_that_has_grown_since_the_run_is_scored_as_it_was(tmp_path):
    """Frames that come down while a run is made, or later, change nothing of its figures."""
    whole = (GOLDEN / "frames.jsonl").read_text().splitlines(keepends=True)
    folder = run_of(tmp_path, lambda frame: frame["id"] in {json.loads(line)["id"] for line in whole[:9]})
    metrics = evaluate(folder, "run")
    assert metrics["frames_received"] == 9
    (folder / "frames.jsonl").write_text("".join(whole))
    assert evaluate(folder, "run") == metrics


def test_figures_against_a_truth_go_when_the_truth_has_gone(session, tmp_path):
    folder = Path(shutil.copytree(session, tmp_path / "session"))
    before = evaluate(folder, "run")
    shutil.rmtree(folder / "truth")
    after = evaluate(folder, "run")
    gone = set(before) - set(after)
    assert {"psnr_clean_db", "ssim_clean", "chamfer", "completeness_mesh", "surface_shown"} <= gone
    assert not {key for key in after if "clean" in key} and {"chi2", "psnr_noisy_db", "misfit"} <= set(after)
    assert "against noiseless" not in (folder / "runs/run/model_card.md").read_text()


def distance_to_triangles(point: np.ndarray, triangles: np.ndarray) -> float:
    """Return the distance of a point from the nearest plane of those triangles [F, 3, 3] that it lies over."""
    corner, sides = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    away = point - corner
    gram = sides @ sides.transpose(0, 2, 1)
    flat = np.linalg.det(gram) > 1e-18
    weights = np.linalg.solve(gram[flat], (sides @ away[..., None])[flat])[..., 0]
    over = (weights >= -1e-6).all(axis=1) & (weights.sum(axis=1) <= 1 + 1e-6)
    left = away[flat] - (weights[:, :, None] * sides[flat]).sum(axis=1)
    return float(np.linalg.norm(left[over], axis=1).min(initial=np.inf))


def test_a_damaged_mesh_is_named_whatever_its_reader_says(tmp_path, monkeypatch):
    (tmp_path / "model.glb").write_bytes(b"glTF")
    with pytest.raises(SessionError, match=r"model\.glb is damaged"):
        read_mesh_points(tmp_path / "model.glb", 10)

    def reader(path):
        raise UnboundLocalError("cannot access local variable 'access'")  # trimesh, of an altered file

    monkeypatch.setattr(trimesh, "load_scene", reader)
    with pytest.raises(SessionError, match=r"model\.glb is damaged"):
        read_mesh_points(tmp_path / "model.glb", 10)


def test_a_mesh_that_is_made_again_takes_the_place_of_what_was_said_of_the_old_one(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    run = tmp_path / "s" / "runs" / "run"
    metrics = json.loads((run / "metrics.json").read_text())
    metrics |= {"missing_outputs": {"model.glb": "No space left", "model.onnx": "torn"}, "glb_bytes": None}
    metrics["completeness_mesh"] = 12.5
    (run / "metrics.json").write_text(json.dumps(metrics))
    (run / "model.glb").unlink()
    done = call("ground", "mesh", str(tmp_path / "s"))
    assert done.returncode == 0, done.stderr
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["missing_outputs"] == {"model.onnx": "torn"}
    assert metrics["glb_bytes"] == (run / "model.glb").stat().st_size
    assert "completeness_mesh" not in metrics
    assert "model.glb is missing" not in (run / "model_card.md").read_text()


def test_the_mesh_is_scored_by_points_on_its_area_and_what_the_frames_show_apart(session):
    """The mesh's points lie on triangles of the file, and both halves of its area have their share of them."""
    metrics = evaluate(session, "run")
    path = session / "runs" / "run" / "model.glb"
    points = read_mesh_points(path, 500)
    mesh = trimesh.load_scene(path).to_mesh()
    y_up = points[:, [0, 2, 1]] * [1, 1, -1]  # glTF's axes
    assert max(distance_to_triangles(point, mesh.triangles) for point in y_up[:50]) < 1e-6
    half = mesh.triangles_center[:, 0] > np.median(mesh.triangles_center[:, 0])
    share = mesh.area_faces[half].sum() / mesh.area_faces.sum()
    on_half = (y_up[:, 0] > np.median(mesh.triangles_center[:, 0])).mean()
    assert abs(on_half - share) < 0.1  # four deviations of 500 points
    case = load_case(session)
    clouds = {
        "": load_ply(session / "runs/run/model.ply").means,
        "_surface": read_points(session / "runs/run/surface.ply"),
        "_mesh": read_mesh_points(path, scoring.SURFACE_POINTS),
    }
    assert metrics["surface_shown"] == pytest.approx(100 * case.shown.mean(), abs=1e-4)
    assert 0 < metrics["surface_shown"] < 100
    for name, cloud_m in clouds.items():
        distances = case.units_per_m * KDTree(cloud_m).query(case.cloud_m[case.shown])[0]
        assert metrics[f"completeness_shown{name}"] == pytest.approx(
            100 * (distances < 0.01).mean(), abs=0.05
        )
    page = write_report(session, "run").read_text()
    assert "of the part that the frames show" in page and "within 0.01 of model.glb" in page
    path.rename(path.with_suffix(".kept"))
    path.write_bytes(b"glTF" + bytes(20))
    with pytest.raises(SessionError, match=r"model\.glb is damaged"):
        evaluate(session, "run")
    path.unlink()
    path.with_suffix(".kept").rename(path)
