"""Growth and pruning of the model: which Gaussians are cloned, split or removed."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core import obb
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices
from obbgs_core.render import Rendered
from obbgs_core.settings import at_least_one, check, fraction
from obbgs_core.train.adam import Adam

SPLIT_SHRINK = 1.6  # the two Gaussians of a split have its deviations divided by this (Kerbl et al. 2023)
# of the deviation along the longest axis: where the centres of the two Gaussians of a split along it lie. 0.6 is worse
# (docs/experiments/043).
LONG_AXIS_SHIFT = 0.8
# of the method's unit of length: larger Gaussians are split, smaller ones cloned (the same)
SPLIT_SIZE = 0.01
GRADIENT_THRESHOLD = 0.0002  # mean screen gradient, per half of an image's width and height (the same)
RESET_OPACITY = 0.01  # no opacity is above this after a reset (the same)


@dataclass(frozen=True)
class GrowthSettings:
    """When and where Gaussians are added, and which are removed; sizes are in the method's unit of length."""

    max_gaussians: int = at_least_one(500_000)
    # above 0: no more Gaussians than so many times the square root of the number of pixels that are lit in the long
    # exposures; fewer than 35 exposures count as 35
    gaussians_per_root_pixel: float = 0.0
    begin: float = fraction(500 / 30_000)  # share of the steps
    # share of the steps from which gradients are recorded, where that is before `begin`
    recorded_from: float = fraction(1.0)
    end: float = fraction(0.5)  # share of the steps
    interval: int = at_least_one(100)  # steps between two densifications
    # above 0: this share of the Gaussians grows, largest gradients first, instead of a threshold
    share: float = 0.0
    # what grows becomes: random, a clone where it is small and two drawn from it where it is large (Kerbl et al. 2023);
    # long_axis, always two beside each other on its longest axis
    split: Literal["random", "long_axis"] = "random"
    pixel_weighted: bool = False  # gradients are averaged over pixels instead of views (Pixel-GS)
    # above 0: gradients of Gaussians nearer to the camera than this count less (Pixel-GS)
    depth_scale: float = 0.0
    obb_interval: int = 0  # above 0: steps between extra growth inside the boxes of the worst tiles
    # of these boxes: where they are tight, or the mean of what is in them (Jiang et al. 2025)
    obb_centre: Literal["middle", "mean"] = "middle"
    # also clone what lies where the worst tiles of a step's views cross, and halve the threshold where two of the
    # step's cameras are far apart (MVGS)
    multi_view: bool = False
    prune_opacity: float = fraction(0.005)  # fainter Gaussians are removed at each densification
    prune_size: float = 0.2  # larger Gaussians are removed at each densification
    prune_size_from: float = fraction(0.0)  # share of the steps before which size is no reason to remove
    prune_radius_px: float = 0.0  # above 0: and those whose three sigma are longer than this in an image
    opacity_reset_interval: int = 3000  # steps between two resets of the opacities; 0: never

    def __post_init__(self):
        check(self, "growth")


@dataclass
class Growth:
    """Running sums of each Gaussian's screen-space gradient since the last densification.

    gradient: [N] sum of gradient norms, weighted; weight: [N] sum of the weights: a view counts by the pixels that the
        Gaussian covers in it (Pixel-GS), or as one (3DGS).
    radius_px: [N] the longest three sigma that the Gaussian had in an image.
    """

    gradient: Tensor
    weight: Tensor
    radius_px: Tensor

    @staticmethod
    def of(count: int) -> "Growth":
        """Return records of `count` Gaussians that have not been seen yet."""
        return Growth(*(torch.zeros(count) for _ in range(3)))

    @torch.no_grad()
    def observe(
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
            self.radius_px = torch.maximum(self.radius_px, rendered.radii[camera].to(self.radius_px))

    def mean(self) -> Tensor:
        """Return each Gaussian's mean gradient [N]."""
        return self.gradient / self.weight.clamp(min=1e-9)

    def select(self, kept: Tensor) -> "Growth":
        """Return the records of the Gaussians `kept` (index or mask)."""
        return Growth(self.gradient[kept], self.weight[kept], self.radius_px[kept])

    def padded(self, count: int) -> "Growth":
        """Return these records with empty ones after them, `count` in all."""
        more = Growth.of(count - len(self.gradient))
        return Growth(*(torch.cat([getattr(self, name), getattr(more, name)]) for name in vars(self)))


def in_view(rendered: Rendered, camera: int) -> Tensor:
    """Return which Gaussians [N] have a circle of their radius around the projected mean that reaches the image."""
    height, width = rendered.alpha.shape[1:]
    radius = rendered.radii[camera]
    x, y = rendered.means2d[camera].detach().unbind(-1)
    inside = (x + radius > 0) & (x - radius < width) & (y + radius > 0) & (y - radius < height)
    return (radius > 0) & inside


def near_camera_weight(means: Tensor, cameras: Cameras, near_m: float) -> Tensor:
    """Return the factor [C, N] on the gradients of Gaussians nearer than `near_m` to a camera (Pixel-GS, 2024)."""
    along = cameras.world_to_camera[:, 2]
    depths_m = along[:, :3] @ means.detach().T + along[:, 3:]
    return (depths_m / near_m).clamp(0, 1) ** 2


def worst_boxes(
    gaussians: Gaussians,
    rendered: Rendered,
    cameras: Cameras,
    residual: Tensor,
    centre: Literal["middle", "mean"],
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
            boxes.append(obb.fit(means[members], centre))
    return boxes


@torch.no_grad()
def grow(
    gaussians: Gaussians,
    adam: Adam,
    growing: Tensor,
    split_over_m: float,
    rng: torch.Generator,
    cloned: Tensor | None = None,
) -> tuple[Gaussians, Tensor]:
    """Return the model with the growing Gaussians [N] bool cloned (small ones) or split in two (large ones).

    Those that were not split stand first in it, unchanged; their old indices are returned too. Splitting draws two
    centres from the Gaussian itself and divides its deviations by `SPLIT_SHRINK`, as in Kerbl et al. 2023.

    Args:
        cloned: [N] bool of further Gaussians to be cloned, whatever their size.
    """
    large = gaussians.scales.max(dim=1).values > split_over_m
    cloning = growing & ~large
    clones = torch.nonzero(cloning if cloned is None else cloning | cloned)[:, 0]
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
    return Gaussians.concatenate(parts).trainable(), kept


@torch.no_grad()
def split_long_axis(gaussians: Gaussians, adam: Adam, growing: Tensor) -> tuple[Gaussians, Tensor]:
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
    adam.follow(kept, 2 * len(splits))
    return Gaussians.concatenate([gaussians.select(kept), *halves]).trainable(), kept


def _grown(
    gaussians: Gaussians,
    adam: Adam,
    growing: Tensor,
    unit_m: float,
    settings: GrowthSettings,
    rng: torch.Generator,
    crossed: Tensor | None = None,
) -> tuple[Gaussians, Tensor]:
    """Return what `grow` or `split_long_axis` does, as the method asks, also with the Gaussians in crossed [N]."""
    if settings.split == "long_axis":
        return split_long_axis(gaussians, adam, growing if crossed is None else growing | crossed)
    return grow(gaussians, adam, growing, SPLIT_SIZE * unit_m, rng, crossed)


@torch.no_grad()
def keep(gaussians: Gaussians, adam: Adam, mask: Tensor) -> Gaussians:
    """Return the model with only the Gaussians in mask [N]."""
    index = torch.nonzero(mask)[:, 0]
    adam.follow(index, 0)
    return gaussians.select(index).trainable()


@torch.no_grad()
def finite(gaussians: Gaussians) -> Tensor:
    """Return which Gaussians [N] have only finite parameters and sizes: images leave the others out silently."""
    kept = gaussians.scales.isfinite().all(dim=1)
    for tensor in gaussians.tensors().values():
        kept &= tensor.reshape(len(gaussians), -1).isfinite().all(dim=1)
    return kept


@torch.no_grad()
def outliers(gaussians: Gaussians, spread: float = 4.0, faint: float = 0.1) -> Tensor:
    """Return which Gaussians [N] the centre-constrained filter removes: far from the robust centre, or faint and far.

    Distance is from the median centre and limited to `spread` times the median distance. A faint Gaussian, one with
    an opacity below `faint`, is removed at half of that (Jiang et al. 2025, section 3.6).
    """
    distance = (gaussians.means - gaussians.means.median(dim=0).values).norm(dim=1)
    limit = spread * distance.median().clamp(min=1e-9)
    return (distance > limit) | ((gaussians.opacities < faint) & (distance > limit / 2))


def densify(
    gaussians: Gaussians,
    adam: Adam,
    growth: Growth,
    unit_m: float,
    settings: GrowthSettings,
    share: float,
    rng: torch.Generator,
    crossed: Tensor | None = None,
    threshold: float = GRADIENT_THRESHOLD,
) -> Gaussians:
    """Grow where screen gradients are large, within the budget; prune what is faint or too large.

    Args:
        unit_m: the method's unit of length.
        share: of the steps that are done.
        crossed: [N] bool of Gaussians that are cloned whatever their gradients, as many as the budget allows.
        threshold: of the gradients.
    """
    growing = chosen(growth.mean(), gaussians, settings, threshold)
    if crossed is not None:
        room = settings.max_gaussians - len(gaussians) - int(growing.sum())
        crossed = crossed & ~growing
        crossed &= crossed.cumsum(dim=0) <= room
    gaussians, kept = _grown(gaussians, adam, growing, unit_m, settings, rng, crossed)
    with torch.no_grad():
        wanted = gaussians.opacities > settings.prune_opacity
        if share >= settings.prune_size_from:
            wanted &= gaussians.scales.max(dim=1).values < settings.prune_size * unit_m
            if settings.prune_radius_px:
                wanted[: len(kept)] &= growth.radius_px[kept] <= settings.prune_radius_px
        wanted &= finite(gaussians)
    return keep(gaussians, adam, wanted) if wanted.any() else gaussians


def densify_boxes(
    gaussians: Gaussians,
    adam: Adam,
    growth: Growth,
    boxes: list[obb.Obb],
    unit_m: float,
    settings: GrowthSettings,
    rng: torch.Generator,
) -> tuple[Gaussians, Growth]:
    """Grow, of the Gaussians that `chosen` picks, those inside a box; records of new ones start empty, others go on."""
    inside = torch.stack([box.contains(gaussians.means.detach()) for box in boxes]).any(dim=0)
    growing = chosen(growth.mean(), gaussians, settings) & inside
    gaussians, kept = _grown(gaussians, adam, growing, unit_m, settings, rng)
    return gaussians, growth.select(kept).padded(len(gaussians))


def chosen(
    gradient: Tensor, gaussians: Gaussians, settings: GrowthSettings, threshold: float = GRADIENT_THRESHOLD
) -> Tensor:
    """Return which Gaussians [N] grow: those above the threshold, or the share with the largest; within the budget."""
    room = settings.max_gaussians - len(gaussians)
    count = int((gradient >= threshold).sum())
    if settings.share:
        count = int(settings.share * len(gaussians))
    count = max(0, min(count, room, int((gradient > 0).sum())))
    growing = torch.zeros(len(gaussians), dtype=torch.bool)
    growing[gradient.topk(count).indices] = True
    return growing


@torch.no_grad()
def reset_opacities(gaussians: Gaussians, adam: Adam, log_lowering: Tensor | None = None) -> None:
    """Make every Gaussian nearly transparent, so that only those that are needed become opaque again.

    Args:
        log_lowering: [N] logarithm of the factor by which opacities are lower when they are rendered; None: zeros.
    """
    if log_lowering is None:
        gaussians.opacity_logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    else:
        most = (RESET_OPACITY / log_lowering.exp()).clamp(max=1 - 1e-6)
        gaussians.opacity_logits.copy_(torch.minimum(gaussians.opacity_logits, most.logit()))
    adam.reset("opacity_logits")
