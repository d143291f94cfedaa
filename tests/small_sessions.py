"""Sessions of a few small pictures with their truth, for tests of comparisons."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flightsw.icd.quaternion import matrix_to_quat
from obbgs_base.physics.navigation_errors import SharedParameters
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from tests import scenes
from tests.benchmarks.targets import Target, View, write

SIZE_PX, FOCAL_PX, VIEWS = 40, 80.0, 24
BORESIGHT_RAD, OWN_RAD = 0.06, 0.003  # 5 and a quarter of a pixel


def small_session(folder: Path, seed: int = 0, views: int = VIEWS, pedestal_dn: float = 0.0) -> Path:
    """Write a session of 40x40 pixels in three exposure times, every eighth view held out, and return its folder.

    pedestal_dn: added to all readings.
    """
    gaussians = scenes.target(seed=seed)
    frames = scenes.photographed(gaussians, views, seed, SIZE_PX, FOCAL_PX)
    if pedestal_dn:
        raised = [(f.dn + pedestal_dn).clamp(max=scenes.SENSOR.white_dn) for f in frames]
        frames = [dataclasses.replace(f, dn=dn) for f, dn in zip(frames, raised, strict=True)]
    _write(frames, gaussians, seed, folder)
    return folder


def erring_session(folder: Path, seed: int = 0, brackets: int = VIEWS) -> Path:
    """Write a session of brackets of three exposures whose tags err, as they say; return its folder.

    All are turned by the same 0.06 rad about the camera's x and y axes, and each bracket by about 0.003 rad more. The
    truth has the true poses.
    """
    gaussians = scenes.target(seed=seed)
    of_exposure = [
        scenes.photographed(gaussians, brackets, seed, SIZE_PX, FOCAL_PX, (exposure_s,))
        for exposure_s in scenes.EXPOSURES_S
    ]  # from the same poses each
    in_time = [frame for bracket in zip(*of_exposure, strict=True) for frame in bracket]
    numbered = [dataclasses.replace(frame, id=number) for number, frame in enumerate(in_time)]
    _write(numbered, gaussians, seed, folder)
    own = OWN_RAD * np.random.default_rng(seed).normal(size=(brackets, 3))
    boresight = BORESIGHT_RAD * np.array([1.0, -1.0, 0.0])
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        line["bracket"], line["bracket_index"] = divmod(line["id"], len(scenes.EXPOSURES_S))
        pose = np.array(line["world_to_camera"])
        turn = np.eye(4)
        turn[:3, :3] = (
            Rotation.from_rotvec(boresight) * Rotation.from_rotvec(own[line["bracket"]])
        ).as_matrix()
        pose = turn @ pose
        line["world_to_camera"], line["quat_body_to_camera"] = (
            pose.tolist(),
            matrix_to_quat(pose[:3, :3]).tolist(),
        )
        line["covariance"] = np.diag([0.0] * 3 + [OWN_RAD**2] * 3).tolist()
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    header = json.loads((folder / "session.json").read_text())
    sigmas = SharedParameters(boresight_rad=np.full(3, BORESIGHT_RAD))
    header["navigation"] = {"sigmas": sigmas.lists()}
    del header["imported_from"]  # so that its frames count as a spacecraft's
    (folder / "session.json").write_text(json.dumps(header))
    return folder


def _write(frames: list[TrainingFrame], gaussians: Gaussians, seed: int, folder: Path) -> None:
    made = []
    for frame in frames:
        rendered = render(gaussians, cameras_of([frame]))
        # as the truth keeps it: half precision, 8 bits of coverage
        made.append(View(_sized(frame), rendered.radiance[0].half().float(), rendered.alpha[0]))
    cloud = (
        np.random.default_rng(seed).normal(size=(500, 3)) * 0.05
        + np.repeat(gaussians.means.numpy(), 9, 0)[:500]
    )
    write(Target(folder.name, scenes.SENSOR, made, cloud), folder)


def _sized(frame: TrainingFrame) -> TrainingFrame:
    assert tuple(frame.dn.shape) == (SIZE_PX, SIZE_PX, 1) and torch.isfinite(frame.dn).all()
    return frame
