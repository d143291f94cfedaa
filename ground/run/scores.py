"""The scores of a model on held-out views and against the true surface, defined once for runs and comparisons."""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ground.session.exposures import MOST_OFFERED
from obbgs_base.srgb import from_srgb, to_srgb
from obbgs_core.score.lpips import SMALLEST_PX, WeightsMissing, lpips
from obbgs_core.score.metrics import (
    cloud_distances,
    foreground_psnr_db,
    mu_law,
    psnr_db,
    ssim,
    surface_scores,
)
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
OF_SIMILARITY = ("psnr_clean_db", "psnr_clean_foreground_db", "chamfer", "completeness_surface")


@dataclass(frozen=True)
class ScoredView:
    """A model's image of a held-out view and the truth that it is compared with, as fractions of full scale.

    image: [H, W, C], predicted without noise.
    clean: [H, W, C], the true noiseless exposure.
    coverage: [H, W], the share of each pixel that the target covers.
    """

    image: Tensor
    clean: Tensor
    coverage: Tensor
    exposure_time_s: float


def noisy_psnr_db(images: Iterable[tuple[Tensor, Tensor]]) -> float:
    """Return the mean PSNR of predicted images against frames as received, pairs of [H, W, C] in 0..1."""
    return _mean([psnr_db(image, noisy) for image, noisy in images])


def display_scores(
    images: Iterable[tuple[Tensor, Tensor]], sensor: Sensor, encoding: str
) -> dict[str, float]:
    """Return psnr_srgb_db and psnr_linear_db of pairs as in `noisy_psnr_db`: of display values, and of linear ones.

    Of display values, for which they were made, ssim_srgb and lpips_srgb too, the latter as in `clean_scores`.

    Args:
        encoding: of the pairs, `srgb` or `linear`.
    """
    black = sensor.black_dn / sensor.white_dn
    convert = from_srgb if encoding == "srgb" else to_srgb
    other = "psnr_linear_db" if encoding == "srgb" else "psnr_srgb_db"
    figures: dict[str, list[float]] = {"psnr_srgb_db": [], "psnr_linear_db": []}
    shown: list[tuple[Tensor, Tensor]] = []
    for pair in images:
        signals = [((image - black) / (1 - black)).clamp(min=0) for image in pair]
        converted = [torch.from_numpy(convert(signal.numpy())) for signal in signals]
        for key in figures:
            figures[key].append(psnr_db(*(converted if key == other else signals)))
        image, read = converted if other == "psnr_srgb_db" else signals
        shown.append((image.clamp(max=1), read.clamp(max=1)))
    return {key: _mean(values) for key, values in figures.items()} | _similar(shown, "srgb")


def clean_scores(views: Sequence[ScoredView]) -> dict[str, float]:
    """Return the scores of some views against the truth, means over them.

    - psnr_clean_db, ssim_clean, lpips_clean (AlexNet; where its weights were fetched, and pictures are large enough).
    - psnr_clean_<exposure>_db: the first by exposure time; where they are few, unlike those of automatic brackets.
    - psnr_clean_pooled_db: of the mean squared error over all views together. The mean above is lifted by single views
      that are nearly exact (each counts up to 120 dB), this is not.
    - psnr_clean_foreground_db: of the pixels that the target covers; missing where it covers none.
    """
    by_exposure: dict[float, list[float]] = {}
    for view in views:
        by_exposure.setdefault(view.exposure_time_s, []).append(psnr_db(view.image, view.clean))
    figures = {"psnr_clean_db": _mean([value for values in by_exposure.values() for value in values])}
    for exposure_s, values in sorted(by_exposure.items()) if len(by_exposure) <= MOST_OFFERED else ():
        figures[f"psnr_clean_{exposure_s * 1e3:g}ms_db"] = _mean(values)
    errors = [(view.image.double() - view.clean.double()).square().mean().item() for view in views]
    figures["psnr_clean_pooled_db"] = -10 * math.log10(max(_mean(errors), 1e-12))
    foreground_db = foreground_psnr_db((view.image, view.clean, view.coverage) for view in views)
    if not math.isnan(foreground_db):
        figures["psnr_clean_foreground_db"] = foreground_db
    return figures | _similar([(view.image, view.clean) for view in views], "clean")


def _similar(pairs: Sequence[tuple[Tensor, Tensor]], name: str) -> dict[str, float]:
    """Return ssim_NAME and lpips_NAME of pairs of images in 0..1, means over them."""
    figures = {f"ssim_{name}": _mean([ssim(*pair) for pair in pairs])}
    if min(pairs[0][0].shape[:2]) >= SMALLEST_PX:
        try:
            figures[f"lpips_{name}"] = _mean([lpips(*pair, network="alex") for pair in pairs])
        except WeightsMissing as error:
            log.info("LPIPS is left out: %s", error)
    return figures


def mu_law_psnr_db(images: Sequence[Tensor], radiance: Sequence[Tensor]) -> float:
    """Return the mean PSNR of radiance after the mu-law, as publications on HDR count it.

    Args:
        images, radiance: [H, W, C] of a model and of the truth, in units of the brightest true pixel of all views.
    """
    return _mean([psnr_db(mu_law(a), mu_law(b)) for a, b in zip(images, radiance, strict=True)])


def cloud_scores(
    clouds_m: Mapping[str, np.ndarray],
    true_cloud_m: np.ndarray,
    units_per_m: float,
    shown: np.ndarray | None = None,
) -> dict[str, float]:
    """Return the distances of a model's points from the true surface, where the target's largest dimension is 2 units.

    Args:
        clouds_m: [N, 3] by what is added to the figures' names: nothing for the Gaussians' centres, or the points of a
            cloud; `_surface` for points on the model's surface, `_mesh` for points on its mesh.
        true_cloud_m: [K, 3], points of the true surface.
        units_per_m: 2 over the target's largest dimension.
        shown: [K], which of those the training frames show; None: unknown.

    Returns:
        chamfer, hausdorff, accuracy and completeness as `cloud_distances` has them, but for empty clouds; of surfaces
        also precision, recall and f, and their chamfer, as `surface_scores` has them; surface_shown: percentage of the
        true surface that the frames show.
    """
    true_cloud = true_cloud_m * units_per_m
    figures: dict[str, float] = {}
    for name, cloud_m in clouds_m.items():
        if len(cloud_m):
            distances = cloud_distances(cloud_m * units_per_m, true_cloud, shown)
            if name:  # points on a surface, not centres
                distances |= surface_scores(cloud_m * units_per_m, true_cloud)
            figures |= {f"{key}{name}": value for key, value in distances.items()}
    if shown is not None:
        figures["surface_shown"] = 100 * float(shown.mean())
    return figures


def of_similarity(figures: dict[str, float]) -> dict[str, float]:
    """Return those of the scores of a model after the best similarity that are shown beside those of a rigid motion."""
    return {f"similarity_{key}": figures[key] for key in OF_SIMILARITY if key in figures}


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values)
