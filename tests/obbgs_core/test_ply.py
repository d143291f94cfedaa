"""PLY files against trimesh and the formulas of the 3DGS viewers."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import expit, sph_harm_y

from obbgs_core.errors import ExportError, ReconstructionError
from obbgs_core.io.ply import display_sh, load_ply, radiance_sh, save_ply, save_surface_ply
from obbgs_core.model import sh
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db
from tests import ply_by_trimesh

WHITE = 2.0


def model(count: int, sh_count: int = 1, channels: int = 1, seed: int = 0) -> Gaussians:
    """Return Gaussians whose radiance is about 1 and depends mildly on direction."""
    g = torch.Generator().manual_seed(seed)
    coefficients = 0.1 * torch.randn(count, sh_count, channels, generator=g)
    coefficients[:, 0] += 1 / sh.C0
    return Gaussians(
        torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g),
        torch.rand(count, 3, generator=g) * 2 - 4,
        torch.randn(count, generator=g),
        coefficients,
    )


def viewer_colour(vertex: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return [N, 3] what a 3DGS viewer shows for a direction: real spherical harmonics made of scipy's complex ones."""
    f_dc = np.stack([vertex[f"f_dc_{c}"] for c in range(3)], axis=1)
    rest = [name for name in vertex.dtype.names if name.startswith("f_rest_")]
    colour = 0.5 + 0.28209479177387814 * f_dc
    per_channel = len(rest) // 3
    theta, phi = np.arccos(direction[2]), np.arctan2(direction[1], direction[0])
    for k in range(per_channel):
        degree = int(np.sqrt(k + 1))
        order = k + 1 - degree * degree - degree
        value = sph_harm_y(degree, abs(order), theta, phi)
        real = value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real)
        for c in range(3):
            colour[:, c] += real * np.asarray(vertex[f"f_rest_{c * per_channel + k}"])
    return colour


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (1, 3), (4, 3), (9, 1), (16, 3)])
def test_a_viewer_shows_the_radiance_on_a_gamma_scale(tmp_path, sh_count, channels):
    gaussians = model(40, sh_count, channels)
    save_ply(gaussians, tmp_path / "m.ply", WHITE)
    vertex = ply_by_trimesh.read(tmp_path / "m.ply")
    a_grey_level = 1 / 255 if sh_count == 1 else 0.02  # a power of harmonics is no sum of so few harmonics
    for direction in np.random.default_rng(0).normal(size=(5, 3)):
        direction /= np.linalg.norm(direction)
        ours = sh.radiance(gaussians.sh, torch.tensor(direction, dtype=torch.float32).expand(40, 3)).numpy()
        shown = np.broadcast_to((ours / WHITE) ** (1 / 2.2), (40, 3))
        np.testing.assert_allclose(viewer_colour(vertex, direction), shown, atol=a_grey_level)


def test_shape_and_opacity_mean_what_viewers_take_them_for(tmp_path):
    gaussians = model(20)
    save_ply(gaussians, tmp_path / "m.ply")
    vertex = ply_by_trimesh.read(tmp_path / "m.ply")
    np.testing.assert_array_equal(np.stack([vertex[a] for a in "xyz"], 1), gaussians.means.numpy())
    quats = np.stack([vertex[f"rot_{i}"] for i in range(4)], axis=1).astype(np.float64)
    turns = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    scaled = turns * np.exp(np.stack([vertex[f"scale_{i}"] for i in range(3)], axis=1))[:, None, :]
    np.testing.assert_allclose(scaled @ scaled.transpose(0, 2, 1), gaussians.covariances().numpy(), atol=1e-7)
    np.testing.assert_allclose(expit(vertex["opacity"]), gaussians.opacities.numpy(), rtol=1e-6)


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (4, 3), (16, 1)])
def test_a_model_comes_back_exactly(tmp_path, sh_count, channels):
    gaussians = model(17, sh_count, channels)
    gaussians.sh *= 5  # far from anything that a display can show
    save_ply(gaussians, tmp_path / "m.ply", WHITE)
    again = load_ply(tmp_path / "m.ply")
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(getattr(again, name), tensor), name
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (1, 3), (4, 3), (16, 3)])
def test_radiance_is_recovered_from_display_colours(sh_count, channels):
    gaussians = model(50, sh_count, channels)
    coefficients = radiance_sh(display_sh(gaussians, WHITE), WHITE, channels)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)))
    error = sh.radiance(coefficients, directions) - sh.radiance(gaussians.sh, directions)
    assert error.abs().max() < (
        1e-4 if sh_count == 1 else 0.06
    )  # of about 1; harmonics of higher degree are lost


def test_a_foreign_or_cut_ply_is_refused(tmp_path):
    save_ply(model(3), tmp_path / "m.ply")
    content = (tmp_path / "m.ply").read_bytes()
    for broken in (content[:-5], b"ply\n" + content[10:60], b""):
        (tmp_path / "b.ply").write_bytes(broken)
        with pytest.raises(ReconstructionError):
            load_ply(tmp_path / "b.ply")


@pytest.mark.parametrize("name", [b"scale_1", b"rot_0", b"opacity", b"radiance_sh_0_1", b"property float x"])
def test_a_header_that_lost_a_column_s_name_is_refused(tmp_path, name):
    save_ply(model(3, 4, 3), tmp_path / "m.ply")
    damaged = (tmp_path / "m.ply").read_bytes().replace(name, b"?" * len(name), 1)
    (tmp_path / "m.ply").write_bytes(damaged)
    with pytest.raises(ReconstructionError, match=r"m\.ply"):
        load_ply(tmp_path / "m.ply")


def test_an_empty_model_is_not_written_and_a_count_that_is_none_is_refused(tmp_path):
    with pytest.raises(ExportError):
        save_ply(model(0), tmp_path / "m.ply")
    assert not (tmp_path / "m.ply").exists()
    save_ply(model(3), tmp_path / "m.ply")
    damaged = (tmp_path / "m.ply").read_bytes().replace(b"element vertex 3", b"element vertex Y", 1)
    (tmp_path / "m.ply").write_bytes(damaged)
    with pytest.raises(ReconstructionError, match="not a model written by this software"):
        load_ply(tmp_path / "m.ply")


def test_a_surface_is_read_by_others(tmp_path):
    points, normals = torch.rand(7, 3), torch.nn.functional.normalize(torch.randn(7, 3), dim=1)
    save_surface_ply(points, normals, tmp_path / "surface.ply")
    vertex = ply_by_trimesh.read(tmp_path / "surface.ply")
    np.testing.assert_array_equal(np.stack([vertex[a] for a in "xyz"], 1), points.numpy())
    np.testing.assert_array_equal(np.stack([vertex[a] for a in ("nx", "ny", "nz")], 1), normals.numpy())


def sparse_ball(count: int = 3000) -> tuple[Gaussians, Cameras]:
    """Return a hollow ball of small thin Gaussians, as a trained model has them, and cameras at 4 m around it."""
    g = torch.Generator().manual_seed(4)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    gaussians = Gaussians(
        directions,
        torch.randn(count, 4, generator=g),
        (torch.tensor([0.06, 0.03, 0.006]) * (0.5 + torch.rand(count, 1, generator=g))).log(),
        torch.full((count,), 2.0),
        sh.from_radiance(0.2 + torch.rand(count, 1, 1, generator=g)),
        footprint="camera",
        psf_sigma_px=torch.tensor(0.3),
    )
    turns = Rotation.random(6, rng=np.random.default_rng(2)).as_matrix()
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turns).float()
    poses[:, 2, 3] = 4.0
    K = torch.tensor([[140.0, 0, 50], [0, 140, 50], [0, 0, 1]]).expand(6, 3, 3)
    return gaussians, Cameras(poses, K, 100, 100)


def test_the_footprint_comes_back_and_viewers_get_opacities_of_their_own(tmp_path):
    gaussians, cameras = sparse_ball(50)
    save_ply(gaussians, tmp_path / "m.ply", WHITE, cameras=cameras)
    again = load_ply(tmp_path / "m.ply")
    assert again.footprint == "camera" and again.psf_sigma_px == gaussians.psf_sigma_px
    assert torch.equal(again.opacity_logits, gaussians.opacity_logits)
    vertex = ply_by_trimesh.read(tmp_path / "m.ply")
    assert (vertex["opacity"] < vertex["fitted_opacity"]).all()
    save_ply(dataclasses.replace(gaussians, footprint="kerbl"), tmp_path / "k.ply", WHITE, cameras=cameras)
    assert load_ply(tmp_path / "k.ply").footprint == "kerbl"
    assert b"fitted_opacity" not in (tmp_path / "k.ply").read_bytes()


@pytest.mark.parametrize("times_nearer", [1, 2, 4])
def test_a_viewer_that_keeps_peaks_shows_nearly_our_picture(tmp_path, times_nearer):
    gaussians, cameras = sparse_ball()
    save_ply(gaussians, tmp_path / "m.ply", WHITE, cameras=cameras)
    vertex = ply_by_trimesh.read(tmp_path / "m.ply")
    shown = dataclasses.replace(
        gaussians, footprint="kerbl", opacity_logits=torch.from_numpy(np.array(vertex["opacity"]))
    )
    poses = cameras.world_to_camera.clone()
    poses[:, 2, 3] = 1.0 + 3.0 / times_nearer  # of the surface
    there = dataclasses.replace(cameras, world_to_camera=poses)
    ours, theirs = (render(each, there).radiance / WHITE for each in (gaussians, shown))
    unchanged = render(dataclasses.replace(gaussians, footprint="kerbl"), cameras).radiance / WHITE
    assert psnr_db(theirs, ours) >= 35  # dB
    if times_nearer == 1:
        assert psnr_db(theirs, ours) > psnr_db(unchanged, ours) + 3
