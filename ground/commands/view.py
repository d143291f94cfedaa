"""The command of `ground` that shows models in the browser."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from obbgs_base.command_line import AsJson
from obbgs_base.imports import quick_imports
from obbgs_base.output import output_may_fail
from obbgs_base.stopping import stop_on_signals

stderr = Console(stderr=True)


@output_may_fail()
def view_command(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Folders of runs, one or two side by side, or of a session: its newest run.",
        ),
    ],
    host: Annotated[
        str, typer.Option(help="The address to serve at; any but this machine's own lets others watch.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The TCP port of the page; 0: any that is free.")
    ] = 8080,
    json_: AsJson = False,
) -> None:
    """Show a model on a page in the browser, with its cameras, frames and the Sun, until stopped.

    A run that is still being made is drawn again whenever its model is renewed; until there is one the page waits.

    Example: ground view pass-12/runs/first
    """
    if len(runs) > 2:
        raise ValueError(f"expected one run or two, got {len(runs)}")
    with quick_imports():
        from ground.show.viewer.door import is_loopback
        from ground.show.viewer.source import Source
        from ground.show.viewer.viewer import view

    stop = stop_on_signals()
    if not is_loopback(host):
        stderr.print(f"serving at {host}: everyone who reaches this port sees the model and the frames")
    sources = [Source(path) for path in runs]

    def say(bound: int) -> None:
        url, names = f"http://{host}:{bound}", [source.name for source in sources]
        print(
            json.dumps({"url": url, "runs": names}) if json_ else f"{url} shows {', '.join(names)}",
            flush=True,
        )

    view(sources, host, port, say, stop.is_set)
