"""Polynomials through a few neighbours in a table, as OEM and AEM ask for."""

import bisect
from collections.abc import Sequence

import numpy as np


def neighbours(tai_ns: Sequence[int], at_ns: int, count: int) -> slice:
    """Return the `count` entries of an increasing table about a time, as many on either side where there are."""
    after = bisect.bisect_right(tai_ns, at_ns)
    first = after - count // 2
    if count % 2 and after < len(tai_ns) and after > 0:  # an odd number is centred on the nearest
        first -= at_ns - tai_ns[after - 1] < tai_ns[after] - at_ns
    first = min(max(first, 0), len(tai_ns) - count)
    return slice(first, first + count)


def lagrange(times_s: np.ndarray, values: np.ndarray, at_s: float) -> np.ndarray:
    """Return the polynomial through values [n, k] at times [n] at another time [k]."""
    weights, _ = _weights(times_s, at_s)
    return values[0] + weights @ (values - values[0])  # of small numbers: rounding stays small


def hermite(
    times_s: np.ndarray, values: np.ndarray, rates: np.ndarray, at_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the polynomial through values and rates [n, k] at times [n] at another time, and its rate [k] there."""
    weights, slopes = _weights(times_s, at_s)
    gaps = times_s[:, None] - times_s + np.eye(len(times_s))
    own_slopes = (1 / gaps - np.eye(len(times_s))).sum(axis=1)  # of each weight at its own time
    away = at_s - times_s
    of_values = (1 - 2 * away * own_slopes) * weights**2
    of_rates = away * weights**2
    slope_of_values = -2 * own_slopes * weights**2 + (1 - 2 * away * own_slopes) * 2 * weights * slopes
    slope_of_rates = weights**2 + away * 2 * weights * slopes
    offsets = values - values[0]
    return (
        values[0] + of_values @ offsets + of_rates @ rates,
        slope_of_values @ offsets + slope_of_rates @ rates,
    )


def _weights(times_s: np.ndarray, at_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the Lagrange polynomials [n] of some times at another time, and their slopes [n]."""
    count = len(times_s)
    weights, slopes = np.ones(count), np.zeros(count)
    for j in range(count):
        for m in range(count):
            if m != j:
                gap = times_s[j] - times_s[m]
                slopes[j] = (slopes[j] * (at_s - times_s[m]) + weights[j]) / gap
                weights[j] *= (at_s - times_s[m]) / gap
    return weights, slopes
