"""The viewer's controls and what they do; it draws again whenever a run's model is renewed."""

import logging
import math
import re
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import imagecodecs
import numpy as np
import viser

from ground.run.runs import without_own_sky
from ground.session.cameras import predicted_image, range_in_words, sun_direction
from ground.session.exposures import in_ms, offered_s
from ground.session.folder import FrameRecord, Session, SessionError
from ground.session.training_frames import training_frame
from ground.show.pictures import ERROR_FULL_SCALE, heat, tone
from ground.show.sizes import states_scale, states_time
from ground.show.turntable import VIEWS, circle, moving_png, pictures
from ground.show.viewer.door import opened
from ground.show.viewer.pass_plots import PassPlots
from ground.show.viewer.ruler import Ruler
from ground.show.viewer.scene import (
    COLOURS,
    ERROR,
    RADIUS,
    SENSOR,
    UNCERTAINTY,
    Placed,
)
from ground.show.viewer.source import Source
from ground.show.viewer.splats import CHI2_SHOWN, DEVIATION_SHOWN, best_seen, legend, seen_exposure_s
from ground.show.viewer.waiting import awaited
from obbgs_base.errors import counted, reason
from obbgs_core.errors import ReconstructionError
from obbgs_core.render.backdrops import without_earth

log = logging.getLogger(__name__)
POLL_S, TICK_S = 1.0, 0.25  # between looks for a renewed model, and between steps of a replay
APART = 2.4  # radii between the centres of two models side by side
SHOWN_BETWEEN = 0.01, 1000.0  # distances from the camera, as viser has them at first
FIELD_RAD = 0.4  # vertical field of view, about that of a telescope's picture of the model
NEAREST, FARTHEST = (
    1.4,
    40.0,
)  # radii from the model that the camera may come to: the wheel never flies into it
# the exposure slider reaches from a quarter of the shortest exposure to so many times the longest
REACH = 4.0
DIGITS = 2  # that the exposure slider shows behind the first one of its shortest time
TURNTABLE_PX = (480, 320)
CHI2_WORDS = "residual chi²: mean squared residual over the variance of the noise; 1 is noise alone"
DEVIATION_WORDS = "standard deviation of the radiance, as a share of full scale at the middle exposure"
PARTS = ("splats", "cameras", "sun", "mesh")


def view(
    sources: list[Source],
    host: str,
    port: int,
    on_ready: Callable[[int], None],
    should_stop: Callable[[], bool],
) -> None:
    """Show one run, or two side by side, until told to stop; `on_ready` receives the port.

    Until each has a model the page says what is waited for and shows the frames that have come.

    Raises:
        SessionError, ReconstructionError: a session or the first model of a run cannot be read. Later ones are logged,
            and the model that was read last stays.
        ViewError: the port cannot be bound.
    """
    server = opened(host, port)
    try:
        on_ready(server.get_port())
        server.scene.set_up_direction("+z")
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        if not awaited(server, sources, should_stop, POLL_S):
            return
        shown = [source.load() for source in sources]
        first = Placed(server, "a", shown[0], np.zeros(3))
        placed = [first]
        for other in shown[1:]:
            placed.append(Placed(server, "b", other, np.array([APART * RADIUS, 0.0, 0.0]), first.per_metre))
        viewer = Viewer(server, placed)
        plots = PassPlots(server, sources[0].session_path, viewer.show_time, viewer.taken_utc_ns)
        looked_s = time.monotonic() - POLL_S
        while not should_stop():
            plots.tick(TICK_S)
            time.sleep(TICK_S)
            if time.monotonic() < looked_s + POLL_S:
                continue
            looked_s = time.monotonic()
            for i, source in enumerate(sources):
                if source.renewed():
                    try:
                        viewer.renew(i, source)
                    except (SessionError, ReconstructionError, OSError, ValueError) as error:
                        log.warning("%s is not shown anew: %s", source.name, reason(error))
    finally:
        server.stop()


class Viewer:
    """The page: those who watch at once share exposure, frame and colours, each has a camera of its own."""

    def __init__(self, server: viser.ViserServer, placed: list[Placed]):
        self.server, self.placed = server, placed
        self.lock = threading.RLock()  # viser calls from threads of its own
        self.frames = _in_time(placed[0])
        server.gui.main_panel.dock_right()  # beside the scene: above it, it would hide the target on narrow screens
        self._controls()
        self._start_camera()
        server.on_client_connect(self._frame)
        server.on_client_disconnect(self._left)
        for client in server.get_clients().values():  # who waited for the model
            self._reset(client)
        self.draw_all()

    @property
    def record(self) -> FrameRecord:
        """The frame that the timeline stands at."""
        return self.frames[min(max(int(self.timeline.value), 0), len(self.frames) - 1)]

    @property
    def exposure_s(self) -> float:
        low_ms, high_ms = self.exposure_limits_ms
        value_ms = float(self.exposure.value)
        return float(np.clip(value_ms if np.isfinite(value_ms) else low_ms, low_ms, high_ms)) / 1e3

    @property
    def colour(self) -> str:
        return self.colouring.value if self.colouring.value in COLOURS else SENSOR

    def _controls(self) -> None:
        gui, session = self.server.gui, self.placed[0].shown.session
        self.status = gui.add_markdown("")
        exposures_s = sorted({record.exposure_time_s for record in session.frames})
        seen_s = float(
            np.clip(seen_exposure_s(self.placed[0].shown), exposures_s[0] / REACH, exposures_s[-1] * REACH)
        )
        middle_ms = 1e3 * seen_s
        name = "Brightness, per mille" if session.nominal_exposures else "Exposure, ms"
        self.exposure = gui.add_slider(name, min=middle_ms, max=middle_ms, step=1.0, initial_value=middle_ms)
        self.exposure.on_update(lambda _: self.draw_splats())
        self.brackets = gui.add_button_group("Brackets, ms", [""], visible=not session.nominal_exposures)
        self.brackets.on_click(lambda _: self._expose(self.brackets.value))
        self.colouring = gui.add_dropdown("Colours", COLOURS, initial_value=SENSOR)
        self.colouring.on_update(lambda _: self._colour_anew())
        self.legend = gui.add_html("", visible=False)
        self.checks = {}
        for part in PARTS:
            self.checks[part] = gui.add_checkbox(part.capitalize(), initial_value=part in ("splats", "sun"))
            self.checks[part].on_update(lambda _: self._show())
        self._measuring_controls()
        with gui.add_folder("Timeline of the pass"):
            first = self.frames.index(best_seen(self.placed[0].shown, seen_s))
            last = max(1, len(self.frames) - 1)
            self.timeline = gui.add_slider("Frame", min=0, max=last, step=1, initial_value=first)
            self.timeline.on_update(lambda _: self.draw_frame())
            self.facts = gui.add_markdown("")
            self.comparison = gui.add_image(
                np.zeros((2, 6, 3), np.uint8), label="frame, model, error", format="png"
            )
            through = gui.add_button("Look through its camera")
            through.on_click(lambda event: self._look_through(event.client))
        reset = gui.add_button("Reset view")
        reset.on_click(lambda event: self._reset(event.client))
        picture = gui.add_button("Save picture")
        picture.on_click(lambda event: self._save_picture(event.client))
        turntable = gui.add_button("Save turntable")
        turntable.on_click(lambda event: self._save_turntable(event.client))
        self._fit_controls()
        chosen = (
            self.exposure,
            self.colouring,
            *self.checks.values(),
            self.measuring,
            *self.crops,
            self.timeline,
        )
        self.defaults: list[tuple[Any, Any]] = [(control, control.value) for control in chosen]

    def _measuring_controls(self) -> None:
        """Add the ruler and the box outside which nothing of the models is drawn."""
        gui = self.server.gui
        self.ruler = Ruler(self.server)
        self.measuring = gui.add_checkbox("Ruler: click on two points", initial_value=False)
        self.measuring.on_update(lambda _: self._measure())
        self.length = gui.add_markdown("", visible=False)
        self.crops = []
        with gui.add_folder("Crop", expand_by_default=False):
            reach_m = RADIUS / self.placed[0].per_metre
            unit = "m" if states_scale(self.placed[0].shown.session) else "units"
            for axis, middle in zip("xyz", self.placed[0].centre_m, strict=True):
                # two digits behind the first of the reach, as the slider shows them
                digits = 2 - math.floor(math.log10(reach_m))
                low, high = (round(float(middle + side * 1.5 * reach_m), digits) for side in (-1, 1))
                step = 10.0**-digits
                crop = gui.add_multi_slider(f"{axis}, {unit}", low, high, step, initial_value=(low, high))
                crop.on_update(lambda _: self._crop())
                self.crops.append(crop)

    def _colour_anew(self) -> None:
        told = {ERROR: (CHI2_SHOWN, CHI2_WORDS), UNCERTAINTY: (DEVIATION_SHOWN, DEVIATION_WORDS)}.get(
            self.colour
        )
        self.legend.visible = told is not None
        if told is not None:
            self.legend.content = legend(*told)
        self.draw_splats()

    def _measure(self) -> None:
        """Take clicks for the ruler, or no longer."""
        scene = self.server.scene
        if self.measuring.value:
            scene.on_click()(self._click)
            self.length.content = "click on the first point"
        else:
            scene.remove_click_callback()
            self.ruler.clear()
        self.length.visible = bool(self.measuring.value)

    def _click(self, event: viser.SceneClickEvent) -> None:
        with self.lock:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            if np.linalg.norm(direction) > 0:
                self.length.content = self.ruler.click(self.placed, origin, direction)

    def _crop(self) -> None:
        ends = np.array([crop.value for crop in self.crops])
        whole = np.array([(crop.min, crop.max) for crop in self.crops])
        box_m = np.where(ends == whole, (-np.inf, np.inf), ends).T  # at a slider's end nothing is cut
        for each in self.placed:
            each.box_m = (box_m[0], box_m[1])
        self.draw_splats()

    def _fit_controls(self) -> None:
        """Let the controls reach what there is to show; what was chosen stays where it still can be."""
        exposures_s = [record.exposure_time_s for record in self.frames]
        low_ms, high_ms = 1e3 * min(exposures_s) / REACH, 1e3 * max(exposures_s) * REACH
        self.exposure_limits_ms = low_ms, high_ms
        self.exposure.min, self.exposure.max, self.exposure.step = low_ms, high_ms, low_ms / 10
        self.exposure.precision = max(0, DIGITS - math.floor(math.log10(low_ms)))
        self.exposure.value = 1e3 * self.exposure_s  # within the limits
        self.offered_s = offered_s(exposures_s)
        self.brackets.options = tuple(self.offered_s)
        self.timeline.max = max(1, len(self.frames) - 1)
        self.checks["sun"].visible = any(sun_direction(record) is not None for record in self.frames)
        self.checks["mesh"].visible = any(each.shown.mesh is not None for each in self.placed)

    def draw_all(self) -> None:
        """Draw everything anew, after a model was put in place."""
        with self.lock:
            for index, each in enumerate(self.placed):
                each.draw_mesh(self._is_checked("mesh"))
                if len(self.placed) > 1:
                    each.draw_name(below=index == 1)  # on a phone names in one line would cover one another
            self.placed[0].draw_cameras(self.frames, self._choose, self._is_checked("cameras"))
            self.draw_frame()
            names = " | ".join(
                f"{each.shown.name}, {counted(len(each.shown.gaussians), 'Gaussian')}" for each in self.placed
            )
            self.status.content = f"**{names}**, read at {datetime.now(UTC):%H:%M:%SZ}"

    def draw_splats(self) -> None:
        """Draw the splats at the chosen exposure, from the direction of the chosen frame, under its Sun."""
        with self.lock:
            for each in self.placed:
                record = self.record if each is self.placed[0] else _nearest(each, self.record)
                each.draw(record, self.exposure_s, self.colour, self._is_checked("splats"))

    def draw_frame(self) -> None:
        """Draw what depends on the chosen frame: facts, pictures, the Sun and the splats' colours."""
        with self.lock:
            record, first = self.record, self.placed[0]
            self.facts.content = _facts(first.shown.session, record)
            self.comparison.image = _compared(first, record)
            for each in self.placed:
                each.draw_sun(record, self._is_checked("sun"))
            self.draw_splats()

    def taken_utc_ns(self) -> list[int]:
        """Return the times at which the frames of the timeline were taken."""
        return [record.mid_exposure_utc_ns for record in self.frames]

    def show_time(self, utc_ns: int) -> None:
        """Move the timeline to the frame that was taken last before a time of the pass."""
        taken = [i for i, record in enumerate(self.frames) if record.mid_exposure_utc_ns <= utc_ns]
        if taken and taken[-1] != self.timeline.value:
            self.timeline.value = taken[-1]

    def renew(self, index: int, source: Source) -> None:
        """Read a run again and draw it in place of the one that was there, in the same scale."""
        shown, old = source.load(), self.placed[index]
        with self.lock:
            self.placed[index] = Placed(self.server, "ab"[index], shown, old.offset, old.per_metre)
            self.placed[index].box_m = old.box_m
            self.ruler.clear()
            old.clear()
            if index == 0:
                self.frames = _in_time(self.placed[0])
            self._fit_controls()
            self.draw_all()

    def _is_checked(self, part: str) -> bool:
        return bool(self.checks[part].value)

    def _show(self) -> None:
        with self.lock:
            for each in self.placed:
                for part in PARTS:
                    each.show(part, self._is_checked(part))

    def _expose(self, text: str) -> None:
        if text in self.offered_s:
            self.exposure.value = 1e3 * self.offered_s[text]

    def _choose(self, record: FrameRecord) -> None:
        self.timeline.value = self.frames.index(record)

    def _start_camera(self) -> None:
        camera = self.server.initial_camera
        away = self.record.position_body_m / max(float(np.linalg.norm(self.record.position_body_m)), 1e-9)
        middle = np.mean([each.offset for each in self.placed], axis=0)
        self.start = middle + away * _fitting_distance(len(self.placed)), middle
        camera.fov = FIELD_RAD
        camera.position, camera.look_at = self.start
        camera.near, camera.far = RADIUS / 10, 100 * RADIUS

    def _frame(self, client: viser.ClientHandle) -> None:
        """Let a client begin with the whole model in view, from further away where its window is narrow.

        Until it is moved its camera follows the window's shape, which changes when the panel is put beside the scene.
        """
        self._limit_zoom(client)
        # where it may have been put, the last one last
        begun = [self._begin(client.camera.aspect), self._begin(1.0)]

        def follow(camera: viser.CameraHandle) -> None:
            unmoved = any(np.allclose(camera.position, each, rtol=1e-3, atol=1e-3) for each in begun)
            if unmoved and not np.allclose(begun[-1], begin := self._begin(camera.aspect)):
                begun.append(begin)
                self._place(client)

        client.camera.on_update(follow)
        follow(client.camera)

    def _left(self, client: viser.ClientHandle) -> None:
        """Let the page that is opened after the last one was closed begin as the first one did."""
        with self.lock:
            if self.server.get_clients():
                return
            for control, value in self.defaults:
                if control.value != value:
                    control.value = value
            self._fit_controls()  # a run that grows may have other limits by now

    def _begin(self, aspect: float) -> np.ndarray:
        """Return where a camera stands at first whose picture is so many times as wide as high."""
        position, look_at = self.start
        return look_at + (position - look_at) / min(1.0, aspect)

    def _place(self, client: viser.ClientHandle) -> None:
        client.camera.position = self._begin(client.camera.aspect)
        client.camera.look_at = self.start[1]

    def _limit_zoom(self, client: viser.ClientHandle) -> None:
        client.camera.max_orbit_distance = FARTHEST * RADIUS
        client.camera.min_orbit_distance = NEAREST * RADIUS

    def _reset(self, client: viser.ClientHandle | None) -> None:
        if client is not None:
            client.camera.up_direction = (0.0, 0.0, 1.0)
            self._place(client)
            client.camera.fov = FIELD_RAD
            client.camera.near, client.camera.far = SHOWN_BETWEEN
            self._limit_zoom(client)

    def _look_through(self, client: viser.ClientHandle | None) -> None:
        """Put a viewer's camera where the chosen frame's was, as far away, with its direction of up and field."""
        if client is None:
            return
        first = self.placed[0]
        record, session = first.shown.compared(self.record), first.shown.session
        pose, K = record.world_to_camera, session.K(record)
        client.camera.max_orbit_distance = 1e6 * RADIUS
        position = first.place(-pose[:3, :3].T @ pose[:3, 3])
        distance = float(np.linalg.norm(position))
        client.camera.far, client.camera.near = distance + 100 * RADIUS, max(0.01, distance - 50 * RADIUS)
        client.camera.fov = float(2 * np.arctan(session.camera.height / 2 / K[1, 1]))
        _, down, forward = pose[:3, :3]
        client.camera.up_direction = -down
        client.camera.position = position
        client.camera.look_at = position + distance * forward

    def file_name(self, what: str) -> str:
        """Return the name of a picture to save: of which models, frame and exposure time it is."""
        names = "-and-".join(each.shown.name for each in self.placed)
        exposure = "" if self.placed[0].shown.session.nominal_exposures else f"-{in_ms(self.exposure_s)}ms"
        text = f"{names}-frame{self.record.id:06d}{exposure}-{what}.png"
        return re.sub(r"[^A-Za-z0-9._-]+", "-", text)

    def _save_picture(self, client: viser.ClientHandle | None) -> None:
        if client is not None:
            # viser draws splats squeezed in a picture of another shape than the window's
            shape = client.camera.image_height, client.camera.image_width
            image = client.get_render(*shape, transport_format="png", timeout=60)
            png = imagecodecs.png_encode(np.ascontiguousarray(on_black(image)))
            what = "view" if self.colour == SENSOR else f"view-of-{self.colour}"
            client.send_file_download(self.file_name(what), bytes(png), save_immediately=True)

    def _save_turntable(self, client: viser.ClientHandle | None) -> None:
        """Send the first model's turntable, drawn by our own renderer at the chosen exposure."""
        if client is not None:
            shown = self.placed[0].shown
            cameras = circle(shown.gaussians, shown.session, VIEWS, *TURNTABLE_PX)
            images = pictures(shown.gaussians, shown.session, shown.sensor, self.exposure_s, cameras)
            client.send_file_download(self.file_name("turntable"), moving_png(images), save_immediately=True)


def _in_time(placed: Placed) -> list[FrameRecord]:
    return sorted(placed.shown.session.frames, key=lambda record: (record.mid_exposure_utc_ns, record.id))


def _nearest(placed: Placed, record: FrameRecord) -> FrameRecord:
    """Return the frame of another session that was taken from the direction nearest to a frame's."""
    wanted = record.position_body_m / max(float(np.linalg.norm(record.position_body_m)), 1e-9)
    frames = placed.shown.session.frames
    return max(
        frames,
        key=lambda r: float(r.position_body_m @ wanted) / max(float(np.linalg.norm(r.position_body_m)), 1e-9),
    )


def _fitting_distance(models: int) -> float:
    width = RADIUS * (1 + APART / 2 * (models - 1))
    return 1.35 * width / np.tan(FIELD_RAD / 2)


def _facts(session: Session, record: FrameRecord) -> str:
    """Return what is known of a frame; of imported pictures only what their format states."""
    facts = [
        f"frame {record.id} of bracket {record.bracket}" if session.is_bracketed else f"picture {record.id}"
    ]
    if not session.nominal_exposures:
        facts.append(f"{1e3 * record.exposure_time_s:g} ms")
    if states_time(session, record):
        facts.append(f"{datetime.fromtimestamp(record.mid_exposure_utc_ns / 1e9, UTC):%H:%M:%S} UTC")
    if states_scale(session):
        facts.append(range_in_words(record))
    facts.append(f"{counted(record.saturated, 'pixel')} saturated")
    return ", ".join(facts)


def _compared(placed: Placed, record: FrameRecord) -> np.ndarray:
    """Return a frame, the model's picture and the error side by side, bytes [H, 3 W, 3].

    Neither the Earth nor what empty sky reads above the stated black level is an error of the model.
    """
    shown = placed.shown
    seen_from = shown.compared(record)
    tagged = next(r for r in shown.tagged.frames if r.id == record.id)
    try:
        taken = training_frame(shown.tagged, seen_from, tagged)
    except SessionError as error:
        log.warning("%s", error)
        return np.zeros((2, 6, 3), np.uint8)
    frame = taken.dn / shown.sensor.white_dn
    image = predicted_image(shown.gaussians, shown.session, seen_from, shown.sensor, record.exposure_time_s)
    black = without_earth(shown.gaussians, without_own_sky(taken, shown.sensor), shown.sensor)
    on_black = black.dn / shown.sensor.white_dn
    error = ((image - on_black).abs().mean(-1, keepdim=True) / ERROR_FULL_SCALE).clamp(0, 1)
    encoding = shown.session.encoding
    toned = [tone(each.numpy(), shown.sensor, encoding) for each in (frame, image)]
    return np.concatenate([*toned, heat(error.numpy())], axis=1)


def on_black(image: np.ndarray) -> np.ndarray:
    """Return a picture [H, W, 4] with transparency on black, bytes [H, W, 3]."""
    return (image[..., :3].astype(np.float32) * (image[..., 3:] / 255)).round().astype(np.uint8)
