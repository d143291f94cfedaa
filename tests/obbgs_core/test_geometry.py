"""Boxes, hull, growth, distances and files of the model."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from obbgs_core.background import grown
from obbgs_core.model import obb, sh
from obbgs_core.model.rotations import multiply, quats_to_matrices
from obbgs_core.published.growth import grow, outliers
from obbgs_core.score.metrics import cloud_distances, even, surface_scores
from obbgs_core.sensor import Sensor
from obbgs_core.start import hull, initialisation
from obbgs_core.train.adam import Adam
from obbgs_core.train.growth import split_long_axis
from obbgs_core.train.parts import Change
from tests.scenes import LargestTensor, random_gaussians


@given(st.integers(0, 2**31), st.integers(4, 60))
def test_a_box_contains_its_points_and_is_tight_along_the_principal_axes(seed, count):
    rng = np.random.default_rng(seed)
    points = torch.tensor(
        rng.normal(size=(count, 3)) * [5, 2, 0.5] @ Rotation.random(rng=rng).as_matrix().T + 3
    )
    box = obb.fit(points)
    assert box.contains(points).all()
    torch.testing.assert_close(box.axes.T @ box.axes, torch.eye(3, dtype=torch.float64))
    _, expected = np.linalg.eigh(np.cov(points.numpy().T))
    np.testing.assert_allclose(np.abs((box.axes.numpy() * expected).sum(0)), 1, atol=1e-6)
    assert not box.contains(box.centre + 1.01 * box.axes[:, 2] * box.half_extents[2] + 1e-6)


def test_a_box_of_a_skewed_set_contains_its_points():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [10, 0, 0], [0, 1, 0], [0, 0, 0.5]])
    box = obb.fit(points)
    assert box.contains(points).all() and not torch.allclose(box.centre, points.mean(0), atol=1)


def test_the_worst_tile_is_found():
    error = torch.zeros(100, 120, 3)
    error[45:50, 85:90, 1] = 1
    assert obb.worst_tile(error) == (40, 80)


def test_gaussians_behind_a_tile_lie_in_its_frustum_and_not_behind_the_surface():
    means = torch.tensor([[0.0, 0, 5], [0, 0, 9], [2, 0, 5], [0, 0, -5]])
    means2d = torch.tensor([[60.0, 30], [60, 30], [100, 30], [60, 30]])
    depth = torch.full((60, 120), 5.0)
    chosen = obb.behind_tile(means, means2d, depth, torch.eye(4), (20, 40))
    assert chosen.tolist() == [True, False, False, False]


def test_the_radius_encloses_nearly_all_light_and_never_holds_the_light_of_all_views():
    K, pose, rng = torch.tensor([[90.0, 0, 50], [0, 90, 50], [0, 0, 1]]), torch.eye(4), torch.Generator()
    pose[2, 3] = 5.0
    masks = [torch.rand(100, 100, generator=rng.manual_seed(i)) < 0.5 for i in range(40)]
    with LargestTensor() as largest:
        found = hull.radius_m([hull.Silhouette(mask, mask, ~mask, pose, K) for mask in masks])
    rows, columns = torch.nonzero(torch.stack(masks), as_tuple=True)[1:]
    reach = torch.hypot((columns + 0.5 - 50) / 90, (rows + 0.5 - 50) / 90) * 5
    assert found == 1.05 * float(reach.sort().values[int(hull.INSIDE * len(reach)) - 1])
    assert largest.numbers <= 2 * 100 * 100  # the places of one view's pixels


def test_the_hull_of_a_ball_is_its_surface(monkeypatch):
    silhouettes, K = [], torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    rows, columns = torch.meshgrid(torch.arange(100) + 0.5, torch.arange(100) + 0.5, indexing="ij")
    radius_px = 100 * 1.0 / math.sqrt(5**2 - 1)  # the outline of a unit ball five metres away
    mask = (rows - 50) ** 2 + (columns - 50) ** 2 < radius_px**2
    for rotation in Rotation.random(40, rng=np.random.default_rng(0)).as_matrix():
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor(rotation, dtype=torch.float32)
        pose[2, 3] = 5.0
        silhouettes.append(hull.Silhouette(mask, mask, ~mask, pose, K))
    assert hull.radius_m(silhouettes) == pytest.approx(1.05 * radius_px / 100 * 5, rel=0.05)
    points, voxel_m = hull.hull_points(silhouettes, hull.radius_m(silhouettes))
    distance = points.norm(dim=1)
    # 40 outlines bound the ball from outside; a pixel is 5 cm, a voxel 0.8 cm; the vote lets corners stand out
    assert len(points) > 1000 and distance.min() > 0.9 and distance.median() < 1.08
    assert hull.coherence(silhouettes, points, voxel_m) > 0.99
    # noise in all views keeps most coarse voxels: they are not carved then, and the hull is the same
    rng = torch.Generator().manual_seed(0)
    specks = [torch.rand(100, 100, generator=rng) < 0.15 for _ in silhouettes]
    noisy = [dataclasses.replace(s, likely=s.likely | n) for s, n in zip(silhouettes, specks, strict=True)]
    found = []
    for worth in (0.5, 1.0):
        monkeypatch.setattr(hull, "WORTH", worth)
        found.append(hull.hull_points(noisy, hull.radius_m(noisy))[0])
    assert torch.equal(*found)
    lost = points[
        points[:, 0] < 0
    ]  # half a hull covers less of what the views show, but more than half of it
    assert 0.5 < hull.coherence(silhouettes, lost, voxel_m) < 0.95


def test_light_does_not_leak_into_the_dark_and_a_faint_face_is_found():
    sensor = Sensor(0.0, 255.0, 1e7, 1e9, 6.4)
    generator = np.random.default_rng(5)
    signal = np.zeros((120, 160, 3))
    signal[30:90, 20:60] = 180.0  # lit
    signal[30:90, 60:110] = 4.0  # in shadow: under one sigma of a pixel
    dn = torch.from_numpy(np.clip(np.round(signal + generator.normal(0, 6.4, signal.shape)), 0, 255)).float()
    seen = hull.silhouette(dn, sensor, torch.eye(4), torch.eye(3))
    assert seen.certain[30:90, 20:60].all()
    assert seen.likely[32:88, 20:108].float().mean() > 0.98  # most of the faint face
    assert seen.likely[30:90, :18].float().mean() < 0.2  # two pixels beside the lit face only noise is left
    assert not (seen.sky & seen.likely).any() and not seen.sky[32:88, 20:108].any()
    assert seen.sky[:, 130:].float().mean() > 0.9


@pytest.mark.parametrize(("faint_sigma", "most"), [(0.0, 1.0), (0.2, 0.05), (0.4, 0.001)])
def test_a_wide_face_far_below_the_noise_is_not_taken_for_sky(faint_sigma, most):
    sensor = Sensor(64.0, 4095.0, 1e7, 1e9, 6.0)
    generator = np.random.default_rng(2)
    signal = np.zeros((200, 200, 3))
    signal[40:160, 40:160] = (
        faint_sigma * 6 / math.sqrt(3)
    )  # the mean of three channels is told by sigmas of its own
    dn = torch.from_numpy(np.round(64 + signal + generator.normal(0, 6, signal.shape))).float()
    seen = hull.silhouette(dn, sensor, torch.eye(4), torch.eye(3))
    assert seen.sky[60:140, 60:140].float().mean() <= most
    assert seen.sky[:20].float().mean() > 0.9  # twenty pixels beside it
    assert seen.sky[36:40, 60:140].float().mean() > 0.1  # right beside it


def test_the_start_leaves_no_thin_part_out():
    rng = torch.Generator().manual_seed(0)
    plate = torch.rand(5000, 3, generator=rng) * torch.tensor([2, 2, 0.02])
    mast = torch.stack([torch.ones(15), torch.ones(15), torch.linspace(0.1, 0.8, 15)], dim=1)
    chosen = initialisation.spread(torch.cat([plate, mast]), 500, rng)
    assert len(chosen.unique()) == 500
    assert (chosen >= 5000).sum() >= 7  # at random 1.5 of the mast's points would be among them


@given(st.integers(2, 60), st.integers(1, 60), st.integers(0, 2**31 - 1))
def test_spread_points_are_as_far_apart_as_any_other_is_from_them(many, count, seed):
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(many, 3, generator=rng) + 5
    chosen = initialisation.spread(points, count, rng)
    assert len(chosen) == len(chosen.unique()) == min(many, count)
    if 1 < count < many:  # Gonzalez 1985: this is why no other choice covers all points with half the radius
        between, to_all = pdist(points[chosen].double()), cdist(points.double(), points[chosen].double())
        assert between.min() >= to_all.min(axis=1).max() * (1 - 1e-3)  # distances are taken in float32


def test_views_that_disagree_leave_no_hull():
    K, rng = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.random.default_rng(0)
    silhouettes = []
    for rotation in Rotation.random(20, rng=rng).as_matrix():
        pose = torch.eye(4)
        pose[:3, :3], pose[2, 3] = torch.tensor(rotation, dtype=torch.float32), 5.0
        mask = torch.zeros(100, 100, dtype=torch.bool)
        row, column = rng.integers(10, 80, 2)
        mask[row : row + 8, column : column + 8] = True
        silhouettes.append(hull.Silhouette(mask, mask, ~mask, pose, K))
    points, _ = hull.hull_points(silhouettes, 2.0)
    assert len(points) == 0


@given(st.integers(0, 2**31), st.integers(1, 24), st.sampled_from([0.0, 0.3]), st.floats(0.05, 1))
def test_points_that_cannot_agree_any_more_are_left_out_of_the_vote_without_changing_it(
    seed, views, reach_m, least
):
    rng, silhouettes = np.random.default_rng(seed), []
    K = torch.tensor([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]])
    for rotation in Rotation.random(views, rng=rng).as_matrix():
        pose = torch.eye(4)
        pose[:3, :3], pose[2, 3] = torch.tensor(rotation, dtype=torch.float32), 5.0
        mask = torch.from_numpy(rng.random((20, 20)) < rng.uniform(0.5, 1))
        silhouettes.append(hull.Silhouette(mask, mask, ~mask, pose, K))
    points = torch.from_numpy(rng.normal(size=(200, 3)) * 2).float()  # some lie beyond the picture
    whole = hull.agreement(silhouettes, points, reach_m)
    early = hull.agreement(silhouettes, points, reach_m, least)
    torch.testing.assert_close(early >= least, whole >= least)
    assert (early[whole >= least] == whole[whole >= least]).all()


@given(st.integers(0, 2**31), st.integers(1, 40), st.floats(0, 0.2))
def test_a_silhouette_grows_as_by_a_maximum_filter(seed, reach_px, share):
    mask = np.random.default_rng(seed).random((17, 23)) < share
    np.testing.assert_array_equal(
        grown(torch.from_numpy(mask), reach_px), maximum_filter(mask, 2 * reach_px + 1, mode="constant")
    )


def test_growth_clones_the_small_splits_the_large_and_carries_the_moments():
    gaussians = random_gaussians(10).trainable()
    with torch.no_grad():
        gaussians.log_scales[:] = -5
        gaussians.log_scales[3] = 0.0
    adam = Adam(gaussians)
    adam.first["means"][:] = torch.arange(10.0)[:, None]
    chosen = torch.zeros(10, dtype=torch.bool)
    chosen[[2, 3]] = True
    grown, unsplit = grow(gaussians, chosen, split_over_m=0.5, rng=torch.Generator().manual_seed(0))
    change = Change(grown, unsplit)
    adam.apply(change)
    assert unsplit.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert len(grown) == 12  # one clone added, one split into two
    torch.testing.assert_close(grown.means[9], gaussians.means[2])
    torch.testing.assert_close(grown.scales[10:], gaussians.scales[[3, 3]] / 1.6)
    assert adam.first["means"][:, 0].tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9, 0, 0, 0]
    fewer = change.then_only(torch.arange(12) != 5)
    assert fewer.kept is not None and fewer.kept.tolist() == [0, 1, 2, 4, 5, 7, 8, 9] and fewer.added == 3
    assert torch.equal(fewer.model.means, torch.cat([grown.means[:5], grown.means[6:]]))
    adam.apply(Change.only(grown, torch.arange(12) != 5, ""))
    assert adam.second["sh"].shape[0] == 11


@given(seed=st.integers(0, 2**32 - 1))
def test_two_along_the_longest_axis_have_the_mean_and_the_covariance_of_the_one(seed):
    """The moments of an even mixture of two normals: mean of the means, mean covariance plus that of the means."""
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(6, seed=seed % 1000).trainable()
    with torch.no_grad():
        gaussians.log_scales += torch.from_numpy(rng.normal(size=(6, 3))).float()
    growing = torch.tensor([False, True, False, True, True, False])
    grown, kept = split_long_axis(gaussians, growing)
    assert kept.tolist() == [0, 2, 5] and len(grown) == 9
    with torch.no_grad():
        torch.testing.assert_close(grown.means[:3], gaussians.means[kept])
        one, left, right = gaussians.select(growing), *(grown.select(torch.arange(i, i + 3)) for i in (3, 6))
        half = (left.means - right.means) / 2
        mixed = (left.covariances() + right.covariances()) / 2 + half[:, :, None] * half[:, None, :]
        torch.testing.assert_close((left.means + right.means) / 2, one.means, atol=1e-5, rtol=1e-4)
        size = one.scales.max() ** 2
        torch.testing.assert_close(mixed / size, one.covariances() / size, atol=1e-5, rtol=1e-3)
        assert (half.norm(dim=1) > 0.5 * one.scales.amax(dim=1)).all()
        torch.testing.assert_close(left.opacity_logits, one.opacity_logits)


def test_adam_matches_torch():
    ours, theirs = random_gaussians(5).trainable(), random_gaussians(5).trainable()
    adam = Adam(ours, eps=1e-8)
    optimizer = torch.optim.Adam([theirs.means, theirs.sh], lr=0.01, eps=1e-8)
    for _ in range(5):
        for gaussians in (ours, theirs):
            ((gaussians.means**3).sum() + (gaussians.sh - 2).square().sum()).backward()
        adam.step(ours, dict.fromkeys(ours.tensors(), 0.01))
        optimizer.step()
        optimizer.zero_grad()
    # eps is added before the bias correction here, after it there
    torch.testing.assert_close(ours.means, theirs.means, atol=1e-5, rtol=1e-5)


def test_the_filter_removes_what_is_far_or_faint_and_fairly_far():
    gaussians = random_gaussians(300)
    gaussians.opacity_logits[:] = 2.0
    gaussians.means[0] = torch.tensor([30.0, 0, 0])
    gaussians.means[1] = torch.tensor([4.5, 0, 0])
    gaussians.opacity_logits[1] = -4.0
    assert torch.nonzero(outliers(gaussians))[:, 0].tolist() == [0, 1]


@given(st.integers(0, 1000))
def test_cloud_distances_match_brute_force(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.random((40, 3)), rng.random((60, 3))
    table = cdist(a, b)
    ours = cloud_distances(a, b)
    assert ours["chamfer"] == pytest.approx((table.min(1).mean() + table.min(0).mean()) / 2)
    assert ours["hausdorff"] == pytest.approx((table.min(1).max() + table.min(0).max()) / 2)
    assert ours["completeness"] == pytest.approx(100 * (table.min(0) < 0.01).mean())


def test_f_is_of_the_share_within_a_radius_both_ways_however_dense_the_points_are():
    side = np.arange(0.0025, 1, 0.005)  # one point in the middle of each cell
    truth = np.stack([*np.meshgrid(side, side), np.zeros((len(side), len(side)))], axis=-1).reshape(-1, 3)
    half = truth[truth[:, 0] < 0.5] + [0, 0, 0.015]
    crowded = np.concatenate([half, *[half[half[:, 1] < 0.2] + 1e-4 * i for i in range(5)]])
    for points in (half, crowded):
        found = surface_scores(points, truth)
        assert found["precision_01"] == found["recall_01"] == found["f_01"] == 0
        assert found["precision_02"] == 100
        assert found["recall_02"] == pytest.approx(
            50, abs=2
        )  # a strip of 0.013 beside the half is near it too
        assert found["f_02"] == pytest.approx(200 * found["recall_02"] / (100 + found["recall_02"]))


@given(st.integers(0, 1000))
def test_scores_of_surfaces_match_brute_force(seed):
    rng = np.random.default_rng(seed)
    a, b = (even(0.1 * rng.random((count, 3))) for count in (40, 60))
    table, found = cdist(a, b), surface_scores(a, b)
    assert found["chamfer"] == pytest.approx((table.min(1).mean() + table.min(0).mean()) / 2)
    assert found["precision_02"] == pytest.approx(100 * (table.min(1) < 0.02).mean())
    assert found["recall_02"] == pytest.approx(100 * (table.min(0) < 0.02).mean())


@given(st.integers(0, 1000))
def test_even_points_are_some_of_all_with_one_in_each_cell_that_had_any(seed):
    points = np.random.default_rng(seed).normal(0, 0.01, (200, 3))
    kept, cells = even(points), {tuple(cell) for cell in np.floor(points / 0.005)}
    assert {tuple(cell) for cell in np.floor(kept / 0.005)} == cells and len(kept) == len(cells)
    assert {tuple(point) for point in kept} <= {tuple(point) for point in points}


def test_an_empty_cloud_is_refused():
    with pytest.raises(ValueError, match="cloud must be finite points"):
        cloud_distances(np.zeros((0, 3)), np.zeros((1, 3)))


def test_radiance_is_never_negative_and_starts_where_it_was_asked():
    wanted = torch.tensor([[0.0005], [0.02], [0.7], [40.0]])
    coefficients = sh.from_radiance(wanted)[:, None]
    torch.testing.assert_close(sh.radiance(coefficients, torch.zeros(4, 3)), wanted, rtol=1e-3, atol=1e-6)
    assert (sh.radiance(torch.full((1, 1, 1), -50.0), torch.zeros(1, 3)) >= 0).all()


def test_spherical_harmonics_are_orthonormal():
    directions = torch.nn.functional.normalize(
        torch.randn(400_000, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    basis = sh.sh_basis(directions, 16)
    gram = 4 * math.pi * basis.T @ basis / len(directions)
    torch.testing.assert_close(gram, torch.eye(16), rtol=0, atol=0.03)  # Monte Carlo: 0.002 times a few


@given(st.integers(0, 10_000))
def test_rotations_match_scipy(seed):
    rng = np.random.default_rng(seed)
    a, b = Rotation.random(rng=rng), Rotation.random(rng=rng)
    qa, qb = (torch.tensor(r.as_quat(scalar_first=True)) for r in (a, b))
    np.testing.assert_allclose(quats_to_matrices(3 * qa).numpy(), a.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(quats_to_matrices(multiply(qa, qb)).numpy(), (a * b).as_matrix(), atol=1e-12)
