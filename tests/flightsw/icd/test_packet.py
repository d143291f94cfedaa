"""Space packet headers: our own bytes against spacepackets'."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spacepackets.ccsds.spacepacket import PacketType, SequenceFlags, SpacePacketHeader

from flightsw.icd.packet import PacketError, PacketHeader, PacketTooShort, pack_packet, unpack_packet

headers = st.builds(
    PacketHeader,
    packet_type=st.integers(0, 1),
    apid=st.integers(0, 0x7FF),
    seq_count=st.integers(0, 0x3FFF),
    data_length=st.integers(0, 0xFFFF),
    seq_flags=st.integers(0, 3),
)


@given(headers)
def test_header_survives_the_wire(header):
    assert PacketHeader.unpack(header.pack()) == header


@given(headers)
def test_header_bytes_are_those_of_spacepackets(header):
    theirs = SpacePacketHeader(
        packet_type=PacketType(header.packet_type),
        apid=header.apid,
        seq_count=header.seq_count,
        data_len=header.data_length,
        sec_header_flag=False,
        seq_flags=SequenceFlags(header.seq_flags),
    )
    assert header.pack() == theirs.pack()


@given(st.binary(max_size=40))
def test_unpack_packet_returns_a_packet_or_raises_packet_error(data):
    try:
        header, content = unpack_packet(data)
    except PacketError:
        return
    assert header.pack() + content == data


@pytest.mark.parametrize("wrong", [{"apid": 0x800}, {"seq_count": 0x4000}, {"data_length": -1}])
def test_header_refuses_values_that_do_not_fit(wrong):
    with pytest.raises(PacketError, match=next(iter(wrong))):
        PacketHeader(**{"packet_type": 0, "apid": 1, "seq_count": 2, "data_length": 3} | wrong)


def test_packet_with_a_byte_missing_is_refused():
    packet = pack_packet(0, 5, 6, b"seven")
    assert unpack_packet(packet)[1] == b"seven"
    with pytest.raises(PacketTooShort, match="promises 5 data bytes, got 4"):
        unpack_packet(packet[:-1])
