"""The model: N anisotropic Gaussians with opacity and scene-linear radiance."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from obbgs_core.rotations import quats_to_matrices
from obbgs_core.sh import C0, radiance, sh_basis

TENSORS = ("means", "quats", "log_scales", "opacity_logits", "sh")


@dataclass
class Gaussians:
    """Stored parameters (optimised) and, as properties, what they stand for.

    means [N, 3] m, body frame; quats [N, 4] w, x, y, z (normalised on use); log_scales [N, 3] of metres;
    opacity_logits [N]; sh [N, K, C] radiance coefficients (see `sh.radiance`), C = 1 or 3. The harmonics are taken at
    `sh_direction`: `view`, from the camera to the Gaussian, or `sun`, from the target towards the Sun. Of degree 1 the
    latter are, softly, max(0, b0 + B·s): Lambert's cosine with a normal and an albedo of each Gaussian's own. The
    shadow that one part casts on another is not modelled.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    sh_direction: Literal["view", "sun"] = "view"

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
        if self.sh_direction not in ("view", "sun"):
            raise ValueError(f"sh_direction must be view or sun, got {self.sh_direction!r}")

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
        return {name: getattr(self, name) for name in TENSORS}

    def select(self, index: Tensor) -> "Gaussians":
        """Return the Gaussians that an index or mask picks."""
        return dataclasses.replace(self, **{name: value[index] for name, value in self.tensors().items()})

    def detach(self) -> "Gaussians":
        return dataclasses.replace(self, **{name: value.detach() for name, value in self.tensors().items()})

    @staticmethod
    def concatenate(parts: "list[Gaussians]") -> "Gaussians":
        tensors = {name: torch.cat([getattr(p, name) for p in parts]) for name in TENSORS}
        return dataclasses.replace(parts[0], **tensors)

    def mean_radiance(self, sun_dir: Tensor | None) -> Tensor:
        """Return the radiance [N, C] in the mean over the views or, if it turns with the Sun, over `sun_dir` [S, 3].

        Raises:
            ValueError: the radiance turns with the Sun, and no direction is given.
        """
        suns = [None] if self.sh_direction == "view" or sun_dir is None else sun_dir
        under = [radiance(self.lit_from(sun).sh[:, :1], torch.zeros_like(self.means)) for sun in suns]
        return torch.stack(under).mean(dim=0)

    def lit_from(self, sun_dir: Tensor | None) -> "Gaussians":
        """Return the model as it looks with the Sun towards `sun_dir` [3] (unit, body frame): of no direction.

        A model whose radiance turns with the view is returned as it is.

        Raises:
            ValueError: the radiance turns with the Sun, and no direction is given.
        """
        if self.sh_direction == "view":
            return self
        if sun_dir is None:
            raise ValueError("the model's radiance turns with the Sun: give sun_dir, the Sun's direction")
        basis = sh_basis(sun_dir.reshape(1, 3).to(self.sh), self.sh.shape[1])
        constant = (basis[0, :, None] * self.sh).sum(dim=1, keepdim=True) / C0
        return dataclasses.replace(self, sh=constant, sh_direction="view")
