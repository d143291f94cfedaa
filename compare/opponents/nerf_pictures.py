"""A trained radiance field as a model: its images, and the surface on which its rays end."""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from compare.opponents.nerf_field import Field
from compare.opponents.nerf_rays import (
    FAINTEST_TRANSMITTANCE,
    Occupancy,
    Rays,
    Samples,
    composited,
    march,
    on_device,
    rays_of,
    transmittances,
    weights_of,
)
from obbgs_core.model.cameras import Cameras
from obbgs_core.score.surface import fused_points
from obbgs_core.sensor import Sensor

RAYS_AT_ONCE = 8192  # bounds the memory
POSITIONS_AT_ONCE = 2**16
MIDDLE = 0.5  # of a step, where images are sampled; trainings draw the place at random
SURFACE_TRANSMITTANCE = 0.5  # a ray ends where this share of its light is left
# of full scale; where a ray ends in less light nothing tells matter from the black sky
FAINTEST_SURFACE = 3e-3


@dataclass(frozen=True)
class Nerf:
    """A radiance field in a cube that reaches `radius_m` from the body's origin; cameras and images are on the CPU.

    step_length: between samples, in sides of the cube.
    reference_s: None: colours are signals as a fraction of the range from black to full scale. Otherwise they are
        radiance, in units of what reaches full scale in this exposure time (s).
    """

    field: Field
    occupancy: Occupancy
    radius_m: float
    step_length: float
    reference_s: float | None
    sensor: Sensor

    def snapshot(self) -> "Nerf":
        """Return a copy that further training does not change."""
        return copy.deepcopy(self)

    @torch.no_grad()
    def density(self, positions: Tensor) -> Tensor:
        """Return the density [N], per side of the cube, at positions [N, 3]."""
        pieces = positions.split(POSITIONS_AT_ONCE)
        return torch.cat([self.field.geometry(piece)[0] for piece in pieces])

    @torch.no_grad()
    def visible(self, rays: Rays, offset: Tensor) -> Samples:
        """Return the samples of rays that some light passes to; `offset` [R] in steps is as in `march`."""
        samples = march(rays, self.occupancy, self.step_length, offset)
        if len(samples.ray) == 0:
            return samples
        depths = self.density(samples.positions) * self.step_length
        return samples.select(transmittances(depths, samples.ray) > FAINTEST_TRANSMITTANCE)

    def composited(self, rays: Rays, samples: Samples) -> tuple[Tensor, Tensor]:
        """Return the rays' colours [R, C] and the samples' optical depths [M], with gradients."""
        density, features = self.field.geometry(samples.positions)
        depths = density * self.step_length
        colours = self.field.colour(features, rays.directions[samples.ray])
        return composited(weights_of(depths, samples.ray), colours, samples.ray, len(rays.origins)), depths

    @torch.no_grad()
    def image(self, camera: Cameras, exposure_time_s: float) -> Tensor:
        """Return the noiseless image [H, W, C] of one camera as a fraction of full scale, 0 to 1."""
        pieces = [
            self.composited(rays, self.visible(rays, middle))[0] for rays, middle in self._pieces(camera)
        ]
        signal = torch.cat(pieces).cpu().reshape(camera.height, camera.width, -1)
        if self.reference_s is not None:
            signal = signal * (exposure_time_s / self.reference_s)
        black = self.sensor.black_dn / self.sensor.white_dn
        return (black + (1 - black) * signal).clamp(0, 1)

    def _pieces(self, camera: Cameras) -> list[tuple[Rays, Tensor]]:
        """Return the rays of all pixels of one camera, row by row, some at a time, and where their samples start."""
        device = self.occupancy.density.device
        camera = on_device(camera, device)
        pieces = []
        for pixel in torch.arange(camera.height * camera.width, device=device).split(RAYS_AT_ONCE):
            row, column = pixel // camera.width, pixel % camera.width
            rays = rays_of(camera, torch.zeros_like(pixel), row, column, self.radius_m)
            pieces.append((rays, torch.full_like(row, MIDDLE, dtype=torch.float32)))
        return pieces

    @torch.no_grad()
    def depth_map(self, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
        """Return the depths [H, W] m at which one camera's rays lose half of their light, their slopes, m/px, and the
        light [H, W] of the pixels.

        A depth is infinite where a ray loses less, or where the pixel is as dark as the sky. Slopes [H, W, 2] are
        differences of the neighbours' depths.
        """
        axis = camera.world_to_camera[0, 2, :3].to(self.occupancy.density.device)
        pieces, lights = [], []
        for rays, middle in self._pieces(camera):
            samples = self.visible(rays, middle)
            colours, depths = self.composited(rays, samples)
            distance = half_depths(depths, samples, len(middle), self.step_length)
            lights.append(colours.mean(dim=1))
            bright = lights[-1] > FAINTEST_SURFACE
            depth = 2 * self.radius_m * distance * (rays.directions @ axis)
            pieces.append(torch.where(bright, depth, torch.inf))
        depth, light = (torch.cat(of).cpu().reshape(camera.height, camera.width) for of in (pieces, lights))
        return depth, slopes(depth), light

    def surface(self, cameras: Cameras, count: int, most_views: int | None = None) -> Tensor:
        """Return points [count, 3] m, evenly spread over the surface that the cameras see; [0, 3] if they see none.

        Args:
            most_views: whose depths are fused, spread evenly; None: of all cameras.
        """
        kept = len(cameras) if most_views is None else min(most_views, len(cameras))
        views = torch.linspace(0, len(cameras) - 1, kept).round().long().unique()
        chosen = Cameras(cameras.world_to_camera[views], cameras.K[views], cameras.width, cameras.height)
        points, _ = fused_points(lambda c: self.depth_map(chosen.one(c)), chosen, count)
        return points


def half_depths(optical_depths: Tensor, samples: Samples, count: int, step_length: float) -> Tensor:
    """Return the distance [count] at which each ray's light falls to one half; infinite where it does not.

    Within a step matter is taken as spread evenly, as the weights of the samples take it.
    """
    before = transmittances(optical_depths, samples.ray)
    after = before * torch.exp(-optical_depths)
    crossing = torch.nonzero((before > SURFACE_TRANSMITTANCE) & (after <= SURFACE_TRANSMITTANCE))[:, 0]
    share = (before[crossing] / SURFACE_TRANSMITTANCE).log() / optical_depths[crossing]
    distance = optical_depths.new_full((count,), torch.inf)
    distance[samples.ray[crossing]] = samples.distance[crossing] + (share - MIDDLE) * step_length
    return distance


def slopes(depth: Tensor) -> Tensor:
    """Return the central differences [H, W, 2] of depths [H, W] along columns and rows; 0 beside infinite ones."""
    rows, columns = torch.zeros_like(depth), torch.zeros_like(depth)
    rows[1:-1] = (depth[2:] - depth[:-2]) / 2
    columns[:, 1:-1] = (depth[:, 2:] - depth[:, :-2]) / 2
    return torch.stack([columns, rows], dim=-1).nan_to_num(0, 0, 0)
