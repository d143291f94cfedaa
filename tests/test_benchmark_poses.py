"""The benchmark of poses photographs what it says, and knows which parameters lead from its tags to the truth."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from hil.sky import SHIPPED
from hil.world.scenario import load_scenario
from obbgs_base.physics.navigation_errors import SharedParameters
from obbgs_core.frames import sun_span_deg
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.gauge import best_motion
from obbgs_core.score.poses import pose_errors
from tests import raycast
from tests.benchmarks import passes, poses, unknown_attitude

SIZE_PX, BRACKETS = 32, 6


@pytest.fixture(scope="module")
def seen() -> passes.Pass:
    return passes.photographed(1, load_scenario("v-bar"), BRACKETS, SIZE_PX, 0)


def test_pictures_are_those_of_the_whole_body_at_every_pixel(seen):
    """Only the square that holds the target is cast; here all of the picture is."""
    boxes = passes.scaled(passes.body(1), seen.size_m / 2)
    unit = float(seen.radiance.max())
    for i in (0, 7, 16):
        pose = seen.motion.world_to_camera[i]
        light, depth_m = raycast.cast(boxes, pose, seen.frames[i].K.double().numpy(), SIZE_PX, passes.SAMPLES)
        ours = seen.radiance[i, ..., 0].numpy() / unit
        np.testing.assert_allclose(ours / ours.sum(), light / light.sum(), atol=1e-6)
        assert (seen.alpha[i].numpy() > 0)[depth_m > 0].all()


def test_the_cloud_lies_on_the_outside_and_covers_it(seen):
    boxes = passes.scaled(passes.body(1), seen.size_m / 2)
    assert raycast.distances_to_surface(boxes, seen.cloud_m).max() < 1e-9 * seen.size_m
    assert np.ptp(seen.cloud_m, axis=0).max() == pytest.approx(seen.size_m, rel=0.01)
    _, depth_m = raycast.cast(
        boxes, seen.motion.world_to_camera[0], seen.frames[0].K.double().numpy(), SIZE_PX
    )
    rows, columns = np.nonzero(depth_m)
    K, pose = seen.frames[0].K.double().numpy(), seen.motion.world_to_camera[0]
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1) @ np.linalg.inv(K).T
    points = (rays * depth_m[rows, columns][:, None] - pose[:3, 3]) @ pose[:3, :3]
    # 20,000 points on some 2.5 squares of the size: the largest gap is a few mean distances of 1 % of it
    assert KDTree(seen.cloud_m).query(points)[0].max() < 0.06 * seen.size_m


def test_the_true_parameters_are_no_deviations_off_and_those_of_the_tags_are(seen):
    frames = poses.correlated(seen, 1.0, seed=3)
    errors, sigmas = poses.shared_errors(seen, 1.0, seed=3)
    corrections = PoseCorrections(frames)
    tagged = corrections.estimate(frames)
    off = poses.errors_in_deviations(seen, errors, tagged)["deviations"]
    # without pictures the posterior is the prior, and the errors were drawn from it but for their length
    np.testing.assert_allclose(
        off, (errors.vector() / sigmas.vector().clip(1e-300))[sigmas.vector() > 0], atol=0.1
    )
    right = dataclasses.replace(tagged, shared=SharedParameters.of(-errors.vector()))
    assert np.abs(poses.errors_in_deviations(seen, errors, right)["deviations"]).max() < 0.1
    corrections._move_shared(frames, torch.from_numpy(-errors.vector()))
    corrected = corrections.corrected(list(range(len(frames))))
    true = torch.stack([f.world_to_camera for f in seen.frames])
    focal_px = seen.frames[0].K[0, 0].item()
    left = pose_errors(corrected, true, best_motion(corrected, true, 1.0), 1.0, focal_px)
    assert (
        left.rotation_deg < 0.05
    )  # each bracket's own error, 0.01 degrees about each axis, and products of errors


def test_a_mesh_is_photographed_where_its_points_are_and_its_sun_stands_still():
    scenario = unknown_attitude.scenario("unknown_attitude_tumbling", seed=0)
    seen = passes.photographed(SHIPPED, scenario, 3, SIZE_PX, 0)
    assert np.ptp(seen.cloud_m, axis=0).max() == pytest.approx(seen.size_m, rel=0.1)
    for i in (0, 8):
        pose, K = seen.motion.world_to_camera[i], seen.frames[i].K.double().numpy()
        at = (seen.cloud_m @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        columns, rows = (at[:, :2] / at[:, 2:]).astype(int).T
        shown = np.zeros((SIZE_PX, SIZE_PX), dtype=bool)
        shown[rows, columns] = True
        covered = seen.alpha[i].numpy() > 0
        assert binary_dilation(covered)[shown].all()
        assert shown[seen.alpha[i].numpy() > 0.9].mean() > 0.9  # points no view of nine shows are left out
        assert (seen.radiance[i, ..., 0].numpy()[covered] > 0).mean() > 0.9
    assert sun_span_deg(unknown_attitude.inertial(seen)) < 0.1  # in half an hour
    assert sun_span_deg(seen.frames) > 30
