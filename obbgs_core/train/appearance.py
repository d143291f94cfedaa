"""Chooses by likelihood what the radiance depends on: the direction of view, that of the Sun, or Lambert's law."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from obbgs_core.batches import Batches
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import shadow_map
from obbgs_core.render.lighting import lambertian
from obbgs_core.render.shadows import ShadowMap, lit_shares
from obbgs_core.sensor import Sensor
from obbgs_core.settings import check, number
from obbgs_core.train.parsimony import next_degree_gain, padded

SHADOW_INTERVAL = 120  # steps between two computations of the shadow maps
SUN_DEGREE = 1  # of harmonics towards the Sun, at most: a face is as bright as the cosine of the Sun's angle
# Albedos under Lambert's law turn with the Sun where no two Suns are further apart: over part of the sphere harmonics
# describe what light from other parts and coarse shadows do, all round it they do not (experiment 075).
TURNING_SPAN_DEG = 90.0
SUN_FROM = 0.05  # share of the steps at which a moving Sun is first tested, before any growth


@dataclass(frozen=True)
class LightSettings:
    """What the radiance of a Gaussian may depend on."""

    sh_degree: int = number(3, most=3)  # of the spherical harmonics at the start
    # above 0: only degree 0 is trained at first, and one degree more after each such interval
    sh_interval: int = 0
    # the degree is raised up to this where the gain exceeds the BIC penalty
    max_sh_degree: int = number(0, most=3)
    sun_span_deg: float = 0.0  # above 0: the Sun is tested too where its direction spans more than this
    # albedo, normal and cast shadows | harmonics towards the Sun
    sun_shading: Literal["lambert", "linear"] = "lambert"
    # given to all Gaussians where withheld frames are explained better, and where the Sun moves
    highlights: bool = False

    def __post_init__(self):
        check(self, "light")

    def moves(self, span_deg: float) -> bool:
        """Return whether a Sun whose direction spans so much is one that moves."""
        return 0 < self.sun_span_deg < span_deg


@dataclass
class Shadows:
    """The shadow maps of a model, by the Sun's direction; the model changes slowly, so they are kept for some steps."""

    maps: dict[tuple[float, ...], ShadowMap] = field(default_factory=dict)

    def sunlit(self, gaussians: Gaussians, cameras: Cameras, step: int) -> Tensor | None:
        """Return the share of each camera's Sun that reaches each Gaussian [C, N]; None unless shading is Lambert's."""
        if gaussians.shading != "lambert":
            return None
        if step % SHADOW_INTERVAL == 0:
            self.maps = {}
        used = []
        for sun_dir in cameras.known_suns():
            sun = tuple(sun_dir.tolist())
            if sun not in self.maps:
                self.maps[sun] = shadow_map(gaussians, sun_dir)
            used.append(self.maps[sun])
        return lit_shares(gaussians, used)


def freeze_later_degrees(gaussians: Gaussians, step: int, settings: LightSettings) -> None:
    """Clear the gradients of the coefficients whose degree is not trained yet at a step, the first is 1 (3DGS)."""
    gradient = gaussians.sh.grad
    if settings.sh_interval and gradient is not None:
        degree = step // settings.sh_interval
        gradient[:, (degree + 1) ** 2 :] = 0


def raised_degree(
    gaussians: Gaussians,
    batches: Batches,
    sensor: Sensor,
    directions: tuple[Literal["view", "sun"], ...],
    settings: LightSettings,
    albedos_turn: bool,
    rng: torch.Generator,
) -> tuple[Gaussians | None, str]:
    """Return the Gaussians with the next harmonic degree, None if its gain is below the BIC penalty, and the reason.

    Constant radiance turns with the first of the directions whose gain exceeds its penalty; a model that turns with one
    already keeps it. A moving Sun is tested first, because it is known to change what is seen. The larger of the two
    gains is no guide: each frame has one view and one Sun, so either explains much of the other, and neighbouring
    Gaussians count the same light twice (on a tumbling target the view gained 1.66 and the Sun 1.52 Mnats, but held-out
    views reached 30.6 dB with the view and 33.9 dB with the Sun).

    Args:
        albedos_turn: under Lambert's law, see `TrainingSetup.albedos_turn`.

    Returns:
        The reason is empty where nothing was tested, because the degree may not rise further.
    """
    degree = math.isqrt(gaussians.sh.shape[1])  # the next one
    highest = (
        min(settings.max_sh_degree, SUN_DEGREE) if gaussians.shading == "sun" else settings.max_sh_degree
    )
    if degree > highest or gaussians.shading == "lambert":
        return None, ""
    tested, raised = [], None
    for direction in directions if degree == 1 else (gaussians.shading,):
        turning = dataclasses.replace(gaussians, shading=direction)
        gain, penalty = next_degree_gain(turning, batches, sensor, rng)
        tested.append(
            f"with the {direction} it would gain {gain:,.0f} nats at a BIC penalty of {penalty:,.0f}"
        )
        if gain > penalty:
            if direction == "sun" and settings.sun_shading == "lambert":
                raised = padded(lambertian(gaussians), SUN_DEGREE if albedos_turn else 0)
            else:
                raised = padded(turning, degree)
            raised = raised.trainable()
            break
    return raised, f"degree {degree}: {'; '.join(tested)}"


def described(gaussians: Gaussians, *reasons: str) -> str:
    """Return what the radiance depends on, in words, with the reasons where there are some."""
    turns = gaussians.sh.shape[1] > 1
    what = f"turns with the {gaussians.shading}" if turns else "constant"
    if gaussians.shading == "lambert":
        what = f"follows Lambert's law with cast shadows, ambient {gaussians.ambient.item():.3f} of the Sun"
        what += ", albedos that turn with the Sun" if turns else ""
    if gaussians.has_highlights:
        what += f", with highlights of roughness {gaussians.gloss[0].exp().item():.2f}"
    why = "; ".join(reason for reason in reasons if reason)
    return f"{what} ({why})" if why else what
