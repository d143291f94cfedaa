"""The baselines `nerf` and `instant-ngp`: neural radiance fields (Mildenhall 2020, Müller 2022).

`instant-ngp` has the encoding and the batch that its authors publish; `nerf` is the same method at a size that a CPU
can train.
"""

import hashlib
import io
import logging
import math
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from compare.opponents.nerf_field import EncodingSize, Field
from compare.opponents.nerf_pictures import Nerf
from compare.opponents.nerf_rays import Occupancy, on_device, rays_of
from compare.opponents.reconstruction import Reconstruction, Work
from obbgs_base.errors import Interrupted, reason
from obbgs_base.files import set_aside, write_whole
from obbgs_core.errors import Diverged, ReconstructionError
from obbgs_core.frames import TrainingFrame, cameras_of, mean_exposure_s, usable
from obbgs_core.sensor import Sensor, clipped_moments
from obbgs_core.start.hull import radius_m
from obbgs_core.start.initialisation import silhouettes

log = logging.getLogger(__name__)
FORMAT = 2  # of checkpoints; raise it when what they hold changes
FIRST_RAYS, FEWEST_RAYS = 256, 64  # of one step
LEARNING_RATE, BETAS, EPSILON = 1e-2, (0.9, 0.99), 1e-15  # of Adam, as published
NETWORK_DECAY = 1e-6  # L2 penalty on the networks' weights, as published
WARM_UP_STEPS = 100  # from a hundredth of the rate
RATE_DROPS, RATE_DROP = (
    (1 / 2, 3 / 4, 9 / 10),
    0.33,
)  # shares of the steps at which the rate falls by the factor
UPDATE_EVERY, UPDATE_EVERYWHERE_UNTIL = 16, 256  # steps; of the occupancy grid, as published
SKY_WEIGHT = 0.1  # of the mean opacity of rays through empty sky
CHECKPOINT_EVERY_S = 60.0
SURFACE_POINTS = 100_000
VIEWS_ON_THE_WAY = 40  # by which the surface is found where the training goes on
FEWEST_PIXELS_ACROSS = 16.0  # of the target; less would leave the encoding no finer level


@dataclass(frozen=True)
class Size:
    """How large a radiance field is, and how long it is trained.

    samples_per_step: about so many carry a gradient; the number of rays follows from it, up to `most_rays`.
    """

    steps: int
    samples_per_step: int
    most_rays: int
    encoding: EncodingSize


# 16 levels of 2 features cost a CPU twice the time of 8 levels of 4 for the same 32 numbers
FOR_A_CPU = Size(8000, 2**15, 4096, EncodingSize(levels=8, features=4, table_rows=2**17))
# the encoding and the samples of a step as published; the steps are those of nerfacc's example for NeRF-synthetic
AS_PUBLISHED = Size(20_000, 2**18, 32_768, EncodingSize(levels=16, features=2, table_rows=2**19))


@dataclass(frozen=True)
class Knowing:
    """What a radiance field knows besides the pictures, which the published ones do not.

    clips: that readings are clipped at zero and at full scale: it predicts their mean, which is above the light in dark
        pixels. mask: where silhouettes show empty sky, which has no matter in front of it.
    """

    clips: bool = False
    mask: bool = False


PUBLISHED = Knowing()


def reconstruct_nerf(
    frames: list[TrainingFrame],
    sensor: Sensor,
    seed: int,
    work: Work,
    steps_share: float = 1.0,
    exposure_aware: bool = False,
    size: Size = FOR_A_CPU,
    device: str = "cpu",
    knowing: Knowing = PUBLISHED,
) -> Reconstruction:
    """Train a radiance field on frames, and return its images and the surface that it shows the training views.

    On a CPU the same seed, thread count and machine give the same result bit for bit, also when the training was
    interrupted or killed and called again with the same folder. A GPU adds up in an order of its own.

    Args:
        steps_share: of the method's own number of steps.
        exposure_aware: False, as published: the field holds pixel values, and all frames count as exposed for the
            geometric mean of their times. True: it holds radiance, each frame's exposure time and the sensor's gain
            turn it into readings, and a reading at full scale only says "at least this much".
        device: where it is trained and drawn, as PyTorch names it; frames, images and points are on the CPU.
        knowing: what it knows of the sensor and the silhouettes besides; nothing, as published.

    Raises:
        ValueError: steps_share is not positive and finite.
        TooFewFrames: fewer than three frames.
        ReconstructionError: every frame is black, frames differ in size, or a value is not finite.
        Diverged: the loss stopped being a number.
        Interrupted: work.should_stop returned true; what was done is kept in work.folder.
    """
    if not 0 < steps_share < math.inf:
        raise ValueError(f"steps_share must be a positive number, got {steps_share}")
    steps = max(1, round(steps_share * size.steps))
    training = Training(frames, sensor, seed, steps, exposure_aware, size, torch.device(device), knowing)
    checkpoint = None if work.folder is None else work.folder / "nerf.ckpt"
    if checkpoint is not None and training.resume(checkpoint):
        log.info("resumed at step %d of %d", training.steps_done, training.steps)
    saved = time.monotonic()
    while training.steps_done < training.steps:
        training.step()
        work.on_step(training.steps_done / training.steps, training.seconds, training.snapshot)
        if work.should_stop():
            kept = checkpoint is not None and training.save(checkpoint)
            where = f"saved in {checkpoint}: the same call goes on from there" if kept else "not saved"
            raise Interrupted(f"interrupted at step {training.steps_done} of {training.steps}, {where}")
        if checkpoint is not None and time.monotonic() - saved > CHECKPOINT_EVERY_S:
            training.save(checkpoint)
            saved = time.monotonic()
    if checkpoint is not None:
        training.save(checkpoint)
    return training.reconstruction()


class Training:
    """A training under way.

    Raises:
        TooFewFrames, ReconstructionError: as in `reconstruct_nerf`.
    """

    def __init__(
        self,
        frames: list[TrainingFrame],
        sensor: Sensor,
        seed: int,
        steps: int,
        exposure_aware: bool,
        size: Size,
        device: torch.device,
        knowing: Knowing = PUBLISHED,
    ):
        began = time.monotonic()
        usable(frames, exposure_aware)
        self.steps, self.exposure_aware, self.sensor, self.size = steps, exposure_aware, sensor, size
        self.knowing, outlines = knowing, silhouettes(frames, sensor)
        radius = radius_m(list(outlines.values()))
        if radius == 0:
            raise ReconstructionError(
                f"all {len(frames)} frames are black (eclipse, or exposures too short): nothing rises above the noise"
            )
        self.cameras = cameras_of(frames)
        poses, K = self.cameras.world_to_camera, self.cameras.K
        pixels_across = float((2 * radius * K[:, 0, 0] / poses[:, :3, 3].norm(dim=1)).median())
        pixels_across = max(pixels_across, FEWEST_PIXELS_ACROSS)
        self.rays_from = on_device(self.cameras, device)
        reference_s = mean_exposure_s(frames)
        self.exposures = torch.tensor([f.exposure_time_s / reference_s for f in frames], device=device)
        dn = torch.stack([f.dn for f in frames])
        self.signals = ((dn - sensor.black_dn) / (sensor.white_dn - sensor.black_dn)).to(device)
        self.saturated = (dn >= sensor.white_dn).to(device)
        self.sky = torch.zeros(dn.shape[:3], dtype=torch.bool, device=device)
        for i, outline in outlines.items() if knowing.mask else ():
            self.sky[i] = outline.sky.to(device) > 0
        self.generator = torch.Generator(device).manual_seed(seed)
        channels, finest_cells = dn.shape[3], round(pixels_across)
        field = Field(channels, not exposure_aware, size.encoding, finest_cells, self.generator)
        exposed_s = reference_s if exposure_aware else None
        self.model = Nerf(field, Occupancy(device), radius, 1 / pixels_across, exposed_s, sensor)
        networks = {"params": field.networks(), "weight_decay": NETWORK_DECAY}
        self.adam = torch.optim.Adam(
            [{"params": [field.encoding.table]}, networks],
            lr=LEARNING_RATE,
            betas=BETAS,
            eps=EPSILON,
            fused=True,
        )
        self.steps_done, self.rays = 0, FIRST_RAYS
        self.fingerprint = _fingerprint(
            frames, (sensor, seed, steps, exposure_aware, size, device.type, knowing)
        )
        self.seconds = time.monotonic() - began

    def step(self) -> None:
        """Render some random pixels and move the field down the gradient of their squared error.

        Raises:
            Diverged: the loss stopped being a number.
        """
        began = time.monotonic()
        if self.steps_done % UPDATE_EVERY == 0:
            everywhere = self.steps_done < UPDATE_EVERYWHERE_UNTIL
            self.model.occupancy.update(
                self.model.density, self.model.step_length, self.generator, everywhere
            )
        count, height, width, _ = self.signals.shape
        random = {"generator": self.generator, "device": self.generator.device}
        drawn = torch.randint(count * height * width, (self.rays,), **random)
        camera, row, column = drawn // (height * width), drawn // width % height, drawn % width
        rays = rays_of(self.rays_from, camera, row, column, self.model.radius_m)
        samples = self.model.visible(rays, torch.rand(self.rays, **random))
        colours, depths = self.model.composited(rays, samples)
        true, saturated = self.signals[camera, row, column], self.saturated[camera, row, column]
        if self.exposure_aware:
            colours = colours * self.exposures[camera, None]
        if self.knowing.clips:
            residual = self._clipped_means(colours) - true
        else:
            residual = torch.where(
                saturated & self.exposure_aware, (colours - true).clamp(max=0), colours - true
            )
        loss = residual.square().mean()
        if self.knowing.mask:
            alpha = 1 - torch.exp(-torch.zeros_like(colours[:, 0]).index_add(0, samples.ray, depths))
            loss = loss + SKY_WEIGHT * (alpha * self.sky[camera, row, column]).mean()
        if not torch.isfinite(loss):
            raise Diverged(self.steps_done, loss.item())
        for group in self.adam.param_groups:
            group["lr"] = LEARNING_RATE * rate_factor(self.steps_done, self.steps)
        self.adam.zero_grad()
        if len(samples.ray):
            loss.backward()
            self.adam.step()
        wanted = round(self.rays * self.size.samples_per_step / max(1, len(samples.ray)))
        self.rays = min(self.size.most_rays, max(FEWEST_RAYS, wanted, self.rays // 2), 2 * self.rays)
        self.steps_done += 1
        self.seconds += time.monotonic() - began

    def _clipped_means(self, signals: Tensor) -> Tensor:
        """Return what pixels of these signals read in the mean, clipped at zero and at full scale, as signals."""
        sensor = self.sensor
        range_dn = sensor.white_dn - sensor.black_dn
        expected_dn = sensor.black_dn + range_dn * signals
        sigma_dn = sensor.variance_dn2(expected_dn).sqrt()
        mean_dn, _ = clipped_moments(expected_dn, sigma_dn, sensor.white_dn)
        return (mean_dn - sensor.black_dn) / range_dn

    def snapshot(self, with_surface: bool) -> Reconstruction:
        """Return what the field shows on the way, its surface from some of the views."""
        return self.reconstruction(VIEWS_ON_THE_WAY if with_surface else 0)

    def reconstruction(self, surface_views: int | None = None) -> Reconstruction:
        """Return what the field shows as it stands; further steps do not change it.

        Args:
            surface_views: by how many views its surface is found at most; None: by all.
        """
        model = self.model.snapshot()
        parameters = list(model.field.parameters())
        points = (
            model.surface(self.cameras, SURFACE_POINTS, surface_views)
            if surface_views != 0
            else torch.zeros(0, 3)
        )
        return Reconstruction(
            points=points,
            surface=points,
            image=model.image,
            size_bytes=sum(p.numel() * p.element_size() for p in parameters),
            seconds=self.seconds,
            figures={"parameters": sum(p.numel() for p in parameters), "steps": self.steps_done},
        )

    def save(self, path: Path) -> bool:
        """Write everything that the next step depends on, whole or not at all, and return whether the disk took it."""
        occupancy = self.model.occupancy
        content = io.BytesIO()
        state = {
            "fingerprint": self.fingerprint,
            "field": self.model.field.state_dict(),
            "adam": self.adam.state_dict(),
            "occupancy": [occupancy.density, occupancy.occupied],
            "generator": self.generator.get_state(),
            "counts": [self.steps_done, self.rays],
            "seconds": self.seconds,
        }
        torch.save(state, content)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, content.getvalue())
        except OSError as error:  # a full disk must not end the training
            log.warning("step %d: %s cannot be written: %s", self.steps_done, path, reason(error))
            return False
        return True

    def resume(self, path: Path) -> bool:
        """Go on from a checkpoint, and return whether there is one of this very training."""
        if not path.exists():
            return False
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
            why = "" if saved["fingerprint"] == self.fingerprint else "belongs to another training or version"
        except (pickle.UnpicklingError, RuntimeError, OSError, EOFError, LookupError, TypeError) as error:
            saved, why = {}, f"is damaged or of another version ({reason(error)})"
        if why:
            kept = set_aside(path).name
            log.warning(
                "%s %s: it is not used; it is kept as %s, and this training begins anew", path, why, kept
            )
            return False
        self.model.field.load_state_dict(saved["field"])
        self.adam.load_state_dict(saved["adam"])
        density, occupied = saved["occupancy"]
        device = self.generator.device
        self.model.occupancy.density, self.model.occupancy.occupied = density.to(device), occupied.to(device)
        self.generator.set_state(saved["generator"])
        self.steps_done, self.rays = saved["counts"]
        self.seconds = saved["seconds"]
        return True


def rate_factor(step: int, steps: int) -> float:
    """Return the factor of the learning rate at a step: a short rise, then drops near the end."""
    rise = min(1.0, 0.01 + 0.99 * step / min(WARM_UP_STEPS, steps))
    return rise * RATE_DROP ** sum(step >= share * steps for share in RATE_DROPS)


def _fingerprint(frames: list[TrainingFrame], settings: tuple) -> str:
    """Return a digest of everything that a training is given."""
    digest = hashlib.sha256(repr((FORMAT, *settings)).encode())
    for frame in frames:
        digest.update(repr((frame.exposure_time_s, tuple(frame.dn.shape))).encode())
        for tensor in (frame.dn, frame.world_to_camera, frame.K):
            digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()
