"""Where Gaussians are added, and which are removed because they are faint: decided by the screen gradients of steps."""

import dataclasses
import logging
import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.batches import Batches
from obbgs_core.evidence.budget import as_many_again, fewer, log_errors
from obbgs_core.evidence.poses import validation_brackets
from obbgs_core.methods.config import GrowthSettings, MethodConfig, Moment
from obbgs_core.model import obb
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.published import mcmc
from obbgs_core.published.growth import (
    GRADIENT_THRESHOLD,
    SPLIT_SIZE,
    grow,
    near_camera_weight,
    reset_opacities,
)
from obbgs_core.published.multi_view import crossing_boxes, inside, threshold_factor
from obbgs_core.published.smoothing import log_lowering
from obbgs_core.render import Rendered
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.parts import Change, Now, Seen
from obbgs_core.train.setup import TrainingSetup

# of the deviation along the longest axis: where the centres of the two Gaussians of a split along it lie. 0.6 is worse
# (docs/experiments/043).
LONG_AXIS_SHIFT = 0.8
MOST_TIMES = 2  # that growth is prolonged: a training is half as long again at most
log = logging.getLogger(__name__)


@dataclass
class Growth:
    """Running sums of each Gaussian's screen-space gradient since the last densification, and the boxes to grow in.

    gradient: [N] sum of gradient norms, weighted; weight: [N] sum of the weights: a view counts by the pixels that the
        Gaussian covers in it (Pixel-GS), or as one (3DGS).
    boxes: around the Gaussians behind the worst tiles since the last growth inside them.
    """

    gradient: Tensor
    weight: Tensor
    boxes: list[obb.Obb] = field(default_factory=list)

    @staticmethod
    def of(count: int) -> "Growth":
        """Return records of `count` Gaussians that have not been seen yet."""
        return Growth(torch.zeros(count), torch.zeros(count))

    @staticmethod
    def is_recorded(config: MethodConfig, moment: Moment) -> bool:
        """Return whether screen gradients are recorded in a step."""
        begin = 0.0 if config.published.recorded_from_start else config.growth.begin
        return begin <= moment.share < config.growth.end

    @staticmethod
    def is_growing(config: MethodConfig, moment: Moment) -> bool:
        """Return whether Gaussians are added around a step."""
        return config.growth.begin <= moment.share < config.growth.end

    @torch.no_grad()
    def observe(self, setup: TrainingSetup, gaussians: Gaussians, seen: Seen, moment: Moment) -> None:
        """Record the screen gradients of a step, and the boxes behind each frame's worst tile."""
        config, cameras, depth_weight = setup.config, seen.batch.cameras, None
        if not self.is_recorded(config, moment):
            return
        if config.published.depth_scale:
            near_m = config.published.depth_scale * setup.unit_m
            depth_weight = near_camera_weight(gaussians.means, cameras, near_m)
        height, width = setup.frames[0].shape[:2]  # half of it is the unit of the published threshold
        half_x_px, half_y_px = 0.5 * cameras.scale * width, 0.5 * cameras.scale * height
        if config.growth.grown_share:  # ranks by the gradient itself
            half_x_px = half_y_px = max(half_x_px, half_y_px)
        self.add(seen.rendered, (half_x_px, half_y_px), config.published.pixel_weighted, depth_weight)
        if config.growth.obb_interval and self.is_growing(config, moment):
            self.boxes += worst_boxes(gaussians, seen.rendered, cameras, seen.residual)

    @torch.no_grad()
    def add(
        self,
        rendered: Rendered,
        half_size_px: tuple[float, float],
        pixel_weighted: bool,
        depth_weight: Tensor | None = None,
    ) -> None:
        """Add one step's gradients.

        Args:
            half_size_px: the units of the gradients along x and y.
            pixel_weighted: whether a view counts by the pixels that the Gaussian covers in it, or as one where the
                circle of its radius reaches the image.
            depth_weight: [C, N] factor on the gradients of each camera's Gaussians.
        """
        half_x_px, half_y_px = half_size_px
        for camera, gradient in rendered.screen.means2d.items():
            weight = rendered.screen.pixels[camera] if pixel_weighted else in_view(rendered, camera).float()
            if half_x_px == half_y_px:
                size = gradient.norm(dim=-1) * half_x_px
            else:
                size = (gradient * torch.tensor(half_size_px)).norm(dim=-1)
            if depth_weight is not None:
                size = size * depth_weight[camera]
            self.gradient += size * weight
            self.weight += weight

    def mean(self) -> Tensor:
        """Return each Gaussian's mean gradient [N]."""
        return self.gradient / self.weight.clamp(min=1e-9)

    def follow(self, change: Change) -> None:
        """Keep the records of the Gaussians that a change keeps, where they go on; those of others are empty."""
        if change.kept is None:
            return
        if not change.goes_on:
            self.gradient, self.weight, self.boxes = *(torch.zeros(len(change.model)) for _ in range(2)), []
            return
        empty = torch.zeros(change.added)
        self.gradient = torch.cat([self.gradient[change.kept], empty])
        self.weight = torch.cat([self.weight[change.kept], empty])

    def due(self, now: Now) -> bool:
        """Return whether Gaussians are added after this step: everywhere, or between two such times in the boxes."""
        settings, step = now.config.growth, now.moment.step
        in_boxes = bool(self.boxes) and step % settings.obb_interval == 0
        return self.is_growing(now.config, now.moment) and (step % settings.interval == 0 or in_boxes)

    def decide(self, now: Now) -> Change:
        """Return the model with more Gaussians where gradients are large, within the budget.

        Where it grows everywhere, what is faint or too large is removed as well, and all records begin anew.
        """
        if now.moment.step % now.config.growth.interval == 0:
            return self._everywhere(now)
        means = now.gaussians.means.detach()
        boxed = torch.stack([box.contains(means) for box in self.boxes]).any(dim=0)
        self.boxes = []
        growing = chosen(self.mean(), len(means), now.config.growth) & boxed
        return dataclasses.replace(_grown(now, growing), goes_on=True)

    def _everywhere(self, now: Now) -> Change:
        if now.config.published.growth == "sampled":
            return Change(*mcmc.relocated(now.gaussians.detach(), now.config.growth.max_gaussians, now.rng))
        gaussians, settings, published = now.gaussians, now.config.growth, now.config.published
        crossed, threshold = None, GRADIENT_THRESHOLD
        if published.multi_view:
            cameras = now.seen.batch.cameras
            crossed = inside(gaussians.means.detach(), crossing_boxes(cameras, now.seen.residual))
            threshold *= threshold_factor(cameras)
        growing = chosen(self.mean(), len(gaussians), settings, threshold)
        if crossed is not None:
            room = settings.max_gaussians - len(gaussians) - int(growing.sum())
            crossed = crossed & ~growing
            crossed &= crossed.cumsum(dim=0) <= room
        change = _grown(now, growing, crossed)
        model = change.model
        wanted = model.opacities > settings.prune_opacity
        if now.moment.share >= published.prune_size_from:
            wanted &= model.scales.max(dim=1).values < published.prune_size * now.setup.unit_m
        wanted &= finite(model)
        return change.then_only(wanted) if wanted.any() else change


@dataclass
class Extension:
    """Lets growth go on beyond the budget where frames could pay for more Gaussians, while held-out brackets gain.

    The budget follows edges (docs/experiments/084); a body with texture all over shows more. Whether it is one is seen
    when growth ends. From then on the validation brackets are kept back, and growth goes on while they surely gain.

    times: that growth was prolonged.
    errors: of the brackets kept back, when it last was; None: it never was.
    reason: why growth went on or ended, in words; nothing: within the budget.
    """

    times: int = 0
    errors: Tensor | None = None
    reason: str = ""

    def back(self, config: MethodConfig) -> int:
        """Return the steps that count as done where growth is prolonged, by as many as it takes to double a model."""
        steps = math.ceil(math.log(2) / math.log1p(config.growth.grown_share)) * config.growth.interval
        return round(config.steps_until(config.growth.end)) - steps

    def goes_on(self, setup: TrainingSetup, model: Gaussians, batches: Batches, order: FrameOrder) -> bool:
        """Return whether growth is prolonged, now that it has come to its end."""
        brackets = order.validation_brackets or validation_brackets(setup.frames)
        config, growth = setup.config, setup.config.growth
        has_room = 2 * len(model) <= setup.shown and growth.grown_share > 0 and bool(brackets)
        # the models of shorter trainings are too coarse to judge by what they do not explain
        has_room = has_room and self.back(config) >= config.steps_until(growth.begin)
        if not has_room and self.errors is None:
            return False
        room = as_many_again(model, batches, setup.sensor)
        goes_on = has_room and self.times < MOST_TIMES and bool(room.justifies)
        before = self.errors
        why = f"as many Gaussians again could gain {room.gain:,.0f} nats at a BIC penalty of {room.penalty:,.0f}"
        if goes_on or before is not None:
            self.errors = log_errors(model, batches, setup.sensor, brackets)
            if before is not None:
                gained = fewer(before, self.errors)
                goes_on &= bool(gained.justifies)
                why += f"; errors of views kept back changed by {-gained.gain:+.1%}, {gained.error:.1%} may be chance"
            order.keep_back(brackets if goes_on or setup.keeps_unseen else [])
        self.times += goes_on
        self.reason = f"growth {'goes on' if goes_on else 'ends'}: {why}"
        log.info("%s", self.reason)
        return goes_on


class OpacityResets:
    """Makes all Gaussians nearly transparent from time to time, as 3DGS does."""

    def due(self, now: Now) -> bool:
        """Return whether it is time: in growth, and before another background than black when it begins (3DGS)."""
        interval, step = now.config.published.opacity_reset_interval, now.moment.step
        if not interval:
            return False
        whole = now.config.steps_until(1) - now.config.steps_until(0)
        begins = now.setup.frames[0].background and step == round(now.config.growth.begin * whole)
        return bool(begins) or (Growth.is_growing(now.config, now.moment) and step % interval == 0)

    def decide(self, now: Now) -> Change:
        """Return the Gaussians with low opacities."""
        deviation_m, gaussians = now.deviation_m, now.gaussians.detach()
        lowering = None if deviation_m is None else log_lowering(gaussians, deviation_m)
        return Change(reset_opacities(gaussians, lowering), None, begun_anew=("opacity_logits",))


def _grown(now: Now, growing: Tensor, crossed: Tensor | None = None) -> Change:
    """Return the growth of some Gaussians [N] as the method asks, also of those in crossed [N], which are cloned."""
    gaussians, split_m = now.gaussians.detach(), SPLIT_SIZE * now.setup.unit_m
    if now.config.published.split == "random":
        return Change(*grow(gaussians, growing, split_m, now.rng, crossed))
    return Change(*split_long_axis(gaussians, growing if crossed is None else growing | crossed))


def chosen(
    gradient: Tensor, count: int, settings: GrowthSettings, threshold: float = GRADIENT_THRESHOLD
) -> Tensor:
    """Return which Gaussians [N] grow: the share with the largest gradients, or those above the threshold.

    There are as many at most as the budget has room for beside the `count` that there are.
    """
    growing = int((gradient >= threshold).sum())
    if settings.grown_share:
        growing = int(settings.grown_share * count)
    growing = max(0, min(growing, settings.max_gaussians - count, int((gradient > 0).sum())))
    mask = torch.zeros(count, dtype=torch.bool)
    mask[gradient.topk(growing).indices] = True
    return mask


@torch.no_grad()
def split_long_axis(gaussians: Gaussians, growing: Tensor) -> tuple[Gaussians, Tensor]:
    """Return the model with the growing Gaussians [N] bool split in two along their longest axis, without chance.

    The centres of the two lie `LONG_AXIS_SHIFT` of its deviations to both sides; along that axis they are so much
    narrower that the two together have the covariance of the one, so that the picture changes little. Those that were
    not split stand first, unchanged; their old indices are returned too.

    Source: after Deng et al., Improving Densification in 3D Gaussian Splatting, 2025, who lower opacities as well.
    """
    kept, splits = torch.nonzero(~growing)[:, 0], torch.nonzero(growing)[:, 0]
    whole = gaussians.select(splits)
    longest = F.one_hot(whole.log_scales.argmax(dim=1), 3).to(whole.means)
    shift_m = LONG_AXIS_SHIFT * (whole.axes @ longest[..., None])[..., 0]
    log_scales = whole.log_scales + longest * (0.5 * math.log(1 - LONG_AXIS_SHIFT**2))
    halves = [
        dataclasses.replace(whole, means=whole.means + sign * shift_m, log_scales=log_scales)
        for sign in (1, -1)
    ]
    return Gaussians.concatenate([gaussians.select(kept), *halves]), kept


def in_view(rendered: Rendered, camera: int) -> Tensor:
    """Return which Gaussians [N] have a circle of their radius around the projected mean that reaches the image."""
    height, width = rendered.alpha.shape[1:]
    radius = rendered.radii[camera]
    x, y = rendered.means2d[camera].detach().unbind(-1)
    inside = (x + radius > 0) & (x - radius < width) & (y + radius > 0) & (y - radius < height)
    return (radius > 0) & inside


def worst_boxes(
    gaussians: Gaussians, rendered: Rendered, cameras: Cameras, residual: Tensor
) -> list[obb.Obb]:
    """Return the boxes around the Gaussians behind the worst tile of each frame; none where they are too few.

    Args:
        residual: [C, H, W, channels].
    """
    means, boxes = gaussians.means.detach(), []
    for i in range(len(cameras)):
        tile = obb.worst_tile(residual[i])
        members = obb.behind_tile(
            means, rendered.means2d[i], rendered.depth[i], cameras.world_to_camera[i], tile
        )
        if members.sum() >= obb.FEWEST:
            boxes.append(obb.fit(means[members]))
    return boxes


@torch.no_grad()
def finite(gaussians: Gaussians) -> Tensor:
    """Return which Gaussians [N] have only finite parameters and sizes: images leave the others out silently."""
    kept = gaussians.scales.isfinite().all(dim=1)
    for tensor in gaussians.tensors().values():
        kept &= tensor.reshape(len(gaussians), -1).isfinite().all(dim=1)
    return kept
