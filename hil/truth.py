"""The truth of a simulated session, from the renderer: true poses, radiance and the surface that the frames see."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from flightsw.navigation.pose import pose_tag
from ground.session import truth
from ground.session.folder import Session, open_session
from hil.sky.render_farm import RenderFarm
from hil.sky.sensor import through_lens

CLOUD_POINTS = 100_000
MAX_SAMPLES_PER_POINT = 10  # where less than a tenth of the surface is seen, the cloud stays smaller


def write_truth(
    folder: Path,
    mission: Mission,
    farm: RenderFarm,
    points: int = CLOUD_POINTS,
    pose_at: Callable[[int], PoseTag] | None = None,
    geometry: bool = False,
    simulation: dict[str, dict] | None = None,
) -> None:
    """Write the truth of a session's frames beside them (`ground.session.truth`); an existing truth folder is replaced.

    The cloud holds `points` surface points, even by area, that at least one of the session's brackets sees.

    Args:
        folder: the session's.
        pose_at: UTC ns to the true pose; by default the mission's own orbits and attitude.
        geometry: write each frame's depth and normals too.
        simulation: what was simulated, by part (camera, link, ...) and quantity, for the report.

    Raises:
        SessionError: the session cannot be read.
    """
    pose_at = pose_at or partial(pose_tag, mission)
    session = open_session(folder)
    # Frames of a bracket that are taken within a second are centimetres apart: one of them stands for all.
    tight = session.frame_spacing_s <= 1
    first_of_bracket = {record.bracket if tight else record.id: record for record in reversed(session.frames)}
    centres = [pose_at(record.mid_exposure_utc_ns).position_body_m for record in first_of_bracket.values()]
    vertices, faces = farm.surface()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    cloud = visible_points(farm, mesh, np.array(centres), points)
    truth.write_truth(folder, _frames(session, farm, pose_at, geometry), vertices, faces, cloud, simulation)


def _frames(
    session: Session, farm: RenderFarm, pose_at: Callable[[int], PoseTag], geometry: bool
) -> Iterator[truth.TrueFrame]:
    for record in session.frames:
        pose = pose_at(record.mid_exposure_utc_ns)
        yield truth.TrueFrame(
            record.id,
            pose.world_to_camera,
            through_lens(farm.radiance(pose), session.camera),
            farm.alpha(pose),
            *(farm.geometry(pose) if geometry else ()),
        )


def visible_points(farm: RenderFarm, mesh: trimesh.Trimesh, centres: np.ndarray, count: int) -> np.ndarray:
    """Return `count` points [count, 3], even by area over the part of the surface that the camera centres [M, 3] see.

    Fewer come back where less than a tenth of the surface is seen.
    """
    found, sampled = np.empty((0, 3)), 0
    while len(found) < count and sampled < MAX_SAMPLES_PER_POINT * count:
        points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=sampled)[0])
        found = np.concatenate([found, points[farm.visible(points, centres)]])
        sampled += count
    return found[:count]
