"""What training looks at: exposures with their poses, and the few of them that make a step."""

import dataclasses
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.errors import ReconstructionError, TooFewFrames
from obbgs_core.model.cameras import Cameras, stacked_suns
from obbgs_core.model.pose_covariance import flaw
from obbgs_core.train.corrections import ExposureCorrections
from obbgs_core.train.presets import MethodConfig

FEWEST_FRAMES = 3


@dataclass(frozen=True)
class TrainingFrame:
    """One exposure: dn [H, W, C] float, known exposure time, pose [4, 4] body to camera, K [3, 3] px.

    pose_covariance: [6, 6] float64, of the motion that in front of world_to_camera makes the tagged pose the true one:
        rotation vector about the camera's axes (rad), then shift along them (m); None or zeros: the pose is exact.
    sun_dir: [3] towards the Sun, unit, body frame; None: not known.
    """

    dn: Tensor
    exposure_time_s: float
    world_to_camera: Tensor
    K: Tensor
    id: int = 0
    bracket: int | None = None  # frames of one trigger share a pose correction
    pose_covariance: Tensor | None = None
    sun_dir: Tensor | None = None


@dataclass(frozen=True)
class Batch:
    """The frames of one step at one image scale."""

    indices: list[int]  # into the training frames
    cameras: Cameras
    dn: Tensor  # [B, H, W, C]
    exposure_time_s: Tensor  # [B, 1, 1, 1], with what is known of its error
    averaged_pixels: int  # sensor pixels in one pixel of dn
    sky: Tensor | None = None  # [B, H, W] share of each pixel that is seen to be empty, where anyone looked


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
    """Return the cameras of some frames of one size, with their Sun where it is known in all."""
    height, width = frames[0].dn.shape[:2]
    poses, K = torch.stack([f.world_to_camera for f in frames]), torch.stack([f.K for f in frames])
    return Cameras(poses, K, width, height, sun_dir=stacked_suns([f.sun_dir for f in frames]))


def usable(frames: list[TrainingFrame], exposure_aware: bool) -> tuple[list[TrainingFrame], float | None]:
    """Return the checked frames; with exposure ignored, all take the geometric mean of the exposures.

    Raises:
        TooFewFrames: fewer than three.
        ReconstructionError: sizes differ, a value is not finite, or a pose covariance is not a covariance.
    """
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"a reconstruction needs at least {FEWEST_FRAMES} frames, got {len(frames)}")
    shapes = {tuple(f.dn.shape) for f in frames}
    if len(shapes) > 1:
        raise ReconstructionError(f"all frames must have one size and channel count, got {sorted(shapes)}")
    for f in frames:
        finite = torch.isfinite(f.dn).all() and torch.isfinite(f.world_to_camera).all()
        if f.sun_dir is not None and not abs(float(f.sun_dir.norm()) - 1) < 1e-3:
            raise ReconstructionError(
                f"frame {f.id} has {f.sun_dir.tolist()} for the Sun's direction, expected a unit vector; leave it out"
            )
        if not (finite and torch.isfinite(f.K).all() and 0 < f.exposure_time_s < math.inf):
            raise ReconstructionError(
                f"frame {f.id} holds a value or a pose that is not finite, or no exposure time; leave it out"
            )
        if f.pose_covariance is not None and (fault := flaw(f.pose_covariance)):
            raise ReconstructionError(
                f"frame {f.id} has a pose covariance that {fault}, expected a symmetric [6, 6] without negative "
                "eigenvalues; leave the frame out, or send zeros if its pose is exact"
            )
    if exposure_aware:
        return frames, None
    reference_s = mean_exposure_s(frames)
    return [dataclasses.replace(f, exposure_time_s=reference_s) for f in frames], reference_s


def bracket_numbers(frames: list[TrainingFrame]) -> list[int]:
    """Return the bracket of each frame, counted from 0; a frame that names none is one by itself."""
    numbers: dict[int, int] = {}
    keys = [f.id if f.bracket is None else -1 - f.bracket for f in frames]
    return [numbers.setdefault(key, len(numbers)) for key in keys]


class Batches:
    """Draws frames without replacement, one of each exposure in turn when the method asks for brackets.

    white_dn: the sensor's full scale.
    sky: where some of the frames, by index, surely show nothing [H, W] bool.
    exposures: what the tags' exposure times are corrected by, where the method allows them an error.
    """

    def __init__(
        self,
        frames: list[TrainingFrame],
        white_dn: float,
        config: MethodConfig,
        rng: torch.Generator,
        sky: dict[int, Tensor] | None = None,
    ):
        self.frames, self.white_dn, self.rng = frames, white_dn, rng
        self.frames_per_step = min(config.frames_per_step, len(frames))
        self.by_exposure = config.bracket_steps
        self.turn = 0
        doubted = config.exposure_aware and config.exposure_sigma > 0
        self.exposures = ExposureCorrections(len(frames), config.exposure_sigma) if doubted else None
        self.hold_out([])
        self.sky = sky or {}
        self.levels: dict[int, list[Tensor]] = {}
        self.sky_levels: dict[int, list[Tensor]] = {}

    def hold_out(self, brackets: list[list[int]]) -> None:
        """From now on draw from all frames but those of these brackets."""
        self.held_out = brackets
        left_out = {index for bracket in brackets for index in bracket}
        groups: dict[float, list[int]] = {}
        for index, frame in enumerate(self.frames):
            if index not in left_out:
                groups.setdefault(frame.exposure_time_s if self.by_exposure else 0.0, []).append(index)
        self.groups = list(groups.values())
        self.waiting: list[list[int]] = [[] for _ in self.groups]

    def state(self) -> dict:
        exposures = self.exposures.state() if self.exposures is not None else None
        waiting = [list(w) for w in self.waiting]
        return {"held_out": self.held_out, "waiting": waiting, "turn": self.turn, "exposures": exposures}

    def restore(self, state: dict) -> None:
        self.hold_out(state["held_out"])
        self.waiting, self.turn = [list(w) for w in state["waiting"]], state["turn"]
        if self.exposures is not None:
            self.exposures.restore(state["exposures"])

    def take(self, scale: float) -> Batch:
        """Return the next frames, averaged to `scale` (1/whole number) of their size."""
        chosen = []
        for _ in range(self.frames_per_step):
            group = self.turn % len(self.groups)
            if not self.waiting[group]:
                members = self.groups[group]
                order = torch.randperm(len(members), generator=self.rng).tolist()
                self.waiting[group] = [members[i] for i in order]
            chosen.append(self.waiting[group].pop())
            self.turn += 1
        return self.batch(chosen, scale)

    def batch(self, indices: list[int], scale: float) -> Batch:
        """Return given frames at a scale."""
        factor = round(1 / scale)
        if factor not in self.levels:
            self.levels[factor] = [_shrunk(f.dn, factor, self.white_dn) for f in self.frames]
            self.sky_levels[factor] = self._sky_shares(factor)
        frames = [self.frames[i] for i in indices]
        cameras = cameras_of(frames)
        exposure_time_s = torch.tensor([f.exposure_time_s for f in frames]).view(-1, 1, 1, 1)
        if self.exposures is not None:
            exposure_time_s = exposure_time_s * self.exposures.factors(indices)
        return Batch(
            indices,
            cameras.scaled(1 / factor) if factor > 1 else cameras,
            torch.stack([self.levels[factor][i] for i in indices]),
            exposure_time_s,
            factor * factor,
            torch.stack([self.sky_levels[factor][i] for i in indices]) if self.sky else None,
        )

    def _sky_shares(self, factor: int) -> list[Tensor]:
        """Return each frame's share of empty sky [H, W], one tensor of zeros for all where nobody looked."""
        nobody_looked = torch.zeros(self.levels[factor][0].shape[:2])
        shares = {
            i: F.avg_pool2d(sky[None].float(), factor, ceil_mode=True)[0] for i, sky in self.sky.items()
        }
        return [shares.get(i, nobody_looked) for i in range(len(self.frames))]


def _shrunk(dn: Tensor, factor: int, white_dn: float) -> Tensor:
    """Return dn averaged over factor x factor pixels; a block with a pixel at full scale is at full scale."""
    if factor == 1:
        return dn
    image = dn.movedim(-1, 0)[None]
    mean = F.avg_pool2d(image, factor, ceil_mode=True)
    largest = F.max_pool2d(image, factor, ceil_mode=True)
    return torch.where(largest >= white_dn, largest, mean)[0].movedim(0, -1)
