"""Photographs of the Middlebury multi-view data as a nerfstudio folder, for `ground import --format nerfstudio`.

    python -m tests.benchmarks.temple --from templeRing --out sessions/templeRing-nerfstudio

The data: Seitz, Curless, Diebel, Scharstein, Szeliski, CVPR 2006. A line of NAME_par.txt is a picture's name, K, R and
t of K [R t], with the centre of the first pixel at (0, 0); here it is at (0.5, 0.5), as in nerfstudio.
"""

import argparse
import json
import shutil
from pathlib import Path

from ground.formats.axes import world_to_camera_to_opengl
from ground.formats.middlebury import read_middlebury


def convert(folder: Path, out: Path) -> int:
    """Write the pictures and transforms.json to `out` and return how many pictures there are."""
    views, frames = read_middlebury(folder), []
    out.mkdir(parents=True, exist_ok=True)
    for view in views:
        shutil.copyfile(view.image, out / view.image.name)
        lens = view.intrinsics
        frames.append(
            {
                "file_path": view.image.name,
                "w": lens.width,
                "h": lens.height,
                "fl_x": lens.fx_px,
                "fl_y": lens.fy_px,
                "cx": lens.cx_px,
                "cy": lens.cy_px,
                "transform_matrix": world_to_camera_to_opengl(view.world_to_camera).tolist(),
            }
        )
    tree = {"camera_model": "PINHOLE", "frames": frames}
    (out / "transforms.json").write_text(json.dumps(tree, indent=1) + "\n")
    return len(frames)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--from", dest="folder", type=Path, required=True, help="with NAME_par.txt")
    parser.add_argument("--out", type=Path, required=True, help="the folder to make")
    given = parser.parse_args()
    print(f"{given.out}: {convert(given.folder, given.out)} pictures")
