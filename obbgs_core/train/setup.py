"""Prepares a training: checks and measures what it is given, and places the first Gaussians."""

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from obbgs_core.batches import GRID_PX, Batches, windows
from obbgs_core.compact import Compact, held, whole
from obbgs_core.compiled import each
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import (
    FEWEST_FRAMES,
    TrainingFrame,
    camera_extent_m,
    cameras_of,
    mean_exposure_s,
    sun_span_deg,
    usable,
)
from obbgs_core.methods.config import MethodConfig, few_share
from obbgs_core.methods.presets import limited
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.process import give_back
from obbgs_core.sensor import Sensor, unusual_unit
from obbgs_core.start.alignment import settled
from obbgs_core.start.hot_pixels import without_hot_pixels
from obbgs_core.start.hull import Silhouette, shows_light
from obbgs_core.start.initialisation import first_gaussians, silhouettes
from obbgs_core.start.sky_level import SkyLevel, levelled, with_noise_seen
from obbgs_core.start.texture import textured_pixels

MOST_HIDDEN = 0.01  # share of the first Gaussians that may be nearer to the cameras than what is drawn
# Albedos under Lambert's law turn with the Sun where no two Suns are further apart: over part of the sphere harmonics
# describe what light from other parts and coarse shadows do, all round it they do not (experiment 075).
TURNING_SPAN_DEG = 90.0


@dataclass(frozen=True)
class TrainingSetup:
    """The frames, the sensor and the method of a training, and what was measured on them before the first step."""

    frames: list[TrainingFrame]  # those that show light
    sensor: Sensor
    asked: MethodConfig  # as it was given
    config: MethodConfig  # the same, with no more Gaussians than the budget allows, and with what so many frames need
    seed: int
    batches: Batches
    radius_m: float  # of the target, as the silhouettes show it
    unit_m: float  # the method's unit of length
    radiance_unit: float  # the method's unit of radiance
    sun_span_deg: float  # largest angle between two frames' Suns, body frame
    start: str  # where the first Gaussians came from, and what was unusual
    warnings: list[str]  # what is unusual about the frames, and what was done about it
    budget: str  # the largest number of Gaussians, and what limits it
    shown: int  # Gaussians that a picture can show: more than the budget where it follows the pictures
    reference_exposure_s: float | None  # what every exposure was taken for when exposure is ignored
    dark_frames: int  # left out: nothing in them rises above the noise
    tagged_exposures_s: list[float]  # of the frames, also where the method ignores them
    silhouettes: dict[int, Silhouette]  # of the long exposures as tagged, by the frame's index
    outlines: dict[int, Silhouette]  # the same, grown or moved by the errors of the poses
    start_means: Tensor  # [N, 3] m, of the first Gaussians
    sky_level: SkyLevel  # of the frames that were given, also of those that show no light

    @property
    def sun_moves(self) -> bool:
        """Whether the Sun moves by enough to be tested as what the radiance depends on."""
        return self.config.light.moves(self.sun_span_deg)

    @property
    def keeps_unseen(self) -> bool:
        """Whether brackets are kept back to learn how much more the model errs on frames that it was not trained on.

        Under Suns between those of its frames it can err by far more than under these.
        """
        return self.config.learns_misfit and not self.config.published.compensation and self.sun_moves

    @property
    def albedos_turn(self) -> bool:
        """Whether albedos under Lambert's law turn with the Sun, which is where it does not go all round."""
        return self.sun_span_deg <= TURNING_SPAN_DEG

    @property
    def exposures_s(self) -> list[float]:
        """The exposure times that the frames are taken to have."""
        return [frame.exposure_time_s for frame in self.frames]

    @property
    def dropout(self) -> float:
        """The share of the Gaussians that steps leave out."""
        return few_share(len(self.frames)) * self.config.sparse.dropout

    @functools.cached_property
    def digest(self) -> str:
        """A digest of the seed, the sensor and the frames."""
        given = dataclasses.replace(self.sensor, response=1.0)  # it is learnt
        digest = hashlib.sha256(repr((self.seed, given)).encode())
        if background := self.frames[0].background:
            digest.update(f"background {background}".encode())
        for f in self.frames:
            digest.update(
                f.dn.numpy().tobytes() + f.world_to_camera.numpy().tobytes() + f.K.numpy().tobytes()
            )
            known = [None if tag is None else tag.tolist() for tag in (f.sun_dir, f.pose_covariance)]
            if f.navigation is not None:
                attitude = None if f.inertial_to_body is None else f.inertial_to_body.tolist()
                digest.update(repr((f.time_s, attitude, f.navigation.tree())).encode())
            if f.earth_m is not None:
                digest.update(repr(f.earth_m.tolist()).encode())
            if f.rates is not None:
                digest.update(f"rates {f.rates.tolist()}".encode())
            if f.own_pose:
                digest.update(b"own pose")
            digest.update(repr((f.exposure_time_s, f.bracket, known, f.psf_sigma_px)).encode())
        return digest.hexdigest()


class Start(NamedTuple):
    """What a training starts from."""

    gaussians: Gaussians
    poses: PoseCorrections | None  # aligned by silhouettes, or refined by a training before; None: as tagged
    why: str  # they are, in words
    rng: torch.Generator


def prepare(
    frames: list[TrainingFrame],
    sensor: Sensor,
    asked: MethodConfig,
    seed: int,
    known: Mapping[int, Silhouette] = MappingProxyType({}),
    refined: PoseCorrections | None = None,
) -> tuple[TrainingSetup, Start]:
    """Return the setup of a training and what it starts from.

    Args:
        known: silhouettes of a setup of the first of these frames, which are not made again.
        refined: poses of the first of these frames, or of all, that a training has refined; they stay.

    Raises:
        TooFewFrames, ReconstructionError: as in `train`.
    """
    checked, reference_exposure_s = usable(frames, asked.exposure_aware, sensor.white_dn)
    checked, sensor, sky_level = levelled(checked, sensor)
    give_back()
    checked, hot = without_hot_pixels(checked, sensor)
    sensor, noise = with_noise_seen(checked, sensor)
    lighted = list(each(lambda f: shows_light(f, sensor), checked))
    lit = _lit(checked, lighted)
    config = asked.for_frames(len(lit))
    published = config.published
    rng, seen = torch.Generator().manual_seed(seed), silhouettes(lit, sensor, known)
    outlines, poses, why = settled(lit, seen, config.poses.refine != "never", refined)
    posed = lit if poses is None else poses.frames(lit)
    white = sensor.full_scale_radiance(mean_exposure_s(lit))
    warnings = [text for text in (hot, noise, unusual_unit(white)) if text]
    certain = {i: held(outline.certain) for i, outline in outlines.items()}
    lit_pixels = [int(whole(mask).sum()) for mask in certain.values()]
    give_back()
    config, shown, budget = limited(config, lit_pixels, textured_pixels(posed, certain, sensor))
    given = (posed, list(outlines.values()), sensor, config.start, published.sh_degree, rng)
    gaussians, radius_m, start = first_gaussians(*given, published.grey_start)
    _check_nearness(gaussians.means.detach(), posed)
    gaussians = dataclasses.replace(gaussians, footprint=published.footprint)
    span_deg = sun_span_deg(lit)
    sky, solid = _masks(outlines, config, span_deg, lit)
    # a window that begins at a multiple of the grid may end within a block of coefficients
    cuts = sensor.jpeg is not None and any(side % GRID_PX for side in lit[0].shape[:2])
    parts = windows(posed, gaussians.means.detach(), certain) if published.windows and not cuts else None
    setup = TrainingSetup(
        frames=lit,
        sensor=sensor,
        asked=asked,
        config=config,
        seed=seed,
        batches=Batches(lit, sensor.white_dn, sky, parts, solid, sensor.jpeg),
        radius_m=radius_m,
        unit_m=camera_extent_m(lit) if published.length_unit == "cameras" else radius_m,
        radiance_unit=white if published.radiance_unit == "full_scale" else 1.0,
        sun_span_deg=span_deg,
        start="; ".join([start, *warnings]),
        warnings=warnings if sky_level.fits else [str(sky_level), *warnings],
        budget=budget,
        shown=shown,
        reference_exposure_s=reference_exposure_s,
        dark_frames=len(checked) - len(lit),
        tagged_exposures_s=[f.exposure_time_s for f, shows in zip(frames, lighted, strict=True) if shows],
        silhouettes=seen,
        outlines=outlines,
        start_means=gaussians.means.detach(),
        sky_level=sky_level,
    )
    return setup, Start(gaussians, poses, why, rng)


def _lit(frames: list[TrainingFrame], shown: list[bool]) -> list[TrainingFrame]:
    """Return the frames that show light.

    Raises:
        ReconstructionError: too few do.
    """
    lit = [f for f, shows in zip(frames, shown, strict=True) if shows]
    if len(lit) < FEWEST_FRAMES:
        raise ReconstructionError(
            f"{len(frames) - len(lit)} of {len(frames)} frames are black (eclipse, or exposures too short): only "
            f"{len(lit)} rise above the noise, {FEWEST_FRAMES} are needed"
        )
    return lit


def _masks(
    outlines: dict[int, Silhouette], config: MethodConfig, span_deg: float, frames: list[TrainingFrame]
) -> tuple[dict[int, Tensor | Compact], dict[int, Tensor | Compact]]:
    """Return where silhouettes show empty sky, and what is solid, by the frame's index; empty where not asked for.

    What is dark under one Sun is lit under another, which tells it from dust: where the Sun moves nothing is solid. Nor
    is it in front of another background than black, which shows through dust. Frames with the Earth in view say
    neither: what stands behind the target in them follows from the model.
    """
    outlines = {i: outline for i, outline in outlines.items() if frames[i].earth_m is None}
    sky = {i: held(outline.sky) for i, outline in outlines.items()} if config.loss.sky_weight else {}
    used = config.loss.solid_weight and not config.light.moves(span_deg) and not frames[0].background
    return sky, {i: held(outline.solid) for i, outline in outlines.items()} if used else {}


def _check_nearness(points: Tensor, frames: list[TrainingFrame]) -> None:
    """Refuse first Gaussians [N, 3] m that are too near to the cameras to be drawn.

    Raises:
        ReconstructionError: many of them are.
    """
    near_m = cameras_of(frames[:1]).near_m
    poses = torch.stack([frame.world_to_camera for frame in frames])
    depths_m = points @ poses[:, 2, :3].T + poses[:, 2, 3]
    in_front = depths_m > 0
    hidden = int((in_front & (depths_m < near_m)).sum()) / max(1, int(in_front.sum()))
    if hidden > MOST_HIDDEN:
        raise ReconstructionError(
            f"{hidden:.0%} of the target is nearer to the cameras than {near_m} m and is not drawn: are the poses "
            "in metres? Scale their positions up, by a thousand if they are in kilometres"
        )
