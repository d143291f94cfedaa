"""The frames of a session that another process is writing, in the order in which they arrive."""

import logging
from pathlib import Path

from ground.session.folder import (
    FrameRecord,
    MissingFrames,
    Session,
    SessionError,
    open_session,
    read_records,
)
from ground.session.training_frames import is_held_out, split, training_frame, usable, whole
from obbgs_core.frames import TrainingFrame, alike

log = logging.getLogger(__name__)


class Arrivals:
    """What has arrived in a session's folder so far; `look` brings it up to date.

    session: None while there is none, or none with a frame.
    frames: those for training, in the order of arrival, `training` their records; `held_out` are the others that are
        usable. Whether a frame is held out depends on its bracket's number alone, so that it never changes.
    damaged: the numbers of those that have come with a damaged picture, or were held out when theirs was damaged.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.session: Session | None = None
        self.frames: list[TrainingFrame] = []
        self.training: list[FrameRecord] = []
        self.held_out: list[FrameRecord] = []
        self.eclipsed = self.untagged = 0  # untagged: without a valid pose or the Sun's direction
        self.damaged: set[int] = set()
        self._known: set[int] = set()  # whose pictures were looked at when they came
        self._bytes_seen = 0  # of frames.jsonl

    @property
    def received(self) -> int:
        return len(self.session.frames) if self.session else 0

    @property
    def brackets(self) -> int:
        """The number of brackets that the training frames are of."""
        return len({record.bracket for record in self.training})

    def look(self) -> bool:
        """Read what has arrived since the last look; return whether anything has.

        Raises:
            SessionError, MissingFrames, SessionCorrupt: as `open_session`, but for a session without frames.
        """
        index = self.folder / "frames.jsonl"
        size_bytes = index.stat().st_size if index.exists() else 0
        if size_bytes == self._bytes_seen or not (self.folder / "session.json").exists():
            return False
        try:
            self.session = open_session(self.folder)
        except MissingFrames as error:
            if error.ids:
                raise
            return False  # the first line is being written
        self.session.check_body_axes()
        self._bytes_seen = size_bytes
        self._take(self.session)
        return True

    def whole(self, records: list[FrameRecord]) -> list[FrameRecord]:
        """Return the frames whose pictures are not damaged now; the others are told, and left out from now on."""
        assert self.session is not None
        good = whole(self.session, [record for record in records if record.id not in self.damaged])
        self.damaged |= {record.id for record in records} - {record.id for record in good}
        self.held_out = [record for record in self.held_out if record.id not in self.damaged]
        return good

    def _take(self, session: Session) -> None:
        if session.frames[0].split is not None:  # an imported session, which is whole from the start
            training, self.held_out = split(session)
        else:
            # in the order of the lines, and no more of them than the session that was read a moment before has
            known = {record.id for record in session.frames}
            records = [record for record in read_records(self.folder) if record.id in known]
            self.whole([record for record in records if record.id not in self._known])
            self._known |= known
            records = [record for record in records if record.id not in self.damaged]
            chosen = usable(records)
            self.eclipsed = sum(r.in_eclipse for r in records)
            self.untagged = len(records) - self.eclipsed - len(chosen)
            training = [r for r in chosen if not is_held_out(r)]
            self.held_out = [r for r in chosen if is_held_out(r)]
        if [r.id for r in training[: len(self.training)]] != [r.id for r in self.training]:
            raise SessionError(f"{self.folder} was replaced by another session: start again")
        new = [training_frame(session, record) for record in training[len(self.training) :]]
        self.frames = alike([*self.frames, *new])
        self.training = training
