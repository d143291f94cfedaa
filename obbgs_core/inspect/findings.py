"""What of a body is not as it was designed: parts that are missing or were added, panels that are turned."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from obbgs_core.inspect.alignment import FINE_POINTS, Similarity, Surface, aligned, refine
from obbgs_core.inspect.cad import CadMesh, Samples, groups_within, principal_axes, sampled
from obbgs_core.inspect.plates import Z_90, Turn, is_turned, plates_of, turn_of
from obbgs_core.inspect.shown import Views, views_showing

ROUNDS = 3  # of laying the design on the body without its turned panels
FEWEST_VIEWS = 4  # that must show a place for something to be missed there
OFF_PX = 2.0  # from the surface or the design: nearer is the same place
OFF_SIGMAS = 4.0  # the same in robust standard deviations of the surface
LINKED_PX = 1.8  # points nearer to each other are of one finding
LEAST_AREA_PX = 20.0  # of a finding, in squares of a pixel
LEAST_WIDTH_PX = 1.5  # its area over its size: frames may not show what is narrower, such as a mast
# that a finding stands off, at least: models of bodies that are as designed err by as much in single places
LEAST_DEPTH_PX = 5.0
WHOLE = 0.6  # of a part's shown samples that are not there: the part is missing
STATES = ("as designed", "missing", "not seen", "turned")
EDGE_PX = 0.5  # standard deviation of where a finding's edge lies
DEPTH_PX = 1.0  # of how far it stands off: models round edges and ends


@dataclass(frozen=True)
class Region:
    """A place that is not as designed: kind ("missing" or "added"), part, middle [3] m, extent [3] m along its axes.

    part: the one that is missing, or that is nearest. area_m2 with its 90 % interval; size_m, the largest dimension,
    with its 90 % interval. depth_m: how far it stands off the other surface, at its 95th percentile. whole: the part is
    missing as a whole.
    """

    kind: str
    part: str
    middle: np.ndarray
    area_m2: float
    size_m: float
    size_interval: tuple[float, float]
    depth_m: float
    depth_interval: tuple[float, float]
    whole: bool
    members: np.ndarray


@dataclass(frozen=True)
class Inspection:
    """All that was found.

    design: its samples in the body's axes, m, panels where they were found; designed: where they should be;
    state [N] of each, an index of STATES.
    added: [M] which points of the surface are no part of the design.
    seen: the share of the design's area that the frames show.
    """

    place: Similarity
    design: Samples
    designed: Samples
    state: np.ndarray
    surface: Surface
    added: np.ndarray
    turns: list[Turn]
    regions: list[Region]
    seen: float
    parts: tuple[str, ...]

    @property
    def turned(self) -> list[Turn]:
        return [turn for turn in self.turns if is_turned(turn)]


def inspect(cad: CadMesh, surface: Surface, solid: Samples, views: Views, seed: int = 0) -> Inspection:
    """Return what of a body is not as designed.

    Args:
        surface: what the frames show of it.
        solid: points spread over the closed mesh of all that the views do not see through, normals outwards: what lies
            outside of it is empty.
        views: the frames.

    Raises:
        ReconstructionError: too little surface.
    """
    place = aligned(cad, surface, seed)
    pixel_m = surface.pixel_m
    samples = sampled(cad, 0.7 * pixel_m / place.scale, seed)
    design, shown, turns = _laid(place, samples, surface, views)
    for _ in range(ROUNDS):
        turned = [turn for turn in turns if is_turned(turn)]
        if not turned:
            break
        place = _without_panels(place, samples, design, surface, turned)
        design, shown, turns = _laid(place, samples, surface, views)
    as_is = _moved(design, [turn for turn in turns if is_turned(turn)])
    if any(is_turned(turn) for turn in turns):
        shown = views_showing(as_is, views, pixel_m) >= FEWEST_VIEWS
    off_m = max(OFF_PX * pixel_m, OFF_SIGMAS * place.sigma_m)
    shown = _faces_seen(as_is, surface, shown, off_m) if views.suns is None else shown
    distance = KDTree(surface.points).query(as_is.points)[0]
    outside = _height(as_is.points, solid)
    absent = shown & (distance > off_m) & (outside > off_m)
    reached = KDTree(as_is.points).query(surface.points)[0]
    added = reached > off_m
    regions, absent = _missing(as_is, absent, shown, np.minimum(distance, outside), cad.names, surface)
    more, added = _added(surface, added, reached, as_is, cad.names)
    present = distance <= off_m
    state = np.where(absent, 1, np.where(present, 0, 2))
    for turn in turns:
        if is_turned(turn):
            members = turn.plate.members
            state[members] = np.where(state[members] == 0, 3, state[members])
    seen = float(np.mean(state != STATES.index("not seen")))
    return Inspection(
        *(place, as_is, design, state, surface, added, turns, regions + more, seen), parts=cad.names
    )


def _laid(
    place: Similarity, samples: Samples, surface: Surface, views: Views
) -> tuple[Samples, np.ndarray, list[Turn]]:
    """Return a design in its place, which of its samples [N] the frames show, and how its panels are turned."""
    design = place.of(samples)
    shown = views_showing(design, views, surface.pixel_m) >= FEWEST_VIEWS
    found = (turn_of(plate, design, surface, shown) for plate in plates_of(design, surface.pixel_m))
    return design, shown, [turn for turn in found if turn is not None]


def _without_panels(
    place: Similarity, samples: Samples, design: Samples, surface: Surface, turned: list[Turn]
) -> Similarity:
    """Return the place of the design by all but its turned panels, which would else pull the body after them."""
    members = np.concatenate([turn.plate.members for turn in turned])
    rest = np.delete(np.arange(len(samples.points)), members)
    panels = _moved(design, turned).points[members]
    apart = KDTree(panels).query(surface.points)[0] > OFF_PX * surface.pixel_m
    if len(rest) < 100 or apart.sum() < 100:
        return place
    left = surface.select(np.flatnonzero(apart)).thinned(FINE_POINTS, np.random.default_rng(0))
    better = refine(samples.select(rest), left, place.rotation, place.shift, place.scale)[1]
    return dataclasses.replace(better, other_rotations=place.other_rotations)


def _moved(design: Samples, turned: list[Turn]) -> Samples:
    points, normals = design.points.copy(), design.normals.copy()
    for turn in turned:
        members, R, t = turn.plate.members, turn.motion[:3, :3], turn.motion[:3, 3]
        points[members], normals[members] = points[members] @ R.T + t, normals[members] @ R.T
    return Samples(points, normals, design.part, design.area)


def _height(points: np.ndarray, solid: Samples) -> np.ndarray:
    """Return the distances [N] of points from a closed surface, negative inside, by the nearest of its samples."""
    distance, nearest = KDTree(solid.points).query(points, k=4)
    offsets = points[:, None] - solid.points[nearest]
    side = (offsets * solid.normals[nearest]).sum(axis=2)
    return distance[:, 0] * np.where((side > 0).sum(axis=1) >= 3, 1.0, -1.0)


def _faces_seen(design: Samples, surface: Surface, shown: np.ndarray, off_m: float) -> np.ndarray:
    """Return which samples [N] are shown where no direction to the Sun is known: those that face as what is seen does.

    Of all shown samples of about the same normal, either way, at least half must lie on the surface.
    """
    there = KDTree(surface.points).query(design.points)[0] < off_m
    tree = KDTree(np.concatenate([design.normals[shown], -design.normals[shown]]))
    on_surface = np.concatenate([there[shown], there[shown]])
    if not len(on_surface):
        return shown
    count = min(200, len(on_surface))
    share = on_surface[tree.query(design.normals, k=count)[1].reshape(len(design.normals), -1)].mean(axis=1)
    return shown & (share > 0.5)


def _missing(
    design: Samples, absent: np.ndarray, shown: np.ndarray, depth: np.ndarray, names: tuple, surface: Surface
) -> tuple[list[Region], np.ndarray]:
    """Return what is missing, and which samples [N] are of it: each part for itself, in regions that hang together."""
    regions, kept = [], np.zeros(len(absent), dtype=bool)
    for part in np.unique(design.part[absent]):
        own = np.flatnonzero(absent & (design.part == part))
        visible = int((shown & (design.part == part)).sum())
        whole = len(own) > WHOLE * visible
        for members in _groups(design.points[own], surface.pixel_m):
            chosen = own[members]
            region = _region(
                "missing",
                names[part],
                design.points[chosen],
                design.area[chosen],
                depth[chosen],
                surface,
                chosen,
                whole,
            )
            if region is not None:
                regions.append(region)
                kept[chosen] = True
    return regions, kept


def _added(
    surface: Surface, added: np.ndarray, depth: np.ndarray, design: Samples, names: tuple
) -> tuple[list[Region], np.ndarray]:
    """Return what was added, and which points [M] of the surface are of it."""
    regions, kept = [], np.zeros(len(added), dtype=bool)
    own = np.flatnonzero(added)
    tree = KDTree(design.points)
    for members in _groups(surface.points[own], surface.pixel_m):
        chosen = own[members]
        points = surface.points[chosen]
        part = design.part[tree.query(points.mean(axis=0))[1]]
        region = _region(
            "added", names[part], points, surface.area[chosen], depth[chosen], surface, chosen, False
        )
        if region is not None:
            regions.append(region)
            kept[chosen] = True
    return regions, kept


def _groups(points: np.ndarray, pixel_m: float) -> list[np.ndarray]:
    groups = groups_within(points, LINKED_PX * pixel_m)
    if not len(groups):
        return []
    return np.split(np.argsort(groups, kind="stable"), np.cumsum(np.bincount(groups))[:-1])


def _region(
    kind: str,
    part: str,
    points: np.ndarray,
    area: np.ndarray,
    depth: np.ndarray,
    surface: Surface,
    members: np.ndarray,
    whole: bool,
) -> Region | None:
    """Return a finding from its points [n, 3] m; None where it is too small to be one."""
    pixel_m = surface.pixel_m
    if area.sum() < LEAST_AREA_PX * pixel_m**2 or len(points) < 4:
        return None
    axes = principal_axes(points)
    size = float(np.ptp(points @ axes.T, axis=0).max())
    if area.sum() < LEAST_WIDTH_PX * pixel_m * size:
        return None
    half = Z_90 * np.sqrt(2) * EDGE_PX * pixel_m
    deepest = float(np.quantile(depth, 0.95))
    if deepest < LEAST_DEPTH_PX * pixel_m:
        return None
    deep = Z_90 * DEPTH_PX * pixel_m
    return Region(
        kind,
        part,
        points.mean(axis=0),
        float(area.sum()),
        size,
        (max(0.0, size - half), size + half),
        deepest,
        (max(0.0, deepest - deep), deepest + deep),
        whole,
        members,
    )
