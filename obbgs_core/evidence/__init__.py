"""What the data justify in a model: Gaussians, degrees of harmonics, highlights, corrected poses.

Each question is answered by an `Evidence` from a model, frames and their sensor; nothing here knows of a training.
"""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Evidence:
    """What the data say for something more in a model, or for each of N things.

    gain: [] or [N], of log-likelihood in nats, or a figure that grows with it.
    penalty: what the gain has to exceed because more parameters always fit better, in its units.
    error: standard errors of the gain by which it has to exceed that, times how many of them are asked for.
    """

    gain: Tensor
    penalty: float = 0.0
    error: float = 0.0

    @property
    def justifies(self) -> Tensor:
        """Whether it is justified, bool [] or [N]."""
        return self.gain - self.penalty > self.error
