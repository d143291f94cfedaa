"""Surface points of models whose surface is known."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.score.surface import depth_map, surface_points

SIZE = 96
DISTANCE = 4.0
PIXEL_M = (4.0 - 1.0) / (1.6 * SIZE)  # on the near side of the sphere


def evenly_on_a_sphere(count: int) -> torch.Tensor:
    i = torch.arange(count, dtype=torch.float64)
    z, angle = 1 - (2 * i + 1) / count, math.pi * (1 + math.sqrt(5)) * i
    reach = (1 - z * z).sqrt()
    return torch.stack([reach * angle.cos(), reach * angle.sin(), z], dim=1)


def discs(
    centres: torch.Tensor, normals: torch.Tensor, radius: float, opacity_logit: float = 3.0
) -> Gaussians:
    """Return discs 0.0002 m thick whose third axis is the normal."""
    n = len(centres)
    # half-way rotation from z to the normal, as a quaternion
    quats = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], torch.zeros(n)], dim=1)
    log_scales = torch.tensor([radius, radius, 0.0002]).log().expand(n, 3).contiguous()
    logits, colours = torch.full((n,), opacity_logit), torch.ones(n, 1, 1)
    return Gaussians(centres.float(), quats.float(), log_scales, logits, colours)


def sphere(count: int = 1500) -> Gaussians:
    points = evenly_on_a_sphere(count)
    return discs(points, points, radius=0.055)


def cameras_around(count: int) -> Cameras:
    poses = []
    for centre in evenly_on_a_sphere(count):
        z = -centre
        x = torch.nn.functional.normalize(
            torch.linalg.cross(z, torch.tensor([0.1, 0.2, 0.97]).double()), dim=0
        )
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
        pose[2, 3] = DISTANCE
        poses.append(pose)
    focal = 1.6 * SIZE
    K = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    return Cameras(torch.stack(poses).float(), K.expand(count, 3, 3), SIZE, SIZE)


def thin_struts() -> tuple[Gaussians, np.ndarray]:
    """Return three struts of faint small Gaussians that scatter by half a pixel, and their axes as points [600, 3]."""
    along = torch.linspace(-0.8, 0.8, 200)[:, None]
    axes = torch.nn.functional.normalize(
        torch.tensor([[1.0, -0.6, 0.35], [1, 0, 0.35], [1, 0.6, 0.35]]), dim=1
    )
    shifts = torch.tensor([[0.0, 0.0, -0.25], [0, 0, 0], [0, 0, 0.25]])
    lines = torch.cat([along * axis + shift for axis, shift in zip(axes, shifts, strict=True)])
    scatter = 0.5 * PIXEL_M * torch.randn(lines.shape, generator=torch.Generator().manual_seed(0))
    struts = discs(lines + scatter, torch.tensor([[0.0, 0.0, 1.0]]).expand(600, 3), 1.0, opacity_logit=-2.0)
    struts.log_scales[:] = math.log(0.05 * PIXEL_M)
    return struts, lines.numpy()


def test_struts_thinner_than_a_pixel_have_points_along_all_of_them():
    struts, lines = thin_struts()
    points, _ = surface_points(struts, cameras_around(20), 5000)
    assert (KDTree(points.numpy()).query(lines)[0] < PIXEL_M).mean() > 0.9
    assert KDTree(lines).query(points.numpy())[0].max() < 5 * PIXEL_M


def test_a_sphere_of_discs_gives_the_sphere_evenly():
    points, normals = surface_points(sphere(), cameras_around(20), 20_000)
    assert 19_800 < len(points) <= 20_000 and points.shape == normals.shape == (len(points), 3)
    radii = points.norm(dim=1, keepdim=True)
    disc_stands_off_m = (2 * 0.055) ** 2 / 2  # of the sphere that it touches, at two sigma: rims count too
    assert (radii - 1).abs().mean() < disc_stands_off_m and (radii - 1).abs().max() < 0.05
    angles = torch.rad2deg(torch.acos((normals * points / radii).sum(dim=1).clamp(-1, 1)))
    assert angles.mean() < 2 and angles.max() < 20
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(points)))
    cells = KDTree(evenly_on_a_sphere(150).numpy())
    counts = np.bincount(cells.query((points / radii).numpy())[1], minlength=150)
    assert counts.std() < 0.1 * counts.mean() and counts.min() > 0.75 * counts.mean()
    gaps, _ = KDTree(points.numpy()).query(evenly_on_a_sphere(5000).numpy())
    at_random = torch.nn.functional.normalize(
        torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0))
    )
    gaps_at_random, _ = KDTree(at_random.numpy()).query(evenly_on_a_sphere(5000).numpy())
    assert gaps.max() < 0.75 * gaps_at_random.max()  # 0.026 and 0.041 m; a pixel is 0.02 m wide


def test_a_solid_of_round_gaussians_ends_a_deviation_before_their_centres():
    discs_ = sphere()
    blobs = Gaussians(
        **{**discs_.tensors(), "log_scales": torch.full_like(discs_.log_scales, math.log(0.055))}
    )
    points, _ = surface_points(blobs, cameras_around(20), 5000)
    radii = points.norm(dim=1)
    assert radii.median() == pytest.approx(1.055, abs=0.02)


def test_depth_follows_a_tilted_disc_and_not_its_centre():
    tilt = math.radians(50)
    normal = torch.tensor([[math.sin(tilt), 0.0, -math.cos(tilt)]])
    pose = torch.eye(4)[None]
    K = torch.tensor([[[100.0, 0, 48], [0, 100, 48], [0, 0, 1]]])
    disc = discs(torch.tensor([[0.0, 0.0, 2.0]]), normal, radius=0.3)
    depth, slope = depth_map(disc, Cameras(pose, K, SIZE, SIZE))
    rows, columns = torch.nonzero(depth.isfinite(), as_tuple=True)
    assert len(rows) > 100
    across = (columns + 0.5 - 48) / 100
    true_m = 2 / (1 - across * math.tan(tilt))  # where the ray (across, ., 1) meets the plane
    width_px = (columns + 0.5 - 48).abs()
    second_order = 2 * (width_px / 100 * math.tan(tilt)) ** 2 + 1e-3  # the depth is linear in the image
    assert ((depth[rows, columns] - true_m).abs() < 2 * second_order).all()
    torch.testing.assert_close(
        slope[rows, columns].mean(dim=0), torch.tensor([2 * math.tan(tilt) / 100, 0.0]), rtol=0.02, atol=1e-4
    )


@pytest.mark.parametrize("copies", [1, 2, 3, 5])
def test_copies_make_the_depth_that_of_the_layer_where_a_power_of_the_transmittance_is_one_half(copies):
    """Layers of wide discs, each lets 0.85 of the light through."""
    layers, through = 8, 0.85
    heights = torch.arange(layers).double() * 0.1
    centres = torch.stack([torch.zeros(layers), torch.zeros(layers), 2 + heights], dim=1)
    facing = torch.tensor([[0.0, 0.0, 1.0]]).expand(layers, 3)
    stack = discs(centres, facing, radius=50.0, opacity_logit=math.log((1 - through) / through))
    K = torch.tensor([[[100.0, 0, 16], [0, 100, 16], [0, 0, 1]]])
    depth, _ = depth_map(stack, Cameras(torch.eye(4)[None], K, 32, 32), copies)
    crossed = math.ceil(
        math.log(0.5) / copies / math.log(through)
    )  # layers until through^n <= 0.5^(1/copies)
    assert depth[16, 16] == pytest.approx(2 + 0.1 * (crossed - 1), abs=1e-3)


def test_no_point_lies_between_two_plates_one_behind_the_other():
    grid = torch.linspace(-1, 1, 30)
    x, y = (t.flatten() for t in torch.meshgrid(grid, grid, indexing="ij"))
    back = torch.stack([x, y, torch.full_like(x, -0.5)], dim=1)
    front = torch.stack([0.3 * x, 0.3 * y, torch.full_like(x, 0.5)], dim=1)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    plates = Gaussians.concatenate(
        [discs(back, up.expand(900, 3), 0.06), discs(front, up.expand(900, 3), 0.02)]
    )
    points, _ = surface_points(plates, cameras_around(20), 5000)
    heights = points[:, 2]
    off_m = torch.minimum((heights + 0.5).abs(), (heights - 0.5).abs())
    assert off_m.max() < 0.05
    on_front = float((heights > 0).float().mean())
    assert (
        abs(on_front - 0.3**2 / (1 + 0.3**2)) < 0.03
    )  # its share of the area, both plates seen from both sides


def test_the_seed_decides_and_an_empty_sky_has_no_surface():
    cameras = cameras_around(4)
    first, again, other = (surface_points(sphere(), cameras, 500, seed)[0] for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)
    faint = sphere(100)
    faint.opacity_logits[:] = -5.0
    for gaussians in (faint, faint.select(torch.tensor([], dtype=torch.long))):
        points, normals = surface_points(gaussians, cameras, 500)
        assert points.shape == normals.shape == (0, 3)
    with pytest.raises(ValueError, match="count"):
        surface_points(faint, cameras, 0)


def test_black_gaussians_in_empty_space_are_no_surface():
    """Nothing in any picture says that they are there."""
    bright = sphere()
    black = Gaussians(
        **{**bright.tensors(), "means": bright.means * 1.5, "sh": torch.full_like(bright.sh, -10.0)}
    )
    with_shell = Gaussians.concatenate([bright, black])
    points, _ = surface_points(with_shell, cameras_around(20), 2000)
    alone, _ = surface_points(bright, cameras_around(20), 2000)
    torch.testing.assert_close(points, alone)


@pytest.mark.parametrize(("behind_px", "at_the_lit_side"), [(1.5, True), (3.0, True), (8.0, False)])
def test_the_dark_side_of_a_thin_plate_lies_where_the_lit_side_shows_it_to_be(behind_px, at_the_lit_side):
    """Dark discs a little behind a lit plate hide it from behind, as they would at any other distance."""
    grid = torch.linspace(-1, 1, 40)
    x, y = (t.flatten() for t in torch.meshgrid(grid, grid, indexing="ij"))
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(1600, 3)
    lit, dark = (
        discs(torch.stack([x, y, torch.full_like(x, z)], dim=1), up, 0.04)
        for z in (0.0, -behind_px * PIXEL_M)
    )
    dark.sh[:] = -1.5
    points, _ = surface_points(Gaussians.concatenate([lit, dark]), cameras_around(20), 5000)
    off_px = points[:, 2].abs() / PIXEL_M
    lit_share = (off_px < 0.5).float().mean()  # without that step 0.44
    assert lit_share > 0.65 if at_the_lit_side else lit_share < 0.6


@pytest.mark.parametrize(("half_length_m", "is_sure"), [(0.9, False), (0.2, True)])
def test_what_less_than_a_tenth_of_the_views_see_is_left_out(half_length_m, is_sure):
    """The floor half-way down a tube: few views show it, and where it is can hardly be told."""
    angle, height = torch.meshgrid(
        torch.arange(48) * 2 * math.pi / 48, torch.linspace(-1, 1, 40), indexing="ij"
    )
    outward = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1).reshape(-1, 3)
    wall = 0.3 * outward + torch.tensor([0.0, 0.0, half_length_m]) * height.reshape(-1, 1)
    grid = torch.linspace(-0.2, 0.2, 11)
    floor = torch.cartesian_prod(grid, grid, torch.zeros(1))
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(floor), 3)
    tube = Gaussians.concatenate([discs(wall, outward, 0.04), discs(floor, up, 0.03)])
    points, _ = surface_points(tube, cameras_around(120), 20_000)
    on_floor = (points[:, :2].norm(dim=1) < 0.2) & (points[:, 2].abs() < 0.05)
    assert (int(on_floor.sum()) > 100) == is_sure
