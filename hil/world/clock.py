"""The simulated clock: when a picture may leave the camera, and whether it is late."""

import math
import threading
import time
from collections.abc import Callable

from flightsw.cameras import OWN_CLOCK_ANSWER_S
from flightsw.icd.mission import Mission

NS = 1_000_000_000
MARGIN_S = 20.0  # of a driver's patience, for rendering
LONGEST_WAIT_S = OWN_CLOCK_ANSWER_S - MARGIN_S


class SimulatedClock:
    """The mission's time, `factor` times as fast as ours; with 0 the camera is in lock step with its client.

    It starts with the first picture that is ready. From then on a picture leaves no earlier than its exposure has
    ended, and one that was not ready by then (rendered too slowly, or asked for too late) is late: it leaves at once.

    Raises:
        ValueError: the factor is negative or not finite, or flight would not wait so long from bracket to bracket.
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
        self._start: tuple[float, int] | None = None  # our seconds, UTC ns
        self._lock = threading.Lock()

    def release(self, end_utc_ns: int, wait: Callable[[float], object]) -> None:
        """Return when an exposure whose picture is ready has ended; `wait` takes the seconds until then."""
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
