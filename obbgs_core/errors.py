"""What can go wrong in a reconstruction."""


class ReconstructionError(Exception):
    """The frames do not allow a model."""


class TooFewFrames(ReconstructionError):
    """Fewer usable frames than a reconstruction needs."""


class Diverged(ReconstructionError):
    """The loss stopped being a number."""

    def __init__(self, step: int, loss: float):
        super().__init__(
            f"the loss became {loss} at step {step}; try smaller learning rates or check the poses"
        )
        self.step, self.loss = step, loss


class ExportError(ReconstructionError):
    """A model cannot be exported as asked."""
