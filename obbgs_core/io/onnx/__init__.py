"""The model as an ONNX renderer of standard operators: a view and an exposure time in, the expected image out.

The graph is the rasterizer of `render`, written for a runtime: it projects all Gaussians, sorts them by depth once,
and composites in each 16x16 tile only the Gaussians that reach it. No tile has a fixed capacity, so none can overflow;
memory grows with the fullest tile, about 4 kB for each Gaussian in it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper

from obbgs_base.files import write_whole
from obbgs_core.errors import ExportError
from obbgs_core.io.onnx.composite import composite
from obbgs_core.io.onnx.graph import Graph
from obbgs_core.io.onnx.projection import camera_view, project
from obbgs_core.io.onnx.radiance import radiance_towards
from obbgs_core.model.footprint import variance_px2
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.reference import MIN_DEPTH_ALPHA
from obbgs_core.sensor import Sensor

OPSET = 18
IR_VERSION = 9
FORMAT_VERSION = "1"
MAX_PROTOBUF_BYTES = 2**31 - 1  # the limit of a protobuf message, and so of an ONNX file


@dataclass(frozen=True)
class Exported:
    path: Path
    size_bytes: int
    gaussians: int


def export_onnx(
    gaussians: Gaussians,
    sensor: Sensor,
    path: Path,
    width: int,
    height: int,
    exposures_s: Sequence[float],
    psf_sigma_px: float | None = None,
    background: float = 0.0,
) -> Exported:
    """Write the renderer; the file appears whole or not at all.

    Inputs of the graph, all float32: world_to_camera [4, 4], K [3, 3] px, exposure_time_s [] and, if the model's
    radiance depends on it, sun_dir [3] (unit, body frame, towards the Sun). Outputs: image [H, W, C], expected digital
    numbers over full scale, 0..1; alpha [H, W]; depth [H, W] m (0 where nothing is drawn). Under Lambert's law the
    graph renders the Sun's shadow map first.

    Args:
        width: of the rendered image, px.
        height: the same.
        exposures_s: the exposure times of the training frames; their range goes into the metadata.
        psf_sigma_px: the point spread of the camera that is rendered, px; None: the model's estimate.
        background: radiance of what is seen where no Gaussian is.

    Raises:
        ExportError: the model is empty, not finite or too large for an ONNX file, or there is no exposure time.
    """
    _check(gaussians, exposures_s)
    footprint_px2 = float(variance_px2(gaussians, psf_sigma_px))
    graph = _graph(gaussians, sensor, width, height, footprint_px2, background)
    size_bytes = sum(len(constant.raw_data) for constant in graph.constants)
    if size_bytes > MAX_PROTOBUF_BYTES:
        raise ExportError(
            f"{len(gaussians):,} Gaussians make an ONNX file of {size_bytes:,} bytes; the format ends at "
            f"{MAX_PROTOBUF_BYTES:,}: train with a smaller budget"
        )
    channels, turns_with_sun = gaussians.sh.shape[2], gaussians.shading != "view"
    model = _model(graph, width, height, channels, turns_with_sun)
    facts = {
        **vars(sensor),
        "width": width,
        "height": height,
        "gaussians": len(gaussians),
        "footprint": gaussians.footprint,
        "footprint_px2": footprint_px2,
        "exposure_min_s": min(exposures_s),
        "exposure_max_s": max(exposures_s),
        "format": FORMAT_VERSION,
    }
    helper.set_model_props(model, {name: str(value) for name, value in facts.items()})
    onnx.checker.check_model(model, full_check=True)
    content = model.SerializeToString()
    write_whole(path, content)
    return Exported(path, len(content), len(gaussians))


def _check(gaussians: Gaussians, exposures_s: Sequence[float]) -> None:
    if len(gaussians) == 0:
        raise ExportError("there is no Gaussian to export")
    if not exposures_s or not all(math.isfinite(e) and e > 0 for e in exposures_s):
        raise ExportError(f"exposures_s must be positive times, got {list(exposures_s)}")
    for name, tensor in {**gaussians.tensors(), "scales": gaussians.scales}.items():
        if not tensor.isfinite().all():
            raise ExportError(f"{name} holds values that are not finite")


def _graph(
    gaussians: Gaussians, sensor: Sensor, width: int, height: int, footprint_px2: float, background: float
) -> Graph:
    """Return the nodes from the inputs to the outputs."""
    graph = Graph()
    camera = camera_view(graph, width, height, footprint_px2)
    projected = project(graph, gaussians, camera)
    radiance = radiance_towards(graph, gaussians, camera)
    channels = gaussians.sh.shape[2]
    ones = np.ones((len(gaussians), 1), dtype=np.float32)  # blended like a colour, they give alpha
    depth = graph.op("Unsqueeze", projected.depth, graph.ints(1))
    features = graph.op("Concat", radiance, depth, ones, axis=1)
    composed = composite(graph, projected, features, channels + 2, camera)
    _name_outputs(graph, composed, channels, sensor, background)
    return graph


def _name_outputs(g: Graph, composed: str, channels: int, sensor: Sensor, background: float) -> None:
    """Turn the composited features [channels + 2, H, W] into the outputs; here the exposure time is applied."""
    parts = []
    for start, end in ((0, channels), (channels, channels + 1), (channels + 1, channels + 2)):
        parts.append(g.op("Slice", composed, g.ints(start), g.ints(end), g.ints(0)))
    radiance, depth_sum, alpha = parts
    if background:
        radiance = g.op("Add", radiance, g.op("Mul", g.op("Sub", 1.0, alpha), background))
    radiance = g.op("Transpose", radiance, perm=[1, 2, 0])
    signal = g.op("Mul", radiance, g.op("Mul", "exposure_time_s", sensor.dn_per_radiance_s))
    g.op("Clip", g.op("Div", g.op("Add", signal, sensor.black_dn), sensor.white_dn), 0.0, 1.0, name="image")
    g.op("Squeeze", alpha, g.ints(0), name="alpha")
    depth = g.op("Div", depth_sum, g.op("Max", alpha, MIN_DEPTH_ALPHA))
    depth = g.op("Where", g.op("Greater", alpha, MIN_DEPTH_ALPHA), depth, 0.0)
    g.op("Squeeze", depth, g.ints(0), name="depth")


def _model(graph: Graph, width: int, height: int, channels: int, turns_with_sun: bool) -> onnx.ModelProto:
    inputs = {"world_to_camera": [4, 4], "K": [3, 3], "exposure_time_s": []}
    inputs |= {"sun_dir": [3]} if turns_with_sun else {}
    outputs = {"image": [height, width, channels], "alpha": [height, width], "depth": [height, width]}
    graph_inputs, graph_outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
        for shapes in (inputs, outputs)
    )
    return helper.make_model(
        helper.make_graph(graph.nodes, "gaussian renderer", graph_inputs, graph_outputs, graph.constants),
        producer_name="obbgs",
        ir_version=IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
