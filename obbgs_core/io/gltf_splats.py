"""The model's splats as binary glTF with the extension KHR_gaussian_splatting, beside the mesh of `mesh`.

glTF has its y axis up: positions, rotations and harmonics are turned so that the body's z axis points upwards, where
the node of `model.glb` turns its mesh to. Colours are the display colours of `ply`, and opacities are made for viewers
that widen by 0.3 px² and keep the peak, as there; software that does not know the extension shows coloured points. What
turns display colours back into radiance stands in the `extras` of the mesh.

Source: Khronos Group, KHR_gaussian_splatting, 2026.
"""

import json
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from obbgs_base.files import write_whole
from obbgs_core.io.mesh import Z_UP_TO_Y_UP
from obbgs_core.io.ply import DISPLAY_GAMMA, display_sh, require_writable, viewer_logits
from obbgs_core.model import sh
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import from_rotation_vectors, multiply, unit
from obbgs_core.render import lit_from

EXTENSION = "KHR_gaussian_splatting"
FLOAT, USHORT, ARRAY_BUFFER, POINTS = 5126, 5123, 34962, 0  # glTF's numbers
TURN = from_rotation_vectors(torch.tensor([-torch.pi / 2, 0, 0]))  # the rotation of Z_UP_TO_Y_UP


def save_gltf_splats(
    gaussians: Gaussians,
    path: Path,
    white_radiance: float = 1.0,
    sun_dir: Tensor | None = None,
    cameras: Cameras | None = None,
) -> None:
    """Write the model as one GLB file; it appears whole or not at all.

    Args:
        white_radiance: the radiance that viewers show as white.
        sun_dir: [3] unit, body frame, towards the Sun: what viewers show, if the radiance depends on it.
        cameras: from which opacities are made for viewers that keep peaks; None: they are the model's own.

    Raises:
        ValueError: the radiance depends on the Sun's direction, and sun_dir is not given.
        ExportError: the model is empty or not finite.
    """
    gaussians = gaussians.detach()
    require_writable(gaussians, white_radiance)
    for_viewers = viewer_logits(gaussians, cameras)
    turn = torch.from_numpy(Z_UP_TO_Y_UP[:3, :3]).float()
    shown = _turned(display_sh(lit_from(gaussians, sun_dir), white_radiance), turn)
    opacities = gaussians.opacities if for_viewers is None else torch.sigmoid(for_viewers)
    rotations = unit(multiply(TURN, unit(gaussians.quats)))
    attributes = {
        "POSITION": gaussians.means @ turn.T,
        f"{EXTENSION}:ROTATION": rotations[:, [1, 2, 3, 0]],  # glTF's order is x, y, z, w
        f"{EXTENSION}:SCALE": gaussians.log_scales.exp(),
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    for k in range(shown.shape[1]):
        degree = int(k**0.5)
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = shown[:, k]
    arrays = {name: values.numpy().astype("<f4") for name, values in attributes.items()}
    diffuse = (0.5 + sh.C0 * shown[:, 0]).clamp(0, 1) ** DISPLAY_GAMMA  # of points COLOR_0 is linear
    colours = torch.cat([diffuse, opacities[:, None]], dim=1)
    arrays["COLOR_0"] = np.round(65535 * colours.numpy()).astype("<u2")
    extras = {"white_radiance": float(white_radiance), "display_gamma": DISPLAY_GAMMA}
    write_whole(path, _glb(arrays, extras))


def _turned(coefficients: Tensor, rotation: Tensor) -> Tensor:
    """Return the coefficients [N, K, 3] of the same colours in axes that a rotation [3, 3] turns the old ones to."""
    directions, to_coefficients = sh.fit(coefficients.shape[1])  # exact: each degree turns into itself
    colours = torch.einsum(
        "dk,nkc->ndc", sh.sh_basis(directions @ rotation, coefficients.shape[1]), coefficients
    )
    return torch.einsum("kd,ndc->nkc", to_coefficients, colours)


def _glb(arrays: dict[str, np.ndarray], extras: dict) -> bytes:
    """Return a file with one node of splats; arrays [N, 1 to 4], each of 4 bytes or 8 an element, by attribute."""
    views, accessors, content = [], [], b""
    for name, values in arrays.items():
        kind = "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}"
        accessor = {
            "bufferView": len(views),
            "componentType": FLOAT if values.dtype.kind == "f" else USHORT,
            "count": len(values),
            "type": kind,
        }
        if values.dtype.kind == "u":
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        data = values.tobytes()
        views.append(
            {"buffer": 0, "byteOffset": len(content), "byteLength": len(data), "target": ARRAY_BUFFER}
        )
        accessors.append(accessor)
        content += data
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "attributes": {name: i for i, name in enumerate(arrays)},
        "mode": POINTS,
        "extensions": {EXTENSION: splats},
    }
    tree = {
        "asset": {"version": "2.0", "generator": "obbgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "target", "mesh": 0}],
        "meshes": [{"name": "target", "primitives": [primitive], "extras": extras}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(content), b"BIN\0") + content  # every array is a multiple of 4 bytes
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
