"""The training frames as a step takes them: averaged images, and of each the window that shows the target."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.background import Backdrop
from obbgs_core.frames import TrainingFrame, averaged, cameras_of
from obbgs_core.model.cameras import Cameras

# windows begin at multiples of it, so that the pixels averaged for a coarse image lie in one window
GRID_PX = 16
MARGIN_PX = 8.0  # around the start, besides what silhouettes show beyond it


@dataclass(frozen=True)
class Batch:
    """The frames of one step at one image scale."""

    indices: list[int]  # into the training frames
    cameras: Cameras
    dn: Tensor  # [B, H, W, C]
    exposure_time_s: Tensor  # [B, 1, 1, 1]
    averaged_pixels: int  # sensor pixels in one pixel of dn
    shown: float = 1.0  # share of the pixels of the whole frames that these images show
    # [B, H, W] share of each pixel that a silhouette shows to be empty or solid, 0 where there is none
    sky: Tensor | None = None
    solid: Tensor | None = None
    doubt: Tensor | None = None  # [B, H, W, C] deviation of the cameras' backdrop


class Batches:
    """The training frames at every image scale; each scale is averaged once, when it is first asked for.

    white_dn: the sensor's full scale.
    sky, solid: where silhouettes show empty sky, and what is solid, [H, W] bool by the frame's index; frames without a
        silhouette are not in them.
    windows: the part of each frame [F, 4] that is shown, see `windows.windows`; None: all of it.
    """

    def __init__(
        self,
        frames: list[TrainingFrame],
        white_dn: float,
        sky: dict[int, Tensor] | None = None,
        windows: Tensor | None = None,
        solid: dict[int, Tensor] | None = None,
    ):
        self.frames, self.white_dn = frames, white_dn
        self._masks = (sky or {}, solid or {})
        self._backdrops: dict[int, Backdrop] = {}
        self._behind: dict[tuple[int, str], list[Tensor]] = {}
        self._windows = windows
        self._images: dict[int, list[Tensor]] = {}
        self._shares: dict[int, tuple[list[Tensor] | None, ...]] = {}

    def cameras(self, indices: list[int]) -> Cameras:
        """Return the cameras of whole frames, with nothing behind the target."""
        return cameras_of([self.frames[i] for i in indices])

    def posed(self, frames: list[TrainingFrame]) -> "Batches":
        """Return the same images with the poses of other frames, such as refined ones."""
        other = copy.copy(self)
        other.frames = frames
        return other

    @property
    def has_backdrops(self) -> bool:
        """Whether something stands behind the target in some frames."""
        return bool(self._backdrops)

    def stand(self, backdrops: dict[int, Backdrop], sky: dict[int, Tensor]) -> None:
        """Put something behind the target in some frames, by their index, and say where they show nothing else.

        Args:
            sky: [H, W] bool, without the target; it is only used where silhouettes' sky is.
        """
        self._backdrops = backdrops
        if self._masks[0]:
            self._masks = (self._masks[0] | sky, self._masks[1])
        self._images, self._shares, self._behind = {}, {}, {}  # copies keep those that they have

    def batch(self, indices: list[int], scale: float = 1.0) -> Batch:
        """Return given frames, averaged to `scale` (1 / whole number) of their size, or windows of one size of them."""
        factor = round(1 / scale)
        if factor not in self._images:
            readings = [
                self._backdrops[i].dn if i in self._backdrops else f.dn for i, f in enumerate(self.frames)
            ]
            images = [averaged(dn, factor, self.white_dn) for dn in readings]
            if self._backdrops:
                nothing = torch.zeros_like(images[0])
                for name in ("radiance", "sigma"):
                    self._behind[factor, name] = [
                        averaged(getattr(self._backdrops[i], name), factor, torch.inf)
                        if i in self._backdrops
                        else nothing
                        for i in range(len(self.frames))
                    ]
            self._shares[factor] = tuple(self._shares_at(m, images[0].shape[:2], factor) for m in self._masks)
            self._images[factor] = images  # last: another thread may ask meanwhile
        cameras, share, shown = self._shown(indices, factor)

        def stacked(images: list[Tensor]) -> Tensor:
            return torch.stack([images[i][part] for i, part in zip(indices, shown, strict=True)])

        sky, solid = (None if shares is None else stacked(shares) for shares in self._shares[factor])
        cameras = cameras.scaled(1 / factor) if factor > 1 else cameras
        doubt = None
        if any(i in self._backdrops for i in indices):
            cameras = dataclasses.replace(cameras, backdrop=stacked(self._behind[factor, "radiance"]))
            doubt = stacked(self._behind[factor, "sigma"])
        return Batch(
            indices,
            cameras,
            stacked(self._images[factor]),
            torch.tensor([self.frames[i].exposure_time_s for i in indices]).view(-1, 1, 1, 1),
            factor * factor,
            share,
            sky,
            solid,
            doubt,
        )

    def _shown(self, indices: list[int], factor: int) -> tuple[Cameras, float, list[tuple[slice, slice]]]:
        """Return the cameras of what is shown of some frames, its share of their pixels, and where it lies."""
        cameras = cameras_of([self.frames[i] for i in indices])
        if self._windows is None or GRID_PX % factor:
            return cameras, 1.0, [(slice(None), slice(None))] * len(indices)
        parts = common(self._windows[indices], cameras.width, cameras.height)
        K = cameras.K.clone()
        K[:, :2, 2] -= parts[:, :2]
        width, height = (parts[0, 2:] - parts[0, :2]).tolist()
        share = width * height / (cameras.width * cameras.height)
        ends = (parts // factor + (parts % factor > 0)).tolist()  # rounded up, as averaging does at the edge
        shown = [(slice(top, bottom), slice(left, right)) for left, top, right, bottom in ends]
        return dataclasses.replace(cameras, K=K, width=width, height=height), share, shown

    def _shares_at(self, masks: dict[int, Tensor], size: torch.Size, factor: int) -> list[Tensor] | None:
        """Return each frame's shares of a mask [H, W], those without one share one image of zeros; None if none has."""
        if not masks:
            return None
        unknown = torch.zeros(size)
        shares = {
            i: F.avg_pool2d(mask[None].float(), factor, ceil_mode=True)[0] if factor > 1 else mask.float()
            for i, mask in masks.items()
        }
        return [shares.get(i, unknown) for i in range(len(self.frames))]


def windows(frames: Sequence[TrainingFrame], means: Tensor, certain: Mapping[int, Tensor]) -> Tensor:
    """Return the window [F, 4] of each frame that the target lies in: left, top, right and bottom, px, int64.

    It holds the start of the training as the frame's pose projects it. All are wider by as much as the certain light
    of any silhouette goes beyond that, since a start may lack thin parts. Where a point of the start is not in front
    of the camera the window is the whole frame.

    Args:
        frames: of one size.
        means: [N, 3] m, centres of the first Gaussians, body frame.
        certain: [H, W], where silhouettes of some of the frames show light for certain, by the index of the frame.
    """
    height, width = frames[0].dn.shape[:2]
    reached = torch.stack([_projected(frame, means) for frame in frames])
    whole = torch.tensor([0, 0, width, height])
    outwards = torch.tensor([-1, -1, 1, 1])
    beyond = [
        ((_bounds(light) - reached[i]) * outwards).amax() for i, light in certain.items() if light.any()
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
