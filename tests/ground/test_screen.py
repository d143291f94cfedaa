"""What stands in front of a plain screen is told from it by the colour of the border."""

import imagecodecs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground.formats.pictures.files import FormatError
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.screen import with_screen_masks
from ground.formats.pictures.view import View, read_mask

SIZE = 48
Y, X = np.mgrid[:SIZE, :SIZE]
RNG = np.random.default_rng(0)


def masked(folder, picture) -> np.ndarray:
    """Return the mask [H, W] of a picture [H, W, 3] in 0..1."""
    return read_mask(with_screen_masks([view_of(folder / "a.png", picture)], folder / "masks")[0])


def view_of(path, picture) -> View:
    path.write_bytes(imagecodecs.png_encode((255 * picture).clip(0, 255).round().astype(np.uint8)))
    return View(path, np.eye(4), Intrinsics(SIZE, SIZE, 50.0, 50.0, SIZE / 2, SIZE / 2))


@given(
    screen=st.tuples(*[st.floats(0.1, 0.8)] * 3),
    slope=st.floats(-0.15, 0.15),
    noise=st.floats(0, 0.015),
    left=st.integers(-6, 20),
)
@settings(max_examples=25, deadline=None)
def test_a_target_is_told_from_a_screen_that_is_lit_unevenly_also_where_it_leaves_the_picture(
    tmp_path_factory, screen, slope, noise, left
):
    picture = np.array(screen) * (1 + slope * (X / SIZE - 0.5) - 0.5 * slope * (Y / SIZE - 0.5))[..., None]
    target = ((X - left - 10) / 14.0) ** 2 + ((Y - 24) / 14.0) ** 2 < 1
    target &= (X - left - 10) ** 2 + (Y - 24) ** 2 > 16  # through the hole the screen is seen
    picture[target] = (np.array(screen) + 0.5) % 1.0
    picture = picture + noise * np.random.default_rng(1).normal(size=picture.shape)
    mask = masked(tmp_path_factory.mktemp("screen"), picture)
    assert (mask[target] == 1).mean() > 0.95 and (mask[~target] == 0).mean() > 0.98


@pytest.mark.parametrize(
    "picture",
    [
        RNG.random((SIZE, SIZE, 3)),
        np.where((X < SIZE // 3)[..., None], 0.1, np.where((X < 32)[..., None], 0.5, 0.9)) * np.ones(3),
    ],
    ids=["leaves", "three walls"],
)
def test_a_border_of_several_colours_is_refused_with_the_remedy(tmp_path, picture):
    with pytest.raises(FormatError, match=r"not of one colour.*--masks a folder"):
        masked(tmp_path, picture)


def test_a_picture_that_the_target_fills_has_the_screen_of_the_others(tmp_path):
    empty = np.ones((SIZE, SIZE, 3)) * [0.1, 0.2, 0.7]
    full = RNG.random((SIZE, SIZE, 3)) * [0.9, 0.9, 0.3]
    full[20:28, 20:28] = empty[0, 0]
    views = [view_of(tmp_path / f"{i}.png", picture) for i, picture in enumerate((empty, empty, full))]
    masks = [read_mask(v) for v in with_screen_masks(views, tmp_path / "masks")]
    assert not masks[0].any()
    assert not masks[2][21:27, 21:27].any() and masks[2].mean() == pytest.approx(1 - 64 / SIZE**2, abs=0.01)
