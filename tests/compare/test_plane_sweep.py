"""Plane-sweep stereo: its parts against OpenCV and scikit-image, the whole on boxes whose surface is known."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.feature import match_template

from compare.opponents import depth_maps, plane_sweep, stereo_views
from compare.opponents.plane_sweep import SweepSettings, correlation, reconstruct_mvs
from compare.opponents.reconstruction import Work
from obbgs_base.errors import Interrupted
from obbgs_core.errors import ReconstructionError, TooFewFrames
from tests import raycast

FEW = SweepSettings(sources=4, window_px=5, fusion=depth_maps.FusionSettings(0.5))
BOXES = raycast.spacecraft(3)


@pytest.fixture(scope="module")
def scene():
    """A textured spacecraft from 20 directions within 40 degrees, 64x64, in three exposures, with true depths."""
    poses = raycast.looking_at_origin(raycast.directions(20, 40), 4.5)
    return raycast.photographed(BOXES, poses, 64, 120.0)


def test_correlation_matches_scikit_image():
    rng = np.random.default_rng(0)
    b = rng.random((20, 24)).astype(np.float32)
    a = (0.3 * b + 0.1 * rng.random((20, 24))).astype(np.float32)
    ours = correlation(torch.from_numpy(a), torch.from_numpy(b)[None], 7)[0]
    for row, column in ((0, 0), (3, 9), (13, 17)):
        window = np.s_[row : row + 7, column : column + 7]
        theirs = match_template(b[window], a[window])[0, 0]
        assert ours[row, column].item() == pytest.approx(theirs, abs=1e-4)  # float32 sums of 49 values


def test_windows_without_texture_do_not_correlate():
    for level in torch.linspace(0.05, 3, 60).tolist():
        value = correlation(torch.full((7, 7), level), torch.full((1, 7, 7), level), 7)
        assert abs(float(value)) < 0.5


@settings(max_examples=10)
@given(gain=st.floats(0.1, 10), offset=st.floats(-1, 1), seed=st.integers(0, 99))
def test_correlation_ignores_gain_and_offset_and_stays_within_one(gain, offset, seed):
    rng = torch.Generator().manual_seed(seed)
    a, b = torch.rand(9, 9, generator=rng), torch.rand(2, 9, 9, generator=rng)
    value = correlation(a, b, 5)
    torch.testing.assert_close(correlation(gain * a + offset, b, 5), value, atol=2e-3, rtol=0)
    assert value.abs().max() <= 1
    torch.testing.assert_close(correlation(a, a[None], 5), torch.ones(1, 5, 5), atol=1e-3, rtol=0)


def test_a_window_that_holds_a_pixel_without_value_has_no_correlation_and_a_flat_one_has_none():
    a = torch.rand(9, 9, generator=torch.Generator().manual_seed(0))
    b = a.clone()[None]
    b[0, 0, 0] = torch.nan
    value = correlation(a, b, 5)[0]
    assert value[0, 0].isnan() and value.isnan().sum() == 1
    assert correlation(a, torch.ones(1, 9, 9), 5).abs().max() < 1e-3


@pytest.mark.parametrize("tilt_deg", [0, 45])
def test_the_image_of_a_plane_is_warped_as_by_opencv(tilt_deg):
    """The homography from OpenCV's own solver, of four points of the plane; the warp from OpenCV."""
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.random((48, 48)).astype(np.float32), (0, 0), 2)
    K = np.array([[80.0, 0, 24], [0, 80, 24], [0, 0, 1]])
    poses = raycast.looking_at_origin(np.array([[0, 0, 1.0], [0.3, 0.1, 1]]), 4.0)
    lit = torch.ones(48, 48, dtype=torch.bool)
    reference, source = (
        stereo_views.View(torch.from_numpy(image)[None], 1.0, lit, torch.tensor(p), torch.tensor(K))
        for p in poses
    )
    normal = np.array([np.sin(np.radians(tilt_deg)), 0, np.cos(np.radians(tilt_deg))])
    offset_m = 3.9 * normal[2]
    corners = np.array([[4, 4], [44, 4], [4, 44], [44, 44]]) + 0.5
    rays = np.c_[corners, np.ones(4)] @ np.linalg.inv(K).T
    points = rays * (offset_m / (rays @ normal))[:, None]
    body = np.linalg.solve(poses[0], np.c_[points, np.ones(4)].T)
    seen = K @ (poses[1] @ body)[:3]
    # OpenCV's pixel centres are whole numbers
    H = cv2.getPerspectiveTransform(
        (corners - 0.5).astype(np.float32), (seen[:2] / seen[2] - 0.5).T.astype(np.float32)
    )
    theirs = cv2.warpPerspective(image, H, (48, 48), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    inside = cv2.warpPerspective(np.ones_like(image), H, (48, 48), flags=flags) > 0.999
    rows, columns = torch.meshgrid(torch.arange(48), torch.arange(48), indexing="ij")
    rays = stereo_views.pixel_rays(rows, columns, reference.K)
    inverse_depths = ((rays @ torch.tensor(normal)) / offset_m).float()[None]
    terms = plane_sweep.homography_terms(rays, reference, source)
    ours = plane_sweep.warp(source.image, *terms, inverse_depths)[0, 0].numpy()
    assert inside.sum() > 500
    # OpenCV rounds places to 1/32 px; the steepest slope of the picture is about 0.1 per px
    np.testing.assert_allclose(ours[inside], theirs[inside], atol=0.1 / 32)


def test_depths_of_a_textured_spacecraft_are_found(scene):
    frames, truth = scene
    views = stereo_views.prepare(frames, raycast.SENSOR, one_exposure=True)
    assert len(views.views) == len(frames)
    pairs = stereo_views.neighbours(views, 4)
    found = plane_sweep.sweep(views, 7, pairs[7], SweepSettings(sources=4, window_px=5))
    sure = (found.confidence.numpy() > 0.7) & (truth[7] > 0)
    error = np.abs(found.depth_m.numpy() - truth[7])[sure]
    assert sure.sum() > 100
    assert np.median(error) < 0.5 * 4.5 / 120  # half a pixel, seen from the side
    assert not ((found.depth_m > 0) & ~views.views[7].lit).any()


def test_a_textured_spacecraft_becomes_a_cloud_on_its_surface(scene):
    frames, _ = scene
    shares, early = [], []

    def on_step(share, seconds, snapshot):
        shares.append(share)
        if len(shares) == 15:
            early.append(len(snapshot(True).points))

    result = reconstruct_mvs(frames, raycast.SENSOR, Work(on_step=on_step), settings=FEW)
    pixel_m = 4.5 / 120
    distance = raycast.distances_to_surface(BOXES, result.points.double().numpy())
    assert len(result.points) > 2000 and result.surface is result.points and result.image is None
    assert np.median(distance) < 0.5 * pixel_m and np.quantile(distance, 0.95) < 2 * pixel_m
    assert result.size_bytes == 12 * len(result.points)
    assert result.figures["points"] == len(result.points) and result.figures["depth_maps"] == 20
    assert 0 < result.figures["rejected_share"] < 1
    assert 0 < early[0] < len(result.points)  # the snapshot after three quarters of the maps
    assert shares == sorted(shares) and len(shares) == 20 and shares[-1] < 1


def test_two_exposures_of_one_view_are_clipped_alike():
    """Once both are clipped where the longer saturates they differ by noise; as they are, by its saturated part."""
    pose = raycast.looking_at_origin(np.array([[0, 0.3, 1.0]]), 4.5)
    frames, _ = raycast.photographed(BOXES, np.repeat(pose, 3, axis=0), 64, 120.0)
    known = stereo_views.prepare(frames, raycast.SENSOR, one_exposure=True)
    raw = stereo_views.prepare(frames, raycast.SENSOR, one_exposure=False)
    assert known.digest != raw.digest and [v.full_scale for v in raw.views] == [1, 1, 1]
    middle, long = known.views[1:]
    assert long.full_scale == pytest.approx(middle.full_scale / 2)
    brightest = middle.image[0] > 1.1 * long.full_scale  # of the mean exposure, beyond the noise
    alike = [plane_sweep.comparable(v, long.full_scale)[brightest].nanmean() for v in (middle, long)]
    assert brightest.sum() > 50 and alike[0].item() == pytest.approx(alike[1].item(), rel=0.01)
    assert middle.image[0][brightest].mean() > 1.1 * long.image[0][brightest].mean()
    lit = raw.views[0].lit & raw.views[2].lit
    assert raw.views[2].image[0][lit].mean() > 2 * raw.views[0].image[0][lit].mean()


def test_an_interrupted_sweep_goes_on_and_ends_alike(scene, tmp_path):
    frames = scene[0][:9]
    whole = reconstruct_mvs(frames, raycast.SENSOR, Work(), settings=FEW)
    answers = iter([False, False, True])
    with pytest.raises(Interrupted, match="after 3 of 9 depth maps"):
        reconstruct_mvs(
            frames, raycast.SENSOR, Work(tmp_path, should_stop=lambda: next(answers)), settings=FEW
        )
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == 3
    kept[1].write_bytes(b"damaged")
    times = {p: p.stat().st_mtime_ns for p in kept}
    again = reconstruct_mvs(frames, raycast.SENSOR, Work(tmp_path), settings=FEW)
    assert torch.equal(again.points, whole.points)
    assert [p.stat().st_mtime_ns == times[p] for p in kept] == [True, False, True]
    # maps of other frames are not taken for these
    other = [dataclasses.replace(f, exposure_time_s=2 * f.exposure_time_s) for f in frames]
    with pytest.raises(Interrupted):
        reconstruct_mvs(other, raycast.SENSOR, Work(tmp_path, should_stop=lambda: True), settings=FEW)
    assert len(list(tmp_path.iterdir())) == 10


def test_frames_without_agreement_give_nothing_with_the_reason(scene):
    frames = scene[0][:3]  # no view has three neighbours
    result = reconstruct_mvs(frames, raycast.SENSOR, Work(), settings=FEW)
    assert len(result.points) == 0 and "no depth of" in result.figures["failed"]


def test_bad_frames_are_refused(scene):
    frames = scene[0]
    with pytest.raises(TooFewFrames, match="at least 3"):
        reconstruct_mvs(frames[:2], raycast.SENSOR, Work())
    black = [dataclasses.replace(f, dn=torch.full_like(f.dn, 64.0)) for f in frames[:3]]
    with pytest.raises(ReconstructionError, match="black"):
        reconstruct_mvs(black, raycast.SENSOR, Work())


def test_the_best_neighbour_is_at_a_useful_angle(scene):
    views = stereo_views.prepare(scene[0], raycast.SENSOR, one_exposure=True)
    centres = torch.stack([v.centre / v.centre.norm() for v in views.views])
    angles_deg = torch.rad2deg((centres @ centres.T).clamp(-1, 1).acos())
    for i, chosen in enumerate(stereo_views.neighbours(views, 5)):
        assert len(chosen) == 5 and i not in chosen
        others = sorted(float(a) for j, a in enumerate(angles_deg[i]) if j != i)
        assert abs(float(angles_deg[i, chosen[0]]) - 15) == pytest.approx(
            min(abs(a - 15) for a in others), abs=4
        )


def test_points_that_only_two_views_see_alike_are_rejected():
    """Three views of one plane, of which one is wrong: no point has two others that agree; with one other, some."""
    poses = raycast.looking_at_origin(np.array([[0, 0, 1.0], [0.2, 0, 1], [0, 0.2, 1]]), 4.0)
    K = torch.tensor([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]], dtype=torch.float64)
    lit = torch.ones(32, 32, dtype=torch.bool)
    views, maps = [], []
    for k, pose in enumerate(poses):
        view = stereo_views.View(torch.zeros(1, 32, 32), 1.0, lit, torch.tensor(pose), K)
        rows, columns = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
        rays = stereo_views.pixel_rays(rows, columns, K) @ view.world_to_camera[:3, :3]
        depth_m = (-view.centre[2] / rays[..., 2]) * (1.2 if k == 2 else 1)  # the plane z = 0 of the body
        views.append(view)
        maps.append(depth_maps.DepthMap(depth_m.float(), torch.ones(32, 32)))
    together = stereo_views.Views(views, 1.0, "")
    two = depth_maps.fuse(together, maps, depth_maps.FusionSettings(0.5, agreeing_views=2))
    one = depth_maps.fuse(together, maps, depth_maps.FusionSettings(0.5, agreeing_views=1))
    assert len(two[0]) == 0 and two[1] == one[1] == 3 * 32 * 32
    assert len(one[0]) > 500 and one[0][:, 2].abs().max() < 0.05
