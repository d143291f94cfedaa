"""The prior for smooth surfaces: who the neighbours are, what their normals cost, and that edges outlast it."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.highlights import shortest_axes
from obbgs_core.train.objective import Neighbours, normals_apart
from tests.scenes import random_gaussians


def about_x(degrees: list[float]) -> Rotation:
    return Rotation.from_rotvec(np.outer(np.radians(degrees), [1.0, 0, 0]))


def leaning(degrees: list[float]) -> Gaussians:
    """Return flat Gaussians whose normals lie in one plane, at these angles from z, in double precision."""
    turned = about_x(degrees).as_quat(scalar_first=True)
    gaussians = random_gaussians(len(degrees))
    flat = torch.tensor([0.0, 0.0, -3.0]).expand(len(degrees), 3)
    return dataclasses.replace(gaussians, quats=torch.from_numpy(turned), log_scales=flat.clone())


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 40), st.integers(0, 10_000))
def test_neighbours_are_those_whose_centres_are_nearest(count, seed):
    gaussians = random_gaussians(count, seed=seed)
    nearest = Neighbours().of(gaussians, 0)
    apart = torch.cdist(gaussians.means, gaussians.means).fill_diagonal_(torch.inf)
    assert nearest.shape == (count, min(8, count - 1))
    assert (nearest != torch.arange(count)[:, None]).all()
    expected = apart.sort(dim=1).values[:, : nearest.shape[1]]
    torch.testing.assert_close(apart.gather(1, nearest), expected)


def test_they_are_searched_again_after_some_steps_and_when_the_number_changes():
    gaussians, neighbours = random_gaussians(12), Neighbours()
    first = neighbours.of(gaussians, 3)
    moved = dataclasses.replace(gaussians, means=gaussians.means.flip(0))
    assert torch.equal(neighbours.of(moved, 19), first)
    assert torch.equal(neighbours.of(moved, 20), Neighbours().of(moved, 0))
    assert not torch.equal(neighbours.of(moved, 21), first)
    assert len(neighbours.of(random_gaussians(11), 22)) == 11


@pytest.mark.parametrize("count", [1, 2])
def test_a_model_of_hardly_any_gaussians_has_a_finite_prior(count):
    gaussians = random_gaussians(count)
    assert torch.isfinite(normals_apart(gaussians, Neighbours().of(gaussians, 0)))


def test_a_centre_that_is_not_finite_stops_no_search():
    """Such a Gaussian is removed after the step, and counted."""
    gaussians = random_gaussians(20)
    gaussians.means[3, 1] = torch.nan
    assert Neighbours().of(gaussians, 0).shape == (20, 8)


@pytest.mark.parametrize("degrees", [0.0, 3.0, 8.0, 45.0, 90.0, 172.0, 180.0])
def test_two_normals_cost_what_their_angle_says_whatever_their_signs(degrees):
    pair = leaning([10.0, 10.0 + degrees])
    squared = np.sin(np.radians(degrees)) ** 2
    cost = normals_apart(pair, torch.tensor([[1], [0]]))
    assert cost.item() == pytest.approx(squared / (squared + 0.02), abs=1e-5)


def test_the_pull_is_strongest_within_the_unevenness_of_a_face_and_weak_at_an_edge():
    def pull(degrees: float) -> float:
        pair = leaning([0.0, degrees])
        pair.quats.requires_grad_()
        normals_apart(pair, torch.tensor([[1], [0]])).backward()
        assert pair.quats.grad is not None
        return pair.quats.grad.norm().item()

    assert pull(45) < 0.1 * pull(5) and pull(85) < 0.02 * pull(5)


def test_uneven_faces_become_even_and_the_edge_between_them_stays():
    """Two square faces at a right angle, 200 Gaussians each, whose normals scatter by 4 degrees about each axis."""
    random, count = np.random.default_rng(5), 200
    places = random.uniform(0, 1, (2 * count, 3))
    places[:count, 2], places[count:, 1] = 0, 0  # normals z and y
    faces = about_x([0.0] * count + [90.0] * count)
    uneven = faces * Rotation.from_rotvec(np.radians(4) * random.standard_normal((2 * count, 3)))
    gaussians = leaning([0.0] * (2 * count))
    gaussians.means[:] = torch.from_numpy(places)
    gaussians.quats[:] = torch.from_numpy(uneven.as_quat(scalar_first=True))

    def lean_deg() -> np.ndarray:
        true = torch.tensor([[0.0, 0, 1], [0.0, 1, 0]]).repeat_interleave(count, dim=0)
        cosine = (shortest_axes(gaussians).detach() * true).sum(dim=1).abs().clamp(max=1)
        return np.degrees(np.arccos(cosine.numpy())).reshape(2, count)

    before, nearest = lean_deg(), Neighbours().of(gaussians, 0)
    gaussians.quats.requires_grad_()
    optimizer = torch.optim.Adam([gaussians.quats], lr=2e-3)
    for _ in range(100):
        optimizer.zero_grad()
        normals_apart(gaussians, nearest).backward()
        optimizer.step()
    after = lean_deg()
    assert np.all(np.median(after, axis=1) < 0.5 * np.median(before, axis=1))
    assert after.max() < 45  # nothing went over to the other face
