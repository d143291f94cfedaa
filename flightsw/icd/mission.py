"""The mission file: one YAML read by every part, checked key by key."""

import hashlib
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from flightsw.icd.config import MAX_YAML_BYTES, ConfigError, build, in_file, parse_yaml, require
from flightsw.icd.pose_sections import (
    NavigationErrorsSection,
    NavigationSection,
    PoseSection,
    TargetAttitudeSection,
)
from flightsw.icd.tle import check_tle
from obbgs_base.errors import reason
from obbgs_base.files import read_bounded

Checksum = Literal["crc-32", "crc-32c", "modular"]  # of CFDP


@dataclass(frozen=True)
class OrbitSection:
    target_tle: tuple[str, ...]
    chaser_tle: tuple[str, ...]
    start_utc: str
    max_element_age_days: float = 7.0

    def __post_init__(self):
        check_tle(self.target_tle, "mission.orbit.target_tle")
        check_tle(self.chaser_tle, "mission.orbit.chaser_tle")
        require(self.max_element_age_days > 0, "mission.orbit.max_element_age_days", "must be positive")
        _ = self.start_utc_ns

    @property
    def start_utc_ns(self) -> int:
        """First trigger, integer Unix nanoseconds."""
        path = "mission.orbit.start_utc"
        try:
            moment = datetime.fromisoformat(self.start_utc)
        except ValueError as error:
            raise ConfigError(
                path, f"expected a time such as 2026-07-21T10:52:30Z, got {self.start_utc!r}"
            ) from error
        require(moment.tzinfo is not None, path, "say the time zone: end the time with Z")
        require(
            2000 <= moment.year <= 2052,
            path,
            f"expected 2000 to 2052, the years of the Sun's ephemeris, got {moment.year}",
        )
        whole = moment.astimezone(UTC).replace(microsecond=0)
        return int(whole.timestamp()) * 1_000_000_000 + moment.microsecond * 1000


@dataclass(frozen=True)
class CameraSection:
    """A pinhole camera (OpenCV axes, pixel centres at .5) and its sensor.

    dn = clip(black_dn + dn_per_radiance_s * exposure_time_s * radiance + noise, 0, white_dn).
    psf_sigma_px: standard deviation of the optics' point spread, without the pixel's own width; None: not calibrated,
        the ground estimates it. The default is that of the simulator's renderer.
    """

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    channels: int = 1
    bit_depth: int = 12
    black_dn: float = 64.0
    dn_per_radiance_s: float = 4.0e7
    electrons_per_dn: float = 4.0
    read_noise_dn: float = 8.0
    psf_sigma_px: float | None = 0.26

    def __post_init__(self):
        path = "mission.camera"
        for name in ("width", "height"):
            require(
                1 <= getattr(self, name) <= 8192,
                f"{path}.{name}",
                f"expected 1 to 8192, got {getattr(self, name)}",
            )
        for name in ("fx_px", "fy_px", "dn_per_radiance_s", "electrons_per_dn"):
            require(getattr(self, name) > 0, f"{path}.{name}", f"must be positive, got {getattr(self, name)}")
        for name in ("cx_px", "cy_px"):  # outside the picture where it was cut from a larger one
            require(
                -8192 <= getattr(self, name) <= 8192,
                f"{path}.{name}",
                f"expected where the line of sight meets the picture, -8192 to 8192, got {getattr(self, name):g}",
            )
        require(
            self.read_noise_dn >= 0,
            f"{path}.read_noise_dn",
            f"must not be negative, got {self.read_noise_dn}",
        )
        require(
            self.psf_sigma_px is None or 0 <= self.psf_sigma_px <= 10,
            f"{path}.psf_sigma_px",
            f"expected 0 to 10, or null where it is not known, got {self.psf_sigma_px}",
        )
        require(self.channels in (1, 3), f"{path}.channels", f"expected 1 or 3, got {self.channels}")
        require(8 <= self.bit_depth <= 16, f"{path}.bit_depth", f"expected 8 to 16, got {self.bit_depth}")
        require(
            0 <= self.black_dn < self.white_dn / 2,
            f"{path}.black_dn",
            f"expected 0 to half of full scale, got {self.black_dn}",
        )

    @property
    def white_dn(self) -> int:
        """The largest digital number, where a pixel is saturated."""
        return (1 << self.bit_depth) - 1

    @property
    def max_container_bytes(self) -> int:
        """What no container of a frame exceeds: JPEG-LS makes pure noise a few per cent longer than its pixels."""
        pixel_bytes = 2 * self.width * self.height * self.channels
        return pixel_bytes + pixel_bytes // 8 + 4096  # header and markers

    @property
    def K(self) -> list[list[float]]:
        """The 3x3 pinhole matrix, px."""
        return [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]


@dataclass(frozen=True)
class BracketSection:
    exposure_times_ms: tuple[float, ...] = (0.05, 0.1, 0.2)
    auto: bool = False  # choose as many times as there are above, by the target's brightness
    exposure_min_ms: float = 0.01  # limits of the automatic choice
    exposure_max_ms: float = 20.0
    target_extent_m: float = 6.0  # largest dimension of the target, as far as known; for planning only
    # from one exposure of a bracket to the next; None: they are spread evenly until the next bracket
    frame_spacing_s: float | None = None
    interval_s: float = 27.0
    count: int = 40

    def __post_init__(self):
        path = "mission.bracket"
        require(
            1 <= len(self.exposure_times_ms) <= 16,
            f"{path}.exposure_times_ms",
            f"expected 1 to 16 exposures, got {len(self.exposure_times_ms)}",
        )
        spacing_s = self.spacing_s()
        for index, time_ms in enumerate(self.exposure_times_ms):
            require(
                1e-3 <= time_ms <= 60_000,
                f"{path}.exposure_times_ms[{index}]",
                f"expected 0.001 to 60000 ms, got {time_ms}",
            )
            require(
                self.frame_spacing_s is None or time_ms / 1e3 <= spacing_s,
                f"{path}.frame_spacing_s",
                f"{spacing_s} s is shorter than an exposure of {time_ms} ms",
            )
        require(
            1e-3 <= self.exposure_min_ms < self.exposure_max_ms <= 60_000,
            f"{path}.exposure_max_ms",
            "expected 0.001 <= exposure_min_ms < exposure_max_ms <= 60000, got "
            f"{self.exposure_min_ms} and {self.exposure_max_ms} ms",
        )
        require(
            not self.auto or self.exposure_max_ms / 1e3 <= spacing_s,
            f"{path}.exposure_max_ms",
            f"{self.exposure_max_ms} ms is longer than from one exposure to the next, {spacing_s:g} s",
        )
        require(
            self.target_extent_m > 0,
            f"{path}.target_extent_m",
            f"must be positive, got {self.target_extent_m}",
        )
        if self.frame_spacing_s is None:  # as long as the longest exposure, at least
            spacing_s = max(self.exposure_times_s)
        shortest_ns = round(spacing_s * len(self.exposure_times_ms) * 1e9)  # as exactly as times are kept
        require(
            round(self.interval_s * 1e9) >= shortest_ns,
            f"{path}.interval_s",
            f"{self.interval_s} s is shorter than the bracket itself ({shortest_ns / 1e9} s)",
        )
        require(self.interval_s <= 86_400, f"{path}.interval_s", f"{self.interval_s} s is more than a day")
        require(1 <= self.count <= 100_000, f"{path}.count", f"expected 1 to 100000, got {self.count}")

    @property
    def exposure_times_s(self) -> tuple[float, ...]:
        return tuple(time_ms / 1e3 for time_ms in self.exposure_times_ms)

    def spacing_s(self, exposures: int | None = None) -> float:
        """Return the time from one exposure to the next, s, of a bracket of so many; None: as many as the mission's."""
        if self.frame_spacing_s is not None:
            return self.frame_spacing_s
        return self.interval_s / (exposures or len(self.exposure_times_ms))


@dataclass(frozen=True)
class StoreSection:
    """How much the frame store may take, and what happens when it is full.

    Frames that the ground has confirmed are always deleted first, oldest first. When that is not enough, `refuse` keeps
    what is waiting and refuses new frames; `drop-oldest` deletes the oldest waiting frame for the new one.
    """

    quota_mb: float = 0.0  # of frame containers, 10^6 bytes; 0: as much as the disk holds
    when_full: Literal["refuse", "drop-oldest"] = "refuse"

    def __post_init__(self):
        require(self.quota_mb >= 0, "mission.store.quota_mb", f"must not be negative, got {self.quota_mb}")

    @property
    def quota_bytes(self) -> int | None:
        return round(self.quota_mb * 1e6) or None


@dataclass(frozen=True)
class LinkSection:
    baud_rate: int = 921_600
    max_packet_bytes: int = 1100
    roi_sigma: float = 4.0
    roi_margin_px: int = 9
    # of the outbox, until commanded
    priority: Literal["oldest", "triage", "thumbnail-first"] = "thumbnail-first"
    housekeeping_s: float = 1.0  # from one housekeeping packet to the next
    checksum: Checksum = "crc-32"  # of each transferred file
    files_in_flight: int = 8  # at most, to the ground

    def __post_init__(self):
        path = "mission.link"
        require(
            0.1 <= self.housekeeping_s <= 3600,
            f"{path}.housekeeping_s",
            f"expected 0.1 to 3600 s, got {self.housekeeping_s}",
        )
        require(
            1200 <= self.baud_rate <= 12_000_000,
            f"{path}.baud_rate",
            f"expected 1200 to 12000000, got {self.baud_rate}",
        )
        require(
            512 <= self.max_packet_bytes <= 4096,  # the longest telemetry packets have some 400 bytes
            f"{path}.max_packet_bytes",
            f"expected 512 to 4096, got {self.max_packet_bytes}",
        )
        require(
            1 <= self.files_in_flight <= 32,  # as many as the ground keeps open
            f"{path}.files_in_flight",
            f"expected 1 to 32, got {self.files_in_flight}",
        )
        require(self.roi_sigma > 0, f"{path}.roi_sigma", f"must be positive, got {self.roi_sigma}")
        require(
            0 <= self.roi_margin_px <= 8192,
            f"{path}.roi_margin_px",
            f"expected 0 to 8192, got {self.roi_margin_px}",
        )


# the ground's training methods, and what can be added to their names
METHODS = ("obbgs", "jiang2025", "3dgs", "3dgs-mcmc", "pixel-gs", "mip-splatting", "mvgs")
VARIANTS = ("exposure", "blind", "affine", "hull", "random", "mask", "l1", "fast")


@dataclass(frozen=True)
class ReconstructSection:
    """How the ground trains; `settings` change the method's own, and the ground knows their names."""

    method: str = "obbgs"  # one of METHODS, each of VARIANTS that it wants after it: 3dgs+exposure+hull
    seed: int = 7
    steps: int = 0  # of training; 0: the method's own number
    settings: dict[str, Any] = field(default_factory=dict, hash=False)  # such as light: {sun_shading: linear}

    def __post_init__(self):
        method, *variants = self.method.split("+")
        require(
            method in METHODS and set(variants) <= set(VARIANTS),
            "mission.reconstruct.method",
            f"expected one of {', '.join(METHODS)}, with variants such as 3dgs+exposure ({', '.join(VARIANTS)}), got "
            f"{self.method!r}",
        )
        require(
            0 <= self.seed < 1 << 32, "mission.reconstruct.seed", f"expected 0 to 2^32 - 1, got {self.seed}"
        )
        require(self.steps >= 0, "mission.reconstruct.steps", f"must not be negative, got {self.steps}")


@dataclass(frozen=True)
class Mission:
    orbit: OrbitSection
    camera: CameraSection
    target_attitude: TargetAttitudeSection = field(default_factory=TargetAttitudeSection)
    bracket: BracketSection = field(default_factory=BracketSection)
    pose: PoseSection = field(default_factory=PoseSection)
    navigation: NavigationSection = field(default_factory=NavigationSection)
    navigation_errors: NavigationErrorsSection = field(default_factory=NavigationErrorsSection)
    store: StoreSection = field(default_factory=StoreSection)
    link: LinkSection = field(default_factory=LinkSection)
    reconstruct: ReconstructSection = field(default_factory=ReconstructSection)
    sha256: str = ""  # of the file's bytes, so a result can be traced to its mission

    def __post_init__(self):
        frame_mb = 2e-6 * self.camera.width * self.camera.height * self.camera.channels
        require(
            self.store.quota_mb == 0 or self.store.quota_mb >= frame_mb,
            "mission.store.quota_mb",
            f"expected room for a frame of this camera, {frame_mb:g} MB uncompressed, or 0 for as much as the disk "
            f"holds, got {self.store.quota_mb:g}",
        )


def load_mission(path: str | Path) -> Mission:
    """Return the mission in a YAML file.

    Raises:
        ConfigError: the file cannot be read or is not YAML, a key is unknown, missing or of the wrong type, a TLE's
            checksum is wrong. The message names the file and the key's path.
    """
    try:
        content = read_bounded(Path(path), MAX_YAML_BYTES)
    except OSError as error:
        advice = "; name one with --mission, `flightsw mission new` makes one" * isinstance(
            error, FileNotFoundError
        )
        raise ConfigError(str(path), f"cannot read the mission file: {reason(error)}{advice}") from error
    with in_file(path):
        tree = parse_yaml(content, "mission")
        return build(Mission, tree, "mission", sha256=hashlib.sha256(content).hexdigest())
