"""Tests of the navigation errors that a pass shares: against integrated orbits and rotations by SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from obbgs_base.physics.navigation_errors import (
    NominalMotion,
    SharedParameters,
    displaced,
    displaced_motion,
    jacobian,
)

GM = 3.986004418e14  # m³/s²
RADIUS_M = 6.9e6
N_RAD_S = np.sqrt(GM / RADIUS_M**3)
RATE, INERTIA = np.array([0.01, 0.02, -0.005]), np.array([1.0, 2.0, 2.6])


def pass_of(frames: int = 20, span_s: float = 1500.0, tumbling: bool = True) -> NominalMotion:
    """Return a circular orbit's two-body fly-around, seen by a camera with arbitrary attitudes."""
    times = np.linspace(-span_s / 4, span_s, frames)
    normal_turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()  # inertial to RTN at the epoch
    path = two_body(
        times, np.array([200.0, 0.0, 150.0]), np.array([0.0, -2 * N_RAD_S * 200, 0.1]), normal_turn
    )
    cameras = Rotation.from_rotvec(np.outer(times, [1e-3, 2e-4, -5e-4])).as_matrix()
    bodies = tumble(times, RATE, INERTIA) if tumbling else np.broadcast_to(np.eye(3), (frames, 3, 3))
    spin = {"rate_rad_s": RATE, "inertia": INERTIA} if tumbling else {}
    return NominalMotion(times, path, cameras, bodies, N_RAD_S, normal_turn, **spin)


def two_body(times, position_rtn, velocity_rtn, inertial_to_rtn):
    """Return the chaser minus the target, both on Kepler orbits, inertial axes."""
    target = np.concatenate(
        [inertial_to_rtn.T @ [RADIUS_M, 0, 0], inertial_to_rtn.T @ [0, RADIUS_M * N_RAD_S, 0]]
    )
    velocity = velocity_rtn + np.cross([0, 0, N_RAD_S], position_rtn)
    chaser = target + np.concatenate([inertial_to_rtn.T @ position_rtn, inertial_to_rtn.T @ velocity])
    flown = [
        integrated(lambda _, y: [*y[3:], *(-GM * y[:3] / np.linalg.norm(y[:3]) ** 3)], s, times)
        for s in (target, chaser)
    ]
    return (flown[1] - flown[0])[:, :3]


def tumble(times, rate, inertia, start=None):
    """Return inertial_to_body [N, 3, 3] of Euler's equations, with the rotation matrix itself integrated."""
    start = np.eye(3) if start is None else start

    def slope(_, y):
        w, B = y[:3], y[3:].reshape(3, 3)
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([np.cross(inertia * w, w) / inertia, (-cross @ B).ravel()])

    return integrated(slope, np.concatenate([rate, start.ravel()]), times)[:, 3:].reshape(-1, 3, 3)


def integrated(slope, start, times):
    rows = np.empty((len(times), len(start)))
    for side in (times >= 0, times < 0):
        at = times[side] if times[side][-1] >= 0 else times[side][::-1]
        solved = solve_ivp(slope, (0, at[-1]), start, "DOP853", t_eval=at, rtol=1e-12, atol=1e-10).y.T
        rows[side] = solved if times[side][-1] >= 0 else solved[::-1]
    return rows


def centres_inertial(poses, motion):
    in_body = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return np.einsum("nji,nj->ni", motion.inertial_to_body, in_body)


def test_no_change_of_the_parameters_moves_nothing():
    motion = pass_of()
    np.testing.assert_allclose(displaced(motion, SharedParameters()), motion.world_to_camera, atol=1e-9)


def test_the_relative_orbit_changes_as_two_kepler_orbits_do():
    motion = pass_of(tumbling=False)
    position, velocity = np.array([3.0, -8.0, 2.0]), np.array([2e-3, -4e-3, 6e-3])
    moved = centres_inertial(
        displaced(motion, SharedParameters(position_m=position, velocity_m_s=velocity)), motion
    )
    start = np.array([200.0, 0.0, 150.0]), np.array([0.0, -2 * N_RAD_S * 200, 0.1])
    true = two_body(motion.times_s, start[0] + position, start[1] + velocity, motion.inertial_to_rtn)
    # the change grows to 40 m; what the linear solution leaves out is of the order of 400 m * 40 m / 6900 km
    assert np.linalg.norm(true - motion.position_m, axis=1).max() > 15
    np.testing.assert_allclose(moved, true, atol=0.05)


def test_without_an_orbit_the_position_changes_with_a_constant_velocity():
    motion = NominalMotion.of_poses(np.arange(4.0), pass_of(4, tumbling=False).world_to_camera)
    moved = centres_inertial(
        displaced(motion, SharedParameters(position_m=[1, 2, 3], velocity_m_s=[0, 1, -1])), motion
    )
    expected = [[1, 2 + t, 3 - t] for t in motion.times_s]
    np.testing.assert_allclose(moved - motion.position_m, expected, atol=1e-9)


def test_a_tumbling_target_turns_as_eulers_equations_say():
    motion = pass_of()
    change = SharedParameters(
        attitude_rad=[0.02, -0.01, 0.03], rate_rad_s=[2e-5, -1e-5, 3e-5], inertia_ratios=[0.01, -0.02]
    )
    start = Rotation.from_rotvec(change.attitude_rad).as_matrix()
    inertia = INERTIA * [1.01, 0.98, 1.0]
    true = motion.inertial_to_camera @ tumble(
        motion.times_s, RATE + change.rate_rad_s, inertia, start
    ).swapaxes(1, 2)
    poses = displaced(motion, change)
    np.testing.assert_allclose(displaced_motion(motion, change).world_to_camera, poses, atol=1e-9)
    error = Rotation.from_matrix(poses[:, :3, :3] @ true.swapaxes(1, 2)).magnitude()
    before = Rotation.from_matrix(motion.world_to_camera[:, :3, :3] @ true.swapaxes(1, 2)).magnitude()
    assert before.max() > 0.2
    assert error.max() < 1e-5  # the steps' errors over 60 rad


def test_boresight_and_focal_length():
    motion = pass_of(tumbling=False)
    change = SharedParameters(boresight_rad=[0.01, 0.02, -0.03], focal=0.1)
    turn = Rotation.from_rotvec([0.01, 0.02, -0.03]).as_matrix()
    np.testing.assert_allclose(
        displaced(motion, change)[:, :3], turn @ motion.world_to_camera[:, :3], rtol=1e-12, atol=1e-9
    )


def test_a_late_clock_shows_the_target_later():
    """A camera that tracks sees the body turn by rate times offset, and itself at its later place."""
    late_s = 0.05
    motion = pass_of(12, 400.0)
    times = motion.times_s + late_s
    start = np.array([200.0, 0.0, 150.0]), np.array([0.0, -2 * N_RAD_S * 200, 0.1])
    path = two_body(times, *start, motion.inertial_to_rtn)
    later = NominalMotion(times, path, motion.inertial_to_camera, tumble(times, RATE, INERTIA))
    poses = displaced(motion, SharedParameters(clock_s=late_s))
    turned = poses[:, :3, :3] @ later.world_to_camera[:, :3, :3].swapaxes(1, 2)
    sight = np.cross(motion.position_m, path - motion.position_m) / (motion.position_m**2).sum(
        1, keepdims=True
    )
    expected = -np.einsum(
        "nij,nj->ni", motion.inertial_to_camera, sight
    )  # the camera turns with the line of sight
    np.testing.assert_allclose(Rotation.from_matrix(turned).as_rotvec(), expected, atol=2e-6)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    true_centres = np.einsum("nij,nj->ni", later.inertial_to_body, path)
    np.testing.assert_allclose(centres, true_centres, atol=2e-3)  # of 400 m


@settings(max_examples=5, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=19, max_size=19), st.booleans())
def test_the_jacobian_predicts_small_changes(draw, tumbling):
    motion = pass_of(6, 100.0, tumbling)
    scale = np.repeat([1.0, 1e-3, 1e-3, 1e-6, 1e-4, 1e-3, 1e-3, 1e-3], [3, 3, 3, 3, 2, 3, 1, 1])
    at = SharedParameters.of(3 * np.roll(draw, 5) * scale)
    change = np.array(draw) * scale * 0.01
    poses, moved = displaced(motion, at), displaced(motion, at.vector() + change)
    motions = moved @ np.linalg.inv(poses)
    predicted = jacobian(motion, at) @ change
    np.testing.assert_allclose(
        Rotation.from_matrix(motions[:, :3, :3]).as_rotvec(), predicted[:, :3], atol=1e-8
    )
    np.testing.assert_allclose(motions[:, :3, 3], predicted[:, 3:], atol=1e-5)


def test_a_spin_whose_rate_is_not_known_errs_as_one_whose_rate_is_known():
    """A body with equal moments: the changes of both agree to first order, and so does what a late clock shows."""
    rate = np.array([0.003, -0.002, 0.02])
    times = np.sort(np.concatenate([np.arange(0, 600, 60.0), np.arange(0, 600, 60.0) + 0.5]))
    bodies = Rotation.from_rotvec(-rate * times[:, None]).as_matrix()
    cameras = np.broadcast_to(np.eye(3), bodies.shape)
    known = NominalMotion(times, np.tile([0.0, 0, -50], (len(times), 1)), cameras, bodies, rate_rad_s=rate)
    unknown = NominalMotion(times, known.position_m, cameras, bodies)
    change = SharedParameters(attitude_rad=[1e-3, -2e-3, 1e-3], rate_rad_s=[2e-6, 1e-6, -3e-6], clock_s=0.02)
    a, b = displaced(known, change), displaced(unknown, change)
    moved = Rotation.from_matrix(a[:, :3, :3] @ known.world_to_camera[:, :3, :3].swapaxes(1, 2)).magnitude()
    left = Rotation.from_matrix(a[:, :3, :3] @ b[:, :3, :3].swapaxes(1, 2)).magnitude()
    assert moved.min() > 1e-3 and left.max() < 2e-5  # second order in 3e-3


def test_parameters_survive_lists_and_vectors():
    parameters = SharedParameters.of(np.arange(19.0))
    assert SharedParameters(**parameters.lists()).lists() == parameters.lists()
    np.testing.assert_array_equal(parameters.vector(), np.arange(19.0))


@pytest.mark.parametrize("wrong", [{"position_m": [1, 2]}, {"clock_s": float("nan")}])
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match="finite numbers"):
        SharedParameters(**wrong)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="position_m"):
        NominalMotion(np.zeros(2), np.zeros((3, 3)), np.zeros((2, 3, 3)), np.zeros((2, 3, 3)))
