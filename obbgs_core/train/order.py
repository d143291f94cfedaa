"""Which frames each step is trained on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from obbgs_core.frames import TrainingFrame

MOST_AT_ONCE = 3
COMES_AGAIN = 3  # frames of one exposure time, at least, where brackets repeat


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
