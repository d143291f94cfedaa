"""Rounds of the poses in the background: when they are answered, and that nothing depends on how long that takes."""

import threading

import numpy as np
import pytest
import torch

from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.poses.answers import Answer, Question
from obbgs_core.train.poses import steps_between
from obbgs_core.train.trainer import Trainer, train
from tests.scenes import QUICK, SENSOR, move_poses_in, photographed, tagged, target

CONFIG = preset("obbgs", QUICK | {"poses.refine": "always"})


@pytest.fixture
def doubted(monkeypatch) -> list[TrainingFrame]:
    move_poses_in(monkeypatch, 8)  # every 5 of 40 steps, answered 4 steps later
    return tagged(photographed(target(), 18), True)


def test_models_do_not_depend_on_how_long_pictures_take_to_say_what_they_know_of_poses(
    doubted, monkeypatch, tmp_path, use_threads
):
    use_threads(1)  # each round is answered before the step goes on
    whole = train(doubted, SENSOR, CONFIG, seed=3)
    told = f"all 40 steps of the schedule done, {len(whole.history)} in all (residual"
    assert len(whole.history) > 40 and whole.stop_reason.startswith(told)
    use_threads(3)
    may_answer, answer, answered = threading.Event(), Question.answer, []

    def held_back(question: Question) -> Answer:
        assert may_answer.wait(60)
        answered.append((len(question.indices), torch.get_num_threads()))
        return answer(question)

    monkeypatch.setattr(Question, "answer", held_back)
    first = Trainer(doubted, SENSOR, CONFIG, seed=3)
    while first.state.poses.round is None:
        first.step()
    first.step()  # without the answer
    assert not answered and first.state.poses.moved == 0
    may_answer.set()
    first.save(tmp_path / "checkpoint")  # which waits for it
    assert answered == [(len(doubted), 1)]
    resumed = Trainer(doubted, SENSOR, CONFIG, seed=3)
    assert resumed.resume(tmp_path / "checkpoint") and resumed.state.poses.round is not None
    for trainer in (first, resumed):
        while not trainer.stop_reason():
            trainer.step()
        result = trainer.result("")
        for name, tensor in whole.gaussians.tensors().items():
            assert torch.equal(tensor, getattr(result.gaussians, name)), name
        assert whole.pose_estimate is not None and result.pose_estimate is not None
        np.testing.assert_array_equal(whole.pose_estimate.estimated, result.pose_estimate.estimated)


def test_an_error_in_the_background_ends_the_training(doubted, monkeypatch, use_threads):
    def broken(question: Question) -> Answer:
        raise MemoryError("no room for pictures")

    use_threads(3)
    monkeypatch.setattr(Question, "answer", broken)
    with pytest.raises(MemoryError, match="no room for pictures"):
        train(doubted, SENSOR, CONFIG)


@pytest.mark.parametrize(("brackets", "apart"), [(12, 17), (50, 17), (60, 24), (100, 67), (150, 100)])
def test_rounds_of_more_brackets_are_rarer_so_that_all_take_less_time(brackets, apart):
    frames = photographed(target(5), brackets, size_px=16)
    assert steps_between(Trainer(frames, SENSOR, preset("obbgs")).setup, 0.1) == apart
