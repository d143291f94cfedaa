"""A camera that may be lost and come back: one log line for each, and counts of the exposures that it missed."""

import logging
import time
from collections.abc import Callable

from flightsw.cameras.camera import Camera, Exposure
from flightsw.errors import CameraLost, CaptureError
from obbgs_base.errors import counted

log = logging.getLogger(__name__)
RETRY_S = 1.0  # between attempts to reach a lost camera
PATIENCE_S = 30.0  # for which a lost camera with a clock of its own is tried again before it counts as gone


class ReconnectingCamera:
    """Tries a lost camera again, and logs only when it is lost and when it is back.

    A camera without a clock of its own is tried at each exposure, and between exposures by `reconnect`: exposures go on
    at their times. One with its own clock is asked for the same exposure again, so that no exposure is lost if it comes
    back within `PATIENCE_S`; after that it counts as gone, and every further exposure fails at once.

    Args:
        pause: waits some seconds; returns true when there is no point in going on.
    """

    def __init__(
        self,
        camera: Camera,
        pause: Callable[[float], object] = time.sleep,
        clock_s: Callable[[], float] = time.monotonic,
    ):
        self.losses = 0  # how many times the camera was lost
        self._camera, self._pause, self._clock_s = camera, pause, clock_s
        self._lost_since_s: float | None = None
        self._exposures_lost = 0  # since then
        self._gone = False

    @property
    def lost(self) -> bool:
        return self._lost_since_s is not None

    @property
    def has_own_clock(self) -> bool:
        return self._camera.has_own_clock

    @property
    def packets_lost(self) -> int:
        return self._camera.packets_lost

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Return one exposure.

        Raises:
            CameraLost: the camera does not answer.
            CaptureError: it answers, but not with a picture.
        """
        while not self._gone:
            try:
                exposure = self._camera.expose(exposure_time_s, start_utc_ns)
            except CameraLost as error:
                away_s = self._note_loss(error)
                self._gone = self.has_own_clock and away_s >= PATIENCE_S
                if not self.has_own_clock or self._gone or self._pause(RETRY_S):
                    self._exposures_lost += 1
                    raise
            except CaptureError:
                self._note_return()
                raise
            else:
                self._note_return()
                return exposure
        raise CameraLost("the camera was lost and did not come back")

    def reconnect(self) -> None:
        """Try once to reach a lost camera; `lost` says whether it answered."""
        if not self.lost:
            return
        try:
            self._camera.open()
        except CameraLost:
            return
        self._note_return()

    def open(self) -> None:
        self._camera.open()

    def close(self) -> None:
        self._camera.close()

    def _note_loss(self, error: CameraLost) -> float:
        """Return for how many seconds the camera has been away."""
        now_s = self._clock_s()
        if self._lost_since_s is None:
            self._lost_since_s, self._exposures_lost = now_s, 0
            self.losses += 1
            log.warning("the camera is lost, it is tried again every %g s: %s", RETRY_S, error)
        return now_s - self._lost_since_s

    def _note_return(self) -> None:
        if self._lost_since_s is not None:
            away_s = self._clock_s() - self._lost_since_s
            lost = counted(self._exposures_lost, "exposure")
            log.warning("the camera is back after %.1f s, %s lost", away_s, lost)
            self._lost_since_s = None
