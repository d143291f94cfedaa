"""The report's view of the model: its Gaussians packed into the page, which draws them with WebGL and no network."""

import base64
import json
from pathlib import Path

import numpy as np
import torch

from ground.run.estimated_poses import as_estimated, read_estimate
from ground.run.runs import Run
from ground.session.cameras import median_sun_direction, sun_direction
from ground.session.exposures import offered_s
from ground.session.folder import FrameRecord
from ground.session.spread import evenly_spread
from ground.show.turntable import VIEWS, circle, extent, metres_per_pixel, moving_png, pictures
from obbgs_core.model.footprint import KERBL_PX2, MIP_SPLATTING_PX2, PIXEL_PX2, lowers_peak
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import sunlit_shares
from obbgs_core.render.highlights import lobe_axes

WEB = Path(__file__).with_name("web")
MOST_SPLATS = 200_000  # more make a page of over 30 MB; the faintest are left out
SUNS = 12  # positions along the pass whose shadows are kept
MOVES_RAD = 0.02  # a Sun that moves less stands still
PICTURE_PX = (360, 240)  # width and height of the turntable
EXPOSURE_REACH = 4.0  # the slider reaches from a quarter of the shortest exposure to four times the longest


def splat_view(run: Run) -> str:
    """Return the view as HTML: the model, its controls, and a turntable for browsers that cannot draw it."""
    gaussians = _strongest(run.gaussians.detach())
    facts, arrays = packed(run, gaussians)
    data = "".join(
        f'<script type="text/plain" data-part="{name}">{base64.b64encode(values.tobytes()).decode()}</script>'
        for name, values in arrays.items()
    )
    middle_s = facts["exposures_s"][len(facts["exposures_s"]) // 2]
    cameras = circle(gaussians, run.session, VIEWS, *PICTURE_PX)
    turning = moving_png(pictures(gaussians, run.session, run.sensor, middle_s, cameras))
    source = "data:image/png;base64," + base64.b64encode(turning).decode()
    program = "".join((WEB / name).read_text() for name in ("splats.js", "orbit.js"))
    return (
        f"<style>{(WEB / 'splats.css').read_text()}</style>"
        '<div class="splats"><div class="stage">'
        f'<img alt="the model, turning" src="{source}"><canvas data-part="canvas" tabindex="0" '
        'aria-label="the model: drag to turn, wheel to zoom"></canvas><canvas data-part="marks"></canvas></div>'
        f'<div class="controls">{_controls(facts)}</div>'
        '<p class="without">This browser does not draw 3D (WebGL 2): a turntable is shown instead.</p>'
        f'<script type="application/json" data-part="model">{json.dumps(facts)}</script>{data}</div>'
        f'<script>"use strict";(() => {{\n{program}}})();</script>'
    )


def packed(run: Run, gaussians: Gaussians) -> tuple[dict, dict[str, np.ndarray]]:
    """Return what the page needs to draw the Gaussians: facts for JSON, and arrays.

    means: [N, 3] float32, m. params: [N, texels, 4] float16: quaternion, log scales and opacity, coefficients of
    radiance padded with zeros, then axis and weight of the highlight in a model that has them. sunlit: [suns, N] bytes,
    the share of each Sun that reaches a Gaussian, 255 for all.
    """
    session, count = as_estimated(run.session, read_estimate(run.folder)), len(gaussians)
    suns = _suns(session.frames) if gaussians.shading != "view" else _suns(session.frames)[:1]
    sunlit = np.zeros((0, count), np.uint8)
    if gaussians.shading == "lambert":
        sunlit = (
            (255 * sunlit_shares(gaussians, torch.stack(suns)).clamp(0, 1)).round().numpy().astype(np.uint8)
        )
    colours = gaussians.sh.flatten(1)
    padding = torch.zeros(count, -colours.shape[1] % 4)
    shape = torch.cat([gaussians.log_scales, gaussians.opacities[:, None]], dim=1)
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    lobes = gaussians.lobes.clone()  # a texel at the end: the axis and the weight itself
    if gaussians.has_highlights:
        lobes = torch.cat([lobe_axes(gaussians), lobes[:, -1:].exp()], dim=1)
    params = torch.cat([quats, shape, colours, padding, lobes], dim=1)
    centre, radius_m = extent(gaussians)
    middle = session.frames[len(session.frames) // 2].position_body_m - centre.numpy()
    x, y, z = (middle / max(float(np.linalg.norm(middle)), 1e-9)).tolist()
    sensor = run.sensor
    facts = {
        "count": count,
        "texels": params.shape[1] // 4,
        "coefficients": gaussians.sh.shape[1],
        "channels": gaussians.sh.shape[2],
        "shading": gaussians.shading,
        "ambient": float(gaussians.ambient),
        "gloss": _gloss(gaussians),
        "footprint": footprint_facts(gaussians, session.camera.psf_sigma_px),
        "centre_m": centre.tolist(),
        "radius_m": radius_m,
        "metres_per_sensor_px": metres_per_pixel(session),
        "sensor": {key: getattr(sensor, key) for key in ("black_dn", "white_dn", "dn_per_radiance_s")},
        "encoding": session.encoding,
        "background": session.background,
        "nominal": session.nominal_exposures,
        "exposures_s": sorted({record.exposure_time_s for record in session.frames}),
        "suns": [[round(v, 6) for v in sun.tolist()] for sun in suns],
        "cameras": _directions(session.frames),
        "start_rad": [float(np.arctan2(y, x)), float(np.clip(np.arcsin(z), -1.5, 1.5))],
    }
    arrays = {"means": gaussians.means.numpy(), "params": params.numpy().astype(np.float16), "sunlit": sunlit}
    return facts, arrays


def _gloss(gaussians: Gaussians) -> dict | None:
    """Return roughness, peak radiance (three channels) and static Sun of the highlights; None without them."""
    if not gaussians.has_highlights:
        return None
    alpha, *peak = gaussians.gloss.exp().tolist()
    sun = gaussians.static_sun.tolist() or None
    return {"alpha": alpha, "peak": peak if len(peak) == 3 else 3 * peak, "sun": sun}


def footprint_facts(gaussians: Gaussians, psf_sigma_px: float | None) -> dict:
    """Return the footprint as a variance in px² of the screen and one in px² of the sensor, and whether peaks fall."""
    psf = float(gaussians.psf_sigma_px) if psf_sigma_px is None else psf_sigma_px
    constant, sensor = {
        "kerbl": (KERBL_PX2, 0.0),
        "mip-splatting": (MIP_SPLATTING_PX2, 0.0),
        "camera": (PIXEL_PX2, psf**2),
    }[gaussians.footprint]
    return {"constant_px2": constant, "sensor_px2": sensor, "lowers_peak": lowers_peak(gaussians)}


def _strongest(gaussians: Gaussians) -> Gaussians:
    """Return the finite Gaussians; of a very large model those that cover most, in their order."""
    numbers = [values.reshape(len(gaussians), -1) for values in gaussians.tensors().values()]
    gaussians = gaussians.select(torch.cat(numbers, dim=1).isfinite().all(dim=1))
    if len(gaussians) <= MOST_SPLATS:
        return gaussians
    two_longest = gaussians.scales.sort(dim=1).values[:, 1:].prod(dim=1)
    kept = (gaussians.opacities * two_longest).topk(MOST_SPLATS).indices
    return gaussians.select(kept.sort().values)


def _suns(frames: tuple[FrameRecord, ...]) -> list[torch.Tensor]:
    """Return directions [3] to the Sun along the pass, in order of time; one where it stands still, none if unknown."""
    in_time = sorted(frames, key=lambda record: record.mid_exposure_utc_ns)
    known = [sun for record in in_time if (sun := sun_direction(record)) is not None]
    median = median_sun_direction(in_time)
    if median is None:
        return []
    if min(float(sun @ median) for sun in known) > np.cos(MOVES_RAD):
        return [median]
    return evenly_spread(known, SUNS)


def _directions(frames: tuple[FrameRecord, ...]) -> list[list[float]]:
    """Return the unit vectors from the body's origin to the cameras, one for each bracket."""
    places = {record.bracket: record.position_body_m for record in frames}.values()
    return [np.round(place / max(float(np.linalg.norm(place)), 1e-9), 4).tolist() for place in places]


def _controls(facts: dict) -> str:
    exposures_s = facts["exposures_s"]
    low, high = np.log2(exposures_s[0] / EXPOSURE_REACH), np.log2(exposures_s[-1] * EXPOSURE_REACH)
    name = "Brightness" if facts["nominal"] else "Exposure"
    parts = [
        f'<label>{name} <input type="range" data-part="exposure" min="{low:.4f}" max="{high:.4f}" step="0.01">'
        '<output data-part="exposed"></output></label>'
    ]
    if not facts["nominal"]:
        shown = "".join(
            f'<button type="button" data-exposure="{time_s!r}">{text} ms</button>'
            for text, time_s in offered_s(exposures_s).items()
        )
        parts.append(f'<span role="group" aria-label="exposures of the brackets">{shown}</span>')
    if len(facts["suns"]) > 1:
        last = len(facts["suns"]) - 1
        parts.append(
            f'<label>Sun along the pass <input type="range" data-part="sun" min="0" max="{last}" step="0.05" '
            f'value="{last / 2}"></label>'
        )
    parts.append('<label><input type="checkbox" data-part="cameras"> camera directions</label>')
    parts += [
        f'<button type="button" data-part="{part}">{text}</button>'
        for part, text in (("turn", "Rotate"), ("reset", "Reset view"), ("save", "Save picture"))
    ]
    return "".join(parts)
