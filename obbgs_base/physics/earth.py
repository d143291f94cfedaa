"""What a camera in orbit sees beside its target: the Earth with clouds and limb, and the Sun's stray light.

Radiance is that of the renderer: a white Lambert plate that faces the Sun has 1, so that the Sun's irradiance is pi.
Everything is in proportion to the target by published albedos and geometry. The picture of land, ocean and clouds is
not a map: it is fractal noise with a fixed seed, at rest on the Earth, so that it moves as the ground does.
"""

import math
from collections.abc import Callable

import numpy as np

RADIUS_M = 6_371_000.0  # mean radius (IUGG)
# Scale height of the air, and its vertical optical depth at 650, 550 and 450 nm at sea level (Bucholtz, 1995)
SCALE_HEIGHT_M = 8_000.0
OPTICAL_DEPTH = (0.048, 0.097, 0.22)
TOP_M = 10 * SCALE_HEIGHT_M  # above it a ray meets no air that shows
# Albedos at visible wavelengths (Wallace and Hobbs, Atmospheric Science, 2006, table 4.1 and chapter 4)
OCEAN, DARK_LAND, BRIGHT_LAND, THIN_CLOUD, THICK_CLOUD = 0.06, 0.10, 0.30, 0.5, 0.8
LAND_SHARE = 0.29
# Of the surface under cloud; thin and small ones count less. With it the Earth's Bond albedo is near the measured 0.30
# (Stephens et al., The albedo of Earth, 2015).
CLOUD_SHARE = 0.45
CLOUD_EDGE = 0.25  # of a cloud's border, in deviations of the noise
COARSEST = 2.0  # cells of the coarsest octave in a radius of the Earth
OCTAVES = 18  # each half as large as the one before: from 3,000 km to 25 m
ROUGHNESS = 2 ** (
    -1 / 3
)  # of an octave over the one before: variance as wavenumber^(-5/3), as satellites see clouds
# Radiance of stray light where the Sun is 30 degrees off the axis; it falls with the angle squared, as in a lens with a
# plain hood, and from one side of the picture to the other by what the angles differ.
STRAY_AT_30_DEG = 0.01
NEAREST_SUN_RAD = math.radians(10)

Albedo = Callable[[np.ndarray, float], np.ndarray]  # of unit normals [N, 3] at a resolution in radians: [N]


def earth_radiance(
    rays: np.ndarray,
    position_m: np.ndarray,
    sun: np.ndarray,
    pixel_rad: float,
    to_ground: np.ndarray | None = None,
    albedo: Albedo | None = None,
    optical_depth: tuple[float, ...] = OPTICAL_DEPTH,
) -> np.ndarray:
    """Return the radiance [H, W, C] of the Earth and its air along rays; 0 where they meet neither.

    The ground reflects by Lambert's law. The air scatters once, by Rayleigh's phase function, and is thin, but that
    light along the limb saturates.

    Args:
        rays: [H, W, 3] unit vectors, in any axes that do not turn.
        position_m: [3] of the camera from the Earth's centre, above the ground.
        sun: [3] unit vector towards it.
        pixel_rad: angle of a pixel; clouds that are smaller are not drawn.
        to_ground: [3, 3] rotation from the rays' axes to those of the Earth; None: they are the same.
        albedo: of the ground and clouds; None: `clouded_albedo`.
        optical_depth: of the air, vertically, one for each channel.
    """
    depth = np.asarray(optical_depth, dtype=float)
    flat = rays.reshape(-1, 3)
    along = flat @ position_m  # negative: towards the Earth
    miss_m2 = position_m @ position_m - along**2  # squared distance of each line from the centre
    hits = (along < 0) & (miss_m2 < RADIUS_M**2)
    light = np.zeros((len(flat), len(depth)))
    near = (along < 0) & (miss_m2 < (RADIUS_M + TOP_M) ** 2)
    cos_scattering = flat @ sun
    phase = 0.75 * (1 + cos_scattering**2)
    # the ground, seen through the air
    distance_m = -along[hits] - np.sqrt(RADIUS_M**2 - miss_m2[hits])
    normals = (position_m + distance_m[:, None] * flat[hits]) / RADIUS_M
    facing_sun, facing_camera = normals @ sun, -np.einsum("ij,ij->i", normals, flat[hits])
    axes = np.eye(3) if to_ground is None else to_ground
    chosen = albedo or clouded_albedo
    finest_rad = pixel_rad * float(np.median(distance_m)) / RADIUS_M if hits.any() else pixel_rad
    reflected = chosen(normals @ axes.T, finest_rad).reshape(len(normals), 1)
    most = math.sqrt(math.pi * RADIUS_M / (2 * SCALE_HEIGHT_M))  # air masses towards the horizon (Chapman)
    masses = 1 / np.maximum(facing_camera, 1 / most)
    down = 1 / np.maximum(facing_sun, 1 / most)
    through = np.exp(-depth * (masses + down)[:, None] / 2)  # half of what is scattered goes on
    light[hits] = reflected * np.maximum(facing_sun, 0)[:, None] * through
    # the air: in front of the ground, and around it
    slant = np.zeros(len(flat))
    slant[hits] = masses
    beside = near & ~hits
    height_m = np.sqrt(miss_m2[beside]) - RADIUS_M
    slant[beside] = 2 * most * np.exp(-height_m / SCALE_HEIGHT_M)
    day = np.zeros(len(flat))
    day[hits] = _daylight(facing_sun)
    tangent = position_m - along[beside, None] * flat[beside]
    day[beside] = _daylight(tangent @ sun / np.linalg.norm(tangent, axis=1))
    light += (phase * day / 4)[:, None] * (1 - np.exp(-depth * slant[:, None]))
    return light.reshape(*rays.shape[:-1], len(depth))


def sees_earth(rays: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """Return which rays [H, W, 3] meet the Earth or its air, as bool [H, W]; the position is as in `earth_radiance`."""
    along = rays @ position_m
    return (along < 0) & (position_m @ position_m - along**2 < (RADIUS_M + TOP_M) ** 2)


def camera_rays(K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the unit vectors [H, W, 3] of pixel centres in the camera's axes (x right, y down, z ahead)."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - K[0][2]) / K[0][0], (v - K[1][2]) / K[1][1], np.ones_like(u)], axis=2)
    return rays / np.linalg.norm(rays, axis=2, keepdims=True)


def stray_light(rays: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Return the radiance [H, W] of the Sun's stray light along rays [H, W, 3]; `sun` is a unit vector [3]."""
    angle = np.arccos(np.clip(rays @ sun, -1, 1))
    return STRAY_AT_30_DEG * (math.radians(30) / np.maximum(angle, NEAREST_SUN_RAD)) ** 2


def clouded_albedo(normals: np.ndarray, finest_rad: float) -> np.ndarray:
    """Return the albedo [N] of ocean, land and the clouds above at unit normals [N, 3] in the Earth's axes.

    Args:
        finest_rad: angle at the Earth's centre below which nothing is drawn.
    """
    finest = max(finest_rad, 1e-9)
    land = fractal(normals, 4 * finest, seed=1)
    is_land = _step(land - _quantile(1 - LAND_SHARE), 0.05)
    dry = _step(fractal(normals + 7.0, 4 * finest, seed=2), 0.5)
    ground = OCEAN + is_land * (DARK_LAND + (BRIGHT_LAND - DARK_LAND) * dry - OCEAN)
    clouds = fractal(normals, finest, seed=3)
    covered = _step(clouds - _quantile(1 - CLOUD_SHARE), CLOUD_EDGE)
    thick = THIN_CLOUD + (THICK_CLOUD - THIN_CLOUD) * _step(clouds - _quantile(1 - CLOUD_SHARE / 2), 0.5)
    return ground + covered * (thick - ground)


def fractal(points: np.ndarray, finest: float, seed: int) -> np.ndarray:
    """Return noise [N] of about unit variance at points [N, 3]: octaves of value noise, down to a wavelength."""
    total, variance, amplitude, cells = np.zeros(len(points)), 0.0, 1.0, COARSEST
    for octave in range(OCTAVES):
        drawn = 1.0 if octave == 0 else np.clip(1 / (cells * finest) - 1, 0.0, 1.0)  # one of two pixels fades
        if drawn:
            total += drawn * amplitude * _value_noise(points * cells, 1000 * seed + octave)
        variance += amplitude**2  # of all octaves, so that the picture is the same at every resolution
        amplitude, cells = amplitude * ROUGHNESS, cells * 2
    return total / math.sqrt(variance)


def _value_noise(points: np.ndarray, seed: int) -> np.ndarray:
    """Return noise [N] of mean 0 and about unit variance, interpolated smoothly between values on a lattice."""
    if not len(points):
        return np.zeros(0)
    corner = np.floor(points)
    share = points - corner
    smooth = share * share * (3 - 2 * share)
    corner = corner.astype(np.int64)
    first = corner.min(axis=0)
    size = corner.max(axis=0) - first + 2
    held = np.prod(size.astype(float)) < 8 * len(points)  # neighbouring points share most of the lattice
    table = _hashed(first + np.stack(np.indices(size), axis=-1).reshape(-1, 3), seed) if held else None
    total = np.zeros(len(points))
    for dx in (0, 1):
        for dy in (0, 1):
            weight_xy = (smooth[:, 0] if dx else 1 - smooth[:, 0]) * (
                smooth[:, 1] if dy else 1 - smooth[:, 1]
            )
            for dz in (0, 1):
                weight = weight_xy * (smooth[:, 2] if dz else 1 - smooth[:, 2])
                at = corner + np.array([dx, dy, dz])
                if table is None:
                    value = _hashed(at, seed)
                else:
                    x, y, z = (at - first).T
                    value = table[(x * size[1] + y) * size[2] + z]
                total += weight * value
    return total / VALUE_NOISE_SIGMA


def _hashed(lattice: np.ndarray, seed: int) -> np.ndarray:
    """Return numbers [N] even in -1..1 that depend on lattice points [N, 3] only (SplitMix64's finaliser)."""
    x, y, z = lattice.astype(np.uint64).T
    mixed = (
        x * np.uint64(0x9E3779B97F4A7C15)
        ^ y * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ z * np.uint64(0x165667B19E3779F9)
    )
    mixed = mixed + np.uint64((seed * 0xD6E8FEB86659FD93) % 2**64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(11)).astype(float) / 2**52 - 1


# Deviation of values even in -1..1 (variance 1/3), times the mean square of the weights of eight corners, (26/35)^3
VALUE_NOISE_SIGMA = math.sqrt((26 / 35) ** 3 / 3)


def _quantile(share: float) -> float:
    """Return the value below which a share of a normal distribution lies, by bisection."""
    low, high = -6.0, 6.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if (1 + math.erf(middle / math.sqrt(2))) / 2 < share else (low, middle)
    return low


def _step(value: np.ndarray, width: float) -> np.ndarray:
    """Return a smooth step from 0 to 1 around 0."""
    share = np.clip(value / (2 * width) + 0.5, 0, 1)
    return share * share * (3 - 2 * share)


def _daylight(cos_sun: np.ndarray) -> np.ndarray:
    """Return how much of the Sun's light reaches the air above a point: 0 to 1 over three degrees at the terminator."""
    return _step(cos_sun + 0.0175, 0.026)
