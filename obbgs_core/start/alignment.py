"""The first poses: as tagged where the silhouettes agree with the tags, else moved to where the silhouettes agree."""

import logging
import math

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame
from obbgs_core.model.motions import cross_matrices, point_flow
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.gauge import joined
from obbgs_core.poses.registration import PoseInformation
from obbgs_core.start import hull
from obbgs_core.start.silhouette_coherence import coherence, most_coherent, seen_from

log = logging.getLogger(__name__)
MOST_DILATION_PX = 8  # of a silhouette, for pose errors
REFINED_DILATION_PX = 2  # the same where poses are refined
CENTRE_SIGMA = 0.1  # of a silhouette's centre about the projection of one point of the body, over its radius
ROUNDS = 12  # of aligning the silhouettes' centres; the problem is nearly linear
# for the most coherent hull, each from where the last one ended, with directions that are right there
SEARCHES = 3
# the aligned poses are taken if they leave at most this share of the light that is not covered as tagged
BETTER = 0.7
OFFSET = 0.3  # of the silhouettes' radius: deviation of their common point from the body's origin
HOLD = 0.3  # of the median distance of the centres from the point, which is added to their deviation
NEAREST = 0.3  # of the median range: no target is taken to be nearer than that while poses are aligned
FAR = 3.0  # times the median distance of the centres from the point, beyond which they count less


def settled(
    frames: list[TrainingFrame],
    outlines: dict[int, hull.Silhouette],
    may_move: bool,
    refined: PoseCorrections | None = None,
) -> tuple[dict[int, hull.Silhouette], PoseCorrections | None, str]:
    """Return silhouettes grown by as much as the poses err, the poses if they were moved, and why they were or not.

    The pose tags state how much the poses may err. Silhouettes are grown by no more than that, and by no more than what
    their coherence asks for: a tag may be honest and its pose still exact, and silhouettes grown for nothing carve
    nothing. Where the hull of the tagged poses is not coherent, the poses are moved, within what the tags allow, to
    where the centres of the silhouettes meet; they are kept if the hull is more coherent there.

    Args:
        outlines: silhouettes of some of the frames, by index, with tagged poses.
        may_move: whether the poses may be moved at all.
        refined: poses of the first of the frames, or of all, that a training has refined; they stay.
    """
    if refined is not None:
        return _resettled(frames, outlines, refined)
    poses = PoseCorrections(frames)
    errors_px = {i: _error_px(frames[i], poses.covariances[i]) for i in outlines}
    if max(errors_px.values()) == 0 or not any(o.certain.any() for o in outlines.values()):
        return outlines, None, ""
    tagged = coherence(outlines)
    if tagged >= hull.AGREEMENT:
        return outlines, None, ""
    if may_move:
        moved, left_px = _aligned(frames, outlines)
        moved, aligned, reached = _searched(frames, outlines, moved)
        why = f"the hull covers {tagged:.3f} of the light as tagged, {reached:.3f} with aligned silhouettes"
        log.info(why)
        if 1 - reached < BETTER * (1 - tagged):
            most = min(MOST_DILATION_PX, max(1, round(left_px)))
            return grown(aligned, dict.fromkeys(aligned, most)), moved, why
    return grown(outlines, errors_px), None, ""


def _resettled(
    frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette], refined: PoseCorrections
) -> tuple[dict[int, hull.Silhouette], PoseCorrections, str]:
    """Return what `settled` does where the first of the frames, or all, have refined poses.

    Where the hull of the tagged poses is not coherent, the others are where the silhouettes' centres put them, else
    where the shared parameters do. Where all are refined and their hull is not coherent, aligned poses are taken if
    theirs is more so: then the training went astray.
    """
    poses = refined if len(frames) == len(refined.of_frame) else refined.extended(frames)
    posed = seen_from(outlines, poses)
    if not any(o.certain.any() for o in outlines.values()):
        return posed, poses, ""
    if poses is refined:
        reached = coherence(posed)
        if reached < hull.AGREEMENT:
            moved, aligned, why = settled(frames, outlines, may_move=True)
            if aligned is not None and coherence(seen_from(outlines, aligned)) > reached:
                return moved, aligned, why
    elif coherence(outlines) < hull.AGREEMENT:
        aligned, _ = _aligned(frames, outlines)
        radius_m = hull.radius_m(list(seen_from(outlines, aligned).values()))
        poses = joined(refined, aligned, frames, radius_m)
        posed = seen_from(outlines, poses)
    posed = grown(posed, dict.fromkeys(posed, REFINED_DILATION_PX))
    return posed, poses, "by a training that frames joined"


def _searched(
    frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette], poses: PoseCorrections
) -> tuple[PoseCorrections, dict[int, hull.Silhouette], float]:
    """Return aligned poses, or ones of a more coherent hull if theirs is not coherent, silhouettes and coherence."""
    aligned = seen_from(outlines, poses)
    reached = coherence(aligned)
    for _ in range(SEARCHES):
        if reached >= hull.AGREEMENT:
            break
        found = most_coherent(frames, outlines, poses)
        if found is poses:  # the centres leave nothing open
            break
        again = seen_from(outlines, found)
        better = coherence(again)
        if better <= reached:
            break
        poses, aligned, reached = found, again, better
    return poses, aligned, reached


def centred(frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette]) -> list[TrainingFrame]:
    """Return frames with the target in the middle of its silhouettes, moved there within what their tags allow.

    For poses relative to inertial axes, in which the target turns, so that no hull says which poses are better. They
    are moved where the silhouettes' centres are farther from the target's centre than a body's own asymmetry explains.

    Args:
        outlines: silhouettes of some of the frames, by index, with tagged poses.
    """
    poses = PoseCorrections(frames)
    if not outlines or not (poses.rank.any() or poses.free.any()):
        return frames
    lit, K, centres_px, radii_px = _centres(frames, outlines)
    tagged_px = float(
        _seen(poses, lit, torch.zeros(3, dtype=torch.float64), K, centres_px)[2].norm(dim=1).median()
    )
    if tagged_px < OFFSET * radii_px.median():
        return frames
    # the mean of a turning body's centres lies on the axis of its rotation, along which nothing is lost by a shift
    moved, left_px = _aligned(frames, outlines, offset=0.0)
    log.info("outlines are %.1f px off the target's centre as tagged, %.1f px aligned", tagged_px, left_px)
    return moved.frames(frames) if left_px < BETTER * tagged_px else frames


def grown(outlines: dict[int, hull.Silhouette], errors_px: dict[int, int]) -> dict[int, hull.Silhouette]:
    """Return silhouettes grown by the least reach that makes them coherent, each by its own limit at most."""
    most = max(errors_px.values())
    for reach_px in [r for r in (0, 1, 2, 4) if r < most]:
        reached = {i: s.dilated(min(reach_px, errors_px[i])) for i, s in outlines.items()}
        agreement = coherence(outlines, reached)
        log.info("silhouettes grown by %d px of at most %d: coherence %.3f", reach_px, most, agreement)
        if agreement >= hull.AGREEMENT:
            return reached
    return {i: s.dilated(errors_px[i]) for i, s in outlines.items()}


def _aligned(
    frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette], offset: float = OFFSET
) -> tuple[PoseCorrections, float]:
    """Return poses at which one point of the body projects to the silhouettes' centres, and what is left, px.

    The point is the body's origin plus an offset that is estimated as well, whose deviation is `offset` radii of the
    silhouettes. The lit part's centre is not quite that of one point: it is taken to err by a tenth of the radius.
    """
    poses, point = PoseCorrections(frames), torch.zeros(3, dtype=torch.float64)
    lit, K, centres_px, radii_px = _centres(frames, outlines)
    sigma_px = CENTRE_SIGMA * radii_px
    ranges_m = torch.stack([frames[i].world_to_camera[:3, 3] for i in lit]).norm(dim=1)
    # the prior deviation of the point from the origin
    offset_m = offset * float((radii_px * ranges_m / K[:, 0, 0]).median())
    by_offset = torch.zeros(len(frames), 6, 3, dtype=torch.float64)
    for _ in range(ROUNDS):
        flow, turn, away_px = _seen(poses, lit, point, K, centres_px)
        # a centre far off counts less, as one of a picture that shows something else
        distance = away_px.norm(dim=1)
        far = (distance / (FAR * distance.median()).clamp(min=1e-9)).clamp(min=1)
        # far from the solution the priors hold the step, so that it is not taken beyond where flow is linear
        weight = 1 / (far * (sigma_px**2 + (HOLD * distance.median()) ** 2))
        gradient = -(flow.mT @ (weight[:, None] * away_px)[..., None])[..., 0]
        poses.gather(lit, PoseInformation(gradient, weight[:, None, None] * (flow.mT @ flow)))
        by_offset[lit, 3:] = offset_m * turn
        change, _ = poses.step(frames, extra=by_offset)
        point = point + offset_m * change
    return poses, float(_seen(poses, lit, point, K, centres_px)[2].norm(dim=1).median())


def _centres(
    frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette]
) -> tuple[list[int], Tensor, Tensor, Tensor]:
    """Return which silhouettes show light, with K [L, 3, 3], their centres [L, 2] px and radii [L] px."""
    lit = [i for i, outline in outlines.items() if outline.certain.any()]
    centres, radii = zip(*(_centre(outlines[i].certain) for i in lit), strict=True)
    K = torch.stack([frames[i].K for i in lit]).double()
    return lit, K, torch.stack(centres), torch.tensor(radii, dtype=torch.float64)


def _seen(
    poses: PoseCorrections, lit: list[int], point: Tensor, K: Tensor, centres_px: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return how the picture of a point of the body moves with its pose, the poses' rotations, and what is left, px.

    What is left [L, 2] is how far the point is from the silhouette's centre, and its derivative by the motion is
    [L, 2, 6]. Where tags, which err, have the target beside or behind the camera, both are those of the distance from
    the ray through that centre instead, over a depth that stays, which is linear in the pose.
    """
    world_to_camera = poses.corrected(lit).double()
    at = world_to_camera[:, :3, :3] @ point + world_to_camera[:, :3, 3]
    focal_px, z = K[:, [0, 1], [0, 1]], at[:, 2:]
    depth = z.clamp(min=NEAREST * float(at.norm(dim=1).median()))
    rays = (centres_px - K[:, :2, 2]) / focal_px
    towards = torch.where(z < depth, rays, at[:, :2] / depth)
    eye = torch.eye(3, dtype=torch.float64).expand(len(lit), 3, 3)
    across = torch.cat([eye[:, :2, :2], -towards[..., None]], dim=2)  # [L, 2, 3]
    by_motion = torch.cat([-cross_matrices(at), eye], dim=2)
    flow = (focal_px / depth)[..., None] * across @ by_motion
    return flow, world_to_camera[:, :3, :3], focal_px / depth * (rays * z - at[:, :2])


def _centre(mask: Tensor) -> tuple[Tensor, float]:
    """Return the centre [2] (x, y) px of a mask [H, W], and the radius of a disc as large."""
    rows, columns = torch.nonzero(mask, as_tuple=True)
    centre = torch.stack([columns.double().mean(), rows.double().mean()]) + 0.5
    return centre, math.sqrt(len(rows) / math.pi)


def _error_px(frame: TrainingFrame, covariance: Tensor) -> int:
    """Return the largest standard deviation, px, that a pose's covariance gives the image of the body's origin."""
    at = frame.world_to_camera[:3, 3].double().clone()
    at[2] = at[2].clamp(min=1e-6)
    pixel_by_motion = point_flow(at[None], frame.K.double()[None])[0]
    covariance_px2 = pixel_by_motion @ covariance.double() @ pixel_by_motion.T
    worst_px2 = float(torch.linalg.eigvalsh(covariance_px2)[-1].clamp(min=0))
    return min(MOST_DILATION_PX, round(math.sqrt(worst_px2)))
