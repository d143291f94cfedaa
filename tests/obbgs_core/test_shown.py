"""Which part of a true surface the frames show, against ray-cast boxes of which one side is lit."""

import dataclasses

import numpy as np
import torch

from obbgs_core.score.metrics import cloud_distances
from obbgs_core.score.shown import shown_points
from tests.raycast import SENSOR, Box, cast, directions, looking_at_origin, photographed

BOX = Box(np.zeros(3), np.array([0.5, 0.4, 0.3]), np.eye(3), 0)


def on_faces(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [N, 3] on the faces of BOX, and outward normals [N, 3]."""
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-1, 1, (count, 3)) * BOX.half_m, np.zeros((count, 3))
    for i, (axis, side) in enumerate(zip(rng.integers(0, 3, count), rng.choice([-1, 1], count), strict=True)):
        points[i, axis], normals[i, axis] = side * BOX.half_m[axis], side
    return points, normals


def test_a_face_is_shown_if_a_camera_has_it_in_view_and_it_is_bright_enough():
    points, normals = on_faces(16_000)
    above = directions(24, 60)  # cameras within 60 degrees of the z axis: none sees the face below
    frames, _ = photographed([BOX], looking_at_origin(above, 4.0), 96, 255.0)
    shown = shown_points(points, frames, SENSOR)
    edge = (np.abs(points) > BOX.half_m - 0.1).sum(axis=1) > 1  # where a cell shows two faces
    assert shown[(normals[:, 2] > 0) & ~edge].all() and not shown[(normals[:, 2] < 0) & ~edge].any()
    for normal, point in ((0, 0), (1, 1)):  # a face at the side is shown as far as cameras look at it
        side = (np.abs(normals[:, normal]) > 0) & ~edge
        assert shown[side].mean() > 0.9, point
    rng = np.random.default_rng(1)
    dark = [
        dataclasses.replace(f, dn=torch.from_numpy(rng.normal(64, 3, f.dn.shape).round().clip(0)).float())
        for f in frames
    ]
    assert shown_points(points, dark, SENSOR).mean() < 0.001


def test_light_that_only_all_frames_together_show_counts():
    """Each frame reads 1.5 of its deviations more than dark: 24 of them together 7, 4 of them 3."""
    points, normals = on_faces(16_000)
    frames, _ = photographed([BOX], looking_at_origin(directions(1, 5).repeat(24, 0), 4.0), 64, 170.0)
    rng, faint = np.random.default_rng(2), []
    for f in frames:
        covered = cast([BOX], f.world_to_camera.double().numpy(), f.K.double().numpy(), 64)[1] > 0
        dn = rng.normal(64 + 1.5 * 3 * covered, 3).round()[..., None].astype(np.float32)
        faint.append(dataclasses.replace(f, dn=torch.from_numpy(dn), exposure_time_s=1e-4))
    front = (normals[:, 2] > 0) & (np.abs(points[:, :2]) < BOX.half_m[:2] - 0.05).all(axis=1)
    assert shown_points(points, faint, SENSOR)[front].mean() > 0.9
    assert shown_points(points, faint[:4], SENSOR)[front].mean() < 0.1


def test_completeness_of_what_is_shown_leaves_out_the_rest():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    found = cloud_distances(truth[:2], truth, np.array([True, False, True, False]))
    assert found["completeness"] == found["completeness_shown"] == 50
    assert (
        cloud_distances(truth[:2], truth, np.array([True, True, False, False]))["completeness_shown"] == 100
    )
    assert "completeness_shown" not in cloud_distances(truth, truth, np.zeros(4, bool))
