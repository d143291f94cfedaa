"""UTC that does not jump: a step of the computer's clock is followed only when it has lasted some seconds.

A false time from GNSS or NTP, put right at once, would otherwise cost every exposure that then seems to be past.
"""

import logging
import threading
import time
from collections.abc import Callable

log = logging.getLogger(__name__)
NS = 1_000_000_000
STEP_NS = (
    NS // 2
)  # that UTC gains on elapsed time at once: more than a correction of its rate between two looks
CONFIRM_NS = 5 * NS  # for which a step must last


class SteadyClock:
    """UTC as the computer's clock has it, carried on by elapsed time while that clock may be wrong.

    Small changes are followed at once. A step is logged when it is seen, and again when it is followed or was undone.
    Any thread may ask. The longer nobody asks, the more of a drift looks like a step; some looks a minute are enough.
    """

    def __init__(
        self,
        utc_ns: Callable[[], int] = lambda: time.time_ns(),
        elapsed_ns: Callable[[], int] = lambda: time.monotonic_ns(),
    ):
        self._utc_ns, self._elapsed_ns = utc_ns, elapsed_ns
        self._guard = threading.Lock()
        self._offset_ns: int | None = None  # of UTC over elapsed time
        self._step: tuple[int, int] | None = None  # the offset after it, and when it was seen

    def utc_ns(self) -> int:
        """Return Unix time."""
        with self._guard:
            now_ns = self._elapsed_ns()
            told = self._look(self._utc_ns() - now_ns, now_ns)
            assert self._offset_ns is not None
            utc_ns = now_ns + self._offset_ns
        if told:
            log.warning("%s", told)  # without the lock: what makes an event of it asks for the time
        return utc_ns

    def _look(self, offset_ns: int, now_ns: int) -> str:
        """Take in the clock's offset; return what is to be told."""
        if self._offset_ns is None:
            self._offset_ns = offset_ns
        gain_ns = offset_ns - self._offset_ns
        if abs(gain_ns) < STEP_NS:
            self._offset_ns, step, self._step = offset_ns, self._step, None
            if step is None:
                return ""
            return (
                f"the clock is right again after {(now_ns - step[1]) / NS:.1f} s; its step was not followed"
            )
        if self._step is None or abs(offset_ns - self._step[0]) >= STEP_NS:
            self._step = offset_ns, now_ns
            return f"the clock stepped by {gain_ns / NS:+z.3f} s; followed if it lasts {CONFIRM_NS / NS:g} s"
        if now_ns - self._step[1] < CONFIRM_NS:
            return ""
        self._offset_ns, self._step = offset_ns, None
        return f"the clock's step by {gain_ns / NS:+z.3f} s has lasted and is followed"


utc_ns = SteadyClock().utc_ns  # of this process
