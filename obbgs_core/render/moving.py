"""Pictures of a target that moves while the shutter is open: the mean over a few moments of the exposure."""

import dataclasses
import math

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.motions import rigid_motions
from obbgs_core.render.rendered import Rendered, ScreenGradients

# Shares of the exposure, of equal weight, at which polynomials in time up to the third degree have the mean that they
# have over all of it (Chebyshev's quadrature of three points). With a model of TDRS it differs from the mean of many by
# 66 dB of the peak after 2 px and 58 dB after 3 px. Gaussians widened along their way, which cost nothing, would differ
# by 46 and 42 dB: faces of several, one behind the other, become transparent.
MOMENTS = (-math.sqrt(1 / 8), 0.0, math.sqrt(1 / 8))
MIDDLE = MOMENTS.index(0.0)


def at_moments(cameras: Cameras) -> Cameras:
    """Return the cameras [C·3] at each moment, one after the other, with nothing behind the target."""
    assert cameras.motion is not None
    poses = cameras.world_to_camera
    moved = [rigid_motions(share * cameras.motion.to(poses)) @ poses for share in MOMENTS]
    return dataclasses.replace(
        cameras,
        world_to_camera=torch.stack(moved, dim=1).flatten(0, 1),
        K=cameras.K.repeat_interleave(len(MOMENTS), dim=0),
        sun_dir=repeated(cameras.sun_dir),
        background=0.0,
        backdrop=None,
        motion=None,
    )


def repeated(of_cameras: Tensor | None) -> Tensor | None:
    """Return what belongs to each camera [C, ...] for each moment of it [C·3, ...]."""
    return None if of_cameras is None else of_cameras.repeat_interleave(len(MOMENTS), dim=0)


def averaged(rendered: Rendered) -> Rendered:
    """Return what C cameras see of what they see at each moment; depths and places are those of the middle one."""
    of_cameras = {
        name: image.unflatten(0, (-1, len(MOMENTS)))
        for name, image in vars(rendered).items()
        if isinstance(image, Tensor)
    }
    means = {name: of_cameras.pop(name).mean(dim=1) for name in ("radiance", "alpha")}
    middle = {name: image[:, MIDDLE] for name, image in of_cameras.items()}
    return Rendered(**means, **middle, screen=_OfMoments(rendered.screen))


class _OfMoments(ScreenGradients):
    """The screen-space facts of cameras, from those of each moment."""

    def __init__(self, of_moments: ScreenGradients):
        self._of_moments = of_moments

    @property
    def means2d(self) -> dict[int, Tensor]:  # pyright: ignore[reportIncompatibleVariableOverride]
        found: dict[int, Tensor] = {}
        for index, gradient in self._of_moments.means2d.items():
            camera = index // len(MOMENTS)
            found[camera] = found[camera] + gradient if camera in found else gradient
        return found

    @property
    def pixels(self) -> dict[int, Tensor]:  # pyright: ignore[reportIncompatibleVariableOverride]
        of_moments, count = self._of_moments.pixels.items(), len(MOMENTS)
        return {i // count: pixels for i, pixels in of_moments if i % count == MIDDLE}
