"""The commands of `ground` for other people's ground systems: dictionary, yamcs."""

import json
from pathlib import Path
from typing import Annotated

import typer

from ground.commands.options import AsJson


def dictionary_command(
    xtce: Annotated[Path, typer.Option(help="The XTCE 1.2 file to write; an older one is replaced.")],
    json_: AsJson = False,
) -> None:
    """Write the dictionary of telemetry and commands in the format of other ground systems.

    Example: ground dictionary --xtce obbgs.xml
    """
    from flightsw.icd.telemetry import DICTIONARY
    from ground.link.xtce.document import xtce_document
    from obbgs_base.files import write_whole

    xtce.parent.mkdir(parents=True, exist_ok=True)
    write_whole(xtce, xtce_document())
    counts = {name: len(getattr(DICTIONARY, name)) for name in ("telemetry", "events", "reports", "commands")}
    text = ", ".join(f"{count} {name}" for name, count in counts.items())
    print(json.dumps({"file": str(xtce)} | counts) if json_ else f"{text} in {xtce}")


def yamcs_command(
    out: Annotated[Path, typer.Option(help="The folder to make.")],
    port: Annotated[
        int, typer.Option(min=1, max=65535, help="The UDP port on which Yamcs waits for packets.")
    ] = 10015,
    web_port: Annotated[
        int, typer.Option(min=1, max=65535, help="The TCP port of its web pages, on 127.0.0.1.")
    ] = 8090,
    json_: AsJson = False,
) -> None:
    """Write a configuration of Yamcs that shows the telemetry of `ground listen --forward`; its start.sh starts it.

    It has no link for commands: they go through `ground uplink` only.

    Example: ground yamcs --out yamcs
    """
    from ground.link.yamcs import write_yamcs

    write_yamcs(out, port, web_port)
    facts = {
        "start": str(out / "start.sh"),
        "forward": f"udp://127.0.0.1:{port}",
        "pages": f"http://127.0.0.1:{web_port}",
    }
    if json_:
        print(json.dumps(facts))
    else:
        print(
            f"start it with {facts['start']}, then: ground listen --forward {facts['forward']}; see {facts['pages']}"
        )
