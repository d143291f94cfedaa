"""What the library checks of the frames that it is given."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame, bracket_numbers, usable
from obbgs_core.methods.presets import preset
from obbgs_core.train import train
from tests.scenes import SENSOR

WHITE_DN = 4095


def frame(**changes) -> TrainingFrame:
    pose = torch.eye(4)
    pose[2, 3] = 4.0
    K = torch.tensor([[60.0, 0, 16], [0, 60, 16], [0, 0, 1]])
    return dataclasses.replace(TrainingFrame(torch.zeros(8, 8, 1), 0.01, pose, K), **changes)


def test_a_picture_that_is_no_tensor_is_refused():
    with pytest.raises(ValueError, match=r"^dn: expected a torch\.Tensor, got numpy\.ndarray$"):
        frame(dn=np.zeros((8, 8, 1)))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"frames": 3}, "frames: expected a list of TrainingFrame, got 3"),
        ({"frames": ["a.png"]}, "frames[0]: expected a TrainingFrame, got 'a.png'"),
        (
            {"frames": [frame(world_to_camera=np.eye(4))]},
            "frame 0: world_to_camera: expected a torch.Tensor, got numpy.ndarray",
        ),
        (
            {"frames": [frame(sun_dir=np.ones(3))]},
            "frame 0: sun_dir: expected a torch.Tensor, got numpy.ndarray",
        ),
        ({"frames": [frame(exposure_time_s="1")]}, "frame 0: exposure_time_s: expected seconds, got '1'"),
        ({"sensor": None}, "sensor: expected a Sensor, got nothing"),
        ({"config": "obbgs"}, "config: expected a MethodConfig, such as preset(\"obbgs\"), got 'obbgs'"),
    ],
)
def test_what_a_training_is_given_of_another_type_is_refused_in_one_line(wrong, told):
    arguments = {"frames": [frame()] * 3, "sensor": SENSOR, "config": preset("obbgs")} | wrong
    with pytest.raises(ValueError) as refused:
        train(**arguments)
    assert str(refused.value) == told


def test_a_training_takes_frames_one_by_one():
    with pytest.raises(ReconstructionError, match="needs at least 3 frames, got 2"):
        train((frame() for _ in range(2)), SENSOR, preset("obbgs"))


def checked(bad: TrainingFrame) -> list[TrainingFrame]:
    return usable([frame(), frame(), bad], True, WHITE_DN)[0]


def pose_of(turn: np.ndarray, last=(0.0, 0.0, 0.0, 1.0)) -> torch.Tensor:
    pose = torch.eye(4)
    pose[:3, :3], pose[3] = torch.from_numpy(turn), torch.tensor(last)
    return pose


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"world_to_camera": pose_of(2 * np.eye(3))}, "frame 2: .*must be a rotation"),
        ({"world_to_camera": pose_of(0.99 * np.eye(3))}, "must be a rotation"),
        ({"world_to_camera": pose_of(np.eye(3) + np.diag([0.01, 0], 1))}, "must be a rotation"),
        ({"world_to_camera": pose_of(np.zeros((3, 3)))}, "must be a rotation"),
        ({"world_to_camera": pose_of(np.diag([1.0, 1, -1]))}, "mirrored"),
        ({"world_to_camera": pose_of(np.eye(3), (0, 0, 1, 1))}, "last row"),
        ({"K": torch.tensor([[60.0, 2, 16], [0, 60, 16], [0, 0, 1]])}, "skew"),
        ({"K": torch.tensor([[60.0, 0, 16], [0, -60, 16], [0, 0, 1]])}, "focal lengths must be positive"),
        ({"K": torch.tensor([[0.0, 0, 16], [0, 60, 16], [0, 0, 1]])}, "focal lengths must be positive"),
        ({"K": torch.tensor([[60.0, 0, 0], [0, 60, 0], [16, 16, 1]])}, "K must be"),
        ({"K": torch.tensor([[60.0, 0, 16], [0, 60, 16], [0, 0, 2]])}, "K must be"),
        ({"dn": torch.full((8, 8, 1), 65520.0)}, "above the sensor's white_dn of 4095"),
        ({"dn": torch.full((8, 8, 1), torch.nan)}, "not finite"),
        ({"world_to_camera": torch.full((4, 4), torch.nan)}, "not finite"),
    ],
)
def test_a_frame_that_no_camera_can_have_taken_is_refused_by_name(changes, told):
    with pytest.raises(ReconstructionError, match=told):
        checked(frame(**changes))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31), focal=st.floats(1, 1e5), place=st.tuples(*[st.floats(-1e4, 1e4)] * 3))
def test_every_rotation_with_any_focal_length_is_taken_also_as_printed_with_six_digits(seed, focal, place):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix().round(6)
    pose = pose_of(turn)
    pose[:3, 3] = torch.tensor(place)
    K = torch.tensor([[focal, 0, 16], [0, focal, 16], [0, 0, 1]])
    assert len(checked(frame(world_to_camera=pose, K=K))) == 3


def test_full_scale_itself_is_a_reading():
    assert len(checked(frame(dn=torch.full((8, 8, 1), float(WHITE_DN))))) == 3


def test_frames_without_ids_have_pose_corrections_of_their_own_and_are_named_by_their_place():
    assert bracket_numbers([frame(), frame(), frame()]) == [0, 1, 2]
    assert bracket_numbers([frame(bracket=0), frame(), frame(bracket=0), frame(id=5)]) == [0, 1, 0, 2]
    assert [f.id for f in usable([frame(), frame(), frame()], True)[0]] == [0, 1, 2]
    assert [f.id for f in usable([frame(id=4), frame(id=2), frame(id=9)], True)[0]] == [4, 2, 9]
