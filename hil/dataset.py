"""Data sets like that of Jiang et al. 2025: a scenario rendered, exposed, and written as a session and for NeRF."""

import dataclasses
import hashlib
import inspect
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

import ground.session.truth
from flightsw.capture.sequencer import Shot, plan
from flightsw.icd.config import ConfigError, assignment, build, in_file, parse_yaml
from flightsw.icd.frame import Frame, encode_frame
from flightsw.icd.mission import Mission
from ground.formats.nerf import export_nerf
from ground.session.folder import open_session
from ground.session.telemetry import FlightCounts
from ground.session.writer import SessionWriter
from hil import truth
from hil.choices import SensorKind
from hil.sky import Materials, blender, motion, sensor
from hil.sky.blender import mesh_sha256
from hil.sky.motion import image_velocity, smear
from hil.sky.render_farm import RenderFarm
from hil.sky.sensor import PRESETS, SensorModel, read_out
from hil.world.scenario import Scene, SceneState, load_scenario, ready_made
from obbgs_base.errors import ObbgsError
from obbgs_base.files import write_whole
from obbgs_base.physics import stars
from obbgs_base.physics.stars import star_radiance

DATASETS = Path(__file__).parent / "datasets"
MARKER = "dataset.json"
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".stl")
# The gain is chosen so that bright parts of the target read 0.7 of full scale at the middle exposure.
BRIGHT_PERCENTILE, BRIGHT_SIGNAL, COVERED_ALPHA = 97, 0.7, 230
MOTION_S = 0.1  # interval over which the image velocity is measured


class DatasetError(ObbgsError):
    """The data set's folder or its scenario cannot be used."""


@dataclass(frozen=True)
class DatasetConfig:
    """The settings of a data set; the mesh is given apart, or `targets` names the meshes of several."""

    scenario: str = "fly-around"
    frames: int = 363
    size_px: int = 800
    bracket_ms: tuple[float, ...] = (0.05, 0.1, 0.2)
    sensor: SensorKind = "paper"
    seed: int = 1
    targets: tuple[str, ...] = ()
    materials: Materials = "own"

    def __post_init__(self):
        if not self.bracket_ms or self.frames < 1 or self.frames % len(self.bracket_ms):
            raise ConfigError(
                "dataset.frames",
                f"expected a multiple of the bracket's {len(self.bracket_ms)} exposures, got {self.frames}",
            )
        if not 8 <= self.size_px <= 8192:
            raise ConfigError("dataset.size_px", f"expected 8 to 8192, got {self.size_px}")
        if not all(np.isfinite(t) and t > 0 for t in self.bracket_ms):
            raise ConfigError("dataset.bracket_ms", f"expected positive times, got {list(self.bracket_ms)}")


@dataclass(frozen=True)
class Progress:
    """The state of one step of a target's data set, in frames."""

    target: str
    step: Literal["render", "expose"]
    done: int
    total: int


def load_dataset_config(name: str | Path | None, changes: Sequence[str] = ()) -> DatasetConfig:
    """Return a ready-made data set's configuration by its name, or the one in a YAML file; with changes to it.

    Args:
        name: None: one with the defaults, for one target.
        changes: texts such as `frames=90`.

    Raises:
        ConfigError: it does not exist or is wrong; the message names the file and the key's path.
    """
    given = dict(assignment(text) for text in changes)
    if name is None:
        return build(DatasetConfig, given, "dataset")
    path, content = ready_made(name, DATASETS, "data set")
    with in_file(path):
        tree = parse_yaml(content, "dataset")
        config = build(DatasetConfig, tree, "dataset")
    return build(DatasetConfig, tree | given, "dataset") if given else config


def target_meshes(config: DatasetConfig, folder: Path) -> list[Path]:
    """Return the mesh files of a set's targets in a folder.

    Raises:
        ConfigError: the configuration names none, or one is not there.
    """
    if not config.targets:
        raise ConfigError("dataset.targets", "names no targets; give one mesh instead")
    meshes = []
    for name in config.targets:
        found = [path for suffix in MESH_SUFFIXES if (path := folder / f"{name}{suffix}").is_file()]
        if not found:
            raise ConfigError("dataset.targets", f"{folder} holds no {name}{{{','.join(MESH_SUFFIXES)}}}")
        meshes.append(found[0])
    return meshes


def make_dataset(
    config: DatasetConfig,
    mesh: Path,
    out: Path,
    cache: Path,
    workers: int = 2,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> dict:
    """Make one target's data set in `out` and return its facts; one that was interrupted is continued.

    `out` holds session/ (frames, and truth/ with radiance and masks, depth and normals, mesh, cloud), the NeRF layout
    (transforms_{train,val,test}.json with their pictures), and dataset.json. Frames are tagged with their true poses.

    Raises:
        ConfigError: scenario, sensor or bracket do not fit together.
        DatasetError: `out` holds a data set made with other settings, or the scenario leaves the target dark.
        MeshError, BlenderError: the mesh or Blender is not usable.
    """
    scenario = load_scenario(config.scenario)
    brackets = scenario.bracket_section(config.bracket_ms, config.frames // len(config.bracket_ms))
    digest = _digest(config, scenario.sha256, mesh)
    done = _already_made(out, digest)
    if done is not None:
        return done
    focal_px = config.size_px / 2 / np.tan(np.radians(scenario.fov_deg) / 2)
    model = PRESETS[config.sensor]
    camera = model.camera_section(config.size_px, config.size_px, focal_px)
    mission = Mission(orbit=scenario.orbit, camera=camera, bracket=brackets, sha256=digest)
    scene = Scene(scenario)
    shots = list(plan(mission))
    states = [scene.state(shot.mid_exposure_utc_ns) for shot in shots]
    with RenderFarm(mission, mesh, cache, workers, config.materials) as farm:
        out.mkdir(
            parents=True, exist_ok=True
        )  # not before Blender has taken the mesh: a refusal leaves nothing
        _write_json(out / MARKER, {"complete": False, "digest": digest})
        rendered = iter(range(1, len(states) + 1))  # a counter that the workers' threads share
        farm.prerender(
            [state.pose for state in states],
            lambda: on_progress(Progress(mesh.stem, "render", next(rendered), len(states))),
            ops=("render", "geometry"),
        )
        middle_s = sorted(config.bracket_ms)[len(config.bracket_ms) // 2] / 1e3
        gain = _gain(farm, states, model, middle_s)
        model = model.with_gain(gain)
        mission = dataclasses.replace(
            mission, camera=model.camera_section(config.size_px, config.size_px, focal_px)
        )
        writer = SessionWriter(out / "session", mission)
        for index, frame in enumerate(_frames(mission, scene, shots, states, farm, model, config.seed)):
            writer.add(frame, encode_frame(frame))
            on_progress(Progress(mesh.stem, "expose", index + 1, len(shots)))
        writer.save({}, 0, FlightCounts(frames_stored=len(shots)))
        truth.write_truth(
            out / "session",
            mission,
            farm,
            truth.CLOUD_POINTS,
            pose_at=lambda utc_ns: scene.state(utc_ns).pose,
            geometry=True,
        )
        mesh_facts, blender_version = farm.facts, farm.version
    session = open_session(out / "session")
    counts = export_nerf(session, out)
    facts = {
        "complete": True,
        "digest": digest,
        "config": dataclasses.asdict(config),
        "mesh": {"name": mesh.name, "sha256": mesh_sha256(mesh), **mesh_facts},
        "scenario": {"name": config.scenario, "sha256": scenario.sha256},
        "blender": blender_version,
        "dn_per_radiance_s": gain,
        "frames": len(shots),
        "in_eclipse": sum(state.pose.in_eclipse for state in states),
        "saturated_share": sum(r.saturated for r in session.frames) / (len(shots) * config.size_px**2),
        "split": counts,
    }
    _write_json(out / MARKER, facts)
    return facts


def _frames(
    mission: Mission,
    scene: Scene,
    shots: list[Shot],
    states: list[SceneState],
    farm: RenderFarm,
    model: SensorModel,
    seed: int,
) -> Iterator[Frame]:
    for number, (shot, state) in enumerate(zip(shots, states, strict=True)):
        light = _light(mission, scene, state, farm, model, shot.exposure_time_s)
        dn = read_out(model, light, shot.exposure_time_s, np.random.default_rng((seed, number)))
        yield Frame(
            frame_id=number,
            bracket_id=shot.bracket_id,
            bracket_index=shot.bracket_index,
            bracket_count=shot.bracket_count,
            exposure_time_s=shot.exposure_time_s,
            mid_exposure_utc_ns=shot.mid_exposure_utc_ns,
            pose=state.pose,
            dn=dn[..., 0] if model.channels == 1 else dn,
            bit_depth=model.bit_depth,
            black_dn=model.black_dn,
            saturated_count=int((dn.reshape(*dn.shape[:2], -1) >= model.white_dn).any(axis=2).sum()),
        )


def _light(
    mission: Mission,
    scene: Scene,
    state: SceneState,
    farm: RenderFarm,
    model: SensorModel,
    exposure_time_s: float,
) -> np.ndarray:
    """Return the mean radiance [H, W, C] over an exposure, before the lens: the moving target and the stars."""
    camera = mission.camera
    light = farm.radiance(state.pose).astype(np.float64)
    if model.stars:
        alpha = farm.alpha(state.pose) / 255
        sky_light = star_radiance(state.gcrs_to_camera, np.array(camera.K), camera.width, camera.height)
        light += (sky_light * (1 - alpha))[..., None]
    if model.line_time_s or exposure_time_s > MOTION_S / 100:
        depth, _ = farm.geometry(state.pose)
        start_ns = scene.orbit.start_utc_ns
        before_ns = max(start_ns, state.utc_ns - round(MOTION_S * 5e8))
        after_ns = state.utc_ns + round(MOTION_S * 5e8)
        velocity = image_velocity(
            depth,
            np.array(camera.K),
            scene.state(before_ns).pose.world_to_camera,
            scene.state(after_ns).pose.world_to_camera,
            (after_ns - before_ns) * 1e-9,
        )
        light = smear(light, velocity, exposure_time_s, model.line_time_s)
    return light


def _gain(farm: RenderFarm, states: list[SceneState], model: SensorModel, exposure_time_s: float) -> float:
    """Return the gain, DN per radiance and s, at which bright parts of the target read 0.7 of full scale."""
    covered = []
    for state in states:
        if not state.pose.in_eclipse:
            radiance = farm.radiance(state.pose).astype(np.float32).mean(axis=2)
            covered.append(radiance[farm.alpha(state.pose) >= COVERED_ALPHA])
    values = np.concatenate(covered) if covered else np.empty(0)
    bright = float(np.percentile(values, BRIGHT_PERCENTILE)) if len(values) else 0.0
    if not bright > 0:
        raise DatasetError("no frame of this scenario shows a lit target: the gain cannot be set")
    gain = BRIGHT_SIGNAL * (model.white_dn - model.black_dn) / (bright * exposure_time_s)
    return float(f"{gain:.6g}")


def _digest(config: DatasetConfig, scenario_sha256: str, mesh: Path) -> str:
    """Return the SHA-256 of what a data set depends on: settings, scenario, mesh, and the code that computes pixels."""
    blender.check_mesh(mesh)
    settings = {**dataclasses.asdict(config), "targets": None, "scenario": scenario_sha256}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode() + mesh_sha256(mesh).encode())
    for source in (*blender.SOURCES, Path(__file__)):
        digest.update(source.read_bytes())
    for module in (sensor, motion, stars, truth, ground.session.truth):
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()


def _already_made(out: Path, digest: str) -> dict | None:
    """Return the facts of a finished data set; None if there is none yet or it is to be continued."""
    marker = out / MARKER
    if not marker.exists():
        if (out / "session").exists():
            raise DatasetError(f"{out}/session was not made by `hil dataset`; choose another folder")
        return None
    try:
        facts = json.loads(marker.read_text())
        same, complete = facts["digest"] == digest, facts["complete"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{marker} is damaged ({error}); remove {out} and run again") from error
    if not same:
        raise DatasetError(
            f"{out} was made with other settings or another version; choose another folder or remove it "
            "(rendered pictures are kept in the cache)"
        )
    return facts if complete else None


def _write_json(path: Path, content: dict) -> None:
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())
