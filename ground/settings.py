"""Options, `--set` and the mission file as changes to the preset of a training method."""

import re
from collections.abc import Sequence

from flightsw.icd.mission import ConfigError, ReconstructSection, build, parse_yaml
from obbgs_core.train.presets import MethodConfig, preset, with_quality


def all_changes(
    section: ReconstructSection,
    method: str,
    quality: str | None,
    budget: str,
    steps: int | None,
    assignments: Sequence[str],
) -> dict:
    """Return all changes to a method's preset; `--set` overrides the options, and both override the mission file.

    Raises:
        ValueError: as in the functions below, or an option and `--set` give the same setting.
    """
    by_set = set_changes(assignments)
    for name, option, given in (
        ("steps", "--steps", steps is not None),
        ("max_gaussians", "--budget", budget != "auto"),
    ):
        if given and name in by_set:
            raise ConfigError(f"--set {name}", f"is given by {option} too: leave one of them out")
    return mission_changes(section) | changes_for(method, quality, budget, steps) | by_set


def changes_for(
    method: str, quality: str | None = None, budget: str = "auto", steps: int | None = None
) -> dict:
    """Return the changes to a method's preset that the options ask for.

    A budget given as a number is used as it is: the limit by the number of lit pixels is turned off.

    Raises:
        ValueError: no such method or quality, or a budget that is neither `auto` nor a number.
    """
    config, changes = preset(method), {}
    if quality is not None:
        config = with_quality(config, quality)
        changes = {name: getattr(config, name) for name in ("steps", "max_gaussians", "start_count")}
    if budget != "auto":
        if not (budget.isascii() and budget.isdigit()) or int(budget) == 0:
            raise ValueError(f"--budget must be auto or a number of Gaussians, got {budget!r}")
        changes["max_gaussians"] = int(budget)
        changes["start_count"] = min(config.start_count, int(budget))
        changes["pixels_per_gaussian"] = 0
    if steps is not None:
        changes["steps"] = steps
    return changes


def mission_changes(section: ReconstructSection) -> dict:
    """Return the changes to its method's preset that a mission file asks for.

    Raises:
        ConfigError: no such setting, or a value of the wrong type; names its path.
    """
    steps = {"steps": section.steps} if section.steps else {}
    return steps | checked_settings(section.settings, "mission.reconstruct.settings")


def set_changes(assignments: Sequence[str]) -> dict:
    """Return the settings given as texts such as `sun_shading=linear`; values are YAML.

    Raises:
        ConfigError: a text is not key=value, a setting is unknown or given twice, or a value has the wrong type.
    """
    tree: dict[str, object] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ConfigError("--set", f"expected key=value, got {text!r}")
        if key in tree:
            raise ConfigError(f"--set {key}", "is given twice")
        tree[key] = parse_yaml(value.encode(), f"--set {key}")
        if isinstance(tree[key], str) and re.fullmatch(r"\s*[+-]?\d+[eE][+-]?\d+\s*", value):
            tree[key] = float(value)  # YAML reads 2e-3, without a point, as text
    return checked_settings(tree, "--set")


def checked_settings(tree: dict, path: str) -> dict:
    """Return settings by name, converted to the types that MethodConfig declares.

    Raises:
        ConfigError: no such setting, or a value of the wrong type or out of its range; names its path.
    """
    try:
        config = build(MethodConfig, tree, path, name="")
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(path, str(error)) from error
    return {name: getattr(config, name) for name in tree}
