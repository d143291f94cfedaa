"""Covariances of pose tags: whether a matrix is one, and the coordinates in which a tag's error has unit variance.

A covariance [6, 6] is that of the small motion which, in front of world_to_camera, makes a tagged pose the true one:
a rotation vector about the camera's axes (rad), then a shift along them (m).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

TOLERANCE = 2e-6  # of a block's mean variance; twice what flight lets pass, since a tag is turned and mixed after that
EXACT = 1e-12  # of a block's mean variance: less counts as none, a micrometre beside a metre
# stands for that of a block without variance, so that any entry of it that is not zero shows
NO_DEVIATION = 1e-30


@dataclass(frozen=True)
class Whitening:
    """The change of coordinates xi = root z, z = inverse xi between motions xi and numbers z of unit variance.

    Attributes:
        root: [P, 6, 6] root rootᵀ is the covariance. It is diagonal where the covariance is, changes little where the
            covariance does, and turns with the camera's axes: none of this holds for eigenvectors with equal values.
        inverse: [P, 6, 6] float64; the pseudo-inverse where some direction is exact.
        support: [P, 6, 6] projects z onto what moves a pose at all.
        exact: [P, 6, 6] float64; exact xi = 0 for every motion that the covariance allows, a row of zeros for each
            direction that is not exact.
        rank: [P] how many directions are not exact.
    """

    root: Tensor
    inverse: Tensor
    support: Tensor
    exact: Tensor
    rank: Tensor


def whitening(covariances: Tensor) -> Whitening:
    """Return the whitening of covariances [P, 6, 6] that have no flaw."""
    covariances = covariances.double()
    values, vectors = torch.linalg.eigh(_scaled(covariances))  # radians and metres have no common scale
    deviations = _deviations(covariances)  # [P, 6]
    deviations = torch.where(deviations > NO_DEVIATION, deviations, 1.0)
    doubted = values > EXACT
    deviation = torch.where(doubted, values, 0.0).sqrt()
    inverse = torch.where(doubted, 1 / deviation, 0.0)

    def symmetric(spectrum: Tensor) -> Tensor:
        return (vectors * spectrum[:, None, :]) @ vectors.mT

    return Whitening(
        root=(deviations[:, :, None] * symmetric(deviation)).float(),
        inverse=symmetric(inverse) / deviations[:, None, :],
        support=symmetric(doubted.double()).float(),
        exact=torch.where(doubted[:, :, None], 0.0, vectors.mT / deviations[:, None, :]),
        rank=doubted.sum(1),
    )


def flaw(covariance: Tensor) -> str:
    """Return what keeps a tensor from being a covariance [6, 6] of a pose; nothing where it is one up to rounding."""
    if covariance.shape != (6, 6):
        return f"has shape {tuple(covariance.shape)}"
    if not torch.isfinite(covariance).all():
        return "holds a value that is not finite"
    scaled = _scaled(covariance.double())
    asymmetry = float((scaled - scaled.mT).abs().max())
    if asymmetry > TOLERANCE:
        return f"is not symmetric (by {asymmetry:.2g} of its mean variances)"
    smallest = float(torch.linalg.eigvalsh(scaled)[0])
    if smallest < -TOLERANCE:
        return f"has a negative eigenvalue ({smallest:.2g} of its mean variances)"
    return ""


def _scaled(covariances: Tensor) -> Tensor:
    """Return covariances [..., 6, 6] with unit mean variance of the rotation and of the shift."""
    deviations = _deviations(covariances)
    return covariances / (deviations[..., :, None] * deviations[..., None, :])


def _deviations(covariances: Tensor) -> Tensor:
    """Return, for each of the six numbers [..., 6], the root of its block's mean variance: no turn changes that."""
    variances = covariances.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 3)).mean(-1)
    return variances.clamp(min=0).sqrt().clamp(min=NO_DEVIATION).repeat_interleave(3, dim=-1)
