"""How pictures depend on the poses that they are taken from: slope and curvature of the likelihood by small motions.

A motion is a rotation vector (rad), then a shift (m), along the camera's axes, in front of world_to_camera.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.losses import ON_TARGET_ALPHA
from obbgs_core.model.cameras import Cameras
from obbgs_core.sensor import Sensor

KNEE = 2.0  # of the robust penalty, as in `losses.charbonnier`


@dataclass(frozen=True)
class PoseInformation:
    """The quadratic model of each picture's negative log likelihood by its motion, nats; float64.

    gradient: [B, 6] at no motion; curvature: [B, 6, 6] of Gauss and Newton, never negative.
    """

    gradient: Tensor
    curvature: Tensor


@torch.no_grad()
def pose_information(
    radiance: Tensor,
    alpha: Tensor,
    depth: Tensor,
    cameras: Cameras,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    averaged_pixels: int = 1,
) -> PoseInformation:
    """Return what rendered pictures say of the errors of their poses.

    A motion shifts each pixel's light by the image flow of its depth (Lucas and Kanade 1981; the flow of a point by the
    camera's motion, Chaumette and Hutchinson 2006). Residuals are taken in deviations of their own mean square where it
    is above the noise's (overdispersion): a picture that the model does not explain says less. What is uncovered behind
    an edge is not modelled; where model and poses are right no residual is left, so that this does not move the
    solution.

    Args:
        radiance [B, H, W, C], alpha and depth [B, H, W]: rendered with the cameras.
        exposure_time_s, dn, averaged_pixels: as for `losses.likelihood_loss`.
    """
    gradients, curvatures = [], []
    for i in range(len(radiance)):
        seen = alpha[i] > ON_TARGET_ALPHA
        near = F.max_pool2d(seen[None, None].float(), 3, 1, 1)[0, 0] > 0
        slope = _image_slope(radiance[i], near)  # [n, C, 2]
        flow = _flow(depth[i], seen, near, cameras.world_to_camera[i], cameras.K[i])  # [n, 2, 6]
        residual, by_radiance = _residual(
            radiance[i][near], exposure_time_s[i, 0], dn[i][near], sensor, averaged_pixels
        )
        rows = (
            (by_radiance[..., None] * -(slope @ flow)).flatten(0, 1).double()
        )  # [n C, 6] of the residual by motion
        residual = residual.flatten().double()
        dispersion = residual.square().mean().clamp(min=1)
        weight = (1 + residual.square() / (KNEE**2 * dispersion)).rsqrt() / dispersion
        gradients.append(rows.T @ (weight * residual))
        curvatures.append(rows.T @ (weight[:, None] * rows))
    return PoseInformation(torch.stack(gradients), torch.stack(curvatures))


def _image_slope(image: Tensor, at: Tensor) -> Tensor:
    """Return the derivatives [n, C, 2] of an image [H, W, C] along x and y at chosen pixels, by central differences."""
    padded = F.pad(image.movedim(-1, 0)[None], (1, 1, 1, 1), mode="replicate")[0].movedim(0, -1)
    dx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    dy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return torch.stack([dx[at], dy[at]], dim=-1)


def _flow(depth: Tensor, seen: Tensor, at: Tensor, world_to_camera: Tensor, K: Tensor) -> Tensor:
    """Return the motion of pixels [n, 2, 6] px by the motion; pixels beside the target have its origin's depth."""
    z = torch.where(seen, depth, world_to_camera[2, 3])[at].clamp(min=1e-6)
    rows, columns = torch.nonzero(at, as_tuple=True)
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    return point_flow(torch.stack([x * z, y * z, z], dim=1), K.expand(len(z), 3, 3))


def point_flow(points: Tensor, K: Tensor) -> Tensor:
    """Return how the pixels of points [n, 3] m, camera axes, move [n, 2, 6] px with a motion; K [n, 3, 3]."""
    x, y, z = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], points[:, 2]
    zero = torch.zeros_like(x)
    along_x = torch.stack([-x * y, 1 + x * x, -y, 1 / z, zero, -x / z], dim=-1)
    along_y = torch.stack([-1 - y * y, x * y, x, zero, 1 / z, -y / z], dim=-1)
    return K[:, [0, 1], [0, 1], None] * torch.stack([along_x, along_y], dim=1)


def _residual(
    radiance: Tensor, exposure_time_s: Tensor, dn: Tensor, sensor: Sensor, averaged_pixels: int
) -> tuple[Tensor, Tensor]:
    """Return the deviance residual [n, C] and its derivative by the radiance."""
    with torch.enable_grad():
        leaf = radiance.detach().requires_grad_()
        residual = sensor.deviance_residual(leaf, exposure_time_s, dn, averaged_pixels)
        (slope,) = torch.autograd.grad(residual.sum(), leaf)
    return residual.detach(), slope
