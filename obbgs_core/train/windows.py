"""The part of each picture that shows the target: the rest of a picture costs time and tells a training nothing."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame
from obbgs_core.start.hull import Silhouette

# windows begin at multiples of it, so that the pixels averaged for a coarse image lie in one window
GRID_PX = 16
MARGIN_PX = 8.0  # around the start, besides what silhouettes show beyond it


def windows(frames: Sequence[TrainingFrame], means: Tensor, outlines: Mapping[int, Silhouette]) -> Tensor:
    """Return the window [F, 4] of each frame that the target lies in: left, top, right and bottom, px, int64.

    It holds the start of the training as the frame's pose projects it. All are wider by as much as the certain light
    of any silhouette goes beyond that, since a start may lack thin parts. Where a point of the start is not in front
    of the camera the window is the whole frame.

    Args:
        frames: of one size.
        means: [N, 3] m, centres of the first Gaussians, body frame.
        outlines: silhouettes of some of the frames, by their index.
    """
    height, width = frames[0].dn.shape[:2]
    reached = torch.stack([_projected(frame, means) for frame in frames])
    whole = torch.tensor([0, 0, width, height])
    outwards = torch.tensor([-1, -1, 1, 1])
    beyond = [
        ((_bounds(outline.certain) - reached[i]) * outwards).amax()
        for i, outline in outlines.items()
        if outline.certain.any()
    ]
    margin = MARGIN_PX + max([0.0, *(float(b) for b in beyond if b.isfinite())])
    begin = ((reached[:, :2] - margin) / GRID_PX).floor() * GRID_PX
    end = ((reached[:, 2:] + margin) / GRID_PX).ceil() * GRID_PX
    found = torch.cat([begin, end], dim=1).clamp(min=torch.zeros(4), max=whole[[2, 3, 2, 3]].float())
    inside = (found.isfinite().all(dim=1) & (found[:, 2:] > found[:, :2]).all(dim=1))[:, None]
    return torch.where(inside, found.nan_to_num(), whole.float()).long()


def common(windows: Tensor, width: int, height: int) -> Tensor:
    """Return windows [B, 4] of one size that hold the given ones, moved and widened as little as possible.

    They still begin at multiples of the grid, inside of pictures of that width and height, px.
    """
    size = torch.tensor([width, height])
    needed = (windows[:, 2:] - windows[:, :2]).amax(dim=0)
    common_size = size - (size - needed) // GRID_PX * GRID_PX
    begin = torch.minimum(windows[:, :2], size - common_size)
    return torch.cat([begin, begin + common_size], dim=1)


def _projected(frame: TrainingFrame, points: Tensor) -> Tensor:
    """Return the bounds [4] of the projections of points [N, 3], px; not finite where one is behind the camera."""
    pose = frame.world_to_camera
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    if not (seen[:, 2] > 0).all():
        return torch.full((4,), torch.nan)
    pixels = (seen @ frame.K.T)[:, :2] / seen[:, 2:]
    return torch.cat([pixels.amin(dim=0), pixels.amax(dim=0)])


def _bounds(mask: Tensor) -> Tensor:
    """Return the bounds [4] of the true pixels of a mask [H, W] that has some."""
    rows, columns = torch.nonzero(mask.any(dim=1))[:, 0], torch.nonzero(mask.any(dim=0))[:, 0]
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()
