"""A ruler in the viewer's scene: two clicked points of a model, their distance, and how far it may be wrong."""

import numpy as np
import viser

from ground.show.sizes import size_deviation, states_scale, with_deviation
from ground.show.turntable import metres_per_pixel
from ground.show.viewer.scene import RADIUS, Placed
from ground.show.viewer.source import Shown

LEAST_ALPHA = 1 / 255  # a Gaussian that covers less of a ray's light is not in its way
COLOUR = (42, 200, 160)


def struck(placed: Placed, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Return the point [3], m in the body frame, at which half of a ray's light has been stopped by a model.

    Args:
        origin, direction: [3] of the ray, in the scene.

    Returns:
        None where the ray passes the model, or comes through it with more than half of its light.
    """
    start = (origin - placed.offset) / placed.per_metre + placed.centre_m
    way = direction / np.linalg.norm(direction)
    shape, kept = placed.shapes, placed.is_inside()
    off = shape.means[kept] - start
    inverse = np.linalg.inv(shape.covariances[kept])
    across = inverse @ way
    depths = (across * off).sum(axis=1) / (across @ way)
    left = off - depths[:, None] * way
    alphas = shape.opacities[kept] * np.exp(-0.5 * np.einsum("ni,nij,nj->n", left, inverse, left))
    order = np.argsort(depths)
    order = order[(alphas[order] >= LEAST_ALPHA) & (depths[order] > 0)]
    through = np.cumprod(1 - alphas[order])
    stopped = np.flatnonzero(through < 0.5)
    return None if not len(stopped) else start + depths[order[stopped[0]]] * way


def measured(shown: Shown, first_m: np.ndarray, second_m: np.ndarray) -> str:
    """Return the distance of two points of a model in words, with its stated error: one standard deviation.

    The ends are each known to half a pixel of the session's cameras, the size of the whole as `size_deviation` says.
    """
    length = float(np.linalg.norm(second_m - first_m))
    share = size_deviation(shown.tagged, shown.estimate)
    error = float(np.hypot(share * length, 0.5 * metres_per_pixel(shown.session) * 2**0.5))
    if not states_scale(shown.session):
        return f"{with_deviation(length, error)} units of the imported poses, whose scale in metres is not stated"
    why = f"size known to {100 * share:.2g} %" if share else "poses stated as exact"
    return f"{with_deviation(length, error)} m (one standard deviation: {why}, each end to half a pixel)"


class Ruler:
    """Two points of a model and the line between them; a third click begins again."""

    def __init__(self, server: viser.ViserServer):
        self._server = server
        self._handles: list = []
        self.model: Placed | None = None
        self.points_m: list[np.ndarray] = []  # in the model's body frame

    def click(self, placed: list[Placed], origin: np.ndarray, direction: np.ndarray) -> str:
        """Take the point that a ray strikes first, and return what is to be said."""
        found = [(each, point) for each in placed if (point := struck(each, origin, direction)) is not None]
        if not found:
            return "no model there: click on it"
        model, point = min(found, key=lambda hit: float(np.linalg.norm(hit[0].place(hit[1]) - origin)))
        if model is not self.model or len(self.points_m) == 2:
            self.clear()
        self.model = model
        self.points_m.append(point)
        if len(self.points_m) == 1:
            text = "click on the second point"
        else:
            text = measured(model.shown, *self.points_m)
        self._draw(text)
        return text

    def _draw(self, text: str) -> None:
        assert self.model is not None
        ends = [self.model.place(point) for point in self.points_m]
        scene = self._server.scene
        self._remove()
        for i, end in enumerate(ends):
            ball = scene.add_icosphere(
                f"/ruler/end {i}", radius=RADIUS / 60, color=COLOUR, position=tuple(end)
            )
            self._handles.append(ball)
        if len(ends) == 2:
            line = np.stack(ends)[None].astype(np.float32)
            self._handles.append(scene.add_line_segments("/ruler/line", line, COLOUR, thickness=RADIUS / 150))
            short = text.partition(" (")[0]
            self._handles.append(
                scene.add_label("/ruler/length", short, position=tuple(np.mean(ends, axis=0)))
            )

    def _remove(self) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = []

    def clear(self) -> None:
        """Take the ruler out of the scene."""
        self._remove()
        self.points_m, self.model = [], None
