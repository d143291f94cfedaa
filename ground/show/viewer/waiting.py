"""The viewer's page before there is a model: what is waited for, and the frames that have come."""

import time
from collections.abc import Callable

import numpy as np
import viser

from ground.run.live.status import line, read_status
from ground.session.folder import MissingFrames, Session, open_session
from ground.show.viewer.pass_plots import PassPlots
from ground.show.viewer.scene import RADIUS, add_camera, one_per_bracket, picture
from ground.show.viewer.source import Source
from obbgs_base.errors import counted

PICTURE_PX = 320
START = np.array(
    [0.0, -6.0 * RADIUS, 2.0 * RADIUS]
)  # of the viewers' cameras, with all frames' cameras in view


def awaited(
    server: viser.ViserServer, sources: list[Source], should_stop: Callable[[], bool], poll_s: float
) -> bool:
    """Show the frames that come until every run has a model; return False when told to stop before.

    Raises:
        SessionError: the session of the first run is damaged.
    """
    waiting = None
    while not all([source.is_ready() for source in sources]):  # each looks for its run
        if should_stop():
            return False
        waiting = waiting or Waiting(server, sources)
        waiting.look()
        waiting.plots.tick(poll_s)
        time.sleep(poll_s)
    if waiting is not None:
        server.gui.reset()
        server.scene.reset()
    return True


class Waiting:
    """A page with the newest frame and the cameras of the first run's session, without a model."""

    def __init__(self, server: viser.ViserServer, sources: list[Source]):
        self._server, self._sources = server, sources
        self._frames = self._bytes_seen = 0  # in the session, and in its frames.jsonl
        self._drawn: set[int] = set()  # frames whose cameras stand in the scene
        server.gui.main_panel.dock_right()
        self.plots = PassPlots(server, sources[0].session_path)
        self.status = server.gui.add_markdown("")
        self.newest = server.gui.add_image(
            np.zeros((2, 2, 3), np.uint8), label="the newest frame", format="png"
        )
        server.initial_camera.position, server.initial_camera.look_at = START, np.zeros(3)

    def look(self) -> None:
        """Show what has come since the last look.

        Raises:
            SessionError: the session is damaged.
        """
        index = self._sources[0].session_path / "frames.jsonl"
        size_bytes = index.stat().st_size if index.exists() else 0
        if size_bytes != self._bytes_seen:
            try:
                self._draw(open_session(index.parent))
                self._bytes_seen = size_bytes
            except MissingFrames as error:
                if error.ids:
                    raise  # without them the first line is being written
        words = [f"{counted(self._frames, 'frame')} received."]
        for source in self._sources:
            if not source.is_ready():
                words.append(f"**Waiting for the first model of {source.name}.** {_progress(source)}")
        text = "\n\n".join(words)
        if self.status.content != text:
            self.status.content = text

    def _draw(self, session: Session) -> None:
        self._frames = len(session.frames)
        newest = picture(
            session, max(session.frames, key=lambda r: (r.mid_exposure_utc_ns, r.id)), PICTURE_PX
        )
        if newest is not None:
            self.newest.image = newest
        for record in one_per_bracket(list(session.frames)):
            if record.id not in self._drawn:
                self._drawn.add(record.id)
                add_camera(
                    self._server, "waiting", session, record, record.position_body_m, np.zeros(3), True
                )


def _progress(source: Source) -> str:
    """Return how the reconstruction says that it stands."""
    facts = {} if source.folder is None else read_status(source.folder)
    return (
        line(facts)
        if facts
        else "`ground live` makes one while frames come, `ground reconstruct` afterwards."
    )
