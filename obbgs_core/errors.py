"""The errors of a reconstruction."""

from obbgs_base.errors import ObbgsError
from obbgs_base.values import told


class ReconstructionError(ObbgsError):
    """The frames do not allow a model."""


def expect(value: object, wanted: type, name: str, expected: str) -> None:
    """Refuse what is not of a type.

    Raises:
        ValueError: names what is wrong, what was expected and what came.
    """
    if isinstance(value, wanted):
        return
    simple = value is None or isinstance(value, (str, int, float))
    came = told(value) if simple else f"{type(value).__module__}.{type(value).__qualname__}"
    raise ValueError(f"{name}: expected {expected}, got {came}")


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
