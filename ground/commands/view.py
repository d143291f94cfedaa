"""The command of `ground` that shows models in the browser."""

import signal
import threading
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from obbgs_base.imports import quick_imports
from obbgs_base.output import output_may_fail

stderr = Console(stderr=True)


@output_may_fail()
def view_command(
    run: Annotated[Path, typer.Argument(help="A run's folder, or a session: its newest run.")],
    other: Annotated[Path | None, typer.Argument(help="A second one, shown beside it.")] = None,
    host: Annotated[
        str, typer.Option(help="The address to serve at; any but this machine's own lets others watch.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="The port; 0: any that is free.")] = 8080,
) -> None:
    """Show a model on a page in the browser, with its cameras, frames and the Sun, until stopped.

    A run that is still being made is drawn again whenever its model is renewed; until there is one the page waits.

    Example: ground view pass-12/runs/first
    """
    with quick_imports():
        from ground.show.viewer.door import is_loopback
        from ground.show.viewer.source import Source
        from ground.show.viewer.viewer import view

    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    if not is_loopback(host):
        stderr.print(f"serving at {host}: everyone who reaches this port sees the model and the frames")
    sources = [Source(path) for path in (run, other) if path is not None]
    view(
        sources,
        host,
        port,
        lambda bound: print(f"http://{host}:{bound} shows {', '.join(s.name for s in sources)}", flush=True),
        stop.is_set,
    )
