"""The model: N anisotropic Gaussians with opacity and scene-linear radiance."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from obbgs_core.rotations import quats_to_matrices


@dataclass
class Gaussians:
    """Stored parameters (optimised) and, as properties, what they stand for.

    means [N, 3] m, body frame; quats [N, 4] w, x, y, z (normalised on use); log_scales [N, 3] of metres;
    opacity_logits [N]; sh [N, K, C] radiance coefficients (see `sh.radiance`), C = 1 or 3.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor

    def __post_init__(self):
        n = self.means.shape[0]
        for name, shape in (
            ("means", (n, 3)),
            ("quats", (n, 4)),
            ("log_scales", (n, 3)),
            ("opacity_logits", (n,)),
        ):
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name} must be {list(shape)}, got {list(getattr(self, name).shape)}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] not in (1, 3):
            raise ValueError(f"sh must be [{n}, K, 1 or 3], got {list(self.sh.shape)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """[N, 3] m, one sigma along each axis."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """[N] in 0..1."""
        return self.opacity_logits.sigmoid()

    def covariances(self) -> Tensor:
        """[N, 3, 3] m², body frame: R S S^T R^T."""
        RS = quats_to_matrices(self.quats) * self.scales[:, None, :]
        return RS @ RS.transpose(1, 2)

    def tensors(self) -> dict[str, Tensor]:
        """The stored parameters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def select(self, index: Tensor) -> "Gaussians":
        """Return the Gaussians that an index or mask picks."""
        return Gaussians(**{name: value[index] for name, value in self.tensors().items()})

    def detach(self) -> "Gaussians":
        return Gaussians(**{name: value.detach() for name, value in self.tensors().items()})

    @staticmethod
    def concatenate(parts: "list[Gaussians]") -> "Gaussians":
        names = [f.name for f in fields(Gaussians)]
        return Gaussians(**{name: torch.cat([getattr(p, name) for p in parts]) for name in names})
