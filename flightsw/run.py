"""One run of the flight software: capture and downlink side by side, and what became of every frame."""

import contextlib
import dataclasses
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flightsw.cameras import open_camera
from flightsw.cameras.reconnecting import PATIENCE_S, RETRY_S, ReconnectingCamera
from flightsw.capture.sequencer import CaptureCounts, capture
from flightsw.clock import utc_ns
from flightsw.downlink.commands import KeyRing
from flightsw.downlink.housekeeping import EventLog
from flightsw.downlink.loop import DownlinkProgress, run_downlink
from flightsw.errors import CameraLost, CaptureError, StoreError
from flightsw.icd.link.can import FLIGHT_SIDE
from flightsw.icd.mission import Mission
from flightsw.ports import Link, open_link
from flightsw.storage.boot_counter import count_boot
from flightsw.storage.settings import load_settings
from flightsw.storage.store import FrameStore, open_store, remove_unused, require_store
from flightsw.watchdog import Watchdog, notify
from obbgs_base.errors import counted
from obbgs_base.stopping import join

log = logging.getLogger(__name__)
LINGER_S = 0.5  # after the last delivery
EXPOSURE_WITHIN_S = 120.0  # with all attempts of the camera; later than this, capture hangs


class _NeverAnswered(CaptureError):
    """The camera gave no other answer than at the start, which was logged then."""


@dataclass(frozen=True)
class RunResult:
    """What became of the frames of one run."""

    frames_stored: int
    outbox: int  # frames still to be delivered
    captured: CaptureCounts | None = None  # None if no camera was asked for
    camera_losses: int = 0
    camera_is_lost: bool = False  # at the end of the run
    sent: DownlinkProgress | None = None  # None if no link was asked for

    def tree(self) -> dict[str, Any]:
        """Return the result as it is printed with --json."""
        tree: dict[str, Any] = {"frames_stored": self.frames_stored, "outbox": self.outbox}
        if self.captured is not None:
            tree["capture"] = vars(self.captured) | {"camera_losses": self.camera_losses}
        if self.sent is not None:
            tree["downlink"] = dataclasses.asdict(self.sent)
        return tree


def run_pass(
    mission: Mission,
    store_dir: Path,
    stop: threading.Event,
    *,
    camera_url: str | None = None,
    link_url: str | None = None,
    key_files: Sequence[Path] = (),
    exit_when_empty: bool = False,
    on_captured: Callable[[CaptureCounts], None] = lambda counts: None,
    on_sent: Callable[[DownlinkProgress], None] = lambda progress: None,
) -> RunResult:
    """Capture and send at the same time, whichever are asked for, and return what became of the frames.

    Key, link and camera are opened before the store, so that wrong ones leave no store behind. Where there is a link,
    stored frames are sent without a camera that answers; it is tried again until the pass is over, and if it never
    answered an error is raised afterwards, and a store that was made for nothing goes again. A link that is not there
    yet is awaited while frames are taken, and a store that cannot be read while commands are answered; with
    `exit_when_empty` the store must be there.

    Args:
        stop: when set, capture and downlink end cleanly.
        key_files: the mission's keys; one that cannot be used is left out, and without any every command is refused.
        exit_when_empty: end the downlink once the ground has or rejects every frame, not only when stopped.
        on_captured: called after each planned exposure.
        on_sent: called from the downlink's thread, about five times a second.

    Raises:
        ObbgsError: what could not be opened, or what ended capture or downlink.
        ValueError: a URL that nothing here can open.
    """
    captured, camera, no_camera, thread, alive = CaptureCounts(), None, None, None, Watchdog()
    with contextlib.ExitStack() as opened:
        events = _events(opened)  # from here on, so that the ground hears of all that is found at the start
        link, keys = _open_link(link_url, key_files, exit_when_empty and camera_url is None, opened)
        if camera_url is not None:
            camera, no_camera = _first_camera(camera_url, mission, stop, opened, is_needed=link is None)
        if exit_when_empty and camera_url is None:
            require_store(store_dir)
        is_patient, is_new = link is not None and not exit_when_empty, not store_dir.exists()
        store = open_store(store_dir, mission, open_now=not is_patient)
        if link is not None:
            thread = _DownlinkThread(store, link, mission, keys, exit_when_empty, stop, on_sent, alive)
            thread.camera, thread.boot, thread.events = camera, count_boot(store_dir), events
            if camera_url is not None:
                thread.capturing.set()
            thread.start()
        notify("READY=1")

        def report(counts: CaptureCounts) -> None:
            if thread is not None:
                thread.captured = counts
            on_captured(counts)

        try:
            if thread is not None:
                _wait_for_stores(store, thread, stop)
            if camera_url is not None and thread is not None and no_camera is not None:
                thread.camera = camera = _awaited_camera(camera_url, mission, stop, opened, alive, no_camera)
            if camera is not None:
                captured = _capture(mission, camera, store, stop, report, alive)
        except Exception as error:
            if thread is not None:  # it may go on for hours until the outbox is empty: log the error now
                thread.camera_failed = True
                _tell(error, events)
            raise
        finally:
            if thread is not None:
                thread.capturing.clear()
                join(thread)
            if is_new and no_camera is not None and camera is None:
                remove_unused(store_dir)
            notify("STOPPING=1")
        if thread is not None and thread.error is not None:
            raise thread.error
    sent = thread.result if thread is not None else None
    return _result(store_dir, captured if camera_url is not None else None, camera, sent)


def _result(
    store_dir: Path,
    captured: CaptureCounts | None,
    camera: ReconnectingCamera | None,
    sent: DownlinkProgress | None,
) -> RunResult:
    left = FrameStore(store_dir)  # opened again: the downlink has its own
    return RunResult(
        frames_stored=len(left.frames),
        outbox=len(left.outbox()),
        captured=captured,
        camera_losses=camera.losses if camera is not None else 0,
        camera_is_lost=camera is not None and camera.lost,
        sent=sent,
    )


def _events(opened: contextlib.ExitStack) -> EventLog:
    """Return where warnings and errors of the flight software go until `opened` ends."""
    events, logger = EventLog(), logging.getLogger("flightsw")
    logger.addHandler(events)
    opened.callback(logger.removeHandler, events)
    return events


def _open_link(
    link_url: str | None, key_files: Sequence[Path], must_be_there: bool, opened: contextlib.ExitStack
) -> tuple[Link | None, KeyRing]:
    """Return the link, None if it was not asked for, and the keys; `opened` closes them."""
    if link_url is None:
        return None, KeyRing([])
    keys = KeyRing(key_files)
    opened.callback(keys.close)
    return opened.enter_context(open_link(link_url, FLIGHT_SIDE, must_be_there)), keys


def _wait_for_stores(store: FrameStore, thread: "_DownlinkThread", stop: threading.Event) -> None:
    """Open the stores of capture and downlink, which takes seconds where many frames wait.

    Where they cannot be read, it is tried again until they can or the run is stopped.

    Raises:
        StoreError: they could not be read before the run was stopped.
    """
    problem = ""
    while not (store.is_open and thread.store.is_open):
        try:
            for each in (store, thread.store):
                if not each.is_open:
                    each.open()
        except StoreError as error:
            if problem != str(error):
                log.error("%s; commands are obeyed, and it is tried again every %g s", error, RETRY_S)
            problem = str(error)
            if stop.wait(RETRY_S):
                raise
    thread.store_is_made.set()


def _tell(error: Exception, events: EventLog) -> None:
    """Log what ended capture; to the ground alone where it was logged at the start."""
    if isinstance(error, _NeverAnswered):
        events.add("error", problem=str(error))
    else:
        log.error("no more exposures: %s", str(error) or repr(error))


def _first_camera(
    url: str, mission: Mission, stop: threading.Event, opened: contextlib.ExitStack, is_needed: bool
) -> tuple[ReconnectingCamera | None, CaptureError | None]:
    """Return a camera, or why there is none; with `is_needed` that is raised."""
    try:
        return _open_camera(url, mission, stop, opened), None
    except CaptureError as error:
        if is_needed:
            raise
        return None, error


def _open_camera(
    url: str, mission: Mission, stop: threading.Event, opened: contextlib.ExitStack
) -> ReconnectingCamera:
    """Return a camera that `opened` closes."""
    camera = ReconnectingCamera(open_camera(url, mission.camera), stop.wait)
    opened.callback(camera.close)
    return camera


def _awaited_camera(
    url: str,
    mission: Mission,
    stop: threading.Event,
    opened: contextlib.ExitStack,
    watchdog: Watchdog,
    error: CaptureError,
) -> ReconnectingCamera:
    """Return a camera that did not answer once it does; it is tried until the pass is over, for `PATIENCE_S` at least.

    Raises:
        CaptureError: it never answered, or it cannot be what the mission expects.
    """
    told = str(error)
    pass_s = mission.bracket.count * mission.bracket.interval_s
    over_utc_ns, patient_until_s = mission.orbit.start_utc_ns + pass_s * 1e9, time.monotonic() + PATIENCE_S
    log.warning("no camera yet, it is tried again every %g s: %s", RETRY_S, error)
    try:
        while isinstance(error, CameraLost) and not stop.is_set():
            if utc_ns() > over_utc_ns and time.monotonic() > patient_until_s:
                break
            watchdog.expect("capture", RETRY_S + EXPOSURE_WITHIN_S)
            stop.wait(RETRY_S)
            try:
                camera = _open_camera(url, mission, stop, opened)
            except CaptureError as again:
                error = again
            else:
                log.warning("the camera answers")
                return camera
    finally:
        watchdog.ended("capture")
    if str(error) == told:
        raise _NeverAnswered("no frame was taken: the camera never answered") from error
    raise error


def _capture(
    mission: Mission,
    camera: ReconnectingCamera,
    store: FrameStore,
    stop: threading.Event,
    on_counts: Callable[[CaptureCounts], None],
    watchdog: Watchdog,
) -> CaptureCounts:
    def wait_until(due_ns: int) -> None:
        # a camera with a clock of its own waits for this computer: in safe mode its time stands still
        while camera.has_own_clock and load_settings(store.folder, mission).safe_mode and not stop.is_set():
            watchdog.expect("capture", RETRY_S + EXPOSURE_WITHIN_S)
            stop.wait(RETRY_S)
        while not camera.has_own_clock and not stop.is_set() and (left_s := (due_ns - utc_ns()) / 1e9) > 0:
            watchdog.expect("capture", RETRY_S + EXPOSURE_WITHIN_S)
            camera.reconnect()
            stop.wait(min(left_s, RETRY_S))  # not all of it: the clock may be set meanwhile

    def on_frame(counts: CaptureCounts) -> None:
        watchdog.expect("capture", EXPOSURE_WITHIN_S)
        counts.packets_lost = camera.packets_lost
        on_counts(counts)

    watchdog.expect("capture", EXPOSURE_WITHIN_S)
    try:
        with store.capturing():
            counts = capture(
                mission,
                camera,
                store,
                on_frame=on_frame,
                should_stop=stop.is_set,
                wait_until=wait_until,
                settings=lambda: load_settings(store.folder, mission),
            )
    finally:
        watchdog.ended("capture")
    if camera.lost:
        lost = counted(counts.lost_with_camera, "exposure")
        log.error("the camera did not come back: %s not taken", lost)
    return counts


class _DownlinkThread(threading.Thread):
    """Sends while frames are being taken; an error is kept for the main thread."""

    def __init__(
        self,
        captured_to: FrameStore,
        link: Link,
        mission: Mission,
        keys: KeyRing,
        exit_when_empty: bool,
        stop: threading.Event,
        on_progress: Callable[[DownlinkProgress], None],
        watchdog: Watchdog,
    ):
        super().__init__(name="downlink", daemon=True)
        self.capturing = threading.Event()  # set while more frames may come
        self.captured = CaptureCounts()  # so far
        self.camera: ReconnectingCamera | None = None  # until it answers
        self.camera_failed = False
        self.boot = 0  # the number of this start
        self.events: EventLog | None = None
        self.store_is_made = threading.Event()  # set once it is open, and what was damaged is repaired
        self.result = DownlinkProgress()
        self.error: Exception | None = None
        # another one than that of capture: each is for one thread, and what they share is on the disk
        self.store = FrameStore(captured_to.folder, open_now=False)
        self._link, self._mission, self._keys = link, mission, keys
        self._exit_when_empty, self._stop_event = exit_when_empty, stop
        self._on_progress, self._watchdog = on_progress, watchdog
        self._empty_since_s: float | None = None

    def run(self) -> None:
        try:
            self.result = run_downlink(
                self.store,
                self._link,
                self._mission,
                on_progress=self._keep,
                should_stop=self._should_stop,
                keys=self._keys,
                capture_values=self._capture_values,
                boot=self.boot,
                events=self.events,
                store_may_open=self.store_is_made.is_set,
            )
        except Exception as error:  # it would be lost with this thread; the main thread raises it
            self.error = error
            if self.capturing.is_set():  # the main thread may be busy for hours
                log.error("the downlink has ended, frames are only stored: %s", str(error) or repr(error))

    def _capture_values(self) -> dict[str, Any]:
        """Return what capture knows of the housekeeping packet."""
        missing = self.capturing.is_set() if self.camera is None else self.camera.lost
        if self.camera_failed or missing:
            state = "failed"
        elif self.capturing.is_set():
            state = "capturing"
        else:
            state = "pass done" if self.captured.planned else "none"
        return {
            "camera": state,
            "frames_failed": self.captured.failed,
            "frames_refused": self.captured.refused,
        }

    def _keep(self, now: DownlinkProgress) -> None:
        self.result = now
        self._watchdog.alive()  # from this loop only: a downlink that hangs is silent
        self._on_progress(now)

    def _should_stop(self) -> bool:
        """Tell whether all is delivered; lingers a little, as the ground may ask for its last answer once more."""
        rejected = self.result.rejected_waiting  # by the ground; they stay on board
        waiting = self.capturing.is_set() or self.result.waiting > rejected or not self._exit_when_empty
        if waiting or not self.store.is_open or len(self.store.outbox()) > rejected:
            self._empty_since_s = None
        elif self._empty_since_s is None:
            self._empty_since_s = time.monotonic()
        done = self._empty_since_s is not None and time.monotonic() - self._empty_since_s > LINGER_S
        return self._stop_event.is_set() or done
