"""Splats as glTF: against the specification's own formulas, another program's file, and Khronos' validator."""

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from obbgs_core.errors import ExportError
from obbgs_core.io.gltf_splats import EXTENSION, save_gltf_splats
from obbgs_core.io.ply import save_ply
from obbgs_core.model import sh
from obbgs_core.model.gaussians import Gaussians
from tests import ply_by_trimesh, readers, scenes

WHITE_RADIANCE = 2.0
BODY_TO_GLTF = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up, as the node of model.glb
DTYPES = {5121: np.uint8, 5123: np.uint16, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Return a GLB's JSON, and the arrays [N, ...] of its only primitive."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    text_bytes, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and text_bytes % 4 == 0
    tree = json.loads(data[20 : 20 + text_bytes])
    content = data[28 + text_bytes :]
    arrays = {}
    for name, index in tree["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = tree["accessors"][index]
        view = tree["bufferViews"][accessor["bufferView"]]
        values = np.frombuffer(
            content, DTYPES[accessor["componentType"]], offset=view["byteOffset"], count=-1
        )
        width = WIDTHS[accessor["type"]]
        values = values[: accessor["count"] * width].reshape(-1, width)
        arrays[name.removeprefix(f"{EXTENSION}:")] = (
            values / np.iinfo(values.dtype).max if accessor.get("normalized") else values.astype(float)
        )
    return tree, arrays


def covariances(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Return R S Sᵀ Rᵀ [N, 3, 3] m², as the specification has it."""
    half = Rotation.from_quat(arrays["ROTATION"]).as_matrix() * arrays["SCALE"][:, None, :]
    return half @ half.transpose(0, 2, 1)


def colours(arrays: dict[str, np.ndarray], direction: np.ndarray) -> np.ndarray:
    """Return what splats show [N, 3] along a unit direction, by the table of the specification, degrees 0 to 3."""
    x, y, z = direction
    basis = {
        (0, 0): 0.2820947917738781,
        (1, 0): -0.4886025119029199 * y,
        (1, 1): 0.4886025119029199 * z,
        (1, 2): -0.4886025119029199 * x,
        (2, 0): 1.092548430592079 * x * y,
        (2, 1): -1.092548430592079 * y * z,
        (2, 2): 0.3153915652525200 * (2 * z * z - x * x - y * y),
        (2, 3): -1.092548430592079 * x * z,
        (2, 4): 0.5462742152960395 * (x * x - y * y),
        (3, 0): -0.5900435899266435 * y * (3 * x * x - y * y),
        (3, 1): 2.890611442640554 * x * y * z,
        (3, 2): -0.4570457994644657 * y * (4 * z * z - x * x - y * y),
        (3, 3): 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        (3, 4): -0.4570457994644657 * x * (4 * z * z - x * x - y * y),
        (3, 5): 1.445305721320277 * z * (x * x - y * y),
        (3, 6): -0.5900435899266435 * x * (x * x - 3 * y * y),
    }
    names = {f"SH_DEGREE_{degree}_COEF_{k}": value for (degree, k), value in basis.items()}
    return 0.5 + sum(value * arrays[name] for name, value in names.items() if name in arrays)


def model(sh_count: int = 16, channels: int = 3) -> Gaussians:
    made = scenes.random_gaussians(50, sh_count, channels)
    return dataclasses.replace(made, sh=torch.cat([made.sh[:, :1].abs(), 0.1 * made.sh[:, 1:]], dim=1))


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (4, 3), (9, 1), (16, 3)])
def test_the_file_holds_the_model_with_its_z_axis_up(tmp_path, sh_count, channels):
    gaussians = model(sh_count, channels)
    save_gltf_splats(gaussians, tmp_path / "splats.glb", WHITE_RADIANCE)
    tree, arrays = read(tmp_path / "splats.glb")
    assert tree["meshes"][0]["extras"]["white_radiance"] == WHITE_RADIANCE
    assert len([name for name in arrays if name.startswith("SH_")]) == sh_count
    np.testing.assert_allclose(arrays["POSITION"], gaussians.means.numpy() @ BODY_TO_GLTF.T, rtol=1e-6)
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    np.testing.assert_array_equal(accessor["min"], arrays["POSITION"].min(axis=0))
    np.testing.assert_array_equal(accessor["max"], arrays["POSITION"].max(axis=0))
    np.testing.assert_allclose(np.linalg.norm(arrays["ROTATION"], axis=1), 1, atol=1e-6)
    ours = BODY_TO_GLTF @ gaussians.covariances().double().numpy() @ BODY_TO_GLTF.T
    np.testing.assert_allclose(covariances(arrays), ours, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(arrays["OPACITY"][:, 0], gaussians.opacities.numpy(), rtol=1e-6)
    np.testing.assert_allclose(arrays["COLOR_0"][:, 3], gaussians.opacities.numpy(), atol=1 / 65535)
    display = {}
    save_ply(gaussians, tmp_path / "model.ply", WHITE_RADIANCE)
    table = ply_by_trimesh.read(tmp_path / "model.ply")
    for k in range(sh_count):
        names = [f"f_dc_{c}" if k == 0 else f"f_rest_{c * (sh_count - 1) + k - 1}" for c in range(3)]
        display[k] = np.stack([table[name] for name in names], axis=1)
    for direction in Rotation.random(5, rng=np.random.default_rng(3)).as_matrix()[:, 0]:
        basis = sh.sh_basis(torch.from_numpy(direction)[None].float(), sh_count)[0].numpy()
        expected = 0.5 + sum(basis[k] * display[k] for k in range(sh_count))
        np.testing.assert_allclose(colours(arrays, BODY_TO_GLTF @ direction), expected, atol=2e-5)


@pytest.mark.parametrize("sh_count", [1, 4, 16])
def test_another_program_s_file_of_our_ply_shows_the_same_splats(tmp_path, sh_count):
    """PlayCanvas' splat-transform, which turns a PLY by 180 degrees about z."""
    programs, gaussians = readers.installed(), model(sh_count)
    save_gltf_splats(gaussians, tmp_path / "ours.glb", WHITE_RADIANCE)
    save_ply(gaussians, tmp_path / "model.ply", WHITE_RADIANCE)
    readers.splat_transform(programs, tmp_path / "model.ply", tmp_path / "theirs.glb")
    (ours_tree, ours), (theirs_tree, theirs) = (read(tmp_path / f"{who}.glb") for who in ("ours", "theirs"))
    assert ours_tree["extensionsUsed"] == theirs_tree["extensionsUsed"] == [EXTENSION]
    ours_part, theirs_part = (
        tree["meshes"][0]["primitives"][0]["extensions"][EXTENSION] for tree in (ours_tree, theirs_tree)
    )
    assert ours_part.items() <= theirs_part.items()  # they write the defaults too
    assert ours.keys() == theirs.keys()
    turn = np.diag([-1.0, -1.0, 1.0]) @ BODY_TO_GLTF.T  # from our axes to theirs
    order = [np.lexsort(np.round(points, 4).T) for points in (ours["POSITION"] @ turn.T, theirs["POSITION"])]
    ours, theirs = (
        {name: a[index] for name, a in arrays.items()}
        for arrays, index in zip((ours, theirs), order, strict=True)
    )
    np.testing.assert_allclose(ours["POSITION"] @ turn.T, theirs["POSITION"], atol=1e-5)
    np.testing.assert_allclose(turn @ covariances(ours) @ turn.T, covariances(theirs), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(ours["OPACITY"], theirs["OPACITY"], atol=1e-6)
    for direction in Rotation.random(5, rng=np.random.default_rng(4)).as_matrix()[:, 0]:
        np.testing.assert_allclose(colours(ours, direction), colours(theirs, turn @ direction), atol=1e-4)


def test_khronos_own_validator_finds_fault_only_with_names_that_it_does_not_know(tmp_path):
    """It does not know the extension; with its names replaced by an application's own it has nothing to say."""
    programs, path = readers.installed(), tmp_path / "splats.glb"
    save_gltf_splats(model(), path, WHITE_RADIANCE)
    codes = {message["code"] for message in readers.gltf_issues(programs, path)["messages"]}
    assert codes <= {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    plain = path.read_bytes().replace(f'"{EXTENSION}:'.encode(), b'"_' + b"X" * len(EXTENSION))
    plain = plain.replace(f'"extensionsUsed":["{EXTENSION}"],'.encode(), b" " * (len(EXTENSION) + 22))
    start = plain.index(b'"extensions":{')
    end = plain.index(b"}}", start) + 2
    path.write_bytes(plain[:start] + b'"extras":{}' + b" " * (end - start - 11) + plain[end:])
    assert readers.gltf_issues(programs, path)["messages"] == []


def test_what_cannot_be_drawn_is_not_written(tmp_path):
    good = model(1)
    means = good.means.clone()
    means[3, 1] = torch.nan
    for gaussians, white, told in (
        (good.select(torch.arange(0)), 1.0, "no Gaussian"),
        (dataclasses.replace(good, means=means), 1.0, "means holds values that are not finite"),
        (good, 0.0, "white_radiance must be a positive radiance, got 0.0"),
    ):
        with pytest.raises(ExportError, match=told):
            save_gltf_splats(gaussians, tmp_path / "splats.glb", white)
    assert list(tmp_path.iterdir()) == []
