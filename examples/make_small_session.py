"""Makes examples/small_session from a finished demo: python examples/make_small_session.py demo/session

Every second bracket, each picture averaged over 4x4 pixels, with the true poses in place of the tags, which err: a
session of some 200 kB that trains in seconds. It has no truth folder, as a real pass has none.
"""

import dataclasses
import hashlib
import json
import shutil
import sys
from pathlib import Path

import imagecodecs
import numpy as np

from flightsw.icd.quaternion import matrix_to_quat
from ground.session.folder import open_session
from ground.session.truth import Truth

OUT = Path(__file__).with_name("small_session")
BINNED = 4  # pixels along a side
EVERY = 1  # bracket
DIGITS = 7  # kept of a pose: a thousandth of a pixel is far more than it needs


def main(demo: Path, out: Path = OUT) -> None:
    session = open_session(demo)
    truth, camera = Truth(session), session.camera
    shutil.rmtree(out, ignore_errors=True)
    (out / "frames").mkdir(parents=True)
    index = {
        json.loads(line)["id"]: json.loads(line) for line in (demo / "frames.jsonl").read_text().splitlines()
    }
    lines = []
    for record in session.frames:
        if record.bracket % EVERY:
            continue
        dn = session.dn(record).reshape(camera.height // BINNED, BINNED, camera.width // BINNED, BINNED)
        dn = dn.mean(axis=(1, 3)).round().astype(np.uint16)
        picture = bytes(imagecodecs.png_encode(dn, level=9))
        number = len(lines)
        file = f"frames/{number:06d}.png"
        (out / file).write_bytes(picture)
        pose = truth.posed(record).world_to_camera
        line = index[record.id] | {
            "id": number,
            "bracket": record.bracket // EVERY,
            "world_to_camera": rounded(pose),
            "quat_body_to_camera": rounded(matrix_to_quat(pose[:3, :3])),
            "position_body_m": rounded(-pose[:3, :3].T @ pose[:3, 3]),
            "covariance": np.zeros((6, 6)).tolist(),
            "sun_dir_body": rounded(record.sun_dir_body),
            "saturated": int((dn >= camera.white_dn).sum()),
            "file": file,
            "sha256": hashlib.sha256(picture).hexdigest(),
        }
        line.pop("quat_inertial_to_body", None)
        lines.append(json.dumps(line))
    (out / "frames.jsonl").write_text("\n".join(lines) + "\n")
    pixels = BINNED**2
    small = dataclasses.replace(
        camera,
        width=camera.width // BINNED,
        height=camera.height // BINNED,
        fx_px=camera.fx_px / BINNED,
        fy_px=camera.fy_px / BINNED,
        cx_px=camera.cx_px / BINNED,
        cy_px=camera.cy_px / BINNED,
        electrons_per_dn=camera.electrons_per_dn * pixels,
        read_noise_dn=float(np.hypot(camera.read_noise_dn / BINNED, np.sqrt(1 / 12))),  # and rounding
        psf_sigma_px=None if camera.psf_sigma_px is None else camera.psf_sigma_px / BINNED,
    )
    header = json.loads((demo / "session.json").read_text())
    kept = {key: header[key] for key in ("schema_version", "mission_sha256", "tles", "losses", "created_utc")}
    size = sum(path.stat().st_size for path in (out / "frames").iterdir())
    facts = {"camera": dataclasses.asdict(small), "frames_received": len(lines), "bytes_received": size}
    (out / "session.json").write_text(json.dumps(kept | facts, indent=2) + "\n")
    print(f"{out}: {len(lines)} frames, {size + (out / 'frames.jsonl').stat().st_size:,} bytes")


def rounded(values: np.ndarray) -> list:
    return np.round(values, DIGITS).tolist()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
