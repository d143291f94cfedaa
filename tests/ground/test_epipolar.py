"""Stated cameras against their pictures: by what neighbours share of textured, ray-cast boxes with known cameras."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground import cli
from ground.formats.middlebury import read_middlebury
from ground.formats.photographs import epipolar
from ground.formats.pictures.views import FormatError, Intrinsics, PoseSigmas, View
from ground.session.folder import open_session
from tests import raycast

SIZE_PX, FOCAL_PX = 200, 470.0
TEMPLE = Path(__file__).parents[3] / "shared" / "real" / "templeRing"
BOX = dataclasses.replace(raycast.spacecraft(5)[0], half_m=np.array([0.7, 0.6, 0.5]), cells=12)


@pytest.fixture(scope="module")
def views(tmp_path_factory) -> list[View]:
    """Pictures of a textured box from 12 places within 30 degrees, all cameras as they were."""
    folder = tmp_path_factory.mktemp("pictures")
    # off the middle, so that a turn about the line of sight moves it
    lens = Intrinsics(SIZE_PX, SIZE_PX, FOCAL_PX, FOCAL_PX, SIZE_PX / 2 + 8, SIZE_PX / 2 - 5)
    made = []
    for i, pose in enumerate(raycast.looking_at_origin(raycast.directions(12, 30), 4.5)):
        radiance, _ = raycast.cast([BOX], pose, np.array(lens.K), SIZE_PX, samples=2)
        path = folder / f"{i:02d}.png"
        cv2.imwrite(str(path), (255 * radiance.clip(0, 1)).round().astype(np.uint8))
        made.append(View(path, pose, lens))
    return made


def rotated(view: View, degrees: tuple[float, float, float]) -> View:
    pose = view.world_to_camera.copy()
    pose[:3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix() @ pose[:3]
    return dataclasses.replace(view, world_to_camera=pose)


def test_right_cameras_agree(views):
    assert epipolar.check_poses(views) == epipolar.PoseCheck(tuple(range(12)), (), (), ())


def test_turned_and_wrong_cameras_are_told_apart_and_mended(views):
    given = list(views)
    for i in (2, 7, 8):
        given[i] = epipolar.turned(views[i])
    given[4] = rotated(views[4], (0, 0, 20))
    check = epipolar.check_poses(given)
    assert (check.turned, check.contradicting, check.unchecked) == ((2, 7, 8), (4,), ())
    mended = epipolar.mended(given, check)
    assert [v.image.stem for v in mended] == [f"{i:02d}" for i in range(12) if i != 4]
    for view in mended:
        true = views[int(view.image.stem)]
        np.testing.assert_allclose(view.world_to_camera, true.world_to_camera, atol=1e-12)
        np.testing.assert_allclose(view.intrinsics.K, true.intrinsics.K, atol=1e-9)


def test_stated_errors_are_forgiven(views):
    given = list(views)
    given[4] = rotated(views[4], (0, 0, 10))
    assert epipolar.check_poses(given).contradicting == (4,)
    assert epipolar.check_poses(given, PoseSigmas(np.radians(10), 0.0)).contradicting == ()


def test_pictures_that_share_nothing_are_not_judged(views, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (SIZE_PX, SIZE_PX)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    given = [*views[:6], dataclasses.replace(views[6], image=tmp_path / "noise.png")]
    check = epipolar.check_poses(given)
    assert check.unchecked == (6,) and check.contradicting == ()
    assert epipolar.check_poses([]) == epipolar.PoseCheck((), (), (), ())


def test_epipolar_distances_are_those_of_opencv(views):
    points = np.random.default_rng(0).uniform(0, SIZE_PX, (40, 2, 2))
    one, other = views[0], views[5]
    motion = other.world_to_camera @ np.linalg.inv(one.world_to_camera)
    x, y, z = motion[:3, 3]
    inverses = [np.linalg.inv(np.array(v.intrinsics.K)) for v in (one, other)]
    F = inverses[1].T @ (np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]) @ inverses[0]
    expected = [  # OpenCV gives the squared distance
        np.sqrt(cv2.sampsonDistance(np.append(a, 1.0), np.append(b, 1.0), F)) for a, b in points
    ]
    ours = epipolar.epipolar_distances_px(one, other, points[:, 0], points[:, 1])
    np.testing.assert_allclose(ours, expected, rtol=1e-9)


def test_a_turned_camera_sees_the_turned_picture_through_a_lens_too(views):
    lens = dataclasses.replace(views[0].intrinsics, distortion=(0.1, -0.02, 0.01, -0.03, 0.005))
    view = dataclasses.replace(views[0], intrinsics=lens)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))

    def projected(v: View) -> np.ndarray:
        R, t = v.world_to_camera[:3, :3], v.world_to_camera[:3, 3]
        K, distortion = np.array(v.intrinsics.K), np.array(v.intrinsics.distortion)
        return cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, K, distortion)[0][:, 0]

    np.testing.assert_allclose(projected(epipolar.turned(view)), SIZE_PX - projected(view), atol=1e-6)


def test_too_many_contradictions_are_not_mended(views):
    with pytest.raises(FormatError, match="axes' convention"):
        epipolar.mended(views, epipolar.PoseCheck((0, 1), (), (2, 3, 4), ()))


def test_import_names_wrong_cameras_and_mends_them_when_told(views, tmp_path, capsys, monkeypatch):
    given = [epipolar.turned(v) if i == 3 else v for i, v in enumerate(views[:8])]
    given[5] = rotated(given[5], (0, 0, 20))
    folder = tmp_path / "set"
    (folder / "images").mkdir(parents=True)
    frames = []
    for view in given:
        (folder / "images" / view.image.name).write_bytes(view.image.read_bytes())
        camera_to_world = np.linalg.inv(view.world_to_camera) @ np.diag([1, -1, -1, 1])
        lens = view.intrinsics
        frames.append(
            {
                "file_path": f"images/{view.image.name}",
                "transform_matrix": camera_to_world.tolist(),
                **{"w": lens.width, "h": lens.height, "fl_x": lens.fx_px, "fl_y": lens.fy_px},
                **{"cx": lens.cx_px, "cy": lens.cy_px},
            }
        )
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    command = ["import", "--format", "nerfstudio", "--from", str(folder), "--json", "--session"]

    def run(session: str, *options: str) -> tuple[dict, str]:
        monkeypatch.setattr("sys.argv", ["ground", *command, str(tmp_path / session), *options])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert not end.value.code
        said = capsys.readouterr()
        return json.loads(said.out), said.err

    found, said = run("checked")
    assert (found["frames"], found["turned"], found["contradicting"]) == (8, ["03.png"], ["05.png"])
    assert "--poses mend turns them" in said and "--poses mend leaves them out" in said
    found, said = run("mended", "--poses", "mend")
    assert found["frames"] == 7 and "they are left out" in said
    third = open_session(tmp_path / "mended").frames[3]
    np.testing.assert_allclose(third.world_to_camera, views[3].world_to_camera, atol=1e-6)
    found, said = run("stated", "--poses", "stated")
    assert found["frames"] == 8 and "turned" not in found and "cameras" not in said


@pytest.mark.skipif(not TEMPLE.is_dir(), reason="needs the photographs of templeRing")
def test_some_published_cameras_of_a_real_ring_are_turned():
    """Pictures 6 to 10, 40 and 41, which stand near each other: the latter are turned against their cameras."""
    views = read_middlebury(TEMPLE)
    given = [*views[5:10], *views[39:41]]
    check = epipolar.check_poses(given)
    names = [given[i].image.stem[-4:] for i in check.turned]
    assert names == ["0040", "0041"] and check.contradicting == ()
