"""Pinhole cameras: OpenCV axes, pixel centres at +0.5."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """C cameras of one image size; world_to_camera [C, 4, 4] (may carry a gradient), K [C, 3, 3] px.

    sun_dir [C, 3] (no gradient): towards the Sun when each picture is taken, unit, body frame; only models whose
    radiance turns with the Sun need it.
    psf_sigma_px: standard deviation of the optics' point spread, in pixels of the sensor; None: not calibrated, the
    model's own estimate is used. Only models whose footprint is the camera's need it.
    scale: pixels of these images for one of the sensor, along a side; below 1 where pixels were averaged.
    background: radiance, the same in all channels, of what is seen where no Gaussian is; space is black.
    backdrop: [C, H, W, channels] (no gradient), what is added to that in each picture; None: nothing.
    motion: [C, 6] (no gradient), how the target moves while the shutter is open: a rotation vector about the camera's
        axes (rad) and a shift along them (m), half before the moment of the pose and half after; None: it stands still.
    """

    world_to_camera: Tensor
    K: Tensor
    width: int
    height: int
    near_m: float = 0.01
    sun_dir: Tensor | None = None
    psf_sigma_px: float | None = None
    scale: float = 1.0
    background: float = 0.0
    backdrop: Tensor | None = None
    motion: Tensor | None = None

    def __post_init__(self):
        count = self.world_to_camera.shape[0]
        for name, shape in (
            ("world_to_camera", (count, 4, 4)),
            ("K", (count, 3, 3)),
            ("sun_dir", (count, 3)),
            ("motion", (count, 6)),
        ):
            value = getattr(self, name)
            if value is not None and tuple(value.shape) != shape:
                raise ValueError(f"{name} must be {list(shape)}, got {list(value.shape)}")
        if self.width < 1 or self.height < 1 or not self.near_m > 0:
            raise ValueError(
                f"width, height and near_m must be positive: {self.width}, {self.height}, {self.near_m}"
            )
        if not 0 <= self.background < math.inf:
            raise ValueError(f"background must be a radiance of at least 0, got {self.background}")
        pictures = (count, self.height, self.width)
        if self.backdrop is not None and tuple(self.backdrop.shape[:3]) != pictures:
            raise ValueError(f"backdrop must be {[*pictures, 'C']}, got {list(self.backdrop.shape)}")

    def __len__(self) -> int:
        return self.world_to_camera.shape[0]

    def __repr__(self) -> str:
        return f"<{len(self)} camera{'s' * (len(self) != 1)} of {self.width}x{self.height} pixels>"

    @property
    def centres(self) -> Tensor:
        """Camera centres [C, 3], m, body frame."""
        R, t = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3:]
        return -(R.transpose(1, 2) @ t)[..., 0]

    @property
    def behind(self) -> Tensor:
        """Radiance of what is seen where no Gaussian is: a number [], or [C, H, W, channels]."""
        return self.background + (torch.zeros(()) if self.backdrop is None else self.backdrop)

    def known_suns(self) -> Tensor:
        """Return sun_dir.

        Raises:
            ValueError: it is not given.
        """
        if self.sun_dir is None:
            raise ValueError(
                "the model's radiance turns with the Sun: give Cameras(sun_dir=[C, 3]), body frame"
            )
        return self.sun_dir

    def one(self, index: int) -> "Cameras":
        """Return one of the cameras, still of shape [1, ...]."""
        sun_dir = None if self.sun_dir is None else self.sun_dir[index : index + 1]
        backdrop = None if self.backdrop is None else self.backdrop[index : index + 1]
        motion = None if self.motion is None else self.motion[index : index + 1]
        pose, K = self.world_to_camera[index : index + 1], self.K[index : index + 1]
        return dataclasses.replace(
            self, world_to_camera=pose, K=K, sun_dir=sun_dir, backdrop=backdrop, motion=motion
        )

    def scaled(self, factor: float) -> "Cameras":
        """Return the cameras of images resized by `factor` (0.5: half as wide and high, rounded up).

        They have no backdrop.
        """
        K = self.K * torch.tensor([[factor], [factor], [1.0]], dtype=self.K.dtype, device=self.K.device)
        width, height = -int(-self.width * factor // 1), -int(-self.height * factor // 1)
        scale = self.scale * factor
        return dataclasses.replace(self, K=K, width=width, height=height, scale=scale, backdrop=None)


def stacked_suns(directions: Sequence[Tensor | None]) -> Tensor | None:
    """Return the Sun's directions of some cameras as one [C, 3], or nothing where one of them is not known."""
    known = [direction for direction in directions if direction is not None]
    return torch.stack(known) if known and len(known) == len(directions) else None
