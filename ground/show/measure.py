"""Lengths and areas of a run's body, with their stated errors."""

import numpy as np

from ground.show.inspection import Model
from obbgs_core.inspect.faces import (
    area_half_width,
    flat_faces,
    is_flat,
    largest_dimension,
    length_half_width,
    nearest_on,
)

WIDTH_KNOWN = 0.25  # half of the 90 % interval of a face's width as a share of it, at most


def places_of(text: str) -> np.ndarray:
    """Return two places [2, 3] m that a text such as 0,0,1:0,0,-1 names.

    Raises:
        ValueError: it names no two places.
    """
    try:
        places = np.array([[float(x) for x in place.split(",")] for place in text.split(":")])
    except ValueError:
        places = np.zeros(0)
    if places.shape != (2, 3) or not np.isfinite(places).all():
        raise ValueError(f"expected two places as X,Y,Z:X,Y,Z in metres, got {text!r}")
    return places


def _is_known(width: dict) -> bool:
    """Return whether a face is so wide that its width says something: the others are crumbs of a curved surface."""
    return width["half_width_90"] <= WIDTH_KNOWN * width["value"]


def measured(model: Model, between: list[np.ndarray] | None = None) -> dict:
    """Return sizes of a run's body as values for JSON, each with half the width of its 90 % interval.

    Args:
        between: pairs of places [2, 3] m, body axes; the points of the surface that are nearest to them count.

    Raises:
        ValueError: a place is further away from the surface than the body is large.
    """
    pixel_m, deviation = model.surface.pixel_m, model.size_deviation

    def length(value: float) -> dict:
        return {"value": value, "half_width_90": length_half_width(value, pixel_m, deviation)}

    largest, ends = largest_dimension(model.surface.points)
    faces = [
        {
            "name": f"face {number}",
            "middle": face.middle.tolist(),
            "normal": face.axes[2].tolist(),
            "length": length(float(face.extent[0])),
            "width": length(float(face.extent[1])),
            "area": {"value": face.area_m2, "half_width_90": area_half_width(face, pixel_m, deviation)},
        }
        for number, face in enumerate(
            (
                face
                for face in flat_faces(model.surface)
                if _is_known(length(float(face.extent[1]))) and is_flat(face, model.surface)
            ),
            1,
        )
    ]
    distances = []
    for places in between or []:
        points = nearest_on(model.surface, places)
        away = np.linalg.norm(points - places, axis=1)
        if away.max() > largest:
            x, y, z = places[away.argmax()]
            unit = "m" if model.in_metres else "units"
            raise ValueError(
                f"{x:g},{y:g},{z:g} is {away.max():.3g} {unit} from the surface, and all of the body is "
                f"{largest:.3g} {unit} large: give a place near the point that is meant"
            )
        distances.append(length(float(np.linalg.norm(points[1] - points[0]))) | {"points": points.tolist()})
    return {
        "run": model.name,
        "unit": "m" if model.in_metres else "units of the imported poses",
        "size_sigma_percent": 100 * deviation,
        "pixel": pixel_m,
        "largest_dimension": length(largest) | {"points": ends.tolist()},
        "faces": faces,
        "distances": distances,
    }
