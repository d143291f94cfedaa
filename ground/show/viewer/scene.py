"""One model in the viewer's scene: its splats, the mesh, cameras with their frames, and the Sun."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from flightsw.icd.quaternion import matrix_to_quat
from ground.session.cameras import sensor_of, sun_direction
from ground.session.folder import FrameRecord, Session, SessionError
from ground.session.spread import evenly_spread
from ground.show.pictures import tone
from ground.show.turntable import extent
from ground.show.viewer.source import Shown
from ground.show.viewer.splats import colours, error_colours, shapes, uncertainty_colours
from obbgs_core.io.mesh import Z_UP_TO_Y_UP

RADIUS = 10.0  # of the first model in the scene: large enough for the half-precision covariances of viser
CAMERAS_AT = 2.0  # radii: true directions, but nearer, or the model could not be seen beside them
MOST_CAMERAS = 60
THUMBNAIL_PX = 64
SENSOR, ERROR, UNCERTAINTY = "as the sensor sees it", "residual chi²", "uncertainty of radiance"
COLOURS = (SENSOR, ERROR, UNCERTAINTY)


class Placed:
    """A model that was put into the scene below a name, and can be replaced there.

    Args:
        offset: [3] of its centre, in units of the scene.
        per_metre: units of the scene; None: such that the model's radius is RADIUS.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        shown: Shown,
        offset: np.ndarray,
        per_metre: float | None = None,
    ):
        self.shown, self.offset = shown, offset
        self._server, self._name = server, name
        centre, radius_m = extent(shown.gaussians)
        self.centre_m = centre.double().numpy()
        self.per_metre = RADIUS / radius_m if per_metre is None else per_metre
        self.shapes = shapes(shown)
        self.box_m: tuple[np.ndarray, np.ndarray] | None = None  # what is shown of it; None: all
        self._cropped_to = self.box_m  # as the splats in the scene are
        self._overlays: dict[str, np.ndarray] = {}
        self.handles: dict[str, list[Any]] = {"cameras": [], "sun": [], "mesh": [], "name": []}

    def place(self, point_m: np.ndarray) -> np.ndarray:
        """Return where a point [..., 3] of the body frame, m, lies in the scene."""
        return (point_m - self.centre_m) * self.per_metre + self.offset

    def draw(self, record: FrameRecord, exposure_time_s: float, colour: str, visible: bool = True) -> None:
        """Put the splats into the scene, or give those there other colours."""
        rgb = colours(self.shown, record, exposure_time_s) if colour == SENSOR else self._overlay(colour)
        opacities = (self.shapes.opacities * self.is_inside())[:, None].astype(np.float32)
        if "splats" in self.handles:  # drawn anew they would fade in again
            self.handles["splats"][0].rgbs = rgb.astype(np.float32) / 255
            if self._cropped_to is not self.box_m:
                self.handles["splats"][0].opacities = opacities
                self._cropped_to = self.box_m
            return
        self._cropped_to = self.box_m
        self.handles["splats"] = [
            self._server.scene.add_gaussian_splats(
                f"/{self._name}/splats",
                self.place(self.shapes.means).astype(np.float32),
                (self.shapes.covariances * self.per_metre**2).astype(np.float32),
                rgb.astype(np.float32) / 255,
                opacities,
                visible=visible,
            )
        ]

    def is_inside(self) -> np.ndarray:
        """Return which Gaussians [N] have their centres in the box that is shown."""
        if self.box_m is None:
            return np.ones(len(self.shapes.means), dtype=bool)
        low, high = self.box_m
        return np.all((self.shapes.means >= low) & (self.shapes.means <= high), axis=1)

    def draw_name(self, below: bool) -> None:
        """Write the model's name above or below it, as is needed where two stand side by side."""
        place = self.offset + np.array([0.0, 0.0, (-1.45 if below else 1.45) * RADIUS])
        label = self._server.scene.add_label(
            f"/{self._name}/name",
            self.shown.name,
            position=tuple(place),
            anchor="top-center" if below else "bottom-center",
        )
        self.handles["name"] = [label]

    def _overlay(self, colour: str) -> np.ndarray:
        if colour not in self._overlays:
            self._overlays[colour] = {ERROR: error_colours, UNCERTAINTY: uncertainty_colours}[colour](
                self.shown
            )
        return self._overlays[colour]

    def draw_mesh(self, visible: bool) -> None:
        """Put model.glb into the scene, if the run has one; its node turns the body's z axis to glTF's y, here back."""
        if self.shown.mesh is not None:
            self.handles["mesh"] = [
                self._server.scene.add_glb(
                    f"/{self._name}/mesh",
                    self.shown.mesh,
                    scale=self.per_metre,
                    wxyz=tuple(matrix_to_quat(Z_UP_TO_Y_UP[:3, :3].T)),
                    position=tuple(self.place(np.zeros(3))),
                    visible=visible,
                )
            ]

    def draw_sun(self, record: FrameRecord, visible: bool) -> None:
        """Put an arrow towards the Sun of a frame into the scene; none where the frame's tag does not know it."""
        sun = sun_direction(record)
        if sun is None:
            self._remove("sun")
            return
        ends = np.stack([1.0 * RADIUS * sun.numpy(), 1.25 * RADIUS * sun.numpy()]) + self.offset
        arrow = self._server.scene.add_arrows(
            f"/{self._name}/sun",
            ends[None].astype(np.float32),
            (240, 180, 41),
            shaft_radius=0.1,
            head_radius=0.3,
            head_length=0.8,
            visible=visible,
        )
        label = self._server.scene.add_label(
            f"/{self._name}/sun label", "Sun", position=tuple(ends[1]), visible=visible
        )
        self.handles["sun"] = [arrow, label]

    def draw_cameras(
        self, records: list[FrameRecord], chosen: Callable[[FrameRecord], None], visible: bool
    ) -> None:
        """Put one camera for each bracket into the scene, with a small picture; `chosen` is called with its frame."""
        self._remove("cameras")
        for record in one_per_bracket(records):
            away = record.position_body_m - self.centre_m
            handle = add_camera(
                self._server, self._name, self.shown.session, record, away, self.offset, visible
            )
            handle.on_click(lambda _, record=record: chosen(record))
            self.handles["cameras"].append(handle)

    def clear(self) -> None:
        """Take the model out of the scene, but for its splats, which those of the next one replace without a gap."""
        for part in ("cameras", "sun", "mesh", "name"):
            self._remove(part)

    def _remove(self, part: str) -> None:
        for handle in self.handles[part]:
            handle.remove()
        self.handles[part] = []

    def show(self, part: str, visible: bool) -> None:
        """Show or hide a part: splats, mesh, cameras, sun, name."""
        for handle in self.handles.get(part, ()):
            handle.visible = visible


def one_per_bracket(records: list[FrameRecord]) -> list[FrameRecord]:
    """Return the last frame of each bracket, of at most MOST_CAMERAS brackets, spread evenly."""
    last = list({record.bracket: record for record in records}.values())
    return evenly_spread(last, MOST_CAMERAS)


def add_camera(
    server: viser.ViserServer,
    name: str,
    session: Session,
    record: FrameRecord,
    away: np.ndarray,
    offset: np.ndarray,
    visible: bool,
) -> viser.CameraFrustumHandle:
    """Put the camera of a frame with a small picture into the scene, below a name, and return it.

    Args:
        away: [3] in its direction, seen from the model, body frame.
        offset: [3] of the model, in units of the scene.
    """
    return server.scene.add_camera_frustum(
        f"/{name}/cameras/{record.id}",
        fov=0.5,
        aspect=session.camera.width / session.camera.height,
        scale=1.2,
        thickness=0.04,
        color=(209, 101, 42),
        image=picture(session, record, THUMBNAIL_PX),
        wxyz=tuple(matrix_to_quat(record.world_to_camera[:3, :3].T)),
        position=tuple(offset + CAMERAS_AT * RADIUS * away / max(float(np.linalg.norm(away)), 1e-9)),
        visible=visible,
    )


def picture(session: Session, record: FrameRecord, largest_px: int) -> np.ndarray | None:
    """Return a frame in screen brightness, bytes [H, W, 3], every so many pixels; None if it cannot be read."""
    try:
        dn = session.dn(record)
    except SessionError:
        return None
    sensor, step = sensor_of(session.camera), math.ceil(max(dn.shape[:2]) / largest_px)
    image = dn[::step, ::step].astype(np.float32) / sensor.white_dn
    return tone(image.reshape(*image.shape[:2], -1), sensor, session.encoding)
