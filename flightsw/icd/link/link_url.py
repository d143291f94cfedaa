"""Links named by URLs on command lines: parsed and checked here, opened by `flightsw.ports`."""

from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from flightsw.icd.config import ConfigError

DEFAULT_BAUD_RATE = 921_600
EXPECTED = "expected serial:///dev/...?baud=921600, slcan:///dev/...?bitrate=1000000 or can://can0"
OPTIONS = {"serial": {"baud"}, "slcan": {"bitrate", "fd", "baud"}, "can": {"bitrate", "fd"}}
# bit/s of the slcan commands S0 to S9 (LAWICEL CANUSB manual; S9 by python-can)
SLCAN_BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000, 83_300)


@dataclass(frozen=True)
class LinkUrl:
    """A link by name. On CAN `baud_rate` is the adapter's serial line, `bitrate` that of the bus."""

    scheme: str  # serial, slcan or can
    device: str  # path of a port, or name of a SocketCAN interface
    baud_rate: int
    bitrate: int = 0  # bit/s of CAN's arbitration phase
    fd: bool = False  # CAN FD: 64 bytes a frame, data phase at 5 Mbit/s

    @property
    def payload_baud_rate(self) -> int:
        """The baud rate of the serial line (10 bits a byte) that carries packets about as fast as this link.

        An ISO-TP frame of classic CAN has 7 bytes in about 114 bits, one of CAN FD 63 bytes in about 30
        bits and 565 at five times the rate.
        """
        if self.scheme == "serial":
            return self.baud_rate
        return int(self.bitrate * (10 * 63 / 143 if self.fd else 10 * 7 / 114))


def parse_link_url(url: str) -> LinkUrl:
    """Return what a URL names.

    Raises:
        ConfigError: another scheme, no device, or an option that is not known.
    """
    try:
        parts = urlsplit(url)
    except ValueError as error:
        raise ConfigError(url, f"is not a URL: {error}") from error
    device, other = (parts.netloc, parts.path) if parts.scheme == "can" else (parts.path, parts.netloc)
    if parts.scheme not in OPTIONS or not device or other:
        raise ConfigError(url or "the link's URL is empty", EXPECTED)
    options = {name: values[-1] for name, values in parse_qs(parts.query, keep_blank_values=True).items()}
    if unknown := set(options) - OPTIONS[parts.scheme]:
        expected = ", ".join(sorted(OPTIONS[parts.scheme]))
        raise ConfigError(url, f"unknown option {', '.join(sorted(unknown))}; expected {expected}")
    default_baud = DEFAULT_BAUD_RATE if parts.scheme == "serial" else 3_000_000
    baud_text = options.get("baud", str(default_baud))
    if not baud_text.isdecimal() or not 1200 <= int(baud_text) <= 12_000_000:
        raise ConfigError(url, f"expected a baud rate of 1200 to 12000000, got {baud_text!r}")
    if parts.scheme == "serial":
        return LinkUrl("serial", device, int(baud_text))
    bitrate_text, fd_text = options.get("bitrate", "1000000"), options.get("fd", "0")
    if bitrate_text not in map(str, SLCAN_BITRATES):
        rates = ", ".join(map(str, SLCAN_BITRATES))
        raise ConfigError(url, f"expected a CAN bit rate of {rates}, got {bitrate_text!r}")
    if fd_text not in ("0", "1"):
        raise ConfigError(url, f"expected fd=0 or fd=1, got {fd_text!r}")
    return LinkUrl(parts.scheme, device, int(baud_text), int(bitrate_text), fd_text == "1")
