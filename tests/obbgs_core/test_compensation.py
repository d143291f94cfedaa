"""Exposure compensation: maps of each frame's colours are learnt as by the authors, and used for other frames."""

import numpy as np
import pytest
import torch

from obbgs_core.published.compensation import Compensation, mapped, nearest
from obbgs_core.sensor import Sensor
from obbgs_core.train.result import Exposing

SENSOR = Sensor(black_dn=10, white_dn=255, dn_per_radiance_s=2.45e6, electrons_per_dn=1e9, read_noise_dn=2)


def test_colours_are_mapped_by_a_matrix_and_an_offset_in_full_scales():
    rng = np.random.default_rng(0)
    radiance, maps = rng.random((2, 4, 5, 3)), rng.random((2, 3, 4))
    full_scale = np.array([2.0, 4.0])
    expected = np.stack(
        [r @ m[:, :3].T + m[:, 3] * f for r, m, f in zip(radiance, maps, full_scale, strict=True)]
    )
    ours = mapped(
        torch.from_numpy(radiance), torch.from_numpy(maps), torch.from_numpy(full_scale).view(2, 1, 1, 1)
    )
    np.testing.assert_allclose(ours.numpy(), expected, rtol=1e-12)


def test_maps_start_as_identities_and_move_as_by_torchs_adam():
    compensation = Compensation(5, 3)
    torch.testing.assert_close(compensation.value.detach(), torch.eye(3, 4).expand(5, 3, 4))
    oracle = compensation.value.detach().clone().requires_grad_()
    adam = torch.optim.Adam([oracle], lr=0.01)
    for step in range(12):
        share = step / 12
        adam.param_groups[0]["lr"] = 0.01 * 0.1**share  # 0.01 to 0.001, as published
        gradient = torch.randn(5, 3, 4, generator=torch.Generator().manual_seed(step))
        gradient[step % 4] = 0  # frames that the step does not show keep their momentum
        compensation.value.grad, oracle.grad = gradient.clone(), gradient
        compensation.step(share)
        adam.step()
    torch.testing.assert_close(compensation.value.detach(), oracle.detach(), rtol=1e-4, atol=1e-6)


def test_gains_of_exposures_are_found():
    """Frames of one scene with gains of 0.5, 1 and 2: the maps alone explain them."""
    scene = torch.rand(1, 6, 6, 1, generator=torch.Generator().manual_seed(1))
    gains, compensation = [0.5, 1.0, 2.0, 0.5], Compensation(4, 1)
    for step in range(1500):
        seen = compensation.applied(scene.expand(4, 6, 6, 1), [0, 1, 2, 3], torch.ones(4, 1, 1, 1))
        (seen - scene * torch.tensor(gains).view(4, 1, 1, 1)).square().mean().backward()
        compensation.step(step / 1500)
    maps = compensation.by_exposure([1e-3, 2e-3, 4e-3, 1e-3])
    assert list(maps) == [1e-3, 2e-3, 4e-3]
    for (exposure_s, found), gain in zip(maps.items(), (0.5, 1.0, 2.0), strict=True):
        assert found[0].tolist() == pytest.approx([gain, 0.0], abs=0.02), exposure_s


def test_a_held_out_picture_takes_the_maps_of_the_nearest_exposure_time():
    maps = {1e-3: torch.tensor([[1.0, 0.0]]), 4e-3: torch.tensor([[2.0, 0.1]])}
    assert nearest(maps, 1.9e-3) is maps[1e-3] and nearest(maps, 2.1e-3) is maps[4e-3]
    radiance = torch.full((2, 2, 1), 0.02)  # at 2 ms 98 of 245 DN: 0.4 of full scale
    image = Exposing(2e-3, maps).image(radiance, SENSOR, 4e-3)
    torch.testing.assert_close(image, torch.full((2, 2, 1), (10 + 245 * (2 * 0.4 + 0.1)) / 255))
    plain = Exposing(None).image(radiance, SENSOR, 1e-3)
    torch.testing.assert_close(plain, torch.full((2, 2, 1), (10 + 245 * 0.2) / 255))
    assert (Exposing(2e-3).image(radiance * 100, SENSOR, 1e-3) == 1).all()
