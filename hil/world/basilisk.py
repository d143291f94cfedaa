"""Orbits and attitude by Basilisk, an astrodynamics engine that is not ours, in place of SGP4 and the free tumble.

Basilisk's conventions stay in this file: `sigma_BN` are the modified Rodrigues parameters of the rotation whose matrix
[BN] takes GCRS (N) to body axes (B), so that as an active rotation they take body vectors to GCRS.

Source: Kenneally, Piggott and Schaub, Basilisk: A Flexible, Scalable and Modular Astrodynamics Simulation Framework,
2020; https://avslab.github.io/basilisk/. Schaub and Junkins, Analytical Mechanics of Space Systems, 2018 (MRPs).
"""

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from flightsw.icd.config import require, require_counts
from flightsw.icd.mission import OrbitSection
from flightsw.icd.reference_frames import teme_to_gcrs
from flightsw.navigation.orbit import OrbitState, propagate, sun_position_gcrs
from hil.world.attitude import AttitudeSection, motion_at_start

# GGM03S (Tapley et al., 2007): the Earth, and its zonal harmonics of degree 0 to 6, normalised
EARTH_MU_M3_S2, EARTH_RADIUS_M = 3.986004415e14, 6378136.3
ZONAL = (
    *(1.0, 0.0, -4.841692638330e-4, 9.572027902208e-7),
    *(5.399964106071e-7, 6.866574057291e-8, -1.499596204836e-7),
)
EARTH_RATE_RAD_S = 7.2921150e-5
LONGEST_STEP_S = 1.0  # of an orbit: below a micrometre an hour by the fourth-order Runge-Kutta method
STEP_RAD = 0.01  # that the target turns in a step at most: some 1e-12 rad of error each
BEFORE_S = 0.1  # what is known before the start, by the first polynomial: clocks err


@dataclass(frozen=True)
class Craft:
    """What a spacecraft's disturbances depend on; it is a sphere to the air and to sunlight.

    area_m2: seen from the direction of flight and from the Sun; 0: neither drag nor solar pressure.
    reflection: 1 of a black sphere; solar pressure is in proportion to it.
    drag_offset_m: where drag acts, from the centre of mass, body axes.
    """

    mass_kg: float = 1000.0
    area_m2: float = 0.0
    drag_coefficient: float = 2.2
    reflection: float = 1.3
    drag_offset_m: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BasiliskSection:
    """The forces and torques of a scenario that Basilisk integrates, in place of SGP4 and `hil.world.attitude`.

    Both spacecraft start in the states that the TLEs give. The target starts in the attitude and with the rate of
    the scenario's attitude, in every mode, and is free from then on; its moments of inertia are kg m² here. The camera
    points at the target as in every scenario.
    """

    gravity_degree: int = 0  # of the Earth's zonal harmonics; 0: a point mass, 2: J2
    density_kg_m3: float = 0.0  # of the air, which turns with the Earth, at the target's height at the start
    scale_height_m: float = 60_000.0
    solar_pressure: bool = False  # outside of the Earth's shadow
    gravity_gradient: bool = False  # torque on the target
    torque_n_m: tuple[float, ...] = (0.0, 0.0, 0.0)  # on the target, constant in body axes: a leak
    target: Craft = field(default_factory=Craft)
    chaser: Craft = field(default_factory=Craft)

    def __post_init__(self):
        path = "scenario.basilisk"
        most = len(ZONAL) - 1
        known = self.gravity_degree == 0 or 2 <= self.gravity_degree <= most
        require(known, f"{path}.gravity_degree", f"expected 0 or 2 to {most}, got {self.gravity_degree}")
        require_counts(self, path, torque_n_m=3)
        numbers = {name: getattr(self, name) for name in ("density_kg_m3", "scale_height_m")}
        for name, craft in (("target", self.target), ("chaser", self.chaser)):
            require_counts(craft, f"{path}.{name}", drag_offset_m=3)
            numbers |= {
                f"{name}.{key}": value for key, value in vars(craft).items() if key != "drag_offset_m"
            }
        for name, value in numbers.items():
            if name.endswith(("mass_kg", "scale_height_m")):
                require(value > 0, f"{path}.{name}", f"must be positive, got {value}")
            require(value >= 0, f"{path}.{name}", f"must not be negative, got {value}")


@dataclass(frozen=True)
class Flown:
    """What Basilisk integrated, as functions of UTC ns; known from a tenth of a second before the start."""

    start: tuple[OrbitState, OrbitState]  # of target and chaser
    end_s: float
    orbits: tuple[CubicHermiteSpline, CubicHermiteSpline]  # s to position [3], m, GCRS
    quat_body_to_gcrs: CubicHermiteSpline  # s to xyzw [4], nearly a unit quaternion

    def orbits_at(self, utc_ns: int) -> tuple[OrbitState, OrbitState]:
        """Return the states of target and chaser.

        Raises:
            ValueError: the time is outside of what was integrated.
        """
        elapsed_s = self._elapsed_s(utc_ns)
        target, chaser = (
            OrbitState(
                position_m=orbit(elapsed_s),
                velocity_m_s=orbit(elapsed_s, 1),
                utc_ns=utc_ns,
                element_age_days=start.element_age_days + elapsed_s / 86_400,
            )
            for start, orbit in zip(self.start, self.orbits, strict=True)
        )
        return target, chaser

    def gcrs_to_body(self, utc_ns: int) -> np.ndarray:
        """Return the target's attitude [3, 3].

        Raises:
            ValueError: as `orbits_at`.
        """
        return Rotation.from_quat(self.quat_body_to_gcrs(self._elapsed_s(utc_ns))).as_matrix().T

    def _elapsed_s(self, utc_ns: int) -> float:
        elapsed_s = (utc_ns - self.start[0].utc_ns) / 1e9
        if not -BEFORE_S <= elapsed_s <= self.end_s:
            raise ValueError(
                f"Basilisk's motion is known from 0 to {self.end_s:g} s after the start, not {elapsed_s:g} s"
            )
        return elapsed_s


@functools.lru_cache(maxsize=4)
def flown(
    section: BasiliskSection, attitude: AttitudeSection, orbit: OrbitSection, horizon_s: float
) -> Flown:
    """Return the motion of target and chaser from the start to `horizon_s` later.

    Raises:
        ModuleNotFoundError: Basilisk is not installed.
        OrbitError: SGP4 cannot propagate the elements to the start.
    """
    start_ns = orbit.start_utc_ns
    start = propagate(orbit.target_tle, start_ns), propagate(orbit.chaser_tle, start_ns)
    gcrs_to_body, rate_rad_s = motion_at_start(attitude, orbit.target_tle, start_ns)
    step_s = min(LONGEST_STEP_S, STEP_RAD / max(float(np.linalg.norm(rate_rad_s)), 1e-9))
    steps = int(np.ceil(horizon_s / step_s))
    with_attitude = (Rotation.from_matrix(gcrs_to_body.T).as_mrp(), rate_rad_s, np.diag(attitude.inertia))
    at_rest = (np.zeros(3), np.zeros(3), np.eye(3))
    simulation = _Simulation(section, start_ns, step_s)
    spacecraft = [
        simulation.spacecraft(name, craft, state, *turning, start[0])
        for name, craft, state, turning in zip(
            ("target", "chaser"),
            (section.target, section.chaser),
            start,
            (with_attitude, at_rest),
            strict=True,
        )
    ]
    target, chaser = simulation.run(spacecraft, steps)
    times_s = target.times() * 1e-9
    quats = Rotation.from_mrp(target.sigma_BN).as_quat()
    # the same rotation has two quaternions: each one is that which is nearer to the one before
    flips = np.sign((quats[1:] * quats[:-1]).sum(axis=1))
    quats[1:] *= np.cumprod(flips)[:, None]
    x, y, z, w = quats.T
    p, q, r = np.array(target.omega_BN_B).T
    # dq/dt = q (0, ω) / 2, as in hil.world.attitude.tumble
    change = np.stack(
        [w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p, -x * p - y * q - z * r], axis=1
    )
    return Flown(
        start,
        float(times_s[-1]),
        (
            CubicHermiteSpline(times_s, target.r_BN_N, target.v_BN_N),
            CubicHermiteSpline(times_s, chaser.r_BN_N, chaser.v_BN_N),
        ),
        CubicHermiteSpline(times_s, quats, change / 2),
    )


class _Simulation:
    """Basilisk's simulation of spacecraft about the Earth."""

    def __init__(self, section: BasiliskSection, start_ns: int, step_s: float):
        from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
        from Basilisk.utilities import SimulationBaseClass  # pyright: ignore[reportMissingImports]

        self._section, self._start_ns = section, start_ns
        self._step_ns = round(step_s * 1e9)
        self._base = SimulationBaseClass.SimBaseClass()
        self._base.CreateNewProcess("process").addTask(self._base.CreateNewTask("task", self._step_ns))
        # the pole of date; zonal harmonics and the wind need no longitude
        earth = messaging.SpicePlanetStateMsgPayload()
        earth.PlanetName, earth.J20002Pfix = "earth", teme_to_gcrs(start_ns).T.tolist()
        sun = messaging.SpicePlanetStateMsgPayload()
        sun.PositionVector = sun_position_gcrs(start_ns).tolist()
        self._earth = messaging.SpicePlanetStateMsg().write(earth)
        self._sun = messaging.SpicePlanetStateMsg().write(sun)
        self._models: list[Any] = [self._earth, self._sun]  # Basilisk does not keep what Python made

    def _add(self, model: Any, priority: int) -> Any:
        self._base.AddModelToTask("task", model, priority)
        self._models.append(model)
        return model

    def spacecraft(
        self,
        name: str,
        craft: Craft,
        state: OrbitState,
        sigma_bn: np.ndarray,
        rate_rad_s: np.ndarray,
        inertia_kg_m2: np.ndarray,
        target: OrbitState,
    ) -> Any:
        """Return Basilisk's spacecraft with what acts on it; torques act on the one whose name is target.

        Args:
            sigma_bn: [3] the attitude at the start.
            rate_rad_s: [3] about the body axes.
            inertia_kg_m2: [3, 3] about the centre of mass, body axes.
            target: at whose height the density of the air is given.
        """
        from Basilisk.simulation import gravityEffector, spacecraft  # pyright: ignore[reportMissingImports]

        hull = spacecraft.Spacecraft()
        hull.ModelTag = name
        hull.hub.mHub, hull.hub.IHubPntBc_B = craft.mass_kg, inertia_kg_m2.tolist()
        hull.hub.r_CN_NInit, hull.hub.v_CN_NInit = state.position_m.tolist(), state.velocity_m_s.tolist()
        hull.hub.sigma_BNInit = sigma_bn[:, None].tolist()
        hull.hub.omega_BN_BInit = rate_rad_s[:, None].tolist()
        # an Earth of its own: GravBodyData keeps where one spacecraft reads its mass and axes
        earth = gravityEffector.GravBodyData()
        earth.planetName, earth.isCentralBody = "earth", True
        earth.mu, earth.radEquator = EARTH_MU_M3_S2, EARTH_RADIUS_M
        degree = self._section.gravity_degree
        if degree:
            earth.gravityModel = gravityEffector.SphericalHarmonicsGravityModel()
            orders = [[0.0] * (n + 1) for n in range(degree + 1)]
            earth.gravityModel.sBar = orders
            earth.gravityModel.cBar = [
                [zonal, *zeros[1:]] for zonal, zeros in zip(ZONAL, orders, strict=False)
            ]
            earth.gravityModel.maxDeg = degree
        earth.planetBodyInMsg.subscribeTo(self._earth)
        hull.gravField.gravBodies = gravityEffector.GravBodyVector([earth])
        self._models.append(earth)
        if craft.area_m2 > 0 and self._section.density_kg_m3 > 0:
            self._drag(hull, craft, float(np.linalg.norm(target.position_m)))
        if craft.area_m2 > 0 and self._section.solar_pressure:
            self._solar_pressure(hull, craft)
        if name == "target":
            self._torques(hull)
        return self._add(hull, 10)

    def _drag(self, hull: Any, craft: Craft, radius_m: float) -> None:
        from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
            dragDynamicEffector,
            exponentialAtmosphere,
            zeroWindModel,
        )

        air = exponentialAtmosphere.ExponentialAtmosphere()
        air.planetRadius, air.baseDensity = radius_m, self._section.density_kg_m3
        air.scaleHeight, air.envMinReach, air.envMaxReach = self._section.scale_height_m, -radius_m, -1.0
        wind = zeroWindModel.ZeroWindModel()
        wind.planetPosInMsg.subscribeTo(self._earth)
        wind.setPlanetOmega_N((EARTH_RATE_RAD_S * teme_to_gcrs(self._start_ns)[:, 2]).tolist())
        drag = dragDynamicEffector.DragDynamicEffector()
        drag.coreParams.projectedArea, drag.coreParams.dragCoeff = craft.area_m2, craft.drag_coefficient
        drag.coreParams.comOffset = list(craft.drag_offset_m)
        for model in (air, wind):
            model.addSpacecraftToModel(hull.scStateOutMsg)
            self._add(model, 30)
        drag.atmoDensInMsg.subscribeTo(air.envOutMsgs[0])
        drag.windVelInMsg.subscribeTo(wind.envOutMsgs[0])
        hull.addDynamicEffector(self._add(drag, 20))

    def _solar_pressure(self, hull: Any, craft: Craft) -> None:
        from Basilisk.simulation import eclipse, radiationPressure  # pyright: ignore[reportMissingImports]

        shadow = self._add(eclipse.Eclipse(), 30)
        shadow.addSpacecraftToModel(hull.scStateOutMsg)
        shadow.addPlanetToModel(self._earth)
        shadow.sunInMsg.subscribeTo(self._sun)
        light = radiationPressure.RadiationPressure()
        light.area, light.coefficientReflection = craft.area_m2, craft.reflection
        light.sunEphmInMsg.subscribeTo(self._sun)
        light.sunEclipseInMsg.subscribeTo(shadow.eclipseOutMsgs[0])
        hull.addDynamicEffector(self._add(light, 20))

    def _torques(self, hull: Any) -> None:
        from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
            GravityGradientEffector,
            extForceTorque,
        )

        if self._section.gravity_gradient:
            gradient = GravityGradientEffector.GravityGradientEffector()
            gradient.addPlanetName("earth")
            hull.addDynamicEffector(self._add(gradient, 20))
        if any(self._section.torque_n_m):
            leak = extForceTorque.ExtForceTorque()
            leak.extTorquePntB_B = [[value] for value in self._section.torque_n_m]
            hull.addDynamicEffector(self._add(leak, 20))

    def run(self, spacecraft: list[Any], steps: int) -> list[Any]:
        """Return records of the states of each spacecraft, at the start and after each step."""
        records = [hull.scStateOutMsg.recorder() for hull in spacecraft]
        for record in records:
            self._add(record, 0)
        self._base.InitializeSimulation()
        self._base.ConfigureStopTime(steps * self._step_ns)
        self._base.ExecuteSimulation()
        return records
