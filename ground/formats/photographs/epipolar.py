"""Whether stated cameras agree with their pictures: by the epipolar distances of features that neighbours share.

A point that two pictures show lies, in each, on the line to which the other picture's ray projects (its epipolar line).
Source: Hartley and Zisserman, Multiple View Geometry, 2004, chapters 9 and 11; features by Lowe, 2004 (SIFT).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ground.formats.pictures.files import FormatError
from ground.formats.pictures.views import EXACT, PoseSigmas, View, read_grey

if TYPE_CHECKING:
    import cv2

MOST_PX = 1000  # larger pictures are made smaller before features are sought
FEATURES = 1500  # of a picture, at most
NEIGHBOURS = 6  # pictures with which each is compared: those whose cameras are nearest
WIDEST_DEG = 60.0  # between the lines of sight of two pictures that are compared
RATIO = 0.75  # of a match's distance to that of the second best, at most (Lowe 2004)
FEWEST_MATCHES = 20  # of two pictures that fit one epipolar geometry, whichever it is
FITTING = 0.5  # share of the matches that must fit it
FIT_PX = 1.5  # how well
# stated cameras agree with the pictures where the median epipolar distance is below this share of the longer side, and
# in small pictures below so many pixels
AGREE_SHARE, AGREE_PX = 0.004, 1.5
SIGMAS = 3.0  # so many deviations of stated pose errors are forgiven
TURN = np.diag([-1.0, -1.0, 1.0])  # by 180 degrees about the line of sight


@dataclass(frozen=True)
class PoseCheck:
    """What the pictures say of their stated cameras, by the pictures' indices.

    agreeing: they agree with each other; the largest such group is taken for right.
    turned: they agree too, once their cameras are turned by 180 degrees about the line of sight.
    contradicting: they share features with the agreeing ones, and neither pose fits.
    unchecked: they share too few features with any agreeing picture.
    """

    agreeing: tuple[int, ...]
    turned: tuple[int, ...]
    contradicting: tuple[int, ...]
    unchecked: tuple[int, ...]


@dataclass(frozen=True)
class Pair:
    """Two pictures, by index, and the points [M, 2] px, of pinhole pictures of full size, at which both show the same.

    scale: of the pictures on which they were found.
    """

    first: int
    second: int
    at_first: np.ndarray
    at_second: np.ndarray
    scale: float


def turned(view: View) -> View:
    """Return the view with its camera turned by 180 degrees about the picture's middle; the picture stays.

    What the camera projected to (x, y) it now projects to (width - x, height - y).
    """
    lens, pose = view.intrinsics, view.world_to_camera.copy()
    pose[:3] = TURN @ pose[:3]
    k1, k2, p1, p2, k3 = lens.distortion
    lens = dataclasses.replace(
        lens, cx_px=lens.width - lens.cx_px, cy_px=lens.height - lens.cy_px, distortion=(k1, k2, -p1, -p2, k3)
    )
    return dataclasses.replace(view, world_to_camera=pose, intrinsics=lens)


def mended(views: Sequence[View], check: PoseCheck) -> list[View]:
    """Return the views with cameras turned where that makes them fit, without those that contradict the others.

    Raises:
        FormatError: most contradict each other, so that it is not known which are right.
    """
    if len(check.contradicting) > len(check.agreeing) + len(check.turned):
        raise FormatError(
            f"{len(check.contradicting)} of {len(views)} pictures contradict their cameras, {len(check.agreeing)} "
            "agree: expected most to agree; look at the axes' convention and the focal lengths, or import them with "
            "--poses stated"
        )
    kept = (i for i in range(len(views)) if i not in check.contradicting)
    return [turned(views[i]) if i in check.turned else views[i] for i in kept]


def check_poses(
    views: Sequence[View],
    sigmas: PoseSigmas = EXACT,
    on_view: Callable[[], None] = lambda: None,
) -> PoseCheck:
    """Return which views agree with their neighbours' pictures and cameras, and which would if they were turned.

    Two pictures are compared where at least `FEWEST_MATCHES` features fit one epipolar geometry, whichever that is:
    they are then seen to show the same points, and the stated cameras agree where these lie on their epipolar lines.
    Views that agree pairwise form groups; the largest is taken for right, and the others are compared with it. An error
    that moves points along their epipolar lines, such as a shift towards the neighbour, is not seen.

    Args:
        sigmas: how far the poses are said to err, which is forgiven.
        on_view: called after each picture.

    Raises:
        FormatError: a picture cannot be read.
    """
    pairs = matched_points(views, on_view)
    limits_px = [_limit_px(view, sigmas) for view in views]
    flipped = [turned(view) for view in views]

    def agree(pair: Pair, turning: set[int]) -> bool:
        one, other = (flipped[i] if i in turning else views[i] for i in (pair.first, pair.second))
        distances_px = pair.scale * epipolar_distances_px(one, other, pair.at_first, pair.at_second)
        return float(np.median(distances_px)) <= max(limits_px[pair.first], limits_px[pair.second])

    def support(group: set[int], turning: set[int]) -> float:
        """Return the share of the features shared with known views whose pairs agree."""
        crossing = _between(pairs, group, known)
        return sum(len(p.at_first) * agree(p, turning) for p in crossing) / sum(
            len(p.at_first) for p in crossing
        )

    compared = {i for pair in pairs for i in (pair.first, pair.second)}
    groups = _groups(len(views), [p for p in pairs if agree(p, set())])
    waiting = sorted((g for g in groups if g & compared), key=len, reverse=True)
    agreeing, turning, wrong, known = set(), set(), set(), set()
    if waiting:
        agreeing |= (largest := waiting.pop(0))
        known |= largest
    while group := next((g for g in waiting if _between(pairs, g, known)), None):
        waiting.remove(group)
        as_stated, as_turned = support(group, turning), support(group, turning | group)
        if max(as_stated, as_turned) <= 0.5:
            wrong |= group
            continue
        known |= group
        if as_turned > as_stated:
            turning |= group
        else:  # with the stated cameras of those that had to be turned
            agreeing |= group
    unchecked = set(range(len(views))) - known - wrong
    return PoseCheck(*(tuple(sorted(indices)) for indices in (agreeing, turning, wrong, unchecked)))


def epipolar_distances_px(one: View, other: View, at_one: np.ndarray, at_other: np.ndarray) -> np.ndarray:
    """Return Sampson's distances [M] px of points [M, 2] of two pinhole pictures from their epipolar lines."""
    motion = other.world_to_camera @ np.linalg.inv(one.world_to_camera)
    x, y, z = motion[:3, 3] / max(float(np.linalg.norm(motion[:3, 3])), 1e-12)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]
    K_one, K_other = (np.array(view.intrinsics.K) for view in (one, other))
    F = np.linalg.inv(K_other).T @ essential @ np.linalg.inv(K_one)
    a, b = (np.column_stack([points, np.ones(len(points))]) for points in (at_one, at_other))
    lines, lines_back = a @ F.T, b @ F
    slope = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (lines_back[:, :2] ** 2).sum(axis=1))
    return np.abs((lines * b).sum(axis=1)) / np.maximum(slope, 1e-12)


def _limit_px(view: View, sigmas: PoseSigmas) -> float:
    """Return up to which median epipolar distance, px of the smaller picture, the poses of a view agree."""
    range_m = max(float(np.linalg.norm(view.world_to_camera[:3, 3])), 1e-9)
    error_px = view.intrinsics.fx_px * math.hypot(sigmas.rotation_rad, sigmas.position_m / range_m)
    side_px = _scale(view) * max(view.intrinsics.width, view.intrinsics.height)
    return max(AGREE_PX, AGREE_SHARE * side_px) + SIGMAS * _scale(view) * error_px


def _scale(view: View) -> float:
    return min(1.0, MOST_PX / max(view.intrinsics.width, view.intrinsics.height))


def matched_points(views: Sequence[View], on_view: Callable[[], None] = lambda: None) -> list[Pair]:
    """Return the pairs of neighbouring views with the points that both show.

    Raises:
        FormatError: a picture cannot be read.
    """
    import cv2  # here and below: the ground station starts without it

    sift = cv2.SIFT.create(nfeatures=FEATURES)
    features = []
    for view in views:
        features.append(_features(sift, view))
        on_view()
    return [
        pair for i, j in _neighbours(views) if (pair := _matched(views, features, i, j, _scale(views[i])))
    ]


def _features(sift: "cv2.SIFT", view: View) -> tuple[np.ndarray, np.ndarray | None]:
    """Return where a picture has features [M, 2] px, without the lens's distortion, and their descriptors."""
    import cv2

    image = read_grey(view)
    # faint pictures are stretched, because features are sought above a fixed contrast
    grey = np.clip(255 / max(float(np.quantile(image, 0.999)), 1 / 255) * image, 0, 255).astype(np.uint8)
    scale = _scale(view)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found, descriptors = sift.detectAndCompute(grey, None)  # pyright: ignore[reportArgumentType, reportCallIssue]
    if not found:
        return np.zeros((0, 2)), None
    at = (np.array([point.pt for point in found]) + 0.5) / scale  # OpenCV's pixel centres are whole numbers
    K = np.array(view.intrinsics.K)
    if skew_px := view.intrinsics.skew_px:
        at[:, 0] -= skew_px / view.intrinsics.fy_px * (at[:, 1] - view.intrinsics.cy_px)
    if any(view.intrinsics.distortion):
        at = cv2.undistortPoints(at[:, None], K, np.array(view.intrinsics.distortion), P=K)[:, 0]
    return at, descriptors


def _neighbours(views: Sequence[View]) -> list[tuple[int, int]]:
    """Return the pairs of views to compare: cameras that stand near each other, not on one spot, and look alike."""
    poses = np.array([view.world_to_camera for view in views]).reshape(-1, 4, 4)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    looking = poses[:, 2, :3] @ poses[:, 2, :3].T
    may = (apart > 1e-6 * apart.max(initial=0)) & (looking > math.cos(math.radians(WIDEST_DEG)))
    pairs = set()
    for i, row in enumerate(np.where(may, apart, np.inf)):
        nearest = np.argsort(row, kind="stable")[:NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest if np.isfinite(row[j])}
    return sorted(pairs)


def _matched(
    views: Sequence[View], features: list[tuple[np.ndarray, np.ndarray | None]], i: int, j: int, scale: float
) -> Pair | None:
    """Return what two pictures share; nothing where that is too little to compare their cameras."""
    import cv2

    (at_i, of_i), (at_j, of_j) = features[i], features[j]
    if of_i is None or of_j is None or min(len(of_i), len(of_j)) < FEWEST_MATCHES:
        return None
    candidates = cv2.BFMatcher().knnMatch(of_i, of_j, k=2)
    good = [m for m, second in candidates if m.distance < RATIO * second.distance]
    if len(good) < FEWEST_MATCHES:
        return None
    a, b = at_i[[m.queryIdx for m in good]], at_j[[m.trainIdx for m in good]]
    fitted, fits = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, FIT_PX / scale, 0.999)
    if fitted is None:
        return None
    kept = fits.ravel() > 0
    if kept.sum() < max(FEWEST_MATCHES, FITTING * len(good)):
        return None
    return Pair(i, j, a[kept], b[kept], scale)


def _groups(count: int, pairs: list[Pair]) -> list[set[int]]:
    """Return the sets of views that pairs connect; a view in no pair is a set of its own."""
    group_of = [{i} for i in range(count)]
    for pair in pairs:
        if (one := group_of[pair.first]) is not (other := group_of[pair.second]):
            one |= other
            for i in other:
                group_of[i] = one
    return list({id(group): group for group in group_of}.values())


def _between(pairs: list[Pair], group: set[int], known: set[int]) -> list[Pair]:
    return [
        pair
        for pair in pairs
        if (pair.first in group and pair.second in known) or (pair.second in group and pair.first in known)
    ]
