"""Rounds of the poses in the background: when they are answered, and that nothing depends on how long that takes."""

import time

import numpy as np
import pytest
import torch

from obbgs_core import compiled
from obbgs_core.frames import TrainingFrame
from obbgs_core.train.pose_answers import Answer, Question
from obbgs_core.train.presets import preset
from obbgs_core.train.trainer import Trainer, train
from tests.scenes import QUICK, SENSOR, move_poses_in, photographed, tagged, target

CONFIG = preset("obbgs", QUICK | {"poses.refine": "always"})


@pytest.fixture
def doubted(monkeypatch) -> list[TrainingFrame]:
    move_poses_in(monkeypatch, 8)  # every 5 of 40 steps, answered 4 steps later
    return tagged(photographed(target(), 18), True)


def test_models_do_not_depend_on_how_long_pictures_take_to_say_what_they_know_of_poses(
    doubted, monkeypatch, tmp_path
):
    answer, late = Question.answer, []
    whole = train(doubted, SENSOR, CONFIG, seed=3)

    def slow(question: Question) -> Answer:
        time.sleep(0.2)
        late.append(len(question.indices))
        return answer(question)

    monkeypatch.setattr(Question, "answer", slow)
    first = Trainer(doubted, SENSOR, CONFIG, seed=3)
    while first.state.round is None:
        first.step()
    assert not late  # the step went on without the answer
    first.step()
    first.save(tmp_path / "checkpoint")  # which waits for it
    assert late == [len(doubted)] and first.state.pose_rounds == 0
    resumed = train(doubted, SENSOR, CONFIG, 3, checkpoint=tmp_path / "checkpoint")
    while not first.stop_reason():
        first.step()
    for name, tensor in whole.gaussians.tensors().items():
        for other in (first.gaussians, resumed.gaussians):
            assert torch.equal(tensor, getattr(other, name)), name
    assert whole.pose_estimate is not None and resumed.pose_estimate is not None
    np.testing.assert_array_equal(whole.pose_estimate.estimated, resumed.pose_estimate.estimated)


def test_pytorch_stays_on_one_thread_for_as_long_as_pictures_are_asked(doubted, use_threads):
    use_threads(3)
    trainer = Trainer(doubted, SENSOR, CONFIG)
    while trainer.state.round is None:
        assert (torch.get_num_threads(), compiled.threads()) == (3, 3)
        trainer.step()
    assert (torch.get_num_threads(), compiled.threads()) == (1, 3)
    del trainer
    assert (torch.get_num_threads(), compiled.threads()) == (3, 3)
