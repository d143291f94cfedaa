"""A few of many, for pages and views that have no room for all."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def evenly_spread(values: Sequence[T], count: int) -> list[T]:
    """Return at most `count` of one or more values, evenly spread by their places, first and last included."""
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))]
