"""The process in which a model from the ground is loaded and run, under limits of memory and time.

A model can ask for any memory and any time with operators that are all in order. So it never runs in the process that
has the link: it runs here, and here only. `flightsw/triage/worker.py` starts this process, writes it one line of JSON
for each thing to do, reads one line for each answer, and kills it when an answer does not come in time. Where the
worker's own process is gone, the end of the input or the limit of processor time ends this one.
"""

import contextlib
import dataclasses
import json
import math
import os
import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flightsw.errors import TriageError, TriageMissing
from flightsw.icd.frame import decode_frame
from flightsw.icd.packet import PacketError
from flightsw.triage.scores import Renderer, rank_frame
from obbgs_base.errors import reason

NICENESS = 10  # the link and capture have priority
FIRST_TO_GO = (
    "1000"  # of oom_score_adj: where the computer's memory ends, this process is killed and not flight
)
TRIED_FROM_PX_M = (
    0.1  # of the target in a pixel at the first picture: near enough for work, and not inside of it
)
TRIED_FOR_S = 1e-4  # exposure time of that picture
SUN_OF_TRIAL = (0.6, 0.0, -0.8)  # behind the camera's shoulder


@dataclass(frozen=True)
class Limits:
    """What a model may use: time to be loaded and draw its first picture, as much again for each frame, and memory.

    The memory is that beyond what Python and onnxruntime take.
    """

    time_s: float = 30.0
    memory_bytes: int = 1 << 30


@dataclass(frozen=True)
class Task:
    """The first line: the model's file, the mission's camera and the limits."""

    model: str
    width: int
    height: int
    K: list[list[float]]
    limits: Limits

    @classmethod
    def parse(cls, line: str) -> "Task":
        values = json.loads(line)
        return cls(**values | {"limits": Limits(**values["limits"])})


def main() -> None:
    """Load and try the model that the first line names, then rank the container that each other line names."""
    os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_GO)
    task = Task.parse(sys.stdin.readline())
    with contextlib.suppress(ImportError):  # the renderer says what is missing
        import onnxruntime  # noqa: F401
    limit_memory(task.limits.memory_bytes)
    _answer({})  # from here on the time counts
    limit_time(task.limits.time_s)
    K = np.array(task.K)
    try:
        renderer = tried(Path(task.model), task.width, task.height, K)
    except (TriageError, OSError, MemoryError) as error:
        problem = "it needs more memory than it may have" if isinstance(error, MemoryError) else reason(error)
        _answer({"problem": problem, "is_unfit": not isinstance(error, TriageMissing | OSError)})
        return
    _answer({"sha256": renderer.sha256.hex()})
    for line in sys.stdin:
        limit_time(task.limits.time_s)
        _answer(ranking(renderer, Path(json.loads(line)), K))


def tried(model: Path, width: int, height: int, K: np.ndarray) -> Renderer:
    """Return the renderer in a file after it has drawn one picture.

    Raises:
        TriageError: as of `Renderer`, or it renders for another camera, or no picture.
    """
    renderer = Renderer(model)
    if (renderer.width, renderer.height) != (width, height):
        raise TriageError(
            f"the model renders {renderer.width}x{renderer.height}, the camera has {width}x{height}"
        )
    world_to_camera = np.eye(4)
    world_to_camera[2, 3] = K[0, 0] * TRIED_FROM_PX_M
    renderer.expected_dn(world_to_camera, K, TRIED_FOR_S, np.array(SUN_OF_TRIAL))
    return renderer


def ranking(renderer: Renderer, container: Path, K: np.ndarray) -> dict[str, Any]:
    """Return what the model makes of a stored frame, as `Ranked`, or why it cannot be ranked."""
    try:
        ranked = rank_frame(renderer, decode_frame(container.read_bytes()), container, K)
    except (PacketError, OSError, TriageError, MemoryError) as error:
        return {"problem": reason(error)}
    return dataclasses.asdict(ranked) | {"path": str(container)}


def limit_memory(memory_bytes: int) -> None:
    """Let this process take so much more memory than it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    address_space = pages * os.sysconf("SC_PAGE_SIZE") + memory_bytes
    _lower(resource.RLIMIT_AS, address_space)
    _lower(resource.RLIMIT_CORE, 0)


def limit_time(time_s: float) -> None:
    """Have the system end this process after so many more seconds of processor time, and up to two."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    soft_s = math.ceil(usage.ru_utime + usage.ru_stime + time_s) + 1
    _lower(resource.RLIMIT_CPU, soft_s)


def _lower(which: int, limit: int) -> None:
    """Set a limit of this process, below the one that it has been given."""
    _, hard = resource.getrlimit(which)
    resource.setrlimit(which, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _answer(values: dict[str, Any]) -> None:
    os.write(sys.stdout.fileno(), json.dumps(values).encode() + b"\n")


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):  # nobody waits for the answer any more
        main()
