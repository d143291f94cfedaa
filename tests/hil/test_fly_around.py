"""Relative orbits: the linear solution against its differential equation, the chaser's TLE against the solution."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from flightsw.icd.mission import ConfigError, OrbitSection, load_mission
from flightsw.navigation.orbit import propagate
from hil.world.fly_around import FlyAround, RelativeElements, design, linear_motion

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
TARGET, START_NS = MISSION.orbit.target_tle, MISSION.orbit.start_utc_ns
# Half a tick of inclination and of node is 6.1 m each at this orbit's radius: the precision of a TLE
ROUNDING_M = np.hypot(6.1, 6.1)
metres = st.floats(-300, 300)


def flown_rtn_m(chaser: tuple[str, ...], times_s: np.ndarray) -> np.ndarray:
    """Return the chaser's position [N, 3] in the target's RTN frame, by flight's own propagation."""
    places = []
    for t in times_s:
        utc_ns = START_NS + round(t * 1e9)
        target, other = propagate(TARGET, utc_ns), propagate(chaser, utc_ns)
        radial = target.position_m / np.linalg.norm(target.position_m)
        normal = np.cross(target.position_m, target.velocity_m_s)
        normal /= np.linalg.norm(normal)
        places.append(
            np.stack([radial, np.cross(normal, radial), normal]) @ (other.position_m - target.position_m)
        )
    return np.array(places)


@settings(max_examples=15)
@given(da=st.floats(-20, 20), dl=metres, dex=metres, dey=metres, dix=metres, diy=metres)
def test_the_linear_motion_solves_the_clohessy_wiltshire_equations(da, dl, dex, dey, dix, diy):
    elements, n = RelativeElements(da, dl, dex, dey, dix, diy), 0.0011

    def place(t):
        t = np.atleast_1d(t)
        return linear_motion(elements, 0.4 + n * t, t, n)

    def equations(_, s):
        x, _, z, vx, vy, vz = s
        return [vx, vy, vz, 3 * n**2 * x + 2 * n * vy, -2 * n * vx, -(n**2) * z]

    start = np.concatenate([place(0.0)[0], (place(0.5) - place(-0.5))[0]])
    times_s = np.linspace(0, 5700, 12)
    solved = solve_ivp(equations, (0, 5700), start, t_eval=times_s, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(place(times_s), solved.y[:3].T, atol=2e-3)


def test_a_fly_around_is_two_to_one_bounded_and_as_wide_as_asked():
    wanted = FlyAround(radial_m=300.0, out_of_plane_m=400.0)
    made = design(TARGET, wanted, START_NS, span_s=3 * 5692)
    times_s = np.arange(0, 3 * made.period_s, made.period_s / 40)
    radial, along, normal = flown_rtn_m(made.chaser_tle, times_s).T
    assert (np.ptp(along) / np.ptp(radial)) == pytest.approx(2, rel=0.02)
    assert np.ptp(radial) / 2 == pytest.approx(300, rel=0.02)
    assert np.ptp(normal) / 2 == pytest.approx(400, abs=ROUNDING_M)
    first, last = along[:40].mean(), along[-40:].mean()
    assert abs(last - first) < 4  # m in two orbits: the last digit of mean motion alone is 0.03 m an orbit
    assert made.error_max_m < ROUNDING_M + 3
    assert abs(made.drift_error_m_per_orbit) < 2


def test_the_default_width_keeps_the_range_constant():
    made = design(TARGET, FlyAround(radial_m=400.0), START_NS, 5700.0)
    ranges = np.linalg.norm(flown_rtn_m(made.chaser_tle, np.linspace(0, 5690, 30)), axis=1)
    assert np.abs(ranges - 800).max() < 12


@settings(max_examples=10)
@given(
    radial=st.floats(50, 800),
    width=st.floats(0, 800),
    phase=st.floats(0, 360),
    lead=st.floats(0, 360),
)
def test_the_reported_error_is_correct_and_comes_from_rounding(radial, width, phase, lead):
    made = design(TARGET, FlyAround(radial, width, phase, lead), START_NS, 5700.0)
    assert made.error_max_m <= made.unrounded_error_max_m + ROUNDING_M + 1
    # eccentricity 2e-4, J2 1e-3, span of 1.25 orbits
    assert made.unrounded_error_max_m < 0.03 * max(radial, width)
    start = flown_rtn_m(made.chaser_tle, np.array([0.0]))[0]
    asked = [radial * np.cos(np.radians(phase)), width * np.cos(np.radians(phase + lead))]
    assert abs(start[0] - asked[0]) <= made.error_max_m + 0.05
    assert abs(start[2] - asked[1]) <= made.error_max_m + 0.05


def test_holding_a_position_on_the_track_and_drifting_along_it_are_accurate_to_decimetres():
    hold = design(TARGET, RelativeElements(dlambda_m=-60), START_NS, 5692.0)
    assert hold.error_max_m < 1.0  # half a tick of eccentricity is 0.3 m, along the track 0.7 m
    drift = design(TARGET, RelativeElements(da_m=-10, dlambda_m=-120), START_NS, 5692.0)
    along = flown_rtn_m(drift.chaser_tle, np.array([0.0, drift.period_s]))[:, 1]
    assert along[1] - along[0] == pytest.approx(3 * np.pi * 10, abs=2)


def test_the_chasers_tle_passes_the_missions_own_checks():
    made = design(TARGET, FlyAround(123.4), START_NS, 5700.0)
    orbit = OrbitSection(TARGET, made.chaser_tle, MISSION.orbit.start_utc)
    assert orbit.chaser_tle[0][2:7] != TARGET[0][2:7]


def test_a_fly_around_needs_a_size():
    with pytest.raises(ConfigError, match="radial_m"):
        FlyAround(0.0)


def test_the_command_prints_numbers_with_units_and_the_tle_as_it_is(tmp_path):
    out = tmp_path / "chaser.tle"
    command = [str(Path(sys.executable).with_name("hil")), "scenario", "--fly-around", "200"]
    root = Path(__file__).parents[2]
    printed = subprocess.run(
        [*command, "--out", str(out)], cwd=root, capture_output=True, text=True, check=True
    )
    lines = printed.stdout.splitlines()
    tle = out.read_text().splitlines()
    assert all(line in lines for line in tle)
    rest = [line for line in lines if line not in tle and str(out) not in line]
    assert not any(sign in line for line in rest for sign in "()[]{}'_")
    assert all(len(number) <= 8 for line in rest for number in re.findall(r"[\d.]+", line))
    table = {line[:24].strip(): line[24:].strip() for line in rest}
    assert table["half width"] == "346.41 m" and table["dlambda"] == "0 m"
    for name, unit in (("period", "s"), ("error rms", "m"), ("dex", "m"), ("drift error", "m per orbit")):
        number, _, shown = table[name].partition(" ")
        assert float(number) != 0 and shown == unit
    described = subprocess.run([*command[:2], "v-bar"], cwd=root, capture_output=True, text=True, check=True)
    assert re.search(r"^range +[\d.]+ to [\d.]+ m$", described.stdout, re.MULTILINE)
