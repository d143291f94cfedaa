"""Makes docs/turntable.gif from a finished demo: python docs/make_turntable.py demo/session demo

The camera circles the target once at one elevation in its body frame; the Sun is where it was in the session.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ground.run.estimated_poses import as_estimated, read_estimate
from ground.run.runs import Run, open_run
from ground.session.cameras import exposed, median_sun_direction
from ground.show.turntable import looking_at
from obbgs_core.model.cameras import Cameras
from obbgs_core.render import render

OUT = Path(__file__).with_name("turntable.gif")
VIEWS, WIDTH, HEIGHT = 36, 480, 320
ELEVATION_DEG = 25.0  # above the body's xy plane; the demo's cameras stood between -4 and 38 degrees
FRAME_MS = 90
MARGIN = 1.04  # of the target's radius
GREYS = 64


def main(session_dir: Path, name: str, out: Path = OUT) -> None:
    run = open_run(session_dir, name)
    exposures_s = sorted({record.exposure_time_s for record in run.session.frames})
    exposure_s = exposures_s[len(exposures_s) // 2]  # the middle of the bracket
    black = run.sensor.black_dn / run.sensor.white_dn
    with torch.no_grad():
        radiance = render(run.gaussians, turntable(run)).radiance
    pictures = []
    for image in exposed(radiance, run.sensor, exposure_s).numpy():
        shown = srgb(np.clip((image - black) / (1 - black), 0, 1).mean(axis=2))
        grey = np.rint(shown * (GREYS - 1)) / (GREYS - 1)
        pictures.append(Image.fromarray(np.rint(255 * grey).astype(np.uint8)))
    pictures[0].save(out, save_all=True, append_images=pictures[1:], duration=FRAME_MS, loop=0, optimize=True)
    print(f"{out}: {len(pictures)} views, {out.stat().st_size / 1e6:.2f} MB")


def turntable(run: Run) -> Cameras:
    """Return cameras around the target at the session's median range, which fills the images' width; body z is up."""
    solid = run.gaussians.means[run.gaussians.opacities > 0.5]
    radius_m = float(torch.quantile(solid.norm(dim=1), 0.995))
    posed = as_estimated(run.session, read_estimate(run.folder)).frames
    range_m = float(np.median([np.linalg.norm(record.position_body_m) for record in posed]))
    focal_px = WIDTH / 2 * range_m / (MARGIN * radius_m)
    K = torch.tensor([[focal_px, 0, WIDTH / 2], [0, focal_px, HEIGHT / 2], [0, 0, 1.0]])
    elevation_rad = float(np.radians(ELEVATION_DEG))
    azimuths_rad = 2 * np.pi * np.arange(VIEWS) / VIEWS
    poses = [looking_at(torch.zeros(3), range_m, float(a), elevation_rad) for a in azimuths_rad]
    sun_dir = median_sun_direction(list(run.session.frames))
    return Cameras(
        torch.stack(poses),
        K.expand(VIEWS, 3, 3),
        WIDTH,
        HEIGHT,
        sun_dir=None if sun_dir is None else sun_dir.expand(VIEWS, 3),
    )


def srgb(linear: np.ndarray) -> np.ndarray:
    """Return linear light of 0 to 1 on the sRGB curve (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
