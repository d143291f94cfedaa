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

from flightsw.icd.frame import Attitude
from flightsw.icd.mission import load_mission
from hil.choices import NAVIGATION, CameraKind, FaultKind, LinkKind, NavigationKind, SensorKind
from hil.sky import SHIPPED, SHIPPED_FOIL, Materials
from obbgs_base.command_line import new_app, refuse_beside, run
from obbgs_base.locks import one_command_in
from obbgs_base.output import output_may_fail

app = new_app("The simulated world: sky, target, camera and link, so that a pass runs on a desk.")
MissionFile = Annotated[Path, typer.Option("--mission", help="The mission file.")]
Mesh = Annotated[
    Path,
    typer.Option(
        "--mesh", help="The target: GLB, OBJ or STL; default: the shipped spacecraft.", show_default=False
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
ScenarioName = Annotated[
    str,
    typer.Option(
        "--scenario", help="A ready-made scenario or a YAML file; default: the mission's own orbits."
    ),
]
Navigation = Annotated[
    NavigationKind,
    typer.Option(
        help="realistic: poses err by 0.1 degrees of boresight, 2 % of the range along the track, 0.2 % of the spin "
        "rate, 20 ms and 0.02 degrees of noise, and the tags say so; perfect: tags are exact."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the navigation errors.")]
KnownAttitude = Annotated[
    Attitude | None,
    typer.Option(
        help="What flight knows of the target's attitude; default: what the mission says. With unknown, its tags are "
        "in inertial axes."
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
    out: Annotated[Path, typer.Option(help="Everything is written below this folder.")] = Path("demo"),
    mission: MissionFile = Path("mission.yaml"),
    mesh: Mesh = SHIPPED,
    camera: Annotated[
        CameraKind,
        typer.Option(help="hil: this project's own protocol on a socket; gige: GigE Vision on 127.0.0.1."),
    ] = "hil",
    link: Annotated[
        LinkKind,
        typer.Option(
            help="serial: a serial line; slcan: a CAN bus, slcan-fd: a CAN FD bus, both at 1 Mbit/s."
        ),
    ] = "serial",
    faults: Annotated[
        FaultKind,
        typer.Option(
            help="standard: 2 % of the packets each lost, damaged, doubled and reordered, and a cut of 5 s."
        ),
    ] = "none",
    scenario: ScenarioName = "",
    real_time: RealTime = 0.0,
    navigation: Navigation = NAVIGATION,
    seed: Seed = 1,
    attitude: KnownAttitude = None,
    json_: AsJson = False,
) -> None:
    """Simulate a whole pass, from rendered frames over flight, link and ground to a model and its report.

    Example: hil demo --camera gige --link slcan --faults standard --scenario tumbling --out demo
    """
    from hil.demo import run_demo
    from hil.processes import unwind_on_sigterm
    from hil.simulated_pass import PassConfig

    unwind_on_sigterm()
    config = PassConfig(camera, link, faults, scenario, navigation, real_time, seed, attitude)
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
    gige: Annotated[
        bool, typer.Option("--gige", help="Serve GigE Vision on 127.0.0.1 instead of --listen.")
    ] = False,
    scenario: ScenarioName = "",
    inputs: Annotated[
        Path,
        typer.Option(
            help="With --scenario: where the mission.yaml and navigation states for flight and ground are written; the "
            "three options below are of these."
        ),
    ] = Path("scenario"),
    navigation: Navigation = NAVIGATION,
    seed: Seed = 1,
    attitude: KnownAttitude = None,
    real_time: RealTime = 0.0,
    prerender: Annotated[
        bool,
        typer.Option(
            "--prerender",
            help="Render the planned exposures before serving; those already in --cache are kept. A GigE client that "
            "gives no times then sees the planned moment nearest to the simulated time, over and over.",
        ),
    ] = False,
) -> None:
    """Serve the simulated camera until stopped; prints its URL. Frames are rendered when a client requests them.

    With --gige any GenICam client can use it: `arv-viewer-0.8`, `arv-camera-test-0.8 -n 127.0.0.1`, `flightsw`. One
    that takes pictures at its own rate wants --prerender, too.

    Example: hil camera --listen hil:///tmp/camera.sock --scenario v-bar --mesh target.glb
    """
    from hil.camera_service import serve_camera
    from hil.processes import unwind_on_sigterm
    from hil.world.navigation import write_flight_inputs
    from hil.world.world import load_world, told

    world = load_world(told(load_mission(mission), attitude), scenario)
    with contextlib.ExitStack() as held:
        if scenario:
            # while this serves: flight and ground read what is written there
            held.enter_context(one_command_in(inputs, "hil"))
            written = write_flight_inputs(world, inputs, seed if navigation == "realistic" else None)
            print(f"start flight with --mission {written.mission_path}", file=sys.stderr)
        unwind_on_sigterm()  # while rendering; then a signal ends the service
        where = None if gige else listen
        serve_camera(world, mesh, cache, where, real_time, prerender, _stop_event, Console(stderr=True))


@app.command()
@output_may_fail()
def link(
    can: Annotated[
        bool, typer.Option(help="Two slcan adapters on a CAN bus instead of a serial line.")
    ] = False,
    fd: Annotated[
        bool, typer.Option(help="The bus is CAN FD, data phase at 5 Mbit/s; implies --can.")
    ] = False,
    baud: Annotated[
        int, typer.Option(min=10, max=100_000_000, help="Serial: bits per second; a byte takes 10.")
    ] = 921_600,
    bitrate: Annotated[int, typer.Option(help="CAN: bits per second.")] = 1_000_000,
    latency: Annotated[
        float, typer.Option(help="Delay from one end to the other, s, in addition to the transmission time.")
    ] = 0.0,
    loss: Annotated[float, typer.Option(help="Fraction of packets (CAN: frames) lost.")] = 0.0,
    flip: Annotated[float, typer.Option(help="Fraction of packets (CAN: frames) with a flipped bit.")] = 0.0,
    duplicate: Annotated[float, typer.Option(help="Fraction of them sent twice.")] = 0.0,
    reorder: Annotated[float, typer.Option(help="Fraction of them that changes places with the next.")] = 0.0,
    overrun: Annotated[
        bool, typer.Option(help="Serial: no flow control; bytes that are not read in time are lost.")
    ] = False,
    one_shot: Annotated[
        bool, typer.Option(help="CAN: the controller does not repeat a frame that is destroyed on the bus.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random faults.")] = 0,
) -> None:
    """Run a virtual serial line or CAN bus with faults until stopped; prints the URLs of both ends, then the counts.

    While it runs it reads commands from standard input, one a line: cut, mend, latency 0.2, loss 0.1, and bit_flip,
    duplicate or reorder with a fraction. SIGUSR1 and SIGUSR2 also cut and mend.

    Example: hil link --baud 921600 --loss 0.02 --flip 0.01 --seed 3
    """
    from hil.links.faults import Faults
    from hil.links.virtual_can import VirtualCan
    from hil.links.virtual_link import VirtualLink, control, run_link
    from hil.links.virtual_serial import VirtualSerial

    faults = Faults(loss, flip, duplicate, reorder)
    line: VirtualLink
    if can or fd:
        line = VirtualCan(bitrate, fd, faults, seed, latency, one_shot)
    else:
        line = VirtualSerial(baud, faults, seed, latency, flow_control=not overrun)

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
        print(f"flight {line.flight_url}\nground {line.ground_url}", flush=True)
        threading.Thread(target=read_commands, daemon=True).start()

    stop = _stop_event()
    counts = run_link(line, ready, stop.is_set)
    print(json.dumps({direction: vars(lane) for direction, lane in counts.items()}))


@app.command()
def scenario(
    name: Annotated[str, typer.Argument(help="A ready-made scenario or a YAML file.")] = "fly-around",
    fly_around: Annotated[
        bool, typer.Option("--fly-around", help="Design a fly-around about the mission's target instead.")
    ] = False,
    mission: MissionFile = Path("mission.yaml"),
    radial: Annotated[
        float, typer.Option(min=0.0, help="With --fly-around: half of the ellipse's height, m.")
    ] = 200.0,
    out_of_plane: Annotated[
        float | None,
        typer.Option(min=0.0, help="Half of its width across the orbit, m; default: that of constant range."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Where --fly-around writes the chaser's TLE.")] = Path(
        "chaser.tle"
    ),
    json_: AsJson = False,
) -> None:
    """Print a scenario's range, phase angle and eclipses; or design a fly-around and write the chaser's TLE.

    The errors are distances between the orbit of the printed elements and the intended one, the unrounded one without
    the rounding to a TLE's digits. Elements (da to diy) are relative orbital elements in metres.

    Example: hil scenario tumbling --json; hil scenario --fly-around --radial 150 --out chaser.tle
    """
    from hil.world.fly_around import FlyAround, design
    from hil.world.scenario import describe, load_scenario

    if not fly_around:
        facts = describe(load_scenario(name))
    else:
        orbit = load_mission(mission).orbit
        wanted = FlyAround(radial, -1.0 if out_of_plane is None else out_of_plane)
        made = design(orbit.target_tle, wanted, orbit.start_utc_ns, span_s=0.0)  # at least one orbit
        out.write_text("\n".join(made.chaser_tle) + "\n")
        facts = {**dataclasses.asdict(made), "half_width_m": wanted.half_width_m, "written": str(out)}
    print(json.dumps(facts) if json_ else "\n".join(_lines(facts)))


@app.command()
@output_may_fail()
def dataset(
    context: typer.Context,
    out: Annotated[
        Path, typer.Option(help="The data set's folder; with --set it holds one folder a target.")
    ],
    mesh: Annotated[
        Path | None, typer.Option(help="The target: GLB, OBJ or STL; default: the shipped spacecraft.")
    ] = None,
    set_: Annotated[
        str | None,
        typer.Option("--set", help="A data set of several targets: obr-st, obr-st-small or a YAML file."),
    ] = None,
    meshes: Annotated[Path, typer.Option(help="Folder of the set's meshes.")] = Path(),
    scenario: Annotated[str, typer.Option(help="A ready-made scenario or a YAML file.")] = "fly-around",
    frames: Annotated[
        int, typer.Option(help="Number of frames, a multiple of the bracket's exposures.")
    ] = 363,
    size: Annotated[int, typer.Option(help="Width and height of a frame, px.")] = 800,
    bracket: Annotated[str, typer.Option(help="Exposure times in ms, comma separated.")] = "0.05,0.1,0.2",
    sensor: Annotated[
        SensorKind,
        typer.Option(help="paper: 8 bits with the noise of Jiang et al. 2025; spacecam: a scientific CMOS."),
    ] = "paper",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 1,
    materials: Annotated[
        Materials,
        typer.Option(help="own: those of the mesh; foil: crinkled foil, and cell glass where it is dark."),
    ] = "own",
    cache: Annotated[Path, typer.Option(help="Folder in which rendered frames are kept.")] = Path("renders"),
    workers: Annotated[int, typer.Option(min=1, help="Number of Blender processes.")] = 2,
    json_: AsJson = False,
) -> None:
    """Make a data set with its truth, as a session and in NeRF-synthetic layout; an interrupted one is continued.

    Example: hil dataset --mesh TDRS.glb --scenario fly-around --frames 363 --size 800 --bracket 0.05,0.1,0.2 --out tdrs
    """
    from flightsw.icd.mission import build
    from hil.dataset import DatasetConfig, Progress, load_dataset_config, make_dataset, target_meshes
    from hil.progress import progress_bar

    if set_ is not None:
        own = ("mesh", "scenario", "frames", "size", "bracket", "sensor", "seed", "materials")
        refuse_beside(context, "--set", own)
        config = load_dataset_config(set_)
        jobs = [(path, out / path.stem) for path in target_meshes(config, meshes)]
    else:
        times_ms = [float(text) for text in bracket.split(",")]
        settings = {"scenario": scenario, "frames": frames, "size_px": size, "bracket_ms": times_ms}
        config = build(
            DatasetConfig, {**settings, "sensor": sensor, "seed": seed, "materials": materials}, "dataset"
        )
        jobs = [(mesh or (SHIPPED_FOIL if materials == "foil" else SHIPPED), out)]
    with progress_bar(Console(stderr=True), label_width=20) as bars:
        tasks: dict[str, TaskID] = {}

        def show(step: Progress) -> None:
            label = f"{step.target} {step.step}"
            if label not in tasks:
                tasks[label] = bars.add_task(label, total=step.total)
            bars.update(tasks[label], completed=step.done)

        made = {}
        for path, folder in jobs:
            with one_command_in(folder, "hil"):
                made[path.stem] = make_dataset(config, path, folder, cache, workers, show)
    if json_:
        print(json.dumps(made))
    for target_name, facts in () if json_ else made.items():
        split = ", ".join(f"{count} {name}" for name, count in facts["split"].items())
        print(f"{target_name}: {facts['frames']} frames ({split}), {facts['in_eclipse']} in eclipse")


@app.command()
def target(
    out: Annotated[Path, typer.Option(help="The GLB to write.")] = Path("spacecraft.glb"),
    materials: Annotated[
        Materials,
        typer.Option(
            help="own: nearly matt; foil: crinkled gold foil, glossy cell glass and a polished dish."
        ),
    ] = "own",
) -> None:
    """Write the shipped target, a parametric spacecraft, as binary glTF; the bytes are the same on every machine.

    Example: hil target --materials foil --out spacecraft.glb
    """
    shipped = SHIPPED_FOIL if materials == "foil" else SHIPPED
    out.write_bytes(shipped.read_bytes())  # not built again: rounding differs between processors
    print(out)


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


def _stop_event() -> threading.Event:
    """Return an event that SIGTERM and SIGINT set."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop


def main() -> None:
    """Run the command line."""
    run(app, "hil")


if __name__ == "__main__":
    main()
