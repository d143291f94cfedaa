"""Textured boxes with a Lambertian surface, cast ray by ray: pictures and depths that no code of the product makes."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hil.sky.sensor import converted
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor

SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=2.0, read_noise_dn=3.0)
EXPOSURES_S = (5e-5, 1e-4, 2e-4)
OCTAVES = 3  # of a texture, each half as large and half as strong


@dataclass(frozen=True)
class Box:
    """A box: its middle [3] and half widths [3] m, rotation [3, 3] to the body frame, and a texture for each face."""

    middle_m: np.ndarray
    half_m: np.ndarray
    rotation: np.ndarray
    seed: int
    cells: int = 4  # random values along each side of a face in the texture's coarsest octave

    def texture(self, face: int, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return values 0.15 to 1 at places 0..1 on a face: smooth noise in several octaves, the same every time."""
        rng = np.random.default_rng([self.seed, face])
        total, weights = np.zeros_like(u), 0.0
        for octave in range(OCTAVES):
            size = self.cells * 2**octave
            values = rng.random((size + 1, size + 1))
            x, y = np.clip(u, 0, 1) * size, np.clip(v, 0, 1) * size
            i, j = np.minimum(x.astype(int), size - 1), np.minimum(y.astype(int), size - 1)
            fx, fy = x - i, y - j
            upper = values[i, j] * (1 - fx) + values[i + 1, j] * fx
            lower = values[i, j + 1] * (1 - fx) + values[i + 1, j + 1] * fx
            total += (upper * (1 - fy) + lower * fy) / 2**octave
            weights += 1 / 2**octave
        return 0.15 + 0.85 * np.clip(2 * total / weights - 0.5, 0, 1)


def cast(
    boxes: list[Box], world_to_camera: np.ndarray, K: np.ndarray, size_px: int, samples: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance [H, W], 0 to 1, and depth [H, W] m of the pixels' centres, 0 in the sky.

    Args:
        samples: along each side of a pixel; the radiance is their mean.
    """
    radiance = np.zeros((size_px, size_px))
    for sy in range(samples):
        for sx in range(samples):
            offset = (np.array([sx, sy]) + 0.5) / samples
            radiance += hit(boxes, world_to_camera, K, size_px, offset)[0] / samples**2
    return radiance, hit(boxes, world_to_camera, K, size_px, np.array([0.5, 0.5]))[1]


def hit(
    boxes: list[Box], world_to_camera: np.ndarray, K: np.ndarray, size_px: int, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance and depth, as `cast`, at one place [2] of each pixel, 0 to 1."""
    columns, rows = np.meshgrid(np.arange(size_px) + offset[0], np.arange(size_px) + offset[1])
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(K).T @ world_to_camera[:3, :3]
    origin = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    radiance, depth_m = np.zeros((size_px, size_px)), np.full((size_px, size_px), np.inf)
    for box in boxes:
        o, d = (origin - box.middle_m) @ box.rotation, rays @ box.rotation
        with np.errstate(divide="ignore"):
            first, last = (-np.sign(d) * box.half_m - o) / d, (np.sign(d) * box.half_m - o) / d
        enter, leave = first.max(axis=-1), last.min(axis=-1)
        nearer = (enter < leave) & (enter > 0) & (enter < depth_m)
        axis = first.argmax(axis=-1)
        at = (o + enter[..., None] * d) / box.half_m
        for k in range(3):
            for side in (-1, 1):
                on = nearer & (axis == k) & (np.sign(d[..., k]) == -side)
                u, v = (0.5 + 0.5 * at[..., other][on] for other in range(3) if other != k)
                # each face has its own light, as under a fixed Sun
                light = 0.5 + 0.15 * (k + (side > 0))
                radiance[on] = light * box.texture(2 * k + (side > 0), u, v)
        depth_m[nearer] = enter[nearer]
    return radiance, np.where(np.isfinite(depth_m), depth_m, 0)


def spacecraft(seed: int) -> list[Box]:
    """Return a random body with two panels, about 2 m wide and turned at random."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    body = rng.uniform(0.2, 0.4, 3)
    panel = np.array([rng.uniform(0.25, 0.4), rng.uniform(0.15, 0.35), 0.02])
    boxes = [Box(np.zeros(3), body, turn, seed)]
    tilt = turn @ Rotation.from_rotvec([rng.uniform(-1, 1), 0, 0]).as_matrix()
    for side in (-1, 1):
        middle = turn @ np.array([side * (body[0] + panel[0] + 0.05), 0, 0])
        boxes.append(Box(middle, panel, tilt, seed * 2 + side + 2))
    return boxes


def looking_at_origin(towards: np.ndarray, range_m: float) -> np.ndarray:
    """Return world_to_camera [V, 4, 4] of cameras that stand in directions [V, 3] from the origin and look at it."""
    poses = np.tile(np.eye(4), (len(towards), 1, 1))
    for pose, direction in zip(poses, towards / np.linalg.norm(towards, axis=1)[:, None], strict=True):
        helper = np.eye(3)[np.abs(direction).argmin()]
        right = np.cross(helper, direction)
        right /= np.linalg.norm(right)
        pose[:3, :3] = [right, np.cross(-direction, right), -direction]
        pose[2, 3] = range_m
    return poses


def directions(count: int, widest_deg: float = 180.0) -> np.ndarray:
    """Return directions [V, 3] spread evenly over those within an angle of the z axis; 180: the whole sphere."""
    k = np.arange(count)
    z = 1 - (1 - np.cos(np.radians(widest_deg))) * (2 * k + 1) / (2 * count)
    longitude = k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(longitude), ring * np.sin(longitude), z], 1)


def photographed(
    boxes: list[Box],
    poses: np.ndarray,
    size_px: int = 96,
    focal_px: float = 170.0,
    seed: int = 0,
    exposures_s: tuple[float, ...] = EXPOSURES_S,
    samples: int = 2,
) -> tuple[list[TrainingFrame], list[np.ndarray]]:
    """Return frames with shot and read noise, the exposures in turn, and their true depths [H, W] m."""
    K = np.array([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])
    rng, frames, depths = np.random.default_rng(seed), [], []
    for i, pose in enumerate(poses):
        radiance, depth_m = cast(boxes, pose, K, size_px, samples)
        expected = SENSOR.expected_dn(
            torch.from_numpy(radiance)[..., None], exposures_s[i % len(exposures_s)]
        )
        sigma_dn = SENSOR.variance_dn2(expected).sqrt().numpy()
        dn = converted(expected.numpy(), sigma_dn, SENSOR.white_dn, rng).astype(np.float32)
        frames.append(
            TrainingFrame(
                torch.from_numpy(dn),
                exposures_s[i % len(exposures_s)],
                torch.from_numpy(pose).float(),
                torch.from_numpy(K).float(),
                i,
            )
        )
        depths.append(depth_m)
    return frames, depths


def distances_to_surface(boxes: list[Box], points: np.ndarray) -> np.ndarray:
    """Return the distance [N] m of points [N, 3] from the nearest surface of boxes, by their signed distance."""
    nearest = np.full(len(points), np.inf)
    for box in boxes:
        q = np.abs((points - box.middle_m) @ box.rotation) - box.half_m
        outside = np.linalg.norm(np.maximum(q, 0), axis=1)
        nearest = np.minimum(nearest, np.abs(outside + np.minimum(q.max(axis=1), 0)))
    return nearest
