"""Plan, expose, tag, store: the capture sequence. Given times, it owns no clock; one bad frame never ends the pass."""

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from flightsw.cameras.camera import Camera
from flightsw.capture.bracket import AutoBracket, Geometry
from flightsw.capture.region import region_of_interest
from flightsw.errors import CameraLost, CaptureError, FlightError, OrbitError, StoreFull
from flightsw.icd.frame import HEADER, Frame, PoseTag, decode_frame, header_of, read_header
from flightsw.icd.mission import Mission
from flightsw.icd.packet import PacketError
from flightsw.navigation.pose import PoseTagger, pose_tag
from flightsw.storage.settings import Settings
from flightsw.storage.store import FrameStore
from obbgs_base.errors import counted

log = logging.getLogger(__name__)
NS = 1_000_000_000
NUMBER = re.compile(r"[\d.]+")


@dataclass(frozen=True)
class Shot:
    """One planned exposure."""

    bracket_id: int
    bracket_index: int
    bracket_count: int
    exposure_time_s: float
    start_utc_ns: int

    @property
    def mid_exposure_utc_ns(self) -> int:
        return self.start_utc_ns + round(self.exposure_time_s * NS / 2)


@dataclass
class CaptureCounts:
    """What became of the planned exposures."""

    planned: int = 0
    stored: int = 0
    already_stored: int = 0
    failed: int = 0
    lost_with_camera: int = 0  # of the failed ones: the camera did not answer
    brackets_short: int = 0  # brackets that lack such exposures
    refused: int = 0  # taken, but the store is full
    dropped: int = 0  # stored frames that were deleted undelivered for newer ones
    skipped: int = 0  # not taken: safe mode
    in_eclipse: int = 0
    pose_invalid: int = 0  # of the stored ones; the next three say why
    stale_elements: int = 0
    outside_ephemeris: int = 0
    navigation_gaps: int = 0
    packets_lost: int = 0  # between camera and computer


def plan(
    mission: Mission, times_s: Callable[[int], tuple[float, ...]] = lambda trigger_utc_ns: ()
) -> Iterator[Shot]:
    """Yield the pass's exposures: brackets `interval_s` apart, their frames `spacing_s` apart, shortest first.

    `times_s` may give other exposure times than the mission's; it is called when a bracket's first exposure is due.
    """
    bracket = mission.bracket
    for bracket_id in range(bracket.count):
        trigger_ns = _trigger_utc_ns(mission, bracket_id)
        exposures_s = sorted(times_s(trigger_ns) or bracket.exposure_times_s)
        spacing_s = bracket.spacing_s(len(exposures_s))
        for index, exposure_time_s in enumerate(exposures_s):
            start_ns = trigger_ns + round(index * spacing_s * NS)
            yield Shot(bracket_id, index, len(exposures_s), exposure_time_s, start_ns)


def _trigger_utc_ns(mission: Mission, bracket_id: int) -> int:
    return mission.orbit.start_utc_ns + round(bracket_id * mission.bracket.interval_s * NS)


def capture(
    mission: Mission,
    camera: Camera,
    store: FrameStore,
    on_frame: Callable[[CaptureCounts], None] = lambda counts: None,
    should_stop: Callable[[], bool] = lambda: False,
    wait_until: Callable[[int], None] = lambda utc_ns: None,
    settings: Callable[[], Settings] | None = None,
) -> CaptureCounts:
    """Take every planned exposure that the store does not hold yet, and return the counts.

    Args:
        camera: a `ReconnectingCamera` logs its own losses; they are only counted here.
        wait_until: returns when it is time for an exposure (UTC, ns); it may return early to stop.
        settings: what the ground has commanded, read when a bracket is due (times), and when an exposure is (NEAR, and
            safe mode, in which the time of the exposure passes without it).

    Raises:
        NavigationError: the mission's navigation file is not there.
        StoreError: the store holds another pass, or the disk refuses; without a store there is no capture. A full
            store is counted, not raised.
    """
    counts = CaptureCounts()
    store.hold_pass(mission.orbit.start_utc_ns)
    dropped_before, tagger = store.dropped_undelivered, PoseTagger(mission)
    times = _BracketTimes(mission, store, wait_until, settings)
    failures = _Repeats("more exposure", "lost for the same reason")
    refusals = _Repeats("more frame", "refused")
    short = set()

    def take(shot: Shot, max_error_dn: int) -> None:
        try:
            frame = expose(mission, camera, shot, store.next_frame_id, tagger)
            store.put(frame, max_error_dn=max_error_dn, roi_mask=region_of_interest(frame.dn, mission))
        except StoreFull as error:
            counts.refused += 1
            refusals.log("the store is full", str(error))
        except CameraLost:
            counts.failed += 1
            counts.lost_with_camera += 1
            short.add(shot.bracket_id)
            counts.brackets_short = len(short)
        except (CaptureError, ValueError) as error:
            counts.failed += 1
            failures.log(str(error), f"bracket {shot.bracket_id} frame {shot.bracket_index} lost: {error}")
        else:
            failures.end()
            refusals.end()
            times.observe(frame)
            counts.stored += 1
            counts.in_eclipse += frame.pose.in_eclipse
            counts.pose_invalid += not frame.pose.valid

    try:
        for shot in plan(mission, times.at):
            if should_stop():
                break
            if store.holds(shot.bracket_id, shot.bracket_index):
                counts.already_stored += 1
            else:
                wait_until(shot.start_utc_ns)
                if should_stop():
                    break
                commanded = settings() if settings else None
                if commanded is not None and commanded.safe_mode:
                    counts.skipped += 1
                else:
                    take(shot, commanded.max_error_dn if commanded else 0)
            counts.planned += 1
            counts.dropped = store.dropped_undelivered - dropped_before
            counts.stale_elements = tagger.stale_elements
            counts.outside_ephemeris = tagger.outside_ephemeris
            counts.navigation_gaps = tagger.navigation_gaps
            on_frame(counts)
    finally:
        failures.end()
        refusals.end()
        tagger.close()
    return counts


def expose(
    mission: Mission, camera: Camera, shot: Shot, frame_id: int, tag: Callable[[int], PoseTag]
) -> Frame:
    """Return one exposure with its tag.

    Raises:
        CaptureError: the camera failed, or its picture is not of the mission's size.
    """
    section = mission.camera
    exposure = camera.expose(shot.exposure_time_s, shot.start_utc_ns)
    expected = (section.height, section.width) + ((3,) if section.channels == 3 else ())
    if exposure.dn.shape != expected:
        raise CaptureError(f"the mission's camera gives {expected} pixels, this one {exposure.dn.shape}")
    return Frame(
        frame_id=frame_id,
        bracket_id=shot.bracket_id,
        bracket_index=shot.bracket_index,
        bracket_count=shot.bracket_count,
        exposure_time_s=exposure.exposure_time_s,
        mid_exposure_utc_ns=exposure.mid_exposure_utc_ns,
        pose=tag(exposure.mid_exposure_utc_ns),
        dn=exposure.dn,
        bit_depth=section.bit_depth,
        black_dn=section.black_dn,
        saturated_count=int((exposure.dn >= section.white_dn).sum()),
    )


class _Repeats:
    """Logs the first of several problems in a row that differ in numbers only, and then how many more there were."""

    def __init__(self, thing: str, fate: str):
        self._thing, self._fate = thing, fate
        self._last, self._repeats = "", 0

    def log(self, problem: str, line: str) -> None:
        if NUMBER.sub("", problem) == NUMBER.sub("", self._last):
            self._repeats += 1
            return
        self.end()
        self._last = problem
        log.warning("%s", line)

    def end(self) -> None:
        if self._repeats:
            log.warning("%s %s: %s", counted(self._repeats, self._thing), self._fate, self._last)
        self._last, self._repeats = "", 0


class _BracketTimes:
    """Which exposure times the next bracket has: commanded, the mission's, or by what the last bracket showed."""

    def __init__(
        self,
        mission: Mission,
        store: FrameStore,
        wait_until: Callable[[int], None],
        settings: Callable[[], Settings] | None,
    ):
        self._mission, self._wait_until, self._settings = mission, wait_until, settings
        self._begun = _BegunBrackets(mission, store)
        self._auto = AutoBracket(mission.camera, mission.bracket)
        self._taken: list[Frame] = []
        self._last_seen: Geometry | None = None
        if mission.bracket.auto and store.frames:  # a restart goes on where the last bracket ended
            last = max(stored.bracket_id for stored in store.frames)
            for stored in store.frames:
                if stored.bracket_id == last:
                    try:
                        self._taken.append(decode_frame(store.read(stored.frame_id)))
                    except (FlightError, ValueError) as error:
                        log.warning("not used for the exposure times: %s", error)

    def observe(self, frame: Frame) -> None:
        if self._taken and self._taken[-1].bracket_id != frame.bracket_id:
            self._taken = []
        self._taken.append(frame)

    def at(self, trigger_utc_ns: int) -> tuple[float, ...]:
        """Return the exposure times of a bracket once it is due; empty for the mission's own.

        A bracket that an earlier start began keeps its number of exposures, whatever has been commanded since.
        """
        if (held := self._begun.whole(trigger_utc_ns)) is not None:
            return held
        return self._begun.completed(trigger_utc_ns, self._next(trigger_utc_ns))

    def _next(self, trigger_utc_ns: int) -> tuple[float, ...]:
        # before the wait, since it takes time
        times_s = self._automatic(trigger_utc_ns) if self._mission.bracket.auto else ()
        self._wait_until(trigger_utc_ns)
        commanded = self._settings() if self._settings else None
        if commanded is not None and commanded.exposure_times_ms is not None:
            return tuple(time_ms / 1e3 for time_ms in commanded.exposure_times_ms)
        return times_s

    def _automatic(self, trigger_utc_ns: int) -> tuple[float, ...]:
        if self._taken:
            self._last_seen = Geometry.of(self._taken[-1].pose)
            self._auto.observe([(frame.dn, frame.exposure_time_s) for frame in self._taken], self._last_seen)
            self._taken = []
        if self._mission.navigation.source != "sgp4" and self._last_seen is not None:
            return self._auto.times_s(self._last_seen)  # the stream has no states of the future
        try:
            return self._auto.times_s(Geometry.of(pose_tag(self._mission, trigger_utc_ns)))
        except OrbitError as error:
            log.warning("exposure times of the mission file: %s", error)
            return ()


class _BegunBrackets:
    """How many exposures each bracket of an earlier start consists of, and their times, as the store tells.

    Headers of stored frames say both. Where a bracket's frames were all deleted, or cannot be read, it had at least
    as many exposures as were stored; the last one may have been interrupted, and is planned as a new one is.
    """

    def __init__(self, mission: Mission, store: FrameStore):
        self._mission, self._store = mission, store
        self._least = store.begun_brackets()
        self._last = max(self._least, default=-1)
        self._brackets = {_trigger_utc_ns(mission, bracket_id): bracket_id for bracket_id in self._least}
        self._frames: dict[int, list[int]] = {}
        for stored in store.frames if self._least else ():
            self._frames.setdefault(stored.bracket_id, []).append(stored.frame_id)

    def whole(self, trigger_utc_ns: int) -> tuple[float, ...] | None:
        """Return as many times as a bracket has exposures if the store holds, or held, all of them."""
        bracket_id = self._brackets.get(trigger_utc_ns)
        if bracket_id is None:
            return None
        count, known_s = self._planned(bracket_id, all_times=False)
        if count == 0 or not all(self._store.holds(bracket_id, index) for index in range(count)):
            return None
        return (next(iter(known_s.values()), self._mission.bracket.exposure_times_s[0]),) * count

    def completed(self, trigger_utc_ns: int, next_s: tuple[float, ...]) -> tuple[float, ...]:
        """Return the times of a bracket of which exposures are missing; `next_s` are those that a new one would have.

        Where neither these nor the mission's are as many as the bracket's, an exposure has the time of the nearest one
        that is known.
        """
        bracket_id = self._brackets.get(trigger_utc_ns)
        if bracket_id is None:
            return next_s
        count, known_s = self._planned(bracket_id, all_times=True)
        own_s = self._mission.bracket.exposure_times_s
        for times_s in (next_s or own_s, own_s):
            if count in (0, len(times_s)):
                return times_s
        known_s = known_s or dict(enumerate(sorted(next_s or own_s)))
        return tuple(known_s[min(known_s, key=lambda i: abs(i - index))] for index in range(count))

    def _planned(self, bracket_id: int, all_times: bool) -> tuple[int, dict[int, float]]:
        """Return how many exposures a bracket has, 0 if that is not known, and the times of those that can be read."""
        count, known_s = 0, {}
        for frame_id in self._frames.get(bracket_id, []):
            try:
                with open(self._store.path(frame_id), "rb") as container:
                    header = read_header(header_of(container.read(HEADER.size)))
            except (OSError, PacketError):
                continue
            count = max(count, header["bracket_count"])
            known_s[header["bracket_index"]] = header["exposure_time_s"]
            if not all_times:
                break
        if count == 0 and bracket_id < self._last:
            count = self._least[bracket_id]
        return count, known_s
