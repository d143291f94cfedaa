"""The registry of compared methods: how each is run, and which axes of a grid change what it does."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from compare import references
from compare.case import Case
from compare.opponents.mvsnet import WeightsUnfit, load_network, reconstruct_mvsnet
from compare.opponents.mvsnet_network import MvsNet
from compare.opponents.nerf import AS_PUBLISHED, FOR_A_CPU, Knowing, Size, reconstruct_nerf
from compare.opponents.plane_sweep import reconstruct_mvs
from compare.opponents.reconstruction import Reconstruction, Work
from compare.opponents.sfm import Pictures, reconstruct_sfm
from compare.trainings import reconstruct_gaussians
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import PRESETS, budget_changes, preset
from obbgs_core.sensor import Sensor
from obbgs_core.settings import changed, flat


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
    gaussians: the most that it trains. working_mb: memory that its work takes besides.
    """

    name: str
    run: Callable[[Task], Outcome]
    stated: dict[str, Any] = field(default_factory=dict)
    seeded: bool = False
    stepped: bool = False
    sized: bool = False
    settable: bool = False
    gaussians: int = 0
    working_mb: float = 0.0


def method(name: str, weights: Path | None = None) -> Method:
    """Return a method by its name: a reference, a baseline, or a training as `preset` names it, `3dgs+exposure`.

    Args:
        weights: the file of a learned method's weights, which decides its rows by its content.

    Raises:
        ValueError: there is no such method; the message names the known ones. Or it needs weights, and there are none
            that fit.
    """
    if name == MVSNET:
        if weights is None or not weights.is_file():
            raise ValueError(f"{MVSNET} needs the file of its weights: --weights FILE, got {weights}")
        status = weights.stat()
        try:
            loaded = _network(weights.resolve(), status.st_mtime_ns, status.st_size)
        except WeightsUnfit as error:
            raise ValueError(f"--weights: {error}") from error
        return Method(name, lambda task: _learned(task, loaded), {"weights": loaded[1]})
    if name in _REFERENCES:
        return Method(name, lambda task: _reference(task, _REFERENCES[name]))
    if name in _BASELINES:
        return _BASELINES[name]
    if name == UNTRAINED:
        return dataclasses.replace(_training(preset("obbgs"), name, 0.0), stepped=False)
    plain = name.removesuffix(EARLY)
    try:
        return _training(preset(plain), name, validated=name != plain)
    except ValueError as error:
        if plain.partition("+")[0] in PRESETS:
            raise
        others = ", ".join([*reference_names(), *_BASELINES, MVSNET])
        raise ValueError(f"{error}; or {others}, which are no trainings of Gaussians") from error


def reference_names() -> list[str]:
    """Return the names of the methods that reconstruct nothing, in the order in which tables show them."""
    return [*_REFERENCES, UNTRAINED]


_REFERENCES: dict[str, Callable[[Case, list[TrainingFrame]], list[Tensor]]] = {
    "black": references.black,
    "mean": references.mean_image,
    "ceiling": references.ceiling,
    "noise": references.noise,
}
EARLY = "+early"  # after a training's name: its model is the one that shows brackets best which are kept back
MVSNET, UNTRAINED = "mvsnet", "untrained"  # the Gaussians that `obbgs` starts from
NGP_MB = 1500.0  # 1,100 were seen beside PyTorch and the frames


def _radiance_field(name: str, size: Size, working_mb: float = 0.0) -> list[Method]:
    """Return a radiance field as published, blind to exposure, with exposure known, and knowing clips and masks too."""

    def variant(*names: str) -> Method:
        knowing = Knowing("clips" in names, "mask" in names)
        return Method(
            "+".join((name, *names)),
            lambda task: _nerf(task, size, "exposure" in names, knowing),
            seeded=True,
            stepped=True,
            working_mb=working_mb,
        )

    more = ("mask",), ("clips",), ("mask", "clips")
    return [variant(), variant("exposure"), *(variant("exposure", *names) for names in more)]


_BASELINES: dict[str, Method] = {
    method.name: method
    for method in (
        *_radiance_field("nerf", FOR_A_CPU),
        *_radiance_field("instant-ngp", AS_PUBLISHED, NGP_MB),
        Method("mvs", lambda task: _stereo(task, one_exposure=True)),
        Method("mvs+raw", lambda task: _stereo(task, one_exposure=False)),
        Method("sfm", lambda task: _motion(task, "raw")),
        Method("sfm+fused", lambda task: _motion(task, "fused")),
        Method("sfm+one-exposure", lambda task: _motion(task, "one-exposure")),
    )
}


def _reference(task: Task, images: Callable[[Case, list[TrainingFrame]], list[Tensor]]) -> Outcome:
    empty = torch.zeros(0, 3)
    return Outcome(Reconstruction(empty, empty, None, 0, 0.0), images(task.case, task.frames))


def _nerf(task: Task, size: Size, exposure_aware: bool, knowing: Knowing) -> Outcome:
    settings = (task.seed, task.work, task.steps_share, exposure_aware, size)
    on_gpu = torch.cuda.is_available()
    made = reconstruct_nerf(
        task.frames, task.sensor, *settings, device="cuda" if on_gpu else "cpu", knowing=knowing
    )
    figures = made.figures | {"device": torch.cuda.get_device_name()} if on_gpu else made.figures
    return Outcome(dataclasses.replace(made, figures=figures))


def _stereo(task: Task, one_exposure: bool) -> Outcome:
    return Outcome(reconstruct_mvs(task.frames, task.sensor, task.work, one_exposure))


@functools.lru_cache(maxsize=1)
def _network(weights: Path, changed_ns: int, size_bytes: int) -> tuple[MvsNet, str, str]:
    """Return a file's network, digest and description, read once for as long as the file stays as it is."""
    return load_network(weights)


def _learned(task: Task, loaded: tuple[MvsNet, str, str]) -> Outcome:
    return Outcome(reconstruct_mvsnet(task.frames, task.sensor, loaded, task.work))


def _motion(task: Task, pictures: Pictures) -> Outcome:
    return Outcome(reconstruct_sfm(task.frames, task.sensor, task.work, pictures))


def _training(
    config: MethodConfig, name: str, time_limit_s: float = float("inf"), validated: bool = False
) -> Method:
    def run(task: Task) -> Outcome:
        changes = dict(task.settings)
        changes["steps"] = max(1, round(changes.get("steps", config.steps) * task.steps_share))
        if task.largest is not None:
            changes = budget_changes(config, changes, task.largest)
        used = changed(config, changes)
        return Outcome(
            reconstruct_gaussians(
                task.frames, task.sensor, used, task.seed, task.work, task.settled, time_limit_s, validated
            )
        )

    return Method(
        name,
        run,
        {"settings": differing(config), "time_limit_s": time_limit_s}
        | ({"validated": True} if validated else {}),
        seeded=True,
        stepped=True,
        sized=True,
        settable=True,
        gaussians=config.growth.max_gaussians,
    )


def differing(config: MethodConfig) -> dict[str, Any]:
    """Return the settings of a method that are not the defaults, so that a new setting changes no digest."""
    usual = flat(MethodConfig(name=""))
    return {name: value for name, value in flat(config).items() if value != usual[name]}
