"""Small scenes that several tests share: Gaussians about the origin, cameras around them, and frames that they take."""

import dataclasses
from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hil.sky.sensor import converted
from obbgs_core.frames import TrainingFrame
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.motions import rigid_motions
from obbgs_core.model.sh import from_radiance
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.parts import Now, Part, Seen
from obbgs_core.train.trainer import Trainer

SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=2.0, read_noise_dn=3.0)
SIZE_PX, FOCAL_PX, RANGE_M = 64, 130.0, 8.0
EXPOSURES_S = (5e-5, 1e-4, 2e-4)
QUICK = {"steps": 40, "start.count": 400, "growth.max_gaussians": 600}


def target(count: int = 60, seed: int = 0) -> Gaussians:
    """Return grey Gaussians of several sizes and albedos within about 1 m of the origin."""
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=rng) * 0.4,
        quats=torch.randn(count, 4, generator=rng),
        log_scales=torch.log(0.05 + 0.15 * torch.rand(count, 3, generator=rng)),
        opacity_logits=torch.full((count,), 2.0),
        sh=from_radiance(0.1 + 0.5 * torch.rand(count, 1, 1, generator=rng)),
    )


def ball(count: int, spread_m: float, log_scale: float, coefficient: float) -> Gaussians:
    """Return equal round Gaussians, normally distributed about the origin, of one radiance."""
    rng = torch.Generator().manual_seed(0)
    return Gaussians(
        torch.randn(count, 3, generator=rng) * spread_m,
        torch.randn(count, 4, generator=rng),
        torch.full((count, 3), log_scale),
        torch.full((count,), 2.0),
        torch.full((count, 1, 1), coefficient),
    )


def random_gaussians(count: int, sh_count: int = 1, channels: int = 1, seed: int = 0) -> Gaussians:
    """Return Gaussians whose parameters are all random."""
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(count, 3, generator=rng),
        torch.randn(count, 4, generator=rng),
        torch.rand(count, 3, generator=rng) * 2 - 4,
        torch.randn(count, generator=rng),
        torch.randn(count, sh_count, channels, generator=rng),
    )


def intrinsics(size_px: int = SIZE_PX, focal_px: float = FOCAL_PX) -> Tensor:
    """Return K [3, 3] of a square image with its principal point in the middle."""
    return torch.tensor([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])


def pose(rotation: np.ndarray, range_m: float = RANGE_M) -> Tensor:
    """Return world_to_camera [4, 4] of a camera that looks at the origin, turned as `rotation` [3, 3] says."""
    world_to_camera = torch.eye(4)
    world_to_camera[:3, :3] = torch.tensor(rotation, dtype=torch.float32)
    world_to_camera[2, 3] = range_m
    return world_to_camera


def photographed(
    gaussians: Gaussians,
    count: int = 18,
    seed: int = 0,
    size_px: int = SIZE_PX,
    focal_px: float = FOCAL_PX,
    exposures_s: Sequence[float] = EXPOSURES_S,
    suns: Tensor | None = None,
) -> list[TrainingFrame]:
    """Return frames of a model from all around, with shot and read noise, the exposures in turn.

    Args:
        suns: [count, 3], the direction to the Sun of each frame, which the frames then tell.
    """
    rng, K = np.random.default_rng(seed), intrinsics(size_px, focal_px)
    frames = []
    for i, rotation in enumerate(Rotation.random(count, rng=rng).as_matrix()):
        exposure_s = exposures_s[i % len(exposures_s)]
        sun = None if suns is None else suns[i]
        cameras = Cameras(
            pose(rotation)[None], K[None], size_px, size_px, sun_dir=None if sun is None else sun[None]
        )
        expected = SENSOR.expected_dn(render(gaussians, cameras).radiance[0], exposure_s)
        sigma_dn = SENSOR.variance_dn2(expected).sqrt().numpy()
        dn = torch.from_numpy(converted(expected.numpy(), sigma_dn, SENSOR.white_dn, rng).astype(np.float32))
        frames.append(TrainingFrame(dn, exposure_s, cameras.world_to_camera[0], K, i, sun_dir=sun))
    return frames


def move_poses_in(monkeypatch: pytest.MonkeyPatch, rounds: int) -> None:
    """Let the poses of a training move in so many rounds, as often early as late."""
    for name in ("EARLY_ROUNDS", "LATE_ROUNDS"):
        monkeypatch.setattr(f"obbgs_core.train.poses.{name}", rounds)


def now_of(trainer: Trainer) -> Now:
    """Return a training as its parts see it between two steps, of which none has seen anything."""
    moment = trainer.setup.config.moment(trainer.state.steps_done)
    return trainer.state.now(trainer.setup, moment, cast(Seen, None))


def decide(trainer: Trainer, part: Part) -> None:
    """Let a part of a training decide, and apply the change that it asks for."""
    change = part.decide(now_of(trainer))
    if change is not None:
        trainer.state.apply(trainer.setup, change)


def tagged(frames: list[TrainingFrame], wrong: bool, sigma_rad: float = 0.005) -> list[TrainingFrame]:
    """Return frames whose tags claim an error of 0.3 degrees or as given, and have it or not."""
    rng, sigma = torch.Generator().manual_seed(0), torch.tensor([sigma_rad] * 3 + [1e-4] * 3)
    errors = rigid_motions(torch.randn(len(frames), 6, generator=rng) * sigma * wrong)
    return [
        dataclasses.replace(
            f, world_to_camera=error @ f.world_to_camera, pose_covariance=torch.diag(sigma.double() ** 2)
        )
        for f, error in zip(frames, errors, strict=True)
    ]


class LargestTensor(TorchDispatchMode):
    """Remembers how many numbers the largest tensor has that an operation makes."""

    numbers = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        sizes = [
            t.untyped_storage().nbytes() // t.element_size()
            for t in tree_leaves(made)
            if isinstance(t, Tensor)
        ]
        self.numbers = max([self.numbers, *sizes])
        return made
