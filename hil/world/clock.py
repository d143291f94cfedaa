"""The simulated clock: it holds a camera's pictures back until their exposures have ended, and counts late ones."""

import math
import threading
import time
from collections.abc import Callable

from flightsw.cameras.camera import OWN_CLOCK_ANSWER_S
from flightsw.icd.mission import Mission

NS = 1_000_000_000
MARGIN_S = 20.0  # of a camera driver's timeout, left for rendering
LONGEST_WAIT_S = OWN_CLOCK_ANSWER_S - MARGIN_S


class SimulatedClock:
    """Mission time that runs `factor` times as fast as real time; with 0 the camera is in lock step with its client.

    It starts when the first picture is ready. From then on no picture leaves before its exposure has ended on this
    clock. One that was not ready by then (rendered too slowly, or requested too late) leaves at once and is late.

    Raises:
        ValueError: the factor is negative or not finite, or brackets would come so slowly that flight's camera driver
            times out.
    """

    def __init__(self, mission: Mission, factor: float = 0.0, clock_s: Callable[[], float] = time.monotonic):
        if not (math.isfinite(factor) and factor >= 0):
            raise ValueError(f"a real-time factor is 0 (lock step) or positive, got {factor}")
        interval_s = mission.bracket.interval_s
        if factor and interval_s / factor > LONGEST_WAIT_S:
            raise ValueError(
                f"at {factor:g} times real time a bracket comes every {interval_s / factor:.0f} s, but flight waits at "
                f"most {LONGEST_WAIT_S:.0f} s for a picture; expected a factor of at least "
                f"{interval_s / LONGEST_WAIT_S:.2g}"
            )
        self.factor = factor
        self.late_frames = 0
        self._clock_s = clock_s
        self._start: tuple[float, int] | None = None  # real time s, and mission time UTC ns
        self._lock = threading.Lock()

    def release(self, end_utc_ns: int, wait: Callable[[float], object]) -> None:
        """Wait until an exposure, whose picture is ready, has ended; `wait` is called with the seconds until then."""
        if not self.factor:
            return
        ready_s = self._clock_s()
        with self._lock:
            if self._start is None:
                self._start = ready_s, end_utc_ns
            start_s, start_utc_ns = self._start
            due_s = start_s + (end_utc_ns - start_utc_ns) / NS / self.factor
            self.late_frames += ready_s > due_s
        wait(max(0.0, due_s - ready_s))
