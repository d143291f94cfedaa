"""What a process that trains sets for all of itself."""

import ctypes
import os

import torch

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of mallopt(3), in malloc.h of the GNU C library
LARGEST_KEPT_BYTES = 32 * 1024**2  # the most that the library takes
KEPT_BYTES = 512 * 1024**2


def prepare_process(threads: int | None = None) -> None:
    """Let PyTorch use some threads, or OMP_NUM_THREADS, or all cores; freed memory stays with the process.

    Each step of a training frees its images and asks for new ones of the same size. The GNU C library hands memory that
    was freed back to the system, which clears it anew for the next step; that takes a tenth of a training. With another
    C library that part does nothing.

    Raises:
        ValueError: more threads than four for each core, which would only wait for each other.
    """
    cores = os.cpu_count() or 1
    # read here: PyTorch takes what it cannot use for something else without a word
    stated = (
        os.environ.get("OMP_NUM_THREADS", "").strip().partition(",")[0] if threads is None else str(threads)
    )
    threads = cores if not stated else int(stated) if stated.isdecimal() else 0
    if not 1 <= threads <= 4 * cores:
        raise ValueError(
            f"OMP_NUM_THREADS: expected 1 to {4 * cores}, four for each of this machine's {cores} cores, got {stated!r}"
        )
    torch.set_num_threads(threads)
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


def give_back() -> None:
    """Hand memory that was freed back to the system, also what lies between what is held, where the C library can.

    Between stages of work that take much memory: what one has freed is in pieces that the next does not fit into.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
