"""SPZ files against the published layout, parsed here byte by byte."""

import dataclasses
import gzip
import math
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import expit

from obbgs_core.errors import ExportError, ReconstructionError
from obbgs_core.io.gltf_splats import save_gltf_splats
from obbgs_core.io.ply import display_sh, save_ply
from obbgs_core.io.spz import load_spz, save_spz
from obbgs_core.model import sh
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db

WHITE = 4.0
HALF_TURN = np.diag([1.0, -1.0, -1.0])  # our axes, taken as those of 3DGS PLYs, to SPZ's


def ball(count: int, sh_count: int = 1, channels: int = 1, seed: int = 0) -> Gaussians:
    """Return a solid ball of radius 1 m with radiances of 0.2 to 3."""
    g = torch.Generator().manual_seed(seed)
    coefficients = 0.15 * torch.randn(count, sh_count, channels, generator=g)
    coefficients[:, 0] = sh.from_radiance(0.2 + 2.8 * torch.rand(count, channels, generator=g))
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    return Gaussians(
        direction * torch.rand(count, 1, generator=g) ** (1 / 3),
        torch.randn(count, 4, generator=g),
        torch.rand(count, 3, generator=g) * 1.5 - 4,
        torch.randn(count, generator=g),
        coefficients,
    )


def parse(content: bytes) -> dict[str, np.ndarray | int]:
    """Return the sections of an SPZ, version 3, decoded as Niantic's README says, in SPZ's axes."""
    data = gzip.decompress(content)
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, reserved) == (0x5053474E, 3, 0)
    others = (degree + 1) ** 2 - 1
    widths = (9, 1, 3, 3, 4, 3 * others)
    assert len(data) == 16 + count * sum(widths)
    sections, at = [], 16
    for width in widths:
        sections.append(np.frombuffer(data, np.uint8, count * width, at).reshape(count, width))
        at += count * width
    positions, alphas, colours, scales, turns, harmonics = sections
    padded = np.concatenate([np.zeros((count, 3, 1), np.uint8), positions.reshape(count, 3, 3)], axis=2)
    fixed = padded.copy().view("<i4")[..., 0] >> 8  # the sign comes with the shift
    quats = np.zeros((count, 4))  # x, y, z, w
    for quat, packed in zip(quats, turns.copy().view("<u4")[:, 0].tolist(), strict=True):
        largest = packed >> 30
        for i in reversed([i for i in range(4) if i != largest]):
            quat[i] = (-1 if packed & 512 else 1) * (packed & 511) / 511 / math.sqrt(2)
            packed >>= 10
        quat[largest] = math.sqrt(max(0.0, 1 - (quat**2).sum()))
    return {
        "bits": bits,
        "antialiased": flags,
        "means": fixed / 2.0**bits,
        "opacities": alphas[:, 0] / 255,
        "f_dc": (colours / 255 - 0.5) / 0.15,
        "log_scales": scales / 16 - 10,
        "turns": Rotation.from_quat(quats).as_matrix(),
        "f_rest": (harmonics.reshape(count, others, 3) - 128.0) / 128,
    }


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (4, 3)])
def test_the_bytes_are_what_the_format_says(tmp_path, sh_count, channels):
    gaussians = ball(300, sh_count, channels)
    save_spz(gaussians, tmp_path / "m.spz", WHITE)
    file = parse((tmp_path / "m.spz").read_bytes())
    np.testing.assert_allclose(file["means"] @ HALF_TURN, gaussians.means.numpy(), atol=2.0**-16)
    np.testing.assert_allclose(file["opacities"], expit(gaussians.opacity_logits.numpy()), atol=0.501 / 255)
    np.testing.assert_allclose(file["log_scales"], gaussians.log_scales.numpy(), atol=0.501 / 16)
    turns = Rotation.from_quat(gaussians.quats.numpy().astype(np.float64), scalar_first=True).as_matrix()
    half_a_step_rad = 0.006
    np.testing.assert_allclose(HALF_TURN @ file["turns"], turns @ np.diag([1, -1, -1]), atol=half_a_step_rad)
    shown = display_sh(gaussians, WHITE).numpy()
    np.testing.assert_allclose(file["f_dc"], shown[:, 0], atol=0.501 / 255 / 0.15)
    assert file["antialiased"] == 0
    if sh_count == 4:  # functions of y, z, x: the first two change sign
        np.testing.assert_allclose(file["f_rest"] * [[-1], [-1], [1]], shown[:, 1:], atol=0.501 / 128)


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (4, 3), (16, 3)])
def test_the_compact_model_renders_like_the_original(tmp_path, sh_count, channels):
    gaussians = ball(2000, sh_count, channels)
    save_spz(gaussians, tmp_path / "m.spz", WHITE)
    save_ply(gaussians, tmp_path / "m.ply", WHITE)
    again = load_spz(tmp_path / "m.spz")
    assert again.sh.shape == gaussians.sh.shape
    pose = torch.eye(4)
    pose[2, 3] = 3.0
    poses = torch.stack([pose, pose @ torch.diag(torch.tensor([-1.0, 1, -1, 1]))])  # from both sides
    K = torch.tensor([[[120.0, 0, 48], [0, 120, 48], [0, 0, 1]]]).expand(2, 3, 3)
    cameras = Cameras(poses, K, 96, 96)
    ours, compact = (render(g, cameras).radiance / WHITE for g in (gaussians, again))
    assert ours.max() > 0.5  # a picture that is not dark
    assert psnr_db(ours, compact) >= 40  # dB, the project's bar
    assert (tmp_path / "m.spz").stat().st_size < (tmp_path / "m.ply").stat().st_size / 4


@settings(max_examples=20)
@given(st.floats(-3, 6), st.integers(0, 1000))
def test_a_model_of_any_size_keeps_its_means(tmp_path_factory, log10_extent, seed):
    path = tmp_path_factory.mktemp("spz") / "m.spz"
    gaussians = ball(20, seed=seed)
    gaussians.means *= 10**log10_extent
    save_spz(gaussians, path, WHITE)
    step_m = max(
        2.0**-16, float(gaussians.means.abs().max()) / 2**22
    )  # 24 bits, one for the sign, one to spare
    torch.testing.assert_close(load_spz(path).means, gaussians.means, rtol=1e-6, atol=step_m)


@pytest.mark.parametrize("white", [np.float64(2.0), np.float32(2.0), 2])
def test_the_radiance_of_white_may_be_a_number_of_any_kind(tmp_path, white):
    save_spz(ball(3), tmp_path / "a.spz", white)
    save_spz(ball(3), tmp_path / "b.spz", 2.0)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    load_spz(tmp_path / "a.spz")
    save_gltf_splats(ball(3), tmp_path / "a.glb", white)


def test_the_same_model_makes_the_same_file(tmp_path):
    for name in ("a", "b"):
        save_spz(ball(50), tmp_path / name, WHITE)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_what_cannot_be_written_is_refused(tmp_path):
    too_far, broken = ball(3), ball(3)
    too_far.means *= 1e8
    broken.sh[0] = float("nan")
    for gaussians, white, reason in (
        (ball(3).select(torch.tensor([], dtype=torch.long)), WHITE, "no Gaussian"),
        (broken, WHITE, "sh holds"),
        (too_far, WHITE, "means reach"),
        (ball(3), 0.0, "white_radiance"),
    ):
        with pytest.raises(ExportError, match=reason):
            save_spz(gaussians, tmp_path / "m.spz", white)
    assert not list(tmp_path.iterdir())


def test_a_foreign_or_cut_file_is_refused(tmp_path):
    save_spz(ball(30), tmp_path / "m.spz", WHITE)
    content = (tmp_path / "m.spz").read_bytes()
    foreign = gzip.compress(gzip.decompress(content))  # a good SPZ, but without our scale of radiance
    for broken in (content[:-20], content[:5], b"", foreign):
        (tmp_path / "b.spz").write_bytes(broken)
        with pytest.raises(ReconstructionError):
            load_spz(tmp_path / "b.spz")


@pytest.mark.parametrize(("count", "inflated"), [(5, 300_000_000), (3_000_000_000, 1000), (9_999_999, 1000)])
def test_a_file_that_inflates_to_more_or_less_than_its_header_says_costs_no_memory(tmp_path, count, inflated):
    save_spz(ball(5), tmp_path / "m.spz", WHITE)
    content = (tmp_path / "m.spz").read_bytes()
    start = content[: content.index(b"\0", 10) + 1]  # gzip's header with our comment
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = stream.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, count, 0, 12, 0, 0))
    packed += b"".join(
        stream.compress(bytes(min(1_000_000, inflated))) for _ in range(inflated // 1_000_000 + 1)
    )
    (tmp_path / "b.spz").write_bytes(start + packed + stream.flush() + bytes(8))
    tracemalloc.start()
    with pytest.raises(ReconstructionError, match=r"b\.spz is damaged"):
        load_spz(tmp_path / "b.spz")
    assert tracemalloc.get_traced_memory()[1] < 20e6  # bytes
    tracemalloc.stop()


def test_bytes_after_the_model_are_refused(tmp_path):
    save_spz(ball(5), tmp_path / "m.spz", WHITE)
    content = (tmp_path / "m.spz").read_bytes()
    (tmp_path / "b.spz").write_bytes(content + gzip.compress(bytes(10_000)))
    with pytest.raises(ReconstructionError, match="does not hold the 5 Gaussians"):
        load_spz(tmp_path / "b.spz")


@pytest.mark.parametrize("footprint", ["camera", "mip-splatting"])
def test_a_lowered_peak_sets_the_flag_that_viewers_know_and_comes_back(tmp_path, footprint):
    gaussians = dataclasses.replace(ball(30), footprint=footprint, psf_sigma_px=torch.tensor(0.375))
    save_spz(gaussians, tmp_path / "m.spz", WHITE)
    assert (
        parse((tmp_path / "m.spz").read_bytes())["antialiased"] == 1
    )  # bit 0 of Niantic's flags, and no other
    again = load_spz(tmp_path / "m.spz")
    assert (again.footprint, again.psf_sigma_px.item()) == (footprint, 0.375)


def test_viewers_that_know_the_flag_show_nearly_our_picture():
    """They widen by 0.3 px² and lower the peak; the model was fitted with 0.15 px²."""
    gaussians = dataclasses.replace(ball(2000), footprint="camera")
    pose = torch.eye(4)
    pose[2, 3] = 3.0
    K = torch.tensor([[[120.0, 0, 48], [0, 120, 48], [0, 0, 1]]])
    ours, theirs = (
        render(gaussians, Cameras(pose[None], K, 96, 96, psf_sigma_px=sigma_px)).radiance / WHITE
        for sigma_px in (0.26, math.sqrt(0.3 - 1 / 12))
    )
    assert psnr_db(ours, theirs) >= 35  # dB
