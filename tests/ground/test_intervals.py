"""How often stated intervals hold in views that a model never saw, and the sector that a comparison holds out."""

import dataclasses

import numpy as np
import pytest
import torch

from compare.case import load_case
from compare.errors import CompareError
from obbgs_core.frames import cameras_of
from obbgs_core.losses import fit_figures
from obbgs_core.misfit import model_error
from obbgs_core.render import render
from obbgs_core.score.intervals import interval_scores, stated_error_scores
from obbgs_core.score.uncertainty import parameter_deviations
from tests import scenes
from tests.small_sessions import small_session


def test_intervals_hold_as_often_as_they_say_where_the_posterior_has_the_right_form():
    """The model is off by a draw of its posterior, three times as far: the calibration has to find the factor."""
    truth = scenes.target()
    training, scored = scenes.photographed(truth, 12), scenes.photographed(truth, 8, seed=1)
    draws = torch.Generator().manual_seed(0)
    deviations = parameter_deviations(truth, training, scenes.SENSOR)
    off = dataclasses.replace(
        truth,
        **{
            name: value + 3 * deviations[name] * torch.randn(value.shape, generator=draws)
            for name, value in truth.tensors().items()
        },
    )
    radiance = [render(truth, cameras_of([frame])).radiance[0] for frame in scored]
    found = interval_scores(off, training, scenes.SENSOR, scored, radiance)
    assert 0.85 < found["interval_90_noisy"] < 0.95
    assert 0.80 < found["interval_90_clean"] < 0.99
    assert 0 < found["interval_90_half_width"] < 0.2
    without_truth = interval_scores(off, training, scenes.SENSOR, scored, [])
    assert without_truth == {"interval_90_noisy": found["interval_90_noisy"]}


def test_nothing_is_stated_where_no_reading_can_calibrate():
    truth = scenes.target()
    frames = scenes.photographed(truth, 4)
    dark = [dataclasses.replace(frame, exposure_time_s=1e-12) for frame in frames]
    assert interval_scores(truth, frames, scenes.SENSOR, dark, []) == {}


SATURATING_S = 2e-3  # at which some of the readings are full scale


def test_readings_that_err_as_stated_have_a_chi2_of_one():
    """Readings are drawn with the variance of noise and own error about the prediction, then clipped."""
    model, misfit, draws = scenes.target(), 0.2, torch.Generator().manual_seed(0)
    frames = []
    for frame in scenes.photographed(model, 24, seed=2):
        for exposure_s in (frame.exposure_time_s, SATURATING_S):
            time_s, radiance = torch.tensor(exposure_s), render(model, cameras_of([frame])).radiance
            prediction = scenes.SENSOR.predicted(radiance, time_s)
            error = model_error(radiance, time_s, scenes.SENSOR, 1, misfit)
            sigma = (prediction.variance_dn2 + error.variance_dn2(prediction, scenes.SENSOR)).sqrt()
            dn = prediction.expected_dn + sigma * torch.randn(radiance.shape, generator=draws)
            dn = dn.clamp(0, scenes.SENSOR.white_dn)[0]
            frames.append(dataclasses.replace(frame, dn=dn, exposure_time_s=exposure_s))
    saturated = torch.stack([frame.dn == scenes.SENSOR.white_dn for frame in frames[1::2]])
    assert 0.02 < saturated.double().mean() < 0.5
    found = stated_error_scores(model, scenes.SENSOR, frames, misfit)
    # some 30,000 readings whose squares have a deviation of 1.4 vary by 1 % in the mean
    assert found["chi2_held_out_both"] == pytest.approx(1, abs=0.03)
    assert found["chi2_held_out"] > 2
    assert stated_error_scores(model, scenes.SENSOR, frames, None) == {
        "chi2_held_out": found["chi2_held_out"]
    }
    rendered = [render(model, cameras_of([frame])) for frame in frames]
    radiance, alpha = (torch.cat([getattr(r, name) for r in rendered]) for name in ("radiance", "alpha"))
    times_s = torch.tensor([frame.exposure_time_s for frame in frames]).view(-1, 1, 1, 1)
    fit = fit_figures(radiance, alpha, times_s, torch.stack([f.dn for f in frames]), scenes.SENSOR)
    assert found["chi2_held_out"] == pytest.approx(fit.chi2, rel=1e-3)


def test_no_error_is_stated_of_frames_that_show_nothing_or_full_scale_alone():
    empty = scenes.target()
    empty = dataclasses.replace(empty, opacity_logits=torch.full_like(empty.opacity_logits, -20.0))
    assert stated_error_scores(empty, scenes.SENSOR, scenes.photographed(empty, 2), 0.1) == {}
    white = [
        dataclasses.replace(frame, exposure_time_s=1e3) for frame in scenes.photographed(scenes.target(), 2)
    ]
    assert stated_error_scores(scenes.target(), scenes.SENSOR, white, 0.1) == {}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return small_session(tmp_path_factory.mktemp("sessions") / "target")


def test_a_sector_is_held_out_as_a_whole_and_alone_is_scored(session):
    whole, without = load_case(session), load_case(session, 90.0)
    ids = [{f.id for f in frames} for frames in (without.training, without.held_out, without.calibration)]
    assert set.union(*ids) == {f.id for f in whole.training + whole.held_out}
    assert sum(map(len, ids)) == len(set.union(*ids)) and all(ids)
    assert ids[2] < {f.id for f in whole.held_out}
    assert len(without.radiance) == len(without.coverage) == len(without.held_out)

    def directions(frames) -> np.ndarray:
        poses = torch.stack([f.world_to_camera for f in frames]).double().numpy()
        centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
        return centres / np.linalg.norm(centres, axis=1, keepdims=True)

    # seen along the axis of least variation, the sector is an interval of azimuth that no training frame enters
    every = directions(whole.training)
    _, axes = np.linalg.eigh(every.T @ every)
    azimuths = [
        np.degrees(np.arctan2(*(directions(frames) @ axes[:, 1:]).T))
        for frames in (without.held_out, without.training)
    ]
    middle = np.degrees(np.angle(np.exp(1j * np.radians(azimuths[0])).mean()))
    inside, outside = (np.abs((azimuth - middle + 180) % 360 - 180) for azimuth in azimuths)
    assert inside.max() - inside.min() <= 90 and np.ptp((azimuths[0] - middle + 180) % 360 - 180) <= 90.001
    assert outside.min() > inside.min()


def test_a_sector_that_holds_everything_out_is_refused(session):
    with pytest.raises(CompareError, match="leaves no frame"):
        load_case(session, 359.9999)
