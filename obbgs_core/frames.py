"""The input of a training: exposures with their poses, checked, and figures of all of them together."""

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import SupportsFloat, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_base.physics.navigation_errors import SharedParameters
from obbgs_core.compact import Compact, changed, hold_compact, part, seen
from obbgs_core.compiled import each
from obbgs_core.errors import ReconstructionError, TooFewFrames, expect
from obbgs_core.model.cameras import Cameras, stacked_suns
from obbgs_core.model.motions import point_flow
from obbgs_core.model.pose_covariance import flaw

VIEW_MARGIN = 0.15  # of the image's width and height: what lies as far outside still counts as in view
FEWEST_FRAMES = 3
ROTATION_TOLERANCE = 1e-3  # of R Rᵀ from 1, single precision and printed numbers included
K_TOLERANCE_PX = 1e-3
READING_TOLERANCE = 1e-6
TENSORS = ("world_to_camera", "K", "pose_covariance", "sun_dir", "inertial_to_body", "earth_m", "rates")


@dataclass(frozen=True, eq=False)
class Navigation:
    """What the pose tags of one pass share: how far its common parameters may err, and the motion that they assume.

    The fields but the first are those of `obbgs_base.physics.navigation_errors.NominalMotion`.
    """

    sigmas: SharedParameters  # deviations; 0: exact
    mean_motion_rad_s: float = 0.0
    inertial_to_rtn: np.ndarray = field(default_factory=lambda: np.eye(3))
    rate_rad_s: np.ndarray = field(default_factory=lambda: np.zeros(3))
    inertia: np.ndarray = field(default_factory=lambda: np.ones(3))
    rate_steps: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    def tree(self) -> dict:
        """Return everything as numbers and lists; without steps as before there were any, so that checkpoints go on."""
        motion = (self.inertial_to_rtn, self.rate_rad_s, self.inertia, self.rate_steps)
        return {
            "sigmas": self.sigmas.lists(),
            "orbit": [self.mean_motion_rad_s, *(m.tolist() for m in motion if m.size)],
        }


@dataclass(frozen=True)
class TrainingFrame:
    """One exposure: dn [H, W, C] float, known exposure time, pose [4, 4] body to camera, K [3, 3] px.

    The origin of the body's axes lies in the target, or not much farther from it than its size.

    pose_covariance: [6, 6] float64, of the motion that in front of world_to_camera makes the tagged pose the true one:
        rotation vector about the camera's axes (rad) and shift along them (m), as in `model.motions`; None or zeros:
        the pose is exact but for what the navigation's parameters change.
    sun_dir: [3] towards the Sun, unit, body frame; None: not known.
    background: radiance of what is seen where the target is not, the same in all frames of a training; space is black.
    psf_sigma_px: of the optics, as in `Cameras`, the same in all frames; None: not calibrated, a method whose footprint
        is the camera's learns it.
    navigation: errors that all frames of the pass share, the same in all of them; None: there are none.
    earth_m: [3] m, from the camera to the Earth's centre, in the camera's axes; None: it is not in the picture, or not
        known.
    rates: [6] how the target moves in front of the camera: rad/s about the camera's axes, m/s along them, so that long
        exposures are blurred; None: it stands still, or moves by less than shows.
    time_s: since the navigation's epoch; inertial_to_body: [3, 3] float64, the attitude that the pose assumes; None:
        the body's axes are inertial. Only the navigation needs them.
    """

    dn: Tensor
    exposure_time_s: float
    world_to_camera: Tensor
    K: Tensor
    id: int = 0  # names the frame in messages; where ids are not unique, its place in the list does
    bracket: int | None = None  # frames of one trigger; they share a pose correction
    own_pose: bool = False  # it does not: it was taken so long before or after that its pose errs by itself
    pose_covariance: Tensor | None = None
    sun_dir: Tensor | None = None
    background: float = 0.0
    psf_sigma_px: float | None = None
    navigation: Navigation | None = None
    time_s: float = 0.0
    inertial_to_body: Tensor | None = None
    earth_m: Tensor | None = None
    rates: Tensor | None = None

    def __repr__(self) -> str:
        height, width, channels = self.shape
        bracket = "" if self.bracket is None else f" of bracket {self.bracket}"
        return (
            f"<frame {self.id}{bracket}: {width}x{height} pixels, {channels} channel{'s' * (channels > 1)}, "
            f"{1e3 * self.exposure_time_s:g} ms>"
        )

    @property
    def shape(self) -> torch.Size:
        """Of dn, [H, W, C]."""
        return self.__dict__["_dn"].shape

    @property
    def is_compact(self) -> bool:
        """Whether dn is held in little memory, so that reading it takes time."""
        return isinstance(self.__dict__["_dn"], Compact)

    @property
    def moved_px(self) -> float:
        """How far a target that fills the picture moves in it while the shutter is open, at most, px."""
        if self.rates is None:
            return 0.0
        K, centre = self.K.double(), self.world_to_camera[:3, 3].double()
        height, width = self.shape[:2]
        sides = torch.stack([width / K[0, 0], height / K[1, 1]])
        half = torch.cat([sides, sides.min()[None]]) / 2
        points = centre + centre[2] * torch.cat([half.diag(), -half.diag(), torch.zeros(1, 3)])
        points = points[points[:, 2] > 0]
        way = point_flow(points, K.expand(len(points), 3, 3)) @ self.rates.double() * self.exposure_time_s
        return float(way.norm(dim=1).max()) if len(points) else 0.0

    def part(self, rows: slice, columns: slice) -> Tensor:
        """Return some rows and columns of dn [h, w, C]."""
        return part(self.__dict__["_dn"], rows, columns)

    def with_readings(self, at: Tensor, dn: Tensor) -> "TrainingFrame":
        """Return the frame with other readings dn [N, C] at the pixels `at` [H, W] bool; the others are held once."""
        return dataclasses.replace(self, dn=cast(Tensor, changed(self.__dict__["_dn"], at, dn)))

    def seen(self, look: Callable[[Tensor], Tensor], reach_px: int) -> Tensor:
        """Return what `look` says of each pixel of dn by those within `reach_px` of it, see `compact.seen`."""
        return seen(look, self.__dict__["_dn"], reach_px)


# 360 pictures of 12 megapixels take 18 GB in single precision
hold_compact(TrainingFrame, ["dn"])


def sun_span_deg(frames: list[TrainingFrame]) -> float:
    """Return the largest angle between the Sun's directions in two frames; 0 where it is not known in all."""
    directions = stacked_suns([f.sun_dir for f in frames])
    if directions is None:
        return 0.0
    directions = directions.double()
    return math.degrees(torch.cdist(directions, directions).max().div(2).clamp(max=1).asin().mul(2).item())


def mean_exposure_s(frames: list[TrainingFrame]) -> float:
    """Return the geometric mean of the frames' exposure times, s."""
    return math.exp(sum(math.log(f.exposure_time_s) for f in frames) / len(frames))


def camera_extent_m(frames: list[TrainingFrame]) -> float:
    """Return 1.1 times the largest distance of a camera from the mean of all: the length unit of 3DGS (Kerbl 2023)."""
    poses = torch.stack([f.world_to_camera for f in frames]).double()
    centres = -(poses[:, :3, :3].transpose(1, 2) @ poses[:, :3, 3:])[..., 0]
    return 1.1 * (centres - centres.mean(dim=0)).norm(dim=1).max().item()


def cameras_of(frames: list[TrainingFrame]) -> Cameras:
    """Return the cameras of some frames of one size and background, with their Sun where it is known in all."""
    height, width = frames[0].shape[:2]
    poses, K = torch.stack([f.world_to_camera for f in frames]), torch.stack([f.K for f in frames])
    suns, psf_sigma_px = stacked_suns([f.sun_dir for f in frames]), frames[0].psf_sigma_px
    motion = None
    if any(f.rates is not None for f in frames):
        still = torch.zeros(6)
        motion = torch.stack([still if f.rates is None else f.rates * f.exposure_time_s for f in frames])
    return Cameras(
        *(poses, K, width, height),
        sun_dir=suns,
        psf_sigma_px=psf_sigma_px,
        background=frames[0].background,
        motion=motion,
    )


@torch.no_grad()
def sampling_rates(means: Tensor, frames: list[TrainingFrame]) -> Tensor:
    """Return how finely pictures sample points [N, 3] m: pixels for a metre [N] where each point is seen largest.

    That is the largest focal length over depth of the frames that have it in view; 0 where none has.
    """
    rate = torch.zeros(len(means))
    for frame in frames:
        height, width = frame.shape[:2]
        x, y, z = (means @ frame.world_to_camera[:3, :3].T + frame.world_to_camera[:3, 3]).unbind(dim=1)
        depth = z.clamp(min=1e-6)
        u = frame.K[0, 0] * x / depth + frame.K[0, 2]
        v = frame.K[1, 1] * y / depth + frame.K[1, 2]
        in_view = (z > 1e-6) & ((u / width - 0.5).abs() <= 0.5 + VIEW_MARGIN)
        in_view &= (v / height - 0.5).abs() <= 0.5 + VIEW_MARGIN
        rate = torch.where(in_view, torch.maximum(rate, frame.K[0, 0] / depth), rate)
    return rate


def alike(frames: list[TrainingFrame]) -> list[TrainingFrame]:
    """Return the frames of a pass with the target's rotation as the last ones state it.

    It is told by the attitudes of the frames that were there when a frame came.
    """
    last = frames[-1].navigation if frames else None
    if last is None:
        return frames
    rotation = {name: getattr(last, name) for name in ("rate_rad_s", "inertia", "rate_steps")}
    return [
        dataclasses.replace(f, navigation=dataclasses.replace(f.navigation, **rotation))
        if f.navigation is not None and f.navigation is not last
        else f
        for f in frames
    ]


def given(frames: Iterable[TrainingFrame]) -> list[TrainingFrame]:
    """Return the frames as a list, the types of what is in them checked; `usable` checks the values.

    Raises:
        ValueError: something is no frame, or what a frame holds is no tensor where `TrainingFrame` wants one.
    """
    expect(frames, Iterable, "frames", "a list of TrainingFrame")
    frames = list(frames)
    for position, frame in enumerate(frames):
        expect(frame, TrainingFrame, f"frames[{position}]", "a TrainingFrame")
        expect(frame.exposure_time_s, SupportsFloat, f"frame {frame.id}: exposure_time_s", "seconds")
        for name in TENSORS:
            value = getattr(frame, name)
            if value is not None or name in ("world_to_camera", "K"):
                expect(value, Tensor, f"frame {frame.id}: {name}", "a torch.Tensor")
    return frames


def usable(
    frames: list[TrainingFrame], exposure_aware: bool, white_dn: float = math.inf
) -> tuple[list[TrainingFrame], float | None]:
    """Return the checked frames, in single precision; if exposure is ignored, all take the exposures' geometric mean.

    Args:
        white_dn: the largest reading that the sensor gives.

    Raises:
        TooFewFrames: fewer than three.
        ReconstructionError: a shape is not that of `TrainingFrame` or a picture smaller than 3x3 pixels; sizes or
            backgrounds differ, a value is not finite, a reading is above `white_dn`, a pose is not a rotation with a
            translation, K is not a pinhole matrix without skew, or a pose covariance is not a covariance.
    """
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"a reconstruction needs at least {FEWEST_FRAMES} frames, got {len(frames)}")
    frames = [
        dataclasses.replace(f, **{name: _single(getattr(f, name)) for name in ("dn", "world_to_camera", "K")})
        for f in frames
    ]
    if len({f.id for f in frames}) < len(frames):  # ids that name no frame: places in the list do
        frames = [dataclasses.replace(f, id=position) for position, f in enumerate(frames)]
    for f in frames:
        if len(f.shape) != 3 or f.shape[2] not in (1, 3) or min(f.shape[:2]) < 3:
            raise ReconstructionError(
                f"frame {f.id}: expected a picture [H, W, 1 or 3] of at least 3x3 pixels, got {list(f.shape)}"
            )
        if f.world_to_camera.shape != (4, 4) or f.K.shape != (3, 3):
            shapes = f"{list(f.world_to_camera.shape)} and {list(f.K.shape)}"
            raise ReconstructionError(
                f"frame {f.id}: expected world_to_camera [4, 4] and K [3, 3], got {shapes}"
            )
    shapes = {tuple(f.shape) for f in frames}
    if len(shapes) > 1:
        raise ReconstructionError(f"all frames must have one size and channel count, got {sorted(shapes)}")
    backgrounds = sorted({f.background for f in frames})
    if len(backgrounds) > 1 or not 0 <= backgrounds[0] < math.inf:
        raise ReconstructionError(
            f"all frames must have one background radiance of at least 0, got {', '.join(map(str, backgrounds))}"
        )
    spreads = {f.psf_sigma_px for f in frames}
    if len(spreads) > 1:
        raise ReconstructionError(
            f"all frames must have one psf_sigma_px, that of their camera, got {sorted(map(str, spreads))}"
        )
    stated = {repr(f.navigation and f.navigation.tree()) for f in frames}
    if len(stated) > 1:
        raise ReconstructionError(
            f"all frames must state the same navigation, that of one pass, got {len(stated)}"
        )
    for _ in each(lambda f: _check_values(f, white_dn), frames):
        pass
    if exposure_aware:
        return frames, None
    reference_s = mean_exposure_s(frames)
    return [dataclasses.replace(f, exposure_time_s=reference_s) for f in frames], reference_s


def _check_values(f: TrainingFrame, white_dn: float) -> None:
    """Refuse a frame with values that none can have.

    Raises:
        ReconstructionError: see `usable`.
    """
    finite = torch.isfinite(f.dn).all() and torch.isfinite(f.world_to_camera).all()
    if f.sun_dir is not None and not abs(float(f.sun_dir.norm()) - 1) < 1e-3:
        raise ReconstructionError(
            f"frame {f.id} has {f.sun_dir.tolist()} for the Sun's direction, expected a unit vector; leave it out"
        )
    if not (finite and torch.isfinite(f.K).all() and 0 < f.exposure_time_s < math.inf):
        raise ReconstructionError(
            f"frame {f.id} holds a value or a pose that is not finite, or no exposure time; leave it out"
        )
    if fault := _pinhole_fault(f, white_dn):
        raise ReconstructionError(f"frame {f.id}: {fault}")
    if f.pose_covariance is not None and (fault := flaw(f.pose_covariance)):
        raise ReconstructionError(
            f"frame {f.id} has a pose covariance that {fault}, expected a symmetric [6, 6] without negative "
            "eigenvalues; leave the frame out, or send zeros if its pose is exact"
        )


def _pinhole_fault(frame: TrainingFrame, white_dn: float) -> str | None:
    """Return what of a frame no pinhole camera and sensor can have, and what to do; None if all is well."""
    rotation, K = frame.world_to_camera[:3, :3].double(), frame.K.double()
    size = torch.linalg.det(rotation).item()
    if (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max() > ROTATION_TOLERANCE:
        return (
            "world_to_camera [:3, :3] must be a rotation, but its rows are not orthonormal (determinant "
            f"{size:.4g}); take a scale out of the pose"
        )
    if size < 0:
        return "world_to_camera is mirrored (determinant -1), expected a rotation; flip one axis of the pose"
    if not torch.equal(frame.world_to_camera[3].double(), torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)):
        return f"the last row of world_to_camera must be 0 0 0 1, got {frame.world_to_camera[3].tolist()}"
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        return (
            f"the focal lengths must be positive, got {K[0, 0]:.4g} and {K[1, 1]:.4g} px; OpenGL's y axis points up: "
            "turn the pose's y and z axes over instead"
        )
    below = torch.stack([K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1]).abs().max().item()
    if below > K_TOLERANCE_PX or abs(K[0, 1]) > K_TOLERANCE_PX:
        return (
            f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}; a picture with skew must be warped to "
            "one without, which `ground import` does"
        )
    highest = frame.dn.max().item()
    if highest > white_dn * (1 + READING_TOLERANCE):
        return (
            f"it has readings of {highest:.6g} DN, above the sensor's white_dn of {white_dn:.6g}; 12 bits that are "
            "shifted into 16 must be shifted back, or white_dn be that of the readings"
        )
    return None


def _single(values: Tensor) -> Tensor:
    return values.detach().float() if values.requires_grad or values.dtype != torch.float32 else values


def bracket_numbers(frames: list[TrainingFrame]) -> list[int]:
    """Return the bracket of each frame, counted from 0; a frame that names none is one by itself, whatever its id."""
    numbers: dict[int, int] = {}
    keys = [-1 - position if f.bracket is None else f.bracket for position, f in enumerate(frames)]
    return [numbers.setdefault(key, len(numbers)) for key in keys]


def pose_numbers(frames: list[TrainingFrame]) -> list[int]:
    """Return which pose correction each frame has, counted from 0: its bracket's, or its own."""
    return bracket_numbers([dataclasses.replace(f, bracket=None) if f.own_pose else f for f in frames])


def averaged(dn: Tensor, factor: int, white_dn: float) -> Tensor:
    """Return dn [H, W, C] averaged over blocks of factor x factor pixels, those at the right and bottom edge smaller.

    A block with a pixel at full scale is at full scale, because the mean of its true signals is not known.
    """
    if factor == 1:
        return dn
    image = dn.movedim(-1, 0)[None]
    mean = F.avg_pool2d(image, factor, ceil_mode=True)
    if dn.max() >= white_dn:
        largest = F.max_pool2d(image, factor, ceil_mode=True)
        mean = torch.where(largest >= white_dn, largest, mean)
    return mean[0].movedim(0, -1)
