"""The motion of a target whose attitude nobody knows, from the frames of a pass alone."""

import logging
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from obbgs_base.errors import Interrupted
from obbgs_core.attitude import search
from obbgs_core.attitude.coherence import hull_axes
from obbgs_core.attitude.motion import SPIN, TUMBLE, attitudes, principal
from obbgs_core.attitude.outlines import outlines
from obbgs_core.attitude.refine import cost, difference_steps, refined, spread
from obbgs_core.attitude.target_motion import TargetMotion
from obbgs_core.attitude.views import Views, views
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
COARSE, FINE = 16, 32  # cells across the pictures of the grid search, and of the refinement
FEWEST_VIEWS = 2 * search.ARC
ARCS = (
    (0.5, 1),
    (0.25, 1),
    (0.75, 1),
    (0.5, 3),
)  # middle of the first arc as a share of the pass, views skipped
UNRELATED = 12  # random motions whose disagreement shows what no relation looks like
EXPLAINED = 0.15  # a motion explains the outlines when it leaves less than this share of that disagreement
TUMBLES = 0.9  # a tumble is believed when it leaves less than this share of what a steady spin leaves
OVERDISPERSION = 2.0  # by which measured errors exceed the deviations of the refinement
LEAST_UNRELATED = 1.0  # disagreement, per ray: true motions of other targets leave 0.5 to 1
# of that disagreement, at most, is left when a body is rolled about an axis that it is round about
ROUND = 0.05
LARGEST_SIGMA_DEG = 10.0  # of the attitude in the mean of the pass; with more it counts as not determined
POLISHING = 8  # steps


class AttitudeUndetermined(ReconstructionError):
    """The frames do not determine the target's attitude; the message says why."""


def estimate_motion(
    frames: list[TrainingFrame],
    times_s: np.ndarray,
    sensor: Sensor,
    on_progress: Callable[[str, float], None] = lambda what, share: None,
    should_stop: Callable[[], bool] = lambda: False,
    seed: int = 0,
    decide: Callable[[list[TargetMotion]], int | None] = lambda motions: None,
) -> TargetMotion:
    """Return the motion that makes the outlines of a pass agree on one body.

    Args:
        frames: with poses and Sun relative to inertial axes through the target's centre of mass.
        times_s: [N] of the frames; time 0 is the reference epoch.
        on_progress: called with what is being done and the share of it that is done.
        decide: called with motions whose outlines agree equally well; returns the index of the right one, None where it
            cannot tell.

    Raises:
        AttitudeUndetermined: too few frames show light, no motion explains them, or several do.
        Interrupted: should_stop returned true.
    """
    found, radius_m = outlines(frames, sensor, FINE)
    if len(found) < FEWEST_VIEWS:
        raise AttitudeUndetermined(
            f"the target's attitude is not known and cannot be found: {len(found)} brackets show light (eclipse, or "
            f"exposures too short), at least {FEWEST_VIEWS} are needed"
        )
    order = sorted(found, key=lambda i: times_s[i])
    silhouettes, at_s = [found[i] for i in order], times_s[order]
    coarse, fine = (views(silhouettes, at_s, radius_m, cells) for cells in (COARSE, FINE))
    unrelated = _unrelated_cost(fine, seed)
    if unrelated < LEAST_UNRELATED:
        raise AttitudeUndetermined(
            "the target's attitude is not known and cannot be found: its outlines agree under any motion, as those "
            "of a body that looks alike from all sides do; give its attitude"
        )

    def report(what: str, share: float) -> None:
        if should_stop():
            raise Interrupted("interrupted while the target's attitude was searched; nothing of it is kept")
        on_progress(what, share)

    best = _candidates(coarse, fine, unrelated, report)
    report("judging the motion", 0.0)
    return _decided(_judged(best, fine, unrelated, seed), fine, unrelated, seed, decide)


def _candidates(
    coarse: Views, fine: Views, unrelated: float, report: Callable[[str, float], None]
) -> list[search.Candidate]:
    """Return motions that may explain all views, best first, from one arc after another until one explains them."""
    best: list[search.Candidate] = []
    for middle, stride in ARCS:
        arc = _arc(len(fine), middle, stride)
        if arc is None:
            continue
        candidates = search.searched(coarse, fine, arc, report)
        best = _ranked([*best, *candidates], fine)
        share = best[0].cost / unrelated
        log.info("from view %d: %s of the unrelated disagreement", arc[len(arc) // 2], share)
        if share < EXPLAINED:
            break
    return best


def _arc(count: int, middle: float, stride: int) -> np.ndarray | None:
    """Return the indices of the views of a first arc; None where the pass is too short for it."""
    half = search.ARC // 2 * stride
    if 2 * half + 1 > count:
        return None
    centre = int(np.clip(round(middle * (count - 1)), half, count - 1 - half))
    return centre + stride * np.arange(-(search.ARC // 2), search.ARC // 2 + 1)


def _unrelated_cost(fine: Views, seed: int) -> float:
    """Return the median cost of random spins of up to half a turn from view to view."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(UNRELATED, 3))
    turns = rng.uniform(0.1, np.pi, UNRELATED) / np.median(np.diff(fine.times_s))
    rates = directions / np.linalg.norm(directions, axis=1, keepdims=True) * turns[:, None]
    return float(np.median(refined(fine, rates, 0)[1]))


def _ranked(candidates: list[search.Candidate], fine: Views) -> list[search.Candidate]:
    """Return the different candidates, best first, their costs taken on the same rays of all views."""
    scored = [
        search.Candidate(c.parameters, float(refined(fine, c.parameters[None], 0)[1][0])) for c in candidates
    ]
    return search.distinct(scored, fine)


def _judged(best: list[search.Candidate], fine: Views, unrelated: float, seed: int) -> list[TargetMotion]:
    """Return the motions that explain the outlines equally well, best first, each a spin if that does as well.

    Raises:
        AttitudeUndetermined: nothing explains the outlines.
    """
    axes = fine.world_to_camera[int(np.abs(fine.times_s).argmin()), :3, :3].double().numpy().T
    mirror = search.mirrored(best[0].parameters[None], axes)[0]
    polished = []
    for parameters in (*(candidate.parameters for candidate in best[:2]), mirror):
        found = []
        for size in (SPIN, TUMBLE):
            moved, costs = refined(fine, parameters[None, :size], POLISHING, seed)
            found.append(search.Candidate(moved[0], float(costs[0])))
        steady, tumble = found
        polished.append(tumble if tumble.cost < TUMBLES * steady.cost else steady)
    ranked = search.distinct(polished, fine)
    share = ranked[0].cost / unrelated
    if share >= EXPLAINED:
        raise AttitudeUndetermined(
            "the target's attitude is not known and cannot be found: no spin and no torque-free tumble with at least "
            f"eight brackets a turn makes the outlines of {len(fine)} brackets agree (the best leaves {share:.0%} of "
            "the disagreement of unrelated motions). The target may look alike from all sides, turn faster than the "
            "brackets follow, or not turn freely; take brackets more often, or give its attitude"
        )
    equal = [c.parameters for c in ranked if c.cost <= ranked[0].cost / TUMBLES]
    return [
        TargetMotion(p, OVERDISPERSION**2 * spread(fine, p, seed), _own_axes(p), share, len(fine))
        for p in equal
    ]


def _decided(
    motions: list[TargetMotion],
    fine: Views,
    unrelated: float,
    seed: int,
    decide: Callable[[list[TargetMotion]], int | None],
) -> TargetMotion:
    """Return the right one of motions that explain the outlines equally well.

    Raises:
        AttitudeUndetermined: nothing tells them apart, or they leave the attitude open.
    """
    if _is_round(motions[0], fine, unrelated, seed):
        raise AttitudeUndetermined(
            "the target's attitude is not known and cannot be found: its outlines are those of a body that is round "
            "about an axis, and do not show how it rolls about that; give its attitude"
        )
    chosen = 0 if len(motions) == 1 else decide(motions)
    if chosen is None:
        first, second = (search.Candidate(m.parameters, 0.0) for m in motions[:2])
        apart = np.degrees(search.apart_rad(first, second, fine))
        raise AttitudeUndetermined(
            f"the target's attitude is not known and cannot be found: two motions, {apart:.0f} degrees apart, explain "
            f"the outlines of {len(fine)} brackets equally well, and nothing else tells them apart. The target may be "
            "too symmetric, or seen from one side only; take brackets from more directions, or give its attitude"
        )
    motion = motions[chosen]
    sigma_deg = float(np.degrees(_attitude_sigma_rad(motion.parameters, motion.covariance, fine.times_s)))
    if sigma_deg > LARGEST_SIGMA_DEG:
        raise AttitudeUndetermined(
            "the target's attitude is not known and cannot be found: the outlines leave it open by "
            f"{sigma_deg:.0f} degrees in the mean of the pass; give its attitude"
        )
    return motion


def _is_round(motion: TargetMotion, fine: Views, unrelated: float, seed: int) -> bool:
    """Return whether the outlines agree even when the body is rolled at random about an axis of its hull."""
    body = motion.inertial_to_body(fine.times_s)
    axes = hull_axes(fine, torch.from_numpy(body).float()).double().numpy()
    angles = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(fine))
    rolled = [
        cost(fine, Rotation.from_rotvec(angles[:, None] * axis).as_matrix() @ body, seed) for axis in axes.T
    ]
    log.info(
        "rolled about axes of its hull: at least %.3f of the unrelated disagreement", min(rolled) / unrelated
    )
    return min(rolled) < ROUND * unrelated


def _attitude_sigma_rad(parameters: np.ndarray, covariance: np.ndarray, times_s: np.ndarray) -> float:
    """Return the standard deviation of the attitude, rad, root mean square over the times."""
    small = difference_steps(parameters, times_s, 1e-4)
    body = attitudes(np.concatenate([parameters[None], parameters + np.diag(small)]), times_s)
    slopes = ((body[1:] - body[0]) / small[:, None, None, None]).reshape(len(parameters), -1)
    # a small turn changes the nine entries of a rotation by the square root of two times its angle
    return float(np.sqrt(np.einsum("kn,kl,ln->", slopes, covariance, slopes) / 2 / len(times_s)))


def _own_axes(parameters: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] from the inertial axes at the epoch to the target's own."""
    if len(parameters) == TUMBLE:
        return principal(parameters).axes.T
    z = parameters / max(np.linalg.norm(parameters), 1e-12)
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(helper, z) / np.linalg.norm(np.cross(helper, z))
    return np.stack([x, np.cross(z, x), z])
