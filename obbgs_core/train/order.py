"""Which frames each step is trained on."""

import math
from dataclasses import dataclass, field

import torch

MOST_AT_ONCE = 3
COMES_AGAIN = 3  # frames of one exposure time, at least, where brackets repeat


@dataclass
class FrameOrder:
    """Draws frames at random without replacement, from each group in turn.

    One that joined late is drawn up to MOST_AT_ONCE times before others come again, until it has been drawn about as
    often as they.

    exposures_s: of all frames.
    by_exposure: the frames of a group are those of about one exposure time; else all frames are one.
    validation_brackets: indices of the frames that are kept back, by bracket.
    left_out: indices of the frames that are left out for good, because they fit no pose that their tags allow.
    groups: indices of the frames to train on; remaining: those of each that are still to come, from the end.
    turn: frames drawn so far.
    visits: how often each frame was drawn, by its index.
    """

    exposures_s: list[float]
    by_exposure: bool
    validation_brackets: list[list[int]]
    left_out: list[int] = field(default_factory=list)
    turn: int = 0
    visits: dict[int, int] = field(default_factory=dict)
    groups: list[list[int]] = field(init=False)
    remaining: list[list[int]] = field(init=False)

    def __post_init__(self):
        self._group()

    def keep_back(self, brackets: list[list[int]]) -> None:
        """Train on all frames but those of some brackets, and those that are left out for good."""
        self.validation_brackets = brackets
        self._group()

    def leave_out(self, indices: list[int]) -> None:
        """Train no more on some frames."""
        self.left_out += indices
        self._group()

    def extend(self, exposures_s: list[float]) -> None:
        """Draw from more frames too, whose exposure times follow those of the frames so far in what is given."""
        self.exposures_s = exposures_s
        self._group()

    @property
    def fitting(self) -> list[int]:
        """The indices of the frames that are not left out for good."""
        left_out = set(self.left_out)
        return [i for i in range(len(self.exposures_s)) if i not in left_out]

    def _group(self) -> None:
        kept_back = {index for bracket in self.validation_brackets for index in bracket}
        drawn = [index for index in self.fitting if index not in kept_back]
        self.groups = self._by_exposure(drawn) if self.by_exposure else [drawn] if drawn else []
        self.remaining = [[] for _ in self.groups]

    def _by_exposure(self, drawn: list[int]) -> list[list[int]]:
        """Return the drawn frames in groups of one exposure time each, as brackets have them.

        A time that at most half as many frames have as the commonest, as under automatic exposure, makes no group of
        its own, whose few frames would be drawn far more often than others: its frames go to the nearest time that
        does. Where no time comes again, as in automatic brackets, all frames are one group.
        """
        of_time: dict[float, list[int]] = {}
        for index in drawn:
            of_time.setdefault(self.exposures_s[index], []).append(index)
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

    def draw(self, count: int, rng: torch.Generator) -> list[int]:
        """Return the indices of the next frames."""
        drawn = []
        for _ in range(count):
            group = self.turn % len(self.groups)
            if not self.remaining[group]:
                members = self._next(self.groups[group])
                self.remaining[group] = [
                    members[i] for i in torch.randperm(len(members), generator=rng).tolist()
                ]
            drawn.append(self.remaining[group].pop())
            self.visits[drawn[-1]] = self.visits.get(drawn[-1], 0) + 1
            self.turn += 1
        return drawn

    def _next(self, members: list[int]) -> list[int]:
        """Return the frames of a group as they come next, those that were drawn less than others several times."""
        visits = [self.visits.get(i, 0) for i in members]
        most = max(visits)
        return [
            i
            for i, n in zip(members, visits, strict=True)
            for _ in range(min(MOST_AT_ONCE, (most + 1) // (n + 1)))
        ]
