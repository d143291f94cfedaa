"""The frame container: exact both ways, and nothing damaged or hostile accepted."""

import contextlib
import dataclasses
import struct
import zlib

import imagecodecs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flightsw.icd.codestream import decode_pixels, encode_pixels
from flightsw.icd.frame import (
    HEADER,
    CrcMismatch,
    Frame,
    PacketError,
    PacketTooShort,
    PoseTag,
    decode_frame,
    encode_frame,
    encode_thumbnail,
    header_of,
    read_header,
    saturated_again,
)

# an optional header that other writers of JPEG-LS put first (ISO 14495-1, annex F of part 2)
SPIFF_BYTES = 44
finite = st.floats(-1e6, 1e6)
own_fixture = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def assert_equal(a: Frame, b: Frame) -> None:
    for field in dataclasses.fields(Frame):
        if field.name not in ("pose", "dn"):
            assert getattr(a, field.name) == getattr(b, field.name), field.name
    for field in dataclasses.fields(PoseTag):
        assert np.array_equal(getattr(a.pose, field.name), getattr(b.pose, field.name)), field.name
    np.testing.assert_array_equal(a.dn, b.dn)


def sealed(body: bytes) -> bytes:
    """Return the bytes behind a CRC that fits: what only a hostile sender would send."""
    return body + struct.pack(">I", zlib.crc32(body))


@given(
    frame_id=st.integers(0, 2**32 - 1),
    mid_ns=st.integers(0, 2**62),
    exposure_s=st.floats(1e-6, 60),
    position=st.tuples(finite, finite, finite),
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    channels=st.sampled_from([1, 3]),
    attitude=st.sampled_from(["known", "rate_only", "unknown"]),
    correlation_s=st.floats(0, 1e6),
    seed=st.integers(0, 99),
)
def test_decode_of_encode_is_the_frame(
    frame_id, mid_ns, exposure_s, position, shape, channels, attitude, correlation_s, seed
):
    rng = np.random.default_rng(seed)
    quat, root = rng.normal(size=4), rng.normal(size=(6, 6))
    quat /= np.linalg.norm(quat)
    assumed = {"known": None, "rate_only": quat, "unknown": np.array([1.0, 0, 0, 0])}[attitude]
    light = (np.array([0.0, 0, 1]), True, False, "navigation")
    pose = PoseTag(quat, np.array(position), root + root.T, *light, attitude, assumed, correlation_s)
    dn = rng.integers(0, 65536, shape if channels == 1 else (*shape, 3), dtype=np.uint16)
    frame = Frame(frame_id, seed, 1, 3, exposure_s, mid_ns, pose, dn, 16, 64.0, 5)
    assert_equal(decode_frame(encode_frame(frame)), frame)


def test_world_to_camera_puts_the_camera_centre_at_the_origin(make_frame):
    frame = make_frame(3)
    centre = np.append(frame.pose.position_body_m, 1.0)
    np.testing.assert_allclose(frame.world_to_camera @ centre, [0, 0, 0, 1], atol=1e-10)  # 400 m in float64


def test_region_of_interest_is_lossless_inside_and_black_outside(make_frame):
    frame, mask = make_frame(1), np.zeros((48, 48), bool)
    mask[10:30, 5:40] = True
    container = encode_frame(frame, roi_mask=mask)
    decoded = decode_frame(container)
    np.testing.assert_array_equal(decoded.dn[mask], frame.dn[mask])
    assert (decoded.dn[~mask] == 64).all()
    assert len(container) < 0.5 * len(encode_frame(frame))
    assert decoded.saturated_count == frame.saturated_count


@pytest.mark.parametrize("channels", [1, 3])
def test_near_bounds_the_error_of_every_pixel(make_frame, channels):
    frame = make_frame(1, channels=channels)
    error = decode_frame(encode_frame(frame, max_error_dn=2)).dn.astype(int) - frame.dn
    assert 0 < np.abs(error).max() <= 2


@pytest.mark.parametrize("channels", [1, 3])
def test_readings_at_full_scale_are_saturated_again_after_near(make_frame, channels):
    dn = make_frame(1, channels=channels).dn
    frame = dataclasses.replace(make_frame(1), dn=np.where(dn > 3000, np.uint16(4095), np.minimum(dn, 4000)))
    container = encode_frame(frame, max_error_dn=3)
    decoded = decode_frame(container)
    assert decoded.dn.max() <= 4095 and (decoded.dn[frame.dn == 4095] < 4095).any()
    again = saturated_again(decoded, container)
    np.testing.assert_array_equal(again.dn == 4095, frame.dn == 4095)
    lossless = encode_frame(frame)
    np.testing.assert_array_equal(saturated_again(decode_frame(lossless), lossless).dn, frame.dn)


@given(st.data())
@own_fixture
def test_a_flipped_bit_is_never_accepted(make_frame, data):
    container = bytearray(encode_frame(make_frame(2, size_px=12)))
    bit = data.draw(st.integers(0, 8 * len(container) - 1))
    container[bit // 8] ^= 1 << bit % 8
    with pytest.raises(PacketError):
        decode_frame(bytes(container))


@given(st.data())
@own_fixture
def test_hostile_container_with_fitting_crc_decodes_or_raises_packet_error(make_frame, data):
    body = bytearray(encode_frame(make_frame(2, size_px=12))[:-4])
    for _ in range(data.draw(st.integers(1, 6))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    try:
        frame = decode_frame(sealed(bytes(body)))
    except PacketError:
        return
    assert frame.dn.shape == (12, 12)


@pytest.mark.parametrize(
    "pattern", ["7ff0000000000001", "7ff8000000000000", "7ff0000000000000", "7fefffffffffffff"]
)
def test_no_number_of_a_container_is_too_strange(make_frame, pattern):
    """A signalling NaN, a quiet one, infinity and the largest number, of which NumPy would warn in a sum or square."""
    container = encode_frame(make_frame(2, size_px=12))
    first = HEADER.size - 8 - 36 * 8
    for place in range(first, HEADER.size - 8, 8):
        body = container[:place] + bytes.fromhex(pattern) + container[place + 8 : -4]
        with contextlib.suppress(PacketError):
            decode_frame(sealed(body))


@given(st.binary(max_size=600))
def test_random_bytes_raise_packet_error(data):
    with pytest.raises(PacketError):
        decode_frame(data)
    with pytest.raises(PacketError):
        decode_frame(sealed(b"OBGF" + data))


def test_a_codestream_of_another_size_is_refused_before_it_is_decoded(make_frame):
    body = bytearray(encode_frame(make_frame(1))[:-4])
    start_of_frame = body.index(b"\xff\xf7", HEADER.size)
    struct.pack_into(">HH", body, start_of_frame + 5, 65535, 65535)  # 8 GiB of pixels
    with pytest.raises(PacketError, match=r"the codestream \(65535, 65535, 1\)"):
        decode_frame(sealed(bytes(body)))


def test_a_codestream_without_its_end_is_refused_before_it_is_decoded(make_frame):
    body = bytearray(encode_frame(make_frame(1))[:-4])
    body[-1] ^= 1  # charls would search for the end for seconds
    with pytest.raises(PacketError, match="codestream does not end"):
        decode_frame(sealed(bytes(body)))


def version_1(frame: Frame) -> bytes:
    """Return a container as version 1 of the interface document lays it out."""
    pose = frame.pose
    stream = bytes(imagecodecs.jpegls_encode(frame.dn))
    numbers = (*pose.quat_body_to_camera, *pose.position_body_m, *pose.sun_dir_body)
    triangle = [pose.covariance[row, column] for row in range(6) for column in range(row + 1)]
    body = struct.pack(">4sHHIIBBH", b"OBGF", 1, 310, frame.frame_id, frame.bracket_id, 0, 3, 2)
    body += struct.pack(">dqHH", frame.exposure_time_s, frame.mid_exposure_utc_ns, *frame.dn.shape)
    body += struct.pack(">BBBBBxfI", 1, 12, 1, 0, 1, frame.black_dn, frame.saturated_count)
    body += struct.pack(">10d21d", *numbers, *triangle)
    body += struct.pack(">II", len(stream), zlib.crc32(frame.dn.astype(">u2").tobytes()))
    assert len(body) == 310
    return sealed(body + stream)


def test_a_container_of_version_1_is_still_read(make_frame):
    frame = make_frame(6)  # its tag does not state an attitude, like those of version 1
    container = version_1(frame)
    assert_equal(decode_frame(container), frame)
    header = header_of(container)
    assert (len(header), len(header_of(encode_frame(frame)))) == (310, HEADER.size)
    values, newest = read_header(header), read_header(header_of(encode_frame(frame)))
    assert values.pop("codestream_bytes") - newest.pop("codestream_bytes") == SPIFF_BYTES
    assert values == newest and values["attitude"] == "known"


@pytest.mark.parametrize("near", [0, 1, 3, 64, 255])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (3, 2, 3), (40, 31), (20, 33, 3)])
@pytest.mark.parametrize("white", [1, 255, 4095, 65535])
def test_another_coder_reads_our_pixels_and_writes_those_we_read(near, shape, white):
    """imagecodecs has CharLS in a build of its own, and puts a SPIFF header before the same codestream."""
    dn = np.random.default_rng(near).integers(0, white + 1, shape, dtype=np.uint16)
    ours, theirs = encode_pixels(dn, near), bytes(imagecodecs.jpegls_encode(dn, level=near))
    size = (*shape, 1)[:3]
    decoded = decode_pixels(ours, size)
    np.testing.assert_array_equal(imagecodecs.jpegls_decode(ours), decoded)
    np.testing.assert_array_equal(decode_pixels(theirs, size), decoded)
    assert np.abs(decoded.astype(int) - dn).max() <= near and decoded.dtype == np.uint16
    assert ours[2:] == theirs[2 + SPIFF_BYTES :]


def test_a_tag_of_unknown_attitude_is_in_inertial_axes(make_frame):
    for assumed in (None, [0.0, 1, 0, 0]):
        with pytest.raises(ValueError, match="must be the identity"):
            dataclasses.replace(make_frame(1).pose, attitude="unknown", quat_inertial_to_body=assumed)


def test_a_quaternion_too_long_to_measure_is_refused(make_frame):
    with pytest.raises(ValueError, match="unit quaternion"):
        dataclasses.replace(make_frame(1).pose, quat_body_to_camera=np.full(4, 1e300))


def test_pixels_that_do_not_fit_their_crc_are_refused(make_frame):
    body = bytearray(encode_frame(make_frame(1))[:-4])
    body[HEADER.size - 1] ^= 1
    with pytest.raises(CrcMismatch, match="decoded pixels"):
        decode_frame(sealed(bytes(body)))


def test_each_refusal_says_what_is_wrong(make_frame):
    container = encode_frame(make_frame(1))
    with pytest.raises(PacketTooShort, match="at least 314 bytes, got 9"):
        decode_frame(container[:9])
    with pytest.raises(PacketTooShort, match="codestream bytes"):
        decode_frame(container[:-1])
    with pytest.raises(PacketError, match="starting with b'OBGF'"):
        decode_frame(b"PNG!" + container[4:])
    with pytest.raises(PacketError, match="version 9"):
        decode_frame(sealed(container[:4] + b"\0\x09" + container[6:-4]))
    with pytest.raises(CrcMismatch, match="container"):
        decode_frame(container[:-1] + bytes([container[-1] ^ 1]))


@pytest.mark.parametrize(
    "wrong",
    [
        {"exposure_time_s": 0.0},
        {"exposure_time_s": float("nan")},
        {"frame_id": 2**32},
        {"black_dn": -1.0},
        {"bit_depth": 7},
        {"mid_exposure_utc_ns": 2**63},
        {"dn": np.zeros((4, 4), np.uint8)},
        {"dn": np.zeros((4, 0), np.uint16)},
    ],
)
def test_a_frame_cannot_hold_values_that_the_container_cannot(make_frame, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        dataclasses.replace(make_frame(1), **wrong)


def test_a_header_alone_says_what_the_frame_is(make_frame):
    frame = make_frame(7)
    values = read_header(encode_frame(frame, max_error_dn=2)[: HEADER.size])
    for name in (
        "frame_id",
        "bracket_id",
        "bracket_index",
        "exposure_time_s",
        "mid_exposure_utc_ns",
        "saturated_count",
    ):
        assert values[name] == getattr(frame, name)
    assert (values["height"], values["width"], values["near"], values["pose_source"]) == (48, 48, 2, "sgp4")
    for name in ("quat_body_to_camera", "position_body_m", "sun_dir_body"):
        np.testing.assert_array_equal(values[name], getattr(frame.pose, name))


@given(st.binary(max_size=HEADER.size + 4), st.integers(0, HEADER.size - 1))
def test_any_bytes_are_a_header_or_a_packet_error(data, at):
    for candidate in (data, b"OBGF" + data, (data + bytes(HEADER.size))[: HEADER.size]):
        try:
            values = read_header(candidate)
        except PacketError:
            continue
        assert np.isfinite(values["exposure_time_s"])


@own_fixture
@given(data=st.data())
def test_a_damaged_header_is_read_or_refused_never_a_crash(make_frame, data):
    header = bytearray(encode_frame(make_frame(1))[: HEADER.size])
    bit = data.draw(st.integers(0, 8 * len(header) - 1))
    header[bit // 8] ^= 1 << bit % 8
    try:
        assert set(read_header(bytes(header))) >= {"frame_id", "position_body_m"}
    except PacketError:
        assert bit < 64 or bit // 8 in (20, 21, 44, 45, 46, 47) or bit // 8 >= 54


@pytest.mark.parametrize(("size_px", "channels"), [(200, 1), (331, 3)])
def test_a_thumbnail_is_the_frame_averaged_over_squares(make_frame, size_px, channels):
    frame = make_frame(3, size_px=size_px, channels=channels)
    container = encode_thumbnail(frame)
    assert container is not None
    thumbnail = decode_frame(container)
    square = -(-size_px // 64)
    side = size_px // square
    assert thumbnail.dn.shape[:2] == (side, side) and side <= 64
    expected = frame.dn[:square, square : 2 * square].astype(float).mean(axis=(0, 1))
    near_and_rounding_dn = 2.5
    np.testing.assert_allclose(thumbnail.dn[0, 1], expected, atol=near_and_rounding_dn)
    assert_equal(dataclasses.replace(thumbnail, dn=frame.dn), frame)


def test_a_small_frame_has_no_thumbnail(make_frame):
    assert encode_thumbnail(make_frame(3)) is None


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"position_body_m": [1.0, 2.0]}, r"position_body_m must be \(3,\) finite numbers"),
        ({"covariance": np.full((6, 6), np.nan)}, r"covariance must be \(6, 6\) finite numbers"),
        ({"source": "guess"}, "source must be one of .*, got 'guess'"),
        ({"attitude": "guess"}, "attitude must be one of .*, got 'guess'"),
        ({"correlation_time_s": -1.0}, "correlation_time_s must be at least 0, got -1.0"),
        ({"correlation_time_s": float("inf")}, "correlation_time_s must be at least 0, got inf"),
    ],
)
def test_a_tag_cannot_hold_what_no_tag_says(make_frame, wrong, problem):
    with pytest.raises(ValueError, match=problem):
        dataclasses.replace(make_frame(1).pose, **wrong)


def test_what_cannot_be_coded_is_refused_before_it_is_coded(make_frame):
    with pytest.raises(ValueError, match="max_error_dn must be 0 to 255, got 256"):
        encode_frame(make_frame(1), max_error_dn=256)
    with pytest.raises(ValueError, match=r"roi_mask has shape \(2, 2\), the frame"):
        encode_frame(make_frame(1), roi_mask=np.ones((2, 2), bool))


def test_a_header_that_is_cut_or_has_more_behind_it_is_refused(make_frame):
    header = encode_frame(make_frame(1))[: HEADER.size]
    assert read_header(header)["frame_id"] == 1
    for data, problem in (
        (header[:9], "a frame header has at least"),
        (header[:-1], f"has {HEADER.size} bytes, got {HEADER.size - 1}"),
        (header + b"\0", "expected one header of"),
    ):
        with pytest.raises(PacketError, match=problem):
            read_header(data)
