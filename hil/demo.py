"""The demo: render the sky, fly a pass, write its truth, train a model and report, all below one folder."""

import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from flightsw.icd.mission import load_mission
from ground.show.summary import model_rows, table
from hil.processes import installed, tied
from hil.progress import progress_bar
from hil.simulated_pass import PassConfig, fly, is_fault_count
from hil.sky.blender import check_mesh
from hil.sky.render_farm import RenderFarm
from hil.truth import write_truth
from hil.world.clock import SimulatedClock
from hil.world.navigation import write_flight_inputs
from hil.world.scenario import true_exposures
from hil.world.surroundings import Surroundings
from hil.world.world import load_world, told
from obbgs_base.errors import ObbgsError
from obbgs_base.locks import one_command_in

MARKER = "demo.json"  # a folder with it was made by a demo and may be overwritten
LOGS = ("ground.log", "flight.log", "flight.json")
REPLACED = ("flight", "session", "scenario", *LOGS)  # by the next demo in the same folder


class DemoError(ObbgsError):
    """The demo's folder holds something else, or the reconstruction failed."""


def run_demo(out: Path, mission_path: Path, mesh: Path, config: PassConfig, console: Console) -> dict:
    """Run the whole demo below `out` and return its figures; frames that an earlier run rendered are used again.

    Raises:
        InUse: another demo works in `out`.
        DemoError: the reconstruction failed.
        And what `simulate_pass` raises.
    """
    with one_command_in(out, "hil"):
        return _run_demo(out, mission_path, mesh, config, console)


def _run_demo(out: Path, mission_path: Path, mesh: Path, config: PassConfig, console: Console) -> dict:
    began_s = time.monotonic()
    simulation = simulate_pass(out, mission_path, mesh, config, console)
    console.print("[bold]4/4 Model[/] trained with known exposure, and once more blind to it")
    session = out / "session"
    command = [installed("ground"), "reconstruct", "--session", str(session), "--name", "demo"]
    command += ["--set", "blind_reference=true", "--mission", str(mission_path)]
    finished = subprocess.run(tied([*command, "--json"]), stdout=subprocess.PIPE, text=True)
    if finished.returncode:
        raise DemoError("the reconstruction failed; its message is above")
    seconds = round(time.monotonic() - began_s, 1)
    figures = {**json.loads(finished.stdout), **simulation, "seconds": seconds}
    (out / MARKER).write_text(json.dumps(figures, indent=2) + "\n")
    console.print(_summary(figures))
    console.print(f"Report: {session / 'runs/demo/report.html'}", soft_wrap=True)
    return figures


def simulate_pass(
    out: Path, mission_path: Path, mesh: Path, config: PassConfig, console: Console
) -> dict[str, dict]:
    """Render the sky, fly the pass and write its truth, all below `out`; return what was simulated, by part.

    A pass that cannot start leaves nothing but rendered frames.

    Raises:
        DemoError: `out` holds a session that no demo made.
        PassError: a process failed or stalled, or a frame was lost or altered on its way.
        ConfigError, MeshError, BlenderError: the mission, the scenario, the mesh or Blender is not usable.
        ValueError: flight cannot follow the real-time factor.
        CaptureError, OSError: the GigE camera cannot be served: Aravis is missing, or its port is taken.
    """
    world = load_world(told(load_mission(mission_path), config.attitude), config.scenario)
    SimulatedClock(world.mission, config.real_time)  # refuses an impossible factor before anything is removed
    check_mesh(mesh)
    _require_own(out)
    mission = world.mission
    exposures = true_exposures(mission, world.pose_at)
    size = f"{mission.camera.width}x{mission.camera.height}"
    console.print(
        f"[bold]1/4 Sky[/]   {len(exposures)} exposures of {mesh.name} at {size}, rendered by Blender"
        + (f", scenario {config.scenario}" if config.scenario else "")
    )
    with _nothing_left_behind(out), RenderFarm(mission, mesh, out / "renders") as farm:
        with progress_bar(console) as progress:
            task = progress.add_task("render", total=len(exposures))
            farm.prerender([e.pose for e in exposures], lambda: progress.advance(task))
        _clear(out)  # not earlier: a mesh that cannot be rendered must not remove an earlier pass
        errors = None
        # where the mission file alone would lead flight to the true poses, it is flown as it is
        by_itself = mission.navigation.source == "sgp4" and mission.target_attitude.knowledge == "known"
        if config.scenario or config.attitude or config.navigation == "realistic" or not by_itself:
            seed = config.seed if config.navigation == "realistic" else None
            inputs = write_flight_inputs(world, out / "scenario", seed)
            mission_path, errors = inputs.mission_path, inputs.errors
            world = replace(world, mission=load_mission(mission_path))
        camera = "gige" if config.gige else "hil"
        console.print(
            f"[bold]2/4 Pass[/]  flight and ground, {camera} camera, {config.link} link between, "
            f"faults: {config.faults}"
        )
        around = Surroundings(world.mission, farm.alpha, world.orbits_at) if config.sky == "real" else None
        simulation = fly(out, world, mission_path, farm.radiance, config, console, around)
        if errors is not None:
            simulation["navigation"] |= errors.described()
        console.print("[bold]3/4 Truth[/] the simulator's own record, for the evaluation only")
        write_truth(out / "session", world.mission, farm, pose_at=world.pose_at, simulation=simulation)
    return simulation


def _require_own(out: Path) -> None:
    """Refuse a folder with a flight/, session/, scenario/ or log that no demo made.

    Raises:
        DemoError: there is such a one.
    """
    if not (out / MARKER).exists():
        for name in REPLACED:
            if (out / name).exists():
                raise DemoError(f"{out / name} was not made by a demo; choose another folder with OUT=DIR")


def _clear(out: Path) -> None:
    """Remove what an earlier demo flew and mark the folder as a demo's; rendered frames stay."""
    for name in REPLACED:
        if (out / name).is_dir():
            shutil.rmtree(out / name)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARKER).write_text("{}\n")


@contextlib.contextmanager
def _nothing_left_behind(out: Path) -> Iterator[None]:
    """Remove the files of a demo that fails before flight or ground wrote any; rendered frames stay."""
    try:
        yield
    except BaseException:
        if not (out / "flight").exists() and not (out / "session").exists():
            shutil.rmtree(out / "scenario", ignore_errors=True)
            for name in (MARKER, *LOGS):
                (out / name).unlink(missing_ok=True)
            for folder in (out / "renders", out):
                with contextlib.suppress(OSError):  # missing, or not empty
                    folder.rmdir()
        raise


def _summary(f: dict) -> Table:
    frames, camera, link, navigation = f["frames"], f["camera"], f["link"], f["navigation"]
    faults = ", ".join(
        f"{value:,} {name.replace('_', ' ')}"
        for name, value in link.items()
        if value and is_fault_count(name)
    )
    rows = [
        ("frames captured / received", f"{frames['captured']} / {frames['received']}, sha256 equal"),
        ("camera", f"{camera['kind']}: {camera['late_frames']} frames late, {camera['failures']} failures"),
        (
            "link",
            f"{link['kind']}, faults {link['faults']}, {link['cuts']} cuts: {link['bytes_down']:,} bytes down",
        ),
        ("faults on the link", faults or "none"),
        (
            "tags against truth",
            f"{navigation['position_error_m']:.3f} m, {navigation['rotation_error_deg']:.4f} deg "
            f"(injected errors: {navigation['errors']})",
        ),
        *model_rows(f),
        ("everything", f"{f['seconds']:.0f} s"),
    ]
    return table("The pass and its model", rows)
