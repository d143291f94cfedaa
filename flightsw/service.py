"""The systemd unit that runs `flightsw serve` of this installation as a user of its own."""

import re
import sys
from pathlib import Path

from flightsw.cameras import driver_of
from flightsw.icd.config import ConfigError
from flightsw.icd.link.link_url import parse_link_url

TEMPLATE = Path(__file__).with_name("obbgs-flight.service")
STATE = Path("/var/lib/obbgs")
MISSION = Path("/etc/obbgs/mission.yaml")
HIDDEN = ("/home", "/root", "/run/user")  # from a service, by ProtectHome


def unit(
    camera_url: str, link_url: str, mission: Path = MISSION, key: Path | None = None, user: str = "obbgs"
) -> str:
    """Return the text of the unit; its first lines say how to install it.

    Args:
        key: where the key will lie; its folder must be the user's, since the counter beside it is written.

    Raises:
        ConfigError: a path is not absolute or hidden from services, the link's URL or the user's name cannot be used,
            or this Python has no command `flightsw`.
        ValueError: there is no driver for the camera's URL.
    """
    driver_of(camera_url)
    parse_link_url(link_url)
    if not re.fullmatch(r"[a-z_][a-z0-9_-]{0,31}", user):
        raise ConfigError("--user", f"expected the name of a user, such as obbgs, got {user!r}")
    program = Path(sys.prefix) / "bin" / "flightsw"
    if not program.is_file():
        raise ConfigError(
            "the environment", f"there is no {program}: install the package into this environment"
        )
    key = STATE / "mission.key" if key is None else key
    for option, path in (("--mission", mission), ("--key", key), ("the environment", program)):
        if not path.is_absolute():
            raise ConfigError(
                option, f"expected an absolute path, a service starts in no folder of yours, got {path}"
            )
        if any(path.is_relative_to(folder) for folder in HIDDEN):
            raise ConfigError(
                option, f"a service cannot read {path}: choose a place such as /opt, /etc or {STATE}"
            )
    arguments = ["--mission", mission, "--key", key, "--store", STATE / "store"]
    arguments += ["--camera", camera_url, "--link", link_url]
    start = " ".join(_quoted(str(word)) for word in (program, "serve", *arguments))
    lines = [
        line
        for line in TEMPLATE.read_text().splitlines()
        if not line.startswith(("#  ", "ExecStart=", "User="))
    ]
    place = lines.index("Type=notify") + 1
    lines[place:place] = [f"User={user}", f"ExecStart={start}"]
    head = [
        f"# The user:    useradd --system --home-dir {STATE} --create-home --groups dialout {user}",
        f"# The key:     install -o {user} -m 600 mission.key mission.key.received* {key.parent}/",
        f"# The mission: install -D -m 644 mission.yaml {mission}",
        "# This unit:   write it to /etc/systemd/system/obbgs-flight.service, then systemctl enable --now obbgs-flight",
    ]
    return "\n".join([*head, *lines[1:]]) + "\n"


def _quoted(word: str) -> str:
    """Return a word of a command line as systemd reads it (systemd.service(5), "Command lines")."""
    if "\n" in word:
        raise ConfigError(repr(word), "expected one line")
    word = word.replace("\\", "\\\\").replace("%", "%%").replace("$", "$$").replace('"', '\\"')
    return f'"{word}"' if re.search(r"[\s'\"\\;]", word) else word
