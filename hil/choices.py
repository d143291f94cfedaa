"""What command lines and configurations of the simulator choose from by name; quick to import, for the help texts."""

from typing import Literal

LinkKind = Literal["serial", "slcan", "slcan-fd"]  # a serial line, or a CAN or CAN FD bus with slcan adapters
SensorKind = Literal["paper", "spacecam"]  # hil.sky.sensor.PRESETS
SkyKind = Literal["real", "black"]  # with what hil.world.surroundings draws, or nothing but the target
SKY: SkyKind = "real"  # unless something else is asked for
NavigationKind = Literal["realistic", "perfect"]  # with the errors of hil.world.navigation_errors, or exact
NAVIGATION: NavigationKind = "realistic"  # unless something else is asked for


def navigation_of(text: str) -> tuple[NavigationKind, int]:
    """Return the kind and the seed of navigation errors that `realistic`, `realistic:SEED` or `perfect` names.

    Raises:
        ValueError: another text.
    """
    kind, colon, seed = text.partition(":")
    if text == "perfect":
        return "perfect", 1
    if kind == "realistic" and (not colon or (seed.isascii() and seed.isdigit())):
        return "realistic", int(seed or 1)
    raise ValueError(f"--navigation: expected realistic, realistic:SEED or perfect, got {text!r}")
