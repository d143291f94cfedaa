"""What a user wishes of a training: options, `--set` and the mission file, as changes to a method's preset."""

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
    """Return the changes to a method's preset: of the mission file, over those the options, over those `--set`.

    Raises:
        ValueError: as in the functions below, or an option and `--set` say the same thing twice.
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
    """Return the changes to a method's preset that a user's wishes come to.

    A budget in numbers is what happens: no number of pixels for each Gaussian takes from it.

    Raises:
        ValueError: no such method or quality, or a budget that is neither `auto` nor a number.
    """
    wished, changes = preset(method), {}
    if quality is not None:
        wished = with_quality(wished, quality)
        changes = {name: getattr(wished, name) for name in ("steps", "max_gaussians", "start_count")}
    if budget != "auto":
        if not (budget.isascii() and budget.isdigit()) or int(budget) == 0:
            raise ValueError(f"--budget must be auto or a number of Gaussians, got {budget!r}")
        changes["max_gaussians"] = int(budget)
        changes["start_count"] = min(wished.start_count, int(budget))
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
    """Return the settings in texts such as `sun_shading=linear`; the values are YAML.

    Raises:
        ConfigError: not such a text, no such setting, one given twice, or a value of the wrong type.
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
            tree[key] = float(value)  # YAML takes 2e-3, without a point, for text
    return checked_settings(tree, "--set")


def checked_settings(tree: dict, path: str) -> dict:
    """Return settings of a method by name, with the types that it wants.

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
