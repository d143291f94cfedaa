"""The Earth behind the target: what is taken out of frames, what is filled in, and what a training makes of it."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from obbgs_base.physics.earth import RADIUS_M
from obbgs_core.background import OUTLINE, backdrop, doubt, earth_pixels, filled, weighed
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.model.cameras import Cameras
from obbgs_core.render import render
from obbgs_core.render.slopes import render_with_slopes
from obbgs_core.start.earth import earth_silhouette
from obbgs_core.train.trainer import Trainer, train
from tests import scenes

HEIGHT_M = 500e3
BELOW = torch.tensor([0.0, 0.0, RADIUS_M + HEIGHT_M])  # the camera looks straight down


def spacecraft():
    """Return an opaque target, as a spacecraft is."""
    return dataclasses.replace(scenes.target(), opacity_logits=torch.full((60,), 6.0))


def limb_at(share: float, size_px: int, focal_px: float) -> torch.Tensor:
    """Return where the Earth's centre is if the limb is this share of the picture's height below its middle."""
    angle = math.asin(RADIUS_M / (RADIUS_M + HEIGHT_M)) + math.atan(share * size_px / focal_px)
    return (RADIUS_M + HEIGHT_M) * torch.tensor([0.0, math.sin(angle), math.cos(angle)])


def earthly(frames: list[TrainingFrame], chosen, contrast: float = 0.3) -> list[TrainingFrame]:
    """Return frames with a bright, uneven Earth behind the spacecraft in the chosen ones."""
    found = []
    for frame in frames:
        if not chosen(frame.id):
            found.append(frame)
            continue
        rng, size = np.random.default_rng((7, frame.id)), frame.dn.shape[0]
        coarse = torch.from_numpy(rng.random((1, 1, 5, 5))).float()
        light = 0.15 + contrast * torch.nn.functional.interpolate(
            coarse, size=(size, size), mode="bicubic"
        ).clamp(0, 1)
        camera = Cameras(frame.world_to_camera[None], frame.K[None], size, size)
        alpha = render(spacecraft(), camera).alpha[0]
        gain = scenes.SENSOR.dn_per_radiance_s * frame.exposure_time_s
        added = gain * (1 - alpha) * light[0, 0]
        dn = (frame.dn + added.round()[..., None]).clamp(max=scenes.SENSOR.white_dn)
        found.append(dataclasses.replace(frame, dn=dn, earth_m=BELOW))
    return found


def test_the_earth_is_where_navigation_has_it():
    frame = scenes.photographed(spacecraft(), 1)[0]
    assert not earth_pixels(frame).any()
    assert earth_pixels(dataclasses.replace(frame, earth_m=BELOW)).all()
    share = 0.25
    limb = dataclasses.replace(frame, earth_m=limb_at(share, scenes.SIZE_PX, scenes.FOCAL_PX))
    column = earth_pixels(limb)[:, scenes.SIZE_PX // 2]
    air_px = 6  # 80 km of it, 2,600 km away, at this focal length
    assert int(column.int().argmax()) == pytest.approx((0.5 + share) * scenes.SIZE_PX - air_px, abs=3)
    assert column[int(column.int().argmax()) :].all()


def test_what_is_known_stays_and_what_is_not_is_filled_from_around():
    y, x = torch.meshgrid(torch.arange(33.0), torch.arange(47.0), indexing="ij")
    ramp = torch.stack([1 + 0.02 * x, 2 - 0.01 * y], dim=-1)
    known = torch.ones(33, 47, dtype=torch.bool)
    known[12:20, 10:22] = False
    image, deviation = filled(ramp, torch.zeros_like(ramp), known)
    torch.testing.assert_close(image[known], ramp[known])
    assert (image - ramp).abs().max() < 0.05  # of a rise by 0.24 across the hole
    even, none = filled(torch.full_like(ramp, 0.7), torch.zeros_like(ramp), known)
    torch.testing.assert_close(even, torch.full_like(ramp, 0.7))
    assert none.max() < 1e-3 and deviation[~known].max() > 0.01


def test_the_earth_beside_the_target_is_taken_out_and_that_behind_it_filled_in():
    frame = scenes.photographed(spacecraft(), 1)[0]
    light = 0.2
    dn = torch.full_like(frame.dn, scenes.SENSOR.expected_dn(torch.tensor(light), frame.exposure_time_s))
    near = torch.zeros(frame.dn.shape[:2], dtype=torch.bool)
    near[20:40, 25:45] = True
    dn[near] = 3000.0
    found = backdrop(dataclasses.replace(frame, dn=dn, earth_m=BELOW), scenes.SENSOR, near)
    assert (found.dn[~near] == scenes.SENSOR.black_dn).all() and (found.dn[near] == 3000).all()
    torch.testing.assert_close(found.radiance[near], torch.full_like(found.radiance[near], light))
    assert (found.radiance[~near] == 0).all() and (found.sigma[~near] == 0).all()


def test_a_backdrop_is_composited_behind_the_model():
    frame = scenes.photographed(spacecraft(), 1)[0]
    cameras = Cameras(frame.world_to_camera[None], frame.K[None], scenes.SIZE_PX, scenes.SIZE_PX)
    behind = torch.full((1, scenes.SIZE_PX, scenes.SIZE_PX, 1), 0.3)
    seen = render(spacecraft(), dataclasses.replace(cameras, backdrop=behind))
    same = render(spacecraft(), dataclasses.replace(cameras, background=0.3))
    torch.testing.assert_close(seen.radiance, same.radiance)
    with pytest.raises(ValueError, match="backdrop must be"):
        dataclasses.replace(cameras, backdrop=behind[:, 1:])


def test_derivatives_are_those_of_a_target_that_moves_in_front_of_a_backdrop_at_rest():
    frame, size = scenes.photographed(spacecraft(), 1)[0], scenes.SIZE_PX
    behind = torch.rand(1, size, size, 1, generator=torch.Generator().manual_seed(3))
    cameras = Cameras(frame.world_to_camera[None], frame.K[None], size, size, backdrop=behind)
    _, slopes = render_with_slopes(spacecraft(), cameras)
    for axis in (0, 1):
        sides = []
        for shift in (-0.5, 0.5):
            K = cameras.K.clone()
            K[:, axis, 2] += shift
            sides.append(render(spacecraft(), dataclasses.replace(cameras, K=K)).radiance)
        torch.testing.assert_close(slopes[..., axis], sides[0] - sides[1], atol=1e-4, rtol=1e-3)


def test_doubt_acts_as_noise_of_its_own():
    """The slope of the squared error over noise is that of both errors together."""
    sigma, behind = torch.tensor(3.0), torch.tensor(4.0)
    dn, prediction = torch.tensor(120.0), torch.tensor(100.0)
    moved = weighed(dn, prediction, sigma, behind, 255.0)
    assert float((prediction - moved) / sigma**2) == pytest.approx(float(-20 / (3.0**2 + 4.0**2)))
    assert weighed(dn, prediction, sigma, torch.tensor(0.0), 255.0) == dn


def test_outlines_that_err_show_more_or_less_of_what_is_behind_them():
    """A step of alpha that lies anywhere within a share of a pixel errs by that share of the light behind it."""
    alpha, radiance = torch.zeros(1, 9, 12), torch.full((1, 9, 12, 3), 0.6)
    alpha[..., 6:] = 1.0
    known, share = torch.zeros_like(radiance), 0.5
    alone = doubt(alpha, radiance, known, share)
    torch.testing.assert_close(alone[:, :, 5:7], torch.full((1, 9, 2, 3), share * OUTLINE * 0.6))
    assert not alone[:, :, :5].any() and not alone[:, :, 7:].any()
    both = doubt(alpha, radiance, torch.full_like(radiance, 0.2), share)
    torch.testing.assert_close(both[:, :, :5], torch.full((1, 9, 5, 3), 0.2))
    torch.testing.assert_close(both[:, :, 5], torch.full((1, 9, 3), math.hypot(0.2, share * OUTLINE * 0.6)))
    assert not doubt(alpha, radiance, known, 0.0).any()  # no other frame shows the outlines
    assert not doubt(alpha, known, known, share).any()  # nothing stands behind


def test_in_front_of_an_even_earth_the_target_stands_out_and_in_front_of_clouds_nothing_is_known():
    frame = scenes.photographed(spacecraft(), 3)[2]
    cameras = Cameras(frame.world_to_camera[None], frame.K[None], scenes.SIZE_PX, scenes.SIZE_PX)
    alpha = render(spacecraft(), cameras).alpha[0]
    even, clouded = (earthly([frame], lambda number: True, contrast)[0] for contrast in (0.0, 0.3))
    found = earth_silhouette(even, scenes.SENSOR)
    assert found.likely[alpha > 0.9].float().mean() > 0.95
    assert found.likely[alpha < 0.01].float().mean() < 0.1
    unknown = earth_silhouette(clouded, scenes.SENSOR)
    assert unknown.likely.all() and not unknown.certain.any() and not unknown.sky.any()


@pytest.fixture(scope="module")
def black():
    return scenes.photographed(spacecraft(), 36)


def quick(steps: int = 200):
    return preset("obbgs", {"steps": steps, "start.count": 400, "growth.max_gaussians": 600})


def psnr_db(gaussians) -> float:
    """Return how well a model shows the target on black sky, from sides that it was not trained on."""
    errors = []
    for frame in scenes.photographed(spacecraft(), 6, seed=99):
        cameras = Cameras(frame.world_to_camera[None], frame.K[None], scenes.SIZE_PX, scenes.SIZE_PX)
        errors.append((render(gaussians, cameras).radiance - render(spacecraft(), cameras).radiance) ** 2)
    return -10 * math.log10(float(torch.stack(errors).mean()))


def test_the_earth_in_half_of_the_frames_costs_little(black):
    plain = psnr_db(train(black, scenes.SENSOR, quick()).gaussians)
    half = psnr_db(train(earthly(black, lambda i: i % 2), scenes.SENSOR, quick()).gaussians)
    # 2.03 dB on a processor without AVX2, less on others: what the Earth costs is measured by results, not here
    assert half > plain - 4


def test_frames_that_all_have_the_earth_say_where_nothing_else_is(black):
    trainer = Trainer(earthly(black[:12], lambda number: True, contrast=0.0), scenes.SENSOR, quick())
    trainer.step()
    sky = trainer.setup.batches.batch(list(range(12))).sky
    assert sky is not None and (sky.flatten(1).mean(dim=1) > 0.1).all()


def test_frames_that_all_have_clouds_behind_the_target_are_refused_in_words(black):
    clouded = earthly(black[:12], lambda number: True)
    with pytest.raises(ReconstructionError, match="all 12 frames have the Earth behind the target, and none"):
        Trainer(clouded, scenes.SENSOR, quick())


def test_a_training_with_the_earth_goes_on_from_its_checkpoint_as_it_was(black, tmp_path):
    frames, config = earthly(black, lambda i: i % 2), quick(60)
    whole = train(frames, scenes.SENSOR, config)
    first = Trainer(frames, scenes.SENSOR, config)
    for _ in range(25):
        first.step()
    first.save(tmp_path / "checkpoint")
    after = train(frames, scenes.SENSOR, config, checkpoint=tmp_path / "checkpoint")
    assert torch.equal(whole.gaussians.means, after.gaussians.means)
