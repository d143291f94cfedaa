"""How well a CAN bus is used while the ground is busy storing frames: python -m tests.benchmarks.can_window

Load of the machine does not matter here: time is simulated. Sender, receiver, packets and ISO-TP channels are those
of flight and ground; modelled are the bus (bits of each frame, stuff bits included), an slcan adapter of 128 frames
behind a terminal's buffer, the computers' time a CAN frame, and a ground that hears nothing while it stores a frame.
"""

import argparse
from collections import deque

from isotp import CanMessage

from flightsw.icd.link.can import FLIGHT_IDS, GROUND_IDS, IsoTpChannels
from flightsw.icd.link.framing import PacketStream
from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.packet import APID_FILES, TELECOMMAND, TELEMETRY
from flightsw.icd.transfer import Receiver, Sender, timer_s
from hil.links.can_timing import frame_s
from hil.links.slcan_adapter import QUEUE_FRAMES
from tests.benchmarks.rows import shown
from tests.link_trial import noise_containers

BITRATE = 1_000_000
TICK_S = 0.0002
POLL_S = 0.002
COMPUTING_S = 35e-6  # a CAN frame, flight or ground, one 2.5 GHz core
LATENCY_S = 0.0005  # from the bus to a computer
TERMINAL_BYTES = 19_456  # unread text that a pseudo-terminal holds
TEXT_BYTES = {False: 22, True: 134}  # of a full frame's line
AHEAD = 2  # files put before their data are on the wire, as the downlink does
LIMIT_S = 1000.0


class Computer:
    """One end: its channels, packets, and until when it is busy."""

    def __init__(self, own_ids: tuple, other_ids: tuple, packet_type: int, fd: bool, packet_bytes: int):
        url = parse_link_url(f"slcan:///dev/null?fd={int(fd)}")
        self.channels = IsoTpChannels(own_ids, other_ids, url)
        self.stream = PacketStream(packet_type, packet_bytes)
        self.interval_s = timer_s(url.payload_baud_rate)
        self.arriving: deque[tuple[float, CanMessage]] = deque()  # when, what
        self.busy_until_s = 0.0
        self._next_poll_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether it has time, and something has come or it is time for its timers."""
        has_come = bool(self.arriving) and self.arriving[0][0] <= now_s
        if now_s < self.busy_until_s or not (has_come or now_s >= self._next_poll_s):
            return False
        self._next_poll_s = now_s + POLL_S
        return True

    def exchange(self, now_s: float) -> tuple[list[bytes], list[CanMessage], int]:
        """Return the PDUs that have come, the frames to send, and how many frames have come."""
        frames = []
        while self.arriving and self.arriving[0][0] <= now_s:
            frames.append(self.arriving.popleft()[1])
        packets, out = self.channels.exchange(frames, now_s)
        return [pdu for _, pdu in self.stream.decode(packets)], out, len(frames)

    def send(self, pdu: bytes, now_s: float) -> list[CanMessage]:
        self.channels.write(self.stream.encode(APID_FILES, pdu))
        return self.channels.exchange([], now_s)[1]


def measure(fd: bool, packet_bytes: int, store_s: float, containers: list[bytes]) -> dict:
    """Send containers in simulated time and return the row."""
    now_s = 0.0
    flight = Computer(FLIGHT_IDS, GROUND_IDS, TELEMETRY, fd, packet_bytes)
    ground = Computer(GROUND_IDS, FLIGHT_IDS, TELECOMMAND, fd, packet_bytes)
    storing_s, stored = 0.0, set()

    def accept(name: str, content: bytes) -> bool:
        nonlocal storing_s
        storing_s += store_s
        stored.add(content)
        return True

    sender = Sender(flight.stream.max_data_bytes, flight.interval_s)
    receiver = Receiver(ground.stream.max_data_bytes, ground.interval_s, accept)
    waiting = deque(enumerate(containers))
    unsent: deque[CanMessage] = deque()  # text that the terminal does not take yet
    terminal: deque[CanMessage] = deque()
    queues: dict[str, deque[tuple[float, CanMessage]]] = {"ground": deque(), "flight": deque()}  # of adapters
    free_s = bus_s = 0.0
    bus_bytes = delivered = 0
    while delivered < len(containers):
        now_s += TICK_S
        if now_s > LIMIT_S:
            raise RuntimeError(f"{delivered} of {len(containers)} frames in {LIMIT_S} s")
        while unsent and len(terminal) < TERMINAL_BYTES // TEXT_BYTES[fd]:
            terminal.append(unsent.popleft())
        while terminal and len(queues["flight"]) < QUEUE_FRAMES:
            queues["flight"].append((now_s, terminal.popleft()))
        while free_s <= now_s and (side := next((s for s in queues if queues[s]), None)):  # the ground wins
            came_s, frame = queues[side].popleft()
            duration_s = frame_s(frame, BITRATE)
            free_s = max(free_s, came_s) + duration_s
            (flight if side == "ground" else ground).arriving.append((free_s + LATENCY_S, frame))
            if side == "flight":
                bus_bytes, bus_s = bus_bytes + len(frame.data), bus_s + duration_s
        if flight.is_due(now_s):
            pdus, out, count = flight.exchange(now_s)
            for pdu in pdus:
                sender.receive(pdu, now_s)
            while waiting and sender.unsent < AHEAD and sender.has_room:
                number, container = waiting.popleft()
                sender.put(f"{number:08d}.obf", container, number + 1, now_s)
            while not unsent and flight.channels.ready and len(out) * COMPUTING_S < TICK_S:
                if (pdu := sender.next_pdu(now_s)) is None:
                    break
                out += flight.send(pdu, now_s)
            unsent.extend(out)
            flight.busy_until_s = now_s + COMPUTING_S * (len(out) + count)
            delivered += sum(outcome.delivered for outcome in sender.outcomes())
        if ground.is_due(now_s):
            pdus, out, count = ground.exchange(now_s)
            for pdu in pdus:
                receiver.receive(pdu, now_s)
            while ground.channels.ready and (pdu := receiver.next_pdu(now_s)) is not None:
                out += ground.send(pdu, now_s)
            queues["ground"].extend((now_s, frame) for frame in out)
            ground.busy_until_s, storing_s = now_s + COMPUTING_S * count + storing_s, 0.0
    assert stored == set(containers)
    wire_bytes_per_s = (63 / 64 if fd else 7 / 8) * bus_bytes / bus_s
    return {
        "link": "canfd" if fd else "can",
        "packet_bytes": packet_bytes,
        "store_ms": round(1000 * store_s),
        "efficiency": round(sum(map(len, containers)) / now_s / wire_bytes_per_s, 3),
        "bus_busy": round(bus_s / now_s, 3),
        "segments_resent": sender.segments_resent,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="The use of a CAN bus while the ground stores frames.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--frames", type=int, default=12, help="of 65 kB")
    arguments = parser.parse_args()
    containers = noise_containers(arguments.frames, 200)
    for fd, packet_bytes in ((True, 1100), (True, 4096), (False, 1100)):
        for store_s in (0.0, 0.015, 0.03, 0.06):
            row = measure(fd, packet_bytes, store_s, containers)
            print(shown(row, "can_window", arguments.json), flush=True)


if __name__ == "__main__":
    main()
