"""Large pictures and masks in little memory, without loss.

A picture is held in the fewest bits that its values fit in, and only where it is not even: flight sends what is far
from the target as black, so that of such a frame only the target and its surroundings take memory. Reading gives a new
tensor of the values that were given.
"""

import dataclasses
import mmap
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from obbgs_core.errors import expect

FEWEST_PX = 1_000_000  # smaller pictures stay as they are: reading them often would cost more than they take


@dataclass(frozen=True, eq=False)
class Compact:
    """A picture [H, W, ...] that has one value around a rectangle.

    around: [...] that value. inside: [h, w, ...] the rectangle, of bits [h, w / 8 rounded up] if dtype is bool.
    changed: rows [N] and columns [N] of pixels in the rectangle, and the values [N, ...] that they have instead.
    """

    shape: torch.Size
    dtype: torch.dtype
    around: np.ndarray
    top: int
    left: int
    width: int
    inside: np.ndarray
    changed: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    @classmethod
    def of(cls, picture: Tensor) -> "Compact":
        """Return a picture [H, W, ...] in little memory."""
        values = picture.numpy()
        differs = (values != values[0, 0]).reshape(*values.shape[:2], -1).any(axis=2)
        rows, columns = np.flatnonzero(differs.any(axis=1)), np.flatnonzero(differs.any(axis=0))
        top, bottom = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        left, right = (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, 0)
        inside = values[top:bottom, left:right]
        width = right - left
        inside = np.packbits(inside, axis=1) if picture.dtype == torch.bool else _smallest(inside)
        return cls(picture.shape, picture.dtype, values[0, 0].copy(), top, left, width, _apart(inside))

    def part(self, rows: slice, columns: slice) -> Tensor:
        """Return some rows and columns, a new tensor [h, w, ...]; the slices have no steps."""
        top, bottom, _ = rows.indices(self.shape[0])
        left, right, _ = columns.indices(self.shape[1])
        around = torch.from_numpy(np.asarray(self.around))
        whole = around.expand(bottom - top, right - left, *self.shape[2:]).contiguous()
        whole = whole.clone() if whole.numel() == around.numel() else whole
        first, last = max(top, self.top), min(bottom, self.top + len(self.inside))
        begin, end = max(left, self.left), min(right, self.left + self.width)
        if first < last and begin < end:
            inside = self.inside[first - self.top : last - self.top]
            if self.dtype == torch.bool:
                inside = np.unpackbits(inside, axis=1, count=self.width).view(bool)
            inside = inside[:, begin - self.left : end - self.left]
            whole.numpy()[first - top : last - top, begin - left : end - left] = inside
        if self.changed is not None:
            at, to, values = self.changed
            shown = (at >= top) & (at < bottom) & (to >= left) & (to < right)
            whole.numpy()[at[shown] - top, to[shown] - left] = values[shown]
        return whole

    def tensor(self) -> Tensor:
        """Return the whole picture, a new tensor that `held` knows again as long as nothing is written into it."""
        whole = self.part(slice(None), slice(None))
        whole.of_compact = (self, whole._version)  # type: ignore[attr-defined]
        return whole


def seen(look: Callable[[Tensor], Tensor], picture: Tensor | Compact, reach: int) -> Tensor:
    """Return what `look` says of each pixel of a picture [H, W, ...], [..., H, W].

    It depends on the readings within `reach` rows and columns of a pixel: where the picture is even it is the same
    everywhere, and of a large one only what is not even is looked at.
    """
    if not isinstance(picture, Compact):
        return look(picture)
    (height, width), margin = picture.shape[:2], 2 * (reach + 1)
    top, bottom = picture.top, picture.top + len(picture.inside)
    left, right = picture.left, picture.left + picture.width
    rows = slice(max(0, top - margin), min(height, bottom + margin))
    columns = slice(max(0, left - margin), min(width, right + margin))
    row, column = (rows.start + rows.stop) // 2, (columns.start + columns.stop) // 2
    if bottom + margin <= height:
        row = bottom + reach
    elif top >= margin:
        row = top - reach - 1
    elif right + margin <= width:
        column = right + reach
    elif left >= margin:
        column = left - reach - 1
    else:
        return look(picture.tensor())
    found = look(picture.part(rows, columns))
    even = found[..., row - rows.start, column - columns.start]
    of_all = even[..., None, None].expand(*even.shape, height, width).contiguous()
    known = (slice(max(0, top - reach), bottom + reach), slice(max(0, left - reach), right + reach))
    at = tuple(
        slice(k.start - p.start, min(k.stop, p.stop) - p.start)
        for k, p in zip(known, (rows, columns), strict=True)
    )
    of_all[(..., *known)] = found[(..., *at)]
    return of_all


def _smallest(values: np.ndarray) -> np.ndarray:
    """Return a copy of values in the smallest type of whole numbers that they fit in, if they do."""
    if values.size and values.min() >= 0 and not np.signbit(values).any():
        for dtype in (np.uint8, np.uint16):
            if values.max() <= np.iinfo(dtype).max and values.dtype.itemsize > np.dtype(dtype).itemsize:
                smaller = values.astype(dtype)
                if np.array_equal(smaller, values):
                    return smaller
    return values


def _apart(values: np.ndarray) -> np.ndarray:
    """Return a copy of values in pages of their own, which go back to the system when it is no longer used.

    Among what comes and goes while frames are read, long-lived arrays would leave gaps that nothing else fits into: of
    360 pictures of 12 megapixels these took as much memory again as the pictures.
    """
    if not values.nbytes:
        return values.copy()
    copy = np.frombuffer(mmap.mmap(-1, values.nbytes), values.dtype).reshape(values.shape)
    copy[...] = values
    return copy


def held(picture: Tensor | Compact) -> Tensor | Compact:
    """Return a picture or mask [H, W, ...] as it is to be kept: a large one in little memory."""
    if isinstance(picture, Compact) or picture.requires_grad or picture.ndim < 2:
        return picture
    if picture.shape[0] * picture.shape[1] < FEWEST_PX:
        return picture
    known = getattr(picture, "of_compact", None)
    if known is not None and known[1] == picture._version:
        return known[0]
    return Compact.of(picture)


def changed(picture: Tensor | Compact, at: Tensor, values: Tensor) -> Tensor | Compact:
    """Return what is held with other values [N, ...] at the pixels `at` [H, W] bool; what is compact is shared."""
    if isinstance(picture, Compact) and picture.changed is None:
        rows, columns, new = *(places.numpy() for places in torch.nonzero(at, as_tuple=True)), values.numpy()
        bottom, right = picture.top + len(picture.inside), picture.left + picture.width
        inside = (rows >= picture.top) & (rows < bottom) & (columns >= picture.left) & (columns < right)
        if (new[~inside] == picture.around).all():
            return dataclasses.replace(picture, changed=(rows[inside], columns[inside], new[inside]))
    other = whole(picture).clone()
    other[at] = values
    return held(other)


def whole(picture: Tensor | Compact) -> Tensor:
    """Return what is held as a tensor [H, W, ...]."""
    return picture.tensor() if isinstance(picture, Compact) else picture


def part(picture: Tensor | Compact, rows: slice, columns: slice) -> Tensor:
    """Return some rows and columns of what is held."""
    return picture.part(rows, columns) if isinstance(picture, Compact) else picture[rows, columns]


class HeldCompact:
    """An attribute that holds a picture or mask as `held` does, and reads as a tensor."""

    def __init__(self, name: str):
        self._name = f"_{name}"

    def __get__(self, instance, owner=None):
        return self if instance is None else whole(instance.__dict__[self._name])

    def __set__(self, instance, value) -> None:
        if not isinstance(value, Compact):
            expect(value, Tensor, self._name[1:], "a torch.Tensor")
        instance.__dict__[self._name] = held(value)


def hold_compact(owner: type, names: Sequence[str]) -> None:
    """Let a dataclass hold pictures in little memory; `NAME` then reads as a tensor, `_NAME` is what is held."""
    for name in names:
        setattr(owner, name, HeldCompact(name))
