"""A model as the viewer's program draws it: covariances, opacities and one display colour for each Gaussian.

The program (viser) blends display colours and widens Gaussians by 0.3 px² of its own screen. The footprint of the
session's pixels is therefore part of the covariances, as in Mip-Splatting's 3D filter, and the share by which it lowers
a peak, in the mean over the session's cameras, part of the opacities.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ground.run.runs import without_own_sky
from ground.session.cameras import cameras_of, exposed, sun_direction
from ground.session.folder import FrameRecord, Session, SessionError
from ground.session.spread import evenly_spread
from ground.session.training_frames import split, told_before, training_frame
from ground.show.pictures import tone
from ground.show.turntable import metres_per_pixel
from ground.show.viewer.source import Shown
from obbgs_core.frames import cameras_of as cameras_of_frames
from obbgs_core.model.footprint import variance_px2
from obbgs_core.model.sh import C0
from obbgs_core.render import project, render, sunlit_shares, weighted_gradient
from obbgs_core.render.backdrops import without_earth
from obbgs_core.render.lighting import radiance_along
from obbgs_core.score.uncertainty import parameter_deviations

VIEWS = 12  # of the session's cameras over which the lowered peaks are averaged
FRAMES = 24  # at most, that overlays are made of
CHI2_SHOWN = (1.0, 100.0)  # from the darkest to the brightest colour
DEVIATION_SHOWN = (0.003, 0.3)  # of full scale
TARGET_SHARE, SEEN_FRAMES, NEAR_ENOUGH = (
    0.6,
    5,
    2.5,
)  # of full scale; frames looked at; factor between brackets
WELL_SEEN = (0.05, 0.95)  # shares of full scale above black between which a pixel shows the target
NOT_SEEN = (90, 90, 110)  # colour of Gaussians that no frame shows
RAMP = np.array(
    [[13, 8, 135], [126, 3, 168], [204, 71, 120], [248, 149, 64], [240, 249, 33]], dtype=float
)  # plasma


@dataclass(frozen=True)
class Shapes:
    """Where Gaussians are and how they cover, without colours: covariances [N, 3, 3] m², opacities [N]."""

    means: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray


@torch.no_grad()
def shapes(shown: Shown) -> Shapes:
    """Return the shapes of a model's Gaussians for a program with another footprint."""
    gaussians, session = shown.gaussians, shown.session
    variance = float(variance_px2(gaussians, session.camera.psf_sigma_px))
    widened = gaussians.covariances() + variance * metres_per_pixel(session) ** 2 * torch.eye(3)
    projected = project(gaussians, cameras_of(session, evenly_spread(session.frames, VIEWS)))
    seen = projected.depths > 0
    share = (projected.peak_shares * seen).sum(dim=0) / seen.sum(dim=0).clamp(min=1)
    return Shapes(gaussians.means.numpy(), widened.numpy(), (gaussians.opacities * share).numpy())


@torch.no_grad()
def colours(shown: Shown, record: FrameRecord, exposure_time_s: float) -> np.ndarray:
    """Return the display colours [N, 3], bytes, seen from a frame's camera under its Sun, at an exposure time."""
    gaussians, session = shown.gaussians, shown.session
    directions = torch.nn.functional.normalize(
        gaussians.means - cameras_of(session, [record]).centres[0], dim=1
    )
    sun = sun_direction(record)
    sunlit = None
    if gaussians.shading == "lambert" and sun is not None:
        sunlit = sunlit_shares(gaussians, sun[None])[0]
    radiance = radiance_along(gaussians, directions, sun, sunlit)
    image = exposed(radiance[None], shown.sensor, exposure_time_s).numpy()
    return tone(image, shown.sensor, session.encoding)[0]


def error_colours(shown: Shown) -> np.ndarray:
    """Return colours [N, 3], bytes, of the misfit: each Gaussian's mean squared residual over the noise, its chi².

    The mean is over the pixels of the frames, as if their sky was black, weighted by how much of each the Gaussian is.
    It is the derivative of the weighted image by the Gaussian's radiance.
    """
    probe = dataclasses.replace(
        shown.gaussians.detach().matt(),
        sh=torch.full(
            (len(shown.gaussians), 1, 1), 10 / C0
        ).requires_grad_(),  # radiance 10: softplus is linear
        shading="view",
    )
    total, weight = torch.zeros(len(probe)), torch.zeros(len(probe))
    for taken in _frames(shown.session):
        cameras = cameras_of_frames([taken])
        with torch.no_grad():
            frame = without_earth(shown.gaussians, without_own_sky(taken, shown.sensor), shown.sensor)
            radiance = render(shown.gaussians, cameras).radiance[0]
            residual = shown.sensor.normalised_residual(radiance, frame.exposure_time_s, frame.dn)
            squared = residual.square().mean(dim=-1, keepdim=True)
        image = render(probe, cameras).radiance[0]
        total += _gradient(image, squared, probe.sh, keep=True)
        weight += _gradient(image, torch.ones_like(squared), probe.sh, keep=False)
    return _ramp(total / weight.clamp(min=1e-9), weight > 0, CHI2_SHOWN)


def uncertainty_colours(shown: Shown) -> np.ndarray:
    """Return colours [N, 3], bytes, of how unsure each Gaussian's radiance is: its standard deviation over full scale.

    The deviation is that of the parameters' posterior (`parameter_deviations`), full scale that of the middle exposure.
    """
    exposures_s = sorted({record.exposure_time_s for record in shown.session.frames})
    deviations = parameter_deviations(shown.gaussians, _frames(shown.session), shown.sensor)["sh"]
    radiance = C0 * deviations[:, 0].mean(dim=1)
    share = radiance / shown.sensor.full_scale_radiance(exposures_s[len(exposures_s) // 2])
    return _ramp(share, torch.ones(len(share), dtype=torch.bool), DEVIATION_SHOWN)


def seen_exposure_s(shown: Shown) -> float:
    """Return an exposure time at which the model is well seen: that of a bracket where one is near enough.

    Well seen: nine tenths of what the middle frames show of the model are below TARGET_SHARE of full scale, and the
    rest above.
    """
    session, sensor = shown.session, shown.sensor
    radiances = []
    for record in evenly_spread(session.frames, SEEN_FRAMES):
        with torch.no_grad():
            rendered = render(shown.gaussians, cameras_of(session, [record]))
        radiances.append(
            rendered.radiance[0].mean(dim=-1)[rendered.alpha[0].reshape(rendered.radiance.shape[1:3]) > 0.5]
        )
    lit = torch.cat(radiances)
    exposures_s = sorted({record.exposure_time_s for record in session.frames})
    if not len(lit) or not (bright := float(lit.quantile(0.9))) > 0:
        return exposures_s[len(exposures_s) // 2]
    wanted_s = TARGET_SHARE * sensor.full_scale_radiance(1.0) / bright
    nearest_s = min(exposures_s, key=lambda time_s: abs(np.log(time_s / wanted_s)))
    return nearest_s if 1 / NEAR_ENOUGH < nearest_s / wanted_s < NEAR_ENOUGH else wanted_s


def best_seen(shown: Shown, exposure_time_s: float) -> FrameRecord:
    """Return the frame in which the target is best seen, of those nearest to an exposure time in some brackets.

    Best seen: most pixels of the model are well above black in the frame, and not saturated, and fewest beside it are.
    Frames that cannot be read show nothing.
    """
    session, sensor = shown.session, shown.sensor
    nearest: dict[int, FrameRecord] = {}
    for record in session.frames:
        kept = nearest.setdefault(record.bracket, record)
        if abs(record.exposure_time_s - exposure_time_s) < abs(kept.exposure_time_s - exposure_time_s):
            nearest[record.bracket] = record

    def pixels_seen(record: FrameRecord) -> int:
        try:
            dn = torch.from_numpy(session.dn(record).astype(np.float32)).reshape(
                session.camera.height, session.camera.width, -1
            )
        except SessionError:
            return 0
        with torch.no_grad():
            alpha = render(shown.gaussians, cameras_of(session, [record])).alpha[0]
        share = (dn.mean(dim=-1) - sensor.black_dn) / (sensor.white_dn - sensor.black_dn)
        target, lit = alpha.reshape(share.shape) > 0.5, share > WELL_SEEN[0]
        beside = lit & ~(alpha.reshape(share.shape) > 0)  # the Earth behind it
        return int((target & lit & (share < WELL_SEEN[1])).sum() - beside.sum())

    return max(evenly_spread(list(nearest.values()), VIEWS), key=pixels_seen)


def legend(limits: tuple[float, float], unit: str) -> str:
    """Return the scale of an overlay's colours as HTML: logarithmic, from its darkest to its brightest."""
    stops = ", ".join(f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in RAMP)
    low, high = limits
    ticks = "".join(f"<span>{t:g}</span>" for t in (low, (low * high) ** 0.5, high))
    grey = f"rgb{NOT_SEEN}"
    return (
        f'<div style="padding: 2px 14px 8px; font-size: 12px"><div style="height: 10px; border-radius: 3px; '
        f'background: linear-gradient(90deg, {stops})"></div><div style="display: flex; '
        f'justify-content: space-between">{ticks}</div>{unit}<br><span style="color: {grey}">■</span> seen by no frame'
        "</div>"
    )


def _frames(session: Session) -> list:
    training, _ = split(session, on_warning=told_before)
    return [training_frame(session, record) for record in evenly_spread(training, FRAMES)]


def _gradient(image: Tensor, weights: Tensor, sh: Tensor, keep: bool) -> Tensor:
    return weighted_gradient(image, weights, sh, keep)[:, 0, 0] / C0


def _ramp(values: Tensor, known: Tensor, limits: tuple[float, float]) -> np.ndarray:
    """Return values on a logarithmic scale of colours, bytes [N, 3]."""
    low, high = np.log(limits)
    at = (np.log(values.clamp(min=1e-12).detach().numpy()) - low) / (high - low)
    places = np.linspace(0, 1, len(RAMP))
    shown = np.stack([np.interp(at, places, RAMP[:, c]) for c in range(3)], axis=1)
    return np.where(known.numpy()[:, None], shown, NOT_SEEN).round().astype(np.uint8)
