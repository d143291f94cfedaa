"""Structure from motion on ray-cast boxes; its alignment against scikit-image, its fusion against OpenCV's promises."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from skimage.transform import SimilarityTransform

from compare.opponents import sfm
from compare.opponents.reconstruction import Work
from obbgs_base.errors import Interrupted
from obbgs_core.errors import TooFewFrames
from tests import raycast

BOXES = [dataclasses.replace(raycast.spacecraft(5)[0], half_m=np.array([0.7, 0.6, 0.5]), cells=12)]


@pytest.fixture(scope="module")
def frames():
    """A textured box from 14 directions within 30 degrees, 128x128, in three exposures that saturate nothing."""
    poses = raycast.looking_at_origin(raycast.directions(14, 30), 4.5)
    return raycast.photographed(BOXES, poses, 128, 300.0, exposures_s=(4e-5, 6e-5, 9e-5))[0]


@settings(max_examples=20)
@given(seed=st.integers(0, 999), scale=st.floats(0.1, 10), shift=st.floats(-10, 10), noise=st.floats(0, 0.1))
def test_the_similarity_is_that_of_scikit_image(seed, scale, shift, noise):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(8, 3))
    target = scale * source @ Rotation.random(rng=rng).as_matrix().T + shift
    target += noise * scale * rng.normal(size=target.shape)
    theirs = SimilarityTransform.from_estimate(source, target)
    np.testing.assert_allclose(sfm.similarity(source, target), theirs.params[:3], atol=1e-8 * (scale + 10))


def test_too_few_cameras_have_no_similarity():
    assert sfm.similarity(np.zeros((2, 3)), np.ones((2, 3))) is None


def test_a_textured_box_is_found_in_the_body_frame(frames, tmp_path):
    shares = []
    work = Work(tmp_path, on_step=lambda share, seconds, snapshot: shares.append((share, seconds)))
    result = sfm.reconstruct_sfm(frames, raycast.SENSOR, work, "one-exposure")
    pixel_m = 4.5 / 300
    distance = raycast.distances_to_surface(BOXES, result.points.double().numpy())
    assert result.figures["registered"] >= 12 and result.figures["pictures"] == 14
    assert len(result.points) == result.figures["points"] > 200
    assert np.median(distance) < 2 * pixel_m
    assert result.figures["camera_error_m"] < 0.05  # of 4.5 m
    assert 0 < result.figures["reprojection_px"] < 1.5
    assert shares == sorted(shares) and len(shares) > 5 and result.seconds >= shares[-1][1]
    # the kept features and matches give the same model once more
    again = sfm.reconstruct_sfm(frames, raycast.SENSOR, Work(tmp_path), "one-exposure")
    assert torch.equal(again.points, result.points)


def test_pictures_without_features_give_nothing_with_the_reason(frames):
    plain = [dataclasses.replace(f, dn=torch.full_like(f.dn, 1000.0)) for f in frames[:4]]
    result = sfm.reconstruct_sfm(plain, raycast.SENSOR, Work(), "raw")
    assert len(result.points) == 0 and "could start a model" in result.figures["failed"]
    assert result.figures["registered"] == 0 and result.figures["features_median"] == 0


def test_frames_brought_to_one_exposure_read_alike_and_raw_ones_do_not(frames):
    at_one_pose = raycast.photographed(BOXES, np.stack([frames[0].world_to_camera.numpy()] * 3), 48, 110.0)[0]
    alike = sfm.pictures_of(at_one_pose, raycast.SENSOR, "one-exposure")
    raw = sfm.pictures_of(at_one_pose, raycast.SENSOR, "raw")
    short, middle, long = (view.image.astype(float) for view in alike)
    unsaturated = raw[2].image < 250
    for other in (short, long):  # shot noise is about 2 of 255 here
        assert np.abs(other - middle)[unsaturated].mean() < 4
    assert raw[1].image.mean() > 1.8 * raw[0].image.mean()


def test_a_bracket_of_one_pose_is_fused_and_frames_of_their_own_pose_are_not(frames):
    at_one_pose = raycast.photographed(BOXES, np.stack([frames[0].world_to_camera.numpy()] * 3), 48, 110.0)[0]
    together = sfm.pictures_of(at_one_pose, raycast.SENSOR, "fused")
    raw = sfm.pictures_of(at_one_pose, raycast.SENSOR, "raw")
    assert len(together) == 1 and len(raw) == 3
    target = raw[1].image > 60
    # of the short and the long exposure the fusion keeps neither the dark nor the saturated part
    assert raw[0].image[target].mean() < together[0].image[target].mean() < raw[2].image[target].mean()
    assert (together[0].image == 255).sum() < (raw[2].image == 255).sum()
    alone = sfm.pictures_of(frames, raycast.SENSOR, "fused")
    assert len(alone) == 14
    np.testing.assert_array_equal(alone[3].image, sfm.pictures_of(frames, raycast.SENSOR, "raw")[3].image)


def test_coloured_pictures_keep_their_channels(frames):
    coloured = [dataclasses.replace(f, dn=f.dn.repeat(1, 1, 3)) for f in frames[:3]]
    assert sfm.pictures_of(coloured, raycast.SENSOR, "raw")[0].image.shape == (128, 128, 3)
    assert sfm.fused([np.full((8, 8, 3), 50, np.uint8)] * 2).shape == (8, 8, 3)


def test_an_interrupted_run_keeps_its_features(frames, tmp_path):
    answers = iter([False, True])
    with pytest.raises(Interrupted, match="features and matches are kept"):
        sfm.reconstruct_sfm(
            frames[:3], raycast.SENSOR, Work(tmp_path, should_stop=lambda: next(answers)), "raw"
        )
    (folder,) = tmp_path.iterdir()
    assert {p.name for p in folder.iterdir()} >= {"database.db", "images", "seconds"}


def test_bad_arguments_are_refused(frames):
    with pytest.raises(TooFewFrames, match="at least 3"):
        sfm.reconstruct_sfm(frames[:2], raycast.SENSOR, Work(), "raw")
    with pytest.raises(ValueError, match="raw, fused or one-exposure"):
        sfm.pictures_of(frames, raycast.SENSOR, "hdr")  # pyright: ignore[reportArgumentType]
