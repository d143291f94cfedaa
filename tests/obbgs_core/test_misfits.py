"""Brackets that fit no pose that their tags allow: found, left out, and named."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import stats

from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.poses.answers import Answer
from obbgs_core.poses.registration import PoseInformation
from obbgs_core.train.adam import Adam
from obbgs_core.train.growth import Growth
from obbgs_core.train.poses import LEFT_OUT_FROM
from obbgs_core.train.trainer import Trainer
from tests.scenes import QUICK, SENSOR, decide, move_poses_in, now_of, photographed, tagged, target

CONFIG = preset("obbgs", QUICK | {"poses.refine": "always"})


@pytest.fixture(scope="module")
def frames() -> list[TrainingFrame]:
    return tagged(photographed(target(60, seed=5), 26, exposures_s=(1e-4,)), True, sigma_rad=0.004)


def trained(frames: list[TrainingFrame], monkeypatch: pytest.MonkeyPatch) -> Trainer:
    """Return a training that has found the true model when poses have mostly settled, with one more round done."""
    move_poses_in(monkeypatch, CONFIG.steps)  # in every step, so that each answers at once
    trainer = Trainer(frames, SENSOR, CONFIG)
    state = trainer.state
    state.gaussians = target(60, seed=5).trainable()
    state.adam, state.growth = Adam(state.gaussians), Growth.of(len(state.gaussians))
    for share in (0.3, 0.5, LEFT_OUT_FROM):
        state.steps_done = round(share * CONFIG.steps)
        assert state.poses.due(now_of(trainer))
        decide(trainer, state.poses)
    return trainer


def swapped(frames: list[TrainingFrame]) -> list[TrainingFrame]:
    """Return frames of which two have each other's picture: no pose near the tagged ones shows it."""
    return [dataclasses.replace(f, dn=frames[{4: 17, 17: 4}.get(i, i)].dn) for i, f in enumerate(frames)]


def test_frames_whose_poses_err_by_more_than_their_tags_say_are_left_out_and_named(frames, monkeypatch):
    trainer = trained(swapped(frames), monkeypatch)
    result = trainer.result("")
    assert sorted(result.misfit_frames) == [4, 17]
    assert {i for group in trainer.state.order.groups for i in group} == set(range(26)) - {4, 17}
    order = trainer.state.order  # who was drawn how often is not forgotten
    assert sum(order.visits.values()) == order.turn
    assert result.pose_estimate is not None
    assert result.pose_estimate.frame_ids == [i for i in range(26) if i not in (4, 17)]
    assert result.pose_estimate.estimated.shape == (24, 4, 4)
    trainer.join([dataclasses.replace(frames[0], id=26)])  # what is left out stays so when others come
    assert {i for group in trainer.state.order.groups for i in group} == set(range(27)) - {4, 17}
    trainer.step()


def test_frames_that_err_as_their_tags_say_all_stay(frames, monkeypatch):
    trainer = trained(frames, monkeypatch)
    assert trainer.result("").misfit_frames == []
    assert {i for group in trainer.state.order.groups for i in group} == set(range(26))


def test_frames_that_stand_out_are_asked_in_small_pictures_next(frames, monkeypatch):
    """A pose that is three pixels off does not find back in a whole picture of a pattern that repeats."""
    poses, setup = trained(swapped(frames), monkeypatch).state.poses, Trainer(frames, SENSOR, CONFIG).setup
    assert {4, 17} <= set(poses.doubtful)
    assert poses._coarse(setup, LEFT_OUT_FROM) == {}  # pictures of 8 pixels would show nothing
    monkeypatch.setattr("obbgs_core.train.poses.SMALLEST_PX", 8)
    assert poses._coarse(setup, LEFT_OUT_FROM) == dict.fromkeys(poses.doubtful, 0.25)


def standing_out(dispersion: torch.Tensor, misfit: torch.Tensor, by: float) -> list[int]:
    nothing = PoseInformation(torch.zeros(0), torch.zeros(0))
    return Answer(list(range(len(misfit))), nothing, dispersion, misfit).standing_out(by)


@pytest.mark.parametrize("by", [3.0, 6.0])
def test_residuals_stand_out_by_scipys_median_absolute_deviation(by):
    rng = np.random.default_rng(3)
    residuals = np.exp(rng.normal(2, 0.3, 60))
    residuals[[5, 40]] *= [3000, 20]
    residuals[7] = np.nan  # the target is not in the picture
    shares = np.sqrt(residuals)
    shares[40] = np.nanmedian(shares)  # thin structures: many deviations of the noise, but little light
    logs = np.log(residuals)
    spread = stats.median_abs_deviation(logs, scale="normal", nan_policy="omit")
    limit = np.nanmedian(logs) + by * spread
    assert (logs > limit)[[5, 40]].all()
    found = standing_out(torch.from_numpy(residuals), torch.from_numpy(shares), by)
    assert 5 in found and not {7, 40} & set(found)
    assert found == np.flatnonzero((logs > limit) & (shares > by * np.nanmedian(shares))).tolist()
    far, shares = torch.tensor([1.0, 1.0, 1.0, 9.0, 9.0]), torch.tensor([0.0, 0.1, 0.1, 0.55, 0.65])
    assert standing_out(far, shares, 6.0) == [4]


def test_dim_frames_are_in_doubt_where_most_of_their_light_is_wrong():
    """Two frames of a fly-around had 6 times the median misfit and were 6 and 1 px off."""
    logs, shares = torch.linspace(-1, 1, 41, dtype=torch.float64), torch.full((41,), 0.1)
    logs[[3, 5, 7, 9]] = (
        torch.tensor([1.4, 0.5, 1.4, 2.5], dtype=torch.float64) * logs.abs().median() * 1.4826
    )
    shares[[3, 5, 7, 9]] = torch.tensor([0.63, 0.63, 0.35, 0.35])
    answer = Answer(list(range(41)), PoseInformation(torch.zeros(0), torch.zeros(0)), logs.exp(), shares)
    assert answer.standing_out(3.0) == [] and answer.doubtful(3.0) == [3]
    shares[9] = 0.4
    assert answer.doubtful(3.0) == [3, 9]
