"""A first silhouette in front of the Earth: what differs from the Earth where that is even, such as over an ocean."""

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.background import earth_pixels, grown
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor, dark_reading
from obbgs_core.start.hull import CERTAIN_SIGMA, SPECK, Silhouette, silhouette

SWEEPS = 10  # of the fit to the Earth, each without what is far from the one before
FAR = 3.0  # deviations
EVEN = 2.5  # the Earth is even where it scatters by at most so many times the noise
LIKELY_SIGMA = 3.0  # of the mean of 3x3 pixels, from the Earth
FEWEST_PX = 100  # of the Earth, that a fit is made to
MOST_SATURATED = 0.02
BRIGHT = 6.0  # deviations of the noise; in front of a darker Earth a dark face does not show


def earth_silhouette(frame: TrainingFrame, sensor: Sensor) -> Silhouette:
    """Return the silhouette of a frame that has the Earth in view.

    In front of the sky it is that of any frame. In front of the Earth, a surface of the second degree is fitted to the
    picture: where the Earth scatters about it by little more than the noise, what differs is light of something else or
    hides the Earth. Elsewhere nothing is known, and the target is likely everywhere, so that such frames carve nothing.
    """
    earth = earth_pixels(frame)
    outside = silhouette(
        torch.where(earth[..., None], sensor.black_dn, frame.dn), sensor, frame.world_to_camera, frame.K
    )
    edge = grown(earth, 2)
    likely, certain, sky = outside.likely | edge, outside.certain & ~edge, outside.sky & ~edge
    differs = _difference(frame.dn.mean(dim=-1).double(), earth, frame.dn.shape[2], sensor)
    if differs is not None:
        mean = F.avg_pool2d(differs[None, None], 3, 1, 1, count_include_pad=False)[0, 0] * 3
        seen = mean.abs() > LIKELY_SIGMA
        certain = certain | (earth & (mean.abs() > CERTAIN_SIGMA))
        certain = certain & (F.avg_pool2d(certain[None].float(), 3, 1, 1)[0] > SPECK)
        likely = torch.where(earth, seen, likely)
    return Silhouette(certain, likely, sky, frame.world_to_camera, frame.K)


def _difference(grey: Tensor, earth: Tensor, channels: int, sensor: Sensor) -> Tensor | None:
    """Return by how many deviations grey [H, W] differs from an even Earth, 0 beside it; None where it is not even."""
    full = grey >= sensor.white_dn * 0.99
    if int(earth.sum()) < FEWEST_PX or full[earth].float().mean() > MOST_SATURATED:
        return None
    height, width = grey.shape
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    basis = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=-1).double()[earth]
    values, noise = grey[earth], dark_reading(sensor)[1] / channels**0.5
    if values.median() < sensor.black_dn + BRIGHT * noise:
        return None
    kept = (values - values.median()).abs() < FAR * 1.5 * (values - values.median()).abs().median() + 1e-6
    residual, scatter = values - values.median(), values.new_zeros(())
    for _ in range(SWEEPS):
        if int(kept.sum()) < FEWEST_PX // 2:
            return None
        fit = torch.linalg.lstsq(basis[kept], values[kept, None]).solution
        residual = values - (basis @ fit)[:, 0]
        scatter = 1.4826 * residual[kept].abs().median()
        kept = residual.abs() < FAR * scatter
    if scatter > EVEN * noise or kept.float().mean() < 0.5:
        return None
    image = torch.zeros_like(grey)
    image[earth] = residual / max(float(scatter), noise)
    return image.float()
