"""A day of flight and ground on a driven clock, memory, files and handles watched: python -m tests.benchmarks.day

The loops of `flightsw downlink` and `ground listen` run in one process, turn by turn, over a link that loses one packet
in a hundred and is cut for a minute in each hour. A small frame comes each minute, a command every ten; the store has a
quota. UTC is an hour ahead for two seconds every six hours, and set by 100 s after noon. There is a row for each hour.
"""

import argparse
import contextlib
import dataclasses
import json
import os
import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

HOUR_S = 3600.0
BEGIN_UTC_S = 1_784_631_150
IDLE_S, BUSY_S = 0.5, 0.02  # what a turn of both sides takes
CUT_S = 60.0  # at the end of each hour
LOSS = 0.01
FRAME_S, COMMAND_S = 60.0, 600.0
SIZE_PX = 32
QUOTA_BYTES = 400_000  # of the store: some 150 frames


class DrivenTime:
    """Elapsed time that only `wait` moves, and a clock with steps; it takes the place of the functions of `time`."""

    def __init__(self):
        self.now_s = 0.0
        self._real = {name: getattr(time, name) for name in ("monotonic", "monotonic_ns", "time", "time_ns")}

    def utc_s(self) -> float:
        is_wrong = (
            3 * HOUR_S <= self.now_s % (6 * HOUR_S) - HOUR_S / 2 < 3 * HOUR_S + 2
        )  # not while the link is cut
        return BEGIN_UTC_S + self.now_s + HOUR_S * is_wrong + 100 * (self.now_s >= 12.25 * HOUR_S)

    def __enter__(self) -> "DrivenTime":
        time.monotonic, time.monotonic_ns = lambda: self.now_s, lambda: round(self.now_s * 1e9)
        time.time, time.time_ns = self.utc_s, lambda: round(self.utc_s() * 1e9)
        return self

    def __exit__(self, *_: object) -> None:
        for name, function in self._real.items():
            setattr(time, name, function)


class Wire:
    """Two ends that take turns: one runs until it waits for the port, then the other does, and the clock moves on."""

    def __init__(self, clock: DrivenTime, end_s: float):
        self.clock, self.end_s = clock, end_s
        self.ended = False
        self.lost = 0
        self.flight, self.ground = End(self), End(self)
        self.flight.other, self.ground.other = self.ground, self.flight
        self._turn = self.flight
        self._changed = threading.Condition()
        self._draw = random.Random(7).random

    def loses(self) -> bool:
        is_cut = self.clock.now_s % HOUR_S >= HOUR_S - CUT_S
        lost = is_cut or self._draw() < LOSS
        self.lost += lost
        return lost

    def pass_on(self, end: "End") -> None:
        """Let the other side run until it is our turn again."""
        with self._changed:
            if self.ended:
                return
            if end is self.ground:
                self.clock.now_s += BUSY_S if self.flight.waiting or self.ground.waiting else IDLE_S
            self._turn = end.other
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._turn is end or self.ended)

    def end(self) -> None:
        with self._changed:
            self.ended = True
            self._changed.notify_all()


class End:
    """One side's port."""

    baud_rate = 115_200
    hang_ups = bytes_read = bytes_written = 0
    connected = ready = True
    other: "End"

    def __init__(self, wire: Wire):
        self._wire = wire
        self.waiting = bytearray()

    @property
    def losses(self) -> dict[str, int]:
        return {}

    def write(self, data: bytes) -> None:
        self.bytes_written += len(data)
        if not self._wire.loses():
            self.other.waiting += data

    def exchange(self, timeout_s: float) -> bytes:
        self._wire.pass_on(self)
        data = bytes(self.waiting)
        self.waiting.clear()
        self.bytes_read += len(data)
        return data

    def close(self) -> None:
        pass

    def __enter__(self) -> "End":
        return self

    def __exit__(self, *_: object) -> None:
        pass


def count_files(folder: Path) -> int:
    return sum(path.is_file() for path in folder.rglob("*"))


def measured(store: Path, session: Path) -> dict[str, float]:
    """Return what must stay bounded, and what grows with the data."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    frames = count_files(session / "frames") + count_files(session / "thumbnails")
    return {
        "rss_mb": round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1),
        "handles": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "store_files": count_files(store),
        "session_files_besides_frames": count_files(session) - frames,
        "session_frame_files": frames,
    }


def a_day(hours: float, folder: Path, show: Callable[[dict[str, Any]], None]) -> None:
    """Run both sides for so many hours of driven time, showing a row after each.

    Raises:
        AssertionError: a side ended early, or a frame or a command is missing at the end.
    """
    clock = DrivenTime()
    with clock:
        # imported here, since functions of the time are arguments' defaults
        import numpy as np

        import ground.link.ingest
        from flightsw.downlink.commands import KeyRing
        from flightsw.downlink.loop import run_downlink
        from flightsw.icd.command import Command
        from flightsw.icd.frame import Frame, PoseTag
        from flightsw.icd.mission import load_mission
        from flightsw.storage.store import open_store
        from ground.link.uplink import make_key, outcome, submit
        from ground.session.folder import open_session

        mission = load_mission("mission.yaml")
        camera = dataclasses.replace(mission.camera, width=SIZE_PX, height=SIZE_PX)
        limits = dataclasses.replace(mission.store, quota_mb=QUOTA_BYTES / 1e6)
        mission = dataclasses.replace(mission, camera=camera, store=limits)
        store, session, key = folder / "store", folder / "session", folder / "key"
        secret = make_key(key)
        capturing, sending = open_store(store, mission), open_store(store, mission)
        wire = Wire(clock, hours * HOUR_S)
        pose = PoseTag(np.array([1.0, 0, 0, 0]), np.zeros(3), np.eye(6), np.array([0.0, 0, 1]), False, True)
        due = {"frame": FRAME_S, "command": COMMAND_S, "row": HOUR_S}
        taken, commands, began_s = 0, [], clock._real["monotonic"]()
        received = 0

        def is_due(name: str, every_s: float) -> bool:
            if clock.now_s < due[name] or clock.now_s > wire.end_s - 600:
                return False
            due[name] += every_s
            return True

        def on_flight() -> bool:
            nonlocal taken
            if is_due("frame", FRAME_S):
                dn = np.random.default_rng(taken).integers(0, 4096, (SIZE_PX, SIZE_PX), dtype=np.uint16)
                number = capturing.next_frame_id
                stamp_ns = BEGIN_UTC_S * 10**9 + round(clock.now_s * 1e9)
                capturing.put(Frame(number, number, 0, 1, 1e-3, stamp_ns, pose, dn, 12, 64.0, 0))
                taken += 1
            return wire.ended

        def on_progress(summary: Any) -> None:
            nonlocal received
            received = summary.frames_received

        def on_ground() -> bool:
            if is_due("command", COMMAND_S):
                commands.append(submit(session, key, Command("ping", {}), None, 300))
            if clock.now_s >= due["row"]:
                hour = round(due["row"] / HOUR_S)
                due["row"] += HOUR_S
                show(
                    {"condition": f"hour {hour}", "hour": hour}
                    | measured(store, session)
                    | {
                        "frames_taken": taken,
                        "frames_received": received,
                        "packets_lost": wire.lost,
                        "commands": len(commands),
                        "real_seconds": round(clock._real["monotonic"]() - began_s, 1),
                    }
                )
            if clock.now_s >= wire.end_s:
                wire.end()
            return wire.ended

        keys = KeyRing([key])
        flight = threading.Thread(
            target=lambda: run_downlink(sending, wire.flight, mission, should_stop=on_flight, keys=keys)
        )
        with _port(ground.link.ingest, wire.ground):
            # flight has the first turn: the ground waits for its own within the first exchange
            flight.start()
            summary = ground.link.ingest.listen(
                "serial:///driven",
                session,
                mission,
                should_stop=on_ground,
                on_progress=on_progress,
                key=secret,
            )
        wire.end()
        flight.join(60)
        keys.close()
        assert not flight.is_alive() and not sending.outbox(), f"{len(sending.outbox())} frames still wait"
        assert len(open_session(session).frames) == summary.frames_received == taken
        stages = [(outcome(session, counter) or {}).get("stage") for counter in commands]
        assert stages.count("completed") == len(stages), stages
        events = [json.loads(line)["text"] for line in (session / "events.jsonl").read_text().splitlines()]
        steps = sum("the clock" in text for text in events)
        show(
            {"condition": "the whole day", "hour": hours, "frames_taken": taken, "commands": len(commands)}
            | {"events": len(events), "events_of_the_clock": steps}
            | {"session_bytes_besides_frames": sum(p.stat().st_size for p in session.glob("*.json*"))}
        )


@contextlib.contextmanager
def _port(ingest: Any, end: End) -> Iterator[None]:
    """Have the listener open our end of the wire."""
    real, ingest.open_link = ingest.open_link, lambda url, side: end
    try:
        yield
    finally:
        ingest.open_link = real


def main() -> None:
    from tests.benchmarks.rows import shown

    parser = argparse.ArgumentParser(description="A day of flight and ground on a driven clock.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--hours", type=float, default=24.0, help="of driven time")
    arguments = parser.parse_args()
    real_load = os.getloadavg

    def show(row: dict[str, Any]) -> None:
        row |= {"bench": "day", "target": "both loops", "load": round(real_load()[0], 1)}
        print(shown(row, "day", arguments.json), flush=True)

    with tempfile.TemporaryDirectory() as name:
        a_day(arguments.hours, Path(name), show)


if __name__ == "__main__":
    main()
