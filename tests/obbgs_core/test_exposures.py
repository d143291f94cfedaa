"""Errors of exposure times from frame to frame are told beside a model, and glare is not taken for them."""

import dataclasses

import numpy as np
import pytest
import torch

from obbgs_core.batches import Batches
from obbgs_core.evidence.exposures import LEAST, frame_errors
from obbgs_core.evidence.response import FRAMES_FROM, Response
from obbgs_core.frames import TrainingFrame
from tests.scenes import EXPOSURES_S, SENSOR, photographed, target

COUNT = 60


def taken(errors: np.ndarray) -> list[TrainingFrame]:
    """Return frames whose true exposure times are exp(errors) times as long as stated."""
    stated_s = np.resize(EXPOSURES_S, COUNT)
    frames = photographed(target(), COUNT, exposures_s=(stated_s * np.exp(errors)).tolist())
    return [dataclasses.replace(f, exposure_time_s=float(s)) for f, s in zip(frames, stated_s, strict=True)]


@pytest.mark.parametrize("sigma", [0.1, 0.3])
def test_each_frames_error_is_found(sigma):
    errors = np.random.default_rng(5).normal(0, sigma, COUNT)
    batches, response = Batches(taken(errors), SENSOR.white_dn), Response()
    for _ in range(2):  # as often as in a training
        assert response.decide(target(), batches.exposed(response.gains(batches.frames)), SENSOR)
    found = np.log(response.gains(batches.frames) or [])
    np.testing.assert_allclose(found - found.mean(), errors - errors.mean(), atol=0.2 * sigma)
    assert found.mean() == pytest.approx(0, abs=0.3 * sigma)
    assert response.exponent == 1 and "from frame to frame" in str(response) and not response.is_as_stated


def test_frames_that_joined_since_are_as_stated():
    response = Response(frames={0: 0.1, 2: -0.2})
    frames = [dataclasses.replace(f, id=i) for i, f in enumerate(photographed(target(), 3))]
    np.testing.assert_allclose(response.gains(frames) or [], np.exp([0.1, 0.0, -0.2]))


@pytest.mark.parametrize("sigma", [0.0, LEAST / 2])
def test_errors_that_are_harmless_are_not_taken(sigma):
    errors = np.random.default_rng(5).normal(0, sigma, COUNT)
    response = Response()
    assert not response.decide(target(), Batches(taken(errors), SENSOR.white_dn), SENSOR)
    assert response.is_as_stated


def test_light_that_changes_slowly_with_the_direction_of_view_is_no_error():
    """As where the whole target glares, which the model does not show."""
    frames = photographed(target(), COUNT)
    places = np.stack([torch.linalg.inv(f.world_to_camera)[:3, 3].numpy() for f in frames])
    glare = 0.3 * places @ [0.6, 0.0, 0.8] / np.linalg.norm(places, axis=1)
    batches = Batches(taken(glare), SENSOR.white_dn)
    assert glare.std() > 3 * LEAST
    assert frame_errors(target(), batches, SENSOR, np.zeros(COUNT)) is None


def test_a_model_in_the_making_tells_nothing_of_single_frames():
    errors = np.random.default_rng(5).normal(0, 0.3, COUNT)
    response = Response()
    response.decide(target(), Batches(taken(errors), SENSOR.white_dn), SENSOR, FRAMES_FROM / 2)
    assert response.frames is None


def test_too_few_frames_tell_nothing():
    errors = np.random.default_rng(5).normal(0, 0.3, COUNT)
    batches = Batches(taken(errors)[:12], SENSOR.white_dn)
    assert frame_errors(target(), batches, SENSOR, np.zeros(12)) is None
