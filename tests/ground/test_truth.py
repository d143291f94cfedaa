"""The truth folder: what is written is read again, old sessions open, and what cannot be read is refused by name."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from ground.session.folder import Navigation, SessionError, open_session
from ground.session.truth import SCHEMA_VERSION, TrueFrame, Truth, write_truth

GOLDEN = Path(__file__).parents[1] / "golden" / "session"
CUBE = trimesh.creation.box(extents=(4, 2, 2))


@pytest.fixture
def session(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "session")
    return open_session(tmp_path / "session")


def true_frame(number: int, with_geometry: bool = False) -> TrueFrame:
    rng = np.random.default_rng(number)
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(size=3)
    radiance = rng.random((6, 8, 1)).astype(np.float16)
    coverage = rng.integers(0, 256, (6, 8), dtype=np.uint8)
    if not with_geometry:
        return TrueFrame(number, pose, radiance, coverage)
    depth = np.where(coverage > 0, 400.0, np.inf).astype(np.float32)
    return TrueFrame(number, pose, radiance, coverage, depth, rng.random((6, 8, 3)).astype(np.float16))


def rewritten(session, **changes) -> None:
    """Change keys of a session's truth.json; None removes one."""
    path = session.path / "truth" / "truth.json"
    facts = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in facts.items() if value is not None}))


def test_what_is_written_is_read_again_and_replaces_what_was_there(session):
    frames = [true_frame(record.id) for record in session.frames]
    cloud = np.random.default_rng(1).normal(size=(50, 3))
    simulation = {"camera": {"kind": "hil", "late_frames": 3}}
    write_truth(session.path, iter(frames), CUBE.vertices, CUBE.faces, cloud, simulation)
    truth = Truth(session)
    assert Truth.exists(session) and not (session.path / "truth.part").exists()
    assert truth.largest_dimension_m == 4 and truth.simulation == simulation
    np.testing.assert_array_equal(truth.cloud_m, cloud.astype(np.float32))
    for record, frame in zip(session.frames, frames, strict=True):
        radiance, coverage = truth.radiance(record)
        np.testing.assert_array_equal(radiance, frame.radiance)
        np.testing.assert_allclose(coverage, frame.alpha / 255, rtol=1e-6)
        np.testing.assert_array_equal(truth.posed(record).world_to_camera, frame.world_to_camera)
        assert truth.posed(record).sha256 == record.sha256
    mesh = trimesh.load(session.path / "truth" / "mesh.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, CUBE.vertices)
    np.testing.assert_array_equal(mesh.faces, CUBE.faces)


def test_finer_light_is_kept_where_it_is_given(session):
    finer = np.random.default_rng(2).random((12, 16, 1)).astype(np.float16)
    frames = [dataclasses.replace(true_frame(0), finer=finer), true_frame(1)]
    write_truth(session.path, frames, CUBE.vertices, CUBE.faces, np.zeros((0, 3)))
    records = {record.id: record for record in session.frames}
    truth = Truth(session)
    np.testing.assert_array_equal(truth.finer(records[0]), finer)
    assert truth.finer(records[1]) is None


def test_depth_and_normals_are_kept_where_they_are_given(session):
    frame = true_frame(0, with_geometry=True)
    write_truth(session.path, [frame, true_frame(1)], CUBE.vertices, CUBE.faces, np.zeros((0, 3)))
    folder = session.path / "truth"
    first, second = json.loads((folder / "truth.json").read_text())["frames"]
    with np.load(folder / first["geometry"]) as arrays:
        np.testing.assert_array_equal(arrays["depth"], frame.depth)
        np.testing.assert_array_equal(arrays["normals"], frame.normals)
    assert "geometry" not in second


def test_a_truth_that_was_not_written_to_its_end_leaves_the_old_one(session):
    before = Truth(session)

    def frames():
        yield true_frame(0)
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        write_truth(session.path, frames(), CUBE.vertices, CUBE.faces, np.zeros((0, 3)))
    np.testing.assert_array_equal(Truth(session).cloud_m, before.cloud_m)


def test_a_truth_without_a_version_is_an_old_one_and_opens(session):
    assert "schema_version" not in json.loads((session.path / "truth" / "truth.json").read_text())
    assert Truth(session).largest_dimension_m == 6


def test_a_truth_of_a_later_version_is_refused_with_both_versions(session):
    rewritten(session, schema_version=SCHEMA_VERSION + 1)
    with pytest.raises(SessionError, match=r"schema version 2; this software reads up to 1"):
        Truth(session)


@pytest.mark.parametrize(
    "changes",
    [
        {"schema_version": "new"},
        {"frames": None},
        {"frames": [{"id": 0}]},
        {"frames": [{"id": 0, "radiance": 7, "world_to_camera": np.eye(4).tolist()}]},
        {"frames": [{"id": 0, "radiance": "a.npz", "world_to_camera": np.eye(3).tolist()}]},
        {"cloud": "none.ply"},
    ],
    ids=["version", "no frames", "no pose", "no path", "no 4x4 pose", "no cloud"],
)
def test_a_damaged_truth_is_refused_and_named(session, changes):
    rewritten(session, **changes)
    with pytest.raises(SessionError, match=r"truth.* is damaged"):
        Truth(session)


def test_what_a_truth_has_not_and_how_to_go_on_is_said(session):
    (session.path / "truth" / "truth.json").write_text("{}")
    with pytest.raises(SessionError, match=r"truth\.json has no 'frames'; simulate the pass again, or move"):
        Truth(session)


def test_a_truth_of_another_pass_cannot_be_turned_and_is_named(session):
    others = [{"id": 9000, "radiance": "a.npz", "world_to_camera": np.eye(4).tolist()}]
    rewritten(session, frames=others)
    turned = dataclasses.replace(session, navigation=Navigation(attitude="rate_only"))
    with pytest.raises(
        SessionError, match="holds no frame 0: it is of another pass; simulate the pass again"
    ):
        Truth(turned)


@pytest.mark.parametrize("degrees", [0, 90, 180])
def test_the_truth_is_in_axes_that_were_chosen_freely(session, degrees):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(degrees * np.array([0.6, 0, 0.8]), degrees=True).as_matrix()
    before = Truth(session)
    frames = [
        dataclasses.replace(r, world_to_camera=before.posed(r).world_to_camera @ turn.T)
        for r in session.frames
    ]
    turned = dataclasses.replace(session, frames=frames, navigation=Navigation(attitude="rate_only"))
    truth = Truth(turned)
    for record in frames:
        np.testing.assert_allclose(truth.posed(record).world_to_camera, record.world_to_camera, atol=1e-9)
    np.testing.assert_allclose(truth.cloud_m, before.cloud_m @ turn[:3, :3].T, atol=1e-9)


def test_whatever_byte_of_a_radiance_is_damaged_it_is_read_or_named(session):
    truth, record = Truth(session), session.frames[0]
    path = session.path / "truth" / "radiance" / f"{record.id:06d}.npz"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    named = 0
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            truth.radiance(record)
        except SessionError as error:
            named += "is damaged" in str(error)
    assert named > 50


def test_a_frame_that_the_truth_lacks_and_a_damaged_file_are_named(session):
    truth, record = Truth(session), session.frames[0]
    (session.path / "truth" / "radiance" / f"{record.id:06d}.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(SessionError, match=r"000000.npz is damaged"):
        truth.radiance(record)
    unknown = dataclasses.replace(record, id=999)
    for read in (truth.radiance, truth.posed):
        with pytest.raises(SessionError, match="holds no frame 999"):
            read(unknown)
