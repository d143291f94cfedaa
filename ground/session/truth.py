"""The truth folder of a simulated session: what it holds, how it is written, and how it is read.

Evaluation, report and benchmarks read it; training never does. Layout of `<session>/truth/`:

- truth.json: schema version, largest dimension, what was simulated, and for each frame its id, pose and files;
- radiance/000123.npz: `radiance` [H, W, C] float16, scene-linear, premultiplied by coverage, and `alpha` [H, W] uint8,
  255 where the target covers the whole pixel;
- geometry/000123.npz (not in every session): `depth` [H, W] float32, planar, m, inf where nothing is seen, and
  `normals` [H, W, 3] float16, unit vectors in body axes;
- mesh.ply: the target's surface, m, body frame; cloud.ply: points of the surface that the frames see, the same.

Arrays are NumPy's, so that a simulator needs nothing of the library in `obbgs_core`.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground.session.folder import FrameRecord, Session, SessionError
from obbgs_base.errors import in_words
from obbgs_base.ply import PlyError, read_ply, write_ply

GO_ON = "simulate the pass again, or move the folder away to go on without the truth"
SCHEMA_VERSION = 1  # sessions from before it was written have the same layout


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """What a simulator knows of one frame."""

    id: int
    world_to_camera: np.ndarray  # [4, 4] m, OpenCV axes
    radiance: np.ndarray  # [H, W, C] scene-linear, premultiplied by coverage
    alpha: np.ndarray  # [H, W] uint8, coverage by the target times 255
    depth: np.ndarray | None = None  # [H, W] planar, m, inf where nothing is seen
    normals: np.ndarray | None = None  # [H, W, 3] unit vectors, body axes; given together with the depth
    finer: np.ndarray | None = None  # [nH, nW, C] the radiance, of pixels n times as small


def write_truth(
    session: Path,
    frames: Iterable[TrueFrame],
    vertices_m: np.ndarray,
    faces: np.ndarray,
    cloud_m: np.ndarray,
    simulation: dict[str, dict] | None = None,
    largest_dimension_m: float | None = None,
) -> None:
    """Write the truth folder of a session whole; one that exists is replaced when the new one is complete.

    Args:
        session: the session's folder.
        frames: taken one by one, so that they need not fit into memory together.
        vertices_m, faces: [V, 3] body frame and [F, 3], the target's mesh.
        cloud_m: [N, 3] body frame, points on the surface that the frames see.
        simulation: what was simulated, by part (camera, link, ...) and quantity, for the report.
        largest_dimension_m: of the target; None: that of the mesh.

    Raises:
        OSError: the disk refuses.
    """
    folder, part = session / "truth", session / "truth.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    facts = {
        "schema_version": SCHEMA_VERSION,
        "frames": [_write_frame(part, frame) for frame in frames],
        "cloud": "cloud.ply",
        "mesh": "mesh.ply",
        "largest_dimension_m": largest_dimension_m or float(np.ptp(vertices_m, axis=0).max()),
        "simulation": simulation or {},
    }
    triangles = {"vertex_indices": np.asarray(faces, dtype=np.int32)}
    write_ply(part / "mesh.ply", {"vertex": _vertices(vertices_m), "face": triangles})
    write_ply(part / "cloud.ply", {"vertex": _vertices(cloud_m)})
    (part / "truth.json").write_text(json.dumps(facts))
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)


def _write_frame(folder: Path, frame: TrueFrame) -> dict[str, Any]:
    """Write a frame's arrays and return its entry in truth.json."""
    content = {
        "radiance": {"radiance": frame.radiance.astype(np.float16), "alpha": frame.alpha.astype(np.uint8)}
    }
    if frame.depth is not None and frame.normals is not None:
        content["geometry"] = {
            "depth": frame.depth.astype(np.float32),
            "normals": frame.normals.astype(np.float16),
        }
    if frame.finer is not None:
        content["finer"] = {"radiance": frame.finer.astype(np.float16)}
    entry = {"id": frame.id, "world_to_camera": frame.world_to_camera.tolist()}
    for kind, arrays in content.items():
        entry[kind] = f"{kind}/{frame.id:06d}.npz"
        (folder / kind).mkdir(exist_ok=True)
        np.savez_compressed(folder / entry[kind], **arrays)
    return entry


def _vertices(points_m: np.ndarray) -> dict[str, np.ndarray]:
    return {axis: np.asarray(points_m[:, column], dtype=np.float32) for column, axis in enumerate("xyz")}


class Truth:
    """The truth beside a session, read: `largest_dimension_m`, `cloud_m` [N, 3] and `simulation` as they were written.

    Where the target's axes were found from the frames, or chosen freely, poses and cloud are turned into those.

    Raises:
        SessionError: there is none, it is damaged, or a later version of this software wrote it.
    """

    def __init__(self, session: Session):
        self.folder = session.path / "truth"
        try:
            facts = json.loads((self.folder / "truth.json").read_text())
            version = int(facts.get("schema_version", SCHEMA_VERSION))
            if version > SCHEMA_VERSION:
                raise SessionError(
                    f"{self.folder} was written with schema version {version}; this software reads up to "
                    f"{SCHEMA_VERSION}: install a newer one"
                )
            self._radiance = {entry["id"]: Path(entry["radiance"]) for entry in facts["frames"]}
            self._finer = {entry["id"]: entry["finer"] for entry in facts["frames"] if "finer" in entry}
            self._poses = {
                entry["id"]: np.array(entry["world_to_camera"], dtype=float).reshape(4, 4)
                for entry in facts["frames"]
            }
            self.largest_dimension_m = float(facts["largest_dimension_m"])
            self.simulation: dict[str, dict] = facts.get("simulation", {})
            self.cloud_m = read_points(self.folder / facts["cloud"])
        except KeyError as error:
            raise SessionError(f"{self.folder} is damaged: truth.json has no {error}; {GO_ON}") from error
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise SessionError(f"{self.folder} is damaged: {in_words(error)}; {GO_ON}") from error
        if session.attitude_estimated or session.navigation.attitude == "rate_only":
            self._turn_to_axes_of(session)

    def _turn_to_axes_of(self, session: Session) -> None:
        """Give poses and cloud in the axes of the target that the session's poses are given in.

        Axes that were found, or chosen freely, may be any: the turn is the mean of those between true and given poses.
        """
        known = [r for r in session.frames if r.id in self._poses]
        if not known:
            self._require(session.frames[0])
        turns = sum(r.world_to_camera[:3, :3].T @ self._poses[r.id][:3, :3] for r in known)
        u, _, v = np.linalg.svd(np.asarray(turns))
        turn = np.eye(4)
        turn[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        self._poses = {number: pose @ turn.T for number, pose in self._poses.items()}
        self.cloud_m = self.cloud_m @ turn[:3, :3].T

    @staticmethod
    def exists(session: Session) -> bool:
        """Return whether a simulator left a truth folder beside the session."""
        return (session.path / "truth" / "truth.json").is_file()

    def posed(self, record: FrameRecord, motion: np.ndarray | None = None) -> FrameRecord:
        """Return a frame's record with its true pose in place of the received one.

        Args:
            motion: [4, 4] from the frame of the model to the true body frame, as in `Alignment`; None: they are one.

        Raises:
            SessionError: the truth has no such frame.
        """
        self._require(record)
        pose = self._poses[record.id]
        if motion is not None:  # a similarity's size makes the range larger instead
            pose = pose @ motion / np.array([[np.cbrt(np.linalg.det(motion[:3, :3]))] * 3 + [1.0]]).T
        return dataclasses.replace(record, world_to_camera=pose)

    def radiance(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray]:
        """Return a frame's scene-linear radiance [H, W, C] and coverage [H, W] in 0..1, both float32.

        Raises:
            SessionError: the truth has no such frame, or its file is missing or damaged.
        """
        self._require(record)
        arrays = self._arrays(self._radiance[record.id], "radiance", "alpha")
        return arrays[0].astype(np.float32), arrays[1].astype(np.float32) / 255

    def finer(self, record: FrameRecord) -> np.ndarray | None:
        """Return a frame's radiance [nH, nW, C], float32, of pixels n times as small; None where it is not known.

        Raises:
            SessionError: its file is missing or damaged.
        """
        file = self._finer.get(record.id)
        return None if file is None else self._arrays(Path(file), "radiance")[0].astype(np.float32)

    def _arrays(self, file: Path, *names: str) -> list[np.ndarray]:
        path = self.folder / file
        try:
            with open(path, "rb") as opened, np.load(opened) as arrays:
                return [arrays[name] for name in names]
        # errors of its zip archive, of zlib, or of NumPy's header: whichever the damage meets
        except Exception as error:
            raise SessionError(f"{path} is damaged: {error}; {GO_ON}") from error

    def _require(self, record: FrameRecord) -> None:
        if record.id not in self._poses:
            raise SessionError(f"{self.folder} holds no frame {record.id}: it is of another pass; {GO_ON}")


def read_points(path: Path) -> np.ndarray:
    """Return the vertices [N, 3] of a PLY file, float64.

    Raises:
        SessionError: the file is missing or damaged.
    """
    try:
        vertices = read_ply(path).tables["vertex"]
        return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (OSError, KeyError, PlyError) as error:
        raise SessionError(f"{path} is damaged: {in_words(error)}") from error
