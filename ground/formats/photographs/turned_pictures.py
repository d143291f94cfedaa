"""The principal point of photographs of which some were turned by 180 degrees.

A shift of the principal point of all photographs looks like a turn of all cameras, so that it cannot be told. Where
some photographs were turned about their middle (by a camera mount that is upside down at times, or by whoever filed
them), it lies on one side of the middle in these and on the other side in the rest, and no common turn explains that.
The adjustments are pycolmap's.
"""

import itertools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np

from ground.formats.photographs.epipolar import TURN

if TYPE_CHECKING:
    import pycolmap

ROUNDS = 5  # of parting the pictures, at most
LENS_STAYS = {"refine_focal_length": False, "refine_extra_params": False}
LEAST_GAIN = 3.0  # nats a picture: what turned pictures explain more than one principal point without turning


def turned_back(
    model: "pycolmap.Reconstruction", step: Callable[[], None]
) -> tuple["pycolmap.Reconstruction", frozenset[str]]:
    """Return the model with those pictures turned back that were turned by 180 degrees, and their names.

    Each picture is given a principal point of its own at first, and these points are parted into two groups. One group
    is turned and the model adjusted with one principal point for all. Pictures whose own point, for the places of the
    features that were found, lies on the other side of the middle change the group, until none does. If that explains
    the features far better than one principal point without turning, the model returned has it, and the pictures named
    are turned in it. Which of the groups was turned makes no difference. Otherwise, and where the groups do not settle,
    the model is returned as it came, and no name.

    Args:
        model: with one SIMPLE_RADIAL camera.
        step: is called before each adjustment and may raise.
    """
    names = sorted(image.name for image in model.images.values() if image.has_pose)
    camera = next(iter(model.cameras.values()))
    middle = np.array([camera.width, camera.height]) / 2

    def points_of_pictures(of: "pycolmap.Reconstruction", **kept: bool) -> np.ndarray:
        step()
        number = {name: i for i, name in enumerate(names)}
        separate, _ = _adjusted(of, number.__getitem__, frozenset(), **LENS_STAYS, **kept)
        return np.array([separate.cameras[i].params[1:3] for i in range(len(names))])

    def with_one_point(turned: frozenset[str]) -> tuple["pycolmap.Reconstruction", float]:
        step()
        return _adjusted(model, lambda _: 0, turned)

    turned, change = frozenset(), _parted(points_of_pictures(model))
    for _ in range(ROUNDS):
        turned ^= set(itertools.compress(names, change))
        mirrored, fit = with_one_point(turned)
        aside = points_of_pictures(mirrored, refine_points3D=False) - middle
        change = aside @ (mirrored.cameras[0].params[1:3] - middle) < 0
        if not change.any():
            gain = fit - with_one_point(frozenset())[1]
            return (mirrored, turned) if gain > LEAST_GAIN * len(names) else (model, frozenset())
    return model, frozenset()


def _parted(points: np.ndarray) -> np.ndarray:
    """Return which of some points [N, 2] are in the second of two groups, as a mask [N].

    They are parted along the direction in which they spread most, where the squared deviations in the groups are least.
    """
    spread = points - points.mean(axis=0)
    along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
    inside = np.sort(along)
    deviations = [i * inside[:i].var() + (len(along) - i) * inside[i:].var() for i in range(1, len(along))]
    return along >= inside[1 + int(np.argmin(deviations))]


def _adjusted(
    model: "pycolmap.Reconstruction", camera_of: Callable[[str], int], turned: frozenset[str], **kept: bool
) -> tuple["pycolmap.Reconstruction", float]:
    """Return a bundle-adjusted copy whose pictures have the cameras of these numbers, and its log-likelihood.

    Principal points are estimated. The log-likelihood is that of the features under the deviation that fits them best,
    but for a constant.

    Args:
        turned: names of the pictures that are turned by 180 degrees first.
        kept: options of the adjustment; all is estimated unless they say otherwise.
    """
    import pycolmap

    copy = _with_cameras(model, camera_of, turned)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False, **kept)
    options.ceres.solver_options.num_threads = 1
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    config = pycolmap.BundleAdjustmentConfig()
    for identity in copy.reg_image_ids():
        config.add_image(identity)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    solved = pycolmap.create_default_ceres_bundle_adjuster(options, config, copy).solve()
    summary = cast("pycolmap.CeresBundleAdjustmentSummary", solved).ceres_summary
    copy.update_point_3d_errors()
    return copy, -0.5 * summary.num_residuals * math.log(summary.final_cost / summary.num_residuals)


def _with_cameras(
    model: "pycolmap.Reconstruction", camera_of: Callable[[str], int], turned: frozenset[str]
) -> "pycolmap.Reconstruction":
    import pycolmap

    camera, copy = next(iter(model.cameras.values())), pycolmap.Reconstruction()
    for identity, image in sorted(model.images.items()):
        if not image.has_pose:
            continue
        number = camera_of(image.name)
        if not copy.exists_camera(number):
            sizes = {"width": camera.width, "height": camera.height}
            own = pycolmap.Camera(camera_id=number, model=camera.model, params=camera.params, **sizes)
            copy.add_camera_with_trivial_rig(own)
        features, pose = np.array([feature.xy for feature in image.points2D]), image.cam_from_world()
        if image.name in turned:
            features = np.array([camera.width, camera.height]) - features
            pose = pycolmap.Rigid3d(TURN @ pose.matrix())
        added = pycolmap.Image(name=image.name, keypoints=features, camera_id=number, image_id=identity)
        copy.add_image_with_trivial_frame(added, pose)
    for point in model.points3D.values():
        copy.add_point3D(point.xyz, point.track)
    return copy
