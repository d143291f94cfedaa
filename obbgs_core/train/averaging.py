"""The mean of the models of the last steps: single steps see a few frames and scatter about what all frames want."""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.model.gaussians import Gaussians


@dataclass(frozen=True)
class Average:
    """The mean of a model over some steps, parameter by parameter.

    Source: Polyak and Juditsky, Acceleration of Stochastic Approximation by Averaging, 1992.
    """

    gaussians: Gaussians  # without gradients
    steps: int

    @staticmethod
    @torch.no_grad()
    def of(gaussians: Gaussians, earlier: "Average | None") -> "Average":
        """Return the mean of an average and one more model; of that alone where it has other parameters."""
        now = gaussians.parameters()
        if earlier is None or not earlier.has_shapes_of(now):
            return Average(gaussians.copied(), 1)
        steps, before = earlier.steps + 1, earlier.gaussians.parameters()
        means = {name: before[name].lerp(value.detach(), 1 / steps) for name, value in now.items()}
        return Average(dataclasses.replace(gaussians, **means), steps)

    def has_shapes_of(self, parameters: dict[str, Tensor]) -> bool:
        """Return whether parameters are those of the same Gaussians, as far as their shapes tell."""
        mine = self.gaussians.parameters()
        return {n: t.shape for n, t in mine.items()} == {n: t.shape for n, t in parameters.items()}

    def select(self, index: Tensor) -> "Average":
        """Return the average of the Gaussians that an index or mask picks."""
        return Average(self.gaussians.select(index), self.steps)
