"""The prior that draws the Gaussians of a face into one plane."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.train.planarity import NEIGHBOURS, ROUNDED, Faces, faces, unevenness

SPACING_M = 0.05


def sheet(noise_m: float, radiance: float = 1.0, height_m: float = 0.0, seed: int = 0) -> Gaussians:
    """Return 20 x 20 opaque discs that face z, each off their plane by noise of that deviation."""
    grid = torch.arange(20) * SPACING_M
    x, y = (t.flatten() for t in torch.meshgrid(grid, grid, indexing="ij"))
    rng = torch.Generator().manual_seed(seed)
    z = height_m + noise_m * torch.randn(len(x), generator=rng)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(x), 1)
    log_scales = torch.tensor([[0.02, 0.03, 0.001]]).log().repeat(len(x), 1)
    light = torch.full((len(x), 1, 1), radiance)
    return Gaussians(torch.stack([x, y, z], dim=1), quats, log_scales, torch.full((len(x),), 2.0), light)


def settled(gaussians: Gaussians, radius_m: float = 1.0, steps: int = 200) -> torch.Tensor:
    """Return where the means end if nothing but the prior moves them."""
    means = gaussians.means.clone().requires_grad_()
    adam = torch.optim.Adam([means], lr=5e-4)
    found = faces(gaussians, radius_m)
    for step in range(steps):
        if step % 50 == 0:
            found = faces(dataclasses.replace(gaussians, means=means.detach()), radius_m)
        adam.zero_grad()
        unevenness(means, found, radius_m).backward()
        adam.step()
    return means.detach()


def test_unevenness_is_the_pseudo_huber_distance_from_the_planes_of_all_neighbours():
    one = sheet(0.01)
    means = one.means.numpy().astype(np.float64)
    apart = np.linalg.norm(means[:, None] - means[None], axis=2)
    nearest = np.argsort(apart, axis=1)[:, 1 : NEIGHBOURS + 1]
    heights = (means[nearest, 2] - means[:, None, 2]) / 2.0
    expected = np.where(np.abs(heights) < 0.05, np.sqrt(heights**2 + ROUNDED**2) - ROUNDED, 0).mean()
    assert float(unevenness(one.means, faces(one, 2.0), 2.0)) == pytest.approx(expected, rel=1e-4)


def test_a_noisy_face_becomes_even_and_stays_where_it_is():
    after = settled(sheet(0.008))
    assert after[:, 2].std() < 0.25 * 0.008
    assert abs(float(after[:, 2].mean())) < 0.001


def test_the_two_sides_of_a_thin_plate_stay_apart():
    front, back = sheet(0.001, 1.0, 0.02, seed=1), sheet(0.001, 0.2, 0.0, seed=2)
    plate = Gaussians.concatenate([front, back])
    after = settled(plate)
    assert after[:400, 2].mean() - after[400:, 2].mean() == pytest.approx(0.02, abs=0.002)
    assert not (faces(plate, 1.0).same[:400] * (faces(plate, 1.0).neighbours[:400] >= 400)).any()


def test_a_bowl_is_not_filled():
    bowl = sheet(0.003)
    centred = bowl.means[:, :2] - bowl.means[:, :2].mean(dim=0)
    bowl.means[:, 2] += 0.8 * centred.square().sum(dim=1)
    normals = torch.cat([-1.6 * centred, torch.ones(len(centred), 1)], dim=1).numpy()
    turns = Rotation.concatenate([Rotation.align_vectors([n], [[0, 0, 1]])[0] for n in normals])
    bowl.quats[:] = torch.from_numpy(turns.as_quat(scalar_first=True)).float()
    after = settled(bowl)
    deep = centred.norm(dim=1) < 0.15
    wanted = 0.8 * centred[deep].square().sum(dim=1).mean()
    assert after[deep, 2].mean() == pytest.approx(
        float(wanted), abs=0.003
    )  # its rim is 0.18 higher at the sides


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.1, 10))
def test_turning_moving_and_scaling_a_model_changes_nothing(seed, scale):
    one = sheet(0.01)
    turn = Rotation.random(rng=np.random.default_rng(seed))
    means = torch.from_numpy(turn.apply(one.means.numpy())).float() * scale + torch.tensor([1.0, -2.0, 0.5])
    quats = torch.from_numpy((turn * Rotation.identity(len(means))).as_quat(scalar_first=True)).float()
    other = dataclasses.replace(one, means=means, quats=quats)
    here, there = faces(one, 1.0), faces(other, scale)
    assert float(unevenness(means, there, scale)) == pytest.approx(
        float(unevenness(one.means, here, 1.0)), rel=0.01
    )


def test_a_mean_that_is_not_finite_does_not_spread():
    one = sheet(0.01)
    one.means[7] = torch.nan
    means = one.means.clone().requires_grad_()
    unevenness(means, faces(one, 1.0), 1.0).backward()
    assert means.grad is not None and means.grad.isfinite().all() and means.grad.abs().sum() > 0


def test_a_single_gaussian_is_even():
    one = sheet(0.01).select(torch.tensor([0]))
    found = faces(one, 1.0)
    assert isinstance(found, Faces) and float(unevenness(one.means, found, 1.0)) == 0
