"""A GigE Vision client of a hundred lines, without Aravis: control by GVCP, pictures by GVSP, lost packets counted.

Source: packet layouts as Wireshark's dissectors packet-gvcp.c and packet-gvsp.c read them.
"""

import re
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

GVCP = ("127.0.0.1", 3956)
READREG, WRITEREG, ACKNOWLEDGE = 0x80, 0x82, 0x01
PRIVILEGE, STREAM_PORT, STREAM_PACKET_BYTES, STREAM_ADDRESS = 0x0A00, 0x0D00, 0x0D04, 0x0D18
LEADER, TRAILER, PAYLOAD = 1, 2, 3
PACKET_BYTES, HEADER_BYTES = 1400, 36  # of IP, UDP and GVSP
HEARTBEAT_S = 1.0  # a camera gives up a client that is silent for 3 s


@dataclass(frozen=True)
class Picture:
    """A complete picture, 16 bits a pixel, and the camera's time stamp."""

    dn: np.ndarray
    stamp_ns: int


class GvspClient:
    """Controls the camera on 127.0.0.1 and receives its pictures; registers are named as in its description."""

    def __init__(self, description: Path):
        text = description.read_text()
        found = re.findall(r'<IntReg Name="(\w+)Register".*?<Address>(\w+)</Address>', text)
        self._addresses = {name: int(address, 16) for name, address in found}
        self.lost_packets = self.incomplete = 0
        self._control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._control.settimeout(2.0)
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._stream.bind(("127.0.0.1", 0))
        self._request = 0
        self._write(PRIVILEGE, 2)
        self._write(STREAM_ADDRESS, int.from_bytes(socket.inet_aton("127.0.0.1"), "big"))
        self._write(STREAM_PORT, self._stream.getsockname()[1])
        self._write(STREAM_PACKET_BYTES, PACKET_BYTES)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.set("AcquisitionStop", 0)
        self._write(PRIVILEGE, 0)
        self._control.close()
        self._stream.close()

    def set(self, name: str, value: int) -> None:
        self._write(self._addresses[name], value)

    def pictures(self, for_s: float) -> Iterator[Picture]:
        """Yield the pictures that arrive complete in so many seconds; the others are counted."""
        until_s, heartbeat_s = time.monotonic() + for_s, 0.0
        block, packets, leader = -1, {}, b""
        while (now_s := time.monotonic()) < until_s:
            if now_s > heartbeat_s:
                self._ask(READREG, struct.pack(">I", PRIVILEGE))
                heartbeat_s = now_s + HEARTBEAT_S
            self._stream.settimeout(min(until_s - now_s, HEARTBEAT_S))
            try:
                packet = self._stream.recv(1 << 16)
            except TimeoutError:
                continue
            status, number, kind_and_id = struct.unpack(">HHI", packet[:8])
            assert status == 0, f"packet status {status:#x}"
            kind, packet_id = kind_and_id >> 24 & 0x7F, kind_and_id & 0xFFFFFF
            if number != block:
                block, packets, leader = number, {}, b""
            if kind == LEADER:
                leader = packet[8:]
            elif kind == PAYLOAD:
                packets[packet_id] = packet[8:]
            elif kind == TRAILER:
                missing = packet_id - 1 - len(packets) + (not leader)  # the trailer's number is the last
                self.lost_packets += missing
                self.incomplete += bool(missing)
                if not missing:
                    yield self._picture(leader, packets)

    @staticmethod
    def _picture(leader: bytes, packets: dict[int, bytes]) -> Picture:
        high, low, _format, width, height = struct.unpack(">IIIII", leader[4:24])
        data = b"".join(packets[number] for number in sorted(packets))[: 2 * width * height]
        return Picture(np.frombuffer(data, "<u2").reshape(height, width), high << 32 | low)

    def _write(self, address: int, value: int) -> None:
        self._ask(WRITEREG, struct.pack(">II", address, value))

    def _ask(self, command: int, content: bytes) -> None:
        self._request = self._request % 0xFFFF + 1
        header = struct.pack(">BBHHH", 0x42, ACKNOWLEDGE, command, len(content), self._request)
        self._control.sendto(header + content, GVCP)
        while True:
            status, answered, _, request = struct.unpack(">HHHH", self._control.recv(1024)[:8])
            if request == self._request:
                assert (status, answered) == (0, command + 1), f"status {status:#x} of command {command:#x}"
                return
