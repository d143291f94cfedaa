"""Errors of navigation that the frames of one pass share: how poses move when a few parameters do.

The simulator injects errors with it, the reconstruction estimates them with it. The same function serves both, since it
only says to which poses a change of the parameters leads: from true poses to tags, or from tags to what is true.
"""

import dataclasses
import functools
from dataclasses import dataclass, field

import numpy as np

from obbgs_base.physics.free_rotation import rotations, stepped_rotation, turning_of

# steps of central differences: m, m/s, rad, rad/s, ratio, rad, s, ratio; of an error of third order in them
DIFFERENCES = {
    "position_m": 1e-2,
    "velocity_m_s": 1e-5,
    "attitude_rad": 1e-4,
    "rate_rad_s": 1e-8,
    "inertia_ratios": 1e-5,
    "boresight_rad": 1e-4,
    "clock_s": 1e-3,
    "focal": 1e-4,
}


@dataclass(frozen=True)
class SharedParameters:
    """Changes of the parameters that all frames of a pass share, or their standard deviations.

    position_m, velocity_m_s: [3] of the camera relative to the target at the epoch, along the target's radial,
        transverse and normal axes, which turn with its orbit; m/s in these axes.
    attitude_rad: [3] rotation vector about the body axes that, at the epoch, follows inertial_to_body.
    rate_rad_s: [3] of the target's angular velocity at the epoch, body axes.
    inertia_ratios: [2] relative changes of the moments of inertia about body x and y over that about z.
    boresight_rad: [3] rotation vector about the camera's axes that follows inertial_to_camera.
    clock_s: [1] by which a frame was exposed later than its time says.
    focal: [1] relative change of the focal length.
    """

    position_m: np.ndarray = field(default_factory=functools.partial(np.zeros, 3))
    velocity_m_s: np.ndarray = field(default_factory=functools.partial(np.zeros, 3))
    attitude_rad: np.ndarray = field(default_factory=functools.partial(np.zeros, 3))
    rate_rad_s: np.ndarray = field(default_factory=functools.partial(np.zeros, 3))
    inertia_ratios: np.ndarray = field(default_factory=functools.partial(np.zeros, 2))
    boresight_rad: np.ndarray = field(default_factory=functools.partial(np.zeros, 3))
    clock_s: np.ndarray = field(default_factory=functools.partial(np.zeros, 1))
    focal: np.ndarray = field(default_factory=functools.partial(np.zeros, 1))

    def __post_init__(self):
        for name, length in LENGTHS.items():
            value = np.array(getattr(self, name), dtype=np.float64).reshape(-1)
            if value.shape != (length,) or not np.isfinite(value).all():
                raise ValueError(f"{name}: expected {length} finite numbers, got {getattr(self, name)}")
            object.__setattr__(self, name, value)

    def vector(self) -> np.ndarray:
        """Return all parameters [19] in the order of the fields."""
        return np.concatenate([getattr(self, name) for name in LENGTHS])

    @staticmethod
    def of(vector: np.ndarray) -> "SharedParameters":
        """Return the parameters in a vector [19]."""
        parts = np.split(np.asarray(vector, dtype=np.float64), np.cumsum(list(LENGTHS.values()))[:-1])
        return SharedParameters(*parts)

    def lists(self) -> dict[str, list[float]]:
        """Return the parameters by name as lists of numbers, for JSON."""
        return {name: getattr(self, name).tolist() for name in LENGTHS}


LENGTHS = {
    name: {"inertia_ratios": 2, "clock_s": 1, "focal": 1}.get(name, 3)
    for name in SharedParameters.__annotations__
}
SIZE = sum(LENGTHS.values())


@dataclass(frozen=True)
class NominalMotion:
    """The geometry of a pass before its parameters change, one row for each frame.

    Where the orbit is not known, the defaults let the relative position err by a constant and a constant velocity along
    the inertial axes. Where the rate is not known (0), the attitudes of the frames say how the target turns, and its
    rate errs by a constant vector in inertial axes, as that of a body with equal moments of inertia does; ratios of
    inertia then change nothing.
    """

    times_s: np.ndarray  # [N] of the frames, since the epoch
    position_m: np.ndarray  # [N, 3] of the camera relative to the target's centre, inertial axes
    inertial_to_camera: np.ndarray  # [N, 3, 3]
    inertial_to_body: np.ndarray  # [N, 3, 3]
    mean_motion_rad_s: float = 0.0  # of the target on its near-circular orbit
    # [3, 3] to radial, transverse and normal axes at the epoch
    inertial_to_rtn: np.ndarray = field(default_factory=lambda: np.eye(3))
    rate_rad_s: np.ndarray = field(
        default_factory=functools.partial(np.zeros, 3)
    )  # [3] of the target at the epoch, body axes
    inertia: np.ndarray = field(
        default_factory=lambda: np.ones(3)
    )  # [3] moments about the body axes; ratios matter
    # [K, 4] when torques have changed the rate, s since the epoch, above 0, in order, and by how much, rad/s, body axes
    rate_steps: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    def __post_init__(self):
        count = len(self.times_s)
        for name, shape in (
            ("times_s", (count,)),
            ("position_m", (count, 3)),
            ("inertial_to_camera", (count, 3, 3)),
            ("inertial_to_body", (count, 3, 3)),
            ("inertial_to_rtn", (3, 3)),
            ("rate_rad_s", (3,)),
            ("inertia", (3,)),
            ("rate_steps", (len(self.rate_steps), 4)),
        ):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name}: expected finite numbers of shape {shape}, got shape {value.shape}")
            object.__setattr__(self, name, value)
        if not (self.inertia > 0).all():
            raise ValueError(f"inertia: expected 3 positive moments, got {self.inertia}")

    @staticmethod
    def of_poses(
        times_s: np.ndarray, world_to_camera: np.ndarray, inertial_to_body: np.ndarray | None = None, **orbit
    ) -> "NominalMotion":
        """Return the motion of poses [N, 4, 4] from body to camera axes; without attitudes the body does not turn.

        Args:
            orbit: any of the fields from `mean_motion_rad_s` on.
        """
        poses = np.asarray(world_to_camera, dtype=np.float64)
        if inertial_to_body is None:
            inertial_to_body = np.broadcast_to(np.eye(3), (len(poses), 3, 3))
        body_to_camera = poses[:, :3, :3]
        inertial_to_camera = body_to_camera @ inertial_to_body
        position_m = -(inertial_to_camera.transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]
        return NominalMotion(times_s, position_m, inertial_to_camera, inertial_to_body, **orbit)

    @property
    def world_to_camera(self) -> np.ndarray:
        """The poses [N, 4, 4] from body to camera axes as they stand."""
        return _poses(self.inertial_to_camera, self.inertial_to_body, self.position_m)


def displaced(motion: NominalMotion, parameters: SharedParameters | np.ndarray) -> np.ndarray:
    """Return the poses world_to_camera [..., N, 4, 4] (m) from body to camera axes with changed parameters.

    The camera's path changes by the Clohessy-Wiltshire solution, the target's attitude by torque-free rotation (Euler's
    equations) between the steps of its rate, both over any time and for changes of any size. A clock that errs moves
    the chaser along its path, turns the camera with the line of sight, and turns the target; to first order in the
    error, which is milliseconds.

    Args:
        parameters: the changes, or vectors [..., 19] of them. The focal length changes no pose.
    """
    vectors = (
        parameters.vector() if isinstance(parameters, SharedParameters) else np.asarray(parameters, float)
    )
    lead = vectors.shape[:-1]
    changed = _changed(motion, vectors.reshape(-1, SIZE))
    return _poses(*changed).reshape(*lead, len(motion.times_s), 4, 4)


def displaced_motion(motion: NominalMotion, parameters: SharedParameters) -> NominalMotion:
    """Return the motion with changed parameters; its poses are those of `displaced`."""
    to_camera, to_body, position_m = (part[0] for part in _changed(motion, parameters.vector()[None]))
    ratios = np.append(1 + parameters.inertia_ratios, 1.0)
    return dataclasses.replace(
        motion,
        position_m=position_m,
        inertial_to_camera=to_camera,
        inertial_to_body=to_body,
        rate_rad_s=motion.rate_rad_s + parameters.rate_rad_s,
        inertia=motion.inertia * ratios,
    )


def _changed(motion: NominalMotion, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inertial_to_camera, inertial_to_body [P, N, 3, 3] and position_m [P, N, 3] with parameters [P, 19]."""
    names = np.split(rows, np.cumsum(list(LENGTHS.values()))[:-1], axis=1)
    position, velocity, attitude, rate, ratios, boresight, clock, _ = names
    inertial_to_rtn = _turning(motion)
    offset_rtn = np.einsum(
        "nij,pj->pni", relative_motion(motion), np.concatenate([position, velocity], axis=1)
    )
    path_velocity = _velocity(motion, inertial_to_rtn)
    moved = motion.position_m + np.einsum("nji,pnj->pni", inertial_to_rtn, offset_rtn)
    moved = moved + clock[:, None] * path_velocity
    to_body = _attitudes(motion, attitude, rate, ratios, clock)
    distance2 = np.maximum((motion.position_m**2).sum(axis=1, keepdims=True), 1e-300)
    sight_turn = (
        np.cross(motion.position_m, path_velocity) / distance2
    )  # [N, 3] rad/s of the line of sight, inertial
    to_camera = motion.inertial_to_camera @ rotations(-sight_turn * clock[:, None])
    return rotations(boresight)[:, None] @ to_camera, to_body, moved


def jacobian(motion: NominalMotion, at: SharedParameters) -> np.ndarray:
    """Return the derivatives [N, 6, 19] of the poses by the parameters, by central differences at given values.

    Rows: the small motion in front of world_to_camera, rotation vector (rad), then shift (m), along the camera's axes.
    """
    steps = np.concatenate([np.full(length, DIFFERENCES[name]) for name, length in LENGTHS.items()])
    here = at.vector()
    sides = displaced(motion, np.stack([here + np.diag(steps), here - np.diag(steps)]))  # [2, 19, N, 4, 4]
    motions = sides[0] @ np.linalg.inv(sides[1])
    skew = (motions[..., :3, :3] - motions[..., :3, :3].swapaxes(-1, -2)) / 2
    turns = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    rows = np.concatenate([turns, motions[..., :3, 3]], axis=-1) / (2 * steps[:, None, None])
    return rows.transpose(1, 2, 0)


def relative_motion(motion: NominalMotion) -> np.ndarray:
    """Return the matrices [N, 3, 6] from a state at the epoch (m, m/s, RTN) to the position at each time (m, RTN).

    Source: Clohessy and Wiltshire, Terminal Guidance System for Satellite Rendezvous, 1960. Without mean motion they
    are those of a constant velocity.
    """
    n, t = motion.mean_motion_rad_s, motion.times_s
    c, s = np.cos(n * t), np.sin(n * t)
    s_over_n = t * np.sinc(n * t / np.pi)
    two_versine_over_n = n * t**2 * np.sinc(n * t / (2 * np.pi)) ** 2  # 2 (1 - cos nt) / n
    matrices = np.zeros((len(t), 3, 6))
    matrices[:, 0, 0] = 4 - 3 * c
    matrices[:, 0, 3], matrices[:, 0, 4] = s_over_n, two_versine_over_n
    matrices[:, 1, 0], matrices[:, 1, 1] = 6 * (s - n * t), 1.0
    matrices[:, 1, 3], matrices[:, 1, 4] = -two_versine_over_n, 4 * s_over_n - 3 * t
    matrices[:, 2, 2], matrices[:, 2, 5] = c, s_over_n
    return matrices


def _poses(to_camera: np.ndarray, to_body: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """Return world_to_camera [..., 4, 4]: from the body's axes about the target's centre to the camera's."""
    turn = to_camera @ to_body.swapaxes(-1, -2)
    poses = np.zeros((*turn.shape[:-2], 4, 4))
    poses[..., :3, :3] = turn
    poses[..., :3, 3:] = -to_camera @ position_m[..., None]
    poses[..., 3, 3] = 1.0
    return poses


def _turning(motion: NominalMotion) -> np.ndarray:
    """Return inertial_to_rtn [N, 3, 3] at each time: it turns about the orbit's normal with the mean motion."""
    turn = np.zeros((len(motion.times_s), 3))
    turn[:, 2] = -motion.mean_motion_rad_s * motion.times_s
    return rotations(turn) @ motion.inertial_to_rtn


def _velocity(motion: NominalMotion, inertial_to_rtn: np.ndarray) -> np.ndarray:
    """Return the camera's velocity [N, 3] m/s relative to the target, inertial axes, of the path that fits best.

    The path is a solution of Clohessy and Wiltshire, so that noise of the single positions does not become velocity.
    """
    at_rtn = np.einsum("nij,nj->ni", inertial_to_rtn, motion.position_m)
    state = np.linalg.lstsq(relative_motion(motion).reshape(-1, 6), at_rtn.ravel())[0]
    step_s = 0.5
    sides = [dataclasses.replace(motion, times_s=motion.times_s + side) for side in (-step_s, step_s)]
    before, after = (np.einsum("nji,nj->ni", _turning(s), relative_motion(s) @ state) for s in sides)
    return (after - before) / (2 * step_s)


def _attitudes(
    motion: NominalMotion, attitude: np.ndarray, rate: np.ndarray, ratios: np.ndarray, clock: np.ndarray
) -> np.ndarray:
    """Return inertial_to_body [P, N, 3, 3] with changes of P values each, as in `SharedParameters`."""
    times_s, nominal = motion.times_s, motion.inertial_to_body
    if motion.rate_rad_s.any():
        steps = motion.rate_steps
        inertia = motion.inertia * np.concatenate([1 + ratios, np.ones((len(ratios), 1))], axis=1)
        rows, of_row = np.unique(
            np.concatenate([motion.rate_rad_s + rate, inertia], axis=1), axis=0, return_inverse=True
        )  # most parameters change none of these
        turned, rates = (part[of_row] for part in stepped_rotation(times_s, rows[:, :3], rows[:, 3:], steps))
        before, _ = stepped_rotation(times_s, motion.rate_rad_s[None], motion.inertia[None], steps)
        to_body = turned @ rotations(attitude)[:, None] @ before.swapaxes(-1, -2) @ nominal
        return rotations(-rates * clock[:, None]) @ to_body
    turning = turning_of(times_s, nominal)
    grown = np.einsum("nij,pj->pni", turning.integral_s, rate @ turning.at_epoch)
    to_body = rotations(-grown) @ nominal @ rotations(attitude @ turning.at_epoch)[:, None]
    return rotations(-turning.rates_rad_s * clock[:, None]) @ to_body
