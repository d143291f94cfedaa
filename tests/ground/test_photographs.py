"""Photographs without poses, ray-cast so that their true cameras are known: structure from motion into a session."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from compare.opponents.sfm import similarity
from ground import cli
from ground.formats.photographs.poses import read_photographs
from ground.formats.pictures.views import FormatError, PoseSigmas, write_session
from ground.session.folder import open_session
from obbgs_base.errors import Interrupted
from tests import raycast
from tests.commands import call

BOXES = [dataclasses.replace(raycast.spacecraft(5)[0], half_m=np.array([0.7, 0.6, 0.5]), cells=12)]
SIZE_PX = 160


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A folder of 14 photographs of a textured box and one of nothing, and the true poses."""
    poses = raycast.looking_at_origin(raycast.directions(14, 35), 4.5)
    frames = raycast.photographed(BOXES, poses, SIZE_PX, 375.0, exposures_s=(6e-5,))[0]
    folder = tmp_path_factory.mktemp("photographs")
    for i, frame in enumerate(frames):
        share = ((frame.dn - raycast.SENSOR.black_dn) / raycast.SENSOR.white_dn).clamp(0, 1)
        cv2.imwrite(str(folder / f"{i:02d}.png"), (255 * share[..., 0]).round().to(torch.uint8).numpy())
    noise = np.random.default_rng(0).integers(0, 20, (SIZE_PX, SIZE_PX)).astype(np.uint8)
    cv2.imwrite(str(folder / "dark.png"), noise)
    return folder, np.asarray(poses)


@pytest.fixture(scope="module")
def registered(photographs, tmp_path_factory):
    folder, _ = photographs
    work = tmp_path_factory.mktemp("session") / "registration"
    with pytest.raises(Interrupted, match="what was found is kept"):
        read_photographs(folder, work, should_stop=lambda: True)
    assert (work / "database.db").is_file()
    shares = []
    found = read_photographs(folder, work, shares.append)
    assert shares == sorted(shares) and len(shares) > 5
    assert not work.exists()
    return found


def test_cameras_are_found_up_to_a_similarity_and_what_is_not_registered_is_named(photographs, registered):
    _, poses = photographs
    assert registered.left_out == ("dark.png",)
    names = [view.image.stem for view in registered.views]
    assert names == [f"{i:02d}" for i in range(14)]
    found = np.array([view.world_to_camera for view in registered.views])
    centres, true_centres = (-np.einsum("nji,nj->ni", p[:, :3, :3], p[:, :3, 3]) for p in (found, poses))
    moved = similarity(centres, true_centres)
    assert moved is not None
    turn = moved[:, :3] / np.cbrt(np.linalg.det(moved[:, :3]))
    left = found[:, :3, :3] @ turn.T @ poses[:, :3, :3].transpose(0, 2, 1)
    assert np.degrees(Rotation.from_matrix(left).magnitude()).max() < 1
    assert 0 < registered.reprojection_px < 1.5
    # the frame is the object's own: its middle in the origin, most of its surface within a metre
    scale = np.cbrt(np.linalg.det(moved[:, :3]))
    assert np.linalg.norm(moved[:, 3]) < 0.5
    assert 0.4 < scale < 1.2


def test_a_session_keeps_who_was_left_out_and_how_far_the_poses_can_err(registered, tmp_path):
    source, described = "images: here", registered.described()
    write_session(registered.views, tmp_path, source, sigmas=registered.sigmas, registration=described)
    session = open_session(tmp_path)
    assert session.registration == described and described["left_out"] == ["dark.png"]
    assert len(session.frames) == described["registered"] == 14
    sigma = registered.sigmas
    for record in session.frames:
        deviations = np.sqrt(np.diag(record.covariance))
        np.testing.assert_allclose(deviations, [sigma.position_m] * 3 + [sigma.rotation_rad] * 3)
    assert 0 < np.degrees(sigma.rotation_rad) < 0.3


def test_a_pose_sigma_of_the_command_line_goes_into_every_tag(registered, tmp_path, monkeypatch):
    """An import of a folder with known cameras, here made by the writer of nerfstudio's layout."""
    write_session(registered.views, tmp_path / "first", "images: here")
    run(monkeypatch, "export", tmp_path / "first", "--out", tmp_path / "n", "--format", "nerfstudio")
    arguments = ("--format", "nerfstudio", "--from", tmp_path / "n", "--session", tmp_path / "second")
    run(monkeypatch, "import", *arguments, "--pose-sigma", "0.2,0.01")
    expected = np.diag(np.repeat([0.01**2, np.radians(0.2) ** 2], 3))
    for record in open_session(tmp_path / "second").frames:
        np.testing.assert_allclose(record.covariance, expected)
    assert not open_session(tmp_path / "first").frames[0].covariance.any()


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr("sys.argv", ["ground", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.mark.parametrize("wrong", ["0.2", "a,b", "-1,0", "1,2,3", "nan,0"])
def test_a_wrong_pose_sigma_is_refused(wrong, tmp_path, monkeypatch, capsys):
    arguments = (
        "--format",
        "colmap",
        "--from",
        tmp_path,
        "--session",
        tmp_path / "s",
        f"--pose-sigma={wrong}",
    )
    assert run(monkeypatch, "import", *arguments) == 2
    assert "--pose-sigma: expected degrees and metres" in " ".join(capsys.readouterr().err.split())


def test_pictures_that_have_nothing_in_common_are_refused_in_one_sentence(photographs, tmp_path):
    rng = np.random.default_rng(1)
    for i in range(3):
        picture = cv2.GaussianBlur(rng.integers(0, 255, (64, 64)).astype(np.uint8), (0, 0), 2)
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    with pytest.raises(FormatError, match="no 3 of 3 photographs have enough features in common"):
        read_photographs(tmp_path, tmp_path / "work")
    with pytest.raises(FormatError, match="nowhere is not a folder"):
        read_photographs(tmp_path / "nowhere", tmp_path / "other")
    given = ["--format", "images", "--from", str(tmp_path / "work"), "--session", str(tmp_path / "s")]
    done = call("ground", "import", *given)
    assert done.stderr == f"ground: {tmp_path / 'work'}: expected at least 3 photographs, found 0\n"
    assert not (tmp_path / "s").exists()  # a refusal leaves nothing behind
    with pytest.raises(FormatError, match="at least 3 photographs, found 0"):
        read_photographs(tmp_path / "work", tmp_path / "other")
    cv2.imwrite(str(tmp_path / "3.png"), np.zeros((32, 64), np.uint8))
    with pytest.raises(FormatError, match="of a session have one size"):
        read_photographs(tmp_path, tmp_path / "work")


def test_features_of_other_pictures_of_the_same_names_are_not_used(tmp_path, caplog):
    pictures, work = tmp_path / "pictures", tmp_path / "work"
    pictures.mkdir()

    def features_stay() -> bool:
        for i in range(3):
            cv2.imwrite(str(pictures / f"{i}.png"), np.full((64, 64), grey, np.uint8))
        with pytest.raises(FormatError, match="features in common"):
            read_photographs(pictures, work)
        stay = (work / "mark").exists()
        (work / "mark").touch()
        return stay

    grey = 50
    assert not features_stay() and features_stay()
    assert "begins anew" not in caplog.text
    grey = 60
    assert not features_stay() and "is of other pictures" in caplog.text


def test_a_folder_that_no_import_has_made_is_left_alone(tmp_path):
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((64, 64), 50, np.uint8))
    mine = tmp_path / "work" / "mine.txt"
    mine.parent.mkdir()
    mine.write_text("precious")
    with pytest.raises(FormatError, match="not from an import"):
        read_photographs(tmp_path, mine.parent)
    assert mine.read_text() == "precious"


def test_deviations_of_poses_are_numbers_of_at_least_0():
    with pytest.raises(ValueError, match="at least 0"):
        PoseSigmas(0.1, -1.0)


def test_a_damaged_registration_is_named(registered, tmp_path):
    write_session(registered.views, tmp_path, "images: here", registration=registered.described())
    header = json.loads((tmp_path / "session.json").read_text())
    (tmp_path / "session.json").write_text(json.dumps(header | {"registration": 3}))
    with pytest.raises(Exception, match="registration"):
        open_session(tmp_path)
