"""The frames that benchmarks make of rendered radiance are those of the sensor that they state."""

from pathlib import Path

import numpy as np
import pytest
import torch

from obbgs_core.losses import fit_figures
from tests.benchmarks import targets

SIZE_PX, VIEWS = 96, 9


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """A target of the benchmark's layout: every view a ramp from black to far beyond saturation."""
    ramp = np.linspace(0, 4, SIZE_PX, dtype=np.float16)
    radiance = np.broadcast_to(ramp[None, None, :, None], (VIEWS, SIZE_PX, SIZE_PX, 3))
    np.savez(
        tmp_path / "RAMP_400.npz",
        radiance=radiance,
        alpha=np.full((VIEWS, SIZE_PX, SIZE_PX), 255, np.uint8),
        world_to_camera=np.tile(np.eye(4), (VIEWS, 1, 1)),
        K=np.eye(3),
        cloud=np.zeros((1, 3), np.float32),
    )
    monkeypatch.setattr(targets, "FOLDER", tmp_path)
    return tmp_path


@pytest.mark.parametrize("sigma", [targets.PAPER_SIGMA, 0.1])
def test_chi2_of_the_true_radiance_is_1_at_every_exposure_of_a_benchmark(folder, sigma):
    target = targets.load("RAMP", SIZE_PX, sigma)
    radiance = torch.linspace(0, 4, SIZE_PX).half().float().view(1, 1, -1, 1).repeat(1, SIZE_PX, 1, 3)
    by_exposure: dict[float, list[float]] = {}
    for frame in [*target.training, *target.held_out]:
        exposure_s = torch.full((1, 1, 1, 1), frame.exposure_time_s)
        alpha = torch.ones(radiance.shape[:3])
        chi2, _ = fit_figures(radiance, alpha, exposure_s, frame.dn[None], target.sensor)
        by_exposure.setdefault(frame.exposure_time_s, []).append(chi2)
    assert set(by_exposure) == set(targets.BRACKET_S)
    for exposure_s, values in by_exposure.items():  # 20,000 to 60,000 readings each: deviations up to 0.01
        assert np.mean(values) == pytest.approx(1, abs=0.03), exposure_s


def test_half_of_the_readings_of_a_signal_at_full_scale_are_below_it(folder):
    target = targets.load("RAMP", SIZE_PX)
    gain = target.sensor.dn_per_radiance_s
    radiance = np.linspace(0, 4, SIZE_PX).astype(np.float16)
    shares = []
    for frame in target.training:
        signal = gain * frame.exposure_time_s * radiance
        column = int(np.argmin(np.abs(signal - 255)))
        if abs(signal[column] - 255) < 3:  # half a deviation of the noise
            shares.append((frame.dn[:, column] < 255).float().mean().item())
    assert len(shares) >= 2  # the longest exposures reach full scale
    assert 0.25 < np.mean(shares) < 0.75
