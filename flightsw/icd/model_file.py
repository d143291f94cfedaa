"""What an uplinked model file may hold: the operators of our renderers, all its data inside, and what triage needs.

The ground looks before it sends a file, the spacecraft before it runs one. No onnx package is needed.

onnxruntime alone would not do: it runs its own com.microsoft operators, declared or not, reads the other files that a
tensor names, and turns in a Loop for as long as the file says. Only the operators that our renderers are made of are
taken. Of those with a body it is Scan alone, not within another: it turns once for each element of a tensor. They can
still multiply their tensors beyond any memory, so the spacecraft also tries a model under limits
(`flightsw/triage/model_process.py`).
"""

from collections.abc import Iterator

MAX_MODEL_BYTES = 64 * 1024 * 1024
STANDARD_DOMAINS = (b"", b"ai.onnx")
# what `obbgs_core/io/onnx/` writes; operators that loop (Loop, If) or make much of little (Tile, Expand, Resize, Range,
# ConstantOfShape) are not among them
OPERATORS = frozenset(
    b"Abs Add And Cast Clip Concat CumSum Div Exp Floor Gather Greater GreaterOrEqual Less LessOrEqual Log MatMul Max "
    b"Min Mul Neg NonZero Pad Reciprocal ReduceL2 ReduceSum ReduceSumSquare Reshape Scan ScatterND Shape Sign Slice "
    b"Softplus Split Sqrt Squeeze Sub ThresholdedRelu TopK Transpose Unsqueeze Where".split()
)
# onnx.proto3: where operators and tensors can be, as {message: {field number: message}}
ONNX_FIELDS = {
    "model": {7: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "body", 10: "tensor", 11: "body", 22: "sparse", 23: "sparse"},
    "body": {1: "node in a body", 5: "tensor", 15: "sparse"},
    "node in a body": {5: "attribute in a body"},
    "attribute in a body": {5: "tensor", 10: "tensor", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
MODEL_METADATA = 14  # metadata_props of a model: entries of a key (1) and a value (2)
SENSOR_METADATA = ("black_dn", "white_dn", "dn_per_radiance_s", "electrons_per_dn", "read_noise_dn")
MODEL_FUNCTION, NODE_OPERATOR, NODE_DOMAIN, TENSOR_EXTERNAL_DATA, TENSOR_DATA_LOCATION = 25, 4, 7, 13, 14
ATTRIBUTE_BODIES = (6, 11)


class ModelUnfit(ValueError):
    """A file is no model for the spacecraft; the message goes on after the file's name."""


def check_model(content: bytes) -> dict[str, str]:
    """Check every node and tensor of an ONNX file; return its metadata.

    Raises:
        ModelUnfit: too large, not ONNX, an operator that our renderers do not use, or data outside the file.
    """
    if len(content) > MAX_MODEL_BYTES:
        raise ModelUnfit(f"has {len(content)} bytes; the limit is {MAX_MODEL_BYTES}")
    metadata: dict[str, str] = {}
    pending = [("model", memoryview(content))]
    try:
        while pending:
            kind, message = pending.pop()
            for number, value in _fields(message):
                _check_field(kind, number, value)
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


def _check_field(kind: str, number: int, value: memoryview | int) -> None:
    """Refuse what no renderer of ours has.

    Raises:
        ModelUnfit: says what.
    """
    if kind == "model" and number == MODEL_FUNCTION:
        raise ModelUnfit("has functions of its own; a renderer of ours has none")
    if kind.startswith("node") and number == NODE_DOMAIN and value not in STANDARD_DOMAINS:
        raise ModelUnfit(f"has an operator that is not standard ONNX: {_name(value)}")
    if kind.startswith("node") and number == NODE_OPERATOR and _is_unfit(kind, value):
        where = "" if kind == "node" else " inside a Scan"
        raise ModelUnfit(f"has an operator that no renderer of ours has{where}: {_name(value)}")
    if kind == "attribute in a body" and number in ATTRIBUTE_BODIES:
        raise ModelUnfit("has a loop in a loop; a renderer of ours has none")
    if kind == "tensor" and number in (TENSOR_EXTERNAL_DATA, TENSOR_DATA_LOCATION) and value != 0:
        raise ModelUnfit("keeps tensors outside the file")


def _is_unfit(kind: str, operator: memoryview | int) -> bool:
    if isinstance(operator, int):
        return True
    return bytes(operator) not in OPERATORS or (kind != "node" and operator == b"Scan")


def _name(value: memoryview | int) -> str:
    return str(value) if isinstance(value, int) else repr(bytes(value[:40]))


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
