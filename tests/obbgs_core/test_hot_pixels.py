"""Hot pixels are told from the target, from stars and from noise by the frames alone."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor
from obbgs_core.start.hot_pixels import hot_pixels, without_hot_pixels

SENSOR = Sensor(0.0, 255.0, 2.5e6, 1e9, 6.0)
SIZE_PX = 64


def passing(rng: np.random.Generator, number: int, channels: int) -> np.ndarray:
    """Return noiseless frames [F, H, W, C] of a textured target that moves, with one star each."""
    texture = rng.uniform(20, 200, (24, 24, channels))
    frames = np.zeros((number, SIZE_PX, SIZE_PX, channels))
    for frame in frames:
        top, left, row, column = rng.integers(0, SIZE_PX - 24, 4)
        frame[top : top + 24, left : left + 24] = texture
        frame[row, column] = 255
    return frames


def read(light: np.ndarray, rng: np.random.Generator) -> list[TrainingFrame]:
    """Return frames of readings of a light [F, H, W, C], DN, with the sensor's noise."""
    noisy = np.rint(light + SENSOR.read_noise_dn * rng.standard_normal(light.shape)).clip(0, 255)
    return [
        TrainingFrame(torch.from_numpy(dn.astype(np.float32)), 1e-4, torch.eye(4), torch.eye(3), i)
        for i, dn in enumerate(noisy)
    ]


@given(st.integers(0, 50), st.integers(24, 60), st.sampled_from([1, 3]))
@settings(max_examples=8, deadline=None)
def test_hot_pixels_are_found_and_no_others(seed, number, channels):
    rng = np.random.default_rng(seed)
    places = rng.permutation(16 * 16)[:6]
    hot = np.zeros((SIZE_PX, SIZE_PX), bool)
    hot[4 * (places // 16) + 1, 4 * (places % 16) + 2] = True  # none beside another
    more_dn = np.where(hot, rng.uniform(30, 255, hot.shape), 0)
    light = passing(rng, number, channels)
    frames = read(light + more_dn[..., None], rng)
    assert torch.equal(hot_pixels(frames, SENSOR), torch.from_numpy(hot))
    cleaned, said = without_hot_pixels(frames, SENSOR)
    assert said.startswith("6 hot pixels")
    for before, after in zip(frames, cleaned, strict=True):
        assert torch.equal(before.dn[~hot], after.dn[~hot])
        row, column = np.argwhere(hot)[0]
        around = before.dn[row - 1 : row + 2, column - 1 : column + 2]
        expected = (around.sum(dim=(0, 1)) - before.dn[row, column]) / 8
        torch.testing.assert_close(after.dn[row, column], expected)


@pytest.mark.parametrize("number", [4, 40])
def test_frames_without_hot_pixels_stay_as_they_are(number):
    rng = np.random.default_rng(1)
    frames = read(passing(rng, number, 3), rng)
    kept, said = without_hot_pixels(frames, SENSOR)
    assert kept is frames and not said
    bright = [dataclasses.replace(f, background=1.0) for f in frames]
    assert without_hot_pixels(bright, SENSOR)[0] is bright
