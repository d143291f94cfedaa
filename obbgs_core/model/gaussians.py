"""The model: N anisotropic Gaussians with opacity and scene-linear radiance."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from torch import Tensor

from obbgs_core.model.rotations import quats_to_matrices

Shading = Literal["view", "sun", "lambert"]
Footprint = Literal["kerbl", "mip-splatting", "camera"]
# With the pixel's own 1/12 px² it makes 0.15 px², the best of several on rendered pictures.
DEFAULT_PSF_SIGMA_PX = 0.26
TENSORS = ("means", "quats", "log_scales", "opacity_logits", "sh")
# numbers of a Gaussian's lobe, the last of them the logarithm of its weight: along its normal, or three for an axis too
LOBES = (1, 4)


@dataclass
class Gaussians:
    """Stored parameters (optimised) and, as properties, what they stand for.

    means [N, 3] m, body frame; quats [N, 4] w, x, y, z (normalised on use); log_scales [N, 3] of metres;
    opacity_logits [N]; sh [N, K, C] coefficients, C = 1 or 3. What they stand for is the `shading`:

    - `view`: radiance (see `sh.radiance`), the harmonics taken along the line from the camera to the Gaussian;
    - `sun`: radiance, the harmonics taken towards the Sun: of degree 1, softly, max(0, b0 + B·s);
    - `lambert`: an albedo. Radiance is albedo·(max(0, n·s)·V(s) + ambient): n the shortest axis on the camera's
      side, s the Sun, V the share of it that other Gaussians let through (`render.sunlit_shares`), all of the light in
      units of the Sun's. The maximum is as soft as `sh.radiance`, and ambient [] is one number for all. Where K > 1 the
      harmonics are taken towards the Sun, and correct the albedo for what else changes with it.

    A model may have highlights (`render.highlights`): each Gaussian then mirrors the Sun in one more lobe, which is
    added to that radiance. lobes [N, 1]: the logarithm of its weight, the Gaussian being a mirror across its shortest
    axis; or [N, 4]: before it an axis of the lobe's own (normalised on use). That is the normal of the mirror where the
    Sun is known, which it is with the shadings `sun` and `lambert` and where static_sun [3] holds its direction (unit,
    body frame), because it stands still; where static_sun is [0], the direction in which the lobe is seen at its
    brightest. gloss [1 + C]: the logarithms of the roughness alpha of GGX and of the peak radiance of a weight of 1,
    shared by all as one material is. A model without highlights has lobes [N, 0] and gloss [0].

    Projected Gaussians are widened by what each pixel averages over, the `footprint`. It belongs to the model, because
    opacities and scales were fitted with it:

    - `kerbl`: 0.3 px², and the peak is kept, so that thin Gaussians gain light (Kerbl et al. 2023);
    - `mip-splatting`: 0.1 px², and the peak is lowered so that the light stays the same (Yu et al. 2024);
    - `camera`: the variance of the camera's pixel and optics, with the peak lowered as well. psf_sigma_px [] is the
      point spread of cameras that do not know their own, in pixels of the sensor.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    shading: Shading = "view"
    ambient: Tensor = field(default_factory=lambda: torch.zeros(()))
    footprint: Footprint = "kerbl"
    psf_sigma_px: Tensor = field(default_factory=lambda: torch.tensor(DEFAULT_PSF_SIGMA_PX))
    lobes: Tensor = field(default_factory=lambda: torch.zeros(0, 0))
    gloss: Tensor = field(default_factory=lambda: torch.zeros(0))
    static_sun: Tensor = field(default_factory=lambda: torch.zeros(0))

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
        if not self.has_highlights:
            self.lobes = self.means.new_zeros(n, 0)
        elif (
            self.lobes.shape[0] != n
            or self.lobes.shape[1] not in LOBES
            or len(self.gloss) != 1 + self.sh.shape[2]
        ):
            raise ValueError(
                f"lobes must be [{n}, 1 or 4] with gloss [{1 + self.sh.shape[2]}], or both empty, got "
                f"{list(self.lobes.shape)} with {list(self.gloss.shape)}"
            )
        if tuple(self.static_sun.shape) not in ((0,), (3,)):
            raise ValueError(
                f"static_sun must be [3], or [0] if it is not known, got {list(self.static_sun.shape)}"
            )
        if self.shading not in get_args(Shading):
            raise ValueError(f"shading must be one of {', '.join(get_args(Shading))}, got {self.shading!r}")
        if self.footprint not in get_args(Footprint):
            raise ValueError(
                f"footprint must be one of {', '.join(get_args(Footprint))}, got {self.footprint!r}"
            )

    @property
    def has_highlights(self) -> bool:
        """Whether each Gaussian has a lobe in which it mirrors the Sun."""
        return self.lobes.shape[1] > 0

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        _, coefficients, channels = self.sh.shape
        lobes = ", with highlights" if self.has_highlights else ""
        return (
            f"<{len(self):,} Gaussians in {channels} channel{'s' * (channels > 1)}, shading {self.shading}, "
            f"harmonics of degree {math.isqrt(coefficients) - 1}{lobes}>"
        )

    @property
    def scales(self) -> Tensor:
        """[N, 3] m, one sigma along each axis."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """[N] in 0..1."""
        return self.opacity_logits.sigmoid()

    @property
    def axes(self) -> Tensor:
        """[N, 3, 3] m, body frame: R S, its columns the axes, one sigma long."""
        return quats_to_matrices(self.quats) * self.scales[:, None, :]

    def covariances(self) -> Tensor:
        """[N, 3, 3] m², body frame: R S S^T R^T."""
        return self.axes @ self.axes.transpose(1, 2)

    def tensors(self) -> dict[str, Tensor]:
        """What is stored of each Gaussian, by name; without lobes where the model has none."""
        names = (*TENSORS, "lobes") if self.has_highlights else TENSORS
        return {name: getattr(self, name) for name in names}

    def parameters(self) -> dict[str, Tensor]:
        """All that is optimised, by name: what is stored of each Gaussian, then what all of them share."""
        shared = {"ambient": self.ambient, "psf_sigma_px": self.psf_sigma_px}
        return self.tensors() | shared | ({"gloss": self.gloss} if self.has_highlights else {})

    def matt(self) -> "Gaussians":
        """Return the model without its highlights."""
        return dataclasses.replace(
            self, lobes=self.lobes[:, :0], gloss=self.gloss[:0], static_sun=self.static_sun[:0]
        )

    def select(self, index: Tensor) -> "Gaussians":
        """Return the Gaussians that an index or mask picks."""
        return dataclasses.replace(self, **{name: value[index] for name, value in self.tensors().items()})

    def detach(self) -> "Gaussians":
        return dataclasses.replace(
            self, **{name: value.detach() for name, value in self.parameters().items()}
        )

    def trainable(self) -> "Gaussians":
        """Return the same values as leaves of autograd that collect gradients."""
        leaves = {n: t.detach().clone().requires_grad_() for n, t in self.parameters().items()}
        return dataclasses.replace(self, **leaves)

    def copied(self) -> "Gaussians":
        """Return the same values without gradients, in memory of their own: a training changes its own in place."""
        return self.trainable().detach()

    @staticmethod
    def concatenate(parts: "list[Gaussians]") -> "Gaussians":
        tensors = {name: torch.cat([getattr(p, name) for p in parts]) for name in parts[0].tensors()}
        return dataclasses.replace(parts[0], **tensors)
