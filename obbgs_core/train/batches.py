"""The frames of each step: which are drawn, and their images at the scale of the step."""

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.frames import TrainingFrame, averaged, cameras_of
from obbgs_core.model.cameras import Cameras
from obbgs_core.train.windows import GRID_PX, common

MOST_AT_ONCE = 3
COMES_AGAIN = 3  # frames of one exposure time, at least, where brackets repeat


@dataclass(frozen=True)
class Batch:
    """The frames of one step at one image scale."""

    indices: list[int]  # into the training frames
    cameras: Cameras
    dn: Tensor  # [B, H, W, C]
    exposure_time_s: Tensor  # [B, 1, 1, 1]
    averaged_pixels: int  # sensor pixels in one pixel of dn
    share: float = 1.0  # of the pixels of the whole frames that these images show
    # [B, H, W] share of each pixel that a silhouette shows to be empty or solid, 0 where there is none
    sky: Tensor | None = None
    solid: Tensor | None = None


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
        self._windows = windows
        self._images: dict[int, list[Tensor]] = {}
        self._shares: dict[int, tuple[list[Tensor] | None, ...]] = {}

    def posed(self, frames: list[TrainingFrame]) -> "Batches":
        """Return the same images with the poses of other frames, such as refined ones."""
        other = copy.copy(self)
        other.frames = frames
        return other

    def batch(self, indices: list[int], scale: float = 1.0) -> Batch:
        """Return given frames, averaged to `scale` (1 / whole number) of their size, or windows of one size of them."""
        factor = round(1 / scale)
        if factor not in self._images:
            images = [averaged(f.dn, factor, self.white_dn) for f in self.frames]
            self._shares[factor] = tuple(self._shares_at(m, images[0].shape[:2], factor) for m in self._masks)
            self._images[factor] = images  # last: another thread may ask meanwhile
        cameras, share, shown = self._shown(indices, factor)

        def stacked(images: list[Tensor]) -> Tensor:
            return torch.stack([images[i][part] for i, part in zip(indices, shown, strict=True)])

        sky, solid = (None if shares is None else stacked(shares) for shares in self._shares[factor])
        return Batch(
            indices,
            cameras.scaled(1 / factor) if factor > 1 else cameras,
            stacked(self._images[factor]),
            torch.tensor([self.frames[i].exposure_time_s for i in indices]).view(-1, 1, 1, 1),
            factor * factor,
            share,
            sky,
            solid,
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


def _by_exposure(frames: list[TrainingFrame], drawn: list[int]) -> list[list[int]]:
    """Return the drawn frames in groups of one exposure time each, as brackets have them.

    A time that at most half as many frames have as the commonest, as under automatic exposure, makes no group of its
    own, whose few frames would be drawn far more often than others: its frames go to the nearest time that does. Where
    no time comes again, as in automatic brackets, all frames are one group.
    """
    of_time: dict[float, list[int]] = {}
    for index in drawn:
        of_time.setdefault(frames[index].exposure_time_s, []).append(index)
    most = max(map(len, of_time.values()), default=0)
    groups: dict[float, list[int]] = {
        time_s: [] for time_s, members in of_time.items() if 2 * len(members) > most >= COMES_AGAIN
    }
    if not groups:
        return [drawn] if drawn else []
    for time_s, members in of_time.items():
        nearest = min(groups, key=lambda other: abs(math.log(other / time_s)))
        groups[nearest] += members
    return [sorted(members) for members in groups.values()]


@dataclass
class FrameOrder:
    """Draws frames at random without replacement, from each group in turn.

    One that joined late is drawn up to MOST_AT_ONCE times a round, until it has been drawn about as often as others.

    groups: indices of the frames to train on, those of about one exposure time in each group, or all in one.
    validation_brackets: indices of the frames that are not drawn, by bracket.
    remaining: what is left of each group in this round, drawn from the end.
    turn: frames drawn so far.
    visits: how often each frame was drawn, by its index.
    """

    groups: list[list[int]]
    validation_brackets: list[list[int]]
    remaining: list[list[int]]
    turn: int = 0
    visits: dict[int, int] = field(default_factory=dict)

    @staticmethod
    def of(
        frames: list[TrainingFrame],
        by_exposure: bool,
        validation_brackets: list[list[int]],
        left_out: Sequence[int] = (),
        earlier: "FrameOrder | None" = None,
    ) -> "FrameOrder":
        """Return the order of all frames but those of the validation brackets, and those that are left out for good.

        Args:
            earlier: the order by which frames were drawn until now. Its turn and how often it drew each frame go on, so
                that frames which joined late are still drawn more often.
        """
        withheld = {index for bracket in validation_brackets for index in bracket} | set(left_out)
        drawn = [index for index in range(len(frames)) if index not in withheld]
        groups = _by_exposure(frames, drawn) if by_exposure else [drawn] if drawn else []
        order = FrameOrder(groups, validation_brackets, [[] for _ in groups])
        if earlier is not None:
            order.turn, order.visits = earlier.turn, dict(earlier.visits)
        return order

    def draw(self, count: int, rng: torch.Generator) -> list[int]:
        """Return the indices of the next frames."""
        drawn = []
        for _ in range(count):
            group = self.turn % len(self.groups)
            if not self.remaining[group]:
                members = self._round(self.groups[group])
                self.remaining[group] = [
                    members[i] for i in torch.randperm(len(members), generator=rng).tolist()
                ]
            drawn.append(self.remaining[group].pop())
            self.visits[drawn[-1]] = self.visits.get(drawn[-1], 0) + 1
            self.turn += 1
        return drawn

    def _round(self, members: list[int]) -> list[int]:
        """Return the frames of a group's next round, those that were drawn less than others several times."""
        visits = [self.visits.get(i, 0) for i in members]
        most = max(visits)
        return [
            i
            for i, n in zip(members, visits, strict=True)
            for _ in range(min(MOST_AT_ONCE, (most + 1) // (n + 1)))
        ]
