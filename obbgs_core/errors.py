"""The errors of a reconstruction."""

from obbgs_base.errors import ObbgsError


class ReconstructionError(ObbgsError):
    """The frames do not allow a model."""


class TooFewFrames(ReconstructionError):
    """Fewer usable frames than a reconstruction needs."""


class Diverged(ReconstructionError):
    """The loss stopped being a number, or what another `problem` says."""

    def __init__(self, step: int, loss: float, problem: str = ""):
        problem = problem or f"the loss became {loss}"
        super().__init__(f"{problem} at step {step}; try smaller learning rates or check the poses")
        self.step, self.loss = step, loss


class ExportError(ReconstructionError):
    """A model cannot be exported as asked."""
