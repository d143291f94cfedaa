"""The training loop, readable top to bottom: frames and a method in, Gaussians out."""

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core import hull, obb, sh
from obbgs_core.cameras import Cameras
from obbgs_core.densify import Adam, Growth, grow, keep, outliers, trainable
from obbgs_core.errors import Diverged, ReconstructionError, TooFewFrames
from obbgs_core.gaussians import Gaussians
from obbgs_core.losses import charbonnier, sobel_edge_loss, ssim
from obbgs_core.methods import MethodConfig
from obbgs_core.render import Rendered, render
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
FEWEST_FRAMES = 3
FEWEST_HULL_POINTS = 200
CHI2_MEMORY = 0.98  # of the running chi² a step


@dataclass(frozen=True)
class TrainingFrame:
    """One exposure: dn [H, W, C] float, known exposure time, pose [4, 4] body to camera, K [3, 3] px."""

    dn: Tensor
    exposure_time_s: float
    world_to_camera: Tensor
    K: Tensor
    id: int = 0


@dataclass(frozen=True)
class StepInfo:
    step: int
    steps: int
    loss: float
    psnr_db: float  # of this step's frames, full scale = 1
    chi2: float  # running mean squared normalised residual where the model is; 1 is pure noise
    gaussians: int
    seconds: float


@dataclass
class TrainResult:
    gaussians: Gaussians
    history: list[StepInfo] = field(default_factory=list)
    stop_reason: str = ""
    start: str = ""  # where the first Gaussians came from
    reference_exposure_s: float | None = None  # what every exposure was taken for when exposure is ignored
    removed_outliers: int = 0
    seconds: float = 0.0


def train(
    frames: list[TrainingFrame],
    sensor: Sensor,
    config: MethodConfig,
    seed: int = 0,
    on_step: Callable[[StepInfo], None] = lambda info: None,
    time_limit_s: float = math.inf,
) -> TrainResult:
    """Fit Gaussians to frames.

    The same seed, thread count and machine give the same result bit for bit.

    Raises:
        TooFewFrames: fewer than three frames.
        ReconstructionError: every frame is black, or frames differ in size.
        Diverged: the loss stopped being finite.
    """
    began = time.monotonic()
    rng = torch.Generator().manual_seed(seed)
    frames, reference_exposure_s = _usable(frames, config)
    silhouettes = _silhouettes(frames, sensor)
    radius = hull.radius_m(silhouettes)
    if radius == 0:
        raise ReconstructionError(
            f"all {len(frames)} frames are black (eclipse, or exposures too short): nothing rises above the noise"
        )
    gaussians, start = _start(frames, silhouettes, sensor, radius, config, rng)
    result = TrainResult(gaussians, start=start, reference_exposure_s=reference_exposure_s)
    adam = Adam(gaussians)
    growth = Growth(len(gaussians), config.pixel_weighted)
    batches = _Batches(frames, config, rng)
    chi2, boxes = math.nan, []
    for step in range(config.steps):
        share = step / config.steps
        batch = batches.take(_image_scale(config, share))
        rendered = render(gaussians, batch.cameras)
        loss, residual = _loss(rendered, batch, sensor, config)
        if not torch.isfinite(loss):
            raise Diverged(step, loss.item())
        loss.backward()
        growing = config.grow_from <= share < config.grow_until
        if growing:
            growth.observe(rendered, max(batch.cameras.width, batch.cameras.height) / 2)
            boxes += _worst_boxes(gaussians, rendered, batch, residual, config) if config.obb_interval else []
        adam.step(gaussians, _rates(config, share, radius))
        if growing and (step + 1) % config.grow_interval == 0:
            gaussians = _densify(gaussians, adam, growth.mean(), radius, config, rng)
            growth, boxes = Growth(len(gaussians), config.pixel_weighted), []
        elif growing and boxes and (step + 1) % config.obb_interval == 0:
            gaussians, growth, boxes = _densify_boxes(gaussians, adam, growth, boxes, radius, config, rng)
        if config.opacity_reset_interval and growing and (step + 1) % config.opacity_reset_interval == 0:
            with torch.no_grad():
                gaussians.opacity_logits.clamp_(max=math.log(0.01 / 0.99))
        chi2 = _running_chi2(chi2, rendered, residual)
        info = StepInfo(
            step + 1,
            config.steps,
            loss.item(),
            _psnr_db(rendered, batch, sensor),
            chi2,
            len(gaussians),
            time.monotonic() - began,
        )
        result.history.append(info)
        on_step(info)
        if reason := _stop_reason(info, share, config, time_limit_s):
            result.stop_reason = reason
            break
    if config.outlier_filter:
        stray = outliers(gaussians)
        result.removed_outliers = int(stray.sum())
        gaussians = gaussians.select(torch.nonzero(~stray)[:, 0])
    result.gaussians = gaussians.detach()
    result.seconds = time.monotonic() - began
    return result


@dataclass(frozen=True)
class Batch:
    """The frames of one step at one image scale."""

    cameras: Cameras
    dn: Tensor  # [B, H, W, C]
    exposure_time_s: Tensor  # [B, 1, 1, 1]
    averaged_pixels: int  # sensor pixels in one pixel of dn


class _Batches:
    """Draws frames without replacement, one of each exposure a step when the method asks for it."""

    def __init__(self, frames: list[TrainingFrame], config: MethodConfig, rng: torch.Generator):
        self.rng, self.frames_per_step = rng, config.frames_per_step
        self.levels: dict[float, list[Tensor]] = {}
        self.frames = frames
        groups: dict[float, list[int]] = {}
        for index, frame in enumerate(frames):
            groups.setdefault(frame.exposure_time_s if config.bracket_steps else 0.0, []).append(index)
        if len(groups) == 1 and config.bracket_steps:  # exposure ignored or fixed: any frames make a step
            groups = {0.0: next(iter(groups.values()))}
        self.sequences = [self._endless(members) for members in groups.values()]
        self.turn = 0

    def _endless(self, members: list[int]) -> Iterator[int]:
        while True:
            for position in torch.randperm(len(members), generator=self.rng).tolist():
                yield members[position]

    def take(self, scale: float) -> Batch:
        chosen = []
        for _ in range(min(self.frames_per_step, len(self.frames))):
            chosen.append(next(self.sequences[self.turn % len(self.sequences)]))
            self.turn += 1
        factor = round(1 / scale)
        if scale not in self.levels:
            self.levels[scale] = [_shrunk(f.dn, factor) for f in self.frames]
        dn = torch.stack([self.levels[scale][i] for i in chosen])
        frames = [self.frames[i] for i in chosen]
        height, width = self.frames[0].dn.shape[:2]
        cameras = Cameras(
            torch.stack([f.world_to_camera for f in frames]),
            torch.stack([f.K for f in frames]),
            width,
            height,
        )
        if factor > 1:
            cameras = cameras.scaled(1 / factor)
        exposures = torch.tensor([f.exposure_time_s for f in frames]).view(-1, 1, 1, 1)
        return Batch(cameras, dn, exposures, factor * factor)


def _shrunk(dn: Tensor, factor: int) -> Tensor:
    """Return dn averaged over factor x factor pixels; a block with a saturated pixel stays saturated."""
    if factor == 1:
        return dn
    image = dn.movedim(-1, 0)[None]
    mean = F.avg_pool2d(image, factor, ceil_mode=True)
    largest = F.max_pool2d(image, factor, ceil_mode=True)
    top = image.max()
    return torch.where(largest >= top, largest, mean)[0].movedim(0, -1) if top > 0 else mean[0].movedim(0, -1)


def _usable(frames: list[TrainingFrame], config: MethodConfig) -> tuple[list[TrainingFrame], float | None]:
    """Return the checked frames; with exposure ignored, all take the geometric mean of the exposures."""
    if len(frames) < FEWEST_FRAMES:
        raise TooFewFrames(f"a reconstruction needs at least {FEWEST_FRAMES} frames, got {len(frames)}")
    shapes = {tuple(f.dn.shape) for f in frames}
    if len(shapes) > 1:
        raise ReconstructionError(f"all frames must have one size and channel count, got {sorted(shapes)}")
    for f in frames:
        if not (
            torch.isfinite(f.dn).all() and torch.isfinite(f.world_to_camera).all() and f.exposure_time_s > 0
        ):
            raise ReconstructionError(
                f"frame {f.id} holds a value or a pose that is not finite, or no exposure time"
            )
    if config.exposure_aware:
        return frames, None
    reference_s = math.exp(sum(math.log(f.exposure_time_s) for f in frames) / len(frames))
    return [TrainingFrame(f.dn, reference_s, f.world_to_camera, f.K, f.id) for f in frames], reference_s


def _silhouettes(frames: list[TrainingFrame], sensor: Sensor) -> list[hull.Silhouette]:
    """Return silhouettes of the longest exposures: shadowed faces are brightest there."""
    longest_s = max(f.exposure_time_s for f in frames)
    return [
        hull.silhouette(f.dn, sensor, f.world_to_camera, f.K, dilate_px=1)
        for f in frames
        if f.exposure_time_s > 0.99 * longest_s
    ]


def _start(
    frames: list[TrainingFrame],
    silhouettes: list[hull.Silhouette],
    sensor: Sensor,
    radius: float,
    config: MethodConfig,
    rng: torch.Generator,
) -> tuple[Gaussians, str]:
    """Return the first Gaussians and where they came from: the visual hull, or random when the hull is too thin."""
    if config.start == "hull":
        points, voxel_m = hull.hull_points(silhouettes, radius)
        if len(points) >= FEWEST_HULL_POINTS:
            chosen = torch.randperm(len(points), generator=rng)[: config.start_count]
            points = points[chosen] + (torch.rand(len(chosen), 3, generator=rng) - 0.5) * voxel_m
            return _at(points, frames, sensor, 0.5, config), f"visual hull, {len(chosen)} points"
        log.warning("the silhouettes agree on only %d points; starting at random", len(points))
    points = (2 * torch.rand(config.start_count, 3, generator=rng) - 1) * radius
    return _at(points, frames, sensor, 0.1, config), f"random, {config.start_count} points"


def _at(
    points: Tensor, frames: list[TrainingFrame], sensor: Sensor, opacity: float, config: MethodConfig
) -> Gaussians:
    """Return round Gaussians at points, as wide as their neighbours are far, with the radiance seen there."""
    distances, _ = KDTree(points.numpy()).query(points.numpy(), k=min(4, len(points)))
    spacing = torch.from_numpy(distances).float()[:, 1:].mean(dim=1).clamp(min=1e-6)
    count, channels = len(points), frames[0].dn.shape[2]
    coefficients = torch.zeros(count, (config.sh_degree + 1) ** 2, channels)
    coefficients[:, 0] = sh.from_radiance(_seen_radiance(points, frames, sensor))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    logits = torch.full((count,), math.log(opacity / (1 - opacity)))
    return trainable(Gaussians(points, quats, spacing.log()[:, None].repeat(1, 3), logits, coefficients))


def _seen_radiance(points: Tensor, frames: list[TrainingFrame], sensor: Sensor, most: int = 24) -> Tensor:
    """Return the mean radiance [N, C] that some of the frames show where the points project, occlusion ignored."""
    total, seen = torch.zeros(len(points), frames[0].dn.shape[2]), torch.zeros(len(points), 1)
    for frame in frames[:: max(1, len(frames) // most)]:
        p = points @ frame.world_to_camera[:3, :3].T + frame.world_to_camera[:3, 3]
        z = p[:, 2].clamp(min=1e-6)
        u = (frame.K[0, 0] * p[:, 0] / z + frame.K[0, 2]).long()
        v = (frame.K[1, 1] * p[:, 1] / z + frame.K[1, 2]).long()
        height, width = frame.dn.shape[:2]
        inside = ((p[:, 2] > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height))[:, None]
        signal = frame.dn[v.clamp(0, height - 1), u.clamp(0, width - 1)] - sensor.black_dn
        total += inside * signal.clamp(min=0) / (sensor.dn_per_radiance_s * frame.exposure_time_s)
        seen += inside
    return total / seen.clamp(min=1)


def _image_scale(config: MethodConfig, share: float) -> float:
    return next(scale for start, scale in reversed(config.pyramid) if share >= start)


def _loss(rendered: Rendered, batch: Batch, sensor: Sensor, config: MethodConfig) -> tuple[Tensor, Tensor]:
    """Return the loss and the noise-normalised residual [B, H, W, C] of a step."""
    residual = sensor.normalised_residual(rendered.radiance, batch.exposure_time_s, batch.dn)
    residual = residual * math.sqrt(batch.averaged_pixels)
    predicted = sensor.expected_dn(rendered.radiance, batch.exposure_time_s)
    full_scale = sensor.white_dn - sensor.black_dn
    if config.loss == "likelihood":
        visible, truth = predicted.clamp(max=sensor.white_dn), batch.dn
        loss = charbonnier(residual)
        if config.edge_weight:
            loss = loss + config.edge_weight * sobel_edge_loss(
                sensor.stabilised(visible), sensor.stabilised(truth)
            )
        return loss, residual.detach()
    a, b = (predicted - sensor.black_dn) / full_scale, (batch.dn - sensor.black_dn) / full_scale
    loss = (1 - config.ssim_weight) * (a - b).abs().mean() + config.ssim_weight * (1 - ssim(a, b))
    if config.edge_weight:
        loss = loss + config.edge_weight * sobel_edge_loss(a, b)
    # one sum over the step's frames, as published: the mean times their number
    return loss * len(batch.cameras), residual.detach()


@torch.no_grad()
def _worst_boxes(
    gaussians: Gaussians, rendered: Rendered, batch: Batch, residual: Tensor, config: MethodConfig
) -> list[obb.Obb]:
    """Return the box around the Gaussians behind each frame's worst tile."""
    if config.loss == "likelihood":
        error = residual.abs().mean(dim=-1)
    else:
        error = (
            (rendered.radiance * batch.exposure_time_s - batch.dn / batch.dn.max().clamp(min=1))
            .abs()
            .mean(-1)
        )
    boxes = []
    for i in range(len(batch.cameras)):
        tile = obb.worst_tile(error[i])
        members = obb.behind_tile(
            gaussians.means, rendered.means2d[i], rendered.depth[i], batch.cameras.world_to_camera[i], tile
        )
        if members.sum() >= obb.FEWEST:
            boxes.append(obb.fit(gaussians.means[members], config.obb_mean_centre))
    return boxes


def _rates(config: MethodConfig, share: float, radius: float) -> dict[str, float]:
    means = config.lr_means ** (1 - share) * config.lr_means_end**share * radius
    return {
        "means": means,
        "quats": config.lr_quats,
        "log_scales": config.lr_log_scales,
        "opacity_logits": config.lr_opacity_logits,
        "sh": config.lr_sh,
    }


def _densify(
    gaussians: Gaussians,
    adam: Adam,
    gradient: Tensor,
    radius: float,
    config: MethodConfig,
    rng: torch.Generator,
) -> Gaussians:
    """Grow where screen gradients are large, within the budget; prune what is faint or far too large."""
    gaussians = grow(gaussians, adam, _chosen(gradient, gaussians, config), config.split_over * radius, rng)
    with torch.no_grad():
        wanted = gaussians.opacities > config.prune_opacity
        wanted &= gaussians.scales.max(dim=1).values < config.prune_over * radius
        wanted &= torch.isfinite(gaussians.means).all(dim=1)
    return keep(gaussians, adam, wanted) if wanted.any() else gaussians


def _densify_boxes(
    gaussians: Gaussians,
    adam: Adam,
    growth: Growth,
    boxes: list[obb.Obb],
    radius: float,
    config: MethodConfig,
    rng: torch.Generator,
) -> tuple[Gaussians, Growth, list[obb.Obb]]:
    """Apply the clone/split rule inside the boxes only; what grows starts its gradient record anew."""
    inside = torch.stack([box.contains(gaussians.means.detach()) for box in boxes]).any(dim=0)
    chosen = _chosen(growth.mean(), gaussians, config) & inside
    before = (gaussians.scales.detach().max(dim=1).values > config.split_over * radius) & chosen
    kept = torch.nonzero(~before)[:, 0]
    gradient, weight = growth.gradient[kept], growth.weight[kept]
    gaussians = grow(gaussians, adam, chosen, config.split_over * radius, rng)
    growth = Growth(len(gaussians), config.pixel_weighted)
    growth.gradient[: len(kept)], growth.weight[: len(kept)] = gradient, weight
    return gaussians, growth, []


def _chosen(gradient: Tensor, gaussians: Gaussians, config: MethodConfig) -> Tensor:
    """Return which Gaussians [N] grow: over the threshold, or the given share; never beyond the budget."""
    room = config.max_gaussians - len(gaussians)
    count = int((gradient >= config.grow_grad2d).sum())
    if config.grow_share:
        count = int(config.grow_share * len(gaussians))
    count = max(0, min(count, room, int((gradient > 0).sum())))
    chosen = torch.zeros(len(gaussians), dtype=torch.bool)
    chosen[gradient.topk(count).indices] = True
    return chosen


@torch.no_grad()
def _running_chi2(chi2: float, rendered: Rendered, residual: Tensor) -> float:
    on_target = rendered.alpha > 0.05
    if not on_target.any():
        return chi2
    now = residual[on_target].square().mean().item()
    return now if math.isnan(chi2) else CHI2_MEMORY * chi2 + (1 - CHI2_MEMORY) * now


@torch.no_grad()
def _psnr_db(rendered: Rendered, batch: Batch, sensor: Sensor) -> float:
    predicted = sensor.expected_dn(rendered.radiance, batch.exposure_time_s).clamp(max=sensor.white_dn)
    mse = ((predicted - batch.dn) / sensor.white_dn).square().mean().item()
    return -10 * math.log10(max(mse, 1e-12))


def _stop_reason(info: StepInfo, share: float, config: MethodConfig, time_limit_s: float) -> str:
    if info.seconds >= time_limit_s:
        return f"time limit of {time_limit_s:g} s"
    if config.chi2_end and info.chi2 <= config.chi2_end and share >= config.grow_until:
        return f"residual chi² reached the noise ({info.chi2:.3f})"
    if info.step == info.steps:
        return f"all {info.steps} steps done (residual chi² {info.chi2:.2f})"
    return ""
