"""A prior on the means: the Gaussians of a face lie in one plane, also where no image shows how deep they lie."""

from dataclasses import dataclass

import torch
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices

NEIGHBOURS = 8  # of each Gaussian
FOUND_EVERY = 50  # steps, where no Gaussians are added or removed
APPLIED_EVERY = 2  # steps, with as many times the weight
LEAST_COSINE = 0.7  # between the normals of neighbours on one face: 45 degrees
FARTHEST = 0.05  # of the target's radius, along the normal; what is farther is another face
LEAST_OPACITY = 0.2  # fainter neighbours are no surface
ALIKE = 0.5  # largest difference of the logarithms of radiance on one face: the two sides of a plate differ by more
DARK = 0.01  # of the bright surface's radiance; what is fainter counts as equally dark
BRIGHT_QUANTILE = 0.97
ROUNDED = 2e-3  # of the target's radius: nearer to the plane the prior is quadratic, farther it is linear


@dataclass(frozen=True)
class Faces:
    """Which Gaussians lie on one face with which of their neighbours.

    neighbours: [N, K] indices; same: [N, K] 1 where the neighbour is on the face, else 0; normals: [N, 3] unit.
    """

    neighbours: Tensor
    same: Tensor
    normals: Tensor


@torch.no_grad()
def faces(gaussians: Gaussians, radius_m: float) -> Faces:
    """Return the faces of a model: neighbours that are turned alike, equally bright, opaque and nearly in one plane.

    Args:
        radius_m: of the target.
    """
    gaussians = gaussians.detach()
    means = gaussians.means.nan_to_num(0, 0, 0)
    count = min(NEIGHBOURS + 1, len(means))
    _, nearest = KDTree(means.numpy()).query(means.numpy(), k=count)
    neighbours = torch.from_numpy(nearest).reshape(len(means), count)[:, 1:]  # the nearest is itself
    axes = quats_to_matrices(gaussians.quats).nan_to_num(0, 0, 0)
    normals = axes[torch.arange(len(means)), :, gaussians.log_scales.argmin(dim=1)]
    light = gaussians.sh[:, 0].mean(dim=1).nan_to_num(0, 0, 0)
    light = light.clamp(min=max(DARK * float(light.quantile(BRIGHT_QUANTILE)), 1e-12)).log()
    offsets = ((means[neighbours] - means[:, None]) * normals[:, None]).sum(dim=2)
    same = (normals[neighbours] * normals[:, None]).sum(dim=2).abs() > LEAST_COSINE
    same &= (light[neighbours] - light[:, None]).abs() < ALIKE
    same &= gaussians.opacities[neighbours] > LEAST_OPACITY
    same &= offsets.abs() < FARTHEST * radius_m
    return Faces(neighbours, same.to(means.dtype), normals)


def unevenness(means: Tensor, found: Faces, radius_m: float) -> Tensor:
    """Return the mean distance [] of neighbours on a face from the plane of each Gaussian, over the target's radius.

    The distances are pseudo-Huber: a few Gaussians far from the plane of the others do not tilt it.

    Args:
        means: [N, 3] m, the only thing that gets a gradient.
    """
    means = means.nan_to_num(0, 0, 0)  # what is not finite is removed later and must not spread
    offsets = ((means[found.neighbours] - means[:, None]) * found.normals[:, None]).sum(dim=2) / radius_m
    distances = (offsets.square() + ROUNDED**2).sqrt() - ROUNDED
    return (distances * found.same).sum() / max(1, distances.numel())
