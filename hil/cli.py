"""hil: demo, camera, link, target."""

import json
import logging
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flightsw.errors import FlightError
from flightsw.icd.mission import ConfigError, load_mission
from hil import spacecraft

app = typer.Typer(
    add_completion=False, no_args_is_help=True, help="The simulated world around flight and ground."
)
MissionFile = Annotated[Path, typer.Option("--mission", help="The mission file.")]
Mesh = Annotated[Path, typer.Option("--mesh", help="GLB, OBJ or STL; default the shipped spacecraft.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Everything is written below this folder.")] = Path("demo"),
    mission: MissionFile = Path("mission.yaml"),
    mesh: Mesh = spacecraft.SHIPPED,
    json_: AsJson = False,
) -> None:
    """Run the whole loop: sky, camera, flight, serial line, ground, model, report.

    Example: hil demo --out demo --mesh spacecraft.glb
    """
    from hil.demo import run_demo

    figures = run_demo(out, mission, mesh, Console(stderr=json_))
    if json_:
        print(json.dumps(figures))


@app.command()
def camera(
    socket: Annotated[Path, typer.Option(help="Unix socket to serve on.")] = Path("camera.sock"),
    mission: MissionFile = Path("mission.yaml"),
    mesh: Mesh = spacecraft.SHIPPED,
    cache: Annotated[Path, typer.Option(help="Rendered frames are kept here.")] = Path("renders"),
) -> None:
    """Serve the simulated camera until stopped; frames are rendered when they are asked for.

    Example: hil camera --socket /tmp/camera.sock --mesh target.glb
    """
    from hil.blender import RenderFarm
    from hil.virtual_camera import CameraServer

    loaded = load_mission(mission)
    stop = _stop_event()
    with RenderFarm(loaded, mesh, cache, workers=1) as farm, CameraServer(loaded, farm, socket) as server:
        print(server.url, flush=True)
        stop.wait()
        print(f"{server.exposures} exposures served", file=sys.stderr)


@app.command()
def link(
    baud: Annotated[int, typer.Option(help="Bits per second; a byte takes ten.")] = 921_600,
    loss: Annotated[float, typer.Option(help="Share of packets lost.")] = 0.0,
    flip: Annotated[float, typer.Option(help="Share of packets with a flipped bit.")] = 0.0,
    duplicate: Annotated[float, typer.Option(help="Share of packets sent twice.")] = 0.0,
    reorder: Annotated[float, typer.Option(help="Share of packets that change places.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Same seed, same faults.")] = 0,
) -> None:
    """Run a virtual serial line with seeded faults until stopped; prints both ends, and the counts at the end.

    Example: hil link --baud 921600 --loss 0.02 --flip 0.01 --seed 3
    """
    from hil.virtual_link import Faults, VirtualSerial, run_link

    def ready(line: VirtualSerial) -> None:
        print(f"flight {line.flight_url}\nground {line.ground_url}", flush=True)

    stop = _stop_event()
    counts = run_link(baud, Faults(loss, flip, duplicate, reorder), seed, ready, stop.is_set)
    print(json.dumps({direction: vars(lane) for direction, lane in counts.items()}))


@app.command()
def target(out: Annotated[Path, typer.Option(help="The GLB to write.")] = Path("spacecraft.glb")) -> None:
    """Write the shipped target, a parametric spacecraft, as binary glTF.

    Example: hil target --out spacecraft.glb
    """
    spacecraft.write(out)
    print(out)


def _stop_event() -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop


def main() -> None:
    """Run the command line; one clear line for what went wrong, exit code 2 for usage and configuration, 1 for work."""
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(_fail("interrupted; run it again, finished rendering is kept", 1))
    except (ConfigError, ValueError) as error:
        sys.exit(_fail(str(error), 2))
    except FlightError as error:
        sys.exit(_fail(str(error), 1))
    except RuntimeError as error:
        if type(error).__module__.partition(".")[0] != "hil":
            raise
        sys.exit(_fail(str(error), 1))


def _fail(message: str, code: int) -> int:
    print(f"hil: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
