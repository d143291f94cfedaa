"""A pass whose empty sky is above the stated black level, from session to report."""

import json
import logging
from types import SimpleNamespace

import pytest

from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.session.cameras import sensor_of
from ground.session.folder import open_session
from ground.show.report.document import write_report
from ground.show.viewer.source import Shown
from ground.show.viewer.viewer import _compared
from tests.scenes import QUICK, target
from tests.small_sessions import small_session

PEDESTAL_DN = 40.0  # a hundredth of full scale


def test_stated_errors_do_not_depend_on_whether_black_is_stated_too_high_or_too_low(tmp_path):
    """Readings of frames, and what is expected of them, are compared above the same black level."""
    chi2 = []
    for name, pedestal_dn in (("low", -PEDESTAL_DN), ("high", PEDESTAL_DN)):
        session = small_session(tmp_path / name, pedestal_dn=pedestal_dn)
        reconstruct(session, "run", "obbgs", QUICK | {"steps": 100})
        metrics = evaluate(session, "run")
        assert metrics["sky_level"] is not None
        chi2.append(metrics["chi2_held_out"])
    assert chi2[0] == pytest.approx(chi2[1], rel=0.15)  # 30 % apart where the levels differ by the pedestal


def test_a_pedestal_is_measured_reported_and_costs_no_score(tmp_path):
    metrics = {}
    for name, pedestal_dn in (("plain", 0.0), ("raised", PEDESTAL_DN)):
        session = small_session(tmp_path / name, pedestal_dn=pedestal_dn)
        reconstruct(session, "run", "obbgs", QUICK | {"steps": 100})
        metrics[name] = evaluate(session, "run")
    plain, raised = metrics["plain"], metrics["raised"]
    assert plain["sky_level"] is None and plain["sky_level_dn"] is None
    for level_dn, sigma_dn in raised["sky_level_dn"].values():
        assert level_dn == pytest.approx(PEDESTAL_DN, abs=max(5 * sigma_dn, 0.5))
    for key in ("psnr_clean_db", "psnr_noisy_db"):  # 9 dB less where it is not taken off
        assert raised[key] > plain[key] - 1.0, key
    page = write_report(tmp_path / "raised", "run").read_text()
    assert "<h3>Picture 7</h3>" in page  # no range: nobody stated that these poses are in metres
    assert "Level of empty sky" in page and "more than the stated black level" in page
    assert "- Sky: empty sky reads" in (tmp_path / "raised/runs/run/model_card.md").read_text()
    assert "have the Earth in view" not in page
    assert "Level of empty sky" not in write_report(tmp_path / "plain", "run").read_text()
    path = tmp_path / "raised/runs/run/metrics.json"
    kept = json.loads(path.read_text())
    assert len(kept["sky_level_dn"]) == kept["frames_trained"]
    kept["sky_level_dn"]["3"] = [7.25, None]  # as of a frame that the Earth fills
    path.write_text(json.dumps(kept))
    page = write_report(tmp_path / "raised", "run").read_text()
    assert (
        "1 of 21 pictures have the Earth in view or too little sky of their own: the mean of the others, 7.25"
        in page
    )


def test_the_viewer_counts_the_level_of_empty_sky_as_no_error(tmp_path):
    """The model is the truth, so that without the level nothing but noise is left of the error."""
    session = open_session(small_session(tmp_path / "raised", pedestal_dn=2 * PEDESTAL_DN))
    shown = Shown("A", session, sensor_of(session.camera), target(seed=0), None, session, None)
    compared = _compared(SimpleNamespace(shown=shown), session.frames[4])  # pyright: ignore[reportArgumentType]
    error = compared[:, 2 * session.camera.width :]
    assert error[..., 0].mean() < 40, "the level itself is 150"


def test_what_is_unusual_about_frames_is_told_once_from_session_to_report(tmp_path, caplog):
    """Two trainings, the scores and the report all read the same frames, and measure their sky."""
    session = small_session(tmp_path / "raised", pedestal_dn=PEDESTAL_DN)
    lines = [json.loads(line) for line in (session / "frames.jsonl").read_text().splitlines()]
    lines[3]["in_eclipse"] = True
    (session / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    reconstruct(session, "run", "obbgs", QUICK | {"steps": 20, "blind_reference": True})
    evaluate(session, "run")
    write_report(session, "run")
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    for begins in ("empty sky reads", "left out: 1 of 24 frames, in eclipse"):
        assert len([text for text in warnings if text.startswith(begins)]) == 1, warnings
    assert len(warnings) == len(set(warnings))
