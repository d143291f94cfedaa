"""The baseline `nerf`: its encoding and compositing against independent formulas, and a small training."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from compare.opponents import nerf, nerf_rays
from compare.opponents.nerf import AS_PUBLISHED, FOR_A_CPU
from compare.opponents.nerf_field import (
    EncodingSize,
    Field,
    HashEncoding,
    corners,
    multiplied,
    scattered,
)
from compare.opponents.nerf_pictures import half_depths, slopes
from compare.opponents.nerf_rays import (
    Occupancy,
    Rays,
    Samples,
    composited,
    march,
    transmittances,
    weights_of,
)
from compare.opponents.reconstruction import Work
from obbgs_base.errors import Interrupted
from obbgs_core.errors import ReconstructionError, TooFewFrames
from obbgs_core.frames import cameras_of
from obbgs_core.score.metrics import psnr_db
from obbgs_core.start.initialisation import silhouettes
from tests import scenes

SMALL = dataclasses.replace(FOR_A_CPU, samples_per_step=2**12, most_rays=512)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_dense_level_interpolates_as_scipy_does():
    cells = 5
    values = torch.randn((cells + 1) ** 3, generator=seeded())
    positions = torch.rand(200, 3, generator=seeded(1))
    positions[:2] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    rows, weights = corners(positions, cells, len(values))
    axis = np.arange(cells + 1) / cells
    grid = values.view(cells + 1, cells + 1, cells + 1).permute(2, 1, 0)  # x runs fastest in the table
    expected = RegularGridInterpolator((axis, axis, axis), grid.double().numpy())(positions.double().numpy())
    np.testing.assert_allclose((values[rows.long()] * weights).sum(0).numpy(), expected, atol=1e-5)


@given(st.integers(17, 3000), st.integers(4, 19), st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_a_hashed_level_finds_the_rows_of_the_published_hash(cells, log2_rows, seed):
    rows = min(2**log2_rows, 2 ** math.floor(math.log2((cells + 1) ** 3 - 1)))
    position = torch.rand(1, 3, generator=seeded(seed))
    found, weights = corners(position, cells, rows)
    low = [min(cells - 1, math.floor(v)) for v in (position[0] * cells).tolist()]
    expected = set()
    for shift in itertools.product((0, 1), repeat=3):
        x, y, z = (a + b for a, b in zip(low, shift, strict=True))
        expected.add((x ^ (y * 2654435761 & 0xFFFFFFFF) ^ (z * 805459861 & 0xFFFFFFFF)) % rows)
    assert set(found[:, 0].tolist()) == expected
    assert float(weights.sum()) == pytest.approx(1, abs=1e-5)


def test_the_gradient_of_the_encoding_is_that_of_plain_indexing():
    encoding = HashEncoding(EncodingSize(8, 4, 2**10), 60, seeded())
    positions = torch.rand(50, 3, generator=seeded(1))
    wanted = torch.randn(50, 32, generator=seeded(2))
    encoding(positions).backward(wanted)
    table, first, features = encoding.table.detach().clone().requires_grad_(), 0, []
    for cells, count in zip(encoding.cells, encoding.rows, strict=True):
        rows, weights = corners(positions, cells, count)
        features.append((table[first + rows.long()] * weights[..., None]).sum(0))
        first += count
    plain = torch.cat(features, dim=1)
    plain.backward(wanted)
    assert first == len(table)
    torch.testing.assert_close(encoding(positions), plain)
    torch.testing.assert_close(encoding.table.grad, table.grad, rtol=1e-4, atol=1e-5)


def test_a_gpu_adds_up_the_gradient_that_a_cpu_multiplies_out():
    rows = torch.randint(40, (300, 8), generator=seeded(), dtype=torch.int32)
    weights, gradient = torch.rand(300, 8, generator=seeded(1)), torch.randn(300, 2, generator=seeded(2))
    torch.testing.assert_close(
        scattered(rows, weights, gradient, 40), multiplied(rows, weights, gradient, 40)
    )


@given(st.floats(0.0, 20.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.integers(1, 60))
@settings(max_examples=50, deadline=None)
def test_a_homogeneous_slab_absorbs_by_the_law_of_beer_and_lambert(density, length, colour, count):
    ray = torch.zeros(count, dtype=torch.long)
    depths = torch.full((count,), density * length / count, dtype=torch.float64)
    weights = weights_of(depths, ray)
    passed = math.exp(-density * length)
    assert float(weights.sum()) == pytest.approx(1 - passed, abs=1e-12)
    seen = composited(weights.float(), torch.full((count, 1), colour), ray, 1)
    assert float(seen) == pytest.approx(colour * (1 - passed), abs=1e-5)


def test_rays_do_not_shade_one_another():
    depths = torch.tensor([1e6, 3.0, 0.5, 0.25])
    passed = transmittances(depths, torch.tensor([0, 0, 2, 2]))
    torch.testing.assert_close(passed, torch.tensor([1.0, 0.0, 1.0, math.exp(-0.5)]))


def test_the_gradient_of_compositing_is_that_of_finite_differences():
    ray = torch.tensor([0, 0, 0, 2, 2])
    depths = torch.rand(5, dtype=torch.float64, generator=seeded(), requires_grad=True)

    def light(depths):
        return (weights_of(depths, ray) * torch.arange(1, 6, dtype=torch.float64)).cumsum(0)

    assert torch.autograd.gradcheck(light, (depths,))


def test_steps_cover_the_chord_of_a_ray_and_skip_empty_cells():
    occupancy = Occupancy(torch.device("cpu"))
    direction = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), dim=1)
    rays = Rays(torch.tensor([[-2.0, 0.5, 0.5], [3.0, -1.0, 0.5]]), direction)
    samples = march(rays, occupancy, 0.01, torch.tensor([0.5, 0.5]))
    assert samples.ray.tolist() == [0] * 100  # the second ray passes beside the cube
    torch.testing.assert_close(samples.positions[:, 0], (torch.arange(100) + 0.5) / 100, atol=1e-5, rtol=0)
    half = torch.arange(64**3) // 64**2 >= 32
    occupancy.occupied = half
    positions = march(rays, occupancy, 0.01, torch.tensor([0.5, 0.5])).positions
    assert len(positions) == 50 and float(positions[:, 0].min()) > 0.5


def test_a_ray_ends_where_half_of_its_light_is_left():
    density, step = 8.0, 0.01
    distance = (torch.arange(100) + 0.5) * step
    samples = Samples(torch.zeros(100, dtype=torch.long), distance, torch.zeros(100, 3))
    depths = torch.where(distance > 0.3, density * step, 0.0)
    ends = half_depths(depths, samples, 2, step)
    assert float(ends[0]) == pytest.approx(0.3 + math.log(2) / density, abs=1e-5)
    assert torch.isinf(ends[1])


def test_slopes_are_those_of_a_plane():
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(5.0), indexing="ij")
    inner = slopes(3 + 0.5 * u - 0.25 * v)[1:-1, 1:-1]
    torch.testing.assert_close(inner, torch.tensor([0.5, -0.25]).expand_as(inner))


def test_the_learning_rate_rises_then_falls_near_the_end():
    factors = [nerf.rate_factor(step, 1000) for step in (0, 100, 499, 500, 750, 900)]
    assert factors == pytest.approx([0.01, 1, 1, 0.33, 0.33**2, 0.33**3])


@pytest.fixture
def small(monkeypatch, use_threads):
    monkeypatch.setattr(nerf, "SURFACE_POINTS", 500)
    monkeypatch.setattr(nerf_rays, "GRID_CELLS", 24)
    use_threads(1)


def psnr(frames, image) -> float:
    """Return the mean PSNR of images of some frames against the frames themselves."""
    white = scenes.SENSOR.white_dn
    return sum(psnr_db(image(f), f.dn / white) for f in frames) / len(frames)


@pytest.mark.parametrize("exposure_aware", [True, False])
def test_a_field_learns_views_that_it_was_not_shown(small, exposure_aware):
    exposures = scenes.EXPOSURES_S if exposure_aware else scenes.EXPOSURES_S[2:]
    frames = scenes.photographed(scenes.target(), 40, size_px=32, focal_px=60.0, exposures_s=exposures)
    training, held_out = frames[:34], frames[34:]
    shares = []
    work = Work(on_step=lambda share, seconds, snapshot: shares.append(share))
    made = nerf.reconstruct_nerf(training, scenes.SENSOR, 0, work, 120 / SMALL.steps, exposure_aware, SMALL)
    assert made.image is not None
    reached = psnr(held_out, lambda f: made.image(cameras_of([f]), f.exposure_time_s))
    mean = torch.stack([f.dn for f in training]).mean(0) / scenes.SENSOR.white_dn
    assert reached > psnr(held_out, lambda f: torch.zeros_like(f.dn)) + 4
    assert reached > psnr(held_out, lambda f: mean) + 4
    assert shares == pytest.approx([(i + 1) / 120 for i in range(120)])
    assert 300 < len(made.surface) <= 500 and made.size_bytes == 4 * made.figures["parameters"]
    assert (
        float(made.surface.norm(dim=1).median()) < 1.5
    )  # the target's own points lie about 0.6 m from the origin


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no CUDA device")
def test_a_gpu_learns_what_a_cpu_does(small):
    frames = scenes.photographed(scenes.target(), 40, size_px=32, focal_px=60.0)
    size = dataclasses.replace(AS_PUBLISHED, samples_per_step=2**12, most_rays=512)
    reached = []
    for device in ("cpu", "cuda"):
        made = nerf.reconstruct_nerf(
            frames[:34], scenes.SENSOR, 0, Work(), 120 / size.steps, True, size, device
        )
        assert made.image is not None
        image = made.image
        reached.append(psnr(frames[34:], lambda f, image=image: image(cameras_of([f]), f.exposure_time_s)))
        assert 300 < len(made.surface) <= 500
    assert reached[1] == pytest.approx(reached[0], abs=2)


def test_an_interrupted_training_goes_on_bit_for_bit(small, tmp_path):
    frames = scenes.photographed(scenes.target(), 12, size_px=24, focal_px=45.0)
    share = 20 / SMALL.steps
    whole = nerf.reconstruct_nerf(frames, scenes.SENSOR, 3, Work(), share, True, SMALL)
    with pytest.raises(Interrupted, match=r"step 1 of 20.*saved"):
        stopped = Work(tmp_path / "work", should_stop=lambda: True)
        nerf.reconstruct_nerf(frames, scenes.SENSOR, 3, stopped, share, True, SMALL)
    steps = []
    work = Work(tmp_path / "work", lambda share, seconds, snapshot: steps.append(share))
    resumed = nerf.reconstruct_nerf(frames, scenes.SENSOR, 3, work, share, True, SMALL)
    assert len(steps) == 19
    assert whole.image is not None and resumed.image is not None
    camera = cameras_of(frames[:1])
    assert torch.equal(whole.image(camera, 1e-4), resumed.image(camera, 1e-4))
    assert torch.equal(whole.surface, resumed.surface)


def training_of(frames, seed: int, exposure_aware: bool) -> nerf.Training:
    return nerf.Training(frames, scenes.SENSOR, seed, 10, exposure_aware, SMALL, torch.device("cpu"))


def test_a_checkpoint_of_another_training_or_half_a_file_is_not_used(small, tmp_path, caplog):
    frames = scenes.photographed(scenes.target(), 6, size_px=24, focal_px=45.0)
    first = training_of(frames, 0, False)
    first.save(tmp_path / "a.ckpt")
    assert not training_of(frames, 1, False).resume(tmp_path / "a.ckpt")
    assert "another training" in caplog.text and not (tmp_path / "a.ckpt").exists()
    content = (tmp_path / "a.ckpt.unused-1").read_bytes()  # not lost
    (tmp_path / "a.ckpt").write_bytes(content[: len(content) // 2])
    assert not first.resume(tmp_path / "a.ckpt")
    assert "damaged" in caplog.text and (tmp_path / "a.ckpt.unused-2").exists()
    assert first.resume(tmp_path / "a.ckpt.unused-1")
    assert not first.resume(tmp_path / "b.ckpt")
    # below a file there is no room for a folder
    assert not first.save(tmp_path / "a.ckpt.unused-1" / "c.ckpt")
    assert "cannot be written" in caplog.text


def test_a_field_that_knows_clips_predicts_the_mean_of_clipped_readings(small):
    sensor = dataclasses.replace(scenes.SENSOR, black_dn=0.0, read_noise_dn=0.1 * scenes.SENSOR.white_dn)
    frames = scenes.photographed(scenes.target(), 6, size_px=32, focal_px=60.0)
    training = nerf.Training(
        frames, sensor, 0, 10, True, SMALL, torch.device("cpu"), nerf.Knowing(clips=True)
    )
    signals = torch.tensor([0.0, 0.03, 0.5, 1.0, 3.0])
    expected = sensor.white_dn * signals
    noise = torch.randn(100_000, 1, generator=torch.Generator().manual_seed(0))
    read = (expected + sensor.variance_dn2(expected).sqrt() * noise).clamp(0, sensor.white_dn)
    torch.testing.assert_close(
        training._clipped_means(signals), read.mean(0) / sensor.white_dn, atol=2e-3, rtol=0
    )


def test_a_field_that_knows_the_mask_has_no_matter_in_front_of_empty_sky(small):
    frames = scenes.photographed(scenes.target(), 20, size_px=32, focal_px=60.0)
    opaque = []
    for knowing in (nerf.PUBLISHED, nerf.Knowing(mask=True)):
        training = nerf.Training(frames, scenes.SENSOR, 0, 80, True, SMALL, torch.device("cpu"), knowing)
        for _ in range(80):
            training.step()
        sky = next(iter(silhouettes(frames, scenes.SENSOR).items()))
        depth = []
        for rays, middle in training.model._pieces(cameras_of([frames[sky[0]]])):
            samples = training.model.visible(rays, middle)
            _, depths = training.model.composited(rays, samples)
            depth.append(torch.zeros(len(middle)).index_add(0, samples.ray, depths.detach()))
        alpha = 1 - torch.exp(-torch.cat(depth)).reshape(32, 32)
        opaque.append(alpha[sky[1].sky].mean().item())
    assert opaque[1] < 0.75 * opaque[0]


def test_frames_that_allow_no_field_are_refused(small):
    frames = scenes.photographed(scenes.target(), 6, size_px=24, focal_px=45.0)
    with pytest.raises(TooFewFrames):
        nerf.reconstruct_nerf(frames[:2], scenes.SENSOR, 0, Work())
    black = [dataclasses.replace(f, dn=torch.full_like(f.dn, 64.0)) for f in frames]
    with pytest.raises(ReconstructionError, match="black"):
        nerf.reconstruct_nerf(black, scenes.SENSOR, 0, Work())
    with pytest.raises(ValueError, match="steps_share"):
        nerf.reconstruct_nerf(frames, scenes.SENSOR, 0, Work(), steps_share=0.0)


def test_colours_are_bounded_only_where_exposures_are_ignored():
    positions, directions = torch.rand(20, 3), torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    for bounded in (True, False):
        field = Field(3, bounded, FOR_A_CPU.encoding, 40, seeded())
        with torch.no_grad():
            field.colour_layers[-1] += 2.0
            colours = field.colour(field.geometry(positions)[1] + 5.0, directions)
        assert (colours.max() > 1) == (not bounded)
        assert float(colours.min()) >= 0


@pytest.mark.parametrize("exposure_aware", [True, False])
def test_rays_through_empty_space_only_are_black(small, exposure_aware):
    frames = scenes.photographed(scenes.target(), 4, size_px=24, focal_px=45.0)
    training = training_of(frames, 0, exposure_aware)
    training.model.occupancy.occupied[:] = False
    image = training.model.image(cameras_of(frames[:1]), 1e-4)
    assert torch.equal(image, torch.full_like(image, scenes.SENSOR.black_dn / scenes.SENSOR.white_dn))
    assert training.model.depth_map(cameras_of(frames[:1]))[0].isinf().all()
