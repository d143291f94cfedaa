"""Photographs of the Middlebury multi-view data as a nerfstudio folder, for `ground import --format nerfstudio`.

    python -m tests.benchmarks.temple --from templeRing --out sessions/templeRing-nerfstudio

The data: Seitz, Curless, Diebel, Scharstein, Szeliski, CVPR 2006. A line of NAME_par.txt is a picture's name, K, R and
t of K [R t], with the centre of the first pixel at (0, 0); here it is at (0.5, 0.5), as in nerfstudio.
"""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera axes: y up, looking along -z


def convert(folder: Path, out: Path) -> int:
    """Write the pictures and transforms.json to `out` and return how many pictures there are."""
    (stated,) = folder.glob("*_par.txt")
    out.mkdir(parents=True, exist_ok=True)
    frames = []
    for line in stated.read_text().splitlines()[1:]:
        name, *numbers = line.split()
        values = np.array(numbers, float)
        K, world_to_camera = values[:9].reshape(3, 3), np.eye(4)
        world_to_camera[:3, :3], world_to_camera[:3, 3] = values[9:18].reshape(3, 3), values[18:]
        shutil.copyfile(folder / name, out / name)
        frames.append(
            {
                "file_path": name,
                "fl_x": K[0, 0],
                "fl_y": K[1, 1],
                "cx": K[0, 2] + 0.5,
                "cy": K[1, 2] + 0.5,
                "transform_matrix": (np.linalg.inv(world_to_camera) @ OPENGL_AXES).tolist(),
            }
        )
    size = {"w": 640, "h": 480}
    (out / "transforms.json").write_text(
        json.dumps({"camera_model": "PINHOLE", **size, "frames": frames}) + "\n"
    )
    return len(frames)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--from", dest="folder", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    print(f"{given.out}: {convert(given.folder, given.out)} pictures")
