"""The simulator's own record beside a session: true poses, radiance and surface, for evaluation only."""

import json
import shutil
from pathlib import Path

import numpy as np
import trimesh

from flightsw.icd.mission import Mission
from flightsw.pose import pose_tag
from hil.blender import RenderFarm

CLOUD_POINTS = 100_000


def write_truth(session: Path, mission: Mission, farm: RenderFarm, points: int = CLOUD_POINTS) -> None:
    """Write `session`/truth for the frames that reached the session; an existing truth folder is replaced.

    The cloud holds the surface points that at least one of those frames sees, of `points` spread evenly by area.
    """
    folder, part = session / "truth", session / "truth.part"
    shutil.rmtree(part, ignore_errors=True)
    (part / "radiance").mkdir(parents=True)
    entries, centres = [], {}
    for line in (session / "frames.jsonl").read_text().splitlines():
        record = json.loads(line)
        pose = pose_tag(mission, record["mid_exposure_utc_ns"])
        farm.radiance(pose)
        name = f"radiance/{record['id']:06d}.npz"
        shutil.copyfile(farm.path(pose), part / name)
        entries.append(
            {"id": record["id"], "world_to_camera": pose.world_to_camera.tolist(), "radiance": name}
        )
        centres.setdefault(
            record["bracket"], pose.position_body_m
        )  # a bracket's frames stand centimetres apart
    vertices, faces = farm.surface()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(part / "mesh.ply")
    sampled = trimesh.sample.sample_surface(mesh, points, seed=0)[0]
    seen = farm.visible(np.asarray(sampled), np.array(list(centres.values())))
    trimesh.PointCloud(np.asarray(sampled)[seen].astype(np.float32)).export(part / "cloud.ply")
    facts = {
        "frames": entries,
        "cloud": "cloud.ply",
        "mesh": "mesh.ply",
        "largest_dimension_m": float(np.ptp(vertices, axis=0).max()),
    }
    (part / "truth.json").write_text(json.dumps(facts))
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)
