"""The links a command line can name, as URLs. Opening them is each side's own business."""

from urllib.parse import parse_qs, urlsplit

from flightsw.icd.mission import ConfigError

DEFAULT_BAUD_RATE = 921_600


def parse_link_url(url: str) -> tuple[str, int]:
    """Return device path and baud rate of a URL such as serial:///dev/ttyUSB0?baud=921600.

    Raises:
        ConfigError: another scheme, no path, or an option that is not known.
    """
    try:
        parts = urlsplit(url)
    except ValueError as error:
        raise ConfigError(url, f"is not a URL: {error}") from error
    if parts.scheme in ("slcan", "can"):
        raise ConfigError(url, "CAN links are not built yet; use serial:///dev/...?baud=921600")
    if parts.scheme != "serial" or parts.netloc or not parts.path:
        raise ConfigError(url, "expected serial:///dev/...?baud=921600")
    options = parse_qs(parts.query, keep_blank_values=True)
    baud_text = options.pop("baud", [str(DEFAULT_BAUD_RATE)])[-1]
    if options:
        raise ConfigError(url, f"unknown option {', '.join(options)}; expected baud")
    if not baud_text.isdigit() or not 1200 <= int(baud_text) <= 12_000_000:
        raise ConfigError(url, f"expected a baud rate of 1200 to 12000000, got {baud_text!r}")
    return parts.path, int(baud_text)
