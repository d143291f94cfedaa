"""A timed pass with a model while it goes on: python -m tests.benchmarks.live --session demo/session --mission FILE

The frames of a recorded session with a simulator's truth are taken once more over `--seconds`. They go through the
flight software, a simulated serial line at the mission's baud rate and `ground live`, each a process of its own. The
models that `ground live` shows are kept as they come and scored afterwards from true poses; where the tags err, after
the rigid motion that brings the poses of their training nearest to the true ones. The same pass is repeated with
`ground listen`, which trains nothing: what the link loses and how late frames come must not depend on the training.

`latency` is the time from the shutter to the session; `seconds_to_half_db` that from the last frame's arrival until the
shown model is within 0.5 dB of one trained on everything afterwards, None where it never is. The same in seconds of
the training's processor time does not depend on what else the machine does.
"""

import argparse
import contextlib
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import torch

from flightsw.icd.frame import Frame
from flightsw.icd.mission import load_mission
from flightsw.storage.store import FrameStore
from ground.run.estimated_poses import FILE as POSES
from ground.run.estimated_poses import Alignment, read_estimate
from ground.session.cameras import exposed, predicted_image, sensor_of
from ground.session.folder import Session, open_session
from ground.session.training_frames import split
from ground.session.truth import Truth
from hil.links.virtual_serial import VirtualSerial
from hil.processes import end, installed, tied, unwind_on_sigterm
from obbgs_base.errors import ObbgsError
from obbgs_core.io.ply import load_ply
from obbgs_core.score.metrics import psnr_db
from tests.benchmarks.rows import shown
from tests.session_frames import frames_of

CLOSE_DB = 0.5
POLL_S = 0.02
LIMIT_S = 3000.0  # for the model to be finished after the pass
LOSSES = (
    "packets_missing",
    "crc_errors",
    "skipped_bytes",
    "segments_resent",
    "duplicates",
    "frames_rejected",
)


@dataclass
class Flown:
    """What was seen of one pass; times in seconds since its first shutter."""

    taken_s: dict[int, float] = field(default_factory=dict)  # by frame
    arrived_s: dict[int, float] = field(default_factory=dict)
    # shown from then on, the training's processor time until then, s, and the folder with the file
    models: list[tuple[float, float, Path]] = field(default_factory=list)
    last_cpu_s: float = 0.0  # processor time of the training when the last frame had come
    losses: dict[str, int] = field(default_factory=dict)
    finished_s: float = 0.0

    def latencies_s(self) -> list[float]:
        return sorted(self.arrived_s[frame] - taken_s for frame, taken_s in self.taken_s.items())


def fly(folder: Path, frames: list[Frame], mission_path: Path, seconds: float, command: str) -> Flown:
    """Fly the pass once with `ground live` or `ground listen` on the ground, and return what was seen."""
    folder.mkdir()
    mission, session, flown = load_mission(mission_path), folder / "session", Flown()
    brackets = sorted({frame.bracket_id for frame in frames})
    due_s = {bracket: seconds * i / len(brackets) for i, bracket in enumerate(brackets)}
    store = FrameStore(folder / "store")
    with (
        VirtualSerial(mission.link.baud_rate) as line,
        open(folder / "ground.json", "w") as ground_out,
        open(folder / "log", "w") as log,
    ):
        common = ["--mission", str(mission_path), "--json"]
        receive = ["--link", line.ground_url, "--session", str(session), "--exit-after", str(len(frames))]
        send = ["downlink", "--link", line.flight_url, "--store", str(store.folder)]
        ground = subprocess.Popen(
            tied([installed("ground"), command, *receive, *common]), stdout=ground_out, stderr=log
        )
        flight = subprocess.Popen(
            tied([installed("flightsw"), *send, *common]), stdout=subprocess.DEVNULL, stderr=log
        )
        try:
            while not (session / "session.json").exists() and ground.poll() is None:
                time.sleep(POLL_S)  # both have started
            _watch(flown, ground, store, frames, due_s, session)
        finally:
            end(flight)
            end(ground)
    if ground.returncode:
        raise SystemExit(f"ground {command} failed: {(folder / 'log').read_text()[-2000:]}")
    summary = json.loads((folder / "ground.json").read_text().splitlines()[-1])
    flown.losses = {name: summary[name] for name in LOSSES}
    return flown


def _watch(
    flown: Flown,
    ground: subprocess.Popen,
    store: FrameStore,
    frames: list[Frame],
    due_s: dict[int, float],
    session: Path,
) -> None:
    """Take frames when they are due, note what arrives and which models are shown, until the ground has ended."""
    began_s, waiting, model = time.monotonic(), list(frames), session / "runs" / "live" / "model.ply"
    renewed_ns = 0
    while ground.poll() is None:
        now_s = time.monotonic() - began_s
        while waiting and due_s[waiting[0].bracket_id] <= now_s:
            frame = waiting.pop(0)
            flown.taken_s[frame.frame_id] = now_s
            store.put(frame)
        for record in _lines(session / "frames.jsonl")[len(flown.arrived_s) :]:
            flown.arrived_s[record["id"]] = time.monotonic() - began_s
            flown.last_cpu_s = _cpu_s(ground)
        if model.exists() and (stamp_ns := model.stat().st_mtime_ns) != renewed_ns:
            renewed_ns, kept = stamp_ns, store.folder.with_name(f"model-{len(flown.models)}")
            kept.mkdir()
            for path in (model, model.with_name(POSES)):
                if path.exists():
                    shutil.copy(path, kept)
            flown.models.append((time.monotonic() - began_s, _cpu_s(ground), kept))
        if now_s > LIMIT_S:
            raise SystemExit(f"the pass has not ended after {LIMIT_S:g} s")
        time.sleep(POLL_S)
    flown.finished_s = time.monotonic() - began_s


def _cpu_s(ground: subprocess.Popen) -> float:
    """Return the processor time of the processes that a process has started: of the training beside a listener."""
    with contextlib.suppress(psutil.NoSuchProcess):
        times = [child.cpu_times() for child in psutil.Process(ground.pid).children(recursive=True)]
        return sum(each.user + each.system for each in times)
    return 0.0


def _lines(path: Path) -> list[dict]:
    """Return the whole JSON lines of a growing file."""
    text = path.read_bytes() if path.exists() else b""
    return [json.loads(line) for line in text.split(b"\n")[:-1]]


def clean_psnr_db(folder: Path, session: Session) -> float:
    """Return the mean PSNR of the images of a folder's model against noiseless exposures of the held-out frames.

    They are compared from true poses, after the motion that brings the poses estimated with the model nearest to them.
    """
    gaussians, truth, sensor = load_ply(folder / "model.ply"), Truth(session), sensor_of(session.camera)
    estimate = read_estimate(folder)
    motion = None if estimate is None else Alignment.of(estimate, session, truth).motion.numpy()
    scores = []
    for held_out in split(session)[1]:
        record = truth.posed(held_out, motion)
        image = predicted_image(gaussians, session, record, sensor, record.exposure_time_s)
        true = exposed(torch.from_numpy(truth.radiance(record)[0]), sensor, record.exposure_time_s)
        scores.append(psnr_db(image, true))
    return statistics.fmean(scores)


def measure(session_dir: Path, mission: Path, seconds: float, folder: Path) -> dict:
    """Fly the pass with and without a training beside it, and return its row."""
    session = open_session(session_dir)
    frames = frames_of(session)
    alone = fly(folder / "listen", frames, mission, seconds, "listen")
    live = fly(folder / "live", frames, mission, seconds, "live")
    reconstruct = ["reconstruct", "--session", str(session_dir), "--mission", str(mission)]
    reconstruct += ["--name", "afterwards", "--overwrite"]
    began_s = time.monotonic()
    subprocess.run([installed("ground"), *reconstruct], check=True, stdout=subprocess.DEVNULL)
    afterwards_s = time.monotonic() - began_s
    afterwards_db = clean_psnr_db(session_dir / "runs" / "afterwards", session)
    scored = [(when_s, cpu_s, clean_psnr_db(path, session)) for when_s, cpu_s, path in live.models]
    last_s = max(live.arrived_s.values())
    close = next(((s, cpu_s) for s, cpu_s, db in scored if db >= afterwards_db - CLOSE_DB), None)

    def at(when_s: float) -> float | None:
        before = [db for shown_s, _, db in scored if shown_s <= when_s]
        return round(before[-1], 2) if before else None

    return {
        "target": session_dir.parent.name,
        "frames": len(frames),
        "size": f"{session.camera.width}x{session.camera.height}",
        "pass_seconds": seconds,
        "baud_rate": load_mission(mission).link.baud_rate,
        "psnr_after_a_third_db": at(seconds / 3),
        "psnr_at_last_frame_db": at(last_s),
        "psnr_live_db": round(scored[-1][2], 2) if scored else None,
        "psnr_afterwards_db": round(afterwards_db, 2),
        "seconds_to_half_db": round(max(0.0, close[0] - last_s), 1) if close else None,
        "cpu_seconds_to_half_db": round(max(0.0, close[1] - live.last_cpu_s), 1) if close else None,
        "seconds_to_finished": round(live.finished_s - last_s, 1),
        "seconds_of_afterwards": round(afterwards_s, 1),
        "models_shown": len(scored),
        **_link_figures("live", live),
        **_link_figures("alone", alone),
    }


def _link_figures(name: str, flown: Flown) -> dict:
    latencies_s = flown.latencies_s()
    return {
        f"latency_{name}_median_s": round(statistics.median(latencies_s), 2),
        f"latency_{name}_largest_s": round(latencies_s[-1], 2),
        f"losses_{name}": {key: count for key, count in flown.losses.items() if count},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="A timed pass with a model while it goes on.")
    parser.add_argument("--session", type=Path, required=True, help="a session with truth")
    parser.add_argument("--mission", type=Path, required=True, help="the mission file of its camera")
    parser.add_argument("--seconds", type=float, default=120.0, help="from the first to the last bracket")
    parser.add_argument("--json", action="store_true", help="print the row as JSON")
    arguments = parser.parse_args()
    unwind_on_sigterm()
    with tempfile.TemporaryDirectory() as name:
        try:
            row = measure(arguments.session, arguments.mission, arguments.seconds, Path(name))
        except ObbgsError as error:
            parser.exit(1, f"live: {error}\n")
    print(shown(row, "live", arguments.json))


if __name__ == "__main__":
    main()
