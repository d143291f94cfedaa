"""Processes for many trainings: a cluster of the command's own on this machine, or one that a scheduler leads."""

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask.config
import numpy as np
import psutil
import torch
from distributed import Client, LocalCluster
from distributed.security import Security

from ground.session.folder import FrameRecord, Session, open_session
from obbgs_base.errors import ObbgsError, reason
from obbgs_core.compact import Compact, held
from obbgs_core.methods.presets import preset

log = logging.getLogger(__name__)
BASE_MB = 600.0  # a process with PyTorch before any work
# of a Gaussian's 59 numbers: parameters, gradient and two moments, and what growth and checkpoints copy of them
GAUSSIAN_MB = 4e-6 * 59 * 8
VALUE_BYTES = 6  # of a frame whose picture is held as it is: readings, averaged images, silhouettes
COMPACT_SHARE = 1.55  # of what a large frame is held in: what the start takes beside it as well
WORKING_BYTES = 58  # of a pixel of the one frame that the start is looking at
LOOKED_AT = 8  # frames of a session, spread evenly, of which one tells what it is held in
USED_MEMORY = 0.9  # of what is available: the rest is for everybody else
CONFIG = {
    "distributed.scheduler.worker-ttl": "1 hour",  # a busy worker of low priority may be silent for minutes
    "distributed.worker.memory.target": False,  # results are single rows: nothing of dask's own to spill
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.admin.tick.limit": "1 hour",  # no warnings about a loop that waits for a computation
    "distributed.comm.timeouts.connect": "60s",
    "distributed.comm.timeouts.tcp": "600s",
}


class ClusterError(ObbgsError):
    """There are no processes, or not enough memory; the message says why and what to do."""


def needed_mb(frames_mb: float, gaussians: int) -> float:
    """Return the memory that a training's process is estimated to need, beside frames that take so much."""
    return BASE_MB + frames_mb + GAUSSIAN_MB * gaussians


def frames_mb(session: Session) -> float:
    """Return the memory that a session's frames are estimated to take in a training.

    Large ones take what shows in them (`obbgs_core.compact`): some are read, of those that are not damaged.

    Raises:
        MissingFrames, SessionCorrupt: a picture is not there, or none of the camera's.
    """
    pixels = session.camera.width * session.camera.height

    def kept(record: FrameRecord) -> float:
        picture = held(torch.from_numpy(session.dn(record).astype(np.float32)))
        if isinstance(picture, Compact):
            return COMPACT_SHARE * picture.inside.nbytes
        return VALUE_BYTES * pixels * session.camera.channels

    evenly = session.frames[:: max(1, len(session.frames) // LOOKED_AT)]
    some = [record for record in evenly if session.is_whole(record)]
    of_each = sum(map(kept, some)) / max(1, len(some))
    return 1e-6 * (WORKING_BYTES * pixels + of_each * len(session.frames))


def training_mb(session_dir: Path, method: str, changes: dict[str, Any]) -> float:
    """Return the memory that a session's training is estimated to need.

    Raises:
        SessionError, ValueError: as in `open_session` and `preset`.
    """
    session, config = open_session(session_dir), preset(method, changes)
    return needed_mb(frames_mb(session), config.growth.max_gaussians)


@contextlib.contextmanager
def connected(
    scheduler: str | None, workers: int | None, needs_mb: list[float], preload: str
) -> Iterator[Client]:
    """Give a client of the scheduler at a URL, or of a cluster of this machine's own for the time of the block.

    Whoever reaches a scheduler has its workers run code. The own cluster therefore takes only connections with the
    credentials that it makes for itself, and a scheduler without TLS is warned of.

    Args:
        scheduler: such as tls://10.0.0.1:8786; its workers must see the folders of the command under the same paths.
        workers: processes of the own cluster, of one thread each; None: one a core. Fewer are started where the
            memory does not hold so many of the largest training.
        needs_mb: what each training is estimated to need.
        preload: the module that each process of the own cluster loads; its `dask_setup` is called.

    Raises:
        ClusterError: the scheduler does not answer, or the memory does not hold the largest training.
    """
    logging.getLogger("distributed").setLevel(
        logging.CRITICAL
    )  # its warnings are about nothing that a user can change
    with dask.config.set(CONFIG):
        if scheduler is not None:
            if not scheduler.startswith("tls://"):
                log.warning(
                    "whoever reaches the scheduler %s has its workers run code as their user: it should stand at tls://",
                    scheduler,
                )
            try:
                client = Client(scheduler, timeout="30s", set_as_default=False)
            except (OSError, ValueError, TypeError) as error:
                raise ClusterError(f"no dask scheduler answers at {scheduler}: {reason(error)}") from error
            with client:
                yield client
            return
        count, limit_mb = share_memory(workers or os.cpu_count() or 1, needs_mb, available_mb())
        with contextlib.ExitStack() as held:
            try:
                cluster = held.enter_context(
                    LocalCluster(
                        n_workers=min(count, max(1, len(needs_mb))),
                        threads_per_worker=1,
                        memory_limit=int(limit_mb * 1e6),
                        security=Security.temporary(),
                        dashboard_address="127.0.0.1:0",
                        silence_logs=50,
                        preload=preload,
                    )
                )
                client = held.enter_context(Client(cluster, set_as_default=False))
            except TimeoutError as error:
                raise ClusterError(
                    "the processes of this command did not start in time, as on a machine that is very busy: the "
                    "same command tries again"
                ) from error
            yield client


def available_mb() -> float:
    """Return the memory that a command may use on this machine."""
    return USED_MEMORY * psutil.virtual_memory().available / 1e6


def share_memory(workers: int, needs_mb: list[float], available: float) -> tuple[int, float]:
    """Return how many workers there is memory for, and how much each of them has (MB).

    Raises:
        ClusterError: the memory does not hold the largest need.
    """
    largest = max(needs_mb, default=0.0)
    if largest > available:
        raise ClusterError(
            f"a training needs about {largest / 1e3:.1f} GB of memory, {available / 1e3:.1f} GB are available: give a "
            "smaller budget of Gaussians, or run on another machine with --workers URL"
        )
    count = max(1, min(workers, int(available // max(largest, 1.0))))
    return count, available / count


def fitting_hosts(client: Client, need_mb: float) -> list[str] | None:
    """Return the hosts whose workers have the memory that a training needs; None where all have, or do not say.

    Raises:
        ClusterError: no worker has it, or the scheduler is lost.
    """
    found = _workers(client)
    limits_mb = {address: info.get("memory_limit") or float("inf") for address, info in found.items()}
    fitting = [address for address, limit in limits_mb.items() if limit >= need_mb * 1e6]
    if found and not fitting:
        raise ClusterError(
            f"a training needs about {need_mb / 1e3:.1f} GB of memory, the largest worker has "
            f"{max(limits_mb.values()) / 1e9:.1f} GB: start one with more (dask worker --memory-limit), or give a "
            "smaller budget of Gaussians"
        )
    if len(fitting) == len(found):
        return None
    return sorted({address.rpartition("//")[2].rpartition(":")[0] for address in fitting})


def threads_of(client: Client) -> int:
    """Return how many trainings the workers take at once.

    Raises:
        ClusterError: the scheduler is lost.
    """
    return sum(info["nthreads"] for info in _workers(client).values())


def _workers(client: Client) -> dict[str, dict]:
    try:
        return client.scheduler_info(n_workers=-1)["workers"]
    except (KeyError, OSError) as error:  # of a lost one nothing is known
        raise ClusterError("the scheduler was lost; the same command goes on from what is saved") from error
