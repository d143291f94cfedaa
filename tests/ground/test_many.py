"""`ground reconstruct` of several sessions: one fails, one is interrupted, none is made twice."""

import json
from pathlib import Path

import pytest

from ground.commands.many import Asked, reconstruct_all
from obbgs_base.errors import Interrupted
from tests.commands import call
from tests.small_sessions import small_session

CHANGES = {"steps": 20, "start.count": 100, "growth.max_gaussians": 150}


@pytest.fixture(scope="module")
def sessions(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("sessions")
    made = [small_session(folder / f"pass-{seed}", seed, views=9) for seed in range(2)]
    (folder / "empty").mkdir()
    return [made[0], folder / "empty", made[1]]


@pytest.fixture
def asked() -> Asked:
    return Asked("run", "obbgs", CHANGES, 1, float("inf"), "auto", False)


def test_an_interrupted_session_is_saved_and_the_same_call_goes_on(sessions, asked):
    session, wished = sessions[0], []

    def should_stop() -> bool:
        """Return true once the training has begun."""
        if (session / "runs" / ".run.part").is_dir():
            wished.append(True)
        return bool(wished)

    long = {"steps": 100_000}
    with pytest.raises(Interrupted, match="0 of 1 session done: the same command goes on"):
        reconstruct_all(
            [session], Asked(**vars(asked) | {"changes": CHANGES | long}), None, 1, should_stop=should_stop
        )
    assert (session / "runs" / ".run.part" / "known-exposure.checkpoint").is_file()
    assert not list((session / "runs").glob(".stop*"))


def test_sessions_are_reconstructed_side_by_side_and_never_twice(sessions):
    settings = [part for name, value in CHANGES.items() for part in ("--set", f"{name}={value}")]
    given = [part for session in sessions for part in ("--session", session)]
    command = ["ground", "reconstruct", *given, *settings, "--workers", "2"]
    first = call(*command, "--json")
    assert first.returncode == 1, first.stderr
    found = json.loads(first.stdout)["sessions"]
    assert list(found) == [str(session) for session in sessions]
    for session in (sessions[0], sessions[2]):
        metrics = found[str(session)]
        assert metrics["train_steps"] == 20 and metrics["psnr_noisy_db"] > 0
        assert (session / "runs" / "run" / "report.html").is_file()
    assert "session.json" in found[str(sessions[1])]["error"]
    made = {path: path.stat().st_mtime_ns for path in sessions[0].parent.glob("pass-*/runs/run/model.ply")}
    again = call(*command)
    assert again.returncode == 1 and again.stderr.count(": was finished") == 2
    assert again.stdout.count(" dB") == 2 and "not made:" in again.stdout
    assert made == {path: path.stat().st_mtime_ns for path in made} and len(made) == 2


def test_a_session_that_is_given_twice_is_refused(sessions, asked):
    with pytest.raises(ValueError, match="given twice"):
        reconstruct_all([sessions[0], sessions[0]], asked, None, 1)
