"""What `flightsw selftest` looks at before a pass: everything is tried for real, and only a key's lock file remains."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from flightsw.icd.mission import Mission
from flightsw.selftest.computer import check_clock, check_computer, check_disk, check_key
from flightsw.selftest.devices import check_camera, check_link
from flightsw.selftest.finding import Finding
from flightsw.selftest.planned_pass import check_orbit, check_view

__all__ = ["Finding", "self_test"]


def self_test(
    mission: Mission,
    store: Path,
    camera_url: str | None = None,
    link_url: str | None = None,
    loopback: bool = False,
    key_files: Sequence[Path] = (),
    on_finding: Callable[[Finding], None] = lambda finding: None,
) -> list[Finding]:
    """Return what was found, one or more findings a check; `on_finding` gets each as soon as it is there.

    Args:
        store: the folder in which the frame store will be; it need not exist yet.
        camera_url, link_url: not checked where they are None.
        loopback: a plug on the link returns what is sent.

    Raises:
        ConfigError: the link's URL is not usable.
        ValueError: there is no driver for the camera's URL.
    """
    checks: list[Callable[[], list[Finding]]] = [
        lambda: check_clock(mission),
        lambda: check_disk(mission, store),
        lambda: check_computer(mission),
        lambda: check_orbit(mission),
        lambda: check_view(mission),
    ]
    checks += [functools.partial(check_key, key_file) for key_file in key_files]
    if link_url is not None:
        checks.append(lambda: check_link(link_url, loopback, mission.link.max_packet_bytes))
    if camera_url is not None:
        checks.append(lambda: check_camera(mission, camera_url))
    findings = []
    for check in checks:
        for finding in check():
            findings.append(finding)
            on_finding(finding)
    return findings
