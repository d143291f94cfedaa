"""Where a design lies in a model's axes: a rotation, a shift and a size, with their covariance, robust to faults."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from obbgs_core.errors import ReconstructionError
from obbgs_core.inspect.cad import CadMesh, Samples, principal_axes, sampled

STARTS = 160  # rotations drawn evenly, besides those that bring principal or file axes together
FIRST_POINTS, COARSE_POINTS, FEW_POINTS, FINE_POINTS = (
    120,
    400,
    1500,
    6000,
)  # of the model that a step looks at
FIRST_STEPS, COARSE_STEPS, FINE_STEPS = 4, 10, 30
KEPT, BEST = 30, 6  # places that are looked at more closely, after the first steps and before the fine ones
TRIMMED = 0.75  # of the model's points count in the coarse search: the others may be faults
TRIMMED_BACK = 0.5  # of the design's: the frames do not show all of it
KNEE = 4.685  # of Tukey's biweight, in robust standard deviations: 95 % efficient where errors are normal
SAME_NORMAL = (
    0.5  # cosine between normals of points that can be the same, at least; either side of a thin plate
)
SYMMETRIC = 1.15  # times the best misfit: another rotation that fits so well cannot be told from it
APART_RAD = np.radians(15.0)
LEAST_SIGMA_PX = 0.1  # of a surface, also of one that is compared with itself
CORRELATED_PX = (
    4.0  # over which a surface's errors are alike: a square of this width counts as one observation
)


@dataclass(frozen=True)
class Surface:
    """What a model shows: points [N, 3] m, unit normals [N, 3], area [N] m² each, and the width of a pixel there, m."""

    points: np.ndarray
    normals: np.ndarray
    area: np.ndarray
    pixel_m: float

    def select(self, chosen: np.ndarray) -> "Surface":
        return Surface(self.points[chosen], self.normals[chosen], self.area[chosen], self.pixel_m)

    def thinned(self, count: int, rng: np.random.Generator) -> "Surface":
        """Return so many of the points at most, drawn by their areas, each of an equal share of the area."""
        if count >= len(self.points):
            return self
        total = self.area.sum()
        chosen = rng.choice(len(self.points), count, replace=False, p=self.area / total)
        return Surface(self.points[chosen], self.normals[chosen], np.full(count, total / count), self.pixel_m)


@dataclass(frozen=True)
class Similarity:
    """A design's place: x_body = scale * rotation @ x_design + shift.

    covariance: [7, 7] of a rotation vector (rad, body axes, about `pivot`), a shift (m) and the scale's logarithm.
    thicker_m: how far the surface lies outside of the design all over: a model's bias, which would else pass for size.
    sigma_m: robust standard deviation of the distances from the surface to the design, along its normals.
    other_rotations: [k, 3, 3] of the body, by which the design can be turned without fitting noticeably worse.
    """

    rotation: np.ndarray
    shift: np.ndarray
    scale: float
    pivot: np.ndarray
    covariance: np.ndarray
    sigma_m: float
    thicker_m: float
    other_rotations: np.ndarray

    def matrix(self) -> np.ndarray:
        """Return it as a matrix [4, 4]."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.shift
        return matrix

    def of(self, samples: Samples) -> Samples:
        """Return samples of the design in the body's axes, m."""
        points = self.scale * samples.points @ self.rotation.T + self.shift
        return Samples(points, samples.normals @ self.rotation.T, samples.part, samples.area * self.scale**2)


def aligned(cad: CadMesh, surface: Surface, seed: int = 0) -> Similarity:
    """Return where a design lies, of any size and in any position, that a surface shows a part of.

    Iterated closest points (Besl and McKay 1992) from many rotations, trimmed (Chetverikov et al. 2002), then point to
    plane (Chen and Medioni 1992) with Tukey's weights, so that what is faulty or missing does not pull.

    Raises:
        ReconstructionError: fewer than 100 points of surface.
    """
    if len(surface.points) < 100:
        raise ReconstructionError(
            f"the model shows {len(surface.points)} points of a surface, at least 100 are needed: train it with more "
            "or better exposed frames"
        )
    rng = np.random.default_rng(seed)
    size = float(np.ptp(cad.vertices, axis=0).max())
    coarse = sampled(cad, size / 60, seed, 4000)
    few = surface.thinned(COARSE_POINTS, rng)
    found = _searched(coarse, few, _starts(coarse, few, rng))
    # the design's samples lie closer together than the surface's errors are large
    fine = sampled(cad, 0.7 * surface.pixel_m / found[0][2], seed)
    some, many = surface.thinned(FEW_POINTS, rng), surface.thinned(FINE_POINTS, rng)
    distinct: list = []
    for start in found:
        if all(_apart(start[0], other[0]) > APART_RAD for other in distinct):
            distinct.append(start)
        if len(distinct) == BEST:
            break
    refined = sorted((refine(fine, some, *start) for start in distinct), key=lambda pair: pair[0])
    first = refined[0][1]
    best = refine(fine, many, first.rotation, first.shift, first.scale)[1]
    others = [
        place.rotation @ best.rotation.T
        for misfit, place in refined[1:]
        if misfit < SYMMETRIC * refined[0][0] and _apart(place.rotation, best.rotation) > APART_RAD
    ]
    return Similarity(
        *(best.rotation, best.shift, best.scale, best.pivot, best.covariance, best.sigma_m, best.thicker_m),
        np.array(others).reshape(-1, 3, 3),
    )


def refine(
    design: Samples,
    surface: Surface,
    rotation: np.ndarray,
    shift: np.ndarray,
    scale: float,
    rigid: bool = False,
) -> tuple[float, Similarity]:
    """Return misfit, m, and place of a design after robust steps from point to plane, from a place that is near.

    The misfit is the mean over all points of their distance, cut off at five pixels.

    Args:
        rigid: the size stays.
    """
    tree = KDTree(design.points)
    place = (rotation, shift, scale)
    pivot = surface.points.mean(axis=0)
    free = [0, 1, 2, 3, 4, 5, 7] if rigid else list(range(8))
    cut_m = 5 * surface.pixel_m
    sigma_m, thicker_m = cut_m, 0.0
    for step in range(FINE_STEPS):
        rows, residual, away = _rows(design, tree, surface, place, pivot)
        close = np.abs((residual - thicker_m * rows[:, 7])[away < 2 * cut_m])
        sigma_m = (
            max(1.4826 * float(np.median(close)), LEAST_SIGMA_PX * surface.pixel_m) if len(close) else cut_m
        )
        limit = KNEE * max(sigma_m, cut_m * 0.7**step)
        weight = np.clip(1 - (np.minimum(away, np.inf) / limit) ** 2, 0, None) ** 2
        normal = rows[:, free].T @ (weight[:, None] * rows[:, free])
        change = np.zeros(8)
        change[free] = np.linalg.lstsq(normal, rows[:, free].T @ (weight * residual), rcond=1e-10)[0]
        place, thicker_m = _stepped(place, change, pivot), float(change[7])
        if (
            step > 12
            and np.abs(change[:3]).max() < 1e-6
            and np.abs(change[3:6]).max() < 1e-5 * surface.pixel_m
        ):
            break
    rows, residual, away = _rows(design, tree, surface, place, pivot)
    near = away < KNEE * sigma_m
    whole = np.zeros((8, 8))
    whole[np.ix_(free, free)] = covariance_of(rows[:, free], residual - thicker_m * rows[:, 7], near, surface)
    misfit = float(np.minimum(away, cut_m).mean())
    none = np.zeros((0, 3, 3))
    return misfit, Similarity(place[0], place[1], place[2], pivot, whole[:7, :7], sigma_m, thicker_m, none)


def covariance_of(rows: np.ndarray, residual: np.ndarray, near: np.ndarray, surface: Surface) -> np.ndarray:
    """Return the covariance of a least-squares fit whose errors are alike over squares of CORRELATED_PX.

    Each point counts as the share of such a square that its area is (the effective number of observations).
    """
    if near.sum() < rows.shape[1]:
        return np.full((rows.shape[1],) * 2, np.inf)
    share = np.minimum(1.0, surface.area / (CORRELATED_PX * surface.pixel_m) ** 2)[near]
    variance = (
        float((share * residual[near] ** 2).sum() / share.sum()) + (LEAST_SIGMA_PX * surface.pixel_m) ** 2
    )
    information = rows[near].T @ (share[:, None] * rows[near])
    return variance * np.linalg.pinv(information, rcond=1e-12, hermitian=True)


def _rows(
    design: Samples, tree: KDTree, surface: Surface, place: tuple, pivot: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return derivatives [N, 8] of the planes' places, residuals [N] m and distances [N] m of the surface's points.

    The last derivative is that by the surface's distance outwards, along its own normals.
    """
    rotation, shift, scale = place
    there = (surface.points - shift) @ rotation / scale
    distance, nearest = tree.query(there)
    normals = design.normals[nearest] @ rotation.T
    points = scale * design.points[nearest] @ rotation.T + shift
    residual = (normals * (surface.points - points)).sum(axis=1)
    away = distance * scale
    # the nearest of sampled points is up to a spacing off along the plane, which is no error
    cosine = (normals * surface.normals).sum(axis=1)
    arm = points - pivot
    growth = (normals * arm).sum(axis=1, keepdims=True)
    rows = np.concatenate([np.cross(arm, normals), normals, growth, np.sign(cosine)[:, None]], axis=1)
    return rows, residual, np.where(np.abs(cosine) > SAME_NORMAL, away, np.inf)


def _stepped(place: tuple, change: np.ndarray, pivot: np.ndarray) -> tuple:
    """Return a place after a rotation vector about the pivot, a shift and a growth."""
    turn, growth = Rotation.from_rotvec(change[:3]).as_matrix(), float(np.exp(np.clip(change[6], -0.2, 0.2)))
    rotation, shift, scale = place
    return turn @ rotation, growth * turn @ (shift - pivot) + pivot + change[3:6], growth * scale


def _searched(design: Samples, surface: Surface, starts: list[tuple]) -> list[tuple]:
    """Return places of a design from many starts, the best first: the most promising ones after more steps."""
    places = starts
    for count, steps in ((FIRST_POINTS, FIRST_STEPS), (COARSE_POINTS, COARSE_STEPS)):
        points = surface.points[:: max(1, len(surface.points) // count)]
        some = design.points[:: max(1, len(design.points) // count)]
        trees = KDTree(design.points), KDTree(points)
        found = [_coarse(design.points, points, some, trees, place, steps) for place in places]
        found.sort(key=lambda pair: pair[0])
        places = [place for _, place in found[:KEPT]]
    return places


def _coarse(
    design: np.ndarray,
    surface: np.ndarray,
    some: np.ndarray,
    trees: tuple[KDTree, KDTree],
    start: tuple,
    steps: int,
) -> tuple[float, tuple]:
    """Return misfit, in sizes of the surface, and place after steps from point to point.

    Args:
        design [N, 3] and surface [M, 3], with their trees; some: of the design's points, which are looked for.
    """
    rotation, shift, scale = start
    size, (forth, back), misfit = float(surface.std()), trees, np.inf
    for step in range(steps + 1):
        there = (surface - shift) @ rotation / scale
        distance, nearest = forth.query(there)
        away, seen = back.query(scale * some @ rotation.T + shift)
        kept = np.argsort(distance)[: int(TRIMMED * len(distance))]
        kept_back = np.argsort(away)[: int(TRIMMED_BACK * len(away))]
        misfit = float((scale * distance[kept]).mean() + away[kept_back].mean()) / size
        if step < steps:
            x = np.concatenate([design[np.asarray(nearest)[kept]], some[kept_back]])
            y = np.concatenate([surface[kept], surface[np.asarray(seen)[kept_back]]])
            rotation, shift, scale = _similar(x, y, scale)
    return misfit, (rotation, shift, scale)


def _similar(x: np.ndarray, y: np.ndarray, scale: float) -> tuple:
    """Return the similarity that brings points x [N, 3] nearest to y [N, 3] (Umeyama 1991); its size changes slowly."""
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    u, singular, vt = np.linalg.svd((y - y_mean).T @ (x - x_mean))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = (u * sign) @ vt
    fitted = float((singular * sign).sum() / ((x - x_mean) ** 2).sum())
    scale = float(np.clip(fitted, 0.9 * scale, 1.1 * scale))
    return rotation, y_mean - scale * rotation @ x_mean, scale


def _starts(design: Samples, surface: Surface, rng: np.random.Generator) -> list[tuple]:
    """Return places to start from: axes upon axes in all 24 ways, principal axes upon each other, and random ones."""
    cube = Rotation.create_group("O").as_matrix()
    axes = [principal_axes(points) for points in (design.points, surface.points)]
    for frame in axes:
        frame[2] *= np.sign(np.linalg.det(frame)) or 1.0
    rotations = [
        *cube,
        *(axes[1].T @ turn @ axes[0] for turn in cube),
        *Rotation.random(STARTS, rng=rng).as_matrix(),
    ]
    middles = [np.median(p, axis=0) for p in (design.points, surface.points)]
    spreads = [
        np.quantile(np.linalg.norm(p - m, axis=1), 0.9)
        for p, m in zip((design.points, surface.points), middles, strict=True)
    ]
    scale = float(spreads[1] / spreads[0])
    return [(turn, middles[1] - scale * turn @ middles[0], scale) for turn in rotations]


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between two rotations, rad."""
    return float(np.arccos(np.clip((np.trace(first @ second.T) - 1) / 2, -1, 1)))
