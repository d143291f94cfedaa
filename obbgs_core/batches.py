"""The training frames as a step takes them: averaged images, and of each the window that shows the target."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.background import Backdrop
from obbgs_core.compact import Compact, held, part, whole
from obbgs_core.frames import TrainingFrame, averaged, cameras_of
from obbgs_core.jpeg import FULL_SCALE, JpegCoding
from obbgs_core.model.cameras import Cameras

# windows begin at multiples of it, so that the pixels averaged for a coarse image lie in one window
GRID_PX = 16
MAIN_MEMORY = torch.device("cpu")
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
    # `JpegCoding.coefficients` that dn came from, of each frame; None: not known
    stored: list[Tensor] | None = None


class Batches:
    """The training frames at every image scale; each frame is averaged once, when it is first asked for.

    white_dn: the sensor's full scale.
    sky, solid: where silhouettes show empty sky, and what is solid, [H, W] bool by the frame's index; frames without a
        silhouette are not in them.
    windows: the part of each frame [F, 4] that is shown, see `windows.windows`; None: all of it.
    jpeg: how the frames were stored; their coefficients never change, and are found when a frame is first asked for.
    """

    def __init__(
        self,
        frames: list[TrainingFrame],
        white_dn: float,
        sky: Mapping[int, Tensor | Compact] | None = None,
        windows: Tensor | None = None,
        solid: Mapping[int, Tensor | Compact] | None = None,
        jpeg: JpegCoding | None = None,
    ):
        self.frames, self.white_dn = frames, white_dn
        self._gains = [1.0] * len(frames)  # true over stated exposure times
        self._masks = {"sky": dict(sky or {}), "solid": dict(solid or {})}
        self._backdrops: dict[int, Backdrop] = {}
        self._windows = windows
        height, width = frames[0].shape[:2]
        # [F, 4] what a batch can show of each frame
        self._reached = None if windows is None else common(windows, width, height)
        # by name, factor, frame and where they are
        self._images: dict[tuple[str, int, int, torch.device], Tensor] = {}
        # whole blocks lie in every window
        self._jpeg = jpeg if jpeg and all(GRID_PX % px == 0 for px in jpeg.blocks_px) else None
        self._stored: dict[int, list[Tensor]] = {}  # by frame

    def cameras(self, indices: list[int]) -> Cameras:
        """Return the cameras of whole frames, with nothing behind the target."""
        return cameras_of([self.frames[i] for i in indices])

    def posed(self, frames: list[TrainingFrame]) -> "Batches":
        """Return the same images with the poses of other frames, such as refined ones."""
        other = copy.copy(self)
        other.frames = frames
        return other

    def exposed(self, gains: list[float] | None) -> "Batches":
        """Return the same images with exposure times so many times as long as stated; None: as stated."""
        other = copy.copy(self)
        other._gains = gains or [1.0] * len(self.frames)
        return other

    @property
    def has_backdrops(self) -> bool:
        """Whether something stands behind the target in some frames."""
        return bool(self._backdrops)

    def stand(self, backdrops: dict[int, Backdrop], sky: dict[int, Tensor]) -> None:
        """Put something behind the target in some frames, by their index, and say where they show nothing else.

        Args:
            sky: [H, W] bool, without the target.
        """
        self._backdrops = backdrops
        self._masks = self._masks | {"sky": self._masks["sky"] | {i: held(m) for i, m in sky.items()}}
        self._images = {}  # copies keep those that they have

    def batch(self, indices: list[int], scale: float = 1.0, device: torch.device = MAIN_MEMORY) -> Batch:
        """Return given frames, averaged to `scale` (1 / whole number) of their size, or windows of one size of them.

        Args:
            device: where the images are, backdrops included; they stay there for the next time. Poses are in main
                memory.
        """
        factor = round(1 / scale)
        cameras, share, shown = self._shown(indices, factor)

        def stacked(name: str) -> Tensor:
            return torch.stack(
                [self._image(name, factor, i, device)[place] for i, place in zip(indices, shown, strict=True)]
            )

        sky, solid = (stacked(name) if self._masks[name] else None for name in ("sky", "solid"))
        cameras = cameras.scaled(1 / factor) if factor > 1 else cameras
        doubt = None
        if any(i in self._backdrops for i in indices):
            cameras = dataclasses.replace(cameras, backdrop=stacked("radiance"))
            doubt = stacked("sigma")
        exposures_s = torch.tensor([self.frames[i].exposure_time_s * self._gains[i] for i in indices])
        return Batch(
            indices,
            cameras,
            stacked("dn"),
            exposures_s.view(-1, 1, 1, 1).to(device),
            factor * factor,
            share,
            sky,
            solid,
            doubt,
            self._coefficients(indices, shown) if factor == 1 else None,
        )

    def _coefficients(self, indices: list[int], shown: list[tuple[slice, slice]]) -> list[Tensor] | None:
        """Return the coefficients of what is shown of some frames; None where dn is not what was stored."""
        if self._jpeg is None or any(i in self._backdrops for i in indices):
            return None
        for i in indices:
            if i not in self._stored:
                # chromas at the edge follow from beyond it, too
                reach = self._reach(1, i)
                wider = [
                    slice(max(0, (of.start or 0) - GRID_PX), of.stop and of.stop + GRID_PX) for of in reach
                ]
                dn = self.frames[i].part(*wider)
                found = self._jpeg.coefficients(dn / (self.white_dn / FULL_SCALE))
                inside = [
                    slice((of.start or 0) - begin, of.stop and of.stop - begin)
                    for of, begin in ((of, wide.start) for of, wide in zip(reach, wider, strict=True))
                ]
                self._stored[i] = self._jpeg.part(found, *inside)
        parts = [self._jpeg.part(self._stored[i], *at) for i, at in zip(indices, shown, strict=True)]
        return [torch.stack(planes) for planes in zip(*parts, strict=True)]

    def _image(self, name: str, factor: int, index: int, device: torch.device) -> Tensor:
        """Return what `_averaged` does, on a device; whole frames are not kept twice in main memory."""
        key = (name, factor, index, device)
        if key in self._images:
            return self._images[key]
        image = self._averaged(name, factor, index).to(device)
        if factor > 1 or device != MAIN_MEMORY or not self.frames[index].is_compact:
            self._images[key] = image
        return image

    def _averaged(self, name: str, factor: int, index: int) -> Tensor:
        """Return what batches can show of a frame, averaged: dn, sky or solid, or its backdrop's radiance or sigma."""
        rows, columns = self._reach(factor, index)
        backdrop = self._backdrops.get(index)
        if name in self._masks:
            mask = self._masks[name].get(index)
            if mask is None:
                size = self.frames[index].part(rows, columns).shape[:2]
                image = torch.zeros([-(-side // factor) for side in size])
            else:
                image = part(mask, rows, columns).float()
                image = F.avg_pool2d(image[None], factor, ceil_mode=True)[0] if factor > 1 else image
        elif name == "dn":
            frame = self.frames[index]
            dn = frame.part(rows, columns) if backdrop is None else backdrop.dn[rows, columns]
            image = averaged(dn, factor, self.white_dn)
        else:
            nothing = torch.zeros_like(self.frames[index].part(rows, columns))
            image = nothing if backdrop is None else getattr(backdrop, name)[rows, columns]
            image = averaged(image, factor, torch.inf)
        return image

    def _reach(self, factor: int, index: int) -> tuple[slice, slice]:
        """Return which rows and columns of a frame batches of this factor can show."""
        if self._reached is None or GRID_PX % factor:
            return slice(None), slice(None)
        left, top, right, bottom = self._reached[index].tolist()
        right, bottom = (factor * -(-end // factor) for end in (right, bottom))  # of whole pixels
        return slice(top, bottom), slice(left, right)

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
        if self._reached is not None:  # images begin there
            parts = parts - self._reached[indices][:, :2].repeat(1, 2)
        ends = (parts // factor + (parts % factor > 0)).tolist()  # rounded up, as averaging does at the edge
        shown = [(slice(top, bottom), slice(left, right)) for left, top, right, bottom in ends]
        return dataclasses.replace(cameras, K=K, width=width, height=height), share, shown


def windows(
    frames: Sequence[TrainingFrame], means: Tensor, certain: Mapping[int, Tensor | Compact]
) -> Tensor:
    """Return the window [F, 4] of each frame that the target lies in: left, top, right and bottom, px, int64.

    It holds the start of the training as the frame's pose projects it. All are wider by as much as the certain light
    of any silhouette goes beyond that, since a start may lack thin parts. Where a point of the start is not in front
    of the camera the window is the whole frame.

    Args:
        frames: of one size.
        means: [N, 3] m, centres of the first Gaussians, body frame.
        certain: [H, W], where silhouettes of some of the frames show light for certain, by the index of the frame.
    """
    height, width = frames[0].shape[:2]
    reached = torch.stack([_projected(frame, means) for frame in frames])
    all_of_it = torch.tensor([0, 0, width, height])
    outwards = torch.tensor([-1, -1, 1, 1])
    beyond = [
        ((_bounds(light) - reached[i]) * outwards).amax()
        for i, light in ((i, whole(mask)) for i, mask in certain.items())
        if light.any()
    ]
    margin = MARGIN_PX + max([0.0, *(float(b) for b in beyond if b.isfinite())])
    begin = ((reached[:, :2] - margin) / GRID_PX).floor() * GRID_PX
    end = ((reached[:, 2:] + margin) / GRID_PX).ceil() * GRID_PX
    found = torch.cat([begin, end], dim=1).clamp(min=torch.zeros(4), max=all_of_it[[2, 3, 2, 3]].float())
    inside = (found.isfinite().all(dim=1) & (found[:, 2:] > found[:, :2]).all(dim=1))[:, None]
    return torch.where(inside, found.nan_to_num(), all_of_it.float()).long()


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
