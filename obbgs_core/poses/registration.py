"""How pictures depend on the poses that they are taken from: slope and curvature of the likelihood by small motions.

A motion is a rotation vector (rad), then a shift (m), along the camera's axes, in front of world_to_camera.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.losses import ON_TARGET_ALPHA
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.motions import point_flow
from obbgs_core.sensor import Sensor

CELLS = 1024  # along each axis of the body
KNEE = 2.0  # of the robust penalty, as in `losses.charbonnier`
# of a picture, that are asked: those where it changes most. Of a photograph they tell nearly all that it can tell.
MOST_PIXELS = 8192


@dataclass(frozen=True)
class PoseInformation:
    """The quadratic model of each picture's negative log likelihood by its motion, nats; float64.

    gradient: [B, 6] at no motion; curvature: [B, 6, 6] of Gauss and Newton, never negative.
    cells: what each picture says of the places of the surface's cells, where that was asked for.
    cell_m: their edge.
    dispersion: [B] mean squared residual of each picture, 1 where only noise is left; none where none was compared.
    """

    gradient: Tensor
    curvature: Tensor
    cells: "list[CellInformation] | None" = None
    cell_m: float = 0.0
    dispersion: Tensor | None = None


@dataclass(frozen=True)
class CellInformation:
    """How a picture's negative log likelihood changes where the surface moves: in cubes, each by a shift of its own.

    numbers: [k] of the cubes; gradient: [k, 3] by their shifts, m, body axes; curvature: [k, 3, 3];
    mixed: [k, 3, 6] second derivatives by shift and motion of the pose.
    """

    numbers: Tensor
    gradient: Tensor
    curvature: Tensor
    mixed: Tensor


@dataclass(frozen=True)
class CellShifts:
    """Where the surface's cells go: shifts [k, 3] m, body axes, of cubes with edge cell_m and numbers [k] (sorted)."""

    numbers: Tensor
    shifts: Tensor
    cell_m: float

    def of_points(self, points: Tensor) -> Tensor:
        """Return the shifts [n, 3] of points [n, 3] m: at most half a cell along each axis, 0 where none is known."""
        numbers = _cell_numbers(points.double(), self.cell_m)
        at = torch.searchsorted(self.numbers, numbers).clamp(max=len(self.numbers) - 1)
        seen = (self.numbers[at] == numbers)[:, None]
        limit = self.cell_m / 2
        return torch.where(seen, self.shifts[at], 0.0).clamp(-limit, limit).to(points)


@torch.no_grad()
def pose_information(
    radiance: Tensor,
    slopes: Tensor,
    alpha: Tensor,
    depth: Tensor,
    cameras: Cameras,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    averaged_pixels: int = 1,
    cell_m: float = 0.0,
) -> PoseInformation:
    """Return what rendered pictures say of the errors of their poses, and of the places of the surface's cells.

    A motion shifts each pixel's light by the image flow of its depth (Lucas and Kanade 1981; the flow of a point by the
    camera's motion, Chaumette and Hutchinson 2006). Residuals are taken in deviations of their own mean square where it
    is above the noise's (overdispersion): a picture that the model does not explain says less. What is uncovered behind
    an edge is not modelled; where model and poses are right no residual is left, so that this does not move the
    solution.

    Args:
        radiance [B, H, W, C], its slopes [B, H, W, C, 2] along x and y, per px, alpha and depth [B, H, W]: rendered
            with the cameras.
        exposure_time_s, dn, averaged_pixels: as for `losses.likelihood_loss`.
        cell_m: above 0: edge of the cubes that the surface is divided into. The values of a cube in a picture are then
            counted as one, because what a model still gets wrong is alike in neighbouring pixels and channels.

    Of pictures that show more than `MOST_PIXELS` of the target those are asked in which it changes most.
    """
    gradients, curvatures, cells, dispersions = [], [], [], []
    for i in range(len(radiance)):
        seen = alpha[i] > ON_TARGET_ALPHA
        lit, deep = (_of_nine(image) for image in (seen.float(), torch.where(seen, depth[i], 0.0)))
        near = lit > 0
        seen_values = int(near.sum()) * radiance.shape[-1]
        near = _steepest(near, slopes[i])
        slope = slopes[i][near]  # [n, C, 2]
        # those beside the target are as deep as its edge
        points = _points(torch.where(seen, depth[i], deep / lit.clamp(min=1)), near, cameras.K[i])  # [n, 3]
        flow = point_flow(points, cameras.K[i].expand(len(points), 3, 3))  # [n, 2, 6]
        residual, by_radiance = _residual(
            radiance[i][near], exposure_time_s[i, 0], dn[i][near], sensor, averaged_pixels
        )
        shift = slope[..., :1] * flow[:, None, 0] + slope[..., 1:] * flow[:, None, 1]  # [n, C, 6]
        rows = (by_radiance[..., None] * -shift).flatten(0, 1).double()  # [n C, 6] of the residual by motion
        residual = residual.flatten().double()
        dispersion = residual.square().mean().clamp(min=1)
        weight = (1 + residual.square() / (KNEE**2 * dispersion)).rsqrt() / dispersion
        if cell_m:
            pose = cameras.world_to_camera[i].double()
            numbers = _cell_numbers((points.double() - pose[:3, 3]) @ pose[:3, :3], cell_m)
            numbers, place = numbers.unique(return_inverse=True)
            place = place.repeat_interleave(radiance.shape[-1])  # of each row
            weight = weight * len(numbers) / max(1, seen_values)
            told = rows, rows[:, 3:] @ pose[:3, :3], weight, residual
            cells.append(_cell_information(numbers, place, *told))
        gradients.append(rows.T @ (weight * residual))
        curvatures.append(rows.T @ (weight[:, None] * rows))
        dispersions.append(residual.square().mean())
    dispersion = torch.stack(dispersions)
    return PoseInformation(torch.stack(gradients), torch.stack(curvatures), cells or None, cell_m, dispersion)


def _steepest(near: Tensor, slopes: Tensor) -> Tensor:
    """Return those of chosen pixels [H, W] in which a picture changes most, by its slopes [H, W, C, 2]."""
    if int(near.sum()) <= MOST_PIXELS:
        return near
    steepness = torch.where(near, slopes.square().sum(dim=(2, 3)), -1.0).flatten()
    chosen = torch.zeros_like(near).flatten()
    chosen[steepness.topk(MOST_PIXELS).indices] = True
    return chosen.view_as(near)


def _cell_numbers(points: Tensor, cell_m: float) -> Tensor:
    """Return the numbers [n] of the cubes in which points [n, 3] of the body lie."""
    at = (points / cell_m).floor().long().clamp(-CELLS // 2, CELLS // 2 - 1) + CELLS // 2
    return (at[:, 0] * CELLS + at[:, 1]) * CELLS + at[:, 2]


def _cell_information(
    numbers: Tensor, place: Tensor, by_motion: Tensor, by_point: Tensor, weight: Tensor, residual: Tensor
) -> CellInformation:
    """Return the sums over the rows [n] of each cell: residuals [n] with derivatives [n, 6] and [n, 3] and weights.

    Args:
        numbers: [k] of the cells; place: [n] of each row's cell among them.
    """
    table = torch.cat([by_point, by_motion, residual[:, None]], dim=1)  # [n, 10]
    products = (weight[:, None] * by_point)[:, :, None] * table[:, None, :]
    summed = torch.zeros(len(numbers), 3, 10, dtype=torch.float64).index_add(0, place, products)
    return CellInformation(numbers, summed[..., 9], summed[..., :3], summed[..., 3:9])


def _of_nine(image: Tensor) -> Tensor:
    """Return the sums [H, W] of each pixel and its neighbours; what lies beyond the edges is 0."""
    wide = F.pad(image, (1, 1, 1, 1))
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]


def _points(depth: Tensor, at: Tensor, K: Tensor) -> Tensor:
    """Return the points [n, 3] m, camera axes, of chosen pixels at these depths."""
    z = depth[at].clamp(min=1e-6)
    rows, columns = torch.nonzero(at, as_tuple=True)
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    return torch.stack([x * z, y * z, z], dim=1)


def _residual(
    radiance: Tensor, exposure_time_s: Tensor, dn: Tensor, sensor: Sensor, averaged_pixels: int
) -> tuple[Tensor, Tensor]:
    """Return the deviance residual [n, C] and its derivative by the radiance."""
    with torch.enable_grad():
        leaf = radiance.detach().requires_grad_()
        residual = sensor.deviance_residual(leaf, exposure_time_s, dn, averaged_pixels)
        (slope,) = torch.autograd.grad(residual.sum(), leaf)
    return residual.detach(), slope
