"""The target's rates at each frame of a session, found from the pose tags around it."""

import dataclasses

import numpy as np
import pytest
import torch

from ground.session.folder import Session, open_session
from ground.session.motion import rates
from ground.session.training_frames import frames_of
from obbgs_core.model.motions import rigid_motions
from tests.small_sessions import FOCAL_PX, small_session

TWIST = torch.tensor([0.004, -0.02, 0.05, 0.01, 0.03, -0.2], dtype=torch.float64)  # rad/s and m/s


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Session:
    """Return a session as over a link whose target moves evenly, a frame each second, exposed for a fifth of one."""
    session = open_session(small_session(tmp_path_factory.mktemp("session") / "A"))
    first = session.frames[0].world_to_camera
    frames = [
        dataclasses.replace(
            record,
            world_to_camera=rigid_motions(second * TWIST[None])[0].numpy() @ first,
            mid_exposure_utc_ns=10**18 + second * 10**9,
            exposure_time_s=0.2,
            pose_valid=second != 5,
        )
        for second, record in enumerate(session.frames)
    ]
    return dataclasses.replace(session, frames=tuple(frames), frames_imported=None)


@pytest.mark.parametrize("number", [0, 3, 4, 10, -1])
def test_rates_are_those_of_the_motion_that_the_tags_tell(moving, number):
    found = rates(moving, moving.frames[number])
    assert found is not None
    np.testing.assert_allclose(found.numpy(), TWIST.numpy(), rtol=1e-4, atol=1e-5)


def test_frames_of_a_training_carry_their_rates(moving):
    frames = frames_of(moving)
    assert len(frames) == len(moving.frames) - 1
    assert all(frame.rates is not None for frame in frames)


def exposed_for(session: Session, seconds: float) -> Session:
    frames = tuple(dataclasses.replace(record, exposure_time_s=seconds) for record in session.frames)
    return dataclasses.replace(session, frames=frames)


def test_what_no_picture_shows_is_left_out(moving):
    """A point at half the picture's width goes by 0.05 rad/s times that, and by what the other rates add."""
    slowest_px_s = 0.05 * FOCAL_PX / 4
    shown, not_shown = (exposed_for(moving, share / slowest_px_s) for share in (0.4, 0.02))
    assert frames_of(shown)[3].rates is not None and frames_of(not_shown)[3].rates is None


def test_pictures_that_were_imported_are_taken_as_standing_still(moving):
    imported = dataclasses.replace(moving, frames_imported=len(moving.frames))
    assert rates(imported, imported.frames[3]) is None


def test_tags_that_turn_by_more_than_a_radian_in_between_tell_no_rate(moving):
    apart = [
        dataclasses.replace(record, mid_exposure_utc_ns=10**18 + i * 10**9, world_to_camera=pose)
        for i, (record, pose) in enumerate(
            (record, rigid_motions(i * 20 * TWIST[None])[0].numpy() @ moving.frames[0].world_to_camera)
            for i, record in enumerate(moving.frames)
        )
    ]
    session = dataclasses.replace(moving, frames=tuple(apart))
    assert rates(session, session.frames[3]) is None
