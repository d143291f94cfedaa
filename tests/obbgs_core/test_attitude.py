"""The attitude of an unknown target: its free rotation, the agreement of outlines, and the search for its motion."""

import dataclasses

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from hil.world.attitude import tumble
from obbgs_base.physics.navigation_errors import SharedParameters
from obbgs_core.attitude import search
from obbgs_core.attitude.coherence import FILL, coherences, grid_points
from obbgs_core.attitude.estimate import AttitudeUndetermined, estimate_motion
from obbgs_core.attitude.motion import SPIN, TUMBLE, at_epoch, attitudes, inertia, principal
from obbgs_core.attitude.outlines import centred
from obbgs_core.attitude.refine import refined
from obbgs_core.attitude.search import mirrored
from obbgs_core.attitude.views import views
from obbgs_core.frames import Navigation, TrainingFrame
from obbgs_core.start.hull import Silhouette
from tests import scenes

RATE_RAD_S = np.array([0.006, 0.016, 0.008])
RANGE_M, FOCAL_PX, SIZE_PX = 40.0, 640.0, 64
shapes = arrays(float, TUMBLE - SPIN, elements=st.floats(-1, 1))
rates = arrays(float, SPIN, elements=st.floats(-0.03, 0.03))


def turned(rotation: np.ndarray) -> float:
    """Return a rotation's angle, rad."""
    return float(Rotation.from_matrix(rotation).magnitude())


@settings(max_examples=15, deadline=None)
@given(rates, shapes, st.floats(-300, 300))
def test_a_tumble_is_that_of_the_simulator(rate, shape, time_s):
    parameters = np.concatenate([rate, shape])
    ours = attitudes(parameters[None], np.array([time_s]))[0, 0]
    own = principal(parameters)  # the simulator takes rates about principal axes, and goes forwards only
    sign = 1.0 if time_s >= 0 else -1.0
    state = tumble(own.moments, sign * own.axes.T @ rate, np.array([1.0, 0, 0, 0]), abs(time_s) + 1.0)(
        abs(time_s)
    )
    start_to_principal = Rotation.from_quat(state[[1, 2, 3, 0]]).as_matrix().T
    expected = own.axes @ start_to_principal @ own.axes.T
    assert turned(ours @ expected.T) < 1e-4  # the integration's error over at most a few turns


@settings(max_examples=15, deadline=None)
@given(rates, shapes, st.floats(-200, 200), st.floats(-200, 200))
@example(np.full(3, 1.5e-153), np.zeros(5), 0.0, 1.0)
def test_the_epoch_does_not_change_a_motion(rate, shape, epoch_s, time_s):
    parameters = np.concatenate([rate, shape])
    before = attitudes(parameters[None], np.array([epoch_s, epoch_s + time_s]))[0]
    after = attitudes(at_epoch(parameters, epoch_s)[None], np.array([time_s]))[0, 0]
    assert turned(before[0].T @ before[1] @ after.T) < 1e-4


@given(shapes)
def test_every_inertia_belongs_to_a_body_that_can_exist(shape):
    moments = np.linalg.eigvalsh(inertia(np.concatenate([RATE_RAD_S, shape])))
    assert moments[0] > 0 and moments[0] + moments[1] >= moments[2] - 1e-12


def body() -> torch.Tensor:
    """Return points [V, 3] of a body without symmetry: three arms of different lengths and a plate."""
    rng = np.random.default_rng(0)
    parts = [
        rng.uniform([-0.2, -0.2, -0.9], [0.2, 0.2, 0.5], (3000, 3)),
        rng.uniform([0.1, -0.1, 0.2], [0.95, 0.1, 0.4], (2000, 3)),
        rng.uniform([-0.1, -0.7, -0.5], [0.1, 0.0, -0.3], (2000, 3)),
        rng.uniform([-0.7, -0.1, -0.9], [0.1, 0.4, -0.8], (2000, 3)),
    ]
    return torch.from_numpy(np.concatenate(parts)).float()


def chaser_poses(times_s: np.ndarray) -> torch.Tensor:
    """Return inertial axes to camera [N, 4, 4] of a chaser that circles the target and looks at it."""
    poses = torch.eye(4).repeat(len(times_s), 1, 1)
    poses[:, :3, :3] = torch.from_numpy(
        Rotation.from_rotvec(times_s[:, None] * [0.001, 0, 0.0003]).as_matrix()
    )
    poses[:, 2, 3] = RANGE_M
    return poses


def pictures(
    parameters: np.ndarray, times_s: np.ndarray, points: torch.Tensor | None = None
) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Return masks [64, 64] of a rotating body, without holes, and the poses of their cameras."""
    points = body() if points is None else points
    poses, masks = chaser_poses(times_s), []
    for pose, attitude in zip(poses, attitudes(parameters[None], times_s)[0], strict=True):
        p = points @ torch.from_numpy(attitude).float() @ pose[:3, :3].T + pose[:3, 3]
        pixels = (p[:, :2] / p[:, 2:] * FOCAL_PX + SIZE_PX / 2).long()
        mask = torch.zeros(SIZE_PX, SIZE_PX, dtype=torch.bool)
        mask[pixels[:, 1], pixels[:, 0]] = True
        masks.append(F.max_pool2d(mask[None].float(), 3, 1, 1)[0] > 0)
    return masks, poses


def outlines(parameters: np.ndarray, times_s: np.ndarray) -> list[Silhouette]:
    masks, poses = pictures(parameters, times_s)
    K = scenes.intrinsics(SIZE_PX, FOCAL_PX)
    return [Silhouette(m, m, ~m, pose, K).dilated(1) for m, pose in zip(masks, poses, strict=True)]


def photographs(
    parameters: np.ndarray, times_s: np.ndarray, points: torch.Tensor | None = None
) -> list[TrainingFrame]:
    """Return frames of a rotating body, evenly bright, with the sensor's noise."""
    masks, poses = pictures(parameters, times_s, points)
    rng = torch.Generator().manual_seed(1)
    frames = []
    for index, (mask, pose) in enumerate(zip(masks, poses, strict=True)):
        noise = torch.randn(SIZE_PX, SIZE_PX, 1, generator=rng) * scenes.SENSOR.read_noise_dn
        dn = (scenes.SENSOR.black_dn + 400.0 * mask[..., None] + noise).round().clamp(min=0)
        K = scenes.intrinsics(SIZE_PX, FOCAL_PX)
        frames.append(TrainingFrame(dn, 1e-4, pose, K, id=index, bracket=index))
    return frames


def test_outlines_agree_under_the_true_motion_and_not_under_others():
    times_s = np.arange(-6, 7) * 20.0
    seen = views(outlines(RATE_RAD_S, times_s), times_s, 1.2, 16)
    wrong = Rotation.random(30, np.random.default_rng(0)).apply(RATE_RAD_S)
    wrong = wrong[np.abs(wrong @ RATE_RAD_S) < 0.5 * (RATE_RAD_S @ RATE_RAD_S)][
        :8
    ]  # more than 60 degrees away
    body_axes = torch.from_numpy(attitudes(np.concatenate([RATE_RAD_S[None], wrong]), times_s)).float()
    coherence = coherences(seen, body_axes, grid_points(FILL * seen.cell))
    assert coherence[0] > 0.95 and coherence[1:].max() < coherence[0] - 0.02


def test_the_mirrored_body_shows_the_same_outlines_from_far_away():
    """Seen along z, reflecting body and motion in the plane of the picture changes no outline."""
    times_s, direction = np.array([0.0, 30.0]), np.eye(3)
    mirror = mirrored(RATE_RAD_S[None], direction)[0]
    points, flip = body().double().numpy(), np.diag([1.0, 1.0, -1.0])
    for now, other in zip(*attitudes(np.stack([RATE_RAD_S, mirror]), times_s), strict=True):
        np.testing.assert_allclose((points @ now)[:, :2], (points @ flip @ other)[:, :2], atol=1e-12)


def test_refinement_brings_a_spin_to_the_true_one():
    times_s = np.arange(-6, 7) * 20.0
    seen = views(outlines(RATE_RAD_S, times_s), times_s, 1.2, 32)
    start = RATE_RAD_S + np.array([0.12, -0.05, 0.05]) / times_s[-1]  # 0.14 rad at the arc's ends
    moved, cost = refined(seen, start[None], 8)
    assert (
        np.linalg.norm(moved[0] - RATE_RAD_S) * times_s[-1] < 0.06
    )  # a pixel at the target's edge is 0.04 rad
    assert cost[0] < refined(seen, start[None], 0)[1][0]


def test_the_spin_of_an_unknown_target_is_found_from_its_frames(monkeypatch):
    monkeypatch.setattr(
        search, "MOST_TURN_RAD", 0.5
    )  # it turns by 0.38 rad: a quarter of the candidates will do
    times_s = (np.arange(26) - 13) * 20.0
    frames = photographs(RATE_RAD_S, times_s)
    shown = []
    motion = estimate_motion(frames, times_s, scenes.SENSOR, lambda what, share: shown.append((what, share)))
    assert not motion.tumbles and motion.views == 26
    true = attitudes(RATE_RAD_S[None], times_s)[0]
    found = motion.inertial_to_body(times_s)
    turns = np.einsum("ij,njk,nlk->nil", motion.epoch_to_body, true, found)
    assert max(map(turned, turns)) < np.radians(3)
    facts = motion.facts()
    axis = np.degrees(np.arccos(facts["axis_inertial"] @ RATE_RAD_S / np.linalg.norm(RATE_RAD_S)))
    assert axis < 1.5 and abs(facts["period_s"] * np.linalg.norm(RATE_RAD_S) / 2 / np.pi - 1) < 0.01
    expected = np.array([0.0, 0.0, np.linalg.norm(RATE_RAD_S)])
    np.testing.assert_allclose(motion.epoch_to_body @ RATE_RAD_S, expected, atol=5e-4)
    assert {what for what, _ in shown} == {"searching the spin", "following the motion", "judging the motion"}
    assert all(0 <= share <= 1 for _, share in shown)


@pytest.mark.parametrize("boresight_rad", [[0.02, 0.04, 0.0], [0.0, 0.0, 0.0]])
def test_a_boresight_that_errs_is_taken_out_of_the_outlines_and_an_exact_one_stays(boresight_rad):
    times_s = (np.arange(26) - 13) * 20.0
    sigmas = SharedParameters(boresight_rad=np.full(3, 0.05))
    true = photographs(RATE_RAD_S, times_s)
    error = torch.eye(4)
    error[:3, :3] = torch.from_numpy(Rotation.from_rotvec(boresight_rad).as_matrix())
    tagged = [
        dataclasses.replace(f, world_to_camera=error @ f.world_to_camera, navigation=Navigation(sigmas))
        for f in true
    ]
    moved = centred(tagged, scenes.SENSOR)
    if not any(boresight_rad):
        assert moved is tagged
    for before, after, exact in zip(tagged, moved, true, strict=True):
        seen, off = (f.world_to_camera[:2, 3] / RANGE_M * FOCAL_PX for f in (after, before))
        wanted = exact.world_to_camera[:2, 3] / RANGE_M * FOCAL_PX
        assert (
            seen - wanted
        ).norm() < 3  # of the target's 16 px of radius; its outline's centre is not its own
        assert (off - wanted).norm() > 25 or not any(boresight_rad)


def test_few_or_dark_frames_do_not_determine_an_attitude():
    times_s = np.arange(30) * 20.0
    frames = photographs(RATE_RAD_S, times_s)
    with pytest.raises(AttitudeUndetermined, match="10 brackets show light"):
        estimate_motion(frames[:10], times_s[:10], scenes.SENSOR)


def round_body(radius: float, half_length: float) -> torch.Tensor:
    """Return points [V, 3] of a cylinder about z."""
    rng = np.random.default_rng(1)
    turn, share = rng.uniform(0, 2 * np.pi, 9000), np.sqrt(rng.uniform(0, 1, 9000))
    x, y = radius * share * np.cos(turn), radius * share * np.sin(turn)
    return torch.from_numpy(np.stack([x, y, rng.uniform(-half_length, half_length, 9000)], axis=1)).float()


def ball() -> torch.Tensor:
    points = torch.randn(9000, 3, generator=torch.Generator().manual_seed(2))
    return 0.8 * points / points.norm(dim=1, keepdim=True)


def test_a_spin_of_less_than_half_a_turn_in_the_pass_is_found(monkeypatch):
    monkeypatch.setattr(search, "MOST_TURN_RAD", 0.2)  # it turns by 0.12 rad from view to view
    times_s, rate = (np.arange(26) - 13) * 20.0, RATE_RAD_S / 3
    motion = estimate_motion(photographs(rate, times_s), times_s, scenes.SENSOR)
    turns = np.einsum(
        "ij,njk,nlk->nil",
        motion.epoch_to_body,
        attitudes(rate[None], times_s)[0],
        motion.inertial_to_body(times_s),
    )
    assert not motion.tumbles and max(map(turned, turns)) < np.radians(4)


def test_a_body_that_is_round_about_its_axis_does_not_tell_how_it_rolls(monkeypatch):
    monkeypatch.setattr(search, "MOST_TURN_RAD", 0.15)
    times_s = (np.arange(26) - 13) * 20.0
    frames = photographs(np.array([0.005, 0.0, 0.0005]), times_s, round_body(0.4, 0.9))
    with pytest.raises(AttitudeUndetermined, match="round about an axis"):
        estimate_motion(frames, times_s, scenes.SENSOR)


def test_a_ball_does_not_tell_how_it_turns():
    times_s = np.arange(26) * 20.0
    with pytest.raises(AttitudeUndetermined, match="agree under any motion"):
        estimate_motion(photographs(RATE_RAD_S, times_s, ball()), times_s, scenes.SENSOR)
