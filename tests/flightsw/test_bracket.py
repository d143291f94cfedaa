"""Automatic brackets against simulated frames: the shortest is not burnt out, the longest shows the shadows."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightsw.capture.bracket import (
    HEADROOM,
    SHADOW_SHARE,
    SHADOW_SNR,
    AutoBracket,
    Geometry,
    TargetLight,
    bracket_times_s,
    expected_light,
    highlight_signal_dn,
    measured_light,
)
from flightsw.capture.region import target_pixels
from flightsw.icd.mission import BracketSection, CameraSection, load_mission
from flightsw.navigation.pose import pose_tag
from hil.sky.sensor import expose

GOLDEN = Path(__file__).parents[1] / "golden"
MISSION = load_mission(GOLDEN / "mission.yaml")
BRACKET = dataclasses.replace(MISSION.bracket, auto=True, exposure_max_ms=20.0)
SUNLIT = Geometry(300.0, 1.0)

cameras = st.builds(
    lambda depth, black, gain, electrons, noise: dataclasses.replace(
        MISSION.camera,
        bit_depth=depth,
        black_dn=black * 2.0**depth,
        dn_per_radiance_s=gain,
        electrons_per_dn=electrons,
        read_noise_dn=noise * 2.0**depth,
    ),
    st.integers(8, 16),
    st.floats(0.0, 0.1),
    st.floats(1e5, 1e9),
    st.floats(0.05, 50.0),
    st.floats(0.0, 0.01),
)
lights = st.builds(
    lambda highlight, ratio: TargetLight(highlight, highlight * ratio),
    st.floats(1e-4, 10),
    st.floats(1e-4, 1),
)


def noise_dn(signal_dn: float, camera: CameraSection) -> float:
    """The datasheet's noise: shot, read, rounding to whole numbers."""
    return float(np.sqrt(signal_dn / camera.electrons_per_dn + camera.read_noise_dn**2 + 1 / 12))


@given(lights, cameras)
def test_the_shortest_frame_is_unsaturated_and_the_longest_lifts_the_shadows_unless_a_limit_forbids(
    light, camera
):
    bracket = BRACKET
    times_s = bracket_times_s(light, camera, bracket)
    assert len(times_s) == 3 and list(times_s) == sorted(times_s)
    low_s, high_s = bracket.exposure_min_ms / 1e3, bracket.exposure_max_ms / 1e3
    assert times_s[0] >= low_s and times_s[-1] <= high_s
    if times_s[0] > low_s:
        signal_dn = camera.dn_per_radiance_s * times_s[0] * light.highlight
        reach_dn = camera.black_dn + signal_dn + 4 * noise_dn(signal_dn, camera)
        assert reach_dn < camera.white_dn * (1 + 1e-3) or signal_dn <= 1.0 + 1e-9
    if times_s[-1] < high_s:
        signal_dn = camera.dn_per_radiance_s * times_s[-1] * light.shadow
        assert signal_dn >= SHADOW_SNR * noise_dn(signal_dn, camera) * 0.99


@given(lights, st.floats(0.1, 10))
def test_twice_the_light_takes_half_the_time(light, factor):
    free = dataclasses.replace(BRACKET, exposure_min_ms=1e-3, exposure_max_ms=500.0)
    limits_s = (free.exposure_min_ms / 1e3, free.exposure_max_ms / 1e3)
    before = bracket_times_s(light, MISSION.camera, free)
    after = bracket_times_s(light.scaled(factor), MISSION.camera, free)
    for a, b in zip(before, after, strict=True):
        if a not in limits_s and b not in limits_s:
            assert a / b == pytest.approx(factor)


@given(st.floats(1, 1e6), st.floats(0, np.pi * 0.98), st.floats(0.1, 100))
def test_the_expected_light_is_positive_and_fades_with_phase_and_with_distance_below_a_pixel(
    range_m, phase_rad, extent_m
):
    here = expected_light(Geometry(range_m, phase_rad), MISSION.camera, extent_m)
    assert 0 < here.shadow <= here.highlight <= 1
    farther = expected_light(Geometry(2 * range_m, phase_rad), MISSION.camera, extent_m)
    assert 0.25 * here.highlight * 0.999 <= farther.highlight <= here.highlight
    assert (
        expected_light(Geometry(range_m, np.pi * 0.98), MISSION.camera, extent_m).highlight <= here.highlight
    )


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 2.0), st.floats(20, 400))
@settings(max_examples=20)
def test_the_light_is_measured_from_frames_of_a_known_sky(seed, highlight, contrast):
    rng = np.random.default_rng(seed)
    radiance = np.zeros((72, 72, 1))
    inside = np.exp(rng.uniform(np.log(highlight / contrast), np.log(highlight), (30, 30, 1)))
    radiance[20:50, 15:45] = inside
    truth = np.quantile(inside, [SHADOW_SHARE, 0.999])
    times_s = bracket_times_s(TargetLight(truth[1], truth[0]), MISSION.camera, BRACKET)
    frames = [(expose(radiance, t, MISSION.camera, rng)[..., 0], t) for t in times_s]
    light = measured_light(frames, MISSION.camera, TargetLight(1.0, 0.01))
    assert light.highlight == pytest.approx(
        truth[1], rel=0.08
    )  # noise of the brightest pixels: 2 % of 2800 DN
    assert light.shadow == pytest.approx(truth[0], rel=0.6)  # a signal of three times the noise


def test_hot_pixels_and_sky_are_no_target():
    rng = np.random.default_rng(1)
    dn = np.clip(64 + rng.normal(0, 8, (72, 72)), 0, None).round()
    for y, x in rng.integers(0, 72, (12, 2)):
        dn[y, x] = 4095
    dn[30:40, 30:40] += 60
    target = target_pixels(dn.astype(np.uint16), MISSION.camera)
    assert target[31:39, 31:39].mean() > 0.95
    target[29:41, 29:41] = False
    assert target.sum() <= 3


def test_a_burnt_out_bracket_is_followed_by_a_quarter_of_its_exposure_and_an_empty_one_by_more():
    auto = AutoBracket(MISSION.camera, BRACKET)
    first = auto.times_s(SUNLIT)
    burnt = np.full((72, 72), 4095, np.uint16)
    auto.observe([(burnt, t) for t in first], SUNLIT)
    after_burnt = auto.times_s(SUNLIT)
    assert after_burnt[0] == pytest.approx(first[0] * HEADROOM / 4, rel=0.01)
    empty = np.full((72, 72), 64, np.uint16)
    longest = [after_burnt[-1]]
    for _ in range(8):
        auto.observe([(empty, t) for t in auto.times_s(SUNLIT)], SUNLIT)
        longest.append(auto.times_s(SUNLIT)[-1])
    assert longest == sorted(longest) and longest[-1] == BRACKET.exposure_max_ms / 1e3


def test_without_light_or_pose_the_missions_own_times_are_used():
    auto = AutoBracket(MISSION.camera, BRACKET)
    assert auto.times_s(None) == tuple(sorted(BRACKET.exposure_times_s))
    tag = pose_tag(MISSION, MISSION.orbit.start_utc_ns)
    assert Geometry.of(dataclasses.replace(tag, in_eclipse=True)) is None
    geometry = Geometry.of(tag)
    assert geometry is not None and 300 < geometry.range_m < 500


def golden_scenes() -> list[tuple[np.ndarray, np.ndarray, Geometry]]:
    """Radiance, target mask and geometry of each bracket of the golden pass: Blender's picture of a real target."""
    scenes = []
    for line in (GOLDEN / "session" / "frames.jsonl").read_text().splitlines()[::3]:
        record = json.loads(line)
        with np.load(GOLDEN / "session" / "truth" / "radiance" / f"{record['id']:06d}.npz") as truth:
            radiance, mask = truth["radiance"].astype(np.float64), truth["alpha"].squeeze() > 0.99
        geometry = Geometry.of(pose_tag(MISSION, record["mid_exposure_utc_ns"]))
        assert geometry is not None
        scenes.append((radiance[..., :1], mask, geometry))
    return scenes


@pytest.mark.parametrize("brightness", [0.02, 0.2, 1.0, 5.0])
def test_brackets_follow_a_rendered_target_through_a_pass(brightness):
    """Oracle: the simulator's sensor and true radiance and mask, of which the planner sees only noisy frames.

    At other brightnesses than 1 the first guess is wrong and two brackets are given to find the target's.
    """
    rng = np.random.default_rng(5)
    camera = MISSION.camera
    auto = AutoBracket(camera, BRACKET)
    unsaturated, shadow_snr = [], []
    for radiance, mask, geometry in golden_scenes():
        times_s = auto.times_s(geometry)
        frames = [(expose(radiance * brightness, t, camera, rng)[..., 0], t) for t in times_s]
        unsaturated.append(min(float((dn[mask] >= camera.white_dn).mean()) for dn, _ in frames) <= 1e-3)
        shadow_dn = (
            np.quantile(radiance[mask], SHADOW_SHARE) * brightness * camera.dn_per_radiance_s * times_s[-1]
        )
        shadow_snr.append(shadow_dn / noise_dn(float(shadow_dn), camera))
        auto.observe(frames, geometry)
    settled = slice(0 if brightness == 1.0 else 2, None)
    assert all(unsaturated[settled])
    assert min(shadow_snr[settled]) > 2.0, shadow_snr  # of single pixels, though the target turns in between
    assert np.median(shadow_snr[settled]) > SHADOW_SNR, shadow_snr


def test_a_bracket_that_saturates_at_the_shortest_time_allowed_stays_there():
    bright = TargetLight(1e6, 1e5)
    assert bracket_times_s(bright, MISSION.camera, BRACKET) == (1e-5, 1e-5, 1e-5)
    assert bracket_times_s(
        bright, MISSION.camera, dataclasses.replace(BRACKET, exposure_times_ms=(1.0,))
    ) == (1e-5,)
    assert highlight_signal_dn(MISSION.camera) == pytest.approx(HEADROOM * (4095 - 64))


def test_lights_that_cannot_be_are_refused():
    for highlight, shadow in ((0.0, 0.0), (1.0, 2.0), (float("nan"), 1.0), (float("inf"), 1.0)):
        with pytest.raises(ValueError, match="shadow <= highlight"):
            TargetLight(highlight, shadow)
    assert isinstance(BRACKET, BracketSection)
