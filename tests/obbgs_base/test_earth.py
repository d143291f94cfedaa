"""The picture of the Earth against closed forms, geometry and measured albedos."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from obbgs_base.physics.earth import (
    RADIUS_M,
    camera_rays,
    clouded_albedo,
    earth_radiance,
    sees_earth,
    stray_light,
)

SUN_IRRADIANCE = math.pi


def pointing(towards: np.ndarray, K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the rays of a camera whose axis points in a direction, in the direction's own axes."""
    turn, _ = Rotation.align_vectors([towards], [[0, 0, 1]])
    return turn.apply(camera_rays(K, width, height).reshape(-1, 3)).reshape(height, width, 3)


def of_albedo(value: float):
    return lambda normals, finest_rad: np.full(len(normals), value)


@pytest.mark.parametrize("phase_deg", [0, 40, 90, 140])
def test_a_lambert_sphere_has_the_phase_function_of_the_closed_form(phase_deg):
    """From far away: E = (2/3) A (R/d)² Phi(alpha) E_sun, Phi = (sin alpha + (pi - alpha) cos alpha) / pi."""
    distance_m, albedo, phase = 1e3 * RADIUS_M, 0.4, math.radians(phase_deg)
    K = np.array([[1e5, 0, 120.0], [0, 1e5, 120.0], [0, 0, 1]])  # the disc is 200 pixels wide
    position_m = np.array([0.0, 0.0, distance_m])
    sun = np.array([math.sin(phase), 0.0, math.cos(phase)])
    rays = pointing(-position_m / distance_m, K, 240, 240)
    light = earth_radiance(rays, position_m, sun, 1e-5, albedo=of_albedo(albedo), optical_depth=(0.0,))
    irradiance = light.sum() / (K[0, 0] * K[1, 1])
    law = (math.sin(phase) + (math.pi - phase) * math.cos(phase)) / math.pi
    assert irradiance == pytest.approx(
        2 / 3 * albedo * (RADIUS_M / distance_m) ** 2 * law * SUN_IRRADIANCE, rel=0.01
    )


def test_the_limb_is_where_geometry_has_it():
    """The dip of the horizon below the horizontal is acos(R / r), to the pixel."""
    height_m, focal_px = 500e3, 2000.0
    K = np.array([[focal_px, 0, 0.5], [0, focal_px, 200.0], [0, 0, 1]])
    dip = math.acos(RADIUS_M / (RADIUS_M + height_m))
    axis = np.array([math.cos(dip), 0.0, -math.sin(dip)])  # at the limb; the zenith is +z
    down = np.array([-math.sin(dip), 0.0, -math.cos(dip)])
    turn = np.stack([np.cross(down, axis), down, axis], axis=1)
    rays = camera_rays(K, 1, 400) @ turn.T
    position_m = np.array([0.0, 0.0, RADIUS_M + height_m])
    light = earth_radiance(
        rays, position_m, np.array([0, 0, 1.0]), 1e-3, albedo=of_albedo(1.0), optical_depth=(0.0,)
    )[:, 0, 0]
    assert (light[:200] == 0).all() and (light[201:] > 0).all()
    seen = sees_earth(rays, position_m)[:, 0]
    reach_px = focal_px * (dip - math.acos((RADIUS_M + 80e3) / (RADIUS_M + height_m)))
    assert 200 - np.argmax(seen) == pytest.approx(reach_px, abs=2)  # the air reaches so far above the limb


def test_the_glow_at_the_limb_falls_by_e_in_a_few_scale_heights():
    K = np.array([[20_000.0, 0, 0.5], [0, 20_000.0, 400.0], [0, 0, 1]])
    position_m = np.array([0.0, 0.0, RADIUS_M + 500e3])
    dip = math.acos(RADIUS_M / (RADIUS_M + 500e3))
    axis, down = np.array([math.cos(dip), 0, -math.sin(dip)]), np.array([-math.sin(dip), 0, -math.cos(dip)])
    rays = camera_rays(K, 1, 400) @ np.stack([np.cross(down, axis), down, axis], axis=1).T
    light = earth_radiance(rays, position_m, np.array([0.6, 0, 0.8]), 1e-4)[:, 0, 1]
    miss_m = np.linalg.norm(np.cross(rays[:, 0], position_m), axis=1)  # of each ray from the Earth's centre
    height_km = (miss_m - RADIUS_M) / 1e3
    assert (np.diff(light[height_km > 1]) >= 0).all()  # brighter towards the ground
    high = (height_km > 40) & (height_km < 60)
    slope = np.polyfit(height_km[high], np.log(light[high]), 1)[0]
    assert -1 / slope == pytest.approx(8, rel=0.05)


def test_the_earth_reflects_what_is_measured():
    """A Bond albedo of 0.30 (Stephens et al. 2015), as the mean over many places."""
    rng = np.random.default_rng(3)
    places = rng.standard_normal((4000, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    albedo = clouded_albedo(places, 1e-4)
    assert albedo.min() >= 0.06 and albedo.max() <= 0.8
    assert 0.25 < albedo.mean() < 0.35
    assert 0.2 < (albedo > 0.4).mean() < 0.67  # opaque clouds; with thin ones 0.67 (MODIS)


def test_a_brighter_earth_is_where_the_sun_is_and_night_is_black():
    K = np.array([[200.0, 0, 50], [0, 200.0, 50], [0, 0, 1]])
    position_m = np.array([0.0, 0.0, RADIUS_M + 500e3])
    rays = pointing(np.array([0.0, 0.0, -1.0]), K, 100, 100)
    day, low, night = (
        earth_radiance(rays, position_m, np.array([math.sin(a), 0, math.cos(a)]), 1 / 200)
        for a in np.radians([10, 80, 130])
    )
    assert day.mean() > 3 * low.mean() and night.max() == 0
    assert day.max() < 0.9  # of a white plate that faces the Sun


def test_the_ground_keeps_its_place_at_every_resolution():
    """Seen twice as finely, the picture is the same where it is averaged."""
    rng = np.random.default_rng(0)
    place = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    near = place + 0.05 * rng.standard_normal((500, 3))
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    fine, coarse = clouded_albedo(near, 1e-4), clouded_albedo(near, 1e-3)
    assert np.corrcoef(fine, coarse)[0, 1] > 0.9


def test_stray_light_falls_with_the_suns_angle():
    rays = np.array([[[math.sin(a), 0, math.cos(a)] for a in np.radians([-20, 0, 20])]])
    sun = np.array([math.sin(math.radians(60)), 0, math.cos(math.radians(60))])
    light = stray_light(rays, sun)[0]
    np.testing.assert_allclose(light / light[1], [(60 / 80) ** 2, 1, (60 / 40) ** 2])


def test_air_above_the_limb_is_seen_where_no_ray_meets_the_ground():
    position = np.array([0.0, 0.0, RADIUS_M + 500e3])
    dip = math.acos((RADIUS_M + 10e3) / (RADIUS_M + 500e3))  # a ray that passes 10 km above the ground
    rays = np.array([[[math.cos(dip), 0.0, -math.sin(dip)]]])
    light = earth_radiance(rays, position, np.array([1.0, 0.0, 0.0]), 1e-4)
    assert (light > 0).all()
