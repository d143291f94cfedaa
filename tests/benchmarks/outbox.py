"""What many waiting frames cost the loop of flight's link: python -m tests.benchmarks.outbox [--waiting 1000 70000]

`run_downlink` sends frames to the real receiving side over a wire in memory; then the ground sends `delete 0 9999`.
A turn of the loop is what flight does between two looks at the wire. Times are processor time of the thread, so that
other work on the machine does not count. A row says how many frames a second of flight's processor time sends, and the
longest turns.
"""

import argparse
import dataclasses
import logging
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from flightsw.downlink.commands import KeyRing
from flightsw.downlink.loop import DownlinkProgress, run_downlink
from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.mission import Mission, load_mission
from flightsw.storage.settings import Settings, save_settings
from flightsw.storage.store import FrameStore
from ground.link.ingest import _Ingest
from ground.link.uplink import make_key, outcome, parse_command, submit
from ground.session.writer import SessionWriter
from tests.benchmarks.rows import shown
from tests.frame_model import End

SIDE_PX = 16
SENT = 500  # frames that are sent in each pass
SETTLE = 20  # and before: the first housekeeping, events and looks
DELETED = 10_000


class Wire(End):
    """Flight's end; the ground has its turn inside `exchange`, and its time is left out."""

    def __init__(self, ground: _Ingest, up: End):
        super().__init__()
        self.longest_turn_ms, self.seconds = 0.0, 0.0
        self._ground, self._up, self._since_s = ground, up, time.thread_time()

    def begin(self) -> None:
        self.longest_turn_ms, self.seconds, self._since_s = 0.0, 0.0, time.thread_time()

    def exchange(self, timeout_s: float) -> bytes:
        turn_s = time.thread_time() - self._since_s
        self.longest_turn_ms, self.seconds = max(self.longest_turn_ms, 1e3 * turn_s), self.seconds + turn_s
        self._up.incoming, self.sent = self.sent, []
        self._ground.turn(time.monotonic())
        data, self._up.sent = b"".join(self._up.sent), []
        self._since_s = time.thread_time()
        return data


def filled_store(folder: Path, count: int) -> FrameStore:
    """Return a store with so many small frames; none of its writes waits for the disk."""
    pose = PoseTag(np.array([1.0, 0, 0, 0]), np.zeros(3), np.eye(6), np.array([1.0, 0, 0]), False, True)
    dn = np.random.default_rng(0).integers(0, 4096, (SIDE_PX, SIDE_PX), dtype=np.uint16)
    frame = Frame(0, 0, 0, 1, 1e-4, 1_784_631_150_000_000_000, pose, dn, 12, 64.0, 0)
    sync, os.fsync = os.fsync, lambda descriptor: None
    try:
        store = FrameStore(folder)
        for number in range(count):
            store.put(dataclasses.replace(frame, frame_id=number, bracket_id=number))
    finally:
        os.fsync = sync
    save_settings(folder, Settings("oldest"))
    return FrameStore(folder)


def measure(folder: Path, mission: Mission, waiting: int) -> dict[str, Any]:
    """Send `SENT` frames of so many, delete the first `DELETED`, and return the row."""
    store, key_file, session = filled_store(folder / "store", waiting), folder / "key", folder / "session"
    make_key(key_file)
    up, keys = End(), KeyRing([key_file])
    wire = Wire(
        _Ingest(up, SessionWriter(session, mission), mission, lambda event: None, None, keys.counters[0].key),
        up,
    )
    delivered = 0

    def note(now: DownlinkProgress) -> None:
        nonlocal delivered
        delivered = now.delivered

    def until(is_done: Any) -> None:
        run_downlink(store, wire, mission, should_stop=is_done, on_progress=note, keys=keys)

    begun: list[int] = []

    def has_sent() -> bool:
        if delivered >= SETTLE and not begun:
            begun.append(delivered)
            wire.begin()
        return bool(begun) and delivered >= begun[0] + SENT

    until(has_sent)
    sending_s, sending_ms = wire.seconds, wire.longest_turn_ms
    for words in (("arm", ["delete"]), ("delete", ["0", str(DELETED - 1)])):
        counter = submit(session, key_file, parse_command(words[0], words[1])[0], None, 600)
    started = [False]

    def has_deleted() -> bool:
        if not started[0]:
            started[0] = True
            wire.begin()
        return outcome(session, counter) is not None

    until(has_deleted)
    end = outcome(session, counter)
    assert end is not None and end["stage"] == "completed", end
    keys.close()
    return {
        "condition": f"{waiting} frames wait",
        "frames_a_second": round(SENT / sending_s),
        "longest_turn_ms": round(sending_ms, 1),
        "longest_turn_deleting_ms": round(wire.longest_turn_ms, 1),
        "said": end["text"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="The loop of flight's link with many waiting frames.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--waiting", type=int, nargs="+", default=[1000, 70_000], help="how many frames wait")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    shared = Path("/dev/shm")
    for waiting in arguments.waiting:
        with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as name:
            text = Path("mission.yaml").read_text()
            for side in ("width", "height"):
                text = text.replace(f"{side}: 256", f"{side}: {SIDE_PX}")
            (Path(name) / "mission.yaml").write_text(text)
            row = measure(Path(name), load_mission(Path(name) / "mission.yaml"), waiting)
        print(shown(row, "outbox", arguments.json), flush=True)


if __name__ == "__main__":
    main()
