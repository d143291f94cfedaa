"""The part of each picture that a training renders and compares."""

import dataclasses

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from obbgs_core.batches import GRID_PX, Batches, common, windows
from obbgs_core.frames import cameras_of
from obbgs_core.jpeg import JpegCoding
from obbgs_core.methods.presets import preset
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db
from obbgs_core.start.initialisation import silhouettes
from obbgs_core.train import train
from obbgs_core.train.trainer import Trainer
from tests.scenes import SENSOR, photographed, target

SIZE_PX = 150  # no multiple of the grid
SMALL = dataclasses.replace(target(40), means=target(40).means * 0.4)


def shown_of(frames) -> torch.Tensor:
    return windows(frames, SMALL.means, {i: s.certain for i, s in silhouettes(frames, SENSOR).items()})


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25])
def test_a_window_shows_what_the_whole_picture_shows_there(scale):
    frames = photographed(SMALL, 6, size_px=SIZE_PX, focal_px=90.0)
    shown = shown_of(frames)
    assert (shown[:, 2:] - shown[:, :2]).float().mean() < 0.8 * SIZE_PX
    indices = [0, 2, 5]
    part = Batches(frames, SENSOR.white_dn, None, shown).batch(indices, scale)
    whole = Batches(frames, SENSOR.white_dn).batch(indices, scale)
    height, width = part.dn.shape[1:3]
    assert (part.cameras.height, part.cameras.width) == (height, width)
    assert part.shown == pytest.approx(height * width / (whole.dn.shape[1] * whole.dn.shape[2]), rel=0.05)
    ours, theirs = (render(SMALL, batch.cameras).radiance for batch in (part, whole))
    moved = ((whole.cameras.K - part.cameras.K)[:, :2, 2]).round().long().tolist()
    for k, (x, y) in enumerate(moved):
        assert torch.equal(part.dn[k], whole.dn[k, y : y + height, x : x + width])
        torch.testing.assert_close(ours[k], theirs[k, y : y + height, x : x + width], rtol=1e-4, atol=1e-5)
        outside = theirs[k].clone()
        outside[y : y + height, x : x + width] = 0
        assert outside.max() < 1e-3 * theirs[k].max()  # of the target nothing is cut off


def test_windows_hold_light_that_the_start_lacks():
    frames = photographed(SMALL, 12, size_px=SIZE_PX, focal_px=90.0)
    lit = {i: outline.certain for i, outline in silhouettes(frames, SENSOR).items()}
    core = SMALL.means[SMALL.means.norm(dim=1) < 0.15]
    tight, shown = windows(frames, core, {}), windows(frames, core, lit)
    for i, certain in lit.items():
        rows, columns = torch.nonzero(certain).unbind(dim=1)
        left, top, right, bottom = shown[i].tolist()
        assert left <= columns.min() and columns.max() < right and top <= rows.min() and rows.max() < bottom
    areas = [(w[:, 2:] - w[:, :2]).prod(dim=1).sum() for w in (tight, shown)]
    assert areas[0] < areas[1]


def test_a_point_behind_a_camera_gets_the_whole_picture():
    frames = photographed(SMALL, 3, size_px=SIZE_PX)
    behind = torch.cat([SMALL.means, cameras_of(frames[:1]).centres * 1.01])
    shown = windows(frames, behind, {})
    assert shown[0].tolist() == [0, 0, SIZE_PX, SIZE_PX]


@given(
    st.integers(3, 200),
    st.integers(3, 200),
    st.lists(st.tuples(*[st.floats(0, 1)] * 4), min_size=1, max_size=4),
)
def test_common_windows_have_one_size_hold_their_own_and_lie_in_the_picture(width, height, drawn):
    size, rows = (width, height), []
    for corner in drawn:
        begin = [int(corner[a] * (size[a] - 1)) // GRID_PX * GRID_PX for a in (0, 1)]
        end = [min(size[a], begin[a] + GRID_PX * (1 + int(6 * corner[2 + a]))) for a in (0, 1)]
        rows.append([*begin, *end])
    given_windows = torch.tensor(rows)
    found = common(given_windows, width, height)
    assert len({tuple(row) for row in (found[:, 2:] - found[:, :2]).tolist()}) == 1
    assert (found[:, :2] <= given_windows[:, :2]).all() and (found[:, 2:] >= given_windows[:, 2:]).all()
    assert (found[:, :2] % GRID_PX == 0).all() and (found[:, :2] >= 0).all()
    assert (found[:, 2:] <= torch.tensor(size)).all()


def test_what_is_learnt_in_windows_is_as_good_on_whole_pictures():
    frames = photographed(SMALL, 24, size_px=SIZE_PX, focal_px=90.0)
    cameras = cameras_of(frames)
    true = render(SMALL, cameras).radiance
    scores_db = []
    for wanted in (False, True):
        config = preset("obbgs", {"steps": 120, "published.windows": wanted})
        setup = Trainer(frames, SENSOR, config).setup
        assert (setup.batches.batch([0], 1.0).shown < 0.6) == wanted
        learnt = train(frames, SENSOR, config, seed=0).gaussians
        scores_db.append(psnr_db(render(learnt, cameras).radiance / true.max(), true / true.max()))
    assert scores_db[0] > 30
    assert scores_db[1] > scores_db[0] - 1


@pytest.mark.parametrize("size_px", [144, 150])
def test_no_window_cuts_a_block_of_jpeg(size_px):
    frames = photographed(SMALL, 6, size_px=size_px, focal_px=90.0)
    told = dataclasses.replace(SENSOR, jpeg=JpegCoding((1,) * 64))
    shown = Trainer(frames, told, preset("obbgs"), 0).setup.batches.batch([0, 1]).dn.shape[1:3]
    assert tuple(shown) == (150, 150) if size_px == 150 else shown[0] < 144 and shown[0] % GRID_PX == 0
