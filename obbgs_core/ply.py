"""Gaussians as a standard 3DGS PLY: other viewers show it, and reading it back is exact."""

import os
from pathlib import Path

import numpy as np
import torch

from obbgs_core import sh
from obbgs_core.errors import ReconstructionError
from obbgs_core.gaussians import Gaussians

DISPLAY_GAMMA = 2.2


def save_ply(gaussians: Gaussians, path: Path, white_radiance: float = 1.0) -> None:
    """Write the model; the file appears whole or not at all.

    f_dc holds what a viewer shows: radiance over `white_radiance`, gamma 2.2, clipped. The scene-linear coefficients
    follow as radiance_sh_*, which viewers ignore and `load_ply` reads.
    """
    count, coefficients, channels = gaussians.sh.shape
    shown = sh.radiance(gaussians.sh[:, :1], torch.zeros(count, 3)).expand(-1, 3) / white_radiance
    f_dc = (shown.clamp(0, 1) ** (1 / DISPLAY_GAMMA) - 0.5) / sh.C0
    columns: dict[str, torch.Tensor] = {}
    for i, axis in enumerate("xyz"):
        columns[axis] = gaussians.means[:, i]
    for axis in ("nx", "ny", "nz"):
        columns[axis] = torch.zeros(count)
    for i in range(3):
        columns[f"f_dc_{i}"] = f_dc[:, i]
    columns["opacity"] = gaussians.opacity_logits
    for i in range(3):
        columns[f"scale_{i}"] = gaussians.log_scales[:, i]
    for i in range(4):
        columns[f"rot_{i}"] = gaussians.quats[:, i]
    for k in range(coefficients):
        for c in range(channels):
            columns[f"radiance_sh_{k}_{c}"] = gaussians.sh[:, k, c]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in columns] + ["end_header\n"]
    table = torch.stack(list(columns.values()), dim=1).detach().cpu().numpy().astype("<f4")
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        file.write("\n".join(header).encode("ascii") + table.tobytes())
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def load_ply(path: Path) -> Gaussians:
    """Return the model in a PLY that `save_ply` wrote.

    Raises:
        ReconstructionError: not such a file, or cut off.
    """
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    counts = [int(line.split()[-1]) for line in lines if line.startswith("element vertex ")]
    if not mark or not data.startswith(b"ply\n") or len(counts) != 1 or "radiance_sh_0_0" not in names:
        raise ReconstructionError(f"{path} is not a model written by this software")
    if len(body) != 4 * counts[0] * len(names):
        raise ReconstructionError(
            f"{path} should hold {4 * counts[0] * len(names)} bytes of numbers, has {len(body)}"
        )
    table = dict(
        zip(names, torch.from_numpy(np.frombuffer(body, "<f4").reshape(-1, len(names)).T.copy()), strict=True)
    )
    radiance = [name for name in names if name.startswith("radiance_sh_")]
    channels = 1 + max(int(name.split("_")[3]) for name in radiance)
    return Gaussians(
        means=torch.stack([table[a] for a in "xyz"], 1),
        quats=torch.stack([table[f"rot_{i}"] for i in range(4)], 1),
        log_scales=torch.stack([table[f"scale_{i}"] for i in range(3)], 1),
        opacity_logits=table["opacity"],
        sh=torch.stack([table[name] for name in radiance], 1).reshape(counts[0], -1, channels),
    )
