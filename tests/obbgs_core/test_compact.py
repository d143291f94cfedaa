"""Pictures in little memory: what is read is what was given, bit for bit, and trainings are the same."""

import dataclasses
import resource
import tracemalloc
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter

from obbgs_core import compact, preset
from obbgs_core.compact import Compact, held, part, seen, whole
from obbgs_core.process import give_back
from obbgs_core.start.hull import silhouette_of
from obbgs_core.start.sky_level import cut_pixels
from obbgs_core.train.trainer import Trainer
from tests import scenes


@st.composite
def pictures(draw) -> torch.Tensor:
    """Pictures of one value around a rectangle, of every type that pictures and masks have."""
    height, width = draw(st.integers(1, 9)), draw(st.integers(1, 20))
    channels = draw(st.sampled_from([(), (1,), (3,)]))
    kind = draw(st.sampled_from([np.float32, np.uint8, np.uint16, np.float64, bool]))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    picture = np.broadcast_to(rng.integers(0, 2, channels), (height, width, *channels)).astype(kind)
    top, left = draw(st.integers(0, height)), draw(st.integers(0, width))
    inside = picture[top : draw(st.integers(0, height)), left : draw(st.integers(0, width))]
    largest = draw(st.sampled_from([2, 256, 5000, 70_000]))
    inside[...] = (rng.integers(0, largest, inside.shape) / draw(st.sampled_from([1, 3]))).astype(kind)
    return torch.from_numpy(picture)


@given(pictures(), st.data())
def test_every_part_of_a_picture_is_what_was_given(picture, data):
    small = Compact.of(picture)
    found = small.tensor()
    assert found.dtype == picture.dtype and torch.equal(found, picture)
    rows, columns = (
        slice(*sorted(data.draw(st.lists(st.integers(0, side), min_size=2, max_size=2))))
        for side in picture.shape[:2]
    )
    assert torch.equal(small.part(rows, columns), picture[rows, columns])
    found.numpy()[...] = 0  # a copy
    assert torch.equal(small.tensor(), picture)


def test_large_pictures_are_held_in_the_memory_of_what_they_show():
    dn = torch.full((1500, 1000, 1), 64.0)
    dn[300:700, 200:600] = torch.randint(0, 4096, (400, 400, 1)).float()
    tracemalloc.start()
    frame = scenes.photographed(scenes.target(), 1)[0]
    frame = dataclasses.replace(frame, dn=dn)
    others = [dataclasses.replace(frame, id=number) for number in range(20)]
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    (kept,) = {id(other.__dict__["_dn"]): other.__dict__["_dn"] for other in others}.values()
    assert taken < 1e5 and kept.inside.nbytes == 2 * 400 * 400  # 16 bits, once
    assert all(torch.equal(other.dn, dn) for other in others[:2])
    assert others[0].shape == dn.shape
    changed = others[1].dn
    changed[0, 0] = 7.0  # of a copy
    assert torch.equal(others[1].dn, dn)
    assert torch.equal(dataclasses.replace(frame, dn=changed).dn, changed)


def taken_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


ON_LINUX = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="Linux tells what a process takes"
)


@ON_LINUX
def test_what_is_no_longer_held_goes_back_to_the_system_whatever_lies_beside_it():
    np.ones(31_000_000, dtype=np.uint8)  # once it is freed the C library keeps what is smaller
    every = [held(torch.randint(0, 4096, (1000, 2000)).float()) for _ in range(20)]
    before = taken_bytes()
    every = every[::2]  # 10 times 4 MB
    assert before - taken_bytes() > 36e6
    assert all(isinstance(one, Compact) for one in every)


@ON_LINUX
def test_what_was_freed_between_what_is_held_is_given_back():
    pieces = [np.ones(100_000, dtype=np.uint8) for _ in range(400)]  # too small for pages of their own
    pieces = pieces[::2]
    before = taken_bytes()
    give_back()
    assert before - taken_bytes() > 10e6  # of 20 MB
    assert len(pieces) == 200


@given(st.integers(0, 99), st.integers(1, 4), st.lists(st.integers(0, 40), min_size=4, max_size=4))
def test_what_depends_on_near_pixels_is_found_around_what_is_not_even(seed, reach, edges):
    rows, columns = (slice(*sorted(pair)) for pair in (edges[:2], edges[2:]))
    picture = torch.full((40, 40, 1), 3.0)
    part = picture[rows, columns]
    part[...] = torch.from_numpy(np.random.default_rng(seed).integers(0, 9, part.shape)).float()

    def look(dn: torch.Tensor) -> torch.Tensor:
        means = uniform_filter(dn[..., 0].double().numpy(), 2 * reach + 1, mode="nearest")
        return torch.from_numpy(np.stack([means.round(6), (dn[..., 0] > 3).numpy()]))

    assert torch.equal(seen(look, Compact.of(picture), reach), look(picture))


def test_silhouettes_and_cut_pixels_of_large_frames_are_those_of_the_whole_picture(monkeypatch):
    frame = scenes.photographed(scenes.target(), 1)[0]
    dn = torch.full((200, 260, frame.shape[2]), float(scenes.SENSOR.black_dn))
    dn[70 : 70 + frame.shape[0], 90 : 90 + frame.shape[1]] = frame.dn
    plain = dataclasses.replace(frame, dn=dn)
    monkeypatch.setattr(compact, "FEWEST_PX", 1)
    large = dataclasses.replace(frame, dn=dn)
    assert large.is_compact and not plain.is_compact
    for name in ("certain", "likely", "sky"):
        one, other = (getattr(silhouette_of(f, scenes.SENSOR), name) for f in (plain, large))
        assert torch.equal(one[13:-13, 13:-13], other[13:-13, 13:-13]), name
    cut = partial(cut_pixels, scenes.SENSOR)
    assert cut(dn).any() and torch.equal(large.seen(cut, 10), cut(dn))


def test_what_is_small_stays_as_it_is():
    dn = torch.rand(20, 20, 1)
    assert held(dn) is dn and whole(dn) is dn
    assert torch.equal(part(dn, slice(2, 4), slice(3, 9)), dn[2:4, 3:9])


@pytest.mark.parametrize("outside", [None, 64.0, 64.5])
def test_a_frame_with_a_few_other_readings_shares_the_others_and_reads_as_if_they_had_been_put_in(outside):
    dn = torch.full((1500, 1000, 1), 64.0)
    dn[300:700, 200:600] = torch.randint(65, 4096, (400, 400, 1)).float()
    frame = dataclasses.replace(scenes.photographed(scenes.target(), 1)[0], dn=dn)
    at = torch.zeros(1500, 1000, dtype=torch.bool)
    at[310, 210:220], at[305:400, 599], at[5, 7] = True, True, outside is not None
    other = torch.full((int(at.sum()), 1), 7.25)
    if outside is not None:
        other[0] = outside
    expected = dn.clone()
    expected[at] = other
    changed = frame.with_readings(at, other)
    assert torch.equal(changed.dn, expected) and torch.equal(frame.dn, dn)
    rows, columns = slice(306, 350), slice(215, 600)
    assert torch.equal(changed.part(rows, columns), expected[rows, columns])
    kept, given = (f.__dict__["_dn"] for f in (changed, frame))
    assert (kept.inside is given.inside) == (outside != 64.5)
    again = changed.with_readings(at, other + 1)
    expected[at] = other + 1
    assert torch.equal(again.dn, expected)


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_a_training_on_compact_frames_is_the_same_to_the_bit(monkeypatch, scale):
    def trained() -> list[torch.Tensor]:
        frames = scenes.photographed(scenes.target(), 12, size_px=45)
        trainer = Trainer(frames, scenes.SENSOR, preset("obbgs", {"steps": 30}), seed=1)
        for _ in range(6):
            trainer.step()
        batch = trainer.setup.batches.batch([1, 3], scale)
        assert trainer.setup.frames[0].is_compact == (compact.FEWEST_PX < 45**2)
        masks = [mask for mask in (batch.sky, batch.solid) if mask is not None]
        return [batch.dn, *masks, trainer.state.model.means.detach(), torch.tensor(trainer.setup.radius_m)]

    as_given = trained()
    monkeypatch.setattr(compact, "FEWEST_PX", 1)
    for ours, theirs in zip(trained(), as_given, strict=True):
        assert torch.equal(ours, theirs)
