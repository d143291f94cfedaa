"""The registry of compared methods: how each is run, and which axes of a grid change what it does."""

import dataclasses
import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ground.baselines.reconstruction import Reconstruction, Work
from ground.compare import references
from ground.compare.case import Case
from ground.compare.trainings import reconstruct_gaussians
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor
from obbgs_core.settings import changed, known_names
from obbgs_core.train.config import MethodConfig
from obbgs_core.train.presets import PRESETS, preset


@dataclass(frozen=True)
class Task:
    """What one cell of a grid gives to a method.

    frames, sensor: what the condition leaves of the session's, and what the method is told of its camera.
    steps_share: of the method's own number of steps; largest: number of Gaussians, None: the method's own.
    settings: changes of a training, by names such as `growth.interval`.
    settled: whether the curve of held-out scores has stopped moving.
    """

    case: Case
    frames: list[TrainingFrame]
    sensor: Sensor
    seed: int
    steps_share: float
    largest: int | None
    settings: dict[str, Any]
    work: Work
    settled: Callable[[], bool] = lambda: False


@dataclass(frozen=True)
class Outcome:
    """What a method made: a reconstruction, and the images of the held-out frames where it has no camera's image."""

    reconstruction: Reconstruction
    images: list[Tensor] | None = None


@dataclass(frozen=True)
class Method:
    """A compared method.

    stated: what of it decides a row besides the axes of the grid, for the row's digest.
    seeded, stepped, sized, settable: whether a seed, a share of the steps, a largest number of Gaussians, and settings
        of a training mean anything to it; cells that differ only in what means nothing are one.
    gaussians: the most that it trains.
    """

    name: str
    run: Callable[[Task], Outcome]
    stated: dict[str, Any] = field(default_factory=dict)
    seeded: bool = False
    stepped: bool = False
    sized: bool = False
    settable: bool = False
    gaussians: int = 0


def method(name: str) -> Method:
    """Return a method by its name.

    Raises:
        ValueError: there is no such method; the message names the known ones.
    """
    if name in _REFERENCES:
        return Method(name, lambda task: _reference(task, _REFERENCES[name]))
    if name == UNTRAINED:
        return dataclasses.replace(_training(STARTED, name, 0.0), stepped=False)
    try:
        config = configured(name)
    except ValueError as error:
        raise ValueError(f"no method {name!r}; expected one of {', '.join(known_methods())}") from error
    return _training(config, name)


def known_methods() -> list[str]:
    """Return the names of all methods, each published one also with `+exposure`."""
    blind = [f"{name}+exposure" for name, config in PRESETS.items() if not config.exposure_aware]
    return [*_REFERENCES, UNTRAINED, *PRESETS, *blind]


def configured(name: str) -> MethodConfig:
    """Return the settings of `METHOD` or `METHOD+exposure`, the second with exposure times and gain known.

    Raises:
        ValueError: there is no such method.
    """
    base, plus, variant = name.partition("+")
    if plus and variant != "exposure":
        raise ValueError(f"no variant {variant!r}; expected exposure")
    return preset(base, {"exposure_aware": True} if plus else {})


_REFERENCES: dict[str, Callable[[Case, list[TrainingFrame]], list[Tensor]]] = {
    "black": references.black,
    "mean": references.mean_image,
    "ceiling": references.ceiling,
    "noise": references.noise,
}
UNTRAINED, STARTED = "untrained", preset("obbgs")  # the Gaussians that `obbgs` starts from


def _reference(task: Task, images: Callable[[Case, list[TrainingFrame]], list[Tensor]]) -> Outcome:
    empty = torch.zeros(0, 3)
    return Outcome(Reconstruction(empty, empty, None, 0, 0.0), images(task.case, task.frames))


def _training(config: MethodConfig, name: str, time_limit_s: float = float("inf")) -> Method:
    def run(task: Task) -> Outcome:
        changes = dict(task.settings)
        changes.setdefault("steps", max(1, round(config.steps * task.steps_share)))
        if task.largest is not None:
            changes |= {"growth.max_gaussians": task.largest, "growth.pixels_per_gaussian": 0}
            changes["start.count"] = min(task.largest, changes.get("start.count", config.start.count))
        used = changed(config, changes)
        return Outcome(
            reconstruct_gaussians(
                task.frames, task.sensor, used, task.seed, task.work, task.settled, time_limit_s
            )
        )

    return Method(
        name,
        run,
        {"settings": differing(config), "time_limit_s": time_limit_s},
        seeded=True,
        stepped=True,
        sized=True,
        settable=True,
        gaussians=config.growth.max_gaussians,
    )


def differing(config: MethodConfig) -> dict[str, Any]:
    """Return the settings of a method that are not the defaults, so that a new setting changes no digest."""
    default = MethodConfig(name="")
    values = {
        name: (operator.attrgetter(name)(config), operator.attrgetter(name)(default))
        for name in known_names(MethodConfig)
    }
    return {name: value for name, (value, usual) in values.items() if value != usual}
