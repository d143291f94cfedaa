"""The navigation filter's states as JSON lines, from a file or a TCP port, interpolated to the middle of an exposure.

A line holds the states of both satellites, or the camera's pose relative to the target (SI units, quaternions w, x, y,
z; a step of more than `max_gap_s` is a gap; after a step back in time or a gap two states in order are needed, so that
one with a wrong time is passed over):

    {"utc_ns": 1784631150000000000,
     "target": {"position_m": [3, GCRS], "velocity_m_s": [3], "quat_gcrs_to_body": [4, optional]},
     "chaser": {"position_m": [3], "velocity_m_s": [3], "quat_gcrs_to_chaser": [4, optional]},
     "covariance": [[6x6, optional: position (m) and velocity (m/s) of the chaser relative to the target, GCRS]]}

    {"utc_ns": 1784631150000000000, "quat_body_to_camera": [4], "position_body_m": [3, camera centre],
     "covariance": [[6x6: position (m, body), rotation vector (rad, camera)]]}

A pose's covariance is that of its errors: position minus the true one, and the rotation vector a in R = exp(a) R_true.
Without attitudes, the target turns as the mission says and the chaser points its camera at the target.
"""

import bisect
import collections
import json
import os
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flightsw.errors import NavigationError
from flightsw.icd.mission import NavigationSection
from flightsw.icd.quaternion import quat_to_matrix, slerp
from obbgs_base.errors import reason

MAX_LINE_BYTES = 16_384
MAX_STATES = 4096  # kept behind the newest one
# states later than an exposure that are read in search of those around it, not a whole file
READ_AHEAD = 2048
POLL_S = 0.01
COVARIANCE_TOLERANCE = 1e-6  # of the mean variances: what six printed digits and float32 leave
SMALLEST_VARIANCE = 1e-60  # for a vector without variance, any entry of whose covariance would then show
NS = 1_000_000_000


@dataclass(frozen=True)
class SatelliteStates:
    """Both satellites in GCRS at one time."""

    utc_ns: int
    target_position_m: np.ndarray  # [3]
    target_velocity_m_s: np.ndarray  # [3]
    chaser_position_m: np.ndarray  # [3]
    chaser_velocity_m_s: np.ndarray  # [3]
    quat_gcrs_to_body: np.ndarray | None  # [4]
    quat_gcrs_to_chaser: np.ndarray | None  # [4]
    covariance: np.ndarray | None  # [6, 6] chaser minus target: position m, velocity m/s


@dataclass(frozen=True)
class RelativePose:
    """The camera in the target's body frame at one time."""

    utc_ns: int
    quat_body_to_camera: np.ndarray  # [4]
    position_body_m: np.ndarray  # [3]
    covariance: np.ndarray  # [6, 6] position m (body), rotation vector rad (camera)


NavigationState = SatelliteStates | RelativePose


def parse_state(line: bytes) -> NavigationState:
    """Return the state in one JSON line.

    Raises:
        NavigationError: it is not JSON, a value is missing, of the wrong shape or not finite, a quaternion is not unit,
            a covariance is not symmetric and positive semi-definite.
    """
    try:
        entry = json.loads(line)
        utc_ns = entry["utc_ns"]
        if not isinstance(utc_ns, int) or isinstance(utc_ns, bool) or not 0 <= utc_ns < 1 << 63:
            raise ValueError(f"utc_ns must be whole nanoseconds, got {utc_ns!r}")
        if "quat_body_to_camera" in entry:
            return RelativePose(
                utc_ns,
                _quaternion(entry["quat_body_to_camera"]),
                _vector(entry["position_body_m"], 3),
                _covariance(entry["covariance"]),
            )
        target, chaser = entry["target"], entry["chaser"]
        return SatelliteStates(
            utc_ns,
            _vector(target["position_m"], 3),
            _vector(target["velocity_m_s"], 3),
            _vector(chaser["position_m"], 3),
            _vector(chaser["velocity_m_s"], 3),
            _quaternion(target["quat_gcrs_to_body"]) if "quat_gcrs_to_body" in target else None,
            _quaternion(chaser["quat_gcrs_to_chaser"]) if "quat_gcrs_to_chaser" in chaser else None,
            _covariance(entry["covariance"]) if "covariance" in entry else None,
        )
    except KeyError as error:
        raise NavigationError(f"a navigation state without {error}") from error
    except (ValueError, TypeError, RecursionError, OverflowError) as error:
        raise NavigationError(f"not a navigation state: {error}") from error


def _vector(value: Any, *shape: int) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape or not np.abs(array).max() < 1e15:  # refuses NaN too
        raise ValueError(f"expected {shape} finite numbers, got {str(value)[:60]}")
    return array


def _quaternion(value: Any) -> np.ndarray:
    quat = _vector(value, 4)
    if abs(np.linalg.norm(quat) - 1) > 1e-3:
        raise ValueError(f"expected a unit quaternion, got {quat}")
    return quat / np.linalg.norm(quat)


def _covariance(value: Any) -> np.ndarray:
    """Return a covariance [6, 6] of two vectors, symmetric; each vector's mean variance is the scale of its errors."""
    matrix = _vector(value, 6, 6)
    mean_variances = np.diag(matrix).reshape(2, 3).mean(axis=1)
    deviations = np.sqrt(np.maximum(mean_variances, SMALLEST_VARIANCE)).repeat(3)
    scaled = matrix / np.outer(deviations, deviations)
    asymmetry, smallest = np.abs(scaled - scaled.T).max(), np.linalg.eigvalsh(scaled)[0]
    if asymmetry > COVARIANCE_TOLERANCE or smallest < -COVARIANCE_TOLERANCE:
        raise ValueError(
            f"a covariance must be symmetric and positive semi-definite; asymmetric by {asymmetry:.2g} and with an "
            f"eigenvalue of {smallest:.2g} of its mean variances"
        )
    return (matrix + matrix.T) / 2


def interpolate(before: NavigationState, after: NavigationState, utc_ns: int) -> NavigationState:
    """Return the state between two of the same kind.

    Positions follow the cubic through both positions and velocities, attitudes the shorter arc. A relative pose is
    interpolated as the target's position in the camera, which hardly moves while the camera tracks,
    however fast the target spins. The covariance is the weighted mean of both, taken in GCRS or, for a relative pose,
    in the camera's axes, in which its errors hardly turn: it is no smaller than the filter's own.
    """
    step_ns = after.utc_ns - before.utc_ns
    u = (utc_ns - before.utc_ns) / step_ns if step_ns else 0.0
    if isinstance(before, RelativePose) and isinstance(after, RelativePose):
        quat = slerp(before.quat_body_to_camera, after.quat_body_to_camera, u)
        turns = [quat_to_matrix(s.quat_body_to_camera) for s in (before, after)]
        position_camera_m = (1 - u) * turns[0] @ before.position_body_m + u * turns[1] @ after.position_body_m
        covariance = (1 - u) * _turned(before.covariance, turns[0]) + u * _turned(after.covariance, turns[1])
        camera_to_body = quat_to_matrix(quat).T
        return RelativePose(
            utc_ns, quat, camera_to_body @ position_camera_m, _turned(covariance, camera_to_body)
        )
    assert isinstance(before, SatelliteStates) and isinstance(after, SatelliteStates)
    step_s = step_ns / NS

    def optional(a: np.ndarray | None, b: np.ndarray | None, mix: Callable) -> np.ndarray | None:
        return None if a is None or b is None else mix(a, b, u)

    return SatelliteStates(
        utc_ns,
        *_hermite(
            before.target_position_m,
            before.target_velocity_m_s,
            after.target_position_m,
            after.target_velocity_m_s,
            step_s,
            u,
        ),
        *_hermite(
            before.chaser_position_m,
            before.chaser_velocity_m_s,
            after.chaser_position_m,
            after.chaser_velocity_m_s,
            step_s,
            u,
        ),
        optional(before.quat_gcrs_to_body, after.quat_gcrs_to_body, slerp),
        optional(before.quat_gcrs_to_chaser, after.quat_gcrs_to_chaser, slerp),
        optional(before.covariance, after.covariance, lambda a, b, u: (1 - u) * a + u * b),
    )


def _turned(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return a relative pose's covariance [6, 6] with the position in other axes; the rotation vector keeps its own."""
    both = np.eye(6)
    both[:3, :3] = rotation
    return both @ covariance @ both.T


def _hermite(
    p0: np.ndarray, v0: np.ndarray, p1: np.ndarray, v1: np.ndarray, step_s: float, u: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity of the cubic through two states; 10 s apart in low orbit it is true to 0.3 mm."""
    if not step_s:
        return p0, v0
    m0, m1, chord = v0 * step_s, v1 * step_s, p1 - p0
    a, b = m0 + m1 - 2 * chord, 3 * chord - 2 * m0 - m1
    return ((a * u + b) * u + m0) * u + p0, ((3 * a * u + 2 * b) * u + m0) / step_s


class NavigationStream:
    """Reads states as they arrive and interpolates to any time between two of them.

    Args:
        section: where from, the largest gap, how long to wait for a state that is not there yet.

    Raises:
        NavigationError: the file is not there. A port that is not there yet is tried again at every request.
    """

    def __init__(self, section: NavigationSection):
        self.bad_lines = 0  # not understood, or with a time that the stream did not go on from
        self.hang_ups = 0
        self._section = section
        # their times increase
        self._states: collections.deque[NavigationState] = collections.deque(maxlen=MAX_STATES)
        # the newest state where it does not follow those, until the next comes
        self._doubtful: NavigationState | None = None
        self._pending = b""
        self._lacked_line_feed = False  # the last line that was read, so that it may still come
        self._descriptor: int | None = None
        self._socket: socket.socket | None = None
        if section.source.startswith("file://"):
            path = section.source.removeprefix("file://")
            try:
                self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
            except OSError as error:
                raise NavigationError(f"no navigation states in {path}: {reason(error)}") from error

    def close(self) -> None:
        for stream in (self._socket, self._descriptor):
            if isinstance(stream, socket.socket):
                stream.close()
            elif stream is not None:
                os.close(stream)
        self._socket = self._descriptor = None
        self._pending = b""

    def first(self, wait_s: float) -> NavigationState | None:
        """Return the first state of the stream, waiting for it; None if none came."""
        deadline_s = time.monotonic() + wait_s
        while not self._states and time.monotonic() < deadline_s:
            self._read(0)
        return self._states[0] if self._states else None

    def at(self, utc_ns: int) -> NavigationState:
        """Return the state at a time, waiting `wait_s` for the states around it.

        Raises:
            NavigationError: before the first state or after the last, or the states around it are too far apart.
        """
        deadline_s = time.monotonic() + self._section.wait_s
        while True:
            later = bisect.bisect_left(self._states, utc_ns, key=lambda state: state.utc_ns)
            problem = self._gap(later, utc_ns)
            if problem is None:
                after = self._states[later]
                before = after if after.utc_ns == utc_ns else self._states[later - 1]
                return interpolate(before, after, utc_ns)
            is_far_ahead = len(self._states) - later >= READ_AHEAD
            if is_far_ahead and self._descriptor is None:  # a port sends no future: these times are wrong
                self.close()
                self._states.clear()
            if is_far_ahead or (not self._read(utc_ns) and time.monotonic() >= deadline_s):
                raise NavigationError(f"gap in the navigation stream: {problem}")

    def _gap(self, later: int, utc_ns: int) -> str | None:
        """Say why there is no state at a time, None if there is; `later` is the first that is not older."""
        if not self._states:
            return "the newest state is missing"
        if later == len(self._states):
            return f"the newest state is {(utc_ns - self._states[-1].utc_ns) / NS:.3f} s older"
        before, after = self._states[max(later - 1, 0)], self._states[later]
        if after.utc_ns == utc_ns:
            return None
        if later == 0:
            return f"it begins {(after.utc_ns - utc_ns) / NS:.3f} s later"
        if type(before) is not type(after):
            return "the states around it are of two kinds"
        if self._follows(before, after):
            return None
        gap_s, max_gap_s = (after.utc_ns - before.utc_ns) / NS, self._section.max_gap_s
        return f"{gap_s:.3f} s between states, at most {max_gap_s} s"

    def _follows(self, before: NavigationState, after: NavigationState) -> bool:
        return 0 < after.utc_ns - before.utc_ns <= self._section.max_gap_s * NS

    def _take(self, state: NavigationState) -> None:
        """Keep a state that follows the newest; two that follow each other after a gap, or after a step back in time.

        After a step back the states from before it with the same or later times go: the stream has taken them back.
        """
        doubtful, self._doubtful = self._doubtful, None
        if not self._states or self._follows(self._states[-1], state):
            self._states.append(state)
            self.bad_lines += doubtful is not None
        elif doubtful is not None and self._follows(doubtful, state):
            while self._states and self._states[-1].utc_ns >= doubtful.utc_ns:
                self._states.pop()
                self.bad_lines += 1
            self._states += [doubtful, state]
        else:
            self._doubtful = state
            self.bad_lines += doubtful is not None

    def _read(self, until_utc_ns: int) -> bool:
        """Take in lines up to the first state that is not older; tell whether there was anything to read."""
        lacking = False
        if b"\n" not in self._pending:
            data = self._receive()
            if not data:
                if not self._is_whole(self._pending):
                    return False
                data, lacking = b"\n", True  # the last line of a file may lack it
            self._pending += data
        while b"\n" in self._pending:
            line, _, self._pending = self._pending.partition(b"\n")
            if not line and self._lacked_line_feed:  # that of a state which was whole without it
                self._lacked_line_feed = False
                continue
            self._lacked_line_feed = lacking
            try:
                state = parse_state(line)
            except NavigationError:
                self.bad_lines += 1
                continue
            self._take(state)
            if state.utc_ns >= until_utc_ns:
                break
        if len(self._pending) > MAX_LINE_BYTES and b"\n" not in self._pending:
            self._pending = b""
            self.bad_lines += 1
        return True

    @staticmethod
    def _is_whole(line: bytes) -> bool:
        """Tell whether a line without a line feed is a state: a JSON object that is cut anywhere is none."""
        try:
            parse_state(line)
        except NavigationError:
            return False
        return True

    def _receive(self) -> bytes:
        """Return what has come, empty after a short wait."""
        if self._descriptor is not None:
            try:
                data = os.read(self._descriptor, 65_536)
            except BlockingIOError:  # a pipe whose writer is silent
                data = b""
            if not data:
                time.sleep(POLL_S)
            return data
        try:
            if self._socket is None:
                host, _, port = self._section.source.removeprefix("tcp://").rpartition(":")
                self._socket = socket.create_connection((host, int(port)), timeout=1.0)
            if not select.select([self._socket], [], [], POLL_S)[0]:
                return b""
            if data := self._socket.recv(65_536):
                return data
            raise ConnectionError("the navigation port closed the connection")
        except OSError:
            self.hang_ups += self._socket is not None
            rest = self._pending
            self.close()
            self._pending = rest if self._is_whole(rest) else b""
            time.sleep(POLL_S)
            return b""
