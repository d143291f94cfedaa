"""`ground live` on a real pseudo-terminal: link, training and triage as processes, and either of them killed."""

import json
import os
import re
import signal
from pathlib import Path

import pytest

from flightsw.storage.store import FrameStore
from ground.run.live.status import read_status
from ground.session.folder import open_session
from hil.links.virtual_serial import VirtualSerial
from tests.hil.test_commands_end_to_end import Tools, lines, wait_for
from tests.session_frames import frames_of

GOLDEN = Path(__file__).parents[1] / "golden"
FIRST = 27  # frames of nine brackets, the eighth of which is held out
RECONSTRUCT = (
    "reconstruct:\n  steps: 100\n  settings: {start: {count: 1000}, growth: {max_gaussians: 1200}}\n"
)
LIMIT_S = 300  # of any wait; a busy machine needs minutes where a quiet one needs seconds


def child_of(process: int) -> int | None:
    """Return the number of a process's only child that is `ground live`; None while there is none."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    lives = [int(c) for c in children if b"--listener" in Path(f"/proc/{c}/cmdline").read_bytes()]
    return lives[0] if lives else None


def is_running(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the training among Linux's /proc")
def test_a_model_while_the_frames_arrive_goes_up_by_itself_and_outlives_kills(tmp_path):
    text = (GOLDEN / "mission.yaml").read_text()
    mission = tmp_path / "mission.yaml"
    mission.write_text(re.sub(r"reconstruct:.*", RECONSTRUCT, text, flags=re.DOTALL))
    store, session, key = tmp_path / "store", tmp_path / "session", tmp_path / "mission.key"
    shot, run = frames_of(open_session(GOLDEN / "session")), session / "runs" / "live"
    for frame in shot[:FIRST]:
        FrameStore(store).put(frame)

    def telemetry() -> list[dict]:
        return [p for p in lines(session / "telemetry.jsonl") if p["packet"] == "housekeeping"]

    with VirtualSerial(921_600) as line, Tools(tmp_path) as tools:
        assert tools.run("ground", "key", key).returncode == 0
        downlink = (
            "downlink",
            "--link",
            line.flight_url,
            "--store",
            store,
            "--key",
            key,
            "--mission",
            mission,
        )
        live = (
            "live",
            "--link",
            line.ground_url,
            "--session",
            session,
            "--mission",
            mission,
        )
        live += ("--triage", "--key", key, "--exit-after", len(shot), "--json")
        flight, ground = tools.start("flightsw", *downlink), tools.start("ground", *live)
        wait_for(lambda: read_status(run).get("frames_trained") == FIRST - 3, LIMIT_S)
        wait_for(lambda: read_status(run)["uplink"].endswith("priority completed"), LIMIT_S)
        wait_for(lambda: telemetry()[-1]["priority"] == "triage", LIMIT_S)
        assert telemetry()[-1]["model"] != "00000000"
        assert (run / "model.ply").exists() and read_status(run)["held_out_db"] > 25

        first = child_of(ground.pid)
        lower = min(19, os.getpriority(os.PRIO_PROCESS, 0) + 10)
        assert first is not None and os.getpriority(os.PRIO_PROCESS, first) == lower
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: child_of(ground.pid) not in (None, first), LIMIT_S)
        log = session / "runs" / ".live.part" / "log"
        wait_for(lambda: "resumed after step" in log.read_text(), LIMIT_S)
        second = child_of(ground.pid)
        assert second is not None and ground.poll() is None
        ground.kill()
        ground.wait()
        wait_for(lambda: not is_running(second), LIMIT_S)
        assert "interrupted after step" in (session / "live.log").read_text()

        tools.stop(flight)
        for frame in shot[FIRST:]:
            FrameStore(store).put(frame)
        flight, ground = tools.start("flightsw", *downlink), tools.start("ground", *live)
        assert ground.wait(2 * LIMIT_S) == 0, (session / "live.log").read_text()
        tools.stop(flight)

    printed = lines(tmp_path / "ground-3.log")
    assert any(line["type"] == "status" and line["model"] for line in printed)
    summary = printed[-1]
    assert summary["frames_in_session"] == 48 and summary["store_failures"] == 0
    assert summary["model"]["frames_trained"] == 42 and summary["model"]["frames_held_out"] == 6
    received = {r.id: r.sha256 for r in open_session(session).frames}
    assert received == {f.frame_id: f.sha256 for f in FrameStore(store).frames}
    assert (
        json.loads((run / "status.json").read_bytes())["state"] == "finished"
        and (run / "report.html").exists()
    )
