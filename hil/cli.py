"""The command line `hil`: demo, camera, link, scenario, dataset, target."""

import contextlib
import dataclasses
import io
import json
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import TaskID

from flightsw.icd.mission import load_mission
from hil.choices import SKY, LinkKind, SkyKind, navigation_of
from hil.sky import SHIPPED, SHIPPED_FOIL, Materials
from obbgs_base.command_line import MISSION_HELP, OUT_HELP, SET_HELP, AsJson, new_app, run
from obbgs_base.locks import one_command_in
from obbgs_base.output import output_may_fail
from obbgs_base.stopping import stop_on_signals

app = new_app("The simulated world: sky, target, camera and link, so that a pass runs on a desk.")
MissionFile = Annotated[Path, typer.Option("--mission", help=f"{MISSION_HELP}.")]
Mesh = Annotated[
    Path,
    typer.Option(
        "--mesh", help="The target: GLB, OBJ or STL; default: the shipped spacecraft.", show_default=False
    ),
]
ScenarioName = Annotated[
    str,
    typer.Option(
        "--scenario", help="A ready-made scenario or a YAML file; default: the mission's own orbits."
    ),
]
Navigation = Annotated[
    str,
    typer.Option(
        "--navigation",
        help="The errors of navigation: realistic or realistic:SEED: 0.1 degrees of boresight, 2 % of the range along "
        "the track, 0.2 % of the spin rate, 20 ms and 0.02 degrees of noise, and the tags say so; perfect: tags are "
        "exact.",
    ),
]
Gige = Annotated[
    bool, typer.Option("--gige", help="GigE Vision on 127.0.0.1 instead of this project's own protocol.")
]
Bus = Annotated[
    LinkKind,
    typer.Option(
        "--bus", help="What the link is; slcan: a CAN bus, slcan-fd: a CAN FD bus (data at 5 Mbit/s)."
    ),
]
LinkTrouble = Annotated[
    str,
    typer.Option(
        "--faults",
        help="What the link does to packets (CAN: frames): none; standard: 2 % each lost, flipped, doubled and "
        "reordered, and in a demo a cut of 5 s; or fractions for loss, bit_flip, duplicate and reorder, latency in "
        "seconds, overrun (serial: without flow control), one_shot (CAN: what is destroyed is not repeated) and the "
        "seed of it all, as in loss=0.02,latency=0.2,seed=3.",
    ),
]
RealTime = Annotated[
    float,
    typer.Option(
        "--real-time", help="Speed of simulated time as a multiple of real time; 0: as fast as possible."
    ),
]


@app.command()
@output_may_fail()
def demo(
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}.")] = Path("demo"),
    mission: MissionFile = Path("mission.yaml"),
    mesh: Mesh = SHIPPED,
    gige: Gige = False,
    bus: Bus = "serial",
    faults: LinkTrouble = "none",
    scenario: ScenarioName = "",
    real_time: RealTime = 0.0,
    navigation: Navigation = "realistic",
    sky: Annotated[
        SkyKind,
        typer.Option(
            help="real: the Earth with clouds and limb from the orbit, stars, the Sun's stray light, and a dark level "
            "that drifts; black: nothing but the target."
        ),
    ] = SKY,
    json_: AsJson = False,
) -> None:
    """Simulate a whole pass, from rendered frames over flight, link and ground to a model and its report.

    Example: hil demo --gige --bus slcan --faults standard --scenario tumbling --out demo
    """
    from hil.demo import run_demo
    from hil.links.faults import LinkFaults
    from hil.processes import unwind_on_sigterm
    from hil.simulated_pass import PassConfig

    unwind_on_sigterm()
    kind, seed = navigation_of(navigation)
    LinkFaults.parse(faults)  # refused before anything is written
    config = PassConfig(gige, bus, faults, scenario, kind, real_time, seed, sky=sky)
    figures = run_demo(out, mission, mesh, config, Console(stderr=json_))
    if json_:
        print(json.dumps(figures))


@app.command()
@output_may_fail()
def camera(
    listen: Annotated[
        str, typer.Option(help="hil:///path/to/socket, or hil://host:port; port 0 chooses a free one.")
    ] = "hil://127.0.0.1:0",
    mission: MissionFile = Path("mission.yaml"),
    mesh: Mesh = SHIPPED,
    cache: Annotated[Path, typer.Option(help="Folder in which rendered frames are kept.")] = Path("renders"),
    gige: Gige = False,
    scenario: ScenarioName = "",
    out: Annotated[
        Path,
        typer.Option(
            help=f"{OUT_HELP}; with --scenario: the mission.yaml and navigation states of flight and ground."
        ),
    ] = Path("scenario"),
    navigation: Navigation = "realistic",
    real_time: RealTime = 0.0,
    prerender: Annotated[
        bool,
        typer.Option(
            "--prerender",
            help="Render the planned exposures before serving; those already in --cache are kept. A GigE client that "
            "gives no times then sees the planned moment nearest to the simulated time, over and over.",
        ),
    ] = False,
    json_: AsJson = False,
) -> None:
    """Serve the simulated camera until stopped; prints its URL. Frames are rendered when a client requests them.

    With --gige any GenICam client can use it: `arv-viewer-0.8`, `arv-camera-test-0.8 -n 127.0.0.1`, `flightsw`. One
    that takes pictures at its own rate wants --prerender, too.

    Example: hil camera --listen hil:///tmp/camera.sock --scenario v-bar --mesh target.glb
    """
    from hil.camera_service import serve_camera
    from hil.processes import unwind_on_sigterm
    from hil.world.navigation import write_flight_inputs
    from hil.world.world import load_world

    kind, seed = navigation_of(navigation)
    world = load_world(load_mission(mission), scenario)
    with contextlib.ExitStack() as held:
        if scenario:
            # while this serves: flight and ground read what is written there
            held.enter_context(one_command_in(out, "hil"))
            written = write_flight_inputs(world, out, seed if kind == "realistic" else None)
            print(f"start flight with --mission {written.mission_path}", file=sys.stderr)
        unwind_on_sigterm()  # while rendering; then a signal ends the service
        where = None if gige else listen
        console = Console(stderr=True)
        serve_camera(world, mesh, cache, where, real_time, prerender, stop_on_signals, console, json_)


@app.command()
@output_may_fail()
def link(
    bus: Bus = "serial",
    rate: Annotated[
        int | None,
        typer.Option(
            min=10,
            max=100_000_000,
            help="Bits per second; default: 921600 of a serial line, 1000000 of a CAN bus.",
        ),
    ] = None,
    faults: LinkTrouble = "none",
    json_: AsJson = False,
) -> None:
    """Run a virtual serial line or CAN bus with faults until stopped; prints the URLs of both ends, then the counts.

    While it runs it reads commands from standard input, one a line: cut, mend, latency 0.2, loss 0.1, and bit_flip,
    duplicate or reorder with a fraction. SIGUSR1 and SIGUSR2 also cut and mend.

    Example: hil link --rate 115200 --faults loss=0.02,bit_flip=0.01,seed=3
    """
    from hil.link_by_name import virtual_link
    from hil.links.faults import LinkFaults
    from hil.links.virtual_link import VirtualLink, control, run_link

    line = virtual_link(bus, LinkFaults.parse(faults), rate or 921_600, rate or 1_000_000)

    def read_commands() -> None:
        if isinstance(sys.stdin, io.TextIOWrapper):
            sys.stdin.reconfigure(errors="replace")  # bytes that are not UTF-8 are an unknown command
        for command in sys.stdin:
            try:
                print(control(line, command), file=sys.stderr)
            except ValueError as error:
                print(error, file=sys.stderr)

    def ready(line: VirtualLink) -> None:
        signal.signal(signal.SIGUSR1, lambda *_: line.cut())
        signal.signal(signal.SIGUSR2, lambda *_: line.mend())
        urls = {"flight": line.flight_url, "ground": line.ground_url}
        print(json.dumps(urls) if json_ else "\n".join(map(" ".join, urls.items())), flush=True)
        threading.Thread(target=read_commands, daemon=True).start()

    stop = stop_on_signals()
    counts = run_link(line, ready, stop.is_set)
    print(json.dumps({direction: vars(lane) for direction, lane in counts.items()}))


@app.command()
def scenario(
    name: Annotated[str, typer.Argument(help="A ready-made scenario or a YAML file.")] = "fly-around",
    fly_around: Annotated[
        str | None,
        typer.Option(
            metavar="HEIGHT[,WIDTH]",
            help="Design a fly-around about the mission's target instead: half of the ellipse's height and of its "
            "width across the orbit, m, such as 150,200. Default of the width: that of constant range.",
        ),
    ] = None,
    mission: MissionFile = Path("mission.yaml"),
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}; the chaser's TLE of --fly-around.")] = Path(
        "chaser.tle"
    ),
    json_: AsJson = False,
) -> None:
    """Print a scenario's range, phase angle and eclipses; or design a fly-around and write the chaser's TLE.

    The errors are distances between the orbit of the printed elements and the intended one, the unrounded one without
    the rounding to a TLE's digits. Elements (da to diy) are relative orbital elements in metres.

    Example: hil scenario tumbling --json; hil scenario --fly-around 150 --out chaser.tle
    """
    from hil.world.fly_around import FlyAround, design
    from hil.world.scenario import describe, load_scenario

    if fly_around is None:
        facts = describe(load_scenario(name))
    else:
        orbit = load_mission(mission).orbit
        wanted = FlyAround(*_half_axes(fly_around))
        made = design(orbit.target_tle, wanted, orbit.start_utc_ns, span_s=0.0)  # at least one orbit
        out.write_text("\n".join(made.chaser_tle) + "\n")
        facts = {**dataclasses.asdict(made), "half_width_m": wanted.half_width_m, "written": str(out)}
    print(json.dumps(facts) if json_ else "\n".join(_lines(facts)))


@app.command()
@output_may_fail()
def dataset(
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}; with --targets it holds a folder for each.")],
    mesh: Annotated[
        Path | None,
        typer.Option(
            help="The target: GLB, OBJ or STL; default: the shipped spacecraft. With --targets: the folder of their "
            "meshes, default: here."
        ),
    ] = None,
    targets: Annotated[
        str | None,
        typer.Option(help="A data set of several targets: obr-st, obr-st-small or a YAML file."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help=f"{SET_HELP}; of the data set: scenario, frames, size_px, bracket_ms, sensor (paper: 8 bits with the "
            "noise of Jiang et al. 2025; spacecam: a scientific CMOS), seed, materials (own, or foil: crinkled foil, "
            "and cell glass where it is dark).",
        ),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Make a data set with its truth, as a session and in NeRF-synthetic layout; an interrupted one is continued.

    Rendered pictures are kept in renders/ beside the data set, so that another one of the same views finds them.

    Example: hil dataset --mesh TDRS.glb --set scenario=v-bar --set frames=90 --set size_px=200 --out tdrs
    """
    from hil.dataset import Progress, load_dataset_config, make_dataset, target_meshes
    from hil.progress import progress_bar

    config = load_dataset_config(targets, settings or ())
    if targets is not None:
        jobs = [(path, out / path.stem) for path in target_meshes(config, mesh or Path())]
    else:
        jobs = [(mesh or (SHIPPED_FOIL if config.materials == "foil" else SHIPPED), out)]
    cache = out.absolute().parent / "renders"
    bars = progress_bar(Console(stderr=True), label_width=20)
    with contextlib.ExitStack() as shown:
        tasks: dict[str, TaskID] = {}

        def show(step: Progress) -> None:
            label = f"{step.target} {step.step}"
            if not tasks:  # bars without a task would leave an empty line before an error
                shown.enter_context(bars)
            if label not in tasks:
                tasks[label] = bars.add_task(label, total=step.total)
            bars.update(tasks[label], completed=step.done)

        made = {}
        for path, folder in jobs:
            with one_command_in(folder, "hil"):
                made[path.stem] = make_dataset(config, path, folder, cache, on_progress=show)
    if json_:
        print(json.dumps(made))
    for target_name, facts in () if json_ else made.items():
        split = ", ".join(f"{count} {name}" for name, count in facts["split"].items())
        print(f"{target_name}: {facts['frames']} frames ({split}), {facts['in_eclipse']} in eclipse")


@app.command()
def target(
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}.")] = Path("spacecraft.glb"),
    materials: Annotated[
        Materials,
        typer.Option(
            help="own: nearly matt; foil: crinkled gold foil, glossy cell glass and a polished dish."
        ),
    ] = "own",
    json_: AsJson = False,
) -> None:
    """Write the shipped target, a parametric spacecraft, as binary glTF; the bytes are the same on every machine.

    Example: hil target --materials foil --out spacecraft.glb
    """
    shipped = SHIPPED_FOIL if materials == "foil" else SHIPPED
    out.write_bytes(shipped.read_bytes())  # not built again: rounding differs between processors
    print(json.dumps({"mesh": str(out)}) if json_ else out)


def _half_axes(text: str) -> list[float]:
    """Return half of a fly-around's height and, where it is given, of its width, m."""
    try:
        axes = [float(part) for part in text.split(",")]
    except ValueError:
        axes = []
    if len(axes) not in (1, 2) or not all(0 <= axis < float("inf") for axis in axes):
        raise ValueError(
            f"--fly-around: expected HEIGHT or HEIGHT,WIDTH in metres, such as 150,200, got {text!r}"
        )
    return axes


UNITS = {"_m_per_orbit": " m per orbit", "_m": " m", "_s": " s", "_deg": " deg"}  # by the suffix of a name


def _lines(facts: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each fact: name, number and unit; a range as `low to high`, a TLE in lines of its own."""
    for key, value in facts.items():
        if isinstance(value, dict):
            yield f"{key.replace('_', ' ')}:"
            yield from (f"  {line}" for line in _lines(value))
            continue
        suffix = next((suffix for suffix in UNITS if key.endswith(suffix)), "")
        name, unit = key.removesuffix(suffix).replace("_", " "), UNITS.get(suffix, "")
        if key.endswith("_tle"):
            yield f"{name}:"
            yield from value
        elif isinstance(value, list | tuple):
            yield f"{name:24} {' to '.join(map(_number, value))}{unit}"
        else:
            yield f"{name:24} {value if isinstance(value, str) else _number(value)}{unit}"


def _number(value: float) -> str:
    """Return a number to six figures and at most three decimals."""
    return f"{round(value, 3) + 0.0:.6g}"


def main() -> None:
    """Run the command line."""
    run(app, "hil")


if __name__ == "__main__":
    main()
