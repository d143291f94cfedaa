"""What a user asks of a training: options, `--set` and the mission file, as changes to a method's preset.

Changes are named as in `preset`: `steps`, or `growth.interval` for a setting of a group.
"""

import operator
from collections.abc import Sequence

from flightsw.icd.config import assignment, keys_below
from flightsw.icd.mission import ConfigError, ReconstructSection, build
from obbgs_base.values import names_like
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import budget_changes, preset, quality_changes
from obbgs_core.settings import known_names


def all_changes(
    section: ReconstructSection,
    method: str,
    quality: str | None,
    budget: str,
    assignments: Sequence[str],
) -> dict:
    """Return the changes to a method's preset: of the mission file, over those the options, over those `--set`.

    Raises:
        ValueError: as in the functions below, or an option and `--set` say the same thing twice.
    """
    by_set = set_changes(assignments)
    if budget != "auto" and (name := "growth.max_gaussians") in by_set:
        raise ConfigError(f"--set {name}", "is given by --budget too: leave one of them out")
    return mission_changes(section) | changes_for(method, quality, budget) | by_set


def changes_for(method: str, quality: str | None = None, budget: str = "auto") -> dict:
    """Return the changes to a method's preset that the options of a command ask for.

    A budget in numbers holds as it is: the number of lit pixels does not lower it.

    Raises:
        ValueError: no such method or quality, or a budget that is neither `auto` nor a number.
    """
    config, changes = preset(method), {}
    if quality is not None:
        changes = quality_changes(config, quality)
    if budget != "auto":
        if not (budget.isascii() and budget.isdigit()) or int(budget) < 2:
            raise ValueError(f"--budget must be auto or a number of at least 2 Gaussians, got {budget!r}")
        changes = budget_changes(config, changes, int(budget))
    return changes


def mission_changes(section: ReconstructSection) -> dict:
    """Return the changes to its method's preset that a mission file asks for.

    Raises:
        ConfigError: no such setting, or a value of the wrong type; names its path.
    """
    steps = {"steps": section.steps} if section.steps else {}
    return steps | checked_settings(section.settings, "mission.reconstruct.settings")


def set_changes(assignments: Sequence[str]) -> dict:
    """Return the settings in texts such as `growth.interval=60`; the values are YAML.

    Raises:
        ConfigError: not such a text, no such setting, one given twice, or a value of the wrong type.
    """
    changes: dict[str, object] = {}
    for text in assignments:
        key, given = assignment(text)
        group, dot, name = key.partition(".")
        tree = {group: {name: given} if dot else given}
        with keys_below(f"--set {key}", f"--set.{key}"):
            checked = checked_settings(tree, "--set")
        for name, setting in checked.items():
            if name in changes:
                raise ConfigError(f"--set {name}", "is given twice")
            changes[name] = setting
    return changes


def checked_settings(tree: dict, path: str) -> dict:
    """Return settings of a method by names such as `steps` or `growth.interval`, with the types that it wants.

    Args:
        tree: a mapping of settings; those of a group are a mapping themselves.

    Raises:
        ConfigError: no such setting, or a value of the wrong type or out of its range; names its path.
    """
    given = {name for name, value in tree.items() if not isinstance(value, dict)}
    given |= {f"{group}.{name}" for group, inner in tree.items() if isinstance(inner, dict) for name in inner}
    known = [name for name in known_names(MethodConfig) if name != "name"]
    groups = {name.partition(".")[0] for name in known}
    for name in sorted(given - {*known, *groups}):
        raise ConfigError(f"{path}.{name}", f"unknown key; {names_like(name, known)}")
    try:
        config = build(MethodConfig, tree, path, name="")
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(path, str(error)) from error
    return {name: operator.attrgetter(name)(config) for name in known if name in given}
