"""What empty sky reads is measured on the frames alone, and its departure from black does not harm a model."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import grey_opening
from scipy.optimize import minimize
from scipy.stats import norm

from hil.sky.sensor import converted
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.methods.presets import preset
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db
from obbgs_core.sensor import Sensor
from obbgs_core.start import sky_level
from obbgs_core.start.sky_level import cut_pixels, field, levelled
from obbgs_core.train import train
from tests.scenes import QUICK, SENSOR, LargestTensor, ball, photographed, target

SIZE_PX = 96
DARK = Sensor(0.0, 255.0, 2.5e6, 1e9, 6.0)  # black is 0: half of the noise on empty sky is clipped


def seen(sensor: Sensor, departure_dn: list[np.ndarray], blocked: float = 0.4) -> list[TrainingFrame]:
    """Return frames whose target, bright at one side and dark at the other, covers a share of them; the rest is sky."""
    rng, frames = np.random.default_rng(1), []
    height = width = SIZE_PX
    inside = np.zeros((height, width), bool)
    inside[: int(blocked * height), :] = True
    light = np.where(inside, np.linspace(0.1, 0.6, width)[None] * (sensor.white_dn - sensor.black_dn), 0.0)
    for number, departure in enumerate(departure_dn):
        signal = light + sensor.black_dn + departure
        dn = converted(signal[..., None], sensor.read_noise_dn, int(sensor.white_dn), rng)
        dn = torch.from_numpy(dn.astype(np.float32))
        frames.append(TrainingFrame(dn, 1e-4, torch.eye(4), torch.eye(3), number))
    return frames


def planes(levels: list[tuple[float, float, float]]) -> list[np.ndarray]:
    """Return departures [H, W] by level in the middle, and rises to the right and to the lower edge, DN."""
    place = (np.arange(SIZE_PX) + 0.5) * 2 / SIZE_PX - 1
    return [a + b * place[None] + c * place[:, None] for a, b, c in levels]


@pytest.mark.parametrize("sensor", [DARK, dataclasses.replace(SENSOR, read_noise_dn=6.0)])
def test_the_level_of_each_frame_is_measured_as_precisely_as_stated(sensor):
    true = [(3 + 2 * math.sin(i), math.cos(2 * i), math.sin(3 * i)) for i in range(24)]
    _, _, level = levelled(seen(sensor, planes(true)), sensor)
    error = (level.planes_dn[:, 0] - torch.tensor(true)) / level.sigma_dn[:, 0]
    # 72 normal deviations: their mean square is within 4 of its own deviations of 1
    assert abs(float(error.square().mean()) - 1) < 4 * math.sqrt(2 / 72)
    assert level.sigma_dn.max() < 0.1 * sensor.read_noise_dn


def test_a_clipped_level_is_the_likeliest_by_scipy():
    (frame,) = frames = seen(DARK, planes([(1.5, 0, 0)]))
    _, _, level = levelled(frames * 3, DARK)
    sky = frame.dn[SIZE_PX // 2 :].flatten().numpy()

    def negative_log_likelihood(parameters: np.ndarray) -> float:
        mean, sigma = parameters
        zero = sky == 0  # a reading of 0 is a signal below half a DN
        return -float(norm.logpdf(sky[~zero], mean, sigma).sum() + zero.sum() * norm.logcdf(0.5, mean, sigma))

    best = minimize(negative_log_likelihood, [1.0, 5.0], method="Nelder-Mead").x
    assert float(level.planes_dn[0, 0, 0]) == pytest.approx(
        best[0], abs=4 * float(level.sigma_dn[0, 0, 0]) * 3**0.5
    )


@given(st.floats(0.5, 3.0), st.integers(0, 3))
@settings(max_examples=10, deadline=None)
def test_where_the_stated_level_fits_nothing_is_changed_whatever_the_noise_is_taken_for(factor, seed):
    rng = np.random.default_rng(seed)
    frames = seen(DARK, planes([(0, 0, 0)] * 6), blocked=rng.uniform(0.1, 0.6))
    told = dataclasses.replace(DARK, read_noise_dn=factor * DARK.read_noise_dn)
    same, sensor, level = levelled(frames, told)
    assert same is frames and sensor is told and level.fits


def test_nothing_is_measured_where_the_target_fills_the_picture_or_in_front_of_another_background():
    full = seen(SENSOR, planes([(0, 0, 0)] * 6), blocked=1.0)
    lit = [
        dataclasses.replace(f, dn=f.dn + 500) for f in full
    ]  # an even face in front of everything but a corner
    for f in lit:
        f.dn[:20, :20] = full[0].dn[-20:, :20] * 0 + SENSOR.black_dn
    assert levelled(lit, SENSOR)[2].fits
    white = [dataclasses.replace(f, background=0.5) for f in seen(SENSOR, planes([(9, 0, 0)] * 6))]
    assert levelled(white, SENSOR)[2].fits


def test_the_level_of_a_frame_that_shows_the_earth_is_that_of_the_others_and_has_no_error_of_its_own():
    frames = seen(SENSOR, planes([(3.0 + i, 0, 0) for i in range(6)]))
    frames[5] = dataclasses.replace(frames[5], earth_m=torch.tensor([0.0, 0.0, 7e6]))
    levels = levelled(frames, SENSOR)[2].by_frame()
    assert levels[5][1] is None and levels[5][0] == pytest.approx(5.0, abs=0.2)
    assert all(levels[i][1] is not None for i in range(5))


def test_what_flight_has_cut_is_no_sky_and_stays_black():
    """Around the target a rim of the sky is left, and its level is that of the whole picture."""
    sensor = dataclasses.replace(SENSOR, read_noise_dn=6.0)
    true = torch.tensor([4.0 + n % 2 for n in range(12)])
    frames = seen(sensor, planes([(level, 1.0, 0.0) for level in true.tolist()]), blocked=0.0)
    for f in frames:
        f.dn[35:60, 30:66] += 800 + 20 * torch.arange(36.0)[:, None]
        sent = torch.zeros(SIZE_PX, SIZE_PX, dtype=torch.bool)
        sent[26:69, 21:75] = True  # flight's margin is 9 px
        f.dn[~sent] = sensor.black_dn
    corrected, told, level = levelled(frames, sensor)
    assert (level.planes_dn[:, 0, 0] - true).abs().max() < 0.25 * sensor.read_noise_dn
    for f in corrected:
        assert (f.dn[:24] == told.black_dn).all() and (f.dn[71:] == told.black_dn).all()


def test_the_sky_of_large_pictures_is_measured_one_picture_at_a_time():
    """No tensor holds the pixels of all frames, however many there are."""
    sensor, rng = dataclasses.replace(SENSOR, read_noise_dn=6.0), np.random.default_rng(3)
    height, width, level_dn = 1100, 1000, 4.0
    noise = torch.from_numpy(rng.normal(scale=6.0, size=(height, width, 1)).astype(np.float32))
    frames = []
    for number in range(12):
        dn = (sensor.black_dn + level_dn + noise.roll(number * 7, 0)).round()
        dn[400:700, 300:600] += 900
        sent = torch.zeros(height, width, dtype=torch.bool)
        sent[350:750, 250:650] = True
        dn[~sent] = sensor.black_dn
        frames.append(TrainingFrame(dn, 1e-4, torch.eye(4), torch.eye(3), number))
    with LargestTensor() as largest:
        _, _, level = levelled(frames, sensor)
    assert largest.numbers <= 4 * height * width  # a pixel's place has three numbers
    assert (level.planes_dn[:, 0, 0] - level_dn).abs().max() < 0.25 * sensor.read_noise_dn


@pytest.mark.parametrize("fits", [True, False])
def test_blocks_of_few_frames_are_computed_with_at_once_and_all_learn_from_each_other(monkeypatch, fits):
    true = [(2.0 * i * (not fits), 0.5, 0.2) for i in range(40)]
    frames = seen(SENSOR, planes(true))
    _, _, together = levelled(frames, SENSOR)
    monkeypatch.setattr(sky_level, "BLOCKS_AT_ONCE", 1)  # 16 frames
    with LargestTensor() as largest:
        _, _, apart = levelled(frames, SENSOR)
    blocks = (SIZE_PX // 3) ** 2
    assert (
        largest.numbers <= 2 * 40 * blocks
    )  # mean and variance of each; three numbers of each were computed with
    torch.testing.assert_close(apart.planes_dn, together.planes_dn)
    torch.testing.assert_close(apart.sigma_dn, together.sigma_dn)


def test_what_a_clipped_reading_says_stays_true():
    """A reading at zero or at full scale is a bound on the light; so are the corrected ones, for no more than that."""
    frames = seen(DARK, planes([(4.0, 2.0, 0.0)] * 6))
    for f in frames:
        f.dn[0, :] = DARK.white_dn
    corrected, sensor, level = levelled(frames, DARK)
    assert sensor.black_dn == 0 and sensor.white_dn < DARK.white_dn - 5.5
    for before, after, plane in zip(frames, corrected, level.planes_dn, strict=True):
        off = field(plane, SIZE_PX, SIZE_PX)
        clipped = before.dn >= DARK.white_dn
        assert (after.dn[clipped] == sensor.white_dn).all()
        # full scale less what was taken off: the light of such a reading is at least that of the corrected one
        assert (after.dn <= DARK.white_dn - off + 1e-3)[clipped].all()
        assert (after.dn[before.dn == 0] == 0).all()
        between = (after.dn > 0) & (after.dn < sensor.white_dn)
        torch.testing.assert_close(after.dn[between], (before.dn - off)[between], atol=1e-4, rtol=0)


def test_black_that_is_stated_too_high_is_lowered():
    frames = seen(SENSOR, planes([(-8.0, 0, 0)] * 6))
    corrected, sensor, level = levelled(frames, SENSOR)
    assert sensor.black_dn == pytest.approx(SENSOR.black_dn - 8, abs=0.3)
    assert float(corrected[0].dn.min()) >= 0 and "-8.0" in str(level)


def test_a_pedestal_and_a_gradient_cost_a_training_nothing():
    """Of a scene whose training loses 5 dB where they are not measured."""
    frames, unseen = photographed(target(), 24), photographed(target(), 6, seed=9)
    rng, size_px = np.random.default_rng(0), frames[0].dn.shape[0]
    place = torch.linspace(-1, 1, size_px)[None, :, None]
    added = [
        dataclasses.replace(
            f, dn=(f.dn + 40 + 20 * math.sin(i) + 15 * rng.uniform() * place).round().clamp(max=4095)
        )
        for i, f in enumerate(frames)
    ]
    scores = []
    for given_frames in (frames, added):
        result = train(given_frames, SENSOR, preset("obbgs", QUICK | {"steps": 120}), seed=1)
        with torch.no_grad():
            radiance = render(result.gaussians, cameras_of(unseen)).radiance
        pairs = zip(radiance, unseen, strict=True)
        scores.append(
            np.mean(
                [
                    psnr_db(
                        SENSOR.expected_dn(r, f.exposure_time_s) / SENSOR.white_dn, f.dn / SENSOR.white_dn
                    )
                    for r, f in pairs
                ]
            )
        )
    assert scores[1] > scores[0] - 0.7


def test_stars_and_a_noisy_ball_do_not_move_the_level():
    frames = photographed(ball(30, 0.2, -2.0, 0.3), 12)
    rng = np.random.default_rng(2)
    for f in frames:
        rows, columns = rng.integers(0, f.dn.shape[0], (2, 30))
        f.dn[rows, columns] += 300
    assert levelled(frames, SENSOR)[2].fits


@given(st.integers(1, 30), st.integers(1, 30), st.floats(0.7, 1), st.integers(0, 2**31 - 1))
def test_pixels_that_were_not_sent_are_those_of_squares_of_nothing_but_black(height, width, share, seed):
    black = np.random.default_rng(seed).random((height, width)) < share
    dn = torch.from_numpy(np.where(black, SENSOR.black_dn, SENSOR.black_dn + 1)).float()[..., None]
    opened = grey_opening(black, size=5, mode="nearest")
    assert torch.equal(cut_pixels(SENSOR, dn), torch.from_numpy(opened))
