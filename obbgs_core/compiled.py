"""The compiled module: whether it is installed, which of its kernels runs, and which tensors it accepts.

Without the module everything runs in plain PyTorch. The module holds each kernel compiled for several instruction sets
and takes the best that the processor runs; the environment variable OBBGS_KERNEL chooses another: avx512, avx2 or
portable.
"""

import contextlib
import functools
import os
import threading
import weakref
from collections.abc import Iterator

import torch
from torch import Tensor

try:
    from obbgs_core import _rasterizer
except ImportError:
    _rasterizer = None


def module_for(*tensors: Tensor):
    """Return the compiled module if it is installed and all tensors, if any, are float32 on the CPU; else None.

    Raises:
        ValueError: OBBGS_KERNEL names no kernel that this processor runs.
    """
    if _rasterizer is None or not all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors):
        return None
    kernels()
    return _rasterizer


@functools.cache
def kernels() -> tuple[str, ...]:
    """Return the kernels that this processor runs, the one in use first; empty without the compiled module.

    Raises:
        ValueError: OBBGS_KERNEL names none of them.
    """
    if _rasterizer is None:
        return ()
    best_first = _rasterizer.kernels()
    chosen = os.environ.get("OBBGS_KERNEL") or best_first[0]
    if chosen not in best_first:
        raise ValueError(
            f"OBBGS_KERNEL must be one of {', '.join(best_first)} on this processor, got {chosen!r}; "
            "without it the first of them is used"
        )
    _rasterizer.use_kernel(chosen)
    return (chosen, *(name for name in best_first if name != chosen))


_threads = 0  # of the compiled module; 0: as many as PyTorch's
_outer = 0  # PyTorch's before it was held to one
_held = 0  # by so many
_lock = threading.RLock()


def threads() -> int:
    """Return on how many threads the compiled module runs: as many as PyTorch, but for `torch_on_one_thread`."""
    return _threads or torch.get_num_threads()


@contextlib.contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let PyTorch's operations run on one thread in a block, the compiled module on as many as PyTorch had before.

    A step of a training takes hundreds of operations on some ten thousand numbers each, which are over before another
    thread is awake: with two threads waking them a step took up to a third longer than with one. The compiled module
    decides loop by loop whether there is enough for another thread. Both numbers are those of the whole process: where
    two of its threads train at once, one may keep the other's operations on one thread for longer, which costs time and
    changes no result.
    """
    _hold()
    try:
        yield
    finally:
        _let_go()


def keep_torch_on_one_thread(owner: object) -> None:
    """Do as `torch_on_one_thread` for as long as an object exists.

    For what another thread computes: a number of threads that changes meanwhile would change the order of its sums.
    """
    _hold()
    weakref.finalize(owner, _let_go)


def _hold() -> None:
    global _threads, _outer, _held
    with _lock:
        if _held == 0:
            _outer, _threads = torch.get_num_threads(), threads()
        _held += 1
    torch.set_num_threads(1)


def _let_go() -> None:
    global _threads, _held
    with _lock:
        _held -= 1
        if _held == 0:
            torch.set_num_threads(_outer)
            _threads = 0
