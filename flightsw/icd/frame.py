"""One frame on the wire: exposure, time, pose tag and pixels in a container with checksums."""

import math
import struct
import zlib
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from flightsw.icd.codestream import decode_pixels, encode_pixels
from flightsw.icd.packet import CrcMismatch, PacketError, PacketTooShort
from flightsw.icd.quaternion import quat_to_matrix

MAGIC = b"OBGF"
VERSION = 2
SOURCES = ("none", "sgp4", "navigation", "truth")
Attitude = Literal["known", "rate_only", "unknown"]  # what is known of the target's
ATTITUDES = get_args(Attitude)
# magic, version, header bytes | frame, bracket, index, count, flags | exposure s, mid-exposure UTC ns
# | height, width, channels, bit depth, codec, NEAR, pose source, attitude | black, saturated | quaternion, position,
# Sun, covariance (lower triangle) | assumed attitude, correlation time s | codestream bytes, CRC-32 of the decoded
# pixels. Byte table: README.md.
HEADER = struct.Struct(">4sHHIIBBHdqHHBBBBBBfI4d3d3d21d4ddII")
# of version 1: without the assumed attitude and the correlation time, and a zero in the place of `attitude`
HEADER_1 = struct.Struct(">4sHHIIBBHdqHHBBBBBBfI4d3d3d21dII")
HEADERS = {1: HEADER_1, VERSION: HEADER}
NOT_STATED = (0.0, 0.0, 0.0, 0.0, 0.0)  # assumed attitude and correlation time, of a header of version 1
CRC = struct.Struct(">I")
FLAG_ECLIPSE, FLAG_POSE_VALID, FLAG_MASKED = 1, 2, 4
CODEC_JPEG_LS = 1
MAX_PIXELS = 8192 * 8192
THUMBNAIL_PX = 64  # longest side of a thumbnail
THUMBNAIL_MAX_ERROR = 2  # DN
TRIANGLE = np.tril_indices(6)


@dataclass(frozen=True)
class PoseTag:
    """The camera's pose in the target's body frame, and the light that fell on the target.

    `attitude` says what is known of the target's attitude. known: the pose is in its body frame. rate_only: so it is,
    but the body's axes at the start were chosen freely. unknown: `body` stands for inertial (GCRS) axes centred on the
    target, for the Sun's direction too.
    """

    quat_body_to_camera: np.ndarray  # [4] w, x, y, z, unit
    position_body_m: np.ndarray  # [3] camera centre
    covariance: np.ndarray  # [6, 6] position (m, body) then rotation vector (rad, camera)
    sun_dir_body: np.ndarray  # [3] unit, target to Sun
    in_eclipse: bool
    valid: bool
    source: str = "sgp4"
    attitude: Attitude = "known"
    # [4] the target's attitude that the pose assumes; None: not stated
    quat_inertial_to_body: np.ndarray | None = None
    correlation_time_s: float = 0.0  # of the tag's errors; 0: independent from bracket to bracket

    def __post_init__(self):
        for name, shape in (
            ("quat_body_to_camera", (4,)),
            ("position_body_m", (3,)),
            ("covariance", (6, 6)),
            ("sun_dir_body", (3,)),
            ("quat_inertial_to_body", (4,)),
        ):
            given = getattr(self, name)
            if given is None:
                continue
            value = np.asarray(given, dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} must be {shape} finite numbers, got shape {value.shape}")
            if name.startswith("quat"):
                _require_unit(name, value)
            object.__setattr__(self, name, value)
        if self.source not in SOURCES:
            raise ValueError(f"source must be one of {', '.join(SOURCES)}, got {self.source!r}")
        if self.attitude not in ATTITUDES:
            raise ValueError(f"attitude must be one of {', '.join(ATTITUDES)}, got {self.attitude!r}")
        assumed = self.quat_inertial_to_body
        if self.attitude == "unknown" and (assumed is None or not abs(assumed[0]) > 1 - 1e-9):
            raise ValueError(
                "with attitude unknown a pose is in inertial axes: quat_inertial_to_body must be the identity, got "
                f"{assumed}"
            )
        if not 0 <= self.correlation_time_s < math.inf:
            raise ValueError(f"correlation_time_s must be at least 0, got {self.correlation_time_s}")

    @property
    def world_to_camera(self) -> np.ndarray:
        """[4, 4], x_camera = world_to_camera @ x_body, m, OpenCV axes."""
        matrix = np.eye(4)
        matrix[:3, :3] = quat_to_matrix(self.quat_body_to_camera)
        matrix[:3, 3] = -matrix[:3, :3] @ self.position_body_m
        return matrix


def _require_unit(name: str, quat: np.ndarray) -> None:
    if np.abs(quat).max() > 2 or abs(np.linalg.norm(quat) - 1) > 1e-6:  # 2: before the norm overflows
        raise ValueError(f"{name} must be a unit quaternion, got {quat}")


@dataclass(frozen=True)
class Frame:
    """One exposure with everything needed to use it."""

    frame_id: int
    bracket_id: int
    bracket_index: int
    bracket_count: int
    exposure_time_s: float
    mid_exposure_utc_ns: int
    pose: PoseTag
    dn: np.ndarray  # [H, W] or [H, W, 3] uint16
    bit_depth: int
    black_dn: float
    saturated_count: int

    def __post_init__(self):
        for name, bits in (
            ("frame_id", 32),
            ("bracket_id", 32),
            ("bracket_index", 8),
            ("bracket_count", 8),
            ("saturated_count", 32),
        ):
            if not 0 <= getattr(self, name) < 1 << bits:
                raise ValueError(f"{name}={getattr(self, name)} does not fit {bits} bits")
        if self.dn.dtype != np.uint16 or self.dn.ndim not in (2, 3) or self.dn.shape[2:] not in ((), (3,)):
            raise ValueError(f"dn must be uint16 [H, W] or [H, W, 3], got {self.dn.dtype} {self.dn.shape}")
        if not 0 < self.dn.shape[0] * self.dn.shape[1] <= MAX_PIXELS:
            raise ValueError(f"dn must have 1 to {MAX_PIXELS} pixels, got {self.dn.shape}")
        if not (np.isfinite(self.exposure_time_s) and self.exposure_time_s > 0):
            raise ValueError(f"exposure_time_s must be positive, got {self.exposure_time_s}")
        if not -(1 << 63) <= self.mid_exposure_utc_ns < 1 << 63:
            raise ValueError(f"mid_exposure_utc_ns={self.mid_exposure_utc_ns} does not fit 64 bits")
        if not 0 <= self.black_dn < 1 << 16:
            raise ValueError(f"black_dn must be 0 to 65535, got {self.black_dn}")
        if not 8 <= self.bit_depth <= 16:
            raise ValueError(f"bit_depth must be 8 to 16, got {self.bit_depth}")

    @property
    def world_to_camera(self) -> np.ndarray:
        """[4, 4], body to camera, m."""
        return self.pose.world_to_camera


def encode_frame(frame: Frame, *, max_error_dn: int = 0, roi_mask: np.ndarray | None = None) -> bytes:
    """Return the frame as a container: header, JPEG-LS codestream, CRC-32 over both.

    Args:
        max_error_dn: the largest error of a pixel, which JPEG-LS calls NEAR; 0 is lossless.
        roi_mask: [H, W] bool; pixels outside are set to the black level before coding. None keeps all.
    """
    if not 0 <= max_error_dn <= 255:
        raise ValueError(f"max_error_dn must be 0 to 255, got {max_error_dn}")
    dn, flags = frame.dn, FLAG_ECLIPSE * frame.pose.in_eclipse | FLAG_POSE_VALID * frame.pose.valid
    if roi_mask is not None:
        if roi_mask.shape != dn.shape[:2]:
            raise ValueError(f"roi_mask has shape {roi_mask.shape}, the frame {dn.shape[:2]}")
        dn = np.where(roi_mask.reshape(roi_mask.shape + (1,) * (dn.ndim - 2)), dn, np.uint16(frame.black_dn))
        flags |= FLAG_MASKED
    codestream = encode_pixels(dn, max_error_dn)
    shape = (dn.shape[0], dn.shape[1], 1 if dn.ndim == 2 else 3)
    decoded = dn if max_error_dn == 0 else decode_pixels(codestream, shape)
    pose = frame.pose
    assumed = np.zeros(4) if pose.quat_inertial_to_body is None else pose.quat_inertial_to_body
    header = HEADER.pack(
        MAGIC,
        VERSION,
        HEADER.size,
        frame.frame_id,
        frame.bracket_id,
        frame.bracket_index,
        frame.bracket_count,
        flags,
        frame.exposure_time_s,
        frame.mid_exposure_utc_ns,
        *shape,
        frame.bit_depth,
        CODEC_JPEG_LS,
        max_error_dn,
        SOURCES.index(pose.source),
        ATTITUDES.index(pose.attitude),
        frame.black_dn,
        frame.saturated_count,
        *pose.quat_body_to_camera,
        *pose.position_body_m,
        *pose.sun_dir_body,
        *pose.covariance[TRIANGLE],
        *assumed,
        pose.correlation_time_s,
        len(codestream),
        _pixel_crc(decoded),
    )
    body = header + codestream
    return body + CRC.pack(zlib.crc32(body))


def decode_frame(data: bytes) -> Frame:
    """Return the frame in a container.

    Raises:
        PacketTooShort: the bytes end before what the header promises.
        CrcMismatch: the container or the decoded pixels do not fit their CRC-32.
        PacketError: not a container, another version, or values out of range.
    """
    fields, header_bytes = _checked_fields(data)
    return _frame_from(fields, data[header_bytes : -CRC.size], fields[-1])


def numbers_of(data: bytes) -> tuple[int, int, int]:
    """Return frame, bracket and place in the bracket of a container after checking all of its bytes.

    The pixels are not decoded: it is ten times as quick as `decode_frame`.

    Raises:
        PacketError: as by `decode_frame`.
    """
    frame_id, bracket_id, bracket_index = _checked_fields(data)[0][3:6]
    return frame_id, bracket_id, bracket_index


def _checked_fields(data: bytes) -> tuple[tuple, int]:
    """Return a container's header fields and the header's number of bytes, once its length and CRC-32 fit."""
    if len(data) < HEADER_1.size + CRC.size:
        raise PacketTooShort(f"a frame has at least {HEADER_1.size + CRC.size} bytes, got {len(data)}")
    fields, header_bytes = _header_fields(data)
    codestream_bytes = fields[-2]
    if len(data) != header_bytes + codestream_bytes + CRC.size:
        raise PacketTooShort(
            f"the header promises {codestream_bytes} codestream bytes, {len(data)} came in all"
        )
    if CRC.unpack_from(data, len(data) - CRC.size)[0] != zlib.crc32(data[: -CRC.size]):
        raise CrcMismatch("the container's CRC-32 does not fit its bytes")
    return fields, header_bytes


def header_of(container: bytes) -> bytes:
    """Return the header at the beginning of a container, whatever its version; nothing is checked."""
    return container[: int.from_bytes(container[6:8], "big")]


def _header_fields(data: bytes) -> tuple[tuple, int]:
    """Return the fields of a header, of any version as those of the newest, and its number of bytes.

    Raises:
        PacketError: not a container, a version that is not known, or the end comes too early.
    """
    magic, version, header_bytes = data[:4], *struct.unpack_from(">HH", data, 4)
    if magic != MAGIC:
        raise PacketError(f"expected a frame starting with {MAGIC!r}, got {magic!r}")
    layout = HEADERS.get(version)
    if layout is None or header_bytes != layout.size:
        raise PacketError(
            f"frame version {version} with {header_bytes} header bytes; this software reads up to {VERSION}"
        )
    if len(data) < header_bytes:
        raise PacketTooShort(f"a frame header of version {version} has {header_bytes} bytes, got {len(data)}")
    fields = layout.unpack_from(data)
    return (fields if version > 1 else (*fields[:-2], *NOT_STATED, *fields[-2:])), header_bytes


def read_header(data: bytes) -> dict[str, Any]:
    """Return the values in a container's header, by their names in README.md: they arrive before the frame itself.

    Raises:
        PacketError: not one whole header of this version, or a value that is not finite.
    """
    if len(data) < HEADER_1.size:
        raise PacketTooShort(f"a frame header has at least {HEADER_1.size} bytes, got {len(data)}")
    fields, header_bytes = _header_fields(data)
    if len(data) != header_bytes or fields[16] >= len(SOURCES) or fields[17] >= len(ATTITUDES):
        raise PacketError(
            f"expected one header of {header_bytes} bytes, a pose source below {len(SOURCES)} and an attitude below "
            f"{len(ATTITUDES)}; got {len(data)} bytes, {fields[16]} and {fields[17]}"
        )
    numbers = (fields[8], fields[18], *fields[20:56])
    if not np.isfinite(numbers).all():
        raise PacketError("a frame header with values that are not finite")
    names = "frame_id bracket_id bracket_index bracket_count flags exposure_time_s mid_exposure_utc_ns height width"
    values = dict(zip(names.split(), fields[3:12], strict=True))
    return values | {
        "near": fields[15],
        "pose_source": SOURCES[fields[16]],
        "attitude": ATTITUDES[fields[17]],
        "saturated_count": fields[19],
        "quat_body_to_camera": list(fields[20:24]),
        "position_body_m": list(fields[24:27]),
        "sun_dir_body": list(fields[27:30]),
        "codestream_bytes": fields[56],
    }


def encode_thumbnail(frame: Frame) -> bytes | None:
    """Return a container of the frame averaged over squares to at most 64 px a side; None if it is hardly larger."""
    size_px = -(-max(frame.dn.shape[:2]) // THUMBNAIL_PX)
    if size_px < 3:
        return None
    rows, columns = (side // size_px for side in frame.dn.shape[:2])
    if rows == 0 or columns == 0:
        return None
    squares = frame.dn[: rows * size_px, : columns * size_px]
    squares = squares.reshape(rows, size_px, columns, size_px, *frame.dn.shape[2:])
    dn = squares.mean(axis=(1, 3)).round().astype(np.uint16)
    return encode_frame(replace(frame, dn=dn), max_error_dn=THUMBNAIL_MAX_ERROR)


def saturated_again(frame: Frame, container: bytes) -> Frame:
    """Return a frame of a container with full scale for readings that NEAR may have moved from there.

    A saturated reading says that there was at least so much light, any other how much there was.
    """
    near = int(_header_fields(container)[0][15])
    full = np.uint16(2**frame.bit_depth - 1)
    return replace(frame, dn=np.where(frame.dn >= full - near, full, frame.dn)) if near else frame


def _frame_from(fields: tuple, codestream: bytes, pixel_crc: int) -> Frame:
    (frame_id, bracket_id, index, count, flags, exposure_s, mid_ns) = fields[3:10]
    (height, width, channels, bit_depth, codec, near, source, attitude, black_dn, saturated) = fields[10:20]
    numbers = np.array(fields[20:56])
    if (
        codec != CODEC_JPEG_LS
        or channels not in (1, 3)
        or source >= len(SOURCES)
        or attitude >= len(ATTITUDES)
        or height * width > MAX_PIXELS
    ):
        raise PacketError(
            f"codec {codec}, {channels} channels, pose source {source}, attitude {attitude}, {height}x{width}: "
            "out of range"
        )
    dn = decode_pixels(codestream, (height, width, channels))
    if _pixel_crc(dn) != pixel_crc:
        raise CrcMismatch("the decoded pixels do not fit their CRC-32")
    if not np.isfinite(numbers).all():  # before any sum: NumPy warns of a signalling NaN
        raise PacketError(f"frame {frame_id}: a number of the pose is not finite")
    if near and bit_depth < 16:
        dn = np.minimum(dn, np.uint16(2**bit_depth - 1))  # NEAR may have moved a reading beyond
    covariance = np.zeros((6, 6))
    covariance[TRIANGLE] = numbers[10:31]
    covariance = covariance + np.tril(covariance, -1).T
    try:
        pose = PoseTag(
            quat_body_to_camera=numbers[0:4],
            position_body_m=numbers[4:7],
            covariance=covariance,
            sun_dir_body=numbers[7:10],
            in_eclipse=bool(flags & FLAG_ECLIPSE),
            valid=bool(flags & FLAG_POSE_VALID),
            source=SOURCES[source],
            attitude=ATTITUDES[attitude],
            quat_inertial_to_body=numbers[31:35] if numbers[31:35].any() else None,
            correlation_time_s=float(numbers[35]),
        )
        return Frame(
            frame_id, bracket_id, index, count, exposure_s, mid_ns, pose, dn, bit_depth, black_dn, saturated
        )
    except ValueError as error:
        raise PacketError(f"frame {frame_id}: {error}") from error


def _pixel_crc(dn: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(dn, dtype=">u2").tobytes())
