"""What flight will do if nothing fails: every exposure's time and true pose, so that the sky can be rendered ahead."""

from dataclasses import dataclass

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from flightsw.pose import pose_tag
from flightsw.sequencer import plan


@dataclass(frozen=True)
class TrueExposure:
    exposure_time_s: float
    mid_exposure_utc_ns: int
    pose: PoseTag


def true_exposures(mission: Mission) -> list[TrueExposure]:
    """Return the exposures that the mission's bracket section asks for, with the pose at each mid-exposure.

    The truth is the mission's own orbits and attitude; the simulator adds no navigation error of its own.
    """
    return [
        TrueExposure(
            shot.exposure_time_s, shot.mid_exposure_utc_ns, pose_tag(mission, shot.mid_exposure_utc_ns)
        )
        for shot in plan(mission)
    ]
