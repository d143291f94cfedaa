"""Passes over virtual links, clean and under every fault: python -m tests.benchmarks.link

Efficiency is the frames' containers per second over what the wire can carry as payload: a byte in ten bits
on serial; on CAN 7 of 8 (FD 63 of 64) bytes of each frame, in the time that these very frames took on the bus,
stuff bits included. A fault case ends in a row only if every frame arrived once and bit-identical (sha256) and
left the outbox.
"""

import argparse
import os
import tempfile
from pathlib import Path

from hil.links.faults import STANDARD_CUT_S, STANDARD_FAULTS, Faults
from hil.processes import unwind_on_sigterm
from tests.benchmarks.rows import shown
from tests.link_trial import (
    Trial,
    TrialResult,
    noise_containers,
    run_trial,
)

TWO_PERCENT = Faults(bit_flip=0.02, duplicate=0.02, reorder=0.02)
CASES = {
    "clean": {},
    "1 % loss": {"faults": Faults(loss=0.01)},
    "10 % loss": {"faults": Faults(loss=0.1)},
    "30 % loss": {"faults": Faults(loss=0.3)},
    "flips, duplicates, reordering 2 % each": {"faults": TWO_PERCENT},
    "5 s cut": {"cut_s": 5.0},
    "standard: 2 % each of loss, flips, duplicates, reordering, and a cut": {
        "faults": STANDARD_FAULTS,
        "cut_s": STANDARD_CUT_S,
    },
    "each side killed three times": {"kills": 3},
    "each side's disk full and freed": {"full_disks": True},
    "all together": {"faults": Faults(0.1, 0.02, 0.02, 0.02), "cut_s": 5.0, "kills": 3, "full_disks": True},
}
ONE_SHOT = {  # beyond what a CAN bus does to frames whose controller repeats them
    "can": {"0.1 % loss, one-shot": 0.001, "1 % loss, one-shot": 0.01},
    "canfd": {"1 % loss, one-shot": 0.01, "10 % loss, one-shot": 0.1},
}
CLEAN_SIZE_PX = 200  # 65 kB of noise a frame, as much as a masked 800x800 one
FAULT_SIZE_PX = {"serial": 200, "canfd": 200, "can": 64}


def wire_bytes_per_s(trial: Trial, result: TrialResult) -> float:
    """Return the payload that the wire can carry."""
    if trial.link == "serial":
        return 300_000.0
    down = result.lanes["down"]
    share = 63 / 64 if trial.link == "canfd" else 7 / 8
    return share * down["bytes_out"] / down["bus_busy_s"]


def measure(case: str, trial: Trial, frames: int, size_px: int, limit_s: float) -> dict:
    """Run one pass and return its row."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = Path("mission.yaml").read_text().replace("link:\n", "link:\n  priority: oldest\n")
        for side in ("width", "height"):
            text = text.replace(f"{side}: 256", f"{side}: {size_px}")
        mission = folder / "mission.yaml"
        mission.write_text(text)
        result = run_trial(trial, folder / "pass", mission, noise_containers(frames, size_px), limit_s)
    downlink = result.flight.get("downlink", {})
    wire = wire_bytes_per_s(trial, result)
    names = ("lost", "flipped", "duplicated", "reordered", "cut", "destroyed", "overrun")
    done = {
        name: sum(
            count for key, count in lane.items() if key.split("_")[-1] == name or key == f"{name}_bytes"
        )
        for name in names
        for lane in [result.lanes["down"]]
    }
    counted = (
        "crc_errors",
        "packets_missing",
        "skipped_bytes",
        "segments_resent",
        "duplicates",
        "store_failures",
    )
    return {
        "link": trial.link,
        "case": case,
        "frames": result.frames,
        "payload_bytes": result.payload_bytes,
        "seconds": round(result.seconds, 2),
        "wire_bytes_per_s": round(wire),
        "efficiency": round(result.payload_bytes / result.seconds / wire, 3),
        "segments_resent": downlink.get("segments_resent"),
        "transfers_put_again": downlink.get("transfers_failed"),
        "flight_rss_mb": round(result.flight_rss_mb, 1),
        "flight_cpu_share": None if trial.kills else round(result.flight_cpu_share, 3),
        "done_to_the_line": {name: count for name, count in done.items() if count},
        "counted_by_ground": {
            name: count
            for name, count in (
                {n: result.ground.get(n) for n in counted} | result.ground["link_losses"]
            ).items()
            if count
        },
        "load": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Passes over virtual links, clean and under faults.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--quick", action="store_true", help="a quarter of the frames")
    parser.add_argument("--link", choices=["serial", "can", "canfd"], help="only this one")
    parser.add_argument("--clean", action="store_true", help="only the passes without faults")
    arguments = parser.parse_args()
    unwind_on_sigterm()
    frames = 16 if arguments.quick else 64
    for link in [arguments.link] if arguments.link else ["serial", "can", "canfd"]:
        cases = {case: Trial(link, seed=1, **settings) for case, settings in CASES.items()}
        for case, loss in ONE_SHOT.get(link, {}).items():
            cases[case] = Trial(link, Faults(loss=loss), one_shot=True, seed=1)
        for case, trial in cases.items():
            if case != "clean" and arguments.clean:
                continue
            size_px = CLEAN_SIZE_PX if case == "clean" else FAULT_SIZE_PX[link]
            row = measure(case, trial, frames, size_px, limit_s=1800)
            print(shown(row, "link", arguments.json), flush=True)


if __name__ == "__main__":
    main()
