"""The frames of each step: their averaged images, and the order in which they are drawn."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from obbgs_core.batches import Batches
from obbgs_core.evidence.poses import validation_brackets
from obbgs_core.frames import TrainingFrame, averaged
from obbgs_core.train.order import FrameOrder
from tests.scenes import SENSOR, photographed, target

WHITE_DN = SENSOR.white_dn


def image(seed: int, height: int, width: int, channels: int = 1) -> torch.Tensor:
    """Return readings [H, W, C] of which some tenth is saturated."""
    rng = np.random.default_rng(seed)
    dn = np.minimum(rng.integers(0, round(1.1 * WHITE_DN), (height, width, channels)), WHITE_DN)
    return torch.from_numpy(dn.astype(np.float32))


def test_only_full_scale_is_saturated_in_a_smaller_picture():
    rng = np.random.default_rng(5)
    dn = torch.from_numpy(rng.normal(2000, 100, (64, 64, 1)).round().astype(np.float32))
    blocks = dn.reshape(16, 4, 16, 4)
    torch.testing.assert_close(averaged(dn, 4, 4095.0)[..., 0], blocks.mean(dim=(1, 3)))
    dn[8, 8] = 4095
    torch.testing.assert_close(averaged(dn, 4, 4095.0)[2, 2, 0], torch.tensor(4095.0))


@given(
    st.integers(0, 1000), st.integers(3, 40), st.integers(3, 40), st.integers(1, 5), st.sampled_from([1, 3])
)
def test_each_pixel_of_a_smaller_picture_is_the_mean_of_its_block_or_saturated(
    seed, height, width, factor, channels
):
    dn = image(seed, height, width, channels)
    small = averaged(dn, factor, WHITE_DN)
    assert small.shape == (-(-height // factor), -(-width // factor), channels)
    for row in range(small.shape[0]):
        for column in range(small.shape[1]):  # blocks at the edge are smaller where the size is no multiple
            block = dn[row * factor : (row + 1) * factor, column * factor : (column + 1) * factor].flatten(
                0, 1
            )
            saturated = (block >= WHITE_DN).any(dim=0)
            expected = torch.where(saturated, WHITE_DN, block.mean(dim=0))
            torch.testing.assert_close(small[row, column], expected)


@given(st.integers(0, 1000), st.integers(3, 33), st.integers(3, 33))
def test_two_halvings_are_one_quartering_where_nothing_is_saturated(seed, rows, columns):
    dn = image(seed, 4 * rows, 4 * columns).clamp(max=WHITE_DN - 1)
    twice = averaged(averaged(dn, 2, WHITE_DN), 2, WHITE_DN)
    torch.testing.assert_close(twice, averaged(dn, 4, WHITE_DN), rtol=1e-5, atol=1e-3)  # float32 sums
    torch.testing.assert_close(twice.mean(), dn.mean(), rtol=1e-5, atol=1e-3)  # no light is lost


@pytest.mark.parametrize(("size_px", "small_px"), [(61, 16), (64, 16), (65, 17)])
def test_smaller_pictures_have_the_size_of_their_cameras_and_their_sky(size_px, small_px):
    frames = photographed(target(5), 3, size_px=size_px)
    sky = {1: torch.ones(size_px, size_px, dtype=torch.bool)}
    batch = Batches(frames, WHITE_DN, sky).batch([1, 2], 0.25)
    assert batch.dn.shape == (2, small_px, small_px, 1) and batch.averaged_pixels == 16
    assert (batch.cameras.height, batch.cameras.width) == (small_px, small_px)
    assert batch.sky is not None and batch.sky.shape == (2, small_px, small_px)
    assert (batch.sky[0] == 1).all() and (batch.sky[1] == 0).all()  # of frame 2 no silhouette is known


def order_of(frames: list[TrainingFrame], kept_back: Sequence[list[int]] = ()) -> FrameOrder:
    return FrameOrder([f.exposure_time_s for f in frames], True, list(kept_back))


def test_validation_brackets_are_withheld_whole():
    exact = photographed(target(), 72)
    frames = [dataclasses.replace(f, bracket=i // 3) for i, f in enumerate(exact)]
    brackets = validation_brackets(frames)
    assert brackets == [[9, 10, 11], [30, 31, 32], [51, 52, 53]]
    order, rng = order_of(frames, brackets), torch.Generator().manual_seed(0)
    drawn = [i for _ in range(42) for i in order.draw(3, rng)]
    assert (
        sorted(drawn[:63]) == sorted(drawn[63:]) == sorted(set(range(72)) - {i for b in brackets for i in b})
    )
    assert validation_brackets(frames[:51]) == []  # 17 brackets hold only two for validation


def test_frames_that_join_late_are_drawn_more_often_until_they_have_caught_up():
    frames = photographed(target(5), 24, size_px=8)
    order, rng = order_of(frames[:12]), torch.Generator().manual_seed(0)
    order.draw(12 * 8, rng)
    assert set(order.visits.values()) == {8}
    order.extend([f.exposure_time_s for f in frames])
    drawn = order.draw(48, rng)  # a round: each of the old once, each of the new three times
    assert sorted(drawn) == sorted([*range(12), *[i for i in range(12, 24) for _ in range(3)]])
    for _ in range(20):
        order.draw(24, rng)
    visits = [order.visits[i] for i in range(24)]
    assert min(visits) * 2 > max(visits)
    assert all(n >= 8 for n in visits)


def test_frames_that_were_there_from_the_start_are_drawn_once_a_round():
    frames = photographed(target(5), 12, size_px=8)
    order, rng = order_of(frames), torch.Generator().manual_seed(0)
    for _ in range(5):
        assert sorted(order.draw(12, rng)) == list(range(12))


def exposed(times_s: list[float]) -> FrameOrder:
    return FrameOrder(times_s, True, [])


AUTOMATIC = [0.02] * 85 + [0.016] * 13 + [1 / 60] * 13 + [0.025] * 7 + [0.0125]


@pytest.mark.parametrize(
    "times_s", [AUTOMATIC, [0.01 * 1.1**i for i in range(40)], [0.01, 0.02] + [0.04] * 9]
)
def test_a_rare_exposure_time_is_drawn_as_often_as_any_frame(times_s):
    order, rng = exposed(times_s), torch.Generator().manual_seed(0)
    drawn = order.draw(3 * len(times_s), rng)
    assert sorted(drawn) == sorted([*range(len(times_s))] * 3)


def test_each_step_still_has_one_of_each_exposure_time_of_brackets_of_which_some_frames_are_missing():
    times_s = [0.01, 0.02, 0.04] * 10
    del times_s[3], times_s[10]
    times_s.append(0.5)  # and one was taken by itself
    order, rng = exposed(times_s), torch.Generator().manual_seed(0)
    assert [len(group) for group in order.groups] == [9, 10, 10]
    for _ in range(20):
        step = {round(times_s[i], 2) for i in order.draw(3, rng)}
        assert step in ({0.01, 0.02, 0.04}, {0.01, 0.02, 0.5})  # the single one stands in for its neighbour
