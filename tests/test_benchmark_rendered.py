"""The views of targets that a benchmark renders: where the cameras and the Sun are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.benchmarks import rendered


@pytest.mark.parametrize("views", [rendered.static_views, rendered.moving_views])
def test_cameras_look_at_the_target_from_one_distance(views):
    poses, suns = views()
    assert poses.shape == (rendered.VIEWS, 4, 4) and suns.shape == (rendered.VIEWS, 3)
    turned = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()  # the nearest rotations
    np.testing.assert_allclose(poses[:, :3, :3], turned, atol=1e-6)
    np.testing.assert_allclose(
        poses[:, 2, 3], rendered.DISTANCE, rtol=0.01
    )  # straight ahead, in OpenCV's axes
    np.testing.assert_allclose(np.linalg.norm(poses[:, :3, 3], axis=1), rendered.DISTANCE)
    np.testing.assert_allclose(np.linalg.norm(suns, axis=1), 1, atol=1e-9)


def test_only_a_moving_sun_moves_and_static_views_lie_all_around():
    poses, suns = rendered.static_views()
    assert np.ptp(suns, axis=0).max() == 0
    centres = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]) / rendered.DISTANCE
    for corner in np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T / 3**0.5:
        assert (centres @ corner).max() > np.cos(np.radians(25))
    moving = rendered.moving_views()[1]
    assert (moving @ moving.T).min() < 0


@pytest.mark.parametrize("views", [rendered.static_views, rendered.moving_views])
def test_dense_views_are_the_same_and_others_between_them(views):
    (poses, suns), (dense, dense_suns) = views(), views(dense=True)
    assert len(dense) == len(dense_suns) == 3 * len(poses)
    np.testing.assert_array_equal(dense[: len(poses)], poses)
    np.testing.assert_array_equal(dense_suns[: len(poses)], suns)
    towards = -dense[:, 2, :3]
    angles = np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1))) + 180 * np.eye(len(towards))
    assert angles[: len(poses), : len(poses)].min(axis=1).mean() > 1.4 * angles.min(axis=1).mean()
