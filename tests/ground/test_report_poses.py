"""What the report says of estimated poses, on frames of a known model whose tags were made to err."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground.run.estimated_poses import write_estimate
from ground.run.runs import Run
from ground.session.cameras import sensor_of
from ground.session.folder import Navigation, open_session, pass_name
from ground.session.training_frames import split
from ground.show.report.poses import PATH, pose_history, poses_section, shared_rows
from ground.show.sizes import with_deviation
from obbgs_base.physics.navigation_errors import SIZE, SharedParameters
from obbgs_core.poses.estimate import PoseEstimate
from tests import scenes
from tests.small_sessions import small_session

BORESIGHT_RAD, LEFT_RAD = 0.02, 0.001


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """A run whose model is the truth, tags that err by a turn of each, and an estimate that is right."""
    folder = small_session(tmp_path_factory.mktemp("session"))
    sigmas = SharedParameters(boresight_rad=np.full(3, BORESIGHT_RAD))
    session = dataclasses.replace(open_session(folder), navigation=Navigation(sigmas=sigmas))
    gaussians = scenes.target(seed=0)
    training, held_out = split(session)
    true = np.array([record.world_to_camera for record in training])
    turns = 0.05 * np.random.default_rng(2).normal(size=(len(true), 3))
    error = np.tile(np.eye(4), (len(true), 1, 1))
    error[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    tagged = error @ true
    covariance = np.zeros((SIZE, SIZE))
    boresight = slice(14, 17)  # after 3 + 3 + 3 + 3 + 2 others
    covariance[boresight, boresight] = LEFT_RAD**2 * np.eye(3)
    brackets = bracket_numbers_of(training)
    rows = max(brackets) + 1
    estimate = PoseEstimate(
        frame_ids=[record.id for record in training],
        brackets=brackets,
        tagged=tagged,
        estimated=true,
        shared=SharedParameters(boresight_rad=[0.011, 0, 0]),
        shared_prior=sigmas,
        shared_posterior=SharedParameters(boresight_rad=[LEFT_RAD, LEFT_RAD, 0.9 * BORESIGHT_RAD]),
        shared_covariance=covariance,
        own=np.zeros((rows, 6)),
        own_prior=np.zeros((rows, 6)),
        own_posterior=np.full((rows, 6), 0.003),
    )
    metrics = {"scored_frames": "held_out"}
    run = Run(folder, session, training, held_out, sensor_of(session.camera), gaussians, None, metrics)
    write_estimate(folder, estimate)
    return run, estimate, turns


def bracket_numbers_of(records) -> list[int]:
    order = sorted({record.bracket for record in records})
    return [order.index(record.bracket) for record in records]


def test_corrections_undo_the_errors_and_carry_their_deviations(example):
    run, estimate, turns = example
    history = pose_history(run, estimate)
    assert (np.diff(history.along) >= 0).all()
    place_of = {number: place for place, number in enumerate(estimate.frame_ids)}
    for row, number in enumerate(history.frame_ids):
        np.testing.assert_allclose(history.correction[row, :3], -turns[place_of[number]], atol=1e-6)
        np.testing.assert_allclose(
            np.diag(history.prior[row]), [BORESIGHT_RAD**2] * 3 + [0] * 3, rtol=1e-4, atol=1e-12
        )
        expected = [LEFT_RAD**2 + 0.003**2] * 3 + [0.003**2] * 3
        np.testing.assert_allclose(np.diag(history.posterior[row]), expected, rtol=1e-4)


def test_the_residual_is_that_of_noise_from_the_right_poses_only(example):
    run, estimate, _ = example
    history = pose_history(run, estimate)
    assert 0.7 < np.median(history.chi2_estimated) < 1.4  # the model is the truth
    assert (history.chi2_tagged > 2 * history.chi2_estimated).mean() > 0.8
    assert history.misfits == []


def test_a_tag_that_places_the_target_beside_the_picture_has_the_residual_of_a_picture_without_it(example):
    run, estimate, _ = example
    place, tagged, aside = 4, estimate.tagged.copy(), np.eye(4)
    aside[0, 3] = 1e3  # m to the right
    tagged[place] = aside @ tagged[place]
    row = pose_history(run, estimate).frame_ids.index(estimate.frame_ids[place])
    history = pose_history(run, dataclasses.replace(estimate, tagged=tagged))
    assert history.chi2_tagged[row] > 10 * history.chi2_estimated[row]
    assert pass_name(Path("/a/pass-12")) == "pass-12" and pass_name(Path("/a/demo/session")) == "demo"


def test_the_section_tells_values_with_both_deviations_and_what_the_frames_do_not_determine(example):
    run, *_ = example
    page = poses_section(run).replace("\N{NO-BREAK SPACE}", " ")
    assert (
        "boresight, camera x" in page and "0.630 ± 0.057 (stated ± 1.1) deg" in page
    )  # 0.011 rad in degrees
    assert "boresight, camera z: not determined by the frames" in page
    assert "relative position" not in page  # exact by the tags
    assert page.count("plotly-graph-div") == 3
    assert "corrections, " in page and PATH in page  # the line that joins them is named too
    assert "The residual chi² is 1" in page and "residual is" not in page


def test_a_bracket_whose_residual_stands_out_is_named(example):
    run, estimate, _ = example
    moved, place, turn = estimate.estimated.copy(), 4, np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.6]).as_matrix()
    moved[place] = turn @ moved[place]
    history = pose_history(run, dataclasses.replace(estimate, estimated=moved))
    assert history.misfits == [estimate.frame_ids[place]]


def test_what_is_as_good_as_known_along_an_axis_is_no_row(example):
    _, estimate, _ = example
    sigmas = SharedParameters(boresight_rad=np.array([1e-10, BORESIGHT_RAD, BORESIGHT_RAD]))
    words = [row[0] for row in shared_rows(dataclasses.replace(estimate, shared_prior=sigmas))]
    assert [text.partition(":")[0] for text in words] == ["boresight, camera y", "boresight, camera z"]


def test_values_are_told_to_the_second_digit_of_their_deviation():
    told = {
        (0.9181, 0.0986): "0.918 ± 0.099",
        (-0.0004902, 0.00067): "-0.00049 ± 0.00067",
        (0.254, 0.0996): "0.25 ± 0.10",
        (12345.6, 234.0): "12346 ± 234",
        (0.3, 0.0): "0.3 ± 0",
        (-0.0001, 0.021): "0.000 ± 0.021",
        (-0.0, 0.0): "0 ± 0",
        (-3.1e-14, 3e-12): "-3.1e-14 ± 3.0e-12",
    }
    assert {pair: with_deviation(*pair) for pair in told} == told


def test_frames_that_were_left_out_are_named_whatever_the_metrics_hold(example):
    run, *_ = example
    for held, told in (([3, 7], "The frames 3, 7 were left out"), (["<b>x"], "The frames &lt;b&gt;x were")):
        assert told in poses_section(dataclasses.replace(run, metrics=run.metrics | {"misfit_frames": held}))


def test_imported_pictures_have_no_minutes_metres_or_tags(example):
    run, estimate, _ = example
    plain = tuple(dataclasses.replace(r, mid_exposure_utc_ns=r.id * 10**9) for r in run.session.frames)
    count = len(plain)
    session = dataclasses.replace(run.session, frames=plain, frames_imported=count)
    imported = dataclasses.replace(run, session=session, metrics=run.metrics | {"frames_imported": count})
    history = pose_history(imported, estimate)
    assert (history.along_name, history.unit) == ("picture", "units")
    linked = dataclasses.replace(run, session=dataclasses.replace(session, frames_imported=None))
    received = pose_history(linked, estimate)
    assert (received.along_name, received.unit) == ("minutes", "m")
    assert history.along.tolist() == history.frame_ids
    assert "minutes" not in (page := poses_section(imported)) and "pose tags" not in page


def test_a_run_with_poses_as_tagged_has_no_such_section(example, tmp_path):
    assert poses_section(dataclasses.replace(example[0], folder=tmp_path)) == ""
