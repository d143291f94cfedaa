"""How a live reconstruction stands: status.json in the run's folder, and the same in a line of text."""

import dataclasses
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from obbgs_base.errors import counted
from obbgs_base.files import write_whole

LIVE_STATUS = "status.json"
# its number is that of the frames that have joined
LIVE_CHECKPOINT = re.compile(r"live-(\d+)\.checkpoint", re.ASCII)
State = Literal["waiting", "training", "settled", "finished"]


@dataclass(frozen=True)
class LiveStatus:
    """How a live reconstruction stands. Its model.ply is renewed whole beside it.

    state: waiting for frames; training; settled: the schedule has ended, further frames set it back; finished.
    message: what is waited for, or why the run ended; empty while it trains.
    share: of the schedule that is done, 0 to 1.
    held_out_db: mean PSNR of model.ply against the held-out frames that have come, noisy as they are; None: no model,
        or no such frame yet.
    model_step: the step that model.ply is of.
    uplink: what became of the last model that was sent up; empty: none was.
    """

    state: State
    message: str
    frames_received: int
    frames_trained: int
    frames_held_out: int
    frames_unusable: int
    step: int
    share: float
    held_out_db: float | None
    model_step: int | None
    gaussians: int | None
    chi2: float | None
    train_seconds: float
    updated_utc_ns: int
    uplink: str = ""

    def write(self, folder: Path) -> None:
        """Write status.json, whole or not at all.

        Raises:
            OSError: the disk does not take it.
        """
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / LIVE_STATUS, json.dumps(dataclasses.asdict(self), indent=2).encode() + b"\n")


def read_status(folder: Path) -> dict[str, Any]:
    """Return what a run's status.json says; {} where there is none that can be read."""
    try:
        facts = json.loads((folder / LIVE_STATUS).read_bytes())
        return dataclasses.asdict(LiveStatus(**facts))
    except (OSError, ValueError, TypeError):
        return {}


def line(facts: dict[str, Any]) -> str:
    """Return a status as `read_status` gives it in one line of text."""
    if not facts:
        return "its status cannot be read"
    if "step" not in facts:  # it has failed before it said anything
        return f"{facts['state']}; {facts['message']}"
    frames = f"{facts['frames_trained']} of {counted(facts['frames_received'], 'frame')}"
    text = f"{facts['state']}, {frames}, step {facts['step']} ({100 * facts['share']:.0f} % of the schedule)"
    if facts["gaussians"] is not None:
        text += f", {facts['gaussians']:,} Gaussians"
    if facts["held_out_db"] is not None:
        text += f", held out {facts['held_out_db']:.1f} dB"
    if facts["uplink"]:
        text += f"; model sent up: {facts['uplink']}"
    return f"{text}; {facts['message']}" if facts["message"] else text
