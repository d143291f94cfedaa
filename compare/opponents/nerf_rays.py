"""Rays through the unit cube: where they are sampled, which cells are empty, and how samples make a pixel's colour."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras

GRID_CELLS = 64  # of the occupancy grid along each axis
GRID_DECAY = 0.95  # of a cell's remembered density at each update, as published
SOLID_ALPHA = 0.01  # a cell that absorbs less in one step counts as empty, as published
FAINTEST_TRANSMITTANCE = 1e-4  # samples behind this much matter are left out, as published


@dataclass(frozen=True)
class Rays:
    """Rays in the unit cube's coordinates: origins [R, 3] in sides of the cube, unit directions [R, 3] (body frame)."""

    origins: Tensor
    directions: Tensor


@dataclass(frozen=True)
class Samples:
    """Samples of some rays, those of one ray together, nearest first.

    ray: [M] index of the ray. distance: [M] from its origin, in sides of the cube. positions: [M, 3] in 0..1.
    """

    ray: Tensor
    distance: Tensor
    positions: Tensor

    def select(self, chosen: Tensor) -> "Samples":
        return Samples(self.ray[chosen], self.distance[chosen], self.positions[chosen])


def on_device(cameras: Cameras, device: torch.device) -> Cameras:
    """Return cameras for `rays_of` on a device."""
    pose, K = cameras.world_to_camera.to(device), cameras.K.to(device)
    return dataclasses.replace(cameras, world_to_camera=pose, K=K)


def rays_of(cameras: Cameras, camera: Tensor, row: Tensor, column: Tensor, radius_m: float) -> Rays:
    """Return the rays through the centres of pixels, in the cube that reaches `radius_m` from the body's origin.

    Args:
        camera, row, column: [R] integers.
    """
    pose, K = cameras.world_to_camera[camera], cameras.K[camera]
    x = (column + 0.5 - K[:, 0, 2]) / K[:, 0, 0]
    y = (row + 0.5 - K[:, 1, 2]) / K[:, 1, 1]
    ray = torch.stack([x, y, torch.ones_like(x)], dim=1)
    directions = (pose[:, :3, :3].transpose(1, 2) @ ray[..., None])[..., 0]
    origins = cameras.centres[camera] / (2 * radius_m) + 0.5
    return Rays(origins, directions / directions.norm(dim=1, keepdim=True))


class Occupancy:
    """A grid of the densities seen lately, [GRID_CELLS] * 3, and which of its cells are worth sampling.

    Source: Müller et al., Instant Neural Graphics Primitives with a Multiresolution Hash Encoding, 2022, appendix C.
    """

    def __init__(self, device: torch.device) -> None:
        self.density = torch.zeros(GRID_CELLS**3, device=device)
        self.occupied = torch.ones(GRID_CELLS**3, dtype=torch.bool, device=device)

    def update(
        self,
        density: Callable[[Tensor], Tensor],
        step_length: float,
        generator: torch.Generator,
        everywhere: bool,
    ) -> None:
        """Take the density at a random place of all cells, or of a quarter of them and as many occupied ones."""
        device = generator.device
        if everywhere:
            cells = torch.arange(len(self.density), device=device)
        else:
            quarter = len(self.density) // 4
            anywhere = torch.randint(len(self.density), (quarter,), generator=generator, device=device)
            occupied = torch.nonzero(self.occupied)[:, 0]
            if len(occupied) > quarter:
                drawn = torch.randint(len(occupied), (quarter,), generator=generator, device=device)
                occupied = occupied[drawn]
            cells = torch.cat([anywhere, occupied]).unique()
        corner = torch.stack(
            [cells // GRID_CELLS**2, cells // GRID_CELLS % GRID_CELLS, cells % GRID_CELLS], dim=1
        )
        positions = (corner + torch.rand(len(cells), 3, generator=generator, device=device)) / GRID_CELLS
        self.density *= GRID_DECAY
        self.density[cells] = torch.maximum(self.density[cells], density(positions))
        threshold = -math.log1p(-SOLID_ALPHA) / step_length
        self.occupied = self.density > min(threshold, float(self.density.mean()))

    def crossed(self, rays: Rays, distance: Tensor) -> Tensor:
        """Return which of the places [R, K] at some distances along rays lie in occupied cells."""
        cell = torch.zeros_like(distance, dtype=torch.int32)
        for axis in range(3):  # one axis at a time, since rows of three numbers are slow to work through
            origin, direction = rays.origins[:, axis, None], rays.directions[:, axis, None]
            along = torch.addcmul(origin * GRID_CELLS, distance, direction * GRID_CELLS)
            cell = cell * GRID_CELLS + along.int().clamp_(0, GRID_CELLS - 1)
        return self.occupied[cell]


def march(rays: Rays, occupancy: Occupancy, step_length: float, offset: Tensor) -> Samples:
    """Return the samples of rays at every step inside occupied cells, shifted by `offset` [R] steps (0..1) each."""
    inverse = 1 / torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
    to_low, to_high = -rays.origins * inverse, (1 - rays.origins) * inverse
    near = torch.minimum(to_low, to_high).amax(dim=1).clamp(min=0)
    far = torch.maximum(to_low, to_high).amin(dim=1)
    hit = torch.nonzero(far > near)[:, 0]
    if len(hit) == 0:
        return Samples(hit, near[hit], rays.origins[hit])
    near, far, reached = near[hit], far[hit], Rays(rays.origins[hit], rays.directions[hit])
    steps = math.ceil(float((far - near).max()) / step_length)
    distance = near[:, None] + (torch.arange(steps, device=near.device) + offset[hit, None]) * step_length
    ray, place = torch.nonzero(
        occupancy.crossed(reached, distance) & (distance < far[:, None]), as_tuple=True
    )
    distance = distance[ray, place]
    positions = reached.origins[ray] + distance[:, None] * reached.directions[ray]
    return Samples(hit[ray], distance, positions.clamp(0, 1))


def transmittances(optical_depths: Tensor, ray: Tensor) -> Tensor:
    """Return the share of light [M] that passes all samples of the same ray in front of each sample.

    Args:
        optical_depths: [M] density times step length.
        ray: [M] index of each sample's ray; samples of a ray stand together, nearest first.
    """
    if len(ray) == 0:
        return optical_depths
    # in double precision, since the sums run over all rays
    before = optical_depths.double().cumsum(0) - optical_depths
    first = torch.searchsorted(ray, ray)
    return (before[first] - before).exp().to(optical_depths.dtype)


def weights_of(optical_depths: Tensor, ray: Tensor) -> Tensor:
    """Return the weight [M] of each sample in its ray's colour: transmittance times alpha (Mildenhall 2020, eq. 3)."""
    return transmittances(optical_depths, ray) * -torch.expm1(-optical_depths)


def composited(weights: Tensor, colours: Tensor, ray: Tensor, count: int) -> Tensor:
    """Return the colours [count, C] of rays in front of a black sky, from samples' weights [M] and colours [M, C]."""
    return colours.new_zeros(count, colours.shape[1]).index_add(0, ray, weights[:, None] * colours)
