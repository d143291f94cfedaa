"""The methods by name: `obbgs` is what the settings are at their defaults, published methods differ from it."""

import logging
import math
from dataclasses import fields, replace
from typing import Any

from obbgs_core.methods.config import (
    GrowthSettings,
    LightSettings,
    LossSettings,
    MethodConfig,
    ParsimonySettings,
    PoseSettings,
    RateSettings,
    SparseSettings,
)
from obbgs_core.published.settings import PublishedSettings
from obbgs_core.settings import changed
from obbgs_core.start.initialisation import StartSettings

log = logging.getLogger(__name__)
GAUSSIANS_PER_PIXEL = 2  # that a picture can show: one behind each edge of a pixel
# of the harmonics, at most, on a body with texture all over: its relief glints as no degree of two describes
TEXTURED_SH_DEGREE = 3
AS_MANY_PICTURES = 35  # long exposures: the lit pixels of fewer count as those of so many (experiment 084)
# Kerbl et al., 3D Gaussian Splatting, 2023
_3DGS = MethodConfig(
    name="3dgs",
    exposure_aware=False,
    frames_per_step=1,
    steps=30_000,
    averaged_from=1.0,
    chi2_end=0.0,
    start=StartSettings(kind="random", count=100_000),
    loss=LossSettings(
        misfit=False,
        edge_weight=0.0,
        gloss_weight=0.0,
        normal_weight=0.0,
        flat_weight=0.0,
        sky_weight=0.0,
        solid_weight=0.0,
    ),
    growth=GrowthSettings(
        max_gaussians=500_000,
        gaussians_per_root_pixel=0,
        begin=500 / 30_000,
        end=14_999 / 30_000,  # the last densification and reset come before step 15,000
        interval=100,
        grown_share=0.0,
        obb_interval=0,
        prune_opacity=0.005,
    ),
    rates=RateSettings(
        means=1.6e-4,
        means_end=1.6e-6,
        quats=0.001,
        log_scales=0.005,
        sh=0.0025,
        sh_rest=1 / 20,
        final_share=1.0,
        second_memory=0.999,
    ),
    parsimony=ParsimonySettings(prune_at=(), keep_above_opacity=1.0),
    light=LightSettings(max_sh_degree=0, sun_span_deg=0.0, highlights=False),
    poses=PoseSettings(refine="never"),
    sparse=SparseSettings(dropout=0.0),
    published=PublishedSettings(
        length_unit="cameras",
        radiance_unit="full_scale",
        bracket_steps=False,
        windows=False,
        footprint="kerbl",
        grey_start=True,
        loss="l1_ssim",
        clamped=False,
        sh_degree=3,
        sh_interval=1000,
        recorded_from_start=True,
        split="random",
        pixel_weighted=False,
        prune_size=0.1,
        prune_size_from=3000 / 30_000,  # after the first reset of the opacities
        opacity_reset_interval=3000,
    ),
)
PRESETS: dict[str, MethodConfig] = {
    c.name: c
    for c in (
        _3DGS,
        changed(_3DGS, {"name": "pixel-gs", "published.pixel_weighted": True, "published.depth_scale": 0.37}),
        changed(
            _3DGS,
            {  # run_360.py and train.py of the authors' code
                "name": "mvgs",
                "steps": 39_000,
                "frames_per_step": 8,
                "published.coarse": ((1 / 8, 48, 3 / 39), (1 / 4, 24, 3 / 39), (1 / 2, 12, 3 / 39)),
                "published.multi_view": True,
            },
        ),
        changed(
            _3DGS,
            {  # train.py of the authors' code; their budgets are those that 3DGS reaches
                "name": "3dgs-mcmc",
                "published.growth": "sampled",
                "published.opacity_reset_interval": 0,
                "growth.end": 25_000 / 30_000,
                "growth.max_gaussians": 20_000,
                "start.count": 20_000,
            },
        ),
        changed(
            _3DGS,
            {
                "name": "mip-splatting",
                "published.smoothing_px2": 0.2,
                "published.footprint": "mip-splatting",
            },
        ),
        changed(
            _3DGS,
            {
                "name": "jiang2025",
                "frames_per_step": 3,
                "loss.edge_weight": 0.2,
                "growth.obb_interval": 50,
                "published.bracket_steps": True,
                "published.pixel_weighted": True,
                "published.outlier_filter": True,
            },
        ),
        MethodConfig(name="obbgs"),
    )
}


# What can be added to a method's name, `3dgs+exposure`, and the settings that it changes.
VARIANTS: dict[str, dict[str, Any]] = {
    "exposure": {  # known exposure times, saturation as the sensor's
        "exposure_aware": True,
        "published.clamped": True,
    },
    "blind": {"exposure_aware": False},  # exposure times are not known
    # the colours of each frame are learnt
    "affine": {"published.compensation": True, "published.clamped": True},
    "hull": {f"start.{f.name}": getattr(StartSettings(), f.name) for f in fields(StartSettings)}
    | {"published.grey_start": False},
    "random": {"start.kind": "random"},
    # where silhouettes show empty sky no Gaussian may be, and only the part around the target is compared
    "mask": {"loss.sky_weight": LossSettings().sky_weight, "published.windows": True},
    "l1": {"published.ssim_weight": 0.0},
    # the rates of obbgs and its schedule, stretched from three frames a step to one, without resets of opacities
    "fast": {f"rates.{f.name}": getattr(RateSettings(), f.name) for f in fields(RateSettings)}
    | {
        "steps": 3 * MethodConfig(name="").steps,
        "averaged_from": MethodConfig(name="").averaged_from,
        "growth.begin": GrowthSettings().begin,
        "growth.end": GrowthSettings().end,
        "growth.interval": 3 * GrowthSettings().interval,
        "published.length_unit": "target",
        "published.radiance_unit": "one",
        "published.sh_interval": 300,
        "published.prune_size": PublishedSettings().prune_size,
        "published.opacity_reset_interval": 0,
    },
}


def preset(name: str, changes: dict[str, Any] | None = None) -> MethodConfig:
    """Return the settings of `METHOD` or `METHOD+VARIANT+VARIANT`, with some of them changed.

    Args:
        name: of one of `PRESETS`, with any of `VARIANTS` that change something in it. The method's own name has its
            variants in the order of `VARIANTS`.
        changes: by names such as `steps` or `growth.interval`.

    Raises:
        ValueError: no such method, variant or setting; a variant that changes nothing or contradicts another; or a
            value that no training can have.
    """
    method, *variants = name.split("+")
    if method not in PRESETS:
        raise ValueError(f"no method {method!r}; expected one of {', '.join(PRESETS)}")
    if unknown := [variant for variant in variants if variant not in VARIANTS]:
        raise ValueError(
            f"no variant {unknown[0]!r} of a method in {name!r}; expected METHOD+VARIANT with one of "
            f"{', '.join(VARIANTS)}"
        )
    variants.sort(key=list(VARIANTS).index)
    config, varied = PRESETS[method], {}
    for variant in variants:
        more = VARIANTS[variant]
        if any(varied.get(setting, value) != value for setting, value in more.items()):
            raise ValueError(f"the variants in {name!r} contradict each other")
        varied |= more
        if (with_variant := changed(config, more)) == config:
            raise ValueError(f"{variant!r} changes nothing in {config.name!r}; leave it out of {name!r}")
        config = replace(with_variant, name=f"{config.name}+{variant}")
    return changed(config, changes or {})


QUALITIES = {"draft": 0.3, "standard": 1.0, "best": 3.0}  # factor on the method's own steps
DRAFT_POINTS = 2  # times as many first points in a draft, which has no time to grow (experiment 063)


def quality_changes(config: MethodConfig, quality: str) -> dict[str, int]:
    """Return the changes that make a training of a quality: three tenths of the method's steps, or three times as many.

    With three times the steps the model may be three times as large where so many pixels are lit. A draft is as large
    as ever: it starts with more points, and as often as before in the whole training it grows.

    Raises:
        ValueError: no such quality.
    """
    if quality not in QUALITIES:
        raise ValueError(f"quality must be one of {', '.join(QUALITIES)}, got {quality!r}")
    factor, growth = QUALITIES[quality], config.growth
    changes = {"steps": round(config.steps * factor)}
    if factor > 1:
        return changes | {"growth.max_gaussians": round(growth.max_gaussians * factor)}
    if factor < 1:
        intervals = {name: getattr(growth, name) for name in ("interval", "obb_interval")}
        changes |= {f"growth.{name}": max(1, round(n * factor)) for name, n in intervals.items() if n}
        changes["start.count"] = min(DRAFT_POINTS * config.start.count, growth.max_gaussians)
    return changes


def budget_changes(config: MethodConfig, changes: dict[str, Any], gaussians: int) -> dict[str, Any]:
    """Return changes to a method, and with them that a model has at most so many Gaussians, whatever is lit."""
    start = min(gaussians, changes.get("start.count", config.start.count))
    limits = {"growth.max_gaussians": gaussians, "growth.gaussians_per_root_pixel": 0, "start.count": start}
    return changes | limits


def limited(
    config: MethodConfig, lit_pixels: list[int], textured_pixels: int
) -> tuple[MethodConfig, int, str]:
    """Return a method with no more Gaussians than its budget and the lit pixels allow, and the budget in words.

    Between them stands how many Gaussians a picture can show, 0 where the budget is what was asked for. A body with
    texture all over begins with a Gaussian for each pixel that shows it, and may have as many as a picture can show:
    growth, which begins at edges, does not reach it in time. What it shines with may turn with the view by one degree
    more, where frames are not few. Numbers that were asked for stay.

    Args:
        lit_pixels: of each long exposure. A few of them show as much detail of the target as many, and count as so
            many.
        textured_pixels: of a picture of a target that has texture all over, else 0.
    """
    most, factor, first = (
        config.growth.max_gaussians,
        config.growth.gaussians_per_root_pixel,
        config.start.count,
    )
    budget = f"at most {most:,} Gaussians"
    pictures = max(len(lit_pixels), AS_MANY_PICTURES)
    lit = sum(lit_pixels) * pictures // len(lit_pixels)
    shown = GAUSSIANS_PER_PIXEL * sum(lit_pixels) // len(lit_pixels) if factor else 0
    light = config.light
    as_usual = (first, most) == (StartSettings().count, GrowthSettings().max_gaussians)
    if factor and as_usual and textured_pixels > first and shown > most:
        first, most = textured_pixels, shown
        if light == LightSettings():
            light = replace(light, max_sh_degree=TEXTURED_SH_DEGREE)
        budget = (
            f"at most {most:,} Gaussians instead of {config.growth.max_gaussians:,}: as many as a picture can show, "
            f"because {textured_pixels:,} of its pixels show texture all over the target"
        )
    elif factor and factor * math.sqrt(lit) < most:
        most = max(2, round(factor * math.sqrt(lit)))  # the fewest that a start may have
        budget = (
            f"at most {most:,} Gaussians instead of {config.growth.max_gaussians:,}: {factor:g} times the square root "
            f"of the {lit:,} pixels that {'are' if pictures == len(lit_pixels) else 'would be'} lit in {pictures} long "
            "exposures"
        )
    log.info("budget: %s", budget)
    growth = replace(config.growth, max_gaussians=most)
    start = replace(config.start, count=min(first, most))
    return replace(config, growth=growth, start=start, light=light), shown, budget
