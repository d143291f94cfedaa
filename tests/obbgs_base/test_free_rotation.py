"""The rotation of a free body, against SciPy's integrator and what no motion changes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from obbgs_base.physics.free_rotation import free_rotation

moments = st.floats(0.4, 2.0)
speeds = st.floats(-0.05, 0.05)


def integrated(times_s: np.ndarray, rate: np.ndarray, inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return attitudes [N, 3, 3] and rates [N, 3] of a body after times of at least 0, by SciPy."""

    def slopes(_: float, state: np.ndarray) -> np.ndarray:
        w, to_body = state[:3], state[3:].reshape(3, 3)
        faster = np.cross(inertia * w, w) / inertia
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
