"""Multi-view stereo by a learned network, MVSNet, with weights that the user gives; its depth maps are fused."""

import hashlib
import math
import pickle
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from compare.opponents.depth_maps import DepthMap, FusionSettings, reconstruct_by_depth_maps
from compare.opponents.mvsnet_network import MULTIPLE, STRIDE, MvsNet
from compare.opponents.reconstruction import Reconstruction, Work
from compare.opponents.stereo_views import View, Views, depth_range_m, neighbours, prepare
from obbgs_base.errors import reason
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor


class WeightsUnfit(ReconstructionError):
    """A file of weights that is missing, damaged, or of another network."""


@dataclass(frozen=True)
class NetworkSettings:
    """How the network is applied."""

    sources: int = 4  # views with which each is matched; the paper has 4 in its evaluation
    planes: int = 64  # a multiple of 8
    # smaller pictures are enlarged by a whole number to at least this, since depths are a quarter
    longest_px: int = 400
    fusion: FusionSettings = field(default_factory=lambda: FusionSettings(least_confidence=0.8))


def reconstruct_mvsnet(
    frames: list[TrainingFrame],
    sensor: Sensor,
    loaded: tuple[MvsNet, str, str],
    work: Work,
    settings: NetworkSettings | None = None,
) -> Reconstruction:
    """Return the fused point cloud of the depth maps that a network with the given weights makes.

    Frames are brought to one exposure and clipped at full scale, since the network knows pictures from 0 to 1.

    Args:
        loaded: what `load_network` returns of a checkpoint of `MvsNet` or of MVSNet_pytorch, of any width.

    Raises:
        TooFewFrames, ReconstructionError: the frames do not fit together, or are black.
        Interrupted: `work.should_stop` returned true; the depth maps that are done are kept in `work.folder`.
    """
    settings = settings or NetworkSettings()
    network, digest, description = loaded
    views = prepare(frames, sensor, one_exposure=True)
    pairs = neighbours(views, settings.sources)
    figures: dict[str, Any] = {"weights": description, "frames_used": len(views.views)}
    return reconstruct_by_depth_maps(
        views,
        lambda i: depth_map(network, views, [i, *pairs[i]], settings),
        settings.fusion,
        f"MVSNet {digest} {settings.sources} {settings.planes} {settings.longest_px}",
        work,
        figures,
    )


def load_network(path: Path) -> tuple[MvsNet, str, str]:
    """Return the network of a checkpoint, ready to be applied, the file's SHA-256, and what the file says it is.

    Only tensors and plain values are unpickled. The width is taken from the tensors' shapes.

    Raises:
        WeightsUnfit: no such file, not a checkpoint, or tensors that are missing, left over or of other shapes.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise WeightsUnfit(
            f"{path}: cannot be read ({reason(error)}); give a checkpoint of MVSNet"
        ) from error
    try:
        kept = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError, AttributeError) as error:
        raise WeightsUnfit(
            f"{path}: expected a PyTorch checkpoint of tensors, got a file that cannot be read as one"
        ) from error
    state = kept.get("model", kept) if isinstance(kept, dict) else None
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise WeightsUnfit(
            f'{path}: expected a dictionary of tensors, or one under the key "model", got {_kind(kept)}'
        )
    # the public version saves a network split over several processors, and a refinement that it does not evaluate
    state = {str(name).removeprefix("module."): value for name, value in state.items()}
    state = {name: value for name, value in state.items() if not name.startswith("refine_network.")}
    first = state.get("feature.conv0.conv.weight")
    if first is None or first.ndim != 4 or first.shape[0] < 1:
        raise WeightsUnfit(f"{path}: has no tensor feature.conv0.conv.weight [width, 3, 3, 3]: not an MVSNet")
    network = MvsNet(width=first.shape[0])
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        raise WeightsUnfit(f"{path}: does not fit an MVSNet of width {first.shape[0]}: {error}") from error
    if not all(torch.isfinite(value).all() for value in state.values()):
        raise WeightsUnfit(f"{path}: holds a value that is not finite")
    description = kept.get("description") if isinstance(kept, dict) else None
    digest = hashlib.sha256(content).hexdigest()
    return network.eval(), digest, str(description) if description else f"{path.name}, width {first.shape[0]}"


def _kind(value: object) -> str:
    if isinstance(value, dict):
        return f"one with the keys {', '.join(sorted(map(str, value))[:5])}"
    return f"a {type(value).__name__}"


@torch.no_grad()
def depth_map(network: MvsNet, views: Views, chosen: list[int], settings: NetworkSettings) -> DepthMap:
    """Return the depths of the first chosen view's lit pixels, at the size of its picture."""
    view = views.views[chosen[0]]
    empty = torch.zeros(view.lit.shape)
    if len(chosen) < 2:
        return DepthMap(empty, empty)
    enlarged = max(1, math.ceil(settings.longest_px / max(view.lit.shape)))
    inputs = [network_input(views.views[i], enlarged) for i in chosen]
    near_m, far_m = depth_range_m(view, views.radius_m)
    depth_m, confidence = network(inputs, torch.linspace(near_m, far_m, settings.planes))
    depth_m, confidence = (_at_pixels(image, view, enlarged) for image in (depth_m, confidence))
    return DepthMap(torch.where(view.lit, depth_m, 0), torch.where(view.lit, confidence, 0))


def network_input(view: View, enlarged: int = 1) -> View:
    """Return a view as the network sees it: three channels, 0 to 1, enlarged, and black to a multiple of 32 px."""
    image = view.image.clamp(0, 1)
    image = image[:3] if len(image) >= 3 else image[:1].expand(3, -1, -1)
    image = F.interpolate(image[None], scale_factor=enlarged, mode="bilinear", align_corners=False)[0]
    down, right = (-size % (STRIDE * MULTIPLE) for size in image.shape[1:])
    K = view.K.clone()
    K[:2] *= enlarged
    return replace(view, image=F.pad(image, (0, right, 0, down)), K=K)


def _at_pixels(image: Tensor, view: View, enlarged: int) -> Tensor:
    """Return values [h, w] of the network's output at the pixels of a view [H, W], the nearest to each."""
    rows, columns = (
        (((torch.arange(size) + 0.5) * enlarged - 0.5) / STRIDE).round().long().clamp(max=most - 1)
        for size, most in zip(view.lit.shape, image.shape, strict=True)
    )
    return image[rows][:, columns]
