"""What command lines and configurations of the simulator choose from by name; quick to import, for the help texts."""

from typing import Literal

CameraKind = Literal["hil", "gige"]  # a socket of our own protocol, or GigE Vision on 127.0.0.1
LinkKind = Literal["serial", "slcan", "slcan-fd"]  # a serial line, or a CAN or CAN FD bus with slcan adapters
FaultKind = Literal["none", "standard"]  # standard: hil.links.faults.STANDARD_FAULTS and a cut in the middle
SensorKind = Literal["paper", "spacecam"]  # hil.sky.sensor.PRESETS
NavigationKind = Literal["realistic", "perfect"]  # with the errors of hil.world.navigation_errors, or exact
NAVIGATION: NavigationKind = "realistic"  # unless something else is asked for
