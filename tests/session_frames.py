"""What tests do with recorded sessions: send their frames down once more, or change them under a finished run."""

from pathlib import Path

import yaml

from flightsw.icd.frame import Frame, PoseTag
from ground.session.folder import Session


def frames_of(session: Session) -> list[Frame]:
    """Return the session's frames, in their order."""
    brackets = [record.bracket for record in session.frames]
    return [
        Frame(
            frame_id=r.id,
            bracket_id=r.bracket,
            bracket_index=r.bracket_index,
            bracket_count=brackets.count(r.bracket),
            exposure_time_s=r.exposure_time_s,
            mid_exposure_utc_ns=r.mid_exposure_utc_ns,
            pose=PoseTag(
                r.quat_body_to_camera,
                r.position_body_m,
                r.covariance,
                r.sun_dir_body,
                r.in_eclipse,
                r.pose_valid,
                quat_inertial_to_body=r.quat_inertial_to_body,
            ),
            dn=session.dn(r),
            bit_depth=r.bit_depth,
            black_dn=r.black_dn,
            saturated_count=r.saturated,
        )
        for r in session.frames
    ]


def forget_session_facts(run: Path) -> None:
    """Make a run's folder that of a version which did not note its session: else a changed session is refused."""
    config = run / "config.yaml"
    noted = yaml.safe_load(config.read_text())
    del noted["session"]
    config.write_text(yaml.safe_dump(noted))
