"""The one place that opens serial ports and CAN buses, for the spacecraft and the ground alike.

It knows the interface contract (`flightsw.icd`) and nothing else of either side.
"""

from flightsw.icd.can import CanSide
from flightsw.icd.link_url import parse_link_url
from flightsw.ports.port import Link, LinkError
from flightsw.ports.serial_port import SerialLink
from flightsw.ports.slcan import SlcanLink
from flightsw.ports.socketcan import SocketCanLink

__all__ = ["Link", "LinkError", "SerialLink", "SlcanLink", "SocketCanLink", "open_link"]


def open_link(url: str, side: CanSide) -> Link:
    """Return the open link that a URL names: serial:///dev/..., slcan:///dev/... or can://can0.

    Args:
        side: whose end this is, FLIGHT_SIDE or GROUND_SIDE; on CAN it decides which identifiers are sent.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port cannot be opened.
    """
    match parse_link_url(url).scheme:
        case "serial":
            return SerialLink(url)
        case "slcan":
            return SlcanLink(url, side)
        case _:
            return SocketCanLink(url, side)
