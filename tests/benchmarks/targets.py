"""Rendered targets for comparisons: true radiance of 120 views, exposed and read out by the benchmark itself.

The folder (default ../shared/data, or OBBGS_TARGETS) holds NAME_400.npz: radiance [120, 400, 400, 3] (scene-linear),
alpha [120, 400, 400] (255 = full), world_to_camera [120, 4, 4], K [3, 3] px, cloud [M, 3] and the unit vector sun_dir
towards the Sun, [3] or [120, 3]; the target's largest dimension is 2 units, here 2 m. Nothing else of the project
reads them. `ground compare` takes them as sessions; with --sun their frames tell the Sun, as those of a pass do:

    python -m tests.benchmarks.targets --size 200 --out sessions TDRS DSCOVR
"""

import argparse
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import imagecodecs
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from compare.case import Case
from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.mission import CameraSection
from flightsw.icd.quaternion import matrix_to_quat
from ground.session.cameras import sensor_of
from ground.session.folder import SCHEMA_VERSION
from ground.session.truth import TrueFrame, write_truth
from ground.session.writer import frame_line
from hil.sky.sensor import PRESETS, RENDERED_PSF_SIGMA_PX, SensorModel, converted, read_out, through_lens
from obbgs_base.physics.stars import star_radiance
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor

FOLDER = Path(os.environ.get("OBBGS_TARGETS", Path(__file__).parents[3] / "shared" / "data"))
BRACKET_S = (5e-5, 1e-4, 2e-4)
HELD_OUT = 8  # views i mod 8 = 7
MID_SIGNAL = 0.7  # of full scale: the 97th percentile of covered pixels at the middle exposure
PAPER_SIGMA = 0.025  # of full scale
ELECTRONS_PER_DN = 1e9  # the paper's camera has no shot noise
LARGEST_DIMENSION = 2.0


@dataclass(frozen=True)
class View:
    """One view of a target: its frame, and its truth without noise."""

    frame: TrainingFrame
    radiance: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W] in 0..1
    finer: Tensor | None = None  # [400, 400, 3] the radiance before averaging, where that was done


@dataclass(frozen=True)
class Target:
    """A target's views as a camera sees them."""

    name: str
    sensor: Sensor
    views: list[View]
    cloud: np.ndarray  # [M, 3]


def names() -> list[str]:
    """Return the targets that are there."""
    return sorted(path.name.removesuffix("_400.npz") for path in FOLDER.glob("*_400.npz"))


def expose(
    name: str, size: int = 400, sigma: float = PAPER_SIGMA, seed: int = 0, with_sun: bool = False
) -> Target:
    """Return a target's views by the paper's 8-bit camera (Gaussian noise, then clipped); view i has exposure i mod 3.

    Args:
        size: pixels along a side; 400, or 200 and 100 by averaging.
        sigma: of the noise, full scale 1.
        with_sun: the frames tell the direction of the Sun.

    Raises:
        FileNotFoundError: no such target.
    """
    with np.load(FOLDER / f"{name}_400.npz") as arrays:
        radiance = torch.from_numpy(arrays["radiance"].astype(np.float32))
        alpha = torch.from_numpy(arrays["alpha"].astype(np.float32) / 255)
        poses = torch.from_numpy(arrays["world_to_camera"].astype(np.float32))
        K = torch.from_numpy(arrays["K"].astype(np.float32))
        cloud = arrays["cloud"].astype(np.float64)
        suns = [None] * len(radiance)
        if with_sun:
            towards = torch.from_numpy(arrays["sun_dir"].astype(np.float32)).expand(len(radiance), 3)
            suns = list(F.normalize(towards, dim=1))
    lit = radiance.mean(-1)[alpha >= 230 / 255]
    # full scale per radiance and second
    gain = MID_SIGNAL / (float(np.percentile(lit.numpy(), 97)) * BRACKET_S[1])
    finer: list[Tensor | None] = [None] * len(radiance)
    if size != radiance.shape[1]:
        finer = list(radiance)
        factor = radiance.shape[1] // size
        radiance = F.avg_pool2d(radiance.movedim(-1, 1), factor).movedim(1, -1)
        alpha = F.avg_pool2d(alpha[:, None], factor)[:, 0]
        K = K * torch.tensor([[1 / factor], [1 / factor], [1.0]])
    sensor = Sensor(0.0, 255.0, 255.0 * gain, ELECTRONS_PER_DN, 255.0 * sigma)
    noise, views = np.random.default_rng(seed), []
    for i in range(len(radiance)):
        exposure_s = BRACKET_S[i % len(BRACKET_S)]
        signal = radiance[i] * gain * exposure_s  # full scale = 1, not clipped yet
        dn = converted(255 * signal.double().numpy(), 255 * sigma, 255, noise)
        frame = TrainingFrame(
            torch.from_numpy(dn.astype(np.float32)), exposure_s, poses[i], K, i, sun_dir=suns[i]
        )
        views.append(View(frame, radiance[i], alpha[i], finer[i]))
    return Target(name, sensor, views, cloud)


def exposed_by(target: Target, model: SensorModel, seed: int = 0) -> Target:
    """Return the same views as another sensor reads them, with its optics, its faults and the stars behind the target.

    The gain is such that the same radiance fills the same share of its range. Colours become grey for a mono sensor.
    The truth is what its lens leaves of the radiance; vignetting and the pixels' faults are no part of it, since no
    calibration tells them to a method.
    """
    model = model.with_gain(
        target.sensor.dn_per_radiance_s * (model.white_dn - model.black_dn) / target.sensor.white_dn
    )
    height, width = target.views[0].frame.dn.shape[:2]
    camera = model.camera_section(width, height, target.views[0].frame.K[0, 0].item())
    noise, views = np.random.default_rng(seed), []
    for view in target.views:
        frame, light = view.frame, view.radiance.double().numpy()
        if model.colour == "mono":
            light = light.mean(axis=2, keepdims=True)
        seen = light
        if model.stars:
            gcrs_to_camera = frame.world_to_camera[:3, :3].double().numpy()
            sky = star_radiance(gcrs_to_camera, frame.K.double().numpy(), width, height)
            seen = light + (sky * (1 - view.alpha.double().numpy()))[..., None]
        dn = torch.from_numpy(read_out(model, seen, frame.exposure_time_s, noise).astype(np.float32))
        exposed = replace(frame, dn=dn, psf_sigma_px=camera.psf_sigma_px)
        views.append(View(exposed, torch.from_numpy(through_lens(light, camera)), view.alpha))
    return replace(target, sensor=sensor_of(camera), views=views)


def load(name: str, size: int = 400, sigma: float = PAPER_SIGMA, seed: int = 0) -> Case:
    """Return a target as a case of a comparison, every eighth view held out; the arguments are those of `expose`."""
    target = expose(name, size, sigma, seed)
    held_out = target.views[HELD_OUT - 1 :: HELD_OUT]
    training = [view.frame for i, view in enumerate(target.views) if i % HELD_OUT != HELD_OUT - 1]
    return Case(
        name,
        target.sensor,
        training,
        [view.frame for view in held_out],
        [view.radiance for view in held_out],
        [view.alpha for view in held_out],
        target.cloud,
        2 / LARGEST_DIMENSION,
    )


def write(target: Target, session: Path) -> None:
    """Write a target as a session with its truth, whole or not at all.

    Each view is a bracket of its own, so that every eighth is held out.
    """
    part = session.with_name(f".{session.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    (part / "frames").mkdir(parents=True)
    camera = _camera(target)
    lines = []
    for view in target.views:
        file = f"frames/{view.frame.id:06d}.png"
        frame = _frame(view, camera)
        picture = bytes(imagecodecs.png_encode(frame.dn, level=1))
        (part / file).write_bytes(picture)
        line = frame_line(frame, file, hashlib.sha256(picture).hexdigest())
        # exactly the pose that the frame has: one made of a quaternion differs in the last digits
        lines.append(json.dumps(line | {"world_to_camera": view.frame.world_to_camera.tolist()}))
    (part / "frames.jsonl").write_text("\n".join(lines) + "\n")
    header = {
        "schema_version": SCHEMA_VERSION,
        "mission_sha256": hashlib.sha256(target.name.encode()).hexdigest(),
        "imported_from": f"rendered target {target.name}",
        "camera": asdict(camera),
        "tles": {},
        "losses": {},
        "frames_received": len(target.views),
        "bytes_received": 0,
        "created_utc": "2026-01-01T00:00:00+00:00",
    }
    (part / "session.json").write_text(json.dumps(header, indent=2) + "\n")
    write_truth(
        part,
        _true_frames(target),
        target.cloud,
        np.empty((0, 3), int),
        target.cloud,
        largest_dimension_m=LARGEST_DIMENSION,
    )
    part.rename(session)


def _camera(target: Target) -> CameraSection:
    frame, sensor = target.views[0].frame, target.sensor
    height, width, channels = frame.dn.shape
    K = frame.K.double()
    return CameraSection(
        width=width,
        height=height,
        fx_px=K[0, 0].item(),
        fy_px=K[1, 1].item(),
        cx_px=K[0, 2].item(),
        cy_px=K[1, 2].item(),
        channels=channels,
        bit_depth=round(math.log2(sensor.white_dn + 1)),
        black_dn=sensor.black_dn,
        dn_per_radiance_s=sensor.dn_per_radiance_s,
        electrons_per_dn=sensor.electrons_per_dn,
        read_noise_dn=sensor.read_noise_dn,
        psf_sigma_px=frame.psf_sigma_px or RENDERED_PSF_SIGMA_PX,
    )


def _frame(view: View, camera: CameraSection) -> Frame:
    frame, pose = view.frame, view.frame.world_to_camera.double().numpy()
    dn = frame.dn.numpy().astype(np.uint16)
    return Frame(
        frame_id=frame.id,
        bracket_id=frame.id,
        bracket_index=0,
        bracket_count=1,
        exposure_time_s=frame.exposure_time_s,
        mid_exposure_utc_ns=frame.id * 1_000_000_000,
        pose=PoseTag(
            quat_body_to_camera=matrix_to_quat(pose[:3, :3]),
            position_body_m=-pose[:3, :3].T @ pose[:3, 3],
            covariance=np.zeros((6, 6)),
            sun_dir_body=np.zeros(3) if frame.sun_dir is None else frame.sun_dir.double().numpy(),
            in_eclipse=False,
            valid=True,
            source="none",
        ),
        dn=dn if camera.channels == 3 else dn[..., 0],
        bit_depth=camera.bit_depth,
        black_dn=camera.black_dn,
        saturated_count=int((dn >= camera.white_dn).any(axis=2).sum()),
    )


def _true_frames(target: Target) -> Iterator[TrueFrame]:
    for view in target.views:
        alpha = (255 * view.alpha).round().numpy().astype(np.uint8)
        pose = view.frame.world_to_camera.double().numpy()
        finer = None if view.finer is None else view.finer.numpy()
        yield TrueFrame(view.frame.id, pose, view.radiance.numpy(), alpha, finer=finer)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("targets", nargs="*", help="names; default: all")
    parser.add_argument("--size", type=int, default=400, choices=(400, 200, 100), help="pixels along a side")
    parser.add_argument(
        "--sensor",
        choices=PRESETS,
        default="paper",
        help="spacecam: with its lens, its faults, blooming and stars",
    )
    parser.add_argument("--sun", action="store_true", help="the frames tell the direction of the Sun")
    parser.add_argument("--out", type=Path, required=True, help="where to write NAME-SIZE")
    arguments = parser.parse_args()
    if wrong := set(arguments.targets).difference(names()):
        parser.error(f"no target {', '.join(sorted(wrong))} in {FOLDER}; there are {', '.join(names())}")
    for name in arguments.targets or names():
        other = arguments.sensor != "paper"
        suffix = f"-{arguments.sensor}" * other + "-sun" * arguments.sun
        session = arguments.out / f"{name}-{arguments.size}{suffix}"
        if not session.exists():
            target = expose(name, arguments.size, with_sun=arguments.sun)
            write(
                exposed_by(target, replace(PRESETS[arguments.sensor], blooming=True)) if other else target,
                session,
            )
        print(session)


if __name__ == "__main__":
    main()
