"""What an uplinked model file may hold: standard operators, all its data inside, and what triage asks of it.

The ground looks before it sends a file, the spacecraft before it runs one. No onnx package is needed.

onnxruntime alone would not do: it runs its own com.microsoft operators, declared or not, and reads the other files that
a tensor names.
"""

from collections.abc import Iterator

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
MODEL_METADATA = 14  # metadata_props of a model: entries of a key (1) and a value (2)
SENSOR_METADATA = ("black_dn", "white_dn", "dn_per_radiance_s", "electrons_per_dn", "read_noise_dn")
NODE_DOMAIN, TENSOR_EXTERNAL_DATA, TENSOR_DATA_LOCATION = 7, 13, 14


class ModelUnfit(ValueError):
    """A file is no model for the spacecraft; the message goes on after the file's name."""


def check_model(content: bytes) -> dict[str, str]:
    """Check every node and tensor of an ONNX file; return its metadata.

    Raises:
        ModelUnfit: too large, not ONNX, an operator that is not standard, or data outside the file.
    """
    if len(content) > MAX_MODEL_BYTES:
        raise ModelUnfit(f"has {len(content)} bytes; the limit is {MAX_MODEL_BYTES}")
    metadata: dict[str, str] = {}
    pending = [("model", memoryview(content))]
    try:
        while pending:
            kind, message = pending.pop()
            for number, value in _fields(message):
                if kind == "node" and number == NODE_DOMAIN and value not in STANDARD_DOMAINS:
                    domain = value if isinstance(value, int) else bytes(value[:40])
                    raise ModelUnfit(f"has an operator that is not standard ONNX: {domain}")
                if kind == "tensor" and number in (TENSOR_EXTERNAL_DATA, TENSOR_DATA_LOCATION) and value != 0:
                    raise ModelUnfit("keeps tensors outside the file")
                if kind == "model" and number == MODEL_METADATA and not isinstance(value, int):
                    entry = {field: v for field, v in _fields(value) if not isinstance(v, int)}
                    metadata[_text(entry.get(1))] = _text(entry.get(2))
                inner = ONNX_FIELDS.get(kind, {}).get(number)
                if inner:
                    if isinstance(value, int):
                        raise ValueError(f"field {number} of a {kind} must be a message")
                    pending.append((inner, value))
    except ModelUnfit:
        raise
    except (IndexError, ValueError) as error:
        raise ModelUnfit("is not an ONNX file") from error
    return metadata


def check_for_triage(content: bytes) -> None:
    """Check that a file is a model of the ground's that triage can use, as far as its bytes say.

    Raises:
        ModelUnfit: as of `check_model`, or it lacks the picture's size or the sensor.
    """
    metadata = check_model(content)
    missing = [name for name in ("width", "height", *SENSOR_METADATA) if name not in metadata]
    if missing:
        raise ModelUnfit(f"is no model.onnx of a run: it does not say {', '.join(missing[:3])}")


def _text(value: memoryview | None) -> str:
    return bytes(value or b"").decode(errors="replace")


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
