"""Model files that other tools wrote again: the same model comes back, or the file is refused."""

import contextlib
import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_base.ply import PlyError, read_ply, write_ply
from obbgs_core.errors import ReconstructionError
from obbgs_core.io.ply import load_ply, save_ply
from obbgs_core.model.gaussians import Gaussians
from tests import ply_by_trimesh

PLAIN = Gaussians(
    torch.randn(12, 3, generator=torch.Generator().manual_seed(0)),
    torch.randn(12, 4, generator=torch.Generator().manual_seed(1)),
    torch.full((12, 3), -2.5),
    torch.randn(12, generator=torch.Generator().manual_seed(2)),
    torch.randn(12, 16, 3, generator=torch.Generator().manual_seed(3)),
)
MODELS = {
    "plain": PLAIN,
    "footprint": dataclasses.replace(PLAIN, footprint="camera", psf_sigma_px=torch.tensor(0.4375)),
    "albedo": dataclasses.replace(
        PLAIN, sh=PLAIN.sh[:, :1], shading="lambert", ambient=torch.tensor(0.1, dtype=torch.float32)
    ),
    "highlights": dataclasses.replace(
        PLAIN,
        sh=PLAIN.sh[:, :1, :1],
        lobes=torch.zeros(12, 1),
        gloss=torch.tensor([-1.1, -0.7]),
        static_sun=torch.tensor([0.0, 0.6, 0.8]),
    ),
}


def rows_of(model: Gaussians, path) -> np.ndarray:
    save_ply(model, path, sun_dir=torch.tensor([0.0, 0.0, 1.0]))
    return ply_by_trimesh.read(path)


def write_rows(path, rows: np.ndarray, names: list[str], order: str = "<", kind: str = "f4") -> None:
    """Write columns in an order of their own, as another tool would; no comments."""
    formats = {"<": "binary_little_endian", ">": "binary_big_endian", "a": "ascii"}
    types = {"f4": "float", "f8": "double"}
    header = ["ply", f"format {formats[order]} 1.0", f"element vertex {len(rows)}"]
    header += [f"property {types[kind]} {name}" for name in names]
    table = np.stack([rows[name].astype("f8") for name in names], axis=1)
    if order == "a":
        body = "\n".join(" ".join(np.format_float_positional(v, trim="-") for v in row) for row in table)
        body = body.encode()
    else:
        body = table.astype(f"{order}{kind}").tobytes()
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize(("order", "kind"), [("<", "f4"), (">", "f4"), (">", "f8"), ("a", "f4")])
def test_another_byte_order_other_types_sorted_columns_and_no_comments_give_the_same_model(
    tmp_path, model, order, kind
):
    rows = rows_of(model, tmp_path / "m.ply")
    write_rows(tmp_path / "again.ply", rows, sorted(rows.dtype.names), order, kind)
    again = load_ply(tmp_path / "again.ply")
    for name, tensor in model.tensors().items():
        assert torch.equal(getattr(again, name), tensor), name
    assert (again.footprint, again.shading) == (model.footprint, model.shading)
    assert torch.equal(again.ambient, model.ambient)
    if model.footprint != "kerbl":
        assert again.psf_sigma_px == model.psf_sigma_px
    assert torch.equal(again.gloss, model.gloss) and torch.equal(again.static_sun, model.static_sun)


def test_rows_may_be_left_out_and_sorted_anew(tmp_path):
    rows = rows_of(PLAIN, tmp_path / "m.ply")
    kept = rows[[7, 2, 9]]
    write_rows(tmp_path / "again.ply", kept, list(rows.dtype.names))
    assert torch.equal(load_ply(tmp_path / "again.ply").means, PLAIN.means[[7, 2, 9]])


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_gaussian_that_was_changed_in_any_bit_is_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("ply")
    rows = rows_of(MODELS["footprint"], folder / "m.ply").copy()
    names = [name for name in rows.dtype.names if name not in ("nx", "ny", "nz")]
    name, row = data.draw(st.sampled_from(names)), data.draw(st.integers(0, len(rows) - 1))
    bits = rows[name].view("<u4").copy()
    bits[row] ^= np.uint32(1 << data.draw(st.integers(0, 31)))
    rows[name] = bits.view("<f4")
    header = (folder / "m.ply").read_bytes().partition(b"end_header\n")[0]
    (folder / "m.ply").write_bytes(header + b"end_header\n" + rows.tobytes())
    with pytest.raises(ReconstructionError, match=r"another tool changed|damaged"):
        load_ply(folder / "m.ply")


@pytest.mark.parametrize("angle_deg", [5.0, 90.0])
def test_a_model_that_was_turned_by_another_tool_is_refused(tmp_path, angle_deg):
    rows = rows_of(PLAIN, tmp_path / "m.ply").copy()
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    rows["x"], rows["y"] = c * rows["x"] - s * rows["y"], s * rows["x"] + c * rows["y"]
    write_rows(tmp_path / "turned.ply", rows, list(rows.dtype.names))
    with pytest.raises(ReconstructionError, match="another tool changed 12 of its 12 Gaussians"):
        load_ply(tmp_path / "turned.ply")


def test_a_column_that_another_tool_dropped_is_missed(tmp_path):
    rows = rows_of(MODELS["footprint"], tmp_path / "m.ply")
    for dropped in rows.dtype.names:
        write_rows(tmp_path / "again.ply", rows, [name for name in rows.dtype.names if name != dropped])
        if dropped in ("nx", "ny", "nz", "row_check"):
            load_ply(tmp_path / "again.ply")
        else:
            with pytest.raises(ReconstructionError, match=r"again\.ply"):
                load_ply(tmp_path / "again.ply")


def test_files_from_before_facts_stood_in_columns_are_read_by_their_comments(tmp_path):
    save_ply(MODELS["footprint"], tmp_path / "m.ply")
    rows, told = (f(tmp_path / "m.ply") for f in (ply_by_trimesh.read, ply_by_trimesh.comments))
    old = [name for name in rows.dtype.names if name not in ("row_check", "footprint", "psf_sigma_px")]
    write_rows(tmp_path / "old.ply", rows, old)
    head, mark, body = (tmp_path / "old.ply").read_bytes().partition(b"element")
    comments = "".join(f"comment {text}\n" for text in told).encode()
    (tmp_path / "old.ply").write_bytes(head + comments + mark + body)
    again = load_ply(tmp_path / "old.ply")
    assert again.footprint == "camera" and again.psf_sigma_px == torch.tensor(0.4375)


# --- the reader of PLY itself, against trimesh ---


@settings(max_examples=40, deadline=None)
@given(
    points=st.lists(st.tuples(*[st.floats(-1e6, 1e6, width=32)] * 3), min_size=3, max_size=8),
    faces=st.lists(st.tuples(*[st.integers(0, 2)] * 3), min_size=1, max_size=4),
)
def test_points_and_faces_are_those_that_trimesh_reads(tmp_path_factory, points, faces):
    path = tmp_path_factory.mktemp("ply") / "m.ply"
    vertices = {a: np.array([p[i] for p in points], np.float32) for i, a in enumerate("xyz")}
    write_ply(path, {"vertex": vertices, "face": {"vertex_indices": np.array(faces, np.int32)}})
    ours = read_ply(path).tables
    for axis in "xyz":
        np.testing.assert_array_equal(ply_by_trimesh.read(path)[axis], vertices[axis])
        np.testing.assert_array_equal(ours["vertex"][axis], vertices[axis])
    theirs = ply_by_trimesh.read(path, "face")
    np.testing.assert_array_equal(theirs[theirs.dtype.names[0]]["f1"], faces)
    np.testing.assert_array_equal(ours["face"]["vertex_indices"], faces)


@settings(max_examples=150, deadline=None)
@given(content=st.binary(max_size=200), at=st.integers(0, 140), much=st.integers(0, 4))
def test_no_damage_of_a_header_ends_in_anything_but_a_named_error(tmp_path_factory, content, at, much):
    path = tmp_path_factory.mktemp("ply") / "m.ply"
    tables = {"vertex": {"x": np.zeros(2, np.float32)}, "face": {"v": np.zeros((1, 3), np.int32)}}
    write_ply(path, tables)
    whole = path.read_bytes()
    path.write_bytes(whole[:at] + content[:much] + whole[at + much :])
    with contextlib.suppress(PlyError):
        read_ply(path)


@pytest.mark.parametrize(
    ("header", "told"),
    [
        ("format binary_middle_endian 1.0", "format"),
        ("format ascii 2.0", "format"),
        ("element vertex 99999999999999999999", "element"),
        ("format ascii 1.0\nelement vertex 1\nproperty half x", "half"),
        ("format ascii 1.0\nelement vertex 1\nproperty int x\nproperty int x", "two columns"),
        ("format binary_little_endian 1.0\nelement vertex 999999999\nproperty int x", "bytes of numbers"),
    ],
)
def test_a_header_that_is_not_understood_is_refused_by_its_line(tmp_path, header, told):
    (tmp_path / "m.ply").write_text(f"ply\n{header}\nend_header\n1 2 3")
    with pytest.raises(PlyError, match=told):
        read_ply(tmp_path / "m.ply")
