"""A virtual link by the name of its kind and the text of its faults."""

from hil.choices import LinkKind
from hil.links.faults import LinkFaults
from hil.links.virtual_can import VirtualCan
from hil.links.virtual_link import VirtualLink
from hil.links.virtual_serial import VirtualSerial


def virtual_link(
    kind: LinkKind, trouble: LinkFaults, baud_rate: int, bitrate: int = 1_000_000
) -> VirtualLink:
    """Return a virtual serial line of `baud_rate` or a CAN bus of `bitrate`, bits a second, not yet running."""
    if kind == "serial":
        return VirtualSerial(
            baud_rate, trouble.faults, trouble.seed, trouble.latency_s, flow_control=not trouble.overrun
        )
    fd = kind == "slcan-fd"
    return VirtualCan(bitrate, fd, trouble.faults, trouble.seed, trouble.latency_s, trouble.one_shot)
