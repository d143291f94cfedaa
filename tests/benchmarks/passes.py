"""Simulated passes about a spacecraft of textured boxes, or a mesh; neither the product nor its renderer makes them.

The boxes depend on a seed alone, so that figures of two versions of the code are figures of the same pictures.
"""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flightsw.icd.quaternion import quat_to_matrix
from hil.sky.sensor import converted
from hil.world.scenario import Scenario, Scene
from obbgs_base.physics.navigation_errors import NominalMotion
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor
from tests.benchmarks.mesh_pictures import pictures
from tests.benchmarks.targets import LARGEST_DIMENSION, MID_SIGNAL
from tests.raycast import Box, hit, spacecraft

SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=4.0, read_noise_dn=2.0)
EXPOSURES_S = (5e-5, 1e-4, 2e-4)
FRAME_SPACING_S = 0.5
FILLS = 0.7  # of the field of view by the target's largest dimension at the mean range
SAMPLES = 4  # along each side of a pixel
CLOUD_POINTS = 20_000
HELD_OUT = 8  # every eighth bracket


@dataclass(frozen=True)
class Pass:
    """True frames of a pass with their geometry."""

    frames: list[TrainingFrame]  # exact poses
    motion: NominalMotion  # true
    radiance: torch.Tensor  # [F, H, W, C]
    alpha: torch.Tensor  # [F, H, W]
    cloud_m: np.ndarray
    size_m: float
    range_m: float
    span_s: float
    held_out: list[int]  # frames, by index, that no training sees


def body(seed: int) -> list[Box]:
    """Return the boxes of a spacecraft, 2 m long: panels, a boom and an antenna without symmetry."""
    boxes = spacecraft(seed)
    rotation, (_, height, depth) = boxes[0].rotation, boxes[0].half_m
    tilted = rotation @ Rotation.from_rotvec([0.4, 0.3, 0.0]).as_matrix()
    parts = [  # middle, half widths, along the first box's axes
        ((0.1, height + 0.2, 0.0), (0.03, 0.2, 0.03), rotation),
        ((0.1, height + 0.48, 0.03), (0.1, 0.08, 0.14), rotation),
        ((-0.12, 0.05, depth + 0.1), (0.22, 0.16, 0.03), tilted),
    ]
    boxes += [
        Box(rotation @ np.array(middle), np.array(half), axes, 1000 + 10 * seed + i, cells=3)
        for i, (middle, half, axes) in enumerate(parts)
    ]
    return scaled(boxes, LARGEST_DIMENSION / np.ptp(_corners(boxes), axis=0).max())


def scaled(boxes: list[Box], factor: float) -> list[Box]:
    """Return boxes enlarged about the origin."""
    return [dataclasses.replace(b, middle_m=factor * b.middle_m, half_m=factor * b.half_m) for b in boxes]


def _corners(boxes: list[Box]) -> np.ndarray:
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
    return np.concatenate([b.middle_m + (signs * b.half_m) @ b.rotation.T for b in boxes])


def surface_points(boxes: list[Box], seed: int = 0) -> np.ndarray:
    """Return points [M, 3] that are spread at random over the outer surface of boxes, as many per area."""
    rng, points = np.random.default_rng(seed), []
    areas = np.array([[8 * b.half_m.prod() / b.half_m[k] / 2 for k in range(3)] for b in boxes])
    for box, of_axis in zip(boxes, areas / areas.sum(), strict=True):
        for k, share in enumerate(of_axis):
            at = rng.uniform(-1, 1, (round(CLOUD_POINTS * share), 3))
            at[:, k] = np.sign(at[:, k])
            points.append(box.middle_m + (at * box.half_m) @ box.rotation.T)
    cloud = np.concatenate(points)
    depths = [(b.half_m - np.abs((cloud - b.middle_m) @ b.rotation)).min(axis=1) for b in boxes]
    return cloud[np.max(depths, axis=0) < 1e-6]


@functools.lru_cache(maxsize=1)
def _pictures(seed: int, scale: float, poses: bytes, K: bytes, size_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance [F, H, W] and coverage [F, H, W] of the body; the means over the samples of each pixel."""
    boxes, K_px = scaled(body(seed), scale), np.frombuffer(K).reshape(3, 3)
    corners, pictures = _corners(boxes), []
    for pose in np.frombuffer(poses).reshape(-1, 4, 4):
        picture, at = np.zeros((2, size_px, size_px)), (corners @ pose[:3, :3].T + pose[:3, 3]) @ K_px.T
        at = at[:, :2] / at[:, 2:]
        first = np.clip(np.floor(at.min(axis=0)), 0, size_px).astype(int)
        side = int(np.ceil(at.max(axis=0) - first).max())  # of a square that holds the target
        fine = K_px.copy()
        fine[:2, 2] -= first
        fine[:2] *= SAMPLES
        light, depth = hit(boxes, pose, fine, SAMPLES * side, np.array([0.5, 0.5]))
        means = np.stack([light, depth > 0]).reshape(2, side, SAMPLES, side, SAMPLES).mean(axis=(2, 4))
        x, y = first
        picture[:, y : y + side, x : x + side] = means[:, : size_px - y, : size_px - x]
        pictures.append(picture)
    stacked = np.array(pictures)
    return stacked[:, 0], stacked[:, 1]


def bracket_times_s(scenario: Scenario, brackets: int, spacing_s: float = FRAME_SPACING_S) -> np.ndarray:
    """Return the times [F] of brackets that are spread over a scenario's whole duration, their frames so far apart."""
    triggers = np.linspace(0, scenario.duration_s, brackets)
    return (triggers[:, None] + spacing_s * np.arange(len(EXPOSURES_S))).ravel()


def motion_and_suns(scenario: Scenario, times_s: np.ndarray) -> tuple[NominalMotion, np.ndarray]:
    """Return the true motion of a scenario at some times [F], and its Sun.

    The second are the directions [F, 3] towards the Sun in the frames, unit, body frame.
    """
    scene, start_ns = Scene(scenario), scenario.orbit.start_utc_ns
    states = [scene.state(start_ns + round(t * 1e9)) for t in times_s]
    target, section = states[0].target, scenario.attitude
    radial = target.position_m / np.linalg.norm(target.position_m)
    normal = np.cross(target.position_m, target.velocity_m_s)
    mean_motion = np.linalg.norm(normal) / (target.position_m @ target.position_m)
    normal /= np.linalg.norm(normal)
    tumbles = section.mode == "tumble"
    motion = NominalMotion(
        times_s,
        np.array([s.chaser.position_m - s.target.position_m for s in states]),
        np.array([s.gcrs_to_camera for s in states]),
        np.array([scene.gcrs_to_body(s.utc_ns) for s in states]),
        float(mean_motion),
        np.stack([radial, np.cross(normal, radial), normal]),
        np.radians(section.rates_deg_s) if tumbles else np.array([0, 0, 2 * np.pi / section.period_s]),
        np.array(section.inertia),
    )
    np.testing.assert_allclose(
        motion.world_to_camera[-1][:3, :3], quat_to_matrix(states[-1].pose.quat_body_to_camera), atol=1e-9
    )
    return motion, np.array([s.pose.sun_dir_body for s in states])


def photographed(target: int | Path, scenario: Scenario, brackets: int, size_px: int, seed: int) -> Pass:
    """Return the frames of a scenario about a body, with exact poses; every eighth bracket is held out.

    Args:
        target: seed of a body of boxes, which have their own light; or a mesh, on which the scenario's Sun shines.
        seed: of the noise.
    """
    of_bracket = np.repeat(np.arange(brackets), len(EXPOSURES_S))
    exposures_s = EXPOSURES_S * brackets
    held_out = np.flatnonzero(of_bracket % HELD_OUT == HELD_OUT - 1).tolist()
    times_s = bracket_times_s(scenario, brackets)
    return taken(target, scenario, times_s, exposures_s, of_bracket.tolist(), held_out, size_px, seed)


def taken(
    target: int | Path,
    scenario: Scenario,
    times_s: np.ndarray,
    exposures_s: Sequence[float],
    brackets: Sequence[int],
    held_out: list[int],
    size_px: int,
    seed: int,
) -> Pass:
    """Return frames of a scenario as `photographed` does, taken at these times and exposures, of these brackets."""
    motion, towards = motion_and_suns(scenario, times_s)
    range_m = float(np.linalg.norm(motion.position_m, axis=1).mean())
    focal_px = size_px / 2 / np.tan(np.radians(scenario.fov_deg) / 2)
    size_m = FILLS * size_px * range_m / focal_px
    K = np.array([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])
    suns: list[torch.Tensor | None] = [None] * len(motion.times_s)
    if isinstance(target, Path):
        light, alpha, cloud_m = pictures(target, size_m, motion.world_to_camera, towards, K, size_px)
        suns = list(torch.from_numpy(towards).float())
    else:
        scale = size_m / LARGEST_DIMENSION
        light, alpha = _pictures(target, scale, motion.world_to_camera.tobytes(), K.tobytes(), size_px)
        cloud_m = surface_points(scaled(body(target), scale))
    # radiance at full scale of the middle exposure
    white = np.percentile(light[alpha > 0.9], 97) / MID_SIGNAL
    radiance = torch.from_numpy(light * SENSOR.full_scale_radiance(EXPOSURES_S[1]) / white)[..., None].float()
    rng, frames = np.random.default_rng(seed), []
    for i, pose in enumerate(motion.world_to_camera):
        exposure_s, bracket = exposures_s[i], brackets[i]
        expected = SENSOR.expected_dn(radiance[i], exposure_s)
        sigma = SENSOR.variance_dn2(expected).sqrt().numpy()
        dn = torch.from_numpy(converted(expected.numpy(), sigma, SENSOR.white_dn, rng).astype(np.float32))
        world_to_camera = torch.from_numpy(pose).float()
        frames.append(
            TrainingFrame(
                dn, exposure_s, world_to_camera, torch.from_numpy(K).float(), i, bracket, sun_dir=suns[i]
            )
        )
    coverage = torch.from_numpy(alpha).float()
    return Pass(frames, motion, radiance, coverage, cloud_m, size_m, range_m, scenario.duration_s, held_out)
