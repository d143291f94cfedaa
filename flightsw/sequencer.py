"""Plan, expose, tag, store: the capture sequence. Given times, it owns no clock; one bad frame never ends the pass."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from flightsw.cameras import Camera
from flightsw.errors import FlightError
from flightsw.icd.frame import Frame
from flightsw.icd.mission import Mission
from flightsw.pose import pose_tag
from flightsw.store import FrameStore

log = logging.getLogger(__name__)
NS = 1_000_000_000


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
    in_eclipse: int = 0
    pose_invalid: int = 0


def plan(mission: Mission) -> Iterator[Shot]:
    """Yield the pass's exposures: brackets `interval_s` apart, their frames `frame_spacing_s` apart, shortest first."""
    bracket = mission.bracket
    times_s = sorted(bracket.exposure_times_s)
    for bracket_id in range(bracket.count):
        trigger_ns = mission.orbit.start_utc_ns + round(bracket_id * bracket.interval_s * NS)
        for index, exposure_time_s in enumerate(times_s):
            start_ns = trigger_ns + round(index * bracket.frame_spacing_s * NS)
            yield Shot(bracket_id, index, len(times_s), exposure_time_s, start_ns)


def capture(
    mission: Mission,
    camera: Camera,
    store: FrameStore,
    on_frame: Callable[[CaptureCounts], None] = lambda counts: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> CaptureCounts:
    """Take every planned exposure that the store does not hold yet, and return the counts.

    Raises:
        StoreError: the disk refuses; without a store there is no capture.
    """
    counts = CaptureCounts()
    for shot in plan(mission):
        if should_stop():
            break
        counts.planned += 1
        if store.holds(shot.bracket_id, shot.bracket_index):
            counts.already_stored += 1
        else:
            try:
                frame = expose(mission, camera, shot, store.next_frame_id)
            except FlightError as error:
                counts.failed += 1
                log.warning("bracket %d frame %d lost: %s", shot.bracket_id, shot.bracket_index, error)
            else:
                store.put(frame, roi_mask=region_of_interest(frame.dn, mission))
                counts.stored += 1
                counts.in_eclipse += frame.pose.in_eclipse
                counts.pose_invalid += not frame.pose.valid
        on_frame(counts)
    return counts


def expose(mission: Mission, camera: Camera, shot: Shot, frame_id: int) -> Frame:
    """Return one exposure with its tag.

    Raises:
        FlightError: the camera or the orbit failed.
    """
    exposure = camera.expose(shot.exposure_time_s, shot.start_utc_ns)
    return Frame(
        frame_id=frame_id,
        bracket_id=shot.bracket_id,
        bracket_index=shot.bracket_index,
        bracket_count=shot.bracket_count,
        exposure_time_s=exposure.exposure_time_s,
        mid_exposure_utc_ns=exposure.mid_exposure_utc_ns,
        pose=pose_tag(mission, exposure.mid_exposure_utc_ns),
        dn=exposure.dn,
        bit_depth=mission.camera.bit_depth,
        black_dn=mission.camera.black_dn,
        saturated_count=int((exposure.dn >= mission.camera.white_dn).sum()),
    )


def region_of_interest(dn: np.ndarray, mission: Mission) -> np.ndarray:
    """Return the mask [H, W] of pixels worth sending: near anything `roi_sigma` above black in a 3x3 mean.

    Outside it the frame carries the black level, which compresses to nothing.
    """
    camera, link = mission.camera, mission.link
    brightness = dn.astype(np.float32).reshape(*dn.shape[:2], -1).mean(axis=2)
    noise_dn = np.hypot(camera.read_noise_dn, 0.3) / 3  # of a 3x3 mean; 0.3 DN is the rounding
    bright = _box_sum(brightness - camera.black_dn, 1) / 9 > link.roi_sigma * noise_dn
    return _box_sum(bright.astype(np.float32), link.roi_margin_px) > 0.5


def _box_sum(image: np.ndarray, radius_px: int) -> np.ndarray:
    """Return the sum over a square window around each pixel, zero outside the image."""
    size = 2 * radius_px + 1
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (radius_px + 1, radius_px)
        total = np.cumsum(np.pad(image, pad), axis=axis, dtype=np.float64)
        upper, lower = [slice(None)] * 2, [slice(None)] * 2
        upper[axis], lower[axis] = slice(size, None), slice(None, -size)
        image = total[tuple(upper)] - total[tuple(lower)]
    return image
