"""A CAN bus between two slcan adapters on pseudo-terminals, with arbitration, bit timing and seeded faults.

Each frame occupies the bus for its bits, stuff bits included; of two waiting frames the lower identifier goes first.
The faults mean here:

- loss destroys a frame on the bus. The sending controller notices and repeats it, as real ones do, which takes time.
  With `one_shot` (a mode of real controllers) it is not repeated and the frame is lost.
- bit_flip damages a line of the adapter's text, which has no checksum (on the bus itself the CRC would find it).
- duplicate and reorder concern the lines of text that an adapter gives to its computer.
- On a cut bus frames disappear as if another node still acknowledged them.
- While the other adapter is closed nobody acknowledges a frame: the controller keeps it and tries again.
- A computer that does not read in time loses what its adapter cannot buffer: an overrun.
"""

import random
import select
import time

from flightsw.icd.link.link_url import SLCAN_BITRATES
from hil.links.can_timing import frame_s
from hil.links.faults import Faults
from hil.links.slcan_adapter import BusLaneStatistics, SlcanAdapter
from hil.links.virtual_link import VirtualLink

ERROR_FRAME_BITS = 20  # error flags, delimiter, pause: at least 17, at most 31
TICK_S = 0.0005


class VirtualCan(VirtualLink):
    """Two slcan adapters on one CAN bus, or on one CAN FD bus whose data phase runs at 5 Mbit/s."""

    def __init__(
        self,
        bitrate: int = 1_000_000,
        fd: bool = False,
        faults: Faults | None = None,
        seed: int = 0,
        latency_s: float = 0.0,
        one_shot: bool = False,
    ):
        if bitrate not in SLCAN_BITRATES:
            rates = ", ".join(map(str, sorted(SLCAN_BITRATES)))
            raise ValueError(f"bitrate must be one of {rates}, got {bitrate}")
        super().__init__(faults, latency_s)
        self.bitrate, self.fd, self.one_shot = bitrate, fd, one_shot
        self._random = random.Random(3 * seed)
        self._free_s = 0.0  # when the frame on the bus ends
        self._flight, self._ground = (
            SlcanAdapter(self, bitrate, master, 3 * seed + number + 1)
            for number, master in enumerate(self._masters)
        )
        self._flight.partner, self._ground.partner = self._ground, self._flight

    @property
    def flight_url(self) -> str:  # type: ignore[override]
        return f"slcan://{self.flight_device}?bitrate={self.bitrate}&fd={int(self.fd)}"

    @property
    def ground_url(self) -> str:  # type: ignore[override]
        return f"slcan://{self.ground_device}?bitrate={self.bitrate}&fd={int(self.fd)}"

    def statistics(self) -> dict[str, BusLaneStatistics]:
        return {"down": self._flight.statistics, "up": self._ground.statistics}

    def _run(self) -> None:
        adapters = (self._flight, self._ground)
        while not self._stop:
            readers = [adapter.master for adapter in adapters if adapter.wants_text]
            busy = any(adapter.queue or adapter.has_unwritten for adapter in adapters)
            readable, _, _ = select.select(readers, [], [], TICK_S if busy else 0.02)
            now_s = time.monotonic()
            self._transmit(now_s)  # the bus did not wait for this thread, which a busy computer may hold up
            for adapter in adapters:
                if adapter.master in readable:
                    adapter.read(now_s)
            self._transmit(time.monotonic())
            now_s = time.monotonic()
            for adapter in adapters:
                adapter.write(now_s)
            if readable:
                time.sleep(TICK_S / 2)  # lets text accumulate; one turn a line would keep a core busy

    def _transmit(self, now_s: float) -> None:
        """Send the waiting frames that the bus has had time for until now."""
        while self._free_s <= now_s:
            senders = [
                adapter
                for adapter in (self._flight, self._ground)
                if adapter.queue and (adapter.partner.is_open or self.is_cut)
            ]
            if not senders:
                return
            sender = min(senders, key=lambda adapter: adapter.queue[0][1].arbitration_id)
            came_s, frame = sender.queue[0]
            lane, began_s = sender.statistics, max(self._free_s, came_s)
            duration_s = frame_s(frame, self.bitrate)
            if self._random.random() < self.faults.loss:
                lane.frames_destroyed += 1
                if self.one_shot:
                    lane.frames_lost += 1
                    sender.queue.popleft()
                duration_s = duration_s * self._random.random() + ERROR_FRAME_BITS / self.bitrate
            else:
                sender.queue.popleft()
                if self.is_cut:
                    lane.frames_cut += 1
                else:
                    sender.partner.receive(frame, began_s + duration_s)
            lane.bus_busy_s += duration_s
            self._free_s = began_s + duration_s
