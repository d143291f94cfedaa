"""The estimated poses of a run: written and read, and the model's place in the true body frame."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from compare.case import load_case
from compare.opponents.reconstruction import EstimatedPoses, Reconstruction
from flightsw.icd.quaternion import quat_to_matrix
from ground.run.estimated_poses import FILE, Alignment, estimated_records, read_estimate, write_estimate
from ground.session.folder import SessionError, open_session
from ground.session.truth import Truth
from ground.show.viewer.source import Source
from obbgs_base.physics.navigation_errors import SharedParameters
from obbgs_core.frames import cameras_of
from obbgs_core.io.ply import save_ply
from obbgs_core.model.motions import rigid_motions
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.render import render
from obbgs_core.score.poses import moved
from tests.scenes import random_gaussians

GOLDEN = Path(__file__).parents[1] / "golden" / "session"
MOTION = rigid_motions(torch.tensor([[0.02, -0.03, 0.01, 0.2, -0.1, 0.3]]).double())[0]


@pytest.fixture(scope="module")
def estimate() -> PoseEstimate:
    """An estimate whose poses are the true ones, seen from a body frame that is moved; the tags are turned by 0.1."""
    session = open_session(GOLDEN)
    truth, records = Truth(session), session.frames
    true = torch.from_numpy(np.stack([truth.posed(r).world_to_camera for r in records]))
    turns = torch.zeros(len(records), 6).double()
    turns[::2, 2] = 0.1
    rng = np.random.default_rng(0)
    sigmas = SharedParameters(boresight_rad=np.full(3, 0.01), clock_s=np.full(1, 0.1))
    return PoseEstimate(
        frame_ids=[r.id for r in records],
        brackets=[r.bracket for r in records],
        tagged=(rigid_motions(turns) @ true).numpy(),
        estimated=(true @ MOTION).numpy(),
        shared=SharedParameters(boresight_rad=rng.normal(size=3)),
        shared_prior=sigmas,
        shared_posterior=dataclasses.replace(sigmas, boresight_rad=np.array([1e-4, 1e-3, 9e-3])),
        shared_covariance=rng.normal(size=(19, 19)),
        own=rng.normal(size=(3, 6)),
        own_prior=rng.random((3, 6)),
        own_posterior=rng.random((3, 6)),
    )


def test_an_estimate_is_read_as_it_was_written(estimate, tmp_path):
    write_estimate(tmp_path, None)
    assert read_estimate(tmp_path) is None
    write_estimate(tmp_path, estimate)
    found = read_estimate(tmp_path)
    assert found is not None and found.tree() == estimate.tree()
    assert found.unobservable() == ["boresight_rad[2]", "clock_s"]


@pytest.mark.parametrize("damage", ["{", "[]", json.dumps({"shared": {}})])
def test_a_damaged_estimate_is_refused(tmp_path, damage):
    (tmp_path / FILE).write_text(damage)
    with pytest.raises(SessionError, match=r"poses_estimated.json cannot be read.*make the run again"):
        read_estimate(tmp_path)


def test_a_model_that_moved_with_its_poses_is_found_again(estimate):
    session = open_session(GOLDEN)
    found = Alignment.of(estimate, session, Truth(session))
    torch.testing.assert_close(found.motion, MOTION, rtol=0, atol=1e-6)
    figures = found.figures()
    assert figures["pose_error_deg"] < 1e-4 and figures["pose_error_px"] < 1e-3
    # half of the tags are turned by 0.1 rad about the line of sight, and no motion of the body undoes that
    assert 1 < figures["pose_error_tagged_deg"] < np.degrees(0.1)


@pytest.mark.parametrize("size", [1.04, 0.97])
def test_a_model_of_another_size_is_told_and_scored_as_one_of_the_true_size(estimate, size):
    """Cameras farther away by as much show the larger model as before; scores after the similarity are as of truth."""
    farther = estimate.estimated.copy()
    farther[:, :3, 3] *= size
    larger, case = dataclasses.replace(estimate, estimated=farther), load_case(GOLDEN)
    figures = Alignment.of(larger, open_session(GOLDEN), Truth(open_session(GOLDEN))).figures()
    assert figures["size_error_percent"] == pytest.approx(100 * (size - 1), abs=1e-3)
    assert figures["similarity_pose_error_range"] < 1e-5 < 0.02 < figures["pose_error_range"]
    nothing = torch.zeros(0, 3)
    made = Reconstruction(nothing, nothing, None, 0, 0.0, poses=EstimatedPoses(larger, lambda frames: frames))
    true_m = torch.from_numpy(case.cloud_m)
    model_m = size * (true_m - MOTION[:3, 3]) @ MOTION[:3, :3]
    rigid, sized = (case.seen_by(made, with_size)[0] for with_size in (False, True))
    assert rigid.cloud_scores(model_m, model_m)["chamfer"] > 0.005
    assert sized.cloud_scores(model_m, model_m)["chamfer"] < 1e-6
    for given, there in zip(case.held_out, sized.held_out, strict=True):
        at = there.world_to_camera[:3, :3].double() @ model_m.T + there.world_to_camera[:3, 3:]
        was = given.world_to_camera[:3, :3].double() @ true_m.T + given.world_to_camera[:3, 3:]
        torch.testing.assert_close(at[:2] / at[2], was[:2] / was[2], rtol=0, atol=1e-6)


def test_surfaces_are_seen_from_the_poses_that_were_found_and_frames_left_out_are_left_out(estimate):
    records = list(open_session(GOLDEN).frames)
    assert estimated_records(records, None) is records
    fewer = dataclasses.replace(estimate, frame_ids=estimate.frame_ids[1:], estimated=estimate.estimated[1:])
    found = estimated_records(records, fewer)
    assert [record.id for record in found] == fewer.frame_ids
    for record, pose in zip(found, fewer.estimated, strict=True):
        np.testing.assert_array_equal(record.world_to_camera, pose)
        np.testing.assert_allclose(pose[:3, :3] @ record.position_body_m + pose[:3, 3], 0, atol=1e-6)
        np.testing.assert_allclose(quat_to_matrix(record.quat_body_to_camera), pose[:3, :3], atol=1e-6)


def test_the_viewer_shows_frames_from_the_poses_that_were_found(estimate, tmp_path):
    """Of a frame that the training was not given the tag stays, where it states no navigation."""
    session = Path(shutil.copytree(GOLDEN, tmp_path / "session"))
    run = session / "runs" / "run"
    run.mkdir(parents=True)
    save_ply(random_gaussians(20), run / "model.ply")
    tagged = [record.world_to_camera for record in open_session(session).frames]
    np.testing.assert_array_equal([r.world_to_camera for r in Source(run).load().session.frames], tagged)
    by_frame = {
        name: getattr(estimate, name)[1:] for name in ("frame_ids", "brackets", "tagged", "estimated")
    }
    fewer = dataclasses.replace(estimate, **by_frame)
    write_estimate(run, fewer)
    first, *others = Source(run).load().session.frames
    np.testing.assert_allclose(first.world_to_camera, tagged[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal([r.world_to_camera for r in others], fewer.estimated)


def test_a_comparison_sees_a_model_from_where_its_estimated_poses_put_it(estimate):
    """Truth that moves with the model gives the same pictures and distances as a model that had stayed."""
    case = load_case(GOLDEN)
    model, asked = random_gaussians(20), []

    def settled(frames):
        asked.append(frames)
        return frames[:1]

    as_given, nothing = Reconstruction.nothing(0.0, ""), torch.zeros(0, 3)
    assert case.seen_by(as_given) == (case, {})
    estimated = Reconstruction(nothing, nothing, None, 0, 0.0, poses=EstimatedPoses(estimate, settled))
    seen, figures = case.seen_by(estimated)
    assert figures["pose_error_deg"] < 1e-4 < 1 < figures["pose_error_tagged_deg"] and not asked
    for given, there in zip(case.held_out, seen.held_out, strict=True):
        expected = render(moved(model, MOTION), cameras_of([given])).radiance
        torch.testing.assert_close(render(model, cameras_of([there])).radiance, expected, rtol=0, atol=1e-3)
    still = torch.from_numpy(case.cloud_m)
    back = (still - MOTION[:3, 3]) @ MOTION[:3, :3]
    assert case.cloud_scores(back, back)["chamfer"] > 0.01 > 1e-6 > seen.cloud_scores(back, back)["chamfer"]
    unknown = dataclasses.replace(case, radiance=[], coverage=[], cloud_m=None)
    assert unknown.seen_by(estimated)[0].held_out == case.held_out[:1] and asked[-1] == case.held_out
