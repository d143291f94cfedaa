"""How the plates of a design are turned: each panel is registered for itself, against the rest of the body."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from obbgs_core.inspect.alignment import Surface, refine
from obbgs_core.inspect.cad import Samples, groups_within, principal_axes

JOINED_PX = 1.5  # samples of one part nearer to each other are of one piece
FLAT = 0.25  # of a plate's width at most is its thickness
EVEN, FACING = (
    0.7,
    0.9,
)  # of a plate's samples face along its normal, by that cosine at least: a ring's do not
NARROWEST_PX = 5.0  # width of a plate whose turn is looked at
ATTACHED = 0.8  # of a piece's samples within a plate's box: it moves with it
BESIDE_PX = 2.0
# a sample is of the outline if the mean of its neighbours so near lies by that share of the distance to one side
OUTLINE_PX, OUTLINE = 2.5, 0.25
HELD = 0.8  # of a plate's outline joins the rest of the design: it is a face of a body, which does not turn by itself
TURNS_DEG = (-24.0, -16.0, -8.0, 8.0, 16.0, 24.0)
TRIED = 3  # starts that are refined
MOST_POINTS = 2000  # of the surface, that a plate is laid on
CUT_PX = 4.0
FOUND = 0.6  # of a plate's shown samples that lie on the surface, for its turn to be told
BETTER = 0.6  # of the misfit of where it should be is left by a turn that is believed, at most
MOST_RAD = np.radians(32.0)  # a plate is not looked for beyond
SYSTEMATIC_PX = 0.2  # by which the ends of a model's plate may lie off, alike over the whole plate
SEEN = 0.1  # of a plate's samples, at least, that the frames show, for its turn to be told
# Of the mean distance of where a panel should be, that its turn leaves at most: 0.2 to 1.28 of panels that are turned,
# 1.32 to 1.75 of a sound dish that passed for turned by 6 to 8 degrees.
NEARER = 1.3
Z_90 = 1.645
TURNED_RAD = np.radians(2.5)  # of a panel, at least, to be told as turned
# The same in its standard deviations, where so much of it lies on the surface after its turn, and where less does: a
# sound dish of TDRS, of which 0.73 to 0.88 do, passes for turned by 12 degrees, 4.2 deviations, while the others stay
# below 2.1 and panels turned by 11 to 20 degrees have 2.3 to 16.
LAID, TURNED_SIGMAS, POORLY_LAID_SIGMAS = 0.9, 2.5, 4.5


@dataclass(frozen=True)
class Plate:
    """A flat panel of a design: the indices of its samples and of what moves with it, its middle and axes.

    axes: [3, 3], rows: along its length, along its width, its normal; extent: [3] m along them.
    """

    part: int
    own: np.ndarray
    members: np.ndarray
    middle: np.ndarray
    axes: np.ndarray
    extent: np.ndarray


@dataclass(frozen=True)
class Turn:
    """How a panel is turned against its design.

    motion: [4, 4], from design to as it is, body axes. tilt_rad: of its normal. axis: [3] of that turn. interval: of
    tilt_rad, 90 %. significance: the turn in its standard deviations. found: share of the shown samples that lie on the
    surface after the motion. left: their mean distance from it then, over that without the motion.
    """

    plate: Plate
    motion: np.ndarray
    tilt_rad: float
    axis: np.ndarray
    interval: tuple[float, float]
    significance: float
    found: float
    left: float


def is_turned(turn: Turn) -> bool:
    """Return whether a panel is turned, beyond what chance and the surface's errors make of one that is not."""
    least = TURNED_SIGMAS if turn.found > LAID else POORLY_LAID_SIGMAS
    return bool(turn.significance > least and turn.tilt_rad > TURNED_RAD and turn.left < NEARER)


def plates_of(design: Samples, pixel_m: float) -> list[Plate]:
    """Return the flat panels of a design (body axes, m), largest first, each piece of the design in one at most.

    A flat piece whose outline joins the rest of the design all around is a face of a body, and no panel: models round
    such faces where no frame shows them, which would pass for a turn.
    """
    pieces = np.zeros(len(design.points), dtype=np.int64)
    for part in np.unique(design.part):
        own = np.flatnonzero(design.part == part)
        pieces[own] = groups_within(design.points[own], JOINED_PX * pixel_m) + pieces.max() + 1
    order, counts = np.unique(pieces, return_counts=True)
    members_of = np.split(np.argsort(pieces, kind="stable"), np.cumsum(counts)[:-1])
    flat = [plate for own in members_of if (plate := _plate(design, own, pixel_m)) is not None]
    flat.sort(key=lambda plate: -plate.extent[0] * plate.extent[1])
    taken = np.zeros(len(design.points), dtype=bool)
    plates = []
    for plate in flat:
        if taken[plate.own].any():
            continue
        inside = _in_box(design.points, plate, BESIDE_PX * pixel_m)
        share = np.bincount(np.searchsorted(order, pieces), inside) / counts
        members = np.flatnonzero((share[np.searchsorted(order, pieces)] > ATTACHED) & ~taken)
        if _held(design.points, plate, members, pixel_m) > HELD:
            continue
        taken[members] = True
        plates.append(Plate(plate.part, plate.own, members, plate.middle, plate.axes, plate.extent))
    return plates


def _plate(design: Samples, own: np.ndarray, pixel_m: float) -> Plate | None:
    """Return a piece as a plate; None where it is not flat or too narrow."""
    points = design.points[own]
    if len(points) < 20:
        return None
    axes = principal_axes(points)
    axes[2] = np.cross(axes[0], axes[1])
    along = points @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    extent = high - low
    if extent[1] < NARROWEST_PX * pixel_m or extent[2] > FLAT * extent[1]:
        return None
    if (np.abs(design.normals[own] @ axes[2]) > FACING).mean() < EVEN:
        return None
    return Plate(int(design.part[own[0]]), own, own, (low + high) / 2 @ axes, axes, extent)


def _held(points: np.ndarray, plate: Plate, members: np.ndarray, pixel_m: float) -> float:
    """Return the share of a plate's outline that joins what of a design [N, 3] does not move with it."""
    own, reach = points[plate.own] @ plate.axes[:2].T, OUTLINE_PX * pixel_m
    near = KDTree(own).query_ball_point(own, reach)
    middles = np.array([own[indices].mean(axis=0) for indices in near])
    outline = np.linalg.norm(middles - own, axis=1) > OUTLINE * reach
    rest = np.delete(points, members, axis=0)
    if not outline.any() or not len(rest):
        return 0.0
    return float((KDTree(rest).query(points[plate.own[outline]])[0] < BESIDE_PX * pixel_m).mean())


def _in_box(points: np.ndarray, plate: Plate, margin: float) -> np.ndarray:
    """Return which points [N] lie in a plate's box, wider by a margin."""
    return np.all(np.abs((points - plate.middle) @ plate.axes.T) <= plate.extent / 2 + margin, axis=1)


def turn_of(plate: Plate, design: Samples, surface: Surface, shown: np.ndarray) -> Turn | None:
    """Return how a panel is turned; None where too little of it is shown or found.

    Starts are turns about its length and its width, through its middle and its edges.

    Args:
        design: whole, in the body's axes, m.
        shown: [N] which of its samples the frames would show.
    """
    pixel_m = surface.pixel_m
    panel = design.select(plate.members)
    visible = panel.points[shown[plate.members]]
    if len(visible) < max(20, SEEN * len(panel.points)):
        return None
    near = _candidates(plate, design, surface)
    if len(near.points) < 20:
        return None
    tree = KDTree(near.points)
    some = visible[:: max(1, len(visible) // 300)]

    def misfit(motion: np.ndarray) -> float:
        away = tree.query(some @ motion[:3, :3].T + motion[:3, 3])[0]
        return float(np.minimum(away, CUT_PX * pixel_m).mean())

    starts = sorted(_starts(plate), key=misfit)[:TRIED]
    straight = _fitted(np.eye(4), panel, near)
    motion, covariance = min(
        [straight, *(_fitted(s, panel, near) for s in starts)], key=lambda p: misfit(p[0])
    )
    if misfit(motion) > BETTER * misfit(straight[0]) or _angle(motion) > MOST_RAD:
        motion, covariance = straight
    found = float((tree.query(visible @ motion[:3, :3].T + motion[:3, 3])[0] < BESIDE_PX * pixel_m).mean())
    if found < FOUND or not np.isfinite(covariance).all():
        return None
    left = misfit(motion) / max(misfit(np.eye(4)), 1e-9 * pixel_m)
    return _turn(plate, motion, covariance, found, left, pixel_m)


def _turn(
    plate: Plate, motion: np.ndarray, covariance: np.ndarray, found: float, left: float, pixel_m: float
) -> Turn:
    """Return the turn of a panel's normal, from its motion and the covariance [3, 3] of its rotation vector."""
    normal = plate.axes[2]
    turned = motion[:3, :3] @ normal
    across = np.cross(normal, turned)
    tilt = float(np.arctan2(np.linalg.norm(across), normal @ turned))
    in_plane = plate.axes[:2]
    stated = in_plane @ covariance @ in_plane.T
    # a turn about the length moves the ends of the width, and the other way round
    stated += np.diag((SYSTEMATIC_PX * pixel_m / plate.extent[[1, 0]]) ** 2)
    axis = across / np.linalg.norm(across) if tilt > 1e-9 else in_plane[0]
    vector = tilt * in_plane @ axis
    significance = float(np.sqrt(vector @ np.linalg.solve(stated, vector)))
    way = in_plane @ axis
    half = Z_90 * float(np.sqrt(way @ stated @ way))
    return Turn(plate, motion, tilt, axis, (max(0.0, tilt - half), tilt + half), significance, found, left)


def _angle(motion: np.ndarray) -> float:
    return float(np.linalg.norm(Rotation.from_matrix(motion[:3, :3]).as_rotvec()))


def _candidates(plate: Plate, design: Samples, surface: Surface) -> Surface:
    """Return the surface that may be the panel's: near enough, and not nearer to what else there is of the design."""
    pixel_m = surface.pixel_m
    reach = np.linalg.norm(plate.extent) + 2 * pixel_m
    close = np.linalg.norm(surface.points - plate.middle, axis=1) < reach
    near = surface.select(np.flatnonzero(close))
    rest = np.ones(len(design.points), dtype=bool)
    rest[plate.members] = False
    if len(near.points) == 0 or not rest.any():
        return near
    of_rest = KDTree(design.points[rest]).query(near.points)[0]
    of_panel = KDTree(design.points[plate.members]).query(near.points)[0]
    chosen = (of_rest > BESIDE_PX * pixel_m) | (of_panel < of_rest)
    return near.select(np.flatnonzero(chosen)).thinned(MOST_POINTS, np.random.default_rng(0))


def _starts(plate: Plate) -> list[np.ndarray]:
    """Return motions [4, 4] of a panel: turns about its length and width, through its middle and its edges."""
    motions = []
    for axis in range(2):
        across = plate.axes[1 - axis] * plate.extent[1 - axis] / 2
        for pivot in (plate.middle, plate.middle + across, plate.middle - across):
            for degrees in TURNS_DEG:
                turn = Rotation.from_rotvec(np.radians(degrees) * plate.axes[axis]).as_matrix()
                motion = np.eye(4)
                motion[:3, :3], motion[:3, 3] = turn, pivot - turn @ pivot
                motions.append(motion)
    return motions


def _fitted(start: np.ndarray, panel: Samples, near: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return a panel's motion [4, 4] and the covariance [3, 3] of its rotation vector, from a start that is near."""
    place = refine(panel, near, start[:3, :3], start[:3, 3], 1.0, rigid=True)[1]
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = place.rotation, place.shift
    return motion, place.covariance[:3, :3]
