"""A stateful model of store, transfer, commands and session, under everything that may happen to them.

The rules drive the real flight side (`_Downlink`) and the real ground side (`_Ingest`) over a wire of lists and on a
clock of ours. After each rule the invariants of `flightsw/icd/README.md`, "What holds for every frame", are checked.
"""

import json
import random
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from flightsw.downlink.commands import KeyRing
from flightsw.downlink.housekeeping import EventLog
from flightsw.downlink.loop import _Downlink
from flightsw.errors import StoreFull
from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.link.auth import Key
from flightsw.icd.mission import load_mission
from flightsw.storage.settings import Settings, save_settings
from flightsw.storage.store import FrameStore, lock_store
from flightsw.storage.transfer_numbers import TransferNumbers
from ground.link.ingest import _Ingest
from ground.link.uplink import make_key, outcome, parse_command, submit
from ground.session.writer import SessionWriter
from obbgs_base.checked import copy_of

SIDE_PX = 8
QUOTA_BYTES = 6_500  # some 11 frames: more than are in flight, so that one can be dropped
STEP_S = 0.02
RESULTS = {
    "ping": "alive",
    "resend": "put into the outbox again",
    "delete": "deleted",
    "arm": "is armed",
}
TEXT = (Path(__file__).parents[1] / "mission.yaml").read_text()
MISSION_TEXT = TEXT.replace("width: 256", f"width: {SIDE_PX}").replace("height: 256", f"height: {SIDE_PX}")
CALM = {"loss": 0.0, "again": 0.0, "late": 0.0, "flip": 0.0}
EVENTS = ["outage", "outage", "kill_flight", "kill_ground", "flip_and_restart"] * 3 + [
    *("pause_of_hours", "step_of_the_clock", "counter_set_back"),
    *("new_store", "new_session"),
]
faults = st.fixed_dictionaries({name: st.sampled_from([0.0, 0.0, 0.1, 0.3]) for name in CALM})
POSE = PoseTag(np.array([1.0, 0, 0, 0]), np.zeros(3), np.eye(6), np.array([1.0, 0, 0]), False, True)


class End:
    """One end of the wire: what is written stands in `sent` packet by packet."""

    baud_rate = 3_000_000
    bytes_read = bytes_written = hang_ups = 0
    connected = ready = True
    losses: dict[str, int] = {}  # noqa: RUF012

    def __init__(self):
        self.sent: list[bytes] = []
        self.incoming: list[bytes] = []

    def write(self, data: bytes) -> None:
        self.sent.append(data)

    def exchange(self, timeout_s: float) -> bytes:
        data, self.incoming = b"".join(self.incoming), []
        return data


class FrameModel(RuleBasedStateMachine):
    """Flight, ground, the wire between them, and what is known of every frame that was captured."""

    rules_run = 0

    @initialize(with_key=st.booleans(), seed=st.integers(0, 1 << 16))
    def begin(self, with_key: bool, seed: int) -> None:
        shared = Path("/dev/shm")
        self.folder = Path(tempfile.mkdtemp(dir=shared if shared.is_dir() else None))
        (self.folder / "mission.yaml").write_text(MISSION_TEXT)
        self.mission = load_mission(self.folder / "mission.yaml")
        self.key_file = self.folder / "mission.key"
        self.key: Key = make_key(self.key_file)
        self.random, self.now_s, self.shift_ns = random.Random(seed), 0.0, 0
        self.with_key = with_key  # whether the ground's answers are authenticated
        self.captured: dict[Path, dict[int, str]] = {}
        self.numbers: list[int] = []
        self.commands: dict[tuple[Path, int], str] = {}
        self.sessions: list[Path] = []
        self.frames_made = self.last_counter = 0
        self.flight = self.keys = None
        self._watch()
        self.new_session()
        self.new_store()

    def _watch(self) -> None:
        """Note every transfer number that is given, and shift the wall clock."""
        self.patched = (TransferNumbers.give, time.time_ns)
        give, time_ns = self.patched

        def noted(numbers: TransferNumbers, in_flight) -> int:
            self.numbers.append(give(numbers, in_flight))
            return self.numbers[-1]

        TransferNumbers.give = noted
        time.time_ns = lambda: time_ns() + self.shift_ns

    # ---- what may happen ----

    @rule(count=st.integers(1, 8))
    def capture(self, count: int) -> None:
        for _ in range(count):
            frame_id = self.capturing.next_frame_id
            self.frames_made += 1
            dn = np.random.default_rng(self.frames_made).integers(
                0, 4096, (SIDE_PX, SIDE_PX), dtype=np.uint16
            )
            utc_ns = self.mission.orbit.start_utc_ns + self.frames_made
            frame = Frame(frame_id, self.frames_made, 0, 1, 1e-4, utc_ns, POSE, dn, 12, 64.0, 0)
            try:
                stored = self.capturing.put(frame)
            except StoreFull:
                continue
            self.captured[self.capturing.folder][frame_id] = stored.sha256

    @rule(turns=st.sampled_from([5, 20, 100, 200]), wire=faults)
    def run(self, turns: int, wire: dict[str, float]) -> None:
        for _ in range(turns):
            self.now_s += STEP_S
            if round(self.now_s / STEP_S) % 5 == 0:
                self.flight.look(self.now_s)
            self.flight.turn(self.now_s)
            self.flight.fill(self.now_s)
            self._carry(self.down, self.up, wire)
            self.ground.turn(self.now_s)
            self._carry(self.up, self.down, wire)

    def _carry(self, source: End, target: End, wire: dict[str, float]) -> None:
        """Bring packets to the other end; a late one stays for the next time and so is overtaken."""
        packets, source.sent = source.sent, []
        for packet in packets:
            if self.random.random() < wire["loss"]:
                continue
            if self.random.random() < wire["flip"]:
                at = self.random.randrange(len(packet))
                packet = packet[:at] + bytes([packet[at] ^ 1 << self.random.randrange(8)]) + packet[at + 1 :]
            if self.random.random() < wire["late"]:
                source.sent.append(packet)
                continue
            target.incoming += [packet] * (2 if self.random.random() < wire["again"] else 1)

    def outage(self) -> None:
        for _ in range(self.random.randrange(1, 12)):
            self.run(3, CALM | {"loss": 1.0})
            self.now_s += 0.5

    def pause_of_hours(self) -> None:
        self.now_s += 4000.0

    def step_of_the_clock(self) -> None:
        self.shift_ns += self.random.choice([-1000, -1, 1, 1000]) * 3_600_000_000_000

    def kill_flight(self) -> None:
        self._start_flight(self.flight_folder)

    def kill_ground(self) -> None:
        self._start_ground(self.sessions[-1])

    def flip_and_restart(self) -> None:
        """One bit of what transfers and commands depend on flips on the disk while flight is off."""
        files = [self.flight_folder / name for name in ("transaction", "store.json", "store.json.copy")]
        received = self.key_file.with_name(self.key_file.name + ".received")
        path = self.random.choice([*files, received, copy_of(received)])
        if path.exists():
            with lock_store(self.flight_folder):
                content = bytearray(path.read_bytes())
                bit = self.random.randrange(8 * len(content))
                content[bit // 8] ^= 1 << bit % 8
                path.write_bytes(content)
        self.kill_flight()

    def new_store(self) -> None:
        """The disk on board is exchanged: frames are numbered from 0 again, in the same session."""
        folder = self.folder / f"store{len(self.captured)}"
        folder.mkdir()
        self.captured[folder] = {}
        save_settings(folder, Settings("oldest"))
        self._start_flight(folder)
        self.capture(3)

    def new_session(self) -> None:
        self.sessions.append(self.folder / f"session{len(self.sessions)}")
        self._start_ground(self.sessions[-1])

    @rule(words=st.sampled_from(["ping", "resend all", "resend 0 3", "arm delete", "delete 0 1"]))
    def command(self, words: str) -> None:
        parsed, _ = parse_command(*(lambda name, *rest: (name, list(rest)))(*words.split()))
        counter = submit(self.sessions[-1], self.key_file, parsed, None, 1e6)
        self.commands[self.sessions[-1], counter] = parsed.name

    def counter_set_back(self) -> None:
        """Somebody restores the ground's counter from a backup."""
        sent = self.key_file.with_name(self.key_file.name + ".sent")
        counter = self.key.parse_counter(sent.read_text(), str(sent))
        for each in (sent, copy_of(sent)):
            each.write_text(self.key.counter_text(max(counter - self.random.randrange(1, 6), 0)))

    @rule(what=st.sampled_from(EVENTS))
    def event(self, what: str) -> None:
        getattr(self, what)()

    def _start_flight(self, folder: Path) -> None:
        if self.flight is not None:
            self.flight.stop()
            self.keys.close()
        self.flight_folder = folder
        self.capturing = FrameStore(folder, QUOTA_BYTES, "drop-oldest")
        self.keys, self.down = KeyRing([self.key_file] if self.with_key else []), End()
        if self.with_key:
            (own,) = self.keys.counters  # also where a file of its counter was damaged
            assert own.last >= self.last_counter, "the counter of commands has fallen"
            self.last_counter = own.last
        self.flight = _Downlink(
            FrameStore(folder),
            self.down,
            self.mission,
            self.keys,
            dict,
            self.clock_s,
            1,
            EventLog(clock_s=self.clock_s),
        )

    def _start_ground(self, session: Path) -> None:
        self.up = End()
        key = self.key if self.with_key else None
        self.ground = _Ingest(
            self.up, SessionWriter(session, self.mission), self.mission, lambda event: None, None, key
        )

    def clock_s(self) -> float:
        return self.now_s

    # ---- what must hold ----

    @invariant()
    def every_frame_is_accounted_for_once(self) -> None:
        if not hasattr(self, "ground"):
            return
        FrameModel.rules_run += 1
        received = {
            json.loads(line)["sha256"]
            for session in self.sessions
            if (session / "frames.jsonl").exists()
            for line in (session / "frames.jsonl").read_bytes().splitlines()
        }
        folder, captured = self.flight_folder, self.captured[self.flight_folder]
        index = (
            [json.loads(line) for line in (folder / "index.jsonl").read_bytes().splitlines()]
            if captured
            else []
        )
        dropped = {entry["frame_id"]: entry["dropped"] for entry in index if "dropped" in entry}
        on_board = {int(path.stem) for path in (folder / "frames").glob("*.obf")}
        waiting = {int(path.name) for path in (folder / "outbox").iterdir()}
        arrived = {frame_id for frame_id, sha256 in captured.items() if sha256 in received}
        lost = {frame_id for frame_id, reason in dropped.items() if reason == "oldest"}
        deleted = {frame_id for frame_id, reason in dropped.items() if reason == "command"}
        assert on_board - waiting <= arrived, "left the outbox, and is not in a session"
        assert {n for n, reason in dropped.items() if reason == "delivered"} <= arrived
        assert set(captured) == on_board | arrived | lost | deleted, "not accounted for"
        assert not lost & (arrived | on_board), "counted as lost, and there"

    @invariant()
    def counters_never_fall(self) -> None:
        if getattr(self, "with_key", False):
            (own,) = self.keys.counters
            assert own.last >= self.last_counter, "the counter of commands has fallen"
            self.last_counter = own.last

    @invariant()
    def numbers_never_come_twice(self) -> None:
        assert len(set(getattr(self, "numbers", []))) == len(getattr(self, "numbers", []))

    @invariant()
    def reports_are_of_their_command(self) -> None:
        for (session, counter), name in getattr(self, "commands", {}).items():
            done = outcome(session, counter)
            if done is not None and done["command"] == name and done["stage"] == "completed":
                assert RESULTS[name] in done["text"]

    def teardown(self) -> None:
        """On a calm wire all arrives in the end, but for what a session rejects: another frame has its number."""
        if not hasattr(self, "ground"):
            return
        try:
            self.new_session()
            for turn in range(1000):
                if turn % 200 == 0:  # an answer that was late on the wire may have begun another pause
                    self.pause_of_hours()
                self.run(10, CALM)
                if not self.flight.waiting:
                    break
            self.every_frame_is_accounted_for_once()
            assert not self.flight.waiting, "a calm link does not empty the outbox"
        finally:
            self.flight.stop()
            self.keys.close()
            TransferNumbers.give, time.time_ns = self.patched
            shutil.rmtree(self.folder)


def run_model(examples: int, steps: int) -> int:
    """Run the model and return how many rules were run and checked.

    Raises:
        AssertionError: an invariant does not hold; the message has the rules that show it.
    """
    FrameModel.rules_run = 0
    made = settings(max_examples=examples, stateful_step_count=steps, deadline=None, print_blob=True)
    run_state_machine_as_test(FrameModel, settings=made)
    return FrameModel.rules_run
