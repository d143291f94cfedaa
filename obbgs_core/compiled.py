"""The compiled module: whether it is installed, which of its kernels runs, and which tensors it accepts.

Without the module everything runs in plain PyTorch. The module holds each kernel compiled for several instruction sets
and takes the best that the processor runs; the environment variable OBBGS_KERNEL chooses another: avx512, avx2 or
portable.
"""

import functools
import os

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
