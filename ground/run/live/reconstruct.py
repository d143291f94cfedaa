"""Reconstruction while a session grows: frames join the training as they arrive, and the pass ends with a model.

This process only reads the session's frames, so that the one that receives them never waits for the training.
"""

import contextlib
import functools
import logging
import math
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path

from ground.link.uplink import is_listening
from ground.run.live.arrivals import Arrivals
from ground.run.live.model import ShownModel
from ground.run.live.status import LIVE_CHECKPOINT, LIVE_STATUS, LiveStatus, State
from ground.run.live.uplink import LiveUplink
from ground.run.model_files import Outputs
from ground.run.reconstruct import KNOWN, finish_run
from ground.run.runs import check_replaceable, run_folder, unfinished_folder, unfinished_run
from ground.session.cameras import sensor_of
from ground.session.folder import SessionError
from obbgs_base.errors import Interrupted, counted, reason
from obbgs_core.compiled import Background
from obbgs_core.errors import ReconstructionError, TooFewFrames
from obbgs_core.frames import FEWEST_FRAMES
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.train.joining import JOINED_AT, check_joinable
from obbgs_core.train.trainer import Trainer

log = logging.getLogger(__name__)
STEPS = 1000  # of the schedule, which begins again when the last frames have joined
# what helps few frames alone would shape the model that the many frames to come inherit
MANY_EXPECTED = {"sparse.dropout": 0.0}
FEWEST_BRACKETS = 4  # that the first hull is carved of, while more may come
JOIN_STEPS = 60  # at least, from frames that join to the next
# at least so many times what the last joining took, from one to the next while frames arrive
JOIN_PAUSE = 3.0
LOOK_S, STATUS_S, SHOW_S, SAVE_S = 0.5, 1.0, 5.0, 20.0  # between two looks, statuses, models and checkpoints
LAST_SHOW_S = 2.0  # between two models once the pass is over, when operators wait for them
SHOW_PAUSE = 2.0  # at least so many times what comparing the last one took, until the next is compared
WAIT_S = 0.1  # where there is nothing to train


def reconstruct_live(
    session_dir: Path,
    name: str = "live",
    changes: dict | None = None,
    seed: int = 7,
    out: Path | None = None,
    overwrite: bool = False,
    idle_timeout_s: float = 30.0,
    must_listen: bool = False,
    key_file: Path | None = None,
    on_status: Callable[[LiveStatus], None] = lambda status: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Train on a session while frames arrive, and return the run's folder when the pass is over.

    The folder shows status.json and the best model.ply so far from the first on, and becomes a finished run in the end.
    The pass is over when the process that listened into the session has ended, or where none does when no frame has
    come for `idle_timeout_s`. A killed reconstruction goes on from its last checkpoint by the same call.

    Args:
        changes: settings that differ from the method's preset.
        out: the folder of runs; None: runs/ in the session.
        overwrite: replace a finished run of the same name.
        must_listen: the pass is over as soon as no process listens into the session.
        key_file: of the mission, with which improved models are sent up; None: none is sent.
        on_status: called about once a second.
        should_stop: called after each step; True saves the work and raises Interrupted.

    Raises:
        SessionError: the session is damaged or no frame came, or the run's name is taken or cannot be written.
        TooFewFrames, ReconstructionError: at the end of the pass the frames allow no model.
        ConfigError: the key cannot be used.
        ValueError: a setting that does not exist, or with which no frames can join.
        Interrupted: should_stop returned True.
    """
    config = preset("obbgs", {"steps": STEPS} | MANY_EXPECTED | (changes or {}))
    folder = run_folder(session_dir, name, out)
    check_replaceable(folder, overwrite)
    uplink = None if key_file is None else LiveUplink(session_dir, key_file)
    kept = [path.name for path in unfinished_folder(folder).glob("*.checkpoint")]
    with _nothing_left_of(session_dir), unfinished_run(folder, overwrite, kept) as part:
        live = LiveReconstruction(session_dir, folder, part, config, seed, uplink, on_status)
        end = PassEnd(session_dir, idle_timeout_s, must_listen)
        try:
            while live.turn(end):
                if should_stop():
                    raise Interrupted(
                        f"interrupted after step {live.steps}; the same command goes on from there"
                    )
        finally:
            live.save()
            live.close()
        live.finish(should_stop)
    return folder


@contextlib.contextmanager
def _nothing_left_of(session_dir: Path) -> Iterator[None]:
    """Remove the folders that were made for a session of which nothing came, where the block ends in an error."""
    is_new, is_empty = not session_dir.exists(), not (session_dir.is_dir() and any(session_dir.iterdir()))
    try:
        yield
    except SessionError:
        if is_empty and [path.name for path in session_dir.iterdir()] == ["runs"]:
            shutil.rmtree(session_dir if is_new else session_dir / "runs", ignore_errors=True)
        raise


class PassEnd:
    """Tells when a pass is over."""

    def __init__(self, session_dir: Path, idle_timeout_s: float, must_listen: bool):
        self._session_dir, self._idle_timeout_s = session_dir, idle_timeout_s
        self._heard = must_listen  # a process has listened
        self._arrived_s = time.monotonic()

    def arrived(self) -> None:
        """Note that a frame has come."""
        self._arrived_s = time.monotonic()

    def reason(self) -> str:
        """Return why the pass is over; nothing while it goes on."""
        if is_listening(self._session_dir):
            self._heard = True
        elif self._heard:
            return "the process that received the session has ended"
        elif time.monotonic() - self._arrived_s >= self._idle_timeout_s:
            return f"no frame for {self._idle_timeout_s:g} s, and no process receives the session"
        return ""


class LiveReconstruction:
    """A training that frames join, with the folder in which it shows how it stands; `turn` is a turn of its loop.

    Args:
        folder: of the run.
        part: the hidden folder in which the finished run is made, with the checkpoints.
    """

    def __init__(
        self,
        session_dir: Path,
        folder: Path,
        part: Path,
        config: MethodConfig,
        seed: int,
        uplink: LiveUplink | None,
        on_status: Callable[[LiveStatus], None],
    ):
        check_joinable(config)
        self.arrivals = Arrivals(session_dir)
        self.shown = ShownModel(folder, self.arrivals)
        self.trainer: Trainer | None = None
        self._folder, self._part, self._config, self._seed = folder, part, config, seed
        self._uplink, self._on_status = uplink, on_status
        self._over = ""  # why the pass is over
        self._missing = "waiting for the first frame"
        self._tried = -1  # frames that no training could begin with
        self._joined = self._joined_step = self._saved_step = 0
        self._joined_s = self._joining_s = 0.0
        self._looks, self._shows, self._reports, self._saves = map(_Every, (LOOK_S, SHOW_S, STATUS_S, SAVE_S))
        self._comparing = Background("comparing")
        # of a model that is being compared, with the time that took, s
        self._offer: Future[float] | None = None

    @property
    def steps(self) -> int:
        return len(self.trainer.state.history) if self.trainer else 0

    def turn(self, end: PassEnd) -> bool:
        """Do what is due, then train a step, or wait a moment; return False when pass and schedule have ended."""
        if self._looks.due():
            self._look(end)
            if self._uplink is not None:
                self._uplink.tend()  # sooner than at the next model
        if self.trainer is not None and not self.trainer.stop_reason():
            self.trainer.step()
        elif self._over:
            return False
        else:
            if self.steps != self._saved_step:
                self.save()
            time.sleep(WAIT_S)
        if self.trainer is not None:
            self._show(self.trainer)
        if self._reports.due():
            self.report("training" if self.trainer else "waiting", "" if self.trainer else self._missing)
        if self._saves.due():
            self.save()
        return True

    def _look(self, end: PassEnd) -> None:
        """Take what has arrived: a training begins with it, or it joins the one that is under way."""
        reason = end.reason()  # first, so that what came before the end is taken
        if reason and not self._over:
            self._shows = _Every(LAST_SHOW_S)
        self._over = reason
        if self.arrivals.look():
            end.arrived()
        if self.trainer is None:
            self._begin()
        if self.trainer is None:
            return
        now_s, trainer = time.monotonic(), self.trainer
        if len(self.arrivals.frames) > self._joined:
            learnt = self.steps - self._joined_step >= JOIN_STEPS
            paused = now_s - self._joined_s >= JOIN_PAUSE * self._joining_s
            if self._over or trainer.stop_reason() or (learnt and paused):
                trainer.join(self.arrivals.frames[self._joined :])
                self._note_joined(now_s)
                self.save()
        if self._over:
            trainer.end_joining()

    def _begin(self) -> None:
        """Go on from a checkpoint, or begin with the frames that are there, if they allow a training.

        Raises:
            SessionError, TooFewFrames, ReconstructionError: they do not, and the pass is over.
        """
        arrivals, began_s = self.arrivals, time.monotonic()
        count = len(arrivals.frames)
        if (count == self._tried and not self._over) or self._resumed():
            return
        self._tried = count
        if not arrivals.received:
            if self._over:
                raise SessionError(f"{self._over}: no frame came into {arrivals.folder}")
            return
        self._missing = (
            f"{counted(arrivals.received, 'frame')} received, {counted(count, 'frame')} of "
            f"{counted(arrivals.brackets, 'bracket')} to train on "
            f"({arrivals.eclipsed} in eclipse, {arrivals.untagged} without a valid pose or the Sun's direction, "
            f"{len(arrivals.damaged)} with a damaged picture, {len(arrivals.held_out)} held out)"
        )
        if self._over and count < FEWEST_FRAMES:
            raise TooFewFrames(f"{self._over}: {self._missing}; {FEWEST_FRAMES} frames are needed")
        if not self._over and (arrivals.brackets < FEWEST_BRACKETS or count < FEWEST_FRAMES):
            self._missing += f"; {FEWEST_BRACKETS} brackets are needed to begin"
            return
        assert arrivals.session is not None
        try:
            trainer = Trainer(
                list(arrivals.frames), sensor_of(arrivals.session.camera), self._config, self._seed
            )
        except ReconstructionError as error:  # all black so far
            if self._over:
                raise
            self._missing += f"; {error}"
            return
        trainer.withhold()
        self.trainer = trainer
        self._note_joined(began_s)
        self.save()

    def _resumed(self) -> bool:
        """Go on from the newest checkpoint whose frames have all arrived, if there is one."""
        arrivals = self.arrivals
        counts = [int(m[1]) for path in self._part.iterdir() if (m := LIVE_CHECKPOINT.fullmatch(path.name))]
        for count in sorted(counts, reverse=True):
            if arrivals.session is not None and FEWEST_FRAMES <= count <= len(arrivals.frames):
                sensor, began_s = sensor_of(arrivals.session.camera), time.monotonic()
                trainer = Trainer(arrivals.frames[:count], sensor, self._config, self._seed)
                if trainer.resume(self._checkpoint(count)):
                    self.trainer = trainer
                    self._note_joined(began_s)
                    self._joined = count
                    log.info("resumed after step %d with %d frames", self.steps, count)
                    return True
        return False

    def _note_joined(self, began_s: float) -> None:
        self._joined, self._joined_step = len(self.arrivals.frames), self.steps
        self._joined_s = time.monotonic()
        self._joining_s = self._joined_s - began_s

    def _show(self, trainer: Trainer) -> None:
        """Renew the shown model if one of some steps ago is better; send it up if that is asked for and worth it.

        Models are compared in a thread of their own, so that training does not wait for it where a core is free.
        """
        if self._offer is not None:
            if not self._offer.done():
                return
            self._shows.pause(SHOW_PAUSE * self._offer.result())
            self._offer = None
        elif not self._shows.due():
            return
        elif self.steps and self.shown.offered_step != self.steps:
            offered = trainer.gaussians.copied(), self.steps, trainer.pose_estimate
            compared = functools.partial(self._compared, *offered)
            self._offer = self._comparing.submit(compared)
            return
        arrivals, is_past_start = self.arrivals, trainer.share >= JOINED_AT
        if self._uplink is not None and is_past_start and arrivals.session is not None:
            self._uplink.follow(self.shown, arrivals.session, arrivals.training, self._part)

    def _compared(self, model: Gaussians, step: int, estimate: PoseEstimate | None) -> float:
        """Show a model unless the shown one is better, and return the time that took, s."""
        began_s = time.monotonic()
        self.shown.offer(model, step, estimate)
        return time.monotonic() - began_s

    def close(self) -> None:
        """Wait for the model that is being compared, if there is one, and report what is shown then."""
        self._comparing.close()
        if self._offer is not None:
            self._offer.result()
            self.report("training", "")

    def report(self, state: State, message: str) -> None:
        arrivals, shown, trainer = self.arrivals, self.shown, self.trainer
        if trainer is not None and state == "training" and trainer.stop_reason():
            state, message = "settled", "waiting for frames, or for the end of the pass"
        status = LiveStatus(
            state=state,
            message=message,
            frames_received=arrivals.received,
            frames_trained=self._joined,
            frames_held_out=len(arrivals.held_out),
            frames_unusable=arrivals.eclipsed + arrivals.untagged + len(arrivals.damaged),
            step=self.steps,
            share=trainer.share if trainer else 0.0,
            held_out_db=_known(shown.held_out_db),
            model_step=shown.step,
            gaussians=None if shown.gaussians is None else len(shown.gaussians),
            chi2=_known(trainer.state.fit.chi2) if trainer else None,
            train_seconds=round(trainer.state.seconds, 3) if trainer else 0.0,
            updated_utc_ns=time.time_ns(),
            uplink=self._uplink.state if self._uplink else "",
        )
        try:
            status.write(self._part if state == "finished" else self._folder)
        except OSError as error:  # a full disk must not end the training
            log.warning("%s cannot be renewed: %s", self._folder / LIVE_STATUS, reason(error))
        self._on_status(status)

    def save(self) -> None:
        """Write a checkpoint, in place of the one before; a disk that does not take it is only noted."""
        if self.trainer is None:
            return
        path = self._checkpoint(self._joined)
        try:
            self.trainer.save(path)
        except OSError as error:
            log.warning("step %d: %s cannot be written: %s", self.steps, path, reason(error))
            return
        self._saved_step = self.steps
        for other in self._part.iterdir():
            if LIVE_CHECKPOINT.fullmatch(other.name) and other != path:
                other.unlink()

    def finish(self, should_stop: Callable[[], bool]) -> None:
        """Make the finished run of the training.

        Raises:
            SessionError: it cannot be written.
            Interrupted: should_stop returned True.
        """
        trainer, session = self.trainer, self.arrivals.session
        assert trainer is not None and session is not None  # the pass has ended with a training
        work = f"{counted(self.steps, 'step')} while {counted(self._joined, 'frame')} came"
        result = trainer.result(f"{self._over}; {work}")
        self.shown.offer(result.gaussians, self.steps, result.pose_estimate)
        self.report("finished", self._over)
        outputs = Outputs(self._part, should_stop)
        records = self.arrivals.training[: self._joined], self.arrivals.held_out
        finish_run(outputs, self._folder, {KNOWN: result}, session, *records, self._seed)

    def _checkpoint(self, frames: int) -> Path:
        return self._part / f"live-{frames}.checkpoint"


class _Every:
    """Tells every so many seconds that something is due, the first time at once."""

    def __init__(self, seconds: float):
        self._seconds, self._next_s = seconds, -math.inf

    def due(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + self._seconds
        return True

    def pause(self, seconds: float) -> None:
        """Let nothing be due for so long at least."""
        self._next_s = max(self._next_s, time.monotonic() + seconds)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 3)
