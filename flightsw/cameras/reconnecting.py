"""A camera that may be lost and come back: one line when it goes, one when it is back, and counts of what it cost."""

import logging
import time
from collections.abc import Callable

from flightsw.cameras import Camera, Exposure
from flightsw.errors import CameraLost, CaptureError

log = logging.getLogger(__name__)
RETRY_S = 1.0  # between attempts to reach a lost camera
PATIENCE_S = 30.0  # for which a camera that waits for us is tried again before it counts as gone


class ReconnectingCamera:
    """Asks a lost camera again, and logs only when it goes and when it is back.

    A camera in our own time (`waits`) is tried at each exposure, and between them by `reconnect`: exposures go on at
    their times. The simulator's time waits for us, so the same exposure is asked for again, and nothing is lost if the
    camera comes back within `PATIENCE_S`; after that it counts as gone, and every further exposure fails at once.

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
    def waits(self) -> bool:
        return self._camera.waits

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
                self._gone = not self.waits and away_s >= PATIENCE_S
                if self.waits or self._gone or self._pause(RETRY_S):
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
        """Try once to reach a lost camera; whether it answers, `lost` says."""
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
            log.warning("the camera is back after %.1f s, %d exposures lost", away_s, self._exposures_lost)
            self._lost_since_s = None
