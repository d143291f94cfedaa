"""Exposure times from range, phase angle and the last bracket's histogram.

Radiance is in the mission's unit, in which a white Lambert plate that faces the Sun has 1. The shortest frame of a
bracket must leave 99.9 % of the target's pixels unsaturated, the longest must lift its shadows above the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flightsw.capture.region import ROUNDING_DN, target_pixels
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import BracketSection, CameraSection

SATURATED_SHARE = 1e-3  # of the target's pixels that the shortest frame may lose
SHADOW_SHARE = 0.1  # the shadows are the darkest tenth of the target's pixels
SHADOW_SNR = 3.0  # of one pixel in the longest frame
HEADROOM = 0.7  # of full scale for the highlights: the target turns from one bracket to the next
SATURATION_SIGMAS = 4.0  # of noise below full scale, at least
UNKNOWN_STEP = 4.0  # how far to look when a frame shows only a limit: all saturated, or nothing at all
SHADOW_ALBEDO = 0.01  # of the darkest tenth before anything is known: what earth-shine and dark panels return


@dataclass(frozen=True)
class Geometry:
    """What the light on the target depends on."""

    range_m: float
    phase_rad: float  # between the Sun and the camera, seen from the target

    @classmethod
    def of(cls, tag: PoseTag) -> "Geometry | None":
        """Return the geometry of a pose tag, None without a pose or in eclipse."""
        range_m, sun = float(np.linalg.norm(tag.position_body_m)), float(np.linalg.norm(tag.sun_dir_body))
        if tag.in_eclipse or tag.source == "none" or range_m == 0 or sun == 0:
            return None
        cosine = float(tag.position_body_m @ tag.sun_dir_body) / (range_m * sun)
        return cls(range_m, float(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True)
class TargetLight:
    """The radiance that all but 0.1 % of the target's pixels stay below, and that a tenth stays below."""

    highlight: float
    shadow: float

    def __post_init__(self):
        if not 0 < self.shadow <= self.highlight < float("inf"):
            raise ValueError(f"expected 0 < shadow <= highlight, got {self.shadow} and {self.highlight}")

    def scaled(self, factor: float) -> "TargetLight":
        return TargetLight(self.highlight * factor, self.shadow * factor)


def expected_light(geometry: Geometry, camera: CameraSection, target_extent_m: float) -> TargetLight:
    """Return the light to expect of a target not seen before.

    A convex white Lambert body shows, at a phase angle a, a face turned to the Sun when a <= 90 degrees, else nothing
    brighter than sin(a). A target smaller than a pixel fills only a part of it.
    """
    phase_rad = geometry.phase_rad
    brightest = 1.0 if phase_rad <= np.pi / 2 else max(float(np.sin(phase_rad)), 0.01)
    extent_px = target_extent_m * min(camera.fx_px, camera.fy_px) / geometry.range_m
    return TargetLight(1.0, SHADOW_ALBEDO).scaled(brightest * min(1.0, extent_px**2))


def measured_light(
    frames: Sequence[tuple[np.ndarray, float]], camera: CameraSection, previous: TargetLight
) -> TargetLight:
    """Return the target's light as the frames of one bracket show it.

    Where they show only a limit, because even the shortest is saturated or the longest shows nothing, the answer goes
    four times beyond the limit.

    Args:
        frames: dn [H, W] or [H, W, 3], and the exposure time, s.
        previous: what was believed before.
    """
    ordered = sorted(frames, key=lambda frame: frame[1])
    longest_dn, longest_s = ordered[-1]
    target = target_pixels(longest_dn, camera)
    count = int(target.sum())
    if count == 0:
        return previous.scaled(1 / UNKNOWN_STEP)
    highlight = 0.0
    for dn, exposure_s in reversed(ordered):
        # by rank, not by place: the target moves between the frames of a bracket
        brightest = np.sort(dn.reshape(*dn.shape[:2], -1).max(axis=2)[target_pixels(dn, camera)])
        lost = int(count * SATURATED_SHARE)
        level_dn = float(brightest[-1 - lost]) if len(brightest) > lost else camera.black_dn + 1
        highlight = max(level_dn - camera.black_dn, 1.0) / (camera.dn_per_radiance_s * exposure_s)
        if level_dn < camera.white_dn:
            break
    else:
        highlight *= UNKNOWN_STEP
    mean_dn = longest_dn.reshape(*longest_dn.shape[:2], -1).astype(np.float64).mean(axis=2)
    shadow_dn = float(np.quantile(mean_dn[target], SHADOW_SHARE)) - camera.black_dn
    shadow = max(shadow_dn, 1.0) / (camera.dn_per_radiance_s * longest_s)
    return TargetLight(highlight, min(shadow, highlight))


def bracket_times_s(light: TargetLight, camera: CameraSection, bracket: BracketSection) -> tuple[float, ...]:
    """Return as many exposure times as the mission's bracket has, shortest first, evenly spaced in stops.

    The shortest keeps the highlights below full scale, noise included; the longest gives the shadows a signal of three
    times their noise. Both stay within exposure_min_ms and exposure_max_ms. A bracket of one frame is the shortest.
    """
    short_s = highlight_signal_dn(camera) / (camera.dn_per_radiance_s * light.highlight)
    long_s = max(shadow_signal_dn(camera) / (camera.dn_per_radiance_s * light.shadow), 2 * short_s)
    low_s, high_s = bracket.exposure_min_ms / 1e3, bracket.exposure_max_ms / 1e3
    count = len(bracket.exposure_times_ms)
    times_s = np.geomspace(short_s, long_s, count) if count > 1 else np.array([short_s])
    return tuple(float(t) for t in np.clip(times_s, low_s, high_s))


def highlight_signal_dn(camera: CameraSection) -> float:
    """Return the signal above black that highlights may have: some headroom, full scale out of the noise's reach."""
    full_dn = camera.white_dn - camera.black_dn
    # S + k sqrt(r^2 + S/e) = full, solved for S
    k2, read2 = SATURATION_SIGMAS**2, camera.read_noise_dn**2 + ROUNDING_DN**2
    b = full_dn + k2 / (2 * camera.electrons_per_dn)
    below_noise = b - np.sqrt(max(b**2 - full_dn**2 + k2 * read2, 0.0))
    return float(max(min(HEADROOM * full_dn, below_noise), 1.0))


def shadow_signal_dn(camera: CameraSection) -> float:
    """Return the signal above black that has `SHADOW_SNR` times its own noise (shot, read, rounding)."""
    # S = k sqrt(r^2 + S/e), solved for S
    k2, read2 = SHADOW_SNR**2, camera.read_noise_dn**2 + ROUNDING_DN**2
    half = k2 / (2 * camera.electrons_per_dn)
    return float(half + np.sqrt(half**2 + k2 * read2))


class AutoBracket:
    """Keeps what the last bracket showed, and carries it to the geometry of the next."""

    def __init__(self, camera: CameraSection, bracket: BracketSection):
        self._camera, self._bracket = camera, bracket
        self._light: TargetLight | None = None
        self._expected_then: TargetLight | None = None

    def times_s(self, geometry: Geometry | None) -> tuple[float, ...]:
        """Return the next bracket's exposure times; the mission's own when no light or no pose is to be expected."""
        if geometry is None:
            return tuple(sorted(self._bracket.exposure_times_s))
        return bracket_times_s(self._light_at(geometry), self._camera, self._bracket)

    def observe(self, frames: Sequence[tuple[np.ndarray, float]], geometry: Geometry | None) -> None:
        """Update the target's light from a bracket that was taken."""
        if geometry is None or not frames:
            return
        light = measured_light(frames, self._camera, self._light_at(geometry))
        expected = expected_light(geometry, self._camera, self._bracket.target_extent_m)
        # no further than the exposure limits can follow: a lost target must be found again
        lowest = highlight_signal_dn(self._camera) / (
            self._camera.dn_per_radiance_s * self._bracket.exposure_max_ms / 1e3
        )
        self._light = light.scaled(max(1.0, lowest / light.highlight))
        self._expected_then = expected

    def _light_at(self, geometry: Geometry) -> TargetLight:
        expected = expected_light(geometry, self._camera, self._bracket.target_extent_m)
        if self._light is None or self._expected_then is None:
            return expected
        return self._light.scaled(expected.highlight / self._expected_then.highlight)
