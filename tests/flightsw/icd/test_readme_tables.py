"""The byte tables of the interface document, read and held against the code."""

import dataclasses
import re
import struct
from pathlib import Path

import numpy as np
import pytest

import flightsw.icd
from flightsw.icd import packet
from flightsw.icd.frame import ATTITUDES, CODEC_JPEG_LS, CRC, HEADER, SOURCES, encode_frame
from flightsw.icd.link.auth import SECURITY_HEADER, TAG_BYTES, Key, seal
from flightsw.icd.packet import PacketHeader

README = (Path(flightsw.icd.__path__[0]) / "README.md").read_text()


def table(first_column: str) -> list[list[str]]:
    """Return the cells of the table whose header starts with a column's name."""
    block = re.search(rf"^\| {first_column} \|.*\n\|[ -|]*\n((?:\|.*\n)+)", README, re.M)
    assert block, first_column
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in block[1].splitlines()]


def test_frame_table_is_what_encode_frame_writes(make_frame):
    frame = make_frame(7)
    stated = {"attitude": "rate_only", "quat_inertial_to_body": [0, 0.6, 0, 0.8], "correlation_time_s": 12.5}
    pose = dataclasses.replace(frame.pose, **stated)
    container = encode_frame(dataclasses.replace(frame, pose=pose))
    expected = {
        "magic": b"OBGF",
        "version": 2,
        "header_bytes": HEADER.size,
        "frame_id": frame.frame_id,
        "bracket_id": frame.bracket_id,
        "bracket_index": frame.bracket_index,
        "bracket_count": frame.bracket_count,
        "flags": 2,
        "exposure_time_s": frame.exposure_time_s,
        "mid_exposure_utc_ns": frame.mid_exposure_utc_ns,
        "height": 48,
        "width": 48,
        "channels": 1,
        "bit_depth": 12,
        "codec": CODEC_JPEG_LS,
        "near": 0,
        "pose_source": SOURCES.index("sgp4"),
        "attitude": ATTITUDES.index("rate_only"),
        "black_dn": 64.0,
        "saturated_count": frame.saturated_count,
        "quat_body_to_camera": tuple(pose.quat_body_to_camera),
        "position_body_m": tuple(pose.position_body_m),
        "sun_dir_body": tuple(pose.sun_dir_body),
        "covariance": tuple(pose.covariance[np.tril_indices(6)]),
        "quat_inertial_to_body": (0.0, 0.6, 0.0, 0.8),
        "correlation_time_s": 12.5,
        "codestream_bytes": len(container) - HEADER.size - CRC.size,
        "pixel_crc": struct.unpack_from(">I", container, HEADER.size - 4)[0],
    }
    position = 0
    for offset, kind, name, _ in table("offset"):
        assert int(offset) == position, name
        position += struct.calcsize(">" + kind)
        values = struct.unpack_from(">" + kind, container, int(offset))
        value = values[0] if len(values) == 1 else values
        assert value == expected.pop(name), name
    assert position == HEADER.size
    assert not expected


def test_flags_and_pose_sources_are_those_of_the_code():
    text = {name: value for _, _, name, value in table("offset")}
    assert text["flags"].startswith("1 in eclipse, 2 pose valid, 4 pixels outside")
    assert text["pose_source"] == ", ".join(f"{number} {name}" for number, name in enumerate(SOURCES))
    assert text["attitude"] == ", ".join(f"{number} {name}" for number, name in enumerate(ATTITUDES))


@pytest.mark.parametrize("field", ["packet_type", "apid", "seq_flags", "seq_count", "data_length"])
def test_packet_table_is_what_the_header_packs(field):
    rows = {name: (int(bit), int(bits)) for bit, bits, name, _ in table("bit")}
    assert sum(bits for _, bits in rows.values()) == 48
    bit, bits = rows[field]
    zeros = {"packet_type": 0, "apid": 0, "seq_count": 0, "data_length": 0, "seq_flags": 0}
    full = PacketHeader(**zeros | {field: (1 << bits) - 1})
    assert int.from_bytes(full.pack(), "big") == ((1 << bits) - 1) << (48 - bit - bits)


def test_stream_table_has_every_application_of_the_code():
    rows = [stream.split(" ") for stream, _, _ in table("stream")]
    assert {f"APID_{name}": int(number, 16) for number, name in rows} == {
        name: value for name, value in vars(packet).items() if name.startswith("APID_")
    }


def test_security_table_is_what_seal_writes():
    sealed = seal(Key(513, bytes(32)), 7, b"ping")
    rows = {name: (place, kind) for place, kind, name, _ in table("place")}
    assert rows.pop("tag") == (f"end - {TAG_BYTES}", f"{TAG_BYTES}s")
    assert rows.pop("command")[0] == str(SECURITY_HEADER.size)
    values = {"spi": (513,), "iv_zeros": (), "counter": (7,)}
    position = 0
    for name, (place, kind) in rows.items():
        assert int(place) == position
        assert struct.unpack_from(">" + kind, sealed, position) == values.pop(name)
        position += struct.calcsize(">" + kind)
    assert not values and len(sealed) == position + len(b"ping") + TAG_BYTES
