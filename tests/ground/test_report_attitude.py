"""What the report shows of a rotation that was found: its axis on the model, as the motion itself has it."""

import numpy as np
from scipy.spatial.transform import Rotation

from ground.show.report.attitude import axis_figure, rotation_rows
from obbgs_core.attitude.motion import of_principal, principal
from obbgs_core.attitude.target_motion import TargetMotion
from tests import scenes

TIMES_S = np.linspace(-600.0, 600.0, 61)
PARAMETERS = of_principal(
    np.array([0.002, 0.02, 0.003]), np.array([0.4, 0.8, 1.0]), Rotation.from_rotvec([1, 2, 0.5]).as_matrix()
)
TUMBLE = TargetMotion(PARAMETERS, np.diag([1e-10] * 3 + [1e-4] * 5), principal(PARAMETERS).axes.T, 0.02, 90)
SPIN = TargetMotion(np.array([0.0, 0.0, 0.02]), np.diag([1e-8] * 3), np.eye(3), 0.02, 90)


def traces(motion: TargetMotion) -> dict[str, np.ndarray]:
    figure = axis_figure(scenes.target(seed=0), motion, TIMES_S)
    return {trace.name: np.stack([trace.x, trace.y, trace.z], axis=1) for trace in figure.data}


def test_the_axis_does_not_move_when_the_body_turns_about_it():
    """In body axes the point on the drawn axis keeps its inertial place for a moment, other points do not."""
    drawn = traces(TUMBLE)
    tip = drawn["axis of rotation"][1]
    before, after = TUMBLE.inertial_to_body(np.array([-0.5, 0.5]))
    assert np.linalg.norm(after.T @ tip - before.T @ tip) < 1e-3 * np.linalg.norm(tip)
    other = np.cross(tip, [1.0, 0, 0])
    assert np.linalg.norm(after.T @ other - before.T @ other) > 1e-2 * np.linalg.norm(other)
    assert np.linalg.norm(drawn["model"], axis=1).max() < np.linalg.norm(tip)


def test_the_path_of_a_tumbles_axis_keeps_energy_and_momentum():
    path = traces(TUMBLE)["path of the axis"]
    length = np.linalg.norm(path, axis=1)
    np.testing.assert_allclose(length, length[0], rtol=1e-3)  # drawn at one distance, coordinates rounded
    # directions of the rate lie on the polhode: the ratio L² / 2T, which has no scale, is the same all along
    ratio = (path**2 @ TUMBLE.moments**2) / (path**2 @ TUMBLE.moments)
    np.testing.assert_allclose(ratio, ratio[0], rtol=2e-3)
    assert "path of the axis" not in traces(SPIN)


def test_the_cone_has_two_deviations():
    drawn = traces(SPIN)
    axis, cone = drawn["axis of rotation"][1], drawn["two deviations"]
    rim = cone[np.linalg.norm(cone, axis=1) > 0.5 * np.linalg.norm(axis)]
    angles = np.arccos(rim @ axis / np.linalg.norm(rim, axis=1) / np.linalg.norm(axis))
    expected = 2 * np.hypot(1e-4, 1e-4) / 0.02  # two components of the rate lie across the axis
    np.testing.assert_allclose(angles, expected, rtol=0.02)


def test_the_rows_tell_both_estimates():
    rows = dict(rotation_rows(TUMBLE, SPIN))
    assert rows["motion"] == "torque-free tumble"
    assert rows["moment of inertia about x over that about z"].startswith("0.4000 ±")
    assert rows["rate from outlines alone"].startswith("1.1459 ±")
    assert "rate from outlines alone" not in dict(rotation_rows(SPIN, None))
    assert dict(rotation_rows(SPIN, None))["one turn"] == "314.2 ± 1.6 s"  # 2 pi / 0.02, half a per cent
