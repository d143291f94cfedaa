"""What an uplinked model file may hold: standard operators, and all its data inside. No onnx package needed.

onnxruntime alone would not do: it runs its own com.microsoft operators, declared or not, and reads the other files that
a tensor names.
"""

from collections.abc import Iterator
from pathlib import Path

from flightsw.errors import TriageError

MAX_MODEL_BYTES = 64 * 1024 * 1024
STANDARD_DOMAINS = (b"", b"ai.onnx")
# onnx.proto3: where operators and tensors can be, as {message: {field number: message}}
ONNX_FIELDS = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
NODE_DOMAIN, TENSOR_EXTERNAL_DATA, TENSOR_DATA_LOCATION = 7, 13, 14


def verified_model(path: Path) -> bytes:
    """Return the bytes of an ONNX file after checking every node and tensor in it.

    Raises:
        TriageError: unreadable, too large, not ONNX, an operator that is not standard, or data outside the file.
    """
    try:
        size_bytes = path.stat().st_size
        if size_bytes > MAX_MODEL_BYTES:
            raise TriageError(f"{path} has {size_bytes} bytes; the limit is {MAX_MODEL_BYTES}")
        content = path.read_bytes()
    except OSError as error:
        raise TriageError(f"{path}: {error.strerror}") from error
    pending = [("model", memoryview(content))]
    try:
        while pending:
            kind, message = pending.pop()
            for number, value in _fields(message):
                if kind == "node" and number == NODE_DOMAIN and value not in STANDARD_DOMAINS:
                    domain = value if isinstance(value, int) else bytes(value[:40])
                    raise TriageError(f"{path} has an operator that is not standard ONNX: {domain}")
                if kind == "tensor" and number in (TENSOR_EXTERNAL_DATA, TENSOR_DATA_LOCATION) and value != 0:
                    raise TriageError(f"{path} keeps tensors outside the file")
                inner = ONNX_FIELDS.get(kind, {}).get(number)
                if inner:
                    if isinstance(value, int):
                        raise ValueError(f"field {number} of a {kind} must be a message")
                    pending.append((inner, value))
    except (IndexError, ValueError) as error:
        raise TriageError(f"{path} is not an ONNX file") from error
    return content


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Yield field number and value (an int for a varint, else the bytes) of a protobuf message.

    Raises:
        IndexError, ValueError: the bytes are no protobuf.
    """
    at = 0

    def varint() -> int:
        nonlocal at
        value = 0
        for shift in range(0, 70, 7):
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError("a varint of more than 10 bytes")

    while at < len(message):
        tag = varint() & 0xFFFFFFFF  # as onnxruntime's reader cuts it
        wire = tag & 7
        if wire == 0:
            yield tag >> 3, varint()
            continue
        length = {1: lambda: 8, 2: varint, 5: lambda: 4}.get(wire)
        if length is None:
            raise ValueError(f"wire type {wire}")
        size = length()
        if size > len(message) - at:
            raise ValueError("a field longer than its message")
        yield tag >> 3, message[at : at + size]
        at += size
