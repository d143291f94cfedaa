"""From a session's frames to a run folder: train, write the model in every form, record how it went."""

import dataclasses
import json
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ground.run.attitude import FILE as ATTITUDE_FILE
from ground.run.attitude import FoundAttitude, find_attitude, in_body_axes, refined_motion
from ground.run.estimated_poses import estimated_records, posed_frames, write_estimate
from ground.run.model_files import Outputs, model_sizes, write_models
from ground.run.record import training_metrics, write_config, write_history
from ground.run.runs import (
    check_not_live,
    check_replaceable,
    publish,
    run_folder,
    unfinished_run,
    written_to,
)
from ground.session.cameras import sensor_of
from ground.session.folder import FrameRecord, Session, open_session
from ground.session.training_frames import frames_of, split, told_before
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import preset
from obbgs_core.render import backend_for
from obbgs_core.train.result import StepInfo, TrainResult
from obbgs_core.train.trainer import train

log = logging.getLogger(__name__)
AttitudeSource = Literal["auto", "tagged", "unknown"]
KNOWN, BLIND = "known exposure", "blind to exposure"  # the trainings of a run


@dataclass(frozen=True)
class Progress:
    """One step of one of the trainings of a run."""

    label: str  # KNOWN or BLIND
    info: StepInfo


def reconstruct(
    session_dir: Path,
    name: str = "run",
    method: str = "obbgs",
    changes: dict | None = None,
    seed: int = 7,
    time_limit_s: float = math.inf,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    out: Path | None = None,
    overwrite: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    attitude: AttitudeSource = "auto",
    on_search: Callable[[str, float], None] = lambda what, share: None,
) -> Path:
    """Train on a session and return the run folder, which appears only when it is complete.

    An interrupted or killed run is resumed from its last checkpoint by the same call and ends in the same model. Once
    a training has finished, every file that can be made of it is kept; `missing_outputs` in metrics.json gives the
    reason for each of the others. The truth of a simulator is never read here.

    Args:
        changes: settings that differ from the method's preset. `blind_reference`: train a second time with every
            exposure time replaced by their geometric mean, on the poses that the first training found, to measure
            what knowing the exposure brings.
        out: the folder of runs; None: runs/ in the session.
        overwrite: replace a finished run of the same name.
        should_stop: called after each step and before each file; True saves the work and raises Interrupted.
        attitude: of the target. tagged: as the pose tags assume it; unknown: found from the frames, which are taken
            relative to inertial axes; auto: unknown where the tags say so.
        on_search: called with what is being done to find the attitude, and the share of it that is done.

    Raises:
        SessionError: the session cannot be used; the name is that of a finished run or of one that another process is
            making; or the folder of runs cannot be written.
        ReconstructionError: the frames allow no model (too few, all black), or leave the attitude open.
        ValueError: unknown method or setting, a name that is no folder's, or a time limit that is not positive.
        Interrupted: should_stop returned True.
    """
    if not time_limit_s > 0:
        raise ValueError(f"the time limit must be longer than 0 s, got {time_limit_s:g}")
    config = preset(method, changes)
    backend_for(config.device)  # before frames are read
    session = open_session(session_dir)
    folder = run_folder(session.path, name, out)
    check_replaceable(folder, overwrite)
    if not overwrite:
        check_not_live(folder)
    training, held_out = split(session)
    sensor = sensor_of(session.camera)
    configs = {KNOWN: config}
    if config.blind_reference and config.exposure_aware:
        configs[BLIND] = dataclasses.replace(_refining(config, "never"), exposure_aware=False)
    kept = [ATTITUDE_FILE, *(_checkpoint(label) for label in configs)]
    with unfinished_run(folder, overwrite, kept) as part:
        found = _attitude(session, training, attitude, part / ATTITUDE_FILE, on_search, should_stop)
        if found is not None:
            session = in_body_axes(session, found)
            training, held_out = split(session, told_before)
            configs[KNOWN] = _refining(config, "always")
        frames = frames_of(session, training)

        def trained(label: str, config: MethodConfig, frames: list[TrainingFrame]) -> TrainResult:
            def on_step(info: StepInfo) -> None:
                on_progress(Progress(label, info))

            limits = time_limit_s, part / _checkpoint(label), should_stop
            on_warning = log.warning if label == KNOWN else told_before  # both have the same frames
            result = train(frames, sensor, config, seed, on_step, *limits, on_warning)
            log.info("%s: start from %s; %s", label, result.start, result.stop_reason)
            return result

        outputs = Outputs(part, should_stop)
        result, blind = trained(KNOWN, configs[KNOWN], frames), None
        if BLIND in configs:
            try:
                blind = trained(BLIND, configs[BLIND], posed_frames(frames, result.pose_estimate))
            except ReconstructionError as error:
                outputs.miss("blind.ply", str(error))
        finish_run(outputs, folder, {KNOWN: result, BLIND: blind}, session, training, held_out, seed)
    return folder


def finish_run(
    outputs: Outputs,
    folder: Path,
    results: dict[str, TrainResult | None],
    session: Session,
    training: list[FrameRecord],
    held_out: list[FrameRecord],
    seed: int,
) -> None:
    """Write the files of finished trainings into the folder of `outputs`, and make that the run's folder.

    Args:
        results: those of KNOWN and, or None, of BLIND.

    Raises:
        SessionError: model.ply or the folder cannot be written.
        Interrupted: as in `Outputs.make`.
    """
    part, result, blind = outputs.folder, results[KNOWN], results.get(BLIND)
    assert result is not None
    blind_gaussians = blind.gaussians if blind else None
    posed = estimated_records(training, result.pose_estimate)
    files = write_models(outputs, result.gaussians, blind_gaussians, session, posed, held_out)
    outputs.require("model.ply")
    metrics = training_metrics(result, blind, session, training, held_out)
    if (found := FoundAttitude.read(part / ATTITUDE_FILE)) is not None:
        metrics["attitude"] = refined_motion(found, session, result.pose_estimate).facts()
        metrics["attitude_from_outlines"] = found.motion.facts()
    metrics |= files | model_sizes(part) | {"missing_outputs": outputs.missing}
    log.info("%d Gaussians in %.1f s: %s", len(result.gaussians), result.seconds, result.stop_reason)
    with written_to(folder.parent):
        (part / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
        write_history(results, part / "metrics.jsonl")
        write_estimate(part, result.pose_estimate)
        write_config(session, result.config, seed, part / "config.yaml")
        publish(part, folder)


def _attitude(
    session: Session,
    training: list[FrameRecord],
    source: AttitudeSource,
    path: Path,
    on_search: Callable[[str, float], None],
    should_stop: Callable[[], bool],
) -> FoundAttitude | None:
    """Return the attitude that is found from the frames, or was before an interruption; None where tags are trusted."""
    if source == "tagged" or (source == "auto" and session.navigation.attitude != "unknown"):
        path.unlink(missing_ok=True)
        return None
    found = FoundAttitude.read(path)
    if found is None:
        found = find_attitude(session, training, on_search, should_stop)
        found.write(path)
    log.info("attitude of the target from its outlines: %s", found.motion.summary())
    return found


def _refining(config: MethodConfig, refine: Literal["never", "always"]) -> MethodConfig:
    """Return a method that refines poses never, as they are refined already; or always, unless it is told never to.

    An attitude from outlines errs for certain.
    """
    if refine == "always" and config.poses.refine != "auto":
        return config
    return dataclasses.replace(config, poses=dataclasses.replace(config.poses, refine=refine))


def _checkpoint(label: str) -> str:
    """Return the file name of a training's checkpoint."""
    return f"{label.replace(' ', '-')}.checkpoint"
