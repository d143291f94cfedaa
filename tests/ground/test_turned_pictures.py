"""Pictures that were turned by 180 degrees are told by the principal point, which they have on the other side."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from ground.formats.photographs.turned_pictures import turned_back
from tests import raycast

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 1500.0
ASIDE_PX = np.array([-18.0, 8.0])  # of the principal point from the middle
NOISE_PX = 0.15
RANGE_M = 6.5
TURN = np.diag([-1.0, -1.0, 1.0])


def model_of(turned: set[int], pictures: int = 20) -> tuple[pycolmap.Reconstruction, np.ndarray]:
    """Return a model as structure from motion leaves it, with the principal point in the middle, and the true poses.

    Points on a sphere are seen where they face the camera, so that each is on a part of the pictures only. A principal
    point aside is nearly a turn of the camera, by which the poses of the model err.
    """
    rng = np.random.default_rng(3)
    points = rng.standard_normal((4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= rng.uniform(0.7, 1.1, (len(points), 1))
    poses = np.asarray(raycast.looking_at_origin(raycast.directions(pictures, 35), RANGE_M))
    model = pycolmap.Reconstruction()
    params = [FOCAL_PX, WIDTH / 2, HEIGHT / 2, 0.0]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
    )
    tracks = [[] for _ in points]
    for i, pose in enumerate(poses):
        there = points @ pose[:3, :3].T + pose[:3, 3]
        centre = -pose[:3, :3].T @ pose[:3, 3]
        (seen,) = np.nonzero((points * (centre - points)).sum(axis=1) > 0.4 * np.linalg.norm(centre))
        aside = ASIDE_PX * (-1 if i in turned else 1)
        shown = TURN if i in turned else np.eye(3)
        poses[i, :3] = shown @ pose[:3]
        there = there[seen] @ shown.T
        xy = FOCAL_PX * there[:, :2] / there[:, 2:] + [WIDTH / 2, HEIGHT / 2] + aside
        xy += NOISE_PX * rng.standard_normal(xy.shape)
        looks_like = Rotation.from_rotvec([-aside[1] / FOCAL_PX, aside[0] / FOCAL_PX, 0]).as_matrix()
        image = pycolmap.Image(name=f"{i:02d}.png", keypoints=xy, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(looks_like @ poses[i, :3]))
        for place, point in enumerate(seen):
            tracks[point].append(pycolmap.TrackElement(i + 1, place))
    for point, elements in zip(points, tracks, strict=True):
        if len(elements) > 2:
            model.add_point3D(point, pycolmap.Track(elements))
    return model, poses


@pytest.mark.parametrize("turned", [{2, 3, 4, 11, 12, 13, 14}, {7}, set(range(10))])
def test_turned_pictures_are_named_and_tell_the_principal_point(turned):
    model, poses = model_of(turned)
    calls = []
    found, names = turned_back(model, lambda: calls.append(1))
    assert calls
    as_named, others = {f"{i:02d}.png" for i in turned}, {f"{i:02d}.png" for i in set(range(20)) - turned}
    assert names in (as_named, others)  # which of the two were turned cannot be known
    aside = found.cameras[0].params[1:3] - [WIDTH / 2, HEIGHT / 2]
    assert np.linalg.norm(aside - (ASIDE_PX if names == as_named else -ASIDE_PX)) < 6
    assert found.cameras[0].params[0] == pytest.approx(FOCAL_PX, rel=0.02)
    rotations = {image.name: image.cam_from_world().rotation.matrix() for image in found.images.values()}
    upright = np.array([TURN @ rotations[n] if n in names else rotations[n] for n in sorted(rotations)])
    away = Rotation.from_matrix(upright @ poses[:, :3, :3].transpose(0, 2, 1))
    common = Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1) @ upright).mean()
    left = away * Rotation.from_matrix(
        poses[:, :3, :3] @ common.inv().as_matrix() @ poses[:, :3, :3].transpose(0, 2, 1)
    )
    assert np.degrees(left.magnitude()).max() < 0.3  # 0.75 degrees to opposite sides before


def test_upright_pictures_are_left_as_they_are():
    model, _ = model_of(set())
    found, names = turned_back(model, lambda: None)
    assert found is model
    assert not names


def test_whoever_asks_to_stop_is_heard():
    model, _ = model_of({1}, pictures=6)

    def stop() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        turned_back(model, stop)
