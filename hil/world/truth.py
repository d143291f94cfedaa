"""The simulator's own record beside a session: true poses, radiance and surface, for evaluation only."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from flightsw.pose import pose_tag
from hil.sky.blender import RenderFarm

CLOUD_POINTS = 100_000
LARGEST_SAMPLE = 10  # times the points wanted: a target whose inside is a tenth outside is given up on


def write_truth(
    session: Path,
    mission: Mission,
    farm: RenderFarm,
    points: int = CLOUD_POINTS,
    pose_at: Callable[[int], PoseTag] | None = None,
    geometry: bool = False,
    simulation: dict[str, dict] | None = None,
) -> None:
    """Write `session`/truth for the frames that reached the session; an existing truth folder is replaced.

    The cloud holds `points` surface points, even by area, that at least one of those frames' brackets sees. A frame's
    radiance file also holds its mask, as coverage (`alpha`).

    Args:
        pose_at: UTC ns to the true pose; by default the mission's own orbits and attitude.
        geometry: write each frame's depth (planar, m, inf for nothing) and normals (body axes) too.
        simulation: what was simulated, by part (camera, link, ...) and quantity, for the report.
    """
    pose_at = pose_at or (lambda utc_ns: pose_tag(mission, utc_ns))
    folder, part = session / "truth", session / "truth.part"
    shutil.rmtree(part, ignore_errors=True)
    (part / "radiance").mkdir(parents=True)
    if geometry:
        (part / "geometry").mkdir()
    entries, centres = [], {}
    for line in (session / "frames.jsonl").read_text().splitlines():
        record = json.loads(line)
        pose = pose_at(record["mid_exposure_utc_ns"])
        name = f"{record['id']:06d}.npz"
        farm.radiance(pose)
        shutil.copyfile(farm.path(pose), part / "radiance" / name)
        entry = {
            "id": record["id"],
            "world_to_camera": pose.world_to_camera.tolist(),
            "radiance": f"radiance/{name}",
        }
        if geometry:
            farm.geometry(pose)
            shutil.copyfile(farm.path(pose, "geometry"), part / "geometry" / name)
            entry["geometry"] = f"geometry/{name}"
        entries.append(entry)
        centres.setdefault(
            record["bracket"], pose.position_body_m
        )  # a bracket's frames stand centimetres apart
    vertices, faces = farm.surface()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(part / "mesh.ply")
    cloud = visible_points(farm, mesh, np.array(list(centres.values())), points)
    trimesh.PointCloud(cloud.astype(np.float32)).export(part / "cloud.ply")
    facts = {
        "frames": entries,
        "cloud": "cloud.ply",
        "mesh": "mesh.ply",
        "largest_dimension_m": float(np.ptp(vertices, axis=0).max()),
        "simulation": simulation or {},
    }
    (part / "truth.json").write_text(json.dumps(facts))
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)


def visible_points(farm: RenderFarm, mesh: trimesh.Trimesh, centres: np.ndarray, count: int) -> np.ndarray:
    """Return `count` points [count, 3], even by area over what the camera centres [M, 3] see of the surface.

    Fewer come back where less than a tenth of the surface is seen.
    """
    found, sampled = np.empty((0, 3)), 0
    while len(found) < count and sampled < LARGEST_SAMPLE * count:
        points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=sampled)[0])
        found = np.concatenate([found, points[farm.visible(points, centres)]])
        sampled += count
    return found[:count]
