"""A model while a session grows: it begins, takes in what arrives, survives a kill, and says what it waits for."""

import dataclasses
import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import ground.run.live.reconstruct
from flightsw.icd.mission import ConfigError
from flightsw.icd.quaternion import matrix_to_quat
from ground import cli
from ground.link.uplink import listening
from ground.run.estimated_poses import read_estimate
from ground.run.live.process import LiveProcess, TrainingFailed
from ground.run.live.reconstruct import MANY_EXPECTED, LiveReconstruction, PassEnd, reconstruct_live
from ground.run.live.status import LiveStatus, line, read_status
from ground.run.reconstruct import reconstruct
from ground.run.runs import open_run, unfinished_run
from ground.session.folder import SessionError
from ground.session.training_frames import is_held_out
from ground.show.listing import find_sessions
from obbgs_base.errors import Interrupted
from obbgs_core.errors import TooFewFrames
from obbgs_core.io.ply import load_ply
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import TENSORS

GOLDEN = Path(__file__).parents[1] / "golden" / "session"  # 48 frames in 16 brackets
CHANGES = {"steps": 200, "start.count": 1000, "growth.max_gaussians": 1200}


class Writer:
    """Lets the frames of the golden session arrive in another one, some at a time."""

    def __init__(self, folder: Path):
        self.folder, self.lines = folder, (GOLDEN / "frames.jsonl").read_text().splitlines()
        (folder / "frames").mkdir(parents=True)
        shutil.copy(GOLDEN / "session.json", folder)
        shutil.copytree(GOLDEN / "truth", folder / "truth")

    def add(self, count: int, **changes: object) -> None:
        """Add so many frames, with some facts of their records changed."""
        for text in self.lines[:count]:
            record = json.loads(text) | changes
            shutil.copy(GOLDEN / record["file"], self.folder / "frames")
            with open(self.folder / "frames.jsonl", "a") as index:
                index.write(json.dumps(record) + "\n")
        del self.lines[:count]


@pytest.fixture(autouse=True)
def fast(monkeypatch) -> None:
    """What is due at intervals is due at every step, but for the shown model."""
    for name in ("LOOK_S", "STATUS_S", "WAIT_S", "JOIN_PAUSE"):
        monkeypatch.setattr(ground.run.live.reconstruct, name, 0.0)
    monkeypatch.setattr(ground.run.live.reconstruct, "JOIN_STEPS", 20)


def begun(
    session: Path, statuses: list[LiveStatus] | None = None, changes: dict | None = None
) -> LiveReconstruction:
    folder = session / "runs" / "live"
    part = session / "runs" / ".live.part"
    part.mkdir(parents=True, exist_ok=True)
    on_status = (lambda status: None) if statuses is None else statuses.append
    config = preset("obbgs", CHANGES | (changes or {}))
    return LiveReconstruction(session, folder, part, config, 7, None, on_status)


def turns(live: LiveReconstruction, end: PassEnd, steps: int) -> None:
    while live.steps < steps:
        assert live.turn(end)


def test_frames_that_arrive_join_the_training_and_the_pass_ends_in_the_model_that_is_made_afterwards(
    tmp_path,
):
    writer, statuses = Writer(tmp_path / "s"), []
    arriving = iter([12, 12, 24])

    def on_status(status: LiveStatus) -> None:
        statuses.append(status)
        if status.step % 25 == 0 and (count := next(arriving, 0)):
            writer.add(count)

    with listening(writer.folder):  # as `ground listen`, which ends below

        def ended() -> bool:
            return not writer.lines and statuses[-1].frames_trained == 42

        with pytest.raises(Interrupted):
            reconstruct_live(writer.folder, changes=CHANGES, on_status=on_status, should_stop=ended)
    trained = [s.frames_trained for s in statuses]
    assert trained == sorted(trained) and {12, 21, 42} <= set(trained)  # 6 of the frames are held out
    shown = tmp_path / "s" / "runs" / "live"
    assert len(load_ply(shown / "model.ply")) == read_status(shown)["gaussians"]
    folder = reconstruct_live(writer.folder, changes=CHANGES, idle_timeout_s=0.0, on_status=on_status)
    assert folder == shown and statuses[-1].state == "finished"
    steps = [s.step for s in statuses]
    assert steps == sorted(steps)  # it went on after the interruption
    afterwards = reconstruct(writer.folder, "afterwards", changes=CHANGES | MANY_EXPECTED)
    models = [load_ply(run / "model.ply") for run in (folder, afterwards)]
    for tensor in TENSORS:
        assert torch.equal(*(getattr(model, tensor) for model in models)), tensor
    assert {p.name for p in afterwards.iterdir()} <= {p.name for p in folder.iterdir()}
    assert not list((writer.folder / "runs").glob(".*"))


def test_a_killed_reconstruction_goes_on_to_the_same_model(tmp_path):
    writer, end = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 1e9, False)
    writer.add(15)
    first = begun(writer.folder)
    turns(first, end, 10)
    writer.add(15)
    turns(first, end, 25)
    assert first.trainer is not None and len(first.trainer.setup.frames) == 27
    first.save()
    (writer.folder / "runs" / ".live.part" / "live-999.checkpoint").write_bytes(
        b""
    )  # of frames that never came
    second = begun(writer.folder)
    for live in (first, second):
        turns(live, end, 30)
    assert second.trainer is not None and len(second.trainer.state.history) == 30
    for name in TENSORS:
        assert torch.equal(getattr(first.trainer.gaussians, name), getattr(second.trainer.gaussians, name)), (
            name
        )


def test_frames_that_came_while_a_settled_training_was_away_are_trained_on(tmp_path, fast):
    """Its schedule is complete, and the pass is over when it is started again."""
    writer, end = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 1e9, False)
    writer.add(24)
    first = begun(writer.folder, changes={"steps": 30})
    while first.trainer is None or not first.trainer.stop_reason():
        assert first.turn(end)
    first.save()
    writer.add(24)
    over = PassEnd(tmp_path / "s", 0.0, False)
    again, statuses = begun(writer.folder, changes={"steps": 30}), []
    again._on_status = statuses.append
    while again.turn(over):
        pass
    again.close()
    again.finish(lambda: False)
    assert statuses[-1].state == "finished" and statuses[-1].frames_trained == 42
    metrics = json.loads((writer.folder / "runs" / "live" / "metrics.json").read_text())
    assert metrics["frames_trained"] == 42 and "while 42 frames came" in metrics["stop_reason"]


def test_it_waits_and_says_what_is_missing_and_frames_in_eclipse_are_none(tmp_path):
    writer, end, statuses = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 1e9, False), []
    live = begun(writer.folder, statuses)
    assert live.turn(end) and "waiting for the first frame" in statuses[-1].message
    writer.add(6)
    writer.add(6, in_eclipse=True)
    assert live.turn(end) and statuses[-1].state == "waiting"
    assert "6 frames of 2 brackets to train on (6 in eclipse" in statuses[-1].message
    assert "4 brackets are needed to begin" in line(dataclasses.asdict(statuses[-1]))
    writer.add(6)
    turns(live, end, 2)
    assert statuses[-1].frames_unusable == 6 and statuses[-1].state == "training"
    (entry,) = find_sessions([tmp_path])
    assert [run.name for run in entry.runs] == ["live"] and "training, 12 of 18 frames" in entry.runs[
        0
    ].problem
    writer.add(3, pose_valid=False)
    turns(live, end, 30)
    assert statuses[-1].frames_received == 21 and statuses[-1].frames_trained == 12


def test_a_damaged_picture_costs_its_frame_alone_and_is_told(tmp_path, caplog):
    """Two frames for training and a held-out one come with a flipped bit."""
    writer, end, statuses = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 0.0, False), []
    records = [json.loads(text) for text in writer.lines[:24]]
    writer.add(24)
    for record in (records[1], records[13], records[21]):
        path = writer.folder / record["file"]
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    live = begun(writer.folder, statuses, {"steps": 20})
    while live.turn(end):
        pass
    live.close()
    live.finish(lambda: False)
    assert statuses[-1].frames_received == 24 and statuses[-1].frames_trained == 19
    assert statuses[-1].frames_unusable == 3 and statuses[-1].frames_held_out == 2
    (told,) = (message for message in caplog.messages if "are damaged" in message)
    assert (
        "3 frames" in told
        and "left out: {}, {}, {};".format(*(records[at]["id"] for at in (1, 13, 21))) in told
    )
    run = open_run(writer.folder, "live")
    assert len(run.training) == 19 and [record.id for record in run.scored] == [r["id"] for r in records[22:]]


def test_a_pass_that_ends_with_too_few_frames_says_so(tmp_path):
    writer = Writer(tmp_path / "s")
    with pytest.raises(SessionError, match="no frame came into"):
        reconstruct_live(writer.folder, idle_timeout_s=0.0)
    with pytest.raises(SessionError, match="no frame came into"):
        reconstruct_live(tmp_path / "never", idle_timeout_s=0.0)
    assert not (tmp_path / "never").exists()
    (tmp_path / "empty").mkdir()
    with pytest.raises(SessionError, match="no frame came into"):
        reconstruct_live(tmp_path / "empty", idle_timeout_s=0.0)
    assert list((tmp_path / "empty").iterdir()) == []
    writer.add(2)
    with pytest.raises(TooFewFrames, match=r"no frame for 0 s, .*2 frames received.*3 frames are needed"):
        reconstruct_live(writer.folder, idle_timeout_s=0.0)
    assert not list((writer.folder / "runs").glob(".*/*.checkpoint"))


def test_of_few_brackets_none_is_held_out_and_the_score_is_that_of_the_training_frames(tmp_path):
    writer = Writer(tmp_path / "s")
    writer.add(12)
    reconstruct_live(writer.folder, changes=CHANGES | {"steps": 20}, idle_timeout_s=0.0)
    run = open_run(writer.folder, "live")
    assert run.metrics["frames_trained"] == len(run.training) == len(run.scored) == 12
    assert run.metrics["scored_frames"] == "training"


def test_an_unfinished_live_run_is_not_lost_to_a_reconstruction_of_the_same_name(tmp_path):
    writer = Writer(tmp_path / "s")
    writer.add(24)
    live = begun(writer.folder)
    turns(live, PassEnd(tmp_path / "s", 1e9, False), 20)
    live.save()
    live.close()
    part = writer.folder / "runs" / ".live.part"
    assert list(part.glob("live-*.checkpoint"))
    with pytest.raises(SessionError, match="`ground live --name live` goes on with it"):
        reconstruct(writer.folder, "live", changes=CHANGES | {"steps": 20})
    assert list(part.glob("live-*.checkpoint"))


def test_a_worse_model_is_not_shown(tmp_path):
    writer, end = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 1e9, False)
    writer.add(48)
    live = begun(writer.folder)
    turns(live, end, 40)
    live.close()
    good, model = live.shown.gaussians, (writer.folder / "runs" / "live" / "model.ply").read_bytes()
    assert good is not None and live.shown.held_out_db > 25
    assert not live.shown.offer(dataclasses.replace(good, sh=good.sh + 2), 41)
    assert (writer.folder / "runs" / "live" / "model.ply").read_bytes() == model


def test_where_tags_err_models_are_compared_and_shown_with_the_poses_that_they_were_trained_with(tmp_path):
    writer, end = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 1e9, False)
    for i, text in enumerate(writer.lines):
        record = json.loads(text)
        turn = Rotation.from_rotvec(
            2e-3 * np.random.default_rng(record["bracket"]).normal(size=3)
        ).as_matrix()
        pose = np.array(record["world_to_camera"])
        pose[:3] = turn @ pose[:3]
        covariance = np.array(record["covariance"]) + np.diag([0, 0, 0, 4e-6, 4e-6, 4e-6])
        quat = matrix_to_quat(pose[:3, :3]).tolist()
        changed = {"world_to_camera": pose.tolist(), "quat_body_to_camera": quat}
        writer.lines[i] = json.dumps(record | changed | {"covariance": covariance.tolist()})
    writer.add(48)
    live = begun(writer.folder, changes={"poses.refine": "always"})
    turns(live, end, 120)
    live.close()
    trainer, folder = live.trainer, writer.folder / "runs" / "live"
    assert trainer is not None and trainer.pose_estimate is not None
    live.shown.offer(trainer.gaussians, live.steps, trainer.pose_estimate)
    shown = read_estimate(folder)
    assert shown is not None and len(shown.frame_ids) == 42
    assert live.shown.estimate is not None and live.shown.estimate.own.any()
    np.testing.assert_allclose(shown.estimated, live.shown.estimate.estimated, atol=1e-6)
    as_tagged = live.shown.score_db(trainer.gaussians, None)
    assert live.shown.score_db(trainer.gaussians, trainer.pose_estimate) > as_tagged + 1


def test_a_full_disk_is_said_and_does_not_end_the_training(tmp_path, monkeypatch, caplog):
    writer, end = Writer(tmp_path / "s"), PassEnd(tmp_path / "s", 1e9, False)
    writer.add(24)
    live = begun(writer.folder)
    turns(live, end, 3)

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    turns(live, end, 6)
    live.save()
    assert "status.json cannot be renewed: No space left" in caplog.text
    assert "checkpoint cannot be written" in caplog.text
    live.shown.gaussians = None
    with pytest.raises(SessionError, match=r"model.ply cannot be written: .*No space left"):
        live.finish(lambda: False)
    monkeypatch.undo()
    turns(live, end, 8)


def test_a_finished_run_and_one_that_another_process_makes_are_left_alone(tmp_path):
    writer = Writer(tmp_path / "s")
    writer.add(12)
    reconstruct_live(writer.folder, changes=CHANGES | {"steps": 5}, idle_timeout_s=0.0)
    with pytest.raises(SessionError, match="is a finished run: --overwrite replaces it"):
        reconstruct_live(writer.folder)
    with (
        unfinished_run(writer.folder / "runs" / "other", False, []),
        pytest.raises(SessionError, match="is making this run in"),
    ):
        reconstruct_live(writer.folder, "other")


def test_the_pass_is_over_when_the_listener_ends_or_nobody_listens_and_nothing_comes(tmp_path):
    waits = PassEnd(tmp_path, 1e9, False)
    assert waits.reason() == "" and "no frame for 0 s" in PassEnd(tmp_path, 0.0, False).reason()
    with listening(tmp_path):
        assert waits.reason() == "" and PassEnd(tmp_path, 0.0, True).reason() == ""
    assert "has ended" in waits.reason() and "has ended" in PassEnd(tmp_path, 1e9, True).reason()


def test_every_eighth_bracket_is_held_out_whatever_else_came(tmp_path):
    records = [json.loads(text) for text in (GOLDEN / "frames.jsonl").read_text().splitlines()]

    @dataclasses.dataclass
    class Record:
        bracket: int

    assert {r["bracket"] for r in records if is_held_out(Record(r["bracket"]))} == {7, 15}  # pyright: ignore


def test_a_key_that_cannot_be_read_is_said_before_anything_is_trained(tmp_path):
    Writer(tmp_path / "s").add(48)
    with pytest.raises(ConfigError, match="cannot read the key"):
        reconstruct_live(tmp_path / "s", key_file=tmp_path / "none.key")
    assert not (tmp_path / "s" / "runs").exists()


def test_a_training_that_fails_by_itself_is_not_started_again_and_its_message_is_shown(tmp_path):
    (tmp_path / "runs" / "live").mkdir(parents=True)  # not ours to replace
    said: list[str] = []
    options = ["--session", str(tmp_path)]
    with LiveProcess(tmp_path, tmp_path / "runs" / "live", options, said.append) as training:
        with pytest.raises(TrainingFailed, match="exists and is not a finished run, so it is not replaced"):
            training.finish(lambda: False, lambda facts: None)
        training.tend()
    assert len(said) == 1 and "receiving goes on: " in said[0] and "ground:" not in said[0]


def test_a_training_whose_log_cannot_be_opened_does_not_end_the_reception(tmp_path):
    """As where `sudo` has left the session's files to another user."""
    (tmp_path / "live.log").mkdir()
    said: list[str] = []
    with LiveProcess(tmp_path, tmp_path / "runs" / "live", [], said.append) as training:
        for _ in range(3):
            training.tend()
        with pytest.raises(TrainingFailed, match=r"cannot be started: .*live\.log: Is a directory"):
            training.finish(lambda: False, lambda facts: None)
    assert len(said) == 1 and "receiving goes on" in said[0]


@pytest.mark.parametrize("option", [("--idle-timeout", "-3"), ("--exit-after", "0")])
def test_an_ending_that_cannot_be_is_refused_before_anything_is_written(tmp_path, option):
    folder = tmp_path / "session"
    result = CliRunner().invoke(cli.app, ["live", "--session", str(folder), *option])
    assert result.exit_code == 2 and option[0] in result.output and not folder.exists()
