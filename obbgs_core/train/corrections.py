"""Small numbers beside the Gaussians that correct what a frame's tag says, held by the tag's own deviations."""

import torch
from torch import Tensor


class Corrections:
    """Corrections [P, n] in units of the tags' deviations; frames share those of their row."""

    def __init__(self, of_frame: list[int], numbers: int, memory: float = 0.99):
        self.of_frame = of_frame
        rows = max(of_frame) + 1
        self.value = torch.zeros(rows, numbers, requires_grad=True)
        self.second, self.visits = torch.zeros(rows, numbers), torch.zeros(rows, 1)
        self.memory = memory

    def rows(self, indices: list[int]) -> Tensor:
        """Return the rows [B] of frames."""
        return torch.tensor([self.of_frame[i] for i in indices])

    def of(self, indices: list[int]) -> Tensor:
        """Return the corrections [B, n] of frames."""
        return self.value[self.rows(indices)]

    def prior(self, indices: list[int], values: int) -> Tensor:
        """Return the corrections' share of a step's mean loss: half their squares over all the step's values."""
        return 0.5 * self.of(indices).square().sum() / values

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move what has a gradient against it, over its root mean square; `rate` is in deviations.

        This is Adam without its first moment: a frame is seen a few dozen times, and momentum overshoots.
        """
        gradient = self.value.grad
        if gradient is None:
            return
        seen = gradient.abs().sum(1, keepdim=True) > 0
        self.visits += seen
        self.second = torch.where(
            seen, self.memory * self.second + (1 - self.memory) * gradient**2, self.second
        )
        second = self.second / (1 - self.memory ** self.visits.clamp(min=1))
        self.value -= torch.where(seen, rate * gradient / (second.sqrt() + 1e-15), 0.0)
        self.value.grad = None

    def state(self) -> dict:
        return {name: getattr(self, name).detach().clone() for name in ("value", "second", "visits")}

    def restore(self, state: dict) -> None:
        for name, tensor in state.items():
            setattr(self, name, tensor.clone())
        self.value.requires_grad_()


class ExposureCorrections(Corrections):
    """A factor on each frame's exposure time, exp(correction · sigma): shutters jitter and drivers round."""

    def __init__(self, frames: int, sigma: float):
        super().__init__(list(range(frames)), 1)
        self.sigma = sigma  # of the logarithm of an exposure time

    def factors(self, indices: list[int]) -> Tensor:
        """Return true over tagged exposure times of frames [B, 1, 1, 1]; gradients reach the corrections."""
        return torch.exp(self.sigma * self.of(indices)).view(-1, 1, 1, 1)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move the corrections; their mean stays zero, because a factor common to all is the model's radiance."""
        super().step(rate)
        seen = self.visits > 0
        if seen.any():
            self.value.sub_(torch.where(seen, self.value[seen].mean(), 0.0))

    @property
    def rms(self) -> float:
        """The root mean square of the corrections of ln(exposure time)."""
        return self.sigma * self.value.detach().square().mean().sqrt().item()
