"""The compiled module: whether it is here, and which tensors it takes. Without it everything runs in plain PyTorch."""

import torch
from torch import Tensor

try:
    from obbgs_core import _rasterizer  # pyright: ignore[reportAttributeAccessIssue]
except ImportError:
    _rasterizer = None


def module_for(*tensors: Tensor):
    """Return the compiled module when it is installed and all tensors, if any, are float32 on the CPU, else None."""
    takes = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)
    return _rasterizer if takes else None
