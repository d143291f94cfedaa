"""Renders a mesh as the six targets were, in its own materials or in foil: NAME_400.npz for `tests.benchmarks.targets`.

Blender is needed. A Sun that stands still shines on 120 views, 40 on an inclined ring and 80 spread over the sphere;
under one that moves they are those of the scenario `tumbling`, from the same distance. What is rendered already is
kept, so that an interrupted run goes on. `--dense` adds 240 views between the 120, whose frames stay the same:

    python -m tests.benchmarks.rendered --materials foil --sun moving --out data spacecraft-foil
    OBBGS_TARGETS=data python -m tests.benchmarks.targets --sun --out sessions spacecraft-foil
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from flightsw.navigation.pose import look_along
from hil.sky import SHIPPED, SHIPPED_FOIL
from hil.sky.blender import Worker
from hil.world.scenario import Scene, load_scenario
from tests.benchmarks.targets import LARGEST_DIMENSION

VIEWS, ON_RING, RING_INCLINATION_DEG = 120, 40, 60
DISTANCE = 4.5  # of the camera from the target's centre, in the units of the data
FOCAL = 2.0  # focal length over the width of the picture
SUN = np.array([0.5, -0.35, 0.79]) / np.linalg.norm([0.5, -0.35, 0.79])
PASS_S = 3900  # of the scenario, all in sunlight
CLOUD = 20_000  # points on the surface, before those that no view shows are left out
SEEN_FROM = 60  # views that decide what is shown


def static_views(dense: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [V, 4, 4] (body to camera) all around the target, in random order, and Sun directions [V, 3].

    Args:
        dense: 240 more follow, on the same ring between its views and over the sphere turned.
    """
    turn = 2 * np.pi * np.arange(ON_RING) / ON_RING
    towards = _shuffled(_ring(turn), _sphere(VIEWS - ON_RING), seed=3)
    if dense:
        between = (turn[:, None] + 2 * np.pi / ON_RING * np.array([1, 2]) / 3).ravel()
        turned = _sphere(2 * (VIEWS - ON_RING)) @ Rotation.from_euler("xyz", [0.7, 1.1, 0.3]).as_matrix().T
        towards = np.concatenate([towards, _shuffled(_ring(between), turned, seed=4)])
    poses = np.tile(np.eye(4), (len(towards), 1, 1))
    for pose, direction in zip(poses, towards, strict=True):
        pose[:3, :3] = look_along(-direction, down=np.array([0.1, -0.3, 1.0]))
        pose[:3, 3] = -DISTANCE * pose[:3, :3] @ direction
    return poses, np.tile(SUN, (len(towards), 1))


def _ring(turn: np.ndarray) -> np.ndarray:
    tilt = np.radians(RING_INCLINATION_DEG)
    return np.stack([np.cos(turn), np.sin(turn) * np.cos(tilt), np.sin(turn) * np.sin(tilt)], axis=1)


def _sphere(count: int) -> np.ndarray:
    place = np.arange(count) + 0.5
    z, angle = 1 - 2 * place / count, np.pi * (1 + 5**0.5) * place
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _shuffled(ring: np.ndarray, sphere: np.ndarray, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).permutation(np.concatenate([ring, sphere]))


def moving_views(dense: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the same for views of the scenario `tumbling`, evenly over its pass.

    Args:
        dense: 240 more follow, at times between those.
    """
    scene, poses, suns = Scene(load_scenario("tumbling")), [], []
    share = (np.arange(VIEWS) + 0.5) / VIEWS
    shares = np.random.default_rng(3).permutation(share)
    if dense:
        between = (share[:, None] + np.array([-1, 1]) / (3 * VIEWS)).ravel()
        shares = np.concatenate([shares, np.random.default_rng(4).permutation(between)])
    for at in shares:
        state = scene.state(scene.orbit.start_utc_ns + round(at * PASS_S * 1e9))
        pose = np.array(state.pose.world_to_camera, dtype=float)
        pose[:3, 3] *= DISTANCE / np.linalg.norm(pose[:3, 3])
        poses.append(pose)
        suns.append(state.pose.sun_dir_body)
    return np.array(poses), np.array(suns)


def render(
    worker: Worker, views: tuple[np.ndarray, np.ndarray], size: int, kept: Path
) -> dict[str, np.ndarray]:
    """Return the arrays of a target; each picture is kept in a folder."""
    metres = worker.facts["largest_dimension_m"] / LARGEST_DIMENSION
    poses, suns = views
    K = np.array([[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1]])
    in_metres = poses.copy()
    in_metres[:, :3, 3] *= metres
    for number, (pose, sun) in enumerate(zip(in_metres, suns, strict=True)):
        path, part = kept / f"{number}.npz", kept / "part.npz"
        if not path.exists():
            ask_for_view(worker, pose, sun, K, size, 3, part)
            part.rename(path)
            print(f"{kept.name}: {number + 1} of {len(poses)}", flush=True)
    pictures = [np.load(kept / f"{number}.npz") for number in range(len(poses))]
    return {
        "radiance": np.stack([picture["radiance"] for picture in pictures]),
        "alpha": np.stack([picture["alpha"] for picture in pictures]),
        "world_to_camera": poses,
        "K": K,
        "sun_dir": suns if np.ptp(suns, axis=0).any() else suns[0],
        "cloud": (shown_points(worker, in_metres, kept) / metres).astype(np.float32),
    }


def ask_for_view(
    worker: Worker,
    pose: np.ndarray,
    sun: np.ndarray,
    K: np.ndarray,
    size: int,
    channels: int,
    out: Path,
    seed: int = 0,
) -> None:
    """Let a view in sunlight be written, see `render` in `hil/sky/blender_worker.py`.

    Args:
        pose: [4, 4] body to camera, m; sun: [3] towards the Sun, unit, body frame; K: [3, 3] px.
        size: pixels along a side.
        seed: of the light paths.
    """
    camera = {"world_to_camera": pose.tolist(), "K": K.tolist(), "width": size, "height": size}
    light = {"sun_dir_body": sun.tolist(), "in_eclipse": False}
    worker.ask(op="render", **camera, channels=channels, **light, out=str(out), seed=seed)


def shown_points(worker: Worker, poses: np.ndarray, kept: Path) -> np.ndarray:
    """Return points of the surface [M, 3] m that some of the views with poses [V, 4, 4] (m) see.

    Args:
        kept: folder for what Blender reads and writes.
    """
    worker.ask(op="surface", out=str(kept / "surface.npz"))
    with np.load(kept / "surface.npz") as surface:
        mesh = trimesh.Trimesh(surface["vertices"], surface["faces"], process=False)
    points = np.asarray(trimesh.sample.sample_surface(mesh, CLOUD, seed=0)[0])
    centres = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    np.savez(kept / "points.npz", points=points, centres=centres[:SEEN_FROM])
    worker.ask(op="visible", points=str(kept / "points.npz"), out=str(kept / "seen.npz"))
    with np.load(kept / "seen.npz") as seen:
        return points[seen["seen"]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", help="of the target that is written")
    parser.add_argument("--mesh", type=Path, help="default: the shipped spacecraft")
    parser.add_argument("--materials", choices=("own", "foil"), default="own")
    parser.add_argument("--sun", choices=("static", "moving"), default="static")
    parser.add_argument("--dense", action="store_true", help="three times the views")
    parser.add_argument("--size", type=int, default=400, help="pixels along a side")
    parser.add_argument("--out", type=Path, required=True, help="folder for NAME_400.npz")
    arguments = parser.parse_args()
    shipped = SHIPPED_FOIL if arguments.materials == "foil" else SHIPPED
    views = (static_views if arguments.sun == "static" else moving_views)(arguments.dense)
    kept = arguments.out / f"{arguments.name}-{arguments.materials}-{arguments.sun}-{arguments.size}"
    kept.mkdir(parents=True, exist_ok=True)
    worker = Worker(arguments.mesh or shipped, materials=arguments.materials)
    try:
        arrays = render(worker, views, arguments.size, kept)
    finally:
        worker.close()
    target = arguments.out / f"{arguments.name}_400.npz"
    np.savez_compressed(target, **arrays)
    print(target)


if __name__ == "__main__":
    main()
