"""The motion of a target found from silhouettes alone: every spin on a short arc, then longer and longer arcs."""

import dataclasses
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from obbgs_core.attitude.coherence import FILL, coherences, grid_points
from obbgs_core.attitude.motion import TUMBLE, at_epoch, attitudes, turned
from obbgs_core.attitude.refine import refined
from obbgs_core.attitude.views import Views

log = logging.getLogger(__name__)
ARC = 13  # views of the first arc
MOST_TURN_RAD = 0.75  # of the target between two views: eight views a turn
GRID_RAD = 0.5  # spacing of the candidates, of the angle turned from the middle of the arc to its end
AT_ONCE = 16  # candidates, bounds the memory
KEPT = 16  # candidates of the grid that are refined
APART_RAD = 0.3  # candidates closer than this at the arc's end are the same
BEAM = 6  # candidates that are followed to longer arcs
GROWTH = 1.4  # of the arc
FIRST_STEPS, STEPS = 8, 5  # of refinement
WORSE = 2.0  # candidates with a cost above the best by this factor are dropped


@dataclass(frozen=True)
class Candidate:
    """A motion [3 or 8] and how badly silhouettes fit it, per ray."""

    parameters: np.ndarray
    cost: float


def spins(views: Views, on_share: Callable[[float], None]) -> np.ndarray:
    """Return the most coherent angular velocities [K, 3] rad/s of an arc, among all up to eight views a turn."""
    span_s = float(np.abs(views.times_s).max())
    most = MOST_TURN_RAD * span_s / float(np.median(np.diff(views.times_s)))
    ticks = np.arange(-np.floor(most / GRID_RAD), most / GRID_RAD + 1) * GRID_RAD
    turns = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    turns = turns[np.linalg.norm(turns, axis=1) <= most]
    points = grid_points(FILL * views.cell)
    found = []
    for first in range(0, len(turns), AT_ONCE):
        body = attitudes(turns[first : first + AT_ONCE] / span_s, views.times_s)
        found.append(coherences(views, torch.from_numpy(body).float(), points))
        on_share(first / len(turns))
    coherence = torch.cat(found).numpy()
    chosen: list[int] = []
    for index in np.argsort(-coherence, kind="stable"):
        if all(np.linalg.norm(turns[index] - turns[other]) > 1.5 * GRID_RAD for other in chosen):
            chosen.append(int(index))
        if len(chosen) == KEPT:
            break
    median = float(np.median(coherence))
    log.info("%d spins: coherence at most %.3f, median %.3f", len(turns), coherence[chosen[0]], median)
    return turns[chosen] / span_s


def mirrored(motions: np.ndarray, view_to_inertial: np.ndarray) -> np.ndarray:
    """Return the motions [K, 3 or 8] of mirrored targets that show the same outlines from far away in one direction.

    The reflection in the plane of the picture acts on them as half a turn about the line of sight does.
    """
    flip = view_to_inertial @ np.diag([-1.0, -1.0, 1.0]) @ view_to_inertial.T
    return np.stack([turned(motion, flip) for motion in motions])


def apart_rad(a: Candidate, b: Candidate, views: Views) -> float:
    """Return the largest angle between the attitudes of two candidates at the two ends of the arc."""
    ends_s = np.array([views.times_s.min(), views.times_s.max()])
    first, second = (attitudes(c.parameters[None], ends_s)[0] for c in (a, b))
    cosines = (np.einsum("nij,nij->n", first, second) - 1) / 2
    return float(np.arccos(np.clip(cosines, -1, 1)).max())


def distinct(candidates: list[Candidate], views: Views) -> list[Candidate]:
    """Return the candidates that fit nearly as well as the best, best first, one of those that are the same motion."""
    ranked = sorted(candidates, key=lambda c: c.cost)
    kept: list[Candidate] = []
    for candidate in ranked:
        fits = candidate.cost <= WORSE * ranked[0].cost
        if fits and all(apart_rad(candidate, other, views) > APART_RAD for other in kept):
            kept.append(candidate)
    return kept[:BEAM]


def searched(
    coarse: Views, fine: Views, arc: np.ndarray, on_progress: Callable[[str, float], None]
) -> list[Candidate]:
    """Return motions that may explain all views, best first, from every spin that explains an arc of them.

    Args:
        coarse, fine: the same views in two resolutions.
        arc: indices of views.
        on_progress: called with what is being done and the share of it that is done.
    """
    epoch_s = float(fine.times_s[arc[len(arc) // 2]])
    coarse, fine = (dataclasses.replace(v, times_s=v.times_s - epoch_s) for v in (coarse, fine))
    candidates = _first(coarse.some(arc), fine.some(arc), on_progress)
    candidates = _followed(fine, candidates, int(arc[0]), int(arc[-1]) + 1, on_progress)
    return [Candidate(at_epoch(c.parameters, -epoch_s), c.cost) for c in candidates]


def _first(coarse: Views, fine: Views, on_progress: Callable[[str, float], None]) -> list[Candidate]:
    """Return the spins that fit an arc best, best first."""
    rates = spins(coarse, lambda share: on_progress("searching the spin", share))
    axes = fine.world_to_camera[len(fine) // 2, :3, :3].double().numpy().T
    rates = np.concatenate([rates, mirrored(rates[: KEPT // 2], axes)])
    moved, costs = refined(fine, rates, FIRST_STEPS)
    return distinct([Candidate(p, float(c)) for p, c in zip(moved, costs, strict=True)], fine)


def _followed(
    fine: Views, candidates: list[Candidate], low: int, high: int, on_progress: Callable[[str, float], None]
) -> list[Candidate]:
    """Return the candidates after they were refined on longer and longer arcs, best first."""
    whole = False
    while not whole:
        on_progress("following the motion", (high - low) / len(fine))
        grown = math.ceil((high - low) * (GROWTH - 1) / 2)
        low, high = max(0, low - grown), min(len(fine), high + grown)
        whole = low == 0 and high == len(fine)
        sub = fine.some(np.arange(low, high))
        starts = np.stack([np.pad(c.parameters, (0, TUMBLE - len(c.parameters))) for c in candidates])
        moved, costs = refined(sub, starts, STEPS)
        candidates = distinct([Candidate(p, float(c)) for p, c in zip(moved, costs, strict=True)], sub)
        shown = ", ".join(f"{c.cost:.3f}" for c in candidates)
        log.info("%d of %d views: costs of the candidates %s", high - low, len(fine), shown)
    return candidates
