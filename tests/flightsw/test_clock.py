"""A clock that is wrong for a moment costs nothing, one that is set is followed, and each step is told."""

import dataclasses
import logging
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw import run
from flightsw.cameras.camera import Exposure
from flightsw.cameras.reconnecting import ReconnectingCamera
from flightsw.clock import CONFIRM_NS, STEP_NS, SteadyClock
from flightsw.downlink.housekeeping import EventLog
from flightsw.errors import CaptureError
from flightsw.icd.telemetry import DICTIONARY
from flightsw.watchdog import Watchdog

NS = 1_000_000_000
START_NS = 1_784_631_150 * NS
HOUR_NS = 3600 * NS
LATE_NS = NS // 2  # what a camera still takes


class Computer:
    """Elapsed time, and a clock that is wrong at times. As a `stop` event of flight it lets time pass."""

    def __init__(self, wrong: list[tuple[float, float, float]]):
        self.elapsed_ns = 0
        self._wrong = wrong  # from, until (elapsed, s), by (s)

    def utc_ns(self) -> int:
        elapsed_s = self.elapsed_ns / NS
        by_s = sum(by_s for begin_s, end_s, by_s in self._wrong if begin_s <= elapsed_s < end_s)
        return START_NS + self.elapsed_ns + round(by_s * NS)

    def clock(self) -> SteadyClock:
        return SteadyClock(self.utc_ns, lambda: self.elapsed_ns)

    def is_set(self) -> bool:
        return False

    def wait(self, seconds: float) -> bool:
        self.elapsed_ns += max(1, round(seconds * NS))
        return False


class Punctual:
    """A camera without a clock of its own, which takes no exposure that is late."""

    has_own_clock, packets_lost = False, 0

    def __init__(self, computer: Computer, clock: SteadyClock, shape: tuple[int, ...]):
        self._computer, self._clock, self._shape = computer, clock, shape
        self.taken_ns: list[int] = []  # elapsed time

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        if self._clock.utc_ns() - start_utc_ns > LATE_NS:
            raise CaptureError("too late")
        self.taken_ns.append(self._computer.elapsed_ns)
        dn = np.zeros(self._shape, np.uint16)
        return Exposure(dn, exposure_time_s, start_utc_ns + round(exposure_time_s * NS / 2))


def captured(computer: Computer, mission, store, monkeypatch) -> tuple[int, list[int]]:
    """Take twelve exposures a second apart, the first after 3 s; return how many failed, and when they were taken."""
    clock = computer.clock()
    monkeypatch.setattr(run, "utc_ns", clock.utc_ns)
    start_ns = START_NS + 3 * NS
    orbit = dataclasses.replace(
        mission.orbit, start_utc=np.datetime64(start_ns, "ns").astype(str) + "Z", max_element_age_days=1e4
    )
    bracket = dataclasses.replace(
        mission.bracket, exposure_times_ms=(1.0,), interval_s=1.0, frame_spacing_s=0.5, count=12
    )
    mission = dataclasses.replace(mission, orbit=orbit, bracket=bracket)
    camera = Punctual(computer, clock, (mission.camera.height, mission.camera.width))
    clock.utc_ns()
    counts = run._capture(
        mission,
        ReconnectingCamera(camera, computer.wait),
        store,
        computer,  # type: ignore[arg-type]
        lambda counts: None,
        Watchdog(lambda: 0.0),
    )
    return counts.failed, camera.taken_ns


@pytest.mark.parametrize("by_s", [3600.0, -3600.0, 1e9, -1e9, 0.7])
@pytest.mark.parametrize("wrong_s", [(4.0, 4.5), (4.9, 8.5), (0.5, 3.2)])
def test_a_clock_that_is_wrong_for_seconds_costs_no_exposure(
    small_mission, store, monkeypatch, by_s, wrong_s
):
    failed, taken_ns = captured(Computer([(*wrong_s, by_s)]), small_mission, store, monkeypatch)
    assert failed == 0
    # STEP_NS: a change of less than that is followed at once
    assert all(abs(at - (3 + n) * NS) <= STEP_NS for n, at in enumerate(taken_ns)) and len(taken_ns) == 12


def test_exposures_that_are_past_by_a_clock_that_was_set_are_given_up(small_mission, store, monkeypatch):
    """Set forward by 20 s after 4.2 s: all are past. Those of the seconds in which that was unsure are taken."""
    failed, taken_ns = captured(Computer([(4.2, 1e9, 20.0)]), small_mission, store, monkeypatch)
    assert 0 < failed < 12 and len(taken_ns) + failed == 12
    assert max(taken_ns) < 4.2 * NS + CONFIRM_NS + 2 * NS


def test_a_computer_that_starts_in_the_past_loses_what_is_due_while_its_clock_is_confirmed(
    small_mission, store, monkeypatch
):
    """Set 1 s after its start, 2 s before the first exposure."""
    failed, taken_ns = captured(Computer([(0.0, 1.0, -1e9)]), small_mission, store, monkeypatch)
    assert failed <= CONFIRM_NS // NS and len(taken_ns) + failed == 12
    assert all(abs(at - (3 + failed + n) * NS) <= STEP_NS for n, at in enumerate(taken_ns))


@pytest.fixture
def store(tmp_path):
    from flightsw.storage.store import FrameStore

    return FrameStore(tmp_path / "store")


@given(
    st.lists(
        st.tuples(st.floats(0.05, 2.0), st.one_of(st.just(0.0), st.floats(-1e9, 1e9)), st.floats(0.0, 4.9)),
        max_size=30,
    )
)
def test_no_sequence_of_short_errors_moves_the_time(steps):
    """(looked at every, wrong by, for): between errors the clock is right for at least one look."""
    computer = Computer([])
    clock = computer.clock()
    clock.utc_ns()
    for every_s, by_s, for_s in steps:
        begin_s = computer.elapsed_ns / NS
        computer._wrong = [(begin_s, begin_s + for_s, by_s)]
        while computer.elapsed_ns / NS < begin_s + for_s:
            assert abs(clock.utc_ns() - START_NS - computer.elapsed_ns) <= STEP_NS
            computer.wait(every_s)
        assert clock.utc_ns() == START_NS + computer.elapsed_ns


@given(st.floats(-1e9, 1e9), st.floats(0.05, 10.0))
def test_a_step_that_lasts_is_followed(by_s, every_s):
    computer = Computer([(1.0, 1e12, by_s)])
    clock = computer.clock()
    clock.utc_ns()
    end_ns = NS + CONFIRM_NS + round(3 * every_s * NS)
    while computer.elapsed_ns < end_ns:
        clock.utc_ns()
        computer.wait(every_s)
    assert clock.utc_ns() == computer.utc_ns()


def test_each_step_is_an_event():
    """The real log: what makes events of warnings asks the clock for the time while it tells."""
    computer = Computer([(10.0, 10.5, 3600.0), (60.0, 1e9, -7.0)])
    clock = computer.clock()
    events = EventLog(clock.utc_ns)
    logger = logging.getLogger("flightsw")
    logger.addHandler(events)
    try:
        for _ in range(100):
            clock.utc_ns()
            computer.wait(1.0 if computer.elapsed_ns != 10 * NS else 0.25)
    finally:
        logger.removeHandler(events)
    told = []
    while (packet := events.take()) is not None:
        told.append(DICTIONARY.unpack("events", packet)[1]["problem"])
    assert [text for text in told if "stepped by +3600.000 s; followed if it lasts 5 s" in text]
    assert [text for text in told if "right again after" in text]
    assert [text for text in told if "stepped by -7.000 s" in text]
    assert [text for text in told if "step by -7.000 s has lasted and is followed" in text]
    assert len(told) == 4


def test_threads_may_ask_at_once():
    clock, seen = SteadyClock(), []
    threads = [
        threading.Thread(target=lambda: seen.extend(clock.utc_ns() for _ in range(500))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 2000 and max(seen) - min(seen) < 60 * NS
