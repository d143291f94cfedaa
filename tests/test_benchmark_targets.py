"""The frames that benchmarks make of rendered radiance are those of the sensor that they state."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hil.sky.sensor import SensorModel
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
        chi2, *_ = fit_figures(radiance, alpha, exposure_s, frame.dn[None], target.sensor)
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


def test_another_sensor_reads_what_its_lens_leaves_and_a_method_that_knows_it_sees_noise_alone(folder):
    """A bright column is blurred; against the blurred truth chi² is 1, against the sharp one it is not."""
    with np.load(folder / "RAMP_400.npz") as arrays:
        content = dict(arrays)
    content["radiance"] = np.where(np.arange(SIZE_PX) == SIZE_PX // 2, 1, 0.3)[None, None, :, None] * np.ones(
        (VIEWS, SIZE_PX, SIZE_PX, 3), np.float16
    )
    np.savez(folder / "RAMP_400.npz", **content)
    sharp = targets.expose("RAMP", SIZE_PX)
    model = SensorModel(read_noise_e=12.0, psf_sigma_px=0.6)
    target = targets.exposed_by(sharp, model)
    assert target.sensor.white_dn == 4095 and target.views[0].frame.dn.shape == (SIZE_PX, SIZE_PX, 1)
    assert target.views[0].frame.psf_sigma_px == pytest.approx(np.hypot(0.6, 0.26))
    inner = (
        slice(8, -8),
        slice(8, -8),
    )  # the lens takes light from beyond the edges, where nothing was rendered

    def chi2(view: targets.View, radiance: torch.Tensor) -> float:
        exposure_s = torch.full((1, 1, 1, 1), view.frame.exposure_time_s)
        pair = (radiance[inner][None].contiguous(), torch.ones(1, SIZE_PX - 16, SIZE_PX - 16))
        return fit_figures(*pair, exposure_s, view.frame.dn[inner][None].contiguous(), target.sensor)[0]

    views = target.views[::3]  # the shortest exposure: nothing is clipped
    assert np.mean([chi2(view, view.radiance) for view in views]) == pytest.approx(1, abs=0.05)
    grey = [view.radiance.mean(dim=2, keepdim=True) for view in sharp.views[::3]]
    assert np.mean([chi2(view, light) for view, light in zip(views, grey, strict=True)]) > 2
