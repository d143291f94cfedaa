"""The capture sequence with a camera that misbehaves, and the region of interest."""

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightsw.cameras.camera import Exposure
from flightsw.capture.sequencer import NS, capture, plan, region_of_interest
from flightsw.errors import CaptureError
from flightsw.icd.frame import decode_frame
from flightsw.icd.mission import load_mission
from flightsw.storage.settings import Settings
from flightsw.storage.store import FrameStore

MISSION = load_mission(Path(__file__).parents[1] / "golden" / "mission.yaml")


class Sky:
    """A camera that shows one bright square and fails on chosen exposures."""

    def __init__(self, failing: tuple[int, ...] = ()):
        self.failing, self.count, self.starts_ns = failing, 0, []

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        self.count += 1
        if self.count - 1 in self.failing:
            raise CaptureError("the shutter stuck")
        self.starts_ns.append(start_utc_ns)
        rng = np.random.default_rng(self.count)
        dn = 64 + rng.normal(0, 8, (MISSION.camera.height, MISSION.camera.width))
        dn[20:40, 25:50] += exposure_time_s * 2e7
        pixels = np.clip(dn.round(), 0, 4095).astype(np.uint16)
        return Exposure(pixels, exposure_time_s, start_utc_ns + round(exposure_time_s * 5e8))

    def close(self) -> None:
        pass


def test_every_exposure_is_planned_at_its_own_time():
    shots = list(plan(MISSION))
    assert len(shots) == 48 and shots[0].start_utc_ns == MISSION.orbit.start_utc_ns
    assert [s.exposure_time_s for s in shots[:3]] == [5e-5, 1e-4, 2e-4]
    assert shots[1].start_utc_ns - shots[0].start_utc_ns == 500_000_000
    assert shots[3].start_utc_ns - shots[0].start_utc_ns == 67_000_000_000
    assert shots[2].mid_exposure_utc_ns - shots[2].start_utc_ns == 100_000


def test_without_a_spacing_exposures_are_spread_evenly_over_the_pass_however_many_are_commanded():
    mission = dataclasses.replace(
        MISSION, bracket=dataclasses.replace(MISSION.bracket, frame_spacing_s=None, interval_s=30.0, count=4)
    )
    starts_s = [(shot.start_utc_ns - mission.orbit.start_utc_ns) / NS for shot in plan(mission)]
    assert starts_s == list(range(0, 120, 10))
    commanded = plan(mission, lambda trigger_ns: (1e-3, 2e-3, 3e-3, 4e-3, 5e-3))
    assert [(shot.start_utc_ns - mission.orbit.start_utc_ns) / NS for shot in commanded] == list(
        range(0, 120, 6)
    )


def test_one_bad_frame_is_counted_and_never_ends_the_pass(tmp_path):
    store = FrameStore(tmp_path)
    counts = capture(MISSION, Sky(failing=(4, 5)), store)
    assert (counts.planned, counts.stored, counts.failed) == (48, 46, 2)
    assert [f.frame_id for f in store.frames] == list(range(46))  # no number is lost to a failed exposure


def test_a_full_store_is_one_line_and_one_with_the_count(tmp_path, caplog):
    room = FrameStore(tmp_path / "room")
    capture(MISSION, Sky(), room)
    quota_bytes = sum(stored.size_bytes for stored in room.frames[:5])
    counts = capture(MISSION, Sky(), FrameStore(tmp_path / "small", quota_bytes))
    assert counts.refused == 48 - counts.stored > 40
    first, rest = (record.getMessage() for record in caplog.records)
    assert (
        first
        == f"frame {counts.stored} refused: the quota of {quota_bytes} bytes is full, and store.when_full is refuse"
    )
    assert rest == f"{counts.refused - 1} more frames refused: the store is full"


def test_a_restart_takes_only_what_is_missing(tmp_path):
    counts = capture(MISSION, Sky(failing=(4, 5)), FrameStore(tmp_path))
    again = capture(MISSION, Sky(), FrameStore(tmp_path))
    assert (again.already_stored, again.stored) == (counts.stored, 2)
    store = FrameStore(tmp_path)
    assert len({(f.bracket_id, f.bracket_index) for f in store.frames}) == 48


def test_stopping_is_prompt(tmp_path):
    store = FrameStore(tmp_path)
    counts = capture(MISSION, Sky(), store, should_stop=lambda: len(store.frames) >= 5)
    assert counts.stored == 5


class Clock:
    """A clock that runs only while something waits, and settings that are commanded at its times."""

    def __init__(self, commanded: dict[float, Settings]):
        self.now_ns = MISSION.orbit.start_utc_ns - 60 * NS
        self._commanded = [
            (MISSION.orbit.start_utc_ns + round(s * NS), value) for s, value in commanded.items()
        ]

    def wait_until(self, utc_ns: int) -> None:
        self.now_ns = max(self.now_ns, utc_ns)

    def settings(self) -> Settings:
        return [value for utc_ns, value in self._commanded if utc_ns <= self.now_ns][-1]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(-59, 230), st.booleans()), max_size=4))
def test_an_exposure_is_taken_unless_safe_mode_holds_when_it_is_due(commanded):
    changes = {-60.0: Settings("oldest")} | {
        at_s: Settings("oldest", safe_mode=safe) for at_s, safe in sorted(commanded)
    }
    mission = dataclasses.replace(MISSION, bracket=dataclasses.replace(MISSION.bracket, count=4))
    clock, camera = Clock(changes), Sky()
    with tempfile.TemporaryDirectory() as folder:
        store = FrameStore(Path(folder))
        counts = capture(mission, camera, store, wait_until=clock.wait_until, settings=clock.settings)
    due_ns = [shot.start_utc_ns for shot in plan(mission)]
    again, expected_ns = Clock(changes), []
    for utc_ns in due_ns:
        again.wait_until(utc_ns)
        if not again.settings().safe_mode:
            expected_ns.append(utc_ns)
    assert camera.starts_ns == expected_ns
    assert (counts.stored, counts.skipped) == (len(expected_ns), len(due_ns) - len(expected_ns))
    assert clock.now_ns == due_ns[-1]  # safe mode does not rush through the pass


@pytest.mark.parametrize("auto", [False, True])
def test_commanded_exposure_times_hold_from_the_next_bracket_on(tmp_path, auto):
    mission = dataclasses.replace(MISSION, bracket=dataclasses.replace(MISSION.bracket, auto=auto))
    commanded = Settings("oldest", exposure_times_ms=(1.0, 2.0))
    clock = Clock({-60.0: Settings("oldest"), MISSION.bracket.interval_s - 1.0: commanded})
    store = FrameStore(tmp_path)
    capture(mission, Sky(), store, wait_until=clock.wait_until, settings=clock.settings)
    times_s = [decode_frame(store.read(stored.frame_id)).exposure_time_s for stored in store.frames]
    assert not {1e-3, 2e-3} & set(times_s[:3])
    assert times_s[3:7] == [1e-3, 2e-3, 1e-3, 2e-3]


def test_failures_that_differ_in_numbers_only_are_one_line_and_a_count(tmp_path, caplog):
    class Late(Sky):
        def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
            self.count += 1
            raise CaptureError(f"the exposure was due {700 + 27.5 * self.count:.1f} s ago")

    counts = capture(MISSION, Late(), FrameStore(tmp_path))
    assert counts.failed == 48
    first, rest = (record.getMessage() for record in caplog.records)
    assert first.startswith("bracket 0 frame 0 lost: the exposure was due")
    assert rest.startswith("47 more exposures lost for the same reason")


def test_the_stored_frame_holds_time_tag_and_pixels(tmp_path):
    store = FrameStore(tmp_path)
    mission = dataclasses.replace(MISSION, bracket=dataclasses.replace(MISSION.bracket, count=1))
    capture(mission, Sky(), store)
    frame = decode_frame(store.read(2))
    sky = Sky()
    for _ in range(2):
        sky.expose(1e-4, 0)
    taken = sky.expose(2e-4, 0).dn
    mask = region_of_interest(taken, mission)
    assert frame.mid_exposure_utc_ns == MISSION.orbit.start_utc_ns + 10**9 + 100_000
    assert (frame.bracket_index, frame.bracket_count, frame.exposure_time_s) == (2, 3, 2e-4)
    np.testing.assert_array_equal(frame.dn[mask], taken[mask])  # lossless inside
    assert (frame.dn[~mask] == 64).all()


def test_region_of_interest_keeps_the_target_with_its_margin_and_drops_the_sky():
    dn = Sky().expose(1e-4, 0).dn
    mask = region_of_interest(dn, MISSION)
    margin = MISSION.link.roi_margin_px
    assert mask[20 - margin : 40 + margin, 25 - margin : 50 + margin].all()
    assert not mask[:5].any() and not mask[-5:].any()


def test_a_restart_goes_on_with_the_exposure_times_that_the_last_bracket_showed(tmp_path):
    """A target far brighter than the mission file expects: the second bracket is darker, also after a restart."""

    class Bright(Sky):
        def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
            exposure = super().expose(exposure_time_s, start_utc_ns)
            dn = np.clip(64 + (exposure.dn.astype(float) - 64) * 50, 0, 4095).round().astype(np.uint16)
            return dataclasses.replace(exposure, dn=dn)

    bracket = dataclasses.replace(MISSION.bracket, auto=True, count=2)
    mission = dataclasses.replace(MISSION, bracket=bracket)

    def times_s(store):
        return [decode_frame(store.read(stored.frame_id)).exposure_time_s for stored in store.frames]

    through = FrameStore(tmp_path / "through")
    capture(mission, Bright(), through)
    first = dataclasses.replace(mission, bracket=dataclasses.replace(bracket, count=1))
    capture(first, Bright(), FrameStore(tmp_path / "again"))
    again = FrameStore(tmp_path / "again")
    capture(mission, Bright(), again)
    assert times_s(again) == times_s(through)
    assert min(times_s(through)[3:]) < min(times_s(through)[:3])
    again.path(2).write_bytes(b"damaged")  # a frame that cannot be read is not asked what it showed
    again.path(5).write_bytes(b"damaged")
    later = dataclasses.replace(mission, bracket=dataclasses.replace(bracket, count=3))
    assert capture(later, Bright(), again).stored == 3


def test_a_camera_of_another_size_gives_no_frame_and_says_both_sizes(tmp_path, caplog):
    class Smaller(Sky):
        def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
            exposure = super().expose(exposure_time_s, start_utc_ns)
            return dataclasses.replace(exposure, dn=exposure.dn[:-1])

    store = FrameStore(tmp_path)
    counts = capture(MISSION, Smaller(), store)
    camera = MISSION.camera
    assert counts.failed == 48 and not store.frames
    assert (
        f"({camera.height}, {camera.width}) pixels, this one ({camera.height - 1}, {camera.width})"
        in caplog.text
    )


@pytest.mark.parametrize("later_ms", [(1.0, 2.0, 4.0, 8.0), (1.0,)])
def test_exposures_commanded_after_a_bracket_are_not_missing_from_it(tmp_path, later_ms):
    """A restart of a pass that is whole, and of one whose second bracket lacks a frame and whose third all of them."""
    store, commanded = FrameStore(tmp_path / "whole"), Settings("oldest", exposure_times_ms=later_ms)
    capture(MISSION, Sky(), store)
    for bracket_id in (0, 1):  # one bracket was deleted, of another one frame
        store.drop(bracket_id * 4)
    for frame_id in (1, 2):
        store.drop(frame_id)
    again = capture(MISSION, Sky(failing=tuple(range(99))), store, settings=lambda: commanded)
    assert (again.planned, again.already_stored, again.failed) == (48, 48, 0)
    store = FrameStore(tmp_path / "lacking")
    capture(MISSION, Sky(failing=(4, 6, 7, 8)), store)
    camera = Sky()
    again = capture(MISSION, camera, FrameStore(tmp_path / "lacking"), settings=lambda: commanded)
    assert (again.failed, again.stored) == (0, 1 + len(later_ms))
    frames = [decode_frame(store.read(stored.frame_id)) for stored in FrameStore(tmp_path / "lacking").frames]
    (completed,) = (frame for frame in frames[44:] if frame.bracket_id == 1)
    assert (completed.bracket_index, completed.bracket_count, completed.exposure_time_s) == (1, 3, 1e-4)


def test_a_begun_bracket_of_commanded_times_is_completed_when_the_mission_has_fewer(tmp_path):
    commanded = Settings("oldest", exposure_times_ms=(1.0, 2.0, 4.0, 8.0))
    mission = dataclasses.replace(MISSION, bracket=dataclasses.replace(MISSION.bracket, count=1))
    capture(mission, Sky(failing=(1,)), FrameStore(tmp_path), settings=lambda: commanded)
    counts = capture(mission, Sky(), FrameStore(tmp_path))
    assert (counts.planned, counts.already_stored, counts.stored) == (4, 3, 1)
    added = decode_frame(FrameStore(tmp_path).read(3))
    assert (added.bracket_index, added.bracket_count, added.exposure_time_s) == (1, 4, 1e-3)
