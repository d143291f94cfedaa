"""A session as a COLMAP folder, which trainers of Gaussian splats read: images/ and a model in sparse/0.

It is a nerfstudio folder too, as nerfstudio's own ones are: transforms.json keeps what COLMAP has no place for.

Source: colmap.github.io/format.html.
"""

import struct
from pathlib import Path

import numpy as np

from flightsw.icd.quaternion import matrix_to_quat
from ground.formats.nerf import split_frames
from ground.formats.nerfstudio import export_nerfstudio
from ground.session.folder import Session
from obbgs_base.files import write_whole

PINHOLE = 1  # the number of COLMAP's camera model
POINTS = 10_000  # from which a trainer of Gaussian splats may start
GREY = (128, 128, 128)


def export_colmap(session: Session, out: Path, surface: np.ndarray | None = None) -> dict[str, int]:
    """Write a session as a COLMAP folder, frames and pictures as in `export_nerfstudio`; return the frames per split.

    Its test.txt names the pictures that are not for training, as for 3DGS.

    Args:
        surface: [P, 3] m, body frame, places on the target, of which at most POINTS become the model's points: grey,
            without the pictures that they were seen in. Without a surface the model has no points.
    """
    counts = export_nerfstudio(session, out)
    width, height = session.camera.width, session.camera.height
    camera_of: dict[tuple[float, ...], int] = {}
    split_of, images, held_out = split_frames(session), [], []
    for record in session.frames:
        if not record.pose_valid:  # as the export above has told
            continue
        K = session.camera.K if record.K is None else record.K.tolist()
        lens = (float(K[0][0]), float(K[1][1]), float(K[0][2]), float(K[1][2]))
        camera = camera_of.setdefault(lens, len(camera_of) + 1)
        name = f"frame_{record.id:06d}.png"
        quat = matrix_to_quat(record.world_to_camera[:3, :3])
        motion = (*quat, *record.world_to_camera[:3, 3])
        images.append(
            struct.pack("<i7di", record.id + 1, *motion, camera)
            + name.encode()
            + b"\0"
            + struct.pack("<Q", 0)
        )
        if split_of[record.id] != "train":
            held_out.append(f"{name}\n")
    cameras = [
        struct.pack("<iiQQ4d", number, PINHOLE, width, height, *lens) for lens, number in camera_of.items()
    ]
    model = out / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    places = np.empty((0, 3)) if surface is None else surface[:: max(1, -(-len(surface) // POINTS))]
    points = [
        struct.pack("<Q3d3BdQ", p + 1, *place, *GREY, 0.0, 0) for p, place in enumerate(places.tolist())
    ]
    for name, entries in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_whole(model / f"{name}.bin", struct.pack("<Q", len(entries)) + b"".join(entries))
    write_whole(model / "test.txt", "".join(held_out).encode())
    return {"train": counts["train"], "val": 0, "test": len(held_out)}
