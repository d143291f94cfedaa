"""The one place that opens serial ports and CAN buses, for the spacecraft and the ground alike.

It knows the interface contract (`flightsw.icd`) and nothing else of either side.
"""

from flightsw.icd.link.can import CanSide
from flightsw.icd.link.link_url import parse_link_url
from flightsw.ports.port import Link, LinkError
from flightsw.ports.serial_port import SerialLink
from flightsw.ports.slcan import SlcanLink
from flightsw.ports.socketcan import SocketCanLink

__all__ = ["Link", "LinkError", "SerialLink", "SlcanLink", "SocketCanLink", "open_link"]


def open_link(url: str, side: CanSide, must_be_there: bool = True) -> Link:
    """Return the open link that a URL names: serial:///dev/..., slcan:///dev/... or can://can0.

    Args:
        side: whose end this is, FLIGHT_SIDE or GROUND_SIDE; on CAN it decides which identifiers are sent.
        must_be_there: otherwise a port that cannot be opened is tried again with each `exchange`, as after a hang-up.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port must be there and cannot be opened.
    """
    match parse_link_url(url).scheme:
        case "serial":
            return SerialLink(url, must_be_there=must_be_there)
        case "slcan":
            return SlcanLink(url, side, must_be_there=must_be_there)
        case _:
            return SocketCanLink(url, side, must_be_there=must_be_there)
