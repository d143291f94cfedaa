"""The methods as data: what each published method, and ours, does differently. No subclasses."""

import dataclasses
import math
from dataclasses import dataclass, replace

CHOICES = {
    "loss": ("l1_ssim", "likelihood"),
    "length_unit": ("target", "cameras"),
    "start": ("random", "hull"),
    "start_colour": ("seen", "grey"),
    "sun_shading": ("lambert", "linear"),
    "refine_poses": ("never", "always", "auto"),
}
COUNTS = ("steps", "frames_per_step", "start_count", "max_gaussians", "grow_interval", "shadow_interval")
SHARES = ("grow_from", "grow_until", "poses_from", "normal_from", "solid_from", "sun_from", "weigh_at")
SHARES += ("prune_over_from", "keep_opacity", "prune_opacity")


@dataclass(frozen=True)
class MethodConfig:
    """Everything that shapes a training run; rates are per step, lengths in the method's own unit."""

    name: str
    exposure_aware: bool = False  # False: exposure ignored, as the methods were published
    length_unit: str = "target"  # target (its radius) | cameras (how far they stand apart, as in 3DGS)
    loss: str = "l1_ssim"  # l1_ssim | likelihood (sensor model, saturated pixels censored)
    ssim_weight: float = 0.2
    edge_weight: float = 0.0  # Sobel
    frames_per_step: int = 1
    bracket_steps: bool = False  # the frames of a step are one of each exposure
    start: str = "random"  # random | hull
    start_colour: str = (
        "seen"  # seen (radiance where the points project) | grey (half of full scale, as in 3DGS)
    )
    start_count: int = 100_000
    steps: int = 30_000
    pyramid: tuple[tuple[float, float], ...] = ((0.0, 1.0),)  # (from this share of the steps, image scale)
    sh_degree: int = 3
    sh_interval: int = (
        0  # > 0: radiance is constant at first, and its degree rises by one after so many steps
    )
    max_gaussians: int = 500_000
    pixels_per_gaussian: int = (
        0  # > 0: so many lit ones of the long exposures for each, or they are learnt by heart
    )
    grow_from: float = 500 / 30_000  # share of the steps
    grow_until: float = 0.5
    grow_interval: int = 100
    grow_patience: int = 0  # > 0: growth ends when held-out likelihood rose in none of so many intervals
    grow_grad2d: float = 0.0002  # mean screen gradient, per NDC
    grow_share: float = (
        0.0  # > 0: grow this share of the Gaussians, largest gradients first, instead of a threshold
    )
    pixel_weighted: bool = False  # Pixel-GS: gradients are averaged over pixels instead of views
    depth_scale: float = (
        0.0  # > 0: gradients of Gaussians nearer to the camera than this count less (Pixel-GS)
    )
    obb_interval: int = 0  # > 0: extra growth inside the boxes of the worst tiles, every so many steps
    obb_mean_centre: bool = False
    split_over: float = 0.01  # Gaussians larger than this are split, smaller ones cloned
    prune_opacity: float = 0.005
    prune_over: float = 0.2  # larger Gaussians are removed
    prune_radius_px: float = 0.0  # > 0: and those whose three sigma are longer than this in a picture
    prune_over_from: float = 0.0  # share of the steps: before, size is no reason
    opacity_reset_interval: int = 3000  # 0: never
    outlier_filter: bool = False
    lr_means: float = 1.6e-4
    lr_means_end: float = 1.6e-6
    lr_quats: float = 0.001
    lr_log_scales: float = 0.005
    lr_opacity_logits: float = 0.05
    lr_sh: float = 0.0025
    lr_sh_rest: float = 1.0  # times lr_sh, of the coefficients above degree 0
    lr_ambient: float = 0.001  # of the Sun
    lr_end: float = 1.0  # all other rates fall to this share of theirs
    lr_poses: float = 0.3  # in deviations of the pose tag
    refine_poses: str = "never"  # never | always | auto (if held-out brackets say so): six numbers a bracket
    poses_from: float = 0.25  # share of the steps: before, the model is too coarse to correct anything
    exposure_sigma: float = 0.0  # of ln(exposure time): > 0 corrects each frame's, unless exposure is ignored
    sh_weight: float = 0.0  # on the mean square of what turns with the view: a prior for matt surface
    flat_weight: float = 0.0  # on the mean shortest scale: flat Gaussians are surface
    sky_weight: float = (
        0.0  # on the alpha of pixels that show no light: space is empty where nothing says otherwise
    )
    normal_weight: float = 0.0  # on the disagreement of rendered normals with those of rendered depths
    normal_from: float = 0.4  # share of the steps
    solid_weight: float = 0.0  # on opacity·(1 - opacity): solid or gone
    solid_from: float = 0.5  # share of the steps
    weigh_at: tuple[float, ...] = ()  # shares of the steps at which each Gaussian must earn its parameters
    price_factor: float = 1.0  # of (parameters / 2)·ln(values measured)
    keep_opacity: float = (
        1.0  # more opaque Gaussians are kept whatever they earn: dark surface explains no light
    )
    most_sh_degree: int = (
        0  # the degree may rise to this where the likelihood pays; 0: radiance turns with nothing
    )
    sun_span_deg: float = (
        0.0  # > 0: the radiance may turn with the Sun where its direction spans more than this
    )
    sun_from: float = 0.05  # share of the steps at which a Sun that moves may first join, before any growth
    sun_shading: str = (
        "lambert"  # lambert (albedo, normal, cast shadows) | linear (harmonics towards the Sun)
    )
    shadow_interval: int = 120  # steps after which they are cast anew
    chi2_end: float = 0.0  # > 0: stop when the mean squared normalised residual falls to this

    def __post_init__(self):
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                expected = f"{', '.join(known[:-1])} or {known[-1]}"
                raise ValueError(f"{name} must be {expected}, got {getattr(self, name)!r}")
        for name, value in vars(self).items():
            for number in value if isinstance(value, tuple) and name != "pyramid" else (value,):
                if not isinstance(number, (int, float)):
                    continue
                if not 0 <= number < math.inf:
                    raise ValueError(f"{name} must be 0 or more, got {number}")
                if name in COUNTS and number < 1:
                    raise ValueError(f"{name} must be at least 1, got {number}")
                if name in SHARES and number > 1:
                    raise ValueError(f"{name} must be from 0 to 1, got {number}")
                if name in ("sh_degree", "most_sh_degree") and number > 3:
                    raise ValueError(f"{name} must be from 0 to 3, got {number}")
        starts = [level[0] for level in self.pyramid]
        if not (
            all(len(level) == 2 and 0 < level[1] <= 1 for level in self.pyramid)
            and starts == sorted(set(starts))
            and starts[:1] == [0]
        ):
            raise ValueError(
                "pyramid must be pairs of a share of the steps, from 0 upwards, and an image scale of 0 to 1, got "
                f"{self.pyramid}"
            )


_3DGS = MethodConfig(
    name="3dgs",
    length_unit="cameras",
    start_colour="grey",
    sh_interval=1000,
    lr_sh_rest=1 / 20,
    prune_over=0.1,
    prune_radius_px=20.0,
    prune_over_from=3000 / 30_000,  # after the first reset of the opacities
)
PRESETS: dict[str, MethodConfig] = {
    c.name: c
    for c in (
        _3DGS,
        replace(_3DGS, name="pixel-gs", pixel_weighted=True, depth_scale=0.37),
        replace(_3DGS, name="mvgs", frames_per_step=4),
        replace(
            _3DGS,
            name="jiang2025",
            edge_weight=0.2,
            frames_per_step=3,
            bracket_steps=True,
            pixel_weighted=True,
            obb_interval=50,
            outlier_filter=True,
        ),
        MethodConfig(
            name="obbgs",
            exposure_aware=True,
            loss="likelihood",
            ssim_weight=0.0,
            edge_weight=0.05,
            frames_per_step=3,
            bracket_steps=True,
            start="hull",
            start_count=6000,
            steps=1500,
            pyramid=((0.0, 0.25), (0.15, 0.5), (0.4, 1.0)),
            sh_degree=0,
            max_gaussians=10_000,
            pixels_per_gaussian=7,
            grow_from=0.08,
            grow_until=0.7,
            grow_interval=60,
            grow_share=0.08,
            pixel_weighted=True,
            obb_interval=30,
            prune_opacity=0.02,
            opacity_reset_interval=0,
            outlier_filter=False,  # nothing strays from the hull: it cost 0.4 dB on the demo session
            lr_means=4e-3,
            lr_means_end=2e-5,
            lr_quats=0.01,
            lr_log_scales=0.02,
            lr_sh=0.04,
            lr_end=0.2,
            sh_weight=1.0,
            flat_weight=3.0,
            sky_weight=0.2,
            refine_poses="auto",
            weigh_at=(0.3, 0.5, 0.7, 0.85),
            keep_opacity=0.5,
            most_sh_degree=1,
            sun_span_deg=5.0,
            chi2_end=1.0,
        ),
    )
}


def preset(name: str, **changes) -> MethodConfig:
    """Return a preset with some fields changed.

    Raises:
        ValueError: no such method or field, or a value that no training can have.
    """
    if name not in PRESETS:
        raise ValueError(f"no method {name!r}; expected one of {', '.join(PRESETS)}")
    known = {f.name for f in dataclasses.fields(MethodConfig)}
    if unknown := set(changes) - known:
        raise ValueError(f"{name} has no setting {', '.join(sorted(unknown))}")
    return replace(PRESETS[name], **changes)


QUALITIES = {"draft": 1 / 3, "standard": 1.0, "best": 3.0}  # of the method's own steps and Gaussians


def with_quality(config: MethodConfig, quality: str) -> MethodConfig:
    """Return the method with its steps and its largest model scaled to a quality.

    Raises:
        ValueError: no such quality.
    """
    if quality not in QUALITIES:
        raise ValueError(f"quality must be one of {', '.join(QUALITIES)}, got {quality!r}")
    factor = QUALITIES[quality]
    return replace(
        config,
        steps=round(config.steps * factor),
        max_gaussians=round(config.max_gaussians * factor),
        start_count=round(config.start_count * min(1.0, factor)),
    )
