"""The model on board: verified when it arrives; it ranks the waiting frames and so decides the order of sending."""

import contextlib
import logging
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from flightsw.icd.mission import CameraSection
from flightsw.icd.packet import PacketError
from flightsw.storage.store import FrameStore
from flightsw.triage.scores import Ranked, sending_order, sent_view
from flightsw.triage.worker import ModelFailed, ModelVerified, TriageWorker
from obbgs_base.errors import in_words
from obbgs_base.files import sync_folder

log = logging.getLogger(__name__)
DECIDED_ONE_BY_ONE = 32  # places of the order by triage: more than are sent before the order is made anew
RANKING_S = 30.0  # for which a frame is held back to be ranked: what is sent first cannot be reordered


class Ranking:
    """Scores of the frames in the outbox by the model in the store, and the sending order that follows from them.

    The store holds the model in use as model.onnx; one that has come is model-COUNTER.received until it is verified.
    One that failed in use is kept as model.onnx.failed and not tried again.
    """

    def __init__(self, store: FrameStore, camera: CameraSection, clock_s: Callable[[], float]):
        self.model_sha256 = b""  # of the model in use, empty without one
        self.model_path = store.folder / "model.onnx"
        self._store, self._clock_s = store, clock_s
        self._worker = TriageWorker(np.array(camera.K), camera.width, camera.height)
        self._hold_until_s = float("-inf")
        self._scores: dict[int, Ranked] = {}
        self._given_to_worker: set[int] = set()
        self._being_ranked: dict[int, float] = {}  # and since when, s
        self._sent_views: dict[int, tuple[float, ...]] = {}  # of frames delivered and in flight
        self._is_verifying = False  # the model from before a restart

    def start(self) -> None:
        """Verify the model that the store holds, if it holds one, and delete those that were not verified in time."""
        for left in self._store.folder.glob("model*.received"):
            with contextlib.suppress(
                OSError
            ):  # a disk that cannot be written to keeps it until the next start
                left.unlink()
        self._is_verifying = self.model_path.exists()
        if self._is_verifying:
            self._hold_until_s = self._clock_s() + RANKING_S
            self._worker.verify(self.model_path)

    @property
    def frames_ranked(self) -> int:
        return len(self._scores)

    def verify(self, model: Path) -> None:
        """Look at a model file that has come; `collect` says how that ended."""
        self._worker.verify(model)

    def collect(self) -> list[ModelVerified]:
        """Take in what was verified and ranked; return the models whose verification has ended.

        A good model that came by uplink is in use from now on, a bad one is deleted.
        """
        verified = []
        for result in self._worker.results():
            if isinstance(result, ModelVerified):
                verified.append(self._end_verification(result))
            elif isinstance(result, ModelFailed):
                log.error("frames are not ranked any more until another model comes: %s", result.problem)
                self._set_aside()
                self._begin_with(b"")
            else:
                path, score = result
                self._being_ranked.pop(int(path.stem), None)
                if score is not None:
                    self._scores[score.frame_id] = score
        return verified

    def rank(self, frame_ids: Iterable[int]) -> None:
        """Have each frame ranked once by the model in use."""
        if not self.model_sha256:
            return
        for frame_id in frame_ids:
            if frame_id not in self._given_to_worker:
                self._given_to_worker.add(frame_id)
                self._being_ranked[frame_id] = self._clock_s()
                self._worker.rank(self._store.path(frame_id))

    def ordered(self, frame_ids: list[int], now_s: float) -> list[int]:
        """Return the frames that may be sent now, in the order by triage.

        For up to `RANKING_S` a frame that is being ranked is held back, and all frames at the start with a model and
        after one comes into use. Frames without a score go before those whose score says nothing (in eclipse, pose not
        valid).
        """
        if (self._is_verifying or self._being_ranked) and now_s < self._hold_until_s:
            return []
        held_since_s = now_s - RANKING_S
        ready = [f for f in frame_ids if self._being_ranked.get(f, held_since_s) <= held_since_s]
        scores = [self._scores[frame_id] for frame_id in ready if frame_id in self._scores]
        ordered = sending_order(scores, list(self._sent_views.values()), DECIDED_ONE_BY_ONE)
        unranked = [frame_id for frame_id in ready if frame_id not in self._scores]
        comparable = [score.frame_id for score in ordered if score.comparable]
        return [*comparable, *unranked, *(score.frame_id for score in ordered if not score.comparable)]

    def note_sent(self, frame_id: int, header: bytes) -> None:
        """Remember the view of a frame that is sent: frames with a similar view go later."""
        with contextlib.suppress(PacketError):
            view = sent_view(header)
            if view is not None:
                self._sent_views[frame_id] = view

    def note_failed(self, frame_id: int) -> None:
        """Forget the view of a frame whose transfer failed."""
        self._sent_views.pop(frame_id, None)

    def note_delivered(self, frame_id: int) -> None:
        """Forget the score of a frame that needs no place in the order any more."""
        self._scores.pop(frame_id, None)

    def stop(self) -> None:
        """End the ranking at once."""
        self._worker.stop()

    def _end_verification(self, result: ModelVerified) -> ModelVerified:
        """Take a good model into use, and return the result."""
        if result.path == self.model_path:
            self._is_verifying = False
            if result.problem and result.is_unfit:
                self._set_aside()
        elif result.problem is None:
            try:
                os.replace(result.path, self.model_path)
                sync_folder(self._store.folder)
            except OSError as error:
                log.warning(
                    "the model is used until the next start only, it cannot be kept: %s", in_words(error)
                )
        else:
            with contextlib.suppress(OSError):
                result.path.unlink()
        if result.problem is None:
            self._begin_with(result.sha256)
        return result

    def _begin_with(self, model_sha256: bytes) -> None:
        """Have frames ranked by this model from now on, by none where it is empty."""
        self.model_sha256 = model_sha256
        self._worker.forget_frames()
        for of_the_one_before in (self._scores, self._given_to_worker, self._being_ranked):
            of_the_one_before.clear()
        if model_sha256:
            self._hold_until_s = self._clock_s() + RANKING_S

    def _set_aside(self) -> None:
        """Have the model in the store not tried again at the next start."""
        try:
            os.replace(self.model_path, self.model_path.with_name("model.onnx.failed"))
        except OSError as error:
            log.warning("the model that failed is tried again at the next start: %s", in_words(error))
