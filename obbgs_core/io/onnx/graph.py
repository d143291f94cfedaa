"""A small builder of ONNX graphs: `graph.op("Add", a, b)` adds an operator and returns the name of its output."""

import numpy as np
import onnx
from onnx import helper, numpy_helper
from torch import Tensor

Value = str | float | np.ndarray  # the name of a value, or a constant


class Graph:
    """Collects nodes and constants; equal constants are stored once."""

    def __init__(self, prefix: str = "v"):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._prefix, self._count = prefix, 0
        self._names: dict[tuple[str, tuple[int, ...], bytes], str] = {}  # of the constants, by their content

    def op(self, kind: str, *inputs: Value, outputs: int = 1, name: str = "", **attributes) -> str:
        """Add an operator and return the name of its last output, of TopK the indices."""
        names = [self.value(each) for each in inputs]
        results = [name] if name else [self._fresh_name() for _ in range(outputs)]
        self.nodes.append(helper.make_node(kind, names, results, **attributes))
        return results[-1]

    def value(self, value: Value) -> str:
        """Return the name of a value; a number becomes a float32 constant, an array a constant of its own type."""
        if isinstance(value, str):
            return value
        array = value if isinstance(value, np.ndarray) else np.asarray(value, dtype=np.float32)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._names:
            self._names[key] = self._fresh_name()
            self.constants.append(numpy_helper.from_array(array, self._names[key]))
        return self._names[key]

    def ints(self, *values: int) -> str:
        """Return the name of a constant vector of int64."""
        return self.value(np.array(values, dtype=np.int64))

    def split(self, value: str, *widths: int) -> list[str]:
        """Return the columns of a matrix in blocks of the given widths."""
        results = [self._fresh_name() for _ in widths]
        self.nodes.append(helper.make_node("Split", [value, self.ints(*widths)], results, axis=1))
        return results

    def _fresh_name(self) -> str:
        self._count += 1
        return f"{self._prefix}{self._count}"


def to_numpy(tensor: Tensor) -> np.ndarray:
    """Return a tensor as a contiguous float32 array."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)
