"""The commands of `ground` for other people's ground systems: dictionary, yamcs."""

import json
from pathlib import Path
from typing import Annotated

import typer

from obbgs_base.command_line import OUT_HELP, AsJson


def dictionary_command(
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}; an older file is replaced.")],
    json_: AsJson = False,
) -> None:
    """Write the dictionary of telemetry and commands in the format of other ground systems, XTCE 1.2.

    Example: ground dictionary --out obbgs.xml
    """
    from flightsw.icd.telemetry import DICTIONARY
    from ground.link.xtce.document import xtce_document
    from obbgs_base.files import write_whole

    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, xtce_document())
    counts = {name: len(getattr(DICTIONARY, name)) for name in ("telemetry", "events", "reports", "commands")}
    text = ", ".join(f"{count} {name}" for name, count in counts.items())
    print(json.dumps({"file": str(out)} | counts) if json_ else f"{text} in {out}")


def yamcs_command(
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}.")],
    json_: AsJson = False,
) -> None:
    """Write a configuration of Yamcs that shows the telemetry of `ground listen --forward`; its start.sh starts it.

    It has no link for commands: they go through `ground uplink` only. Its ports, UDP 10015 and the pages' TCP 8090,
    stand in its configuration.

    Example: ground yamcs --out yamcs
    """
    from ground.link.yamcs import TELEMETRY_PORT, WEB_PORT, write_yamcs

    write_yamcs(out)
    facts = {
        "start": str(out / "start.sh"),
        "forward": f"udp://127.0.0.1:{TELEMETRY_PORT}",
        "pages": f"http://127.0.0.1:{WEB_PORT}",
    }
    if json_:
        print(json.dumps(facts))
    else:
        print(
            f"start it with {facts['start']}, then: ground listen --forward {facts['forward']}; see {facts['pages']}"
        )
