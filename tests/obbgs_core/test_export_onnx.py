"""The exported renderer on onnxruntime against our own renderer."""

import dataclasses
import math

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from flightsw.icd import model_file
from obbgs_core.errors import ExportError
from obbgs_core.io.onnx import export_onnx
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=2e7, electrons_per_dn=4, read_noise_dn=8)


def scene(count: int, sh_count: int, channels: int, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(count, 3, generator=g) * 0.6,
        torch.randn(count, 4, generator=g),
        torch.rand(count, 3, generator=g) * 2 - 4.5,
        torch.randn(count, generator=g) * 2,
        torch.rand(count, sh_count, channels, generator=g) * 2 - 0.3,
    )


def random_view(rng: np.random.Generator, distance: float = 5.0) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q, (0.1, -0.2, distance)
    return pose.astype(np.float32)


@pytest.mark.parametrize(("sh_count", "channels", "width", "height"), [(1, 1, 64, 64), (16, 3, 75, 41)])
def test_onnxruntime_agrees_with_our_renderer(tmp_path, sh_count, channels, width, height):
    gaussians = scene(400, sh_count, channels)
    path = tmp_path / "model.onnx"
    exported = export_onnx(gaussians, SENSOR, path, width, height, [5e-5, 2e-4])
    assert exported.size_bytes == path.stat().st_size
    session = onnxruntime.InferenceSession(str(path))
    K = np.array([[80, 0, width / 2], [0, 78, height / 2 - 1], [0, 0, 1]], dtype=np.float32)
    rng = np.random.default_rng(1)
    for exposure_s in np.geomspace(5e-5, 2e-4, 20):
        pose = random_view(rng)
        feed = {"world_to_camera": pose, "K": K, "exposure_time_s": np.array(exposure_s, dtype=np.float32)}
        image, alpha, depth = session.run(["image", "alpha", "depth"], feed)
        cameras = Cameras(torch.tensor(pose)[None], torch.tensor(K)[None], width, height)
        ours = render(gaussians, cameras)
        expected = (SENSOR.expected_dn(ours.radiance[0], exposure_s) / SENSOR.white_dn).clamp(0, 1)
        assert -10 * math.log10(((torch.tensor(image) - expected) ** 2).mean()) >= 50  # dB, the project's bar
        torch.testing.assert_close(torch.tensor(alpha), ours.alpha[0], rtol=0, atol=5e-3)  # cutoff pixels
        covered = ours.alpha[0] > 0.1
        torch.testing.assert_close(torch.tensor(depth)[covered], ours.depth[0][covered], rtol=0, atol=0.05)


@pytest.mark.parametrize("footprint", ["camera", "mip-splatting"])
def test_onnxruntime_lowers_peaks_as_our_renderer_does(tmp_path, footprint):
    gaussians = dataclasses.replace(scene(400, 1, 1), footprint=footprint, psf_sigma_px=torch.tensor(0.4))
    path = tmp_path / "model.onnx"
    K = np.array([[80, 0, 32], [0, 78, 31], [0, 0, 1]], dtype=np.float32)
    rng = np.random.default_rng(1)
    for psf_sigma_px in (None, 0.8):  # the model's estimate, and a calibrated camera
        export_onnx(gaussians, SENSOR, path, 64, 64, [1e-4], psf_sigma_px)
        session = onnxruntime.InferenceSession(str(path))
        for distance in (5.0, 15.0):
            pose = random_view(rng, distance)
            feed = {"world_to_camera": pose, "K": K, "exposure_time_s": np.array(1e-4, dtype=np.float32)}
            image, alpha = session.run(["image", "alpha"], feed)
            cameras = Cameras(
                torch.tensor(pose)[None], torch.tensor(K)[None], 64, 64, psf_sigma_px=psf_sigma_px
            )
            ours = render(gaussians, cameras)
            expected = (SENSOR.expected_dn(ours.radiance[0], 1e-4) / SENSOR.white_dn).clamp(0, 1)
            assert -10 * math.log10(((torch.tensor(image) - expected) ** 2).mean()) >= 60  # dB
            torch.testing.assert_close(torch.tensor(alpha), ours.alpha[0], rtol=0, atol=5e-3)  # cutoff pixels


def needles() -> Gaussians:
    """Return lines of light a thousand times longer than wide, the worst case for float32."""
    gaussians = scene(200, 1, 1)
    gaussians.log_scales = torch.tensor([1.0, 1e-3, 1e-3]).log().expand(200, 3).contiguous()
    return gaussians


@pytest.mark.parametrize(
    ("gaussians", "distance"),
    [(needles(), 5.0), (scene(600, 1, 1), 150.0)],
    ids=["needles", "all in one tile"],
)
def test_float64_agrees_with_the_exported_float32(tmp_path, gaussians, distance):
    path = tmp_path / "model.onnx"
    export_onnx(gaussians, SENSOR, path, 64, 64, [1e-4])
    K = np.array([[80, 0, 32], [0, 80, 32], [0, 0, 1]], dtype=np.float32)
    pose = random_view(np.random.default_rng(2), distance)
    feed = {"world_to_camera": pose, "K": K, "exposure_time_s": np.array(1e-4, dtype=np.float32)}
    image = onnxruntime.InferenceSession(str(path)).run(["image"], feed)[0]
    exact = Gaussians(**{name: tensor.double() for name, tensor in gaussians.tensors().items()})
    cameras = Cameras(torch.tensor(pose)[None].double(), torch.tensor(K)[None].double(), 64, 64)
    radiance = render(exact, cameras, "reference").radiance[0]
    expected = (SENSOR.expected_dn(radiance, 1e-4) / SENSOR.white_dn).clamp(0, 1)
    assert expected.max() > 0.05  # the black level is 0.016: something is seen
    assert (
        -10 * math.log10(((torch.tensor(image) - expected) ** 2).mean() + 1e-12) >= 80
    )  # dB, 12 bits are 84


def test_a_model_too_large_for_the_uplink_is_written_and_one_too_large_for_onnx_is_named(
    tmp_path, monkeypatch
):
    path = tmp_path / "m.onnx"
    exported = export_onnx(scene(300_000, 16, 3), SENSOR, path, 32, 32, [1e-4])
    assert exported.size_bytes == path.stat().st_size > model_file.MAX_MODEL_BYTES
    path.unlink()
    monkeypatch.setattr("obbgs_core.io.onnx.MAX_PROTOBUF_BYTES", 100_000)
    with pytest.raises(
        ExportError, match=r"5,000 Gaussians make .* ends at 100,000: train with a smaller budget"
    ):
        export_onnx(scene(5000, 1, 1), SENSOR, path, 32, 32, [1e-4])
    assert not list(tmp_path.iterdir())


def test_a_view_of_empty_sky_is_the_black_level(tmp_path):
    path = tmp_path / "model.onnx"
    export_onnx(scene(10, 1, 1), SENSOR, path, 32, 32, [1e-4])
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = -5.0  # the target is behind the camera
    K = np.array([[30, 0, 16], [0, 30, 16], [0, 0, 1]], dtype=np.float32)
    feed = {"world_to_camera": pose, "K": K, "exposure_time_s": np.array(1e-4, dtype=np.float32)}
    image, alpha, depth = onnxruntime.InferenceSession(str(path)).run(None, feed)
    np.testing.assert_allclose(image, 64 / 4095, rtol=1e-6)
    assert (alpha == 0).all() and (depth == 0).all()


def test_only_standard_operators_and_the_sensor_in_the_metadata(tmp_path):
    path = tmp_path / "model.onnx"
    export_onnx(scene(10, 4, 3), SENSOR, path, 32, 24, [2e-4, 5e-5])
    model = onnx.load(path)
    assert [o.domain for o in model.opset_import] == [""]
    facts = {p.key: p.value for p in model.metadata_props}
    assert (facts["width"], facts["height"], facts["gaussians"]) == ("32", "24", "10")
    assert float(facts["exposure_min_s"]) == 5e-5 and float(facts["white_dn"]) == 4095
    assert not list(tmp_path.glob("*.part"))


def test_an_empty_or_broken_model_is_refused(tmp_path):
    empty = scene(1, 1, 1).select(torch.tensor([], dtype=torch.long))
    with pytest.raises(ExportError, match="no Gaussian"):
        export_onnx(empty, SENSOR, tmp_path / "a.onnx", 8, 8, [1e-4])
    broken = scene(3, 1, 1)
    broken.means[1] = float("nan")
    with pytest.raises(ExportError, match="means"):
        export_onnx(broken, SENSOR, tmp_path / "b.onnx", 8, 8, [1e-4])
    assert not list(tmp_path.iterdir())
