"""The mission file: what is wrong is named by its path."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from sgp4.io import compute_checksum

from flightsw.icd.config import ConfigError, build
from flightsw.icd.mission import Mission, load_mission
from flightsw.icd.tle import orbit_axes, tle_checksum
from flightsw.navigation.orbit import propagate

TEXT = (Path(__file__).parents[2] / "mission.yaml").read_text()
TREE = yaml.safe_load(TEXT)


def load(tmp_path: Path, text: str) -> Mission:
    path = tmp_path / "mission.yaml"
    path.write_text(text)
    return load_mission(path)


def test_the_shipped_mission_loads(tmp_path):
    mission = load(tmp_path, TEXT)
    assert mission.camera.white_dn == 4095
    assert mission.bracket.exposure_times_s == pytest.approx((5e-5, 1e-4, 2e-4))
    assert mission.orbit.start_utc_ns == 1_784_631_150_000_000_000  # 2026-07-21T10:52:30Z
    assert len(mission.sha256) == 64


@pytest.mark.parametrize(
    ("old", "new", "path"),
    [
        ("width: 256", "width: two", r"mission\.camera\.width: expected a whole number, got 'two'"),
        ("width: 256", "width: 0", r"mission\.camera\.width: expected 1 to 8192"),
        ("read_noise_dn: 8.0", "read_noise_dn: 8e-1x", r"mission\.camera\.read_noise_dn: expected a number"),
        ("black_dn: 64.0", "black_dn: .nan", r"mission\.camera\.black_dn: expected a number"),
        (
            "[0.05, 0.1, 0.2]",
            "[0.05, two]",
            r"mission\.bracket\.exposure_times_ms\[1\]: expected a number, got 'two'",
        ),
        ("[0.05, 0.1, 0.2]", "[]", r"mission\.bracket\.exposure_times_ms: expected 1 to 16"),
        (
            "interval_s: 27.0",
            "interval_s: 1.0\n  frame_spacing_s: 0.5",
            r"mission\.bracket\.interval_s: 1\.0 s is shorter",
        ),
        (
            "interval_s: 27.0",
            "interval_s: 0.0003",
            r"mission\.bracket\.interval_s: 0\.0003 s is shorter than the bracket itself \(0\.0006 s\)",
        ),
        ("mode: spin", "mode: wobble", r"mission\.target_attitude\.mode: expected one of inertial, spin"),
        ("axis: sun", "axis: [1.0, 1.0, 0.0]", r"mission\.target_attitude\.axis: expected a unit vector"),
        ("baud_rate", "bawd_rate", r"mission\.link\.bawd_rate: unknown key; expected one of baud_rate"),
        ("  width: 256", "", r"mission\.camera\.width: is missing"),
        ("12714-4 0  9997", "12714-4 0  9998", r"target_tle\[0\]: checksum is 8, but the line adds up to 7"),
        ("2 31698", "2 31699", r"mission\.orbit\.target_tle"),
        ("10:52:30Z", "10:52:30", r"mission\.orbit\.start_utc: say the time zone"),
        ("10:52:30Z", "25:52:30Z", r"mission\.orbit\.start_utc: expected a time such as"),
        (
            "mode: spin",
            "knowledge: some",
            r"target_attitude\.knowledge: expected one of known, rate_only, unknown",
        ),
        (
            "pose:",
            "pose:\n  correlation_time_s: -1",
            r"mission\.pose\.correlation_time_s: must not be negative",
        ),
        (
            "pose:",
            "navigation_errors: {clock_ms: 1}\npose:",
            r"navigation_errors\.clock_ms: unknown key.*clock_s",
        ),
        (
            "pose:",
            "navigation_errors: {position_m: [1, 2]}\npose:",
            r"position_m: expected 1 or 3 numbers, got 2",
        ),
        (
            "pose:",
            "navigation_errors: {inertia_ratios: []}\npose:",
            r"inertia_ratios: expected 1 or 2 numbers, got 0",
        ),
        (
            "pose:",
            "navigation_errors: {rate_deg_s: [0, -1, 0]}\npose:",
            r"rate_deg_s: must not be negative, got -1",
        ),
        (
            "pose:",
            "navigation_errors: {focal: two}\npose:",
            r"navigation_errors\.focal: expected a number, got 'two'",
        ),
        (
            "pose:",
            "navigation_errors: {focal: 2}\npose:",
            r"navigation_errors\.focal: expected 0 to 0\.5, a share of the focal length: write 1 % as 0\.01, got 2$",
        ),
        (
            "pose:",
            "store: {quota_mb: 0.0001}\npose:",
            r"mission\.store\.quota_mb: expected room for a frame .*, 0\.131072 MB uncompressed, or 0 .*, got 0\.0001$",
        ),
    ],
)
def test_a_wrong_value_is_named_by_its_path(tmp_path, old, new, path):
    assert old in TEXT
    with pytest.raises(ConfigError, match=path):
        load(tmp_path, TEXT.replace(old, new))


def test_the_shortest_interval_that_a_message_states_is_taken(tmp_path):
    """The sum of three times of 0.2 ms is 0.6000000000000001 ms."""
    assert load(tmp_path, TEXT.replace("interval_s: 27.0", "interval_s: 0.0006")).bracket.interval_s == 6e-4
    with pytest.raises(ConfigError, match="is shorter"):
        load(tmp_path, TEXT.replace("interval_s: 27.0", "interval_s: 0.000599999"))


def test_sigmas_of_shared_errors_are_in_radians_one_an_axis(tmp_path):
    assert not load(tmp_path, TEXT).navigation_errors.sigmas.vector().any()  # missions without the section
    section = "navigation_errors: {position_m: [1, 8, 2], boresight_deg: 0.1, inertia_ratios: [0.1, 0.2], clock_s: 0.5}"
    sigmas = load(tmp_path, f"{TEXT}\n{section}\n").navigation_errors.sigmas
    assert sigmas.position_m.tolist() == [1, 8, 2]
    assert sigmas.boresight_rad.tolist() == pytest.approx([0.1 * math.pi / 180] * 3)
    assert sigmas.inertia_ratios.tolist() == [0.1, 0.2] and sigmas.clock_s.tolist() == [0.5]


def test_the_orbit_s_axes_are_those_of_its_states():
    utc_ns = 1_784_631_150_000_000_000
    rate_rad_s, axes = orbit_axes(tuple(TREE["orbit"]["target_tle"]), utc_ns)
    assert 2 * math.pi / rate_rad_s == pytest.approx(
        86_400 / 15.19, rel=1e-3
    )  # revolutions a day in the elements
    state = propagate(tuple(TREE["orbit"]["target_tle"]), utc_ns)
    along = state.velocity_m_s / np.linalg.norm(state.velocity_m_s)
    np.testing.assert_allclose(
        axes @ state.position_m / np.linalg.norm(state.position_m), [1, 0, 0], atol=7e-3
    )
    np.testing.assert_allclose(axes @ along, [0, 1, 0], atol=7e-3)  # 0.4 degrees of precession
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("text", ["", "- a list", "orbit: [", "\x00", "orbit: 3"])
def test_what_is_no_mission_is_refused(tmp_path, text):
    with pytest.raises(ConfigError):
        load(tmp_path, text)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the mission file"):
        load_mission(tmp_path / "nowhere.yaml")


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*TREE, "x"]), inner, max_size=4)
        ),
    )
)
def test_any_tree_gives_a_mission_or_a_config_error(tree):
    try:
        assert isinstance(build(Mission, tree, "mission"), Mission)
    except ConfigError as error:
        assert error.path.startswith("mission")


def test_checksum_matches_sgp4s_own():
    for line in (*TREE["orbit"]["target_tle"], *TREE["orbit"]["chaser_tle"]):
        assert tle_checksum(line) == compute_checksum(line) == int(line[68])
