"""Chooses by likelihood what the radiance depends on: the direction of view, that of the Sun, or Lambert's law."""

import dataclasses
import math
from typing import Literal

import torch

from obbgs_core.batches import Batches
from obbgs_core.evidence.gains import next_degree_gain, padded
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.lighting import lambertian
from obbgs_core.sensor import Sensor

SUN_DEGREE = 1  # of harmonics towards the Sun, at most: a face is as bright as the cosine of the Sun's angle


def raised_degree(
    gaussians: Gaussians,
    batches: Batches,
    sensor: Sensor,
    directions: tuple[Literal["view", "sun"], ...],
    highest: int,
    linear: bool,
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
        highest: degree, at most.
        linear: a radiance that turns with the Sun is one of harmonics, instead of following Lambert's law.
        albedos_turn: under Lambert's law, with the Sun.

    Returns:
        The reason is empty where nothing was tested, because the degree may not rise further.
    """
    degree = math.isqrt(gaussians.sh.shape[1])  # the next one
    highest = min(highest, SUN_DEGREE) if gaussians.shading == "sun" else highest
    if degree > highest or gaussians.shading == "lambert":
        return None, ""
    tested, raised = [], None
    for direction in directions if degree == 1 else (gaussians.shading,):
        turning = dataclasses.replace(gaussians, shading=direction)
        evidence = next_degree_gain(turning, batches, sensor, rng)
        tested.append(
            f"with the {direction} it would gain {evidence.gain:,.0f} nats at a BIC penalty of {evidence.penalty:,.0f}"
        )
        if evidence.justifies:
            if direction == "sun" and not linear:
                raised = padded(lambertian(gaussians), SUN_DEGREE if albedos_turn else 0)
            else:
                raised = padded(turning, degree)
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
