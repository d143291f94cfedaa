"""The rotation of a free body, against SciPy's integrator and what no motion changes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from obbgs_base.physics.free_rotation import free_rotation, rotations, stepped_rotation
from obbgs_base.physics.rotation_fit import fitted_rotation

moments = st.floats(0.4, 2.0)
speeds = st.floats(-0.05, 0.05)


def integrated(
    times_s: np.ndarray, rate: np.ndarray, inertia: np.ndarray, torque: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return attitudes [N, 3, 3] and rates [N, 3] of a body after times of at least 0, by SciPy.

    Args:
        torque: [3] body axes, in the unit of the inertia over s².
    """

    def slopes(_: float, state: np.ndarray) -> np.ndarray:
        w, to_body = state[:3], state[3:].reshape(3, 3)
        faster = (np.cross(inertia * w, w) + torque) / inertia
        return np.concatenate([faster, -np.cross(w, to_body, axisb=0, axisc=0).ravel()])

    start = np.concatenate([rate, np.eye(3).ravel()])
    found = solve_ivp(slopes, (0, times_s[-1]), start, "DOP853", t_eval=times_s, rtol=1e-11, atol=1e-11).y.T
    return found[:, 3:].reshape(-1, 3, 3), found[:, :3]


@settings(max_examples=12, deadline=None)
@given(st.tuples(moments, moments, moments), st.tuples(speeds, speeds, speeds), st.booleans())
def test_many_periods_are_as_scipy_integrates_them(inertia, rate, round_about_an_axis):
    inertia = np.array([inertia[0], inertia[0] if round_about_an_axis else inertia[1], inertia[2]])
    rate, times_s = np.array(rate), np.array([0.0, 3.0, 700.0, 1500.0])
    turned, rates = free_rotation(times_s, rate[None], inertia[None])
    expected, expected_rates = integrated(times_s, rate, inertia)
    # errors of the start grow exponentially near the axis of the middle moment
    np.testing.assert_allclose(turned[0], expected, atol=1e-6)
    np.testing.assert_allclose(rates[0], expected_rates, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.tuples(moments, moments, moments), st.tuples(speeds, speeds, speeds))
def test_what_turned_for_a_time_turns_back_and_keeps_its_angular_momentum(inertia, rate):
    inertia, rate = np.array([inertia]), np.array([rate])
    turned, rates = free_rotation(np.array([2e3, -2e3]), rate, inertia)
    momentum = np.einsum("nji,nj->ni", turned[0], inertia * rates[0])  # in the axes of the start
    scale = np.linalg.norm(inertia * rate) + 1e-12
    np.testing.assert_allclose(momentum / scale, np.tile(inertia * rate, (2, 1)) / scale, atol=1e-5)
    back, _ = free_rotation(np.array([-2e3]), rates[:, 0], inertia)
    np.testing.assert_allclose(back[0, 0] @ turned[0, 0], np.eye(3), atol=1e-3)


def test_bodies_of_one_call_do_not_touch_each_other_and_times_come_in_any_order():
    rates = np.array([[0.03, -0.02, 0.01], [0.0, 0.0, 0.05], [1e-3, 2e-3, 1e-3]])
    inertia = np.array([[1.0, 0.8, 0.5], [1.0, 0.8, 0.5], [0.7, 0.7, 1.0]])
    times_s = np.array([900.0, -200.0, 0.0, 4000.0])
    together = free_rotation(times_s, rates, inertia)
    for i in range(3):
        for at, time_s in enumerate(times_s):
            alone = free_rotation(np.array([time_s]), rates[i : i + 1], inertia[i : i + 1])
            np.testing.assert_allclose(together[0][i, at], alone[0][0, 0], atol=2e-6)
            np.testing.assert_allclose(together[1][i, at], alone[1][0, 0], atol=1e-7)


def test_a_moment_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="positive moments"):
        free_rotation(np.array([1.0]), np.array([[0.1, 0, 0]]), np.array([[1.0, -1, 1]]))


# a pass: frames 54 s apart, every eighth bracket of three is missing; as far as this body turns the gap is over a turn
PASS_S = np.array([54.0 * i for i in range(72) if i // 3 % 8 != 7])
ATTITUDE_AT_EPOCH = rotations(np.array([0.4, -2.0, 1.1]))


def attitudes(rate: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    return integrated(PASS_S, rate, inertia)[0] @ ATTITUDE_AT_EPOCH


@pytest.mark.parametrize(
    ("rate_deg_s", "inertia"),
    [
        ((0.0, 0.0, 1.2), (1.0, 1.0, 1.0)),
        ((0.8, 0.1, 0.9), (0.45, 0.82, 1.0)),
        ((0.2, 1.1, 0.3), (1.0, 0.7, 1.0)),
    ],
)
def test_attitudes_tell_rate_and_inertia_through_gaps_of_more_than_a_turn_and_noise(rate_deg_s, inertia):
    rate, rng = np.radians(rate_deg_s), np.random.default_rng(3)
    noisy = rotations(rng.normal(0, np.radians(0.02), (len(PASS_S), 3))) @ attitudes(rate, np.array(inertia))
    order = rng.permutation(len(PASS_S))
    found = fitted_rotation(PASS_S[order], noisy[order], 1e-3)
    assert found is not None
    np.testing.assert_allclose(found[0], rate, atol=1e-5)
    turned, _ = free_rotation(PASS_S, found[0][None], found[1][None])
    apart = turned[0] @ ATTITUDE_AT_EPOCH @ attitudes(rate, np.array(inertia)).swapaxes(1, 2)
    assert np.linalg.norm(apart - np.eye(3), axis=(1, 2)).max() < 2e-3


def test_attitudes_of_no_free_rotation_and_too_few_tell_nothing():
    rate, inertia = np.radians([0.3, 0.2, 0.9]), np.array([0.5, 0.8, 1.0])
    free = attitudes(rate, inertia)
    assert fitted_rotation(PASS_S[:5], free[:5], 1e-3) is None
    erring = rotations(np.random.default_rng(4).normal(0, 0.01, (len(PASS_S), 3))) @ free
    assert fitted_rotation(PASS_S, erring, 1e-3) is None
    strong = integrated(PASS_S, rate, inertia, (1e-5, 0.0, 0.0))[0]  # 1.1 rad in five frames
    assert fitted_rotation(PASS_S, strong, 1e-3) is None
    at_rest = np.broadcast_to(ATTITUDE_AT_EPOCH, free.shape)
    found = fitted_rotation(PASS_S, at_rest, 1e-3)
    assert found is not None and np.abs(found[0]).max() < 1e-9


@pytest.mark.parametrize("inertia", [(0.385, 0.77, 1.0), (1.0, 1.0, 1.0)])
@pytest.mark.parametrize("tight", [False, True])
def test_where_torques_act_an_error_of_the_rate_grows_as_in_a_body_that_turns_like_this_one(inertia, tight):
    """By SciPy, which integrates the torque; brackets of one time each count as one attitude."""
    times_s = (
        32.5 * np.arange(121) if not tight else (32.5 * np.arange(121)[:, None] + [0.0, 0.2, 0.4]).ravel()
    )
    rate, error, torque = np.radians([0.05, 1.2, 0.05]), np.array([1e-6, 4e-5, -1e-6]), (0, 2e-7, 8e-8)
    nominal, rates = integrated(times_s, rate, np.array(inertia), torque)
    true, _ = integrated(times_s, rate + error, np.array(inertia), torque)
    found = fitted_rotation(times_s, nominal, 2e-3)
    assert found is not None and len(found[2]) > 10

    def farthest_deg(steps: np.ndarray) -> float:
        both = np.stack([found[0] + error, found[0]])
        turned, _ = stepped_rotation(times_s, both, np.tile(found[1], (2, 1)), steps)
        predicted = turned[0] @ turned[1].swapaxes(1, 2) @ nominal
        return float(np.degrees(np.linalg.norm(predicted - true, axis=(1, 2)).max() / np.sqrt(2)))

    assert farthest_deg(found[2]) < 0.3
    if len(set(inertia)) > 1:
        assert farthest_deg(found[2][:0]) > 2.0
    _, followed = stepped_rotation(times_s, found[0][None], found[1][None], found[2])
    np.testing.assert_allclose(followed[0], rates, atol=3e-4)
