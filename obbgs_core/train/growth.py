"""Growth and pruning: who is cloned, split or removed, with the optimiser's state carried along."""

import dataclasses
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from obbgs_core import compiled
from obbgs_core.model.gaussians import TENSORS, Gaussians
from obbgs_core.model.rotations import quats_to_matrices
from obbgs_core.obb import Obb
from obbgs_core.render import Rendered
from obbgs_core.train.presets import MethodConfig

RECORDS = ("gradient", "weight", "radius_px")  # of each Gaussian in Growth
SPLIT_SHRINK = 1.6  # a split's halves are this much smaller (Kerbl et al. 2023)


@dataclass
class Growth:
    """Running screen-space gradients [N], by view or weighted by the pixels each Gaussian covers (Pixel-GS).

    radius_px: [N] the longest three sigma that each Gaussian had in a picture.
    """

    count: int
    pixel_weighted: bool
    gradient: Tensor = field(init=False)
    weight: Tensor = field(init=False)
    radius_px: Tensor = field(init=False)

    def __post_init__(self):
        self.gradient, self.weight, self.radius_px = (torch.zeros(self.count) for _ in range(3))

    @torch.no_grad()
    def observe(self, rendered: Rendered, half_size_px: float, depth_weight: Tensor | None = None) -> None:
        """Add one step's gradients, per unit of normalised device coordinates as the published thresholds are.

        Args:
            depth_weight: [C, N] factor on the gradients of each camera's Gaussians.
        """
        for camera, gradient in rendered.screen.means2d.items():
            pixels = rendered.screen.pixels[camera]
            weight = pixels if self.pixel_weighted else (pixels > 0).float()
            size = gradient.norm(dim=-1) * half_size_px
            if depth_weight is not None:
                size = size * depth_weight[camera]
            self.gradient += size * weight
            self.weight += weight
            self.radius_px = torch.maximum(self.radius_px, rendered.radii[camera].to(self.radius_px))

    def mean(self) -> Tensor:
        return self.gradient / self.weight.clamp(min=1e-9)

    def follow(self, kept: Tensor) -> None:
        """Keep the records of the Gaussians `kept` (index or mask)."""
        for name in RECORDS:
            setattr(self, name, getattr(self, name)[kept])
        self.count = len(self.gradient)


class Adam:
    """Adam over the Gaussians' parameters whose moments follow the Gaussians when they are split or removed."""

    def __init__(self, gaussians: Gaussians, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        self.betas, self.eps, self.steps = betas, eps, 0
        self.first = {name: torch.zeros_like(t) for name, t in gaussians.parameters().items()}
        self.second = {name: torch.zeros_like(t) for name, t in gaussians.parameters().items()}

    @torch.no_grad()
    def step(self, gaussians: Gaussians, rates: dict[str, float | Tensor]) -> None:
        """Move every parameter that has a gradient, and drop the gradients; a rate may differ within a parameter."""
        self.steps += 1
        b1, b2 = self.betas
        correction = math.sqrt(1 - b2**self.steps) / (1 - b1**self.steps)
        for name, parameter in gaussians.parameters().items():
            if parameter.grad is None:
                continue
            values, gradient, rate = parameter.detach(), parameter.grad.contiguous(), rates[name] * correction
            first, second = self.first[name], self.second[name]
            native = compiled.module_for(values)
            if native is not None and not isinstance(rate, Tensor):  # the same in one pass over memory
                threads = torch.get_num_threads()
                native.adam_step(values, gradient, first, second, rate, b1, b2, self.eps, threads)
            else:
                first.lerp_(gradient, 1 - b1)
                second.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
                values.sub_(rate * first / second.sqrt().add_(self.eps))
            parameter.grad = None

    def rest(self, name: str) -> None:
        """Forget what is known of a parameter's gradients, whose values were changed by hand."""
        self.first[name].zero_()
        self.second[name].zero_()

    def widen(self, gaussians: Gaussians) -> None:
        """Follow coefficients of radiance that were added: theirs start at rest."""
        for moments in (self.first, self.second):
            more = torch.zeros_like(gaussians.sh)
            more[:, : moments["sh"].shape[1]] = moments["sh"]
            moments["sh"] = more

    def follow(self, kept: Tensor, added: int) -> None:
        """Keep the moments of the Gaussians `kept` (index) and start `added` new ones at rest."""
        for moments in (self.first, self.second):
            for name in TENSORS:
                rest = torch.zeros(added, *moments[name].shape[1:], dtype=moments[name].dtype)
                moments[name] = torch.cat([moments[name][kept], rest])


@torch.no_grad()
def grow(
    gaussians: Gaussians, adam: Adam, growing: Tensor, split_over_m: float, rng: torch.Generator
) -> tuple[Gaussians, Tensor]:
    """Return the model with the growing Gaussians [N] bool cloned (small ones) or split in two (large ones).

    Those that were not split stand first in it, unchanged; their old indices are returned too. Splitting draws the
    halves' centres from the Gaussian itself and shrinks them, as in Kerbl et al. 2023.
    """
    large = gaussians.scales.max(dim=1).values > split_over_m
    clones = torch.nonzero(growing & ~large)[:, 0]
    splits = torch.nonzero(growing & large)[:, 0]
    kept = torch.nonzero(~(growing & large))[:, 0]
    parts = [gaussians.select(kept), gaussians.select(clones)]
    for _ in range(2):
        half = gaussians.select(splits)
        noise = torch.randn(len(splits), 3, generator=rng) * half.scales
        half.means = half.means + (quats_to_matrices(half.quats) @ noise[..., None])[..., 0]
        half.log_scales = half.log_scales - math.log(SPLIT_SHRINK)
        parts.append(half)
    adam.follow(kept, len(clones) + 2 * len(splits))
    return trainable(Gaussians.concatenate(parts)), kept


@torch.no_grad()
def keep(gaussians: Gaussians, adam: Adam, mask: Tensor) -> Gaussians:
    """Return the model with only the Gaussians in mask [N]."""
    index = torch.nonzero(mask)[:, 0]
    adam.follow(index, 0)
    return trainable(gaussians.select(index))


@torch.no_grad()
def finite(gaussians: Gaussians) -> Tensor:
    """Return which Gaussians [N] have only finite parameters and sizes: images leave the others out silently."""
    kept = gaussians.scales.isfinite().all(dim=1)
    for tensor in gaussians.tensors().values():
        kept &= tensor.reshape(len(gaussians), -1).isfinite().all(dim=1)
    return kept


def trainable(gaussians: Gaussians) -> Gaussians:
    """Return the same values as leaves that collect gradients."""
    leaves = {n: t.detach().clone().requires_grad_() for n, t in gaussians.parameters().items()}
    return dataclasses.replace(gaussians, **leaves)


@torch.no_grad()
def outliers(gaussians: Gaussians, spread: float = 4.0, faint: float = 0.1) -> Tensor:
    """Return which Gaussians [N] the centre-constrained filter removes: far from the robust centre, or faint and far.

    Distance is from the median centre, in units of the median distance; the limit adapts to the target. A faint
    Gaussian is removed at half of it (Jiang et al. 2025, section 3.6).
    """
    distance = (gaussians.means - gaussians.means.median(dim=0).values).norm(dim=1)
    limit = spread * distance.median().clamp(min=1e-9)
    return (distance > limit) | ((gaussians.opacities < faint) & (distance > limit / 2))


def densify(
    gaussians: Gaussians,
    adam: Adam,
    growth: Growth,
    unit_m: float,
    config: MethodConfig,
    share: float,
    rng: torch.Generator,
) -> Gaussians:
    """Grow where screen gradients are large, within the budget; prune what is faint or too large.

    Args:
        unit_m: the method's unit of length.
        share: of the steps that are done.
    """
    growing = chosen(growth.mean(), gaussians, config)
    gaussians, kept = grow(gaussians, adam, growing, config.split_over * unit_m, rng)
    with torch.no_grad():
        wanted = gaussians.opacities > config.prune_opacity
        if share >= config.prune_over_from:
            wanted &= gaussians.scales.max(dim=1).values < config.prune_over * unit_m
            if config.prune_radius_px:
                wanted[: len(kept)] &= growth.radius_px[kept] <= config.prune_radius_px
        wanted &= finite(gaussians)
    return keep(gaussians, adam, wanted) if wanted.any() else gaussians


def densify_boxes(
    gaussians: Gaussians,
    adam: Adam,
    growth: Growth,
    boxes: list[Obb],
    unit_m: float,
    config: MethodConfig,
    rng: torch.Generator,
) -> tuple[Gaussians, Growth]:
    """Apply the clone/split rule inside the boxes only; what grows starts its gradient record anew."""
    inside = torch.stack([box.contains(gaussians.means.detach()) for box in boxes]).any(dim=0)
    growing = chosen(growth.mean(), gaussians, config) & inside
    gaussians, kept = grow(gaussians, adam, growing, config.split_over * unit_m, rng)
    anew = Growth(len(gaussians), config.pixel_weighted)
    for name in RECORDS:
        getattr(anew, name)[: len(kept)] = getattr(growth, name)[kept]
    return gaussians, anew


def chosen(gradient: Tensor, gaussians: Gaussians, config: MethodConfig) -> Tensor:
    """Return which Gaussians [N] grow: over the threshold, or the given share; never beyond the budget."""
    room = config.max_gaussians - len(gaussians)
    count = int((gradient >= config.grow_grad2d).sum())
    if config.grow_share:
        count = int(config.grow_share * len(gaussians))
    count = max(0, min(count, room, int((gradient > 0).sum())))
    growing = torch.zeros(len(gaussians), dtype=torch.bool)
    growing[gradient.topk(count).indices] = True
    return growing
