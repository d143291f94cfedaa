"""Train on a device beside the processor that every machine has: python -m tests.second_device METHOD...

PyTorch takes it for a device of its own. Its tensors hold others in main memory, on which the work is done. What would
end in an error on a GPU does so here too: an operation on tensors of both (but for numbers without axes in main memory,
and indices), and NumPy. A process of its own, because PyTorch looks for devices once, at the first gradient.
"""

import sys
from typing import Any

import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from obbgs_core.methods.presets import preset
from obbgs_core.render.device import DEVICES
from obbgs_core.train.trainer import train
from tests.scenes import SENSOR, photographed, target

CHANGES = {
    "steps": 10,
    "start.count": 60,
    "growth.max_gaussians": 90,
    "growth.interval": 2,
    "device": "warp",
}
aten = torch.ops.aten
COPIES = {aten._to_copy.default, aten.copy_.default, aten._copy_from.default, aten.to.device}
INDEXED = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default}  # by indices of either


DEVICE = torch.device("privateuseone:0")


def make_device() -> None:
    """Let PyTorch know the device."""
    _setup_privateuseone_for_python_backend("second")
    _library.impl("empty_strided", _empty, "PrivateUse1")  # what `torch.tensor` calls, past every mode
    _library.impl("_copy_from", _copy, "PrivateUse1")


_library = torch.library.Library("aten", "IMPL")


def _empty(size, stride, *, dtype=None, layout=None, device=None, pin_memory=None) -> "There":
    return There(torch.empty_strided(size, stride, dtype=dtype))


def _copy(source, target, non_blocking=False):
    _raw(target).copy_(_raw(source))
    return target


class There(torch.Tensor):
    """A tensor on the second device; `raw` holds its values in main memory."""

    raw: torch.Tensor

    @staticmethod
    def __new__(cls, raw: torch.Tensor):
        layout = {"strides": raw.stride(), "storage_offset": raw.storage_offset(), "dtype": raw.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, raw.size(), **layout, device=DEVICE)  # pyright: ignore
        made.raw = raw
        return made

    def numpy(self, **_: Any):
        raise TypeError("this tensor is not in main memory")

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs)


class _Both(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs)


def _run(func, args, kwargs):
    kwargs = dict(kwargs or {})
    tensors = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, torch.Tensor)]
    there = [t for t in tensors if isinstance(t, There)]
    here = [t for t in tensors if not isinstance(t, There) and t.ndim]
    asked = kwargs.get("device")
    target = torch.device(asked) if asked is not None else None
    if there and here and func not in COPIES | INDEXED:
        raise RuntimeError(f"{func} of tensors on two devices: {[list(t.shape) for t in tensors]}")
    stays = bool(there) if target is None else target.type == DEVICE.type
    if target is not None:
        kwargs["device"] = torch.device("cpu")
    raw = func(*tree_map(_raw, args), **tree_map(_raw, kwargs))
    if func is aten.copy_.default:
        return args[0]
    wrappers = {id(t.raw): t for t in there}
    return tree_map(lambda t: _wrapped(t, wrappers), raw) if stays else raw


def _raw(value: Any) -> Any:
    return value.raw if isinstance(value, There) else value


def _wrapped(value: Any, wrappers: dict[int, There]) -> Any:
    if not isinstance(value, torch.Tensor):
        return value
    return wrappers[id(value)] if id(value) in wrappers else There(value)


def main(methods: list[str]) -> None:
    """Train by each method, and print it with the steps that were done."""
    make_device()
    wp.config.log_level = wp.LOG_WARNING  # it would print what it finds
    wp.init()
    from_torch = wp.from_torch
    wp.from_torch = lambda tensor, **given: from_torch(tensor.raw, **given)
    wp.device_from_torch = lambda _: "cpu"
    DEVICES["warp"] = DEVICE  # pyright: ignore[reportArgumentType]
    frames = photographed(target(), count=9)
    with _Both():
        try:
            torch.ones(3, device=DEVICE) + torch.ones(3)
        except RuntimeError as error:
            print(error)
        for method in methods:
            result = train(frames, SENSOR, preset(method, CHANGES), seed=1)
            assert type(result.gaussians.means) is torch.Tensor
            print(method, result.history[-1].step)


if __name__ == "__main__":
    main(sys.argv[1:])
