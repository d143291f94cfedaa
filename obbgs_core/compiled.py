"""The compiled module: whether it is installed, which of its kernels runs, and which tensors it accepts.

Without the module everything runs in plain PyTorch. The module holds each kernel compiled for several instruction sets
and takes the best that the processor runs; the environment variable OBBGS_KERNEL chooses another: avx512, avx2 or
portable.
"""

import contextlib
import functools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

import torch
from torch import Tensor

Item = TypeVar("Item")
Result = TypeVar("Result")
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
_beside = threading.local()  # has `one` in threads that work beside others: each of them is one


def threads() -> int:
    """Return on how many threads the compiled module runs: as many as PyTorch, but for `torch_on_one_thread`.

    One in a thread that works beside others, see `each`.
    """
    return 1 if hasattr(_beside, "one") else _threads or torch.get_num_threads()


@contextlib.contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let PyTorch's operations run on one thread in a block, the compiled module on as many as PyTorch had before.

    A step of a training takes hundreds of operations on some ten thousand numbers each, which are over before another
    thread is awake: with two threads waking them a step took up to a third longer than with one. The compiled module
    decides loop by loop whether there is enough for another thread. Both numbers are those of the whole process: where
    two of its threads train at once, one may set back what the other needs, which costs time and changes no result.
    """
    global _threads
    outer, torch_threads = _threads, torch.get_num_threads()
    _threads = threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torch_threads)
        _threads = outer


def each(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield work(item) of each item in their order, made on as many threads as the compiled module has.

    Each item is worked on by one thread, so that results do not depend on their number. Items are drawn in the caller's
    thread, and only about as many are under way or wait to be taken as there are threads: that bounds the memory.
    Errors are raised where their results would come.
    """
    count, gradients = threads(), torch.is_grad_enabled()
    if count == 1:
        yield from map(work, items)
        return

    def made(item: Item) -> Result:
        with torch.set_grad_enabled(gradients):  # each thread has its own
            return work(item)

    pool, waiting = _workers(count), deque[Future[Result]]()
    try:
        for item in items:
            waiting.append(pool.submit(made, item))
            if len(waiting) > count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        wait([future for future in waiting if not future.cancel()])


@functools.cache
def _workers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, "each", _start_beside)


def _start_beside() -> None:
    _start_on_one_thread()
    _beside.one = True


class Background:
    """A thread beside the caller's, for one piece of work at a time.

    PyTorch's operations run on one thread there, so that what they compute does not depend on their number. Where the
    caller has one thread only, work is done at once, on that.
    """

    def __init__(self, name: str):
        self._executor = ThreadPoolExecutor(1, name, _start_on_one_thread)

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Begin with some work, or do it at once; its errors are raised with the result, or at once."""
        if threads() > 1:
            return self._executor.submit(work)
        done: Future[Result] = Future()
        done.set_result(work())
        return done

    def close(self) -> None:
        """Wait for what is under way, and end the thread."""
        self._executor.shutdown()


def _start_on_one_thread() -> None:
    torch.get_num_threads()  # PyTorch sets a thread's number when it is first asked for; this comes before ours
    torch.set_num_threads(1)
