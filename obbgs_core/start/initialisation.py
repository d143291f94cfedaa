"""The first Gaussians: on the visual hull of the long exposures, or at random."""

import dataclasses
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import torch
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.compiled import each
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame, mean_exposure_s
from obbgs_core.model import sh
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.sensor import Sensor
from obbgs_core.settings import check, number
from obbgs_core.start import hull
from obbgs_core.start.earth import earth_silhouette

log = logging.getLogger(__name__)
FEWEST_HULL_POINTS = 200  # with fewer the start is random
FEWEST_VIEWS = 12  # that carve the hull
FARTHEST_ORIGIN = 4.0  # from the target, in deviations of its light about its middle, where there is no hull
VIEWS_FOR_COLOUR = 24  # about so many frames, spread evenly, are averaged for the first radiance
HULL_OPACITY, RANDOM_OPACITY = 0.5, 0.1  # of the first Gaussians
# Deviation on the hull over the mean distance to the nearest three: spread points are 1.4 times as far from each other
# as random ones, and at 1 they hide what is behind them (docs/experiments/046).
HULL_WIDTH = 0.7


@dataclass(frozen=True)
class StartSettings:
    """The first Gaussians."""

    # on the target's hull, or in a cube around it; the number is that of the note in docs/experiments (001)
    kind: Literal["random", "hull"] = "hull"
    count: int = number(3000, least=2)  # at most: the hull may have fewer points (046, 060)

    def __post_init__(self):
        check(self, "start")


def silhouettes(
    frames: list[TrainingFrame], sensor: Sensor, known: Mapping[int, hull.Silhouette] = MappingProxyType({})
) -> dict[int, hull.Silhouette]:
    """Return silhouettes of the longest exposures by the frame's index, as tagged.

    Shadowed faces are brightest there. Where these frames are few those of the next longest exposure join them: a view
    that misses a shadowed face does less harm than no view. Those that are `known` are not made again. Frames with the
    Earth in view have no silhouette, or, where there are few others, one of what differs from an even Earth.
    """
    black = {i: f for i, f in enumerate(frames) if f.earth_m is None}
    earth: dict[int, TrainingFrame] = {}
    if len(black) < FEWEST_VIEWS:
        earth = {i: f for i, f in enumerate(frames) if f.earth_m is not None}
    chosen: dict[int, TrainingFrame] = {}
    for exposure_s in sorted({f.exposure_time_s for f in frames}, reverse=True):
        if len(chosen) < FEWEST_VIEWS:
            chosen |= {i: f for i, f in black.items() if f.exposure_time_s == exposure_s}

    def outline(i: int) -> hull.Silhouette:
        if i in known:
            return known[i]
        if i in earth:
            return earth_silhouette(earth[i], sensor)
        f = chosen[i]
        found = hull.silhouette_of(f, sensor)
        spread_px = math.ceil(f.moved_px / 2)
        return dataclasses.replace(found, grown_px=spread_px) if spread_px else found

    indices = list(chosen | earth)
    return dict(zip(indices, each(outline, indices), strict=True))


def first_gaussians(
    frames: list[TrainingFrame],
    outlines: list[hull.Silhouette],
    sensor: Sensor,
    settings: StartSettings,
    sh_degree: int,
    rng: torch.Generator,
    grey: bool = False,
) -> tuple[Gaussians, float, str]:
    """Return the first Gaussians, the target's radius (m), and where the Gaussians came from.

    Args:
        outlines: silhouettes of some of the frames.
        sh_degree: of the spherical harmonics that the Gaussians have room for.
        grey: their radiance is half of full scale, plus up to 0.0011 of it at random (3DGS, on data sets without a
            point cloud), instead of what the frames show where the points project.

    Raises:
        ReconstructionError: every frame is black, or the origin is behind the cameras or far from the target.
    """
    radius = hull.radius_m(outlines)
    if radius == 0 and any(outline.certain.any() for outline in outlines):
        raise ReconstructionError(
            "the origin of the body's axes lies behind every camera that sees light: poses must have it in the target"
        )
    if radius == 0 and all(f.earth_m is not None for f in frames):
        raise ReconstructionError(
            f"all {len(frames)} frames have the Earth behind the target, and none shows it on black sky or in front of "
            "an even part of the Earth, such as an ocean: take frames with the camera away from the Earth"
        )
    if radius == 0:
        raise ReconstructionError(
            f"all {len(frames)} frames are black (eclipse, or exposures too short): nothing rises above the noise"
        )
    coefficients = (sh_degree + 1) ** 2
    if settings.kind == "hull":
        points, voxel_m = hull.hull_points(outlines, radius)
        if len(points) >= FEWEST_HULL_POINTS:
            chosen = spread(points, settings.count, rng)
            points = points[chosen] + (torch.rand(len(chosen), 3, generator=rng) - 0.5) * voxel_m
            colours = _colours(points, frames, sensor, grey, rng)
            width_m = HULL_WIDTH * _mean_spacing(points)
            model = _round_gaussians(points, colours, width_m, coefficients, HULL_OPACITY)
            return model, radius, f"visual hull, {len(chosen)} points"
        if (apart := hull.origin_apart(outlines)) > FARTHEST_ORIGIN:
            where = (
                f"{apart:.0f} times the target's width beside it"
                if apart < math.inf
                else "behind the cameras"
            )
            raise ReconstructionError(
                f"the origin of the body's axes lies {where}: poses must have it in the target"
            )
        log.warning("the silhouettes agree on only %d points; starting at random", len(points))
    points = (2 * torch.rand(settings.count, 3, generator=rng) - 1) * radius
    colours = _colours(points, frames, sensor, grey, rng)
    spacing = _root_mean_square_spacing if settings.kind == "random" else _mean_spacing
    model = _round_gaussians(points, colours, spacing(points), coefficients, RANDOM_OPACITY)
    return model, radius, f"random, {settings.count} points"


def spread(points: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Return the indices of at most `count` of the points [M, 3], spread so that no part of them is left out.

    The first is drawn at random; each further one is the farthest from all before it, so that no point is farther from
    the chosen ones than twice what is possible. If all were drawn at random, a thin mast could get none, and training
    would show it as one long Gaussian that sticks out at both ends.

    Source: Gonzalez, Clustering to Minimize the Maximum Intercluster Distance, 1985.
    """
    if len(points) <= count:
        return torch.arange(len(points))
    points = points - points.mean(dim=0)
    half_square = 0.5 * points.square().sum(dim=1)
    nearest = torch.full_like(
        half_square, torch.inf
    )  # half of the squared distance to the nearest chosen point
    distance = torch.empty_like(half_square)
    chosen = [int(torch.randint(len(points), (1,), generator=rng))]
    for _ in range(count - 1):
        last = chosen[-1]
        torch.addmv(half_square, points, points[last], alpha=-1, out=distance)
        torch.minimum(nearest, distance.add_(float(half_square[last])), out=nearest)
        nearest[last] = -torch.inf  # not again, whatever rounding says
        chosen.append(int(nearest.argmax()))
    return torch.tensor(chosen)


def _colours(
    points: Tensor,
    frames: list[TrainingFrame],
    sensor: Sensor,
    grey: bool,
    rng: torch.Generator,
) -> Tensor:
    """Return the coefficients of degree 0 [N, C] that Gaussians at points start with."""
    if grey:
        noise = torch.rand(len(points), frames[0].shape[2], generator=rng)
        full_scale = sensor.full_scale_radiance(mean_exposure_s(frames))
        return sh.from_radiance((0.5 + sh.C0 * noise / 255) * full_scale)
    return sh.from_radiance(_seen_radiance(points, frames, sensor))


def _neighbour_distances_m(points: Tensor) -> Tensor:
    """Return the distances [N, 3] of each point's three nearest neighbours, fewer where there are fewer points."""
    distances, _ = KDTree(points.numpy()).query(points.numpy(), k=min(4, len(points)))
    return torch.from_numpy(distances).float()[:, 1:]


def _mean_spacing(points: Tensor) -> Tensor:
    return _neighbour_distances_m(points).mean(dim=1)


def _root_mean_square_spacing(points: Tensor) -> Tensor:  # as in 3DGS
    return _neighbour_distances_m(points).square().mean(dim=1).sqrt()


def _round_gaussians(
    points: Tensor, colours: Tensor, spacing_m: Tensor, coefficients: int, opacity: float
) -> Gaussians:
    """Return round Gaussians at points, of deviations spacing_m [N]."""
    spacing = spacing_m.clamp(min=1e-6)
    count = len(points)
    radiance = torch.zeros(count, coefficients, colours.shape[1])
    radiance[:, 0] = colours
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    logits = torch.full((count,), math.log(opacity / (1 - opacity)))
    return Gaussians(points, quats, spacing.log()[:, None].repeat(1, 3), logits, radiance).trainable()


def _seen_radiance(points: Tensor, frames: list[TrainingFrame], sensor: Sensor) -> Tensor:
    """Return the mean radiance [N, C] that some of the frames show where the points project, occlusion ignored."""
    total, seen = torch.zeros(len(points), frames[0].shape[2]), torch.zeros(len(points), 1)
    frames = [frame for frame in frames if frame.earth_m is None] or frames
    for frame in frames[:: max(1, len(frames) // VIEWS_FOR_COLOUR)]:
        p = points @ frame.world_to_camera[:3, :3].T + frame.world_to_camera[:3, 3]
        z = p[:, 2].clamp(min=1e-6)
        u = (frame.K[0, 0] * p[:, 0] / z + frame.K[0, 2]).long()
        v = (frame.K[1, 1] * p[:, 1] / z + frame.K[1, 2]).long()
        height, width = frame.shape[:2]
        inside = ((p[:, 2] > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height))[:, None]
        signal = frame.dn[v.clamp(0, height - 1), u.clamp(0, width - 1)] - sensor.black_dn
        total += inside * signal.clamp(min=0) / (sensor.dn_per_radiance_s * frame.exposure_time_s)
        seen += inside
    return total / seen.clamp(min=1)
