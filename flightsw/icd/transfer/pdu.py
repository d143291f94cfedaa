"""What both ends of a file transfer share: entities, timers, configuration of the library, strict parsing of PDUs."""

import struct
from collections import OrderedDict
from typing import Any

from cfdppy import exceptions as cfdp_errors
from cfdppy.mib import IndicationConfig, LocalEntityConfig, RemoteEntityConfig, RemoteEntityConfigTable
from spacepackets.cfdp import ConditionCode, Direction, DirectiveType, TransmissionMode
from spacepackets.cfdp.defs import InvalidCrcError, UnsupportedCfdpVersionError
from spacepackets.cfdp.pdu import AckPdu, EofPdu, FinishedPdu, MetadataPdu
from spacepackets.cfdp.pdu.ack import TransactionStatus
from spacepackets.cfdp.pdu.helper import PduFactory
from spacepackets.util import ByteFieldU8

from flightsw.icd.mission import Checksum
from flightsw.icd.packet import PacketError
from flightsw.icd.transfer.cfdp_fixes import Faults
from flightsw.icd.transfer.checksum import TYPES

FLIGHT, GROUND = ByteFieldU8(1), ByteFieldU8(2)  # entity IDs
Route = tuple[ByteFieldU8, ByteFieldU8]  # the entities that send and receive a file
DOWNLINK: Route = (FLIGHT, GROUND)
UPLINK: Route = (GROUND, FLIGHT)
TIMER_LIMIT = 8  # expirations in a row before a transaction ends; below 6 a lossy link ends good ones
REMEMBERED = 4096  # closed transactions whose late PDUs are still answered
BUFFER_BYTES = 20_480  # what a pseudo-terminal or driver holds before it makes the writer wait

UNPARSABLE = (
    ValueError,
    IndexError,
    KeyError,
    TypeError,
    struct.error,
    InvalidCrcError,
    UnsupportedCfdpVersionError,
)
REFUSALS = (
    cfdp_errors.PduIgnoredForDest,
    cfdp_errors.PduIgnoredForSource,
    cfdp_errors.InvalidPduDirection,
    cfdp_errors.InvalidPduForDestHandler,
    cfdp_errors.InvalidPduForSourceHandler,
    cfdp_errors.InvalidSourceId,
    cfdp_errors.InvalidDestinationId,
    cfdp_errors.InvalidTransactionSeqNum,
    cfdp_errors.InvalidNakPdu,
    cfdp_errors.NoRemoteEntityConfigFound,
)


def timer_s(baud_rate: int) -> float:
    """Return the time after which an answer counts as lost: twice the round trip through full buffers."""
    round_trip_s = 0.1 + 2 * BUFFER_BYTES * 10 / baud_rate
    return 2 * round_trip_s


def parse_pdu(data: bytes, route: Route = DOWNLINK) -> Any:
    """Return the PDU in `data`.

    Raises:
        PacketError: no PDU, not of class 2, of another route, or with bytes left over.
    """
    try:
        pdu = PduFactory.from_raw(data)
        if isinstance(pdu, MetadataPdu):
            _ = pdu.source_file_name, pdu.dest_file_name  # decoded only here, and perhaps not text
        if isinstance(pdu, EofPdu):
            # spacepackets 0.32.0 leaves the code in the upper half of its byte
            pdu.condition_code = ConditionCode(data[pdu.pdu_header.header_len + 1] >> 4)
    except UNPARSABLE as error:
        raise PacketError(f"not a CFDP PDU: {error}") from error
    if pdu is None or pdu.packet_len != len(data) or pdu.pdu_header.crc_flag:
        raise PacketError(f"not one whole CFDP PDU without CRC in {len(data)} bytes")
    if pdu.transmission_mode != TransmissionMode.ACKNOWLEDGED:
        raise PacketError("a CFDP PDU of class 1, this link uses class 2")
    if (pdu.source_entity_id.value, pdu.dest_entity_id.value) != (route[0].value, route[1].value):
        raise PacketError(
            f"CFDP entities {pdu.source_entity_id.value} to {pdu.dest_entity_id.value}, not ours"
        )
    return pdu


def configuration(
    local: ByteFieldU8,
    remote: ByteFieldU8,
    max_pdu_bytes: int,
    interval_s: float,
    checksum: Checksum,
    max_segment_bytes: int | None = None,
) -> tuple[LocalEntityConfig, RemoteEntityConfigTable]:
    """Return the library's configuration of this end and of the other one."""
    local_config = LocalEntityConfig(local, IndicationConfig(), Faults())
    remote_config = RemoteEntityConfig(
        entity_id=remote,
        max_file_segment_len=max_segment_bytes,
        max_packet_len=max_pdu_bytes,
        closure_requested=True,
        crc_on_transmission=False,
        default_transmission_mode=TransmissionMode.ACKNOWLEDGED,
        crc_type=TYPES[checksum],
        positive_ack_timer_interval_seconds=interval_s,
        positive_ack_timer_expiration_limit=TIMER_LIMIT,
        immediate_nak_mode=False,  # measured: immediate mode resends far more after a restart
        nak_timer_interval_seconds=interval_s,
        nak_timer_expiration_limit=TIMER_LIMIT,
    )
    return local_config, RemoteEntityConfigTable([remote_config])


def acknowledges(pdu: Any, directive: DirectiveType) -> bool:
    """Tell whether a PDU is the acknowledgement of such a directive."""
    return isinstance(pdu, AckPdu) and pdu.directive_code_of_acked_pdu == directive


def acknowledgement(pdu: EofPdu | FinishedPdu, towards: Direction) -> bytes:
    """Return the ACK for a PDU of a transaction that is closed already."""
    directive = DirectiveType.EOF_PDU if isinstance(pdu, EofPdu) else DirectiveType.FINISHED_PDU
    config = pdu.pdu_header.pdu_conf
    config.direction = towards
    return bytes(AckPdu(config, directive, pdu.condition_code, TransactionStatus.TERMINATED).pack())


def remember(closed: OrderedDict, transaction: int, value: Any) -> None:
    """Keep what late PDUs of a closed transaction are answered with; the oldest are forgotten."""
    closed[transaction] = value
    while len(closed) > REMEMBERED:
        closed.popitem(last=False)
