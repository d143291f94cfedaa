"""Is a body as built: a run's surface against a CAD mesh, or against another run; as JSON, page and coloured GLB."""

import html
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from ground.run.runs import written_to
from ground.session.cameras import cameras_of
from ground.session.folder import SessionError
from ground.session.spread import evenly_spread
from ground.show.page import cards, legend, page, picture, section
from ground.show.sizes import size_deviation, states_scale
from ground.show.turntable import metres_per_pixel
from ground.show.viewer.source import Shown, Source
from obbgs_base.files import write_whole
from obbgs_core.inspect.alignment import Surface
from obbgs_core.inspect.cad import CadMesh, Samples, read_cad, sampled
from obbgs_core.inspect.faces import faces_as_parts
from obbgs_core.inspect.findings import STATES, Inspection, Region, inspect
from obbgs_core.inspect.plates import Z_90, Turn, is_turned
from obbgs_core.inspect.shown import Views
from obbgs_core.io.mesh import Z_UP_TO_Y_UP

SPACING_PX = 0.5  # between points on a run's mesh
SEEN_BY = 2  # views that must see all corners of a triangle of a run for it to count as seen
MOST_VIEWS = 60
COLOURS = {  # of the states of a design, and of what was added
    "as designed": (150, 160, 170),
    "missing": (214, 48, 49),
    "not seen": (70, 75, 85),
    "turned": (240, 180, 41),
    "added": (46, 134, 222),
}
PICTURE_PX, ELEVATION_RAD = 460, np.radians(25)


@dataclass(frozen=True)
class Model:
    """What an inspection needs of a run: its seen surface, its closed mesh, its views, and the error of its size.

    solid: points all over the mesh, of which part 1 is seen. size_deviation: standard deviation of the model's size as
    a share of it. in_metres: the poses state a scale.
    """

    name: str
    mesh: CadMesh
    surface: Surface
    solid: Samples
    views: Views
    size_deviation: float
    in_metres: bool


def read_model(run: Path) -> Model:
    """Return the surface of a finished run, from its model.glb.

    Raises:
        SessionError: the folder is no run in a session, or has no mesh.
    """
    shown = Source(run).load()
    pixel_m = metres_per_pixel(shown.session)
    mesh = _own_mesh(shown, run)
    solid = sampled(mesh, SPACING_PX * pixel_m)
    seen = np.flatnonzero(solid.part == 1)
    if len(seen) == 0:
        raise SessionError(
            f"no triangle of {run / 'model.glb'} is seen by {SEEN_BY} views: train it with more frames"
        )
    surface = Surface(solid.points[seen], solid.normals[seen], solid.area[seen], pixel_m)
    return Model(
        shown.name,
        mesh,
        surface,
        solid,
        _views(shown),
        size_deviation(shown.tagged, shown.estimate),
        states_scale(shown.session),
    )


def _own_mesh(shown: Shown, run: Path) -> CadMesh:
    """Return a run's mesh, body axes, m, in two parts: what is not seen and what is."""
    import trimesh

    if shown.mesh is None:
        raise SessionError(f"{run} has no model.glb: `ground mesh` makes it")
    try:
        (geometry,) = trimesh.load_scene(io.BytesIO(shown.mesh), file_type="glb").geometry.values()
        seen_by = np.asarray(geometry.vertex_attributes["_SEEN_BY_VIEWS"]).ravel()
        # the file's node turns z upwards; the vertices themselves are in the body's axes
        vertices, triangles = np.asarray(geometry.vertices, dtype=np.float64), np.asarray(geometry.faces)
        seen = np.all(seen_by[triangles] >= SEEN_BY, axis=1).astype(np.int64)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise SessionError(
            f"{run / 'model.glb'} is damaged or of another program: {error}; `ground mesh` makes it anew"
        ) from error
    return CadMesh(vertices, triangles, seen, ("not seen", "seen"))


def _views(shown: Shown) -> Views:
    """Return a run's frames, one of each bracket and MOST_VIEWS at most; their Suns where all tags know them."""
    last = list({record.bracket: record for record in shown.session.frames if record.pose_valid}.values())
    cameras = cameras_of(shown.session, evenly_spread(last, MOST_VIEWS))
    return Views(
        cameras.world_to_camera.double().numpy(),
        cameras.K.double().numpy(),
        cameras.width,
        cameras.height,
        None if cameras.sun_dir is None else cameras.sun_dir.double().numpy(),
    )


def inspected(model: Model, cad: CadMesh, against: str) -> tuple[Inspection, dict]:
    """Return what of a run is not as designed, and the same as values for JSON; lengths in metres, angles in degrees.

    Raises:
        ReconstructionError: the run shows too little surface.
    """
    found = inspect(cad, model.surface, model.solid, model.views)
    place, pixel_m = found.place, model.surface.pixel_m
    deviation = float(np.hypot(place.covariance[6, 6] ** 0.5, model.size_deviation))
    half = Z_90 * deviation * place.scale
    return found, {
        "run": model.name,
        "against": against,
        "unit": "m" if model.in_metres else "units of the imported poses",
        "pixel": pixel_m,
        "cad_to_body": place.matrix().tolist(),
        "scale": place.scale,
        "scale_interval_90": [place.scale - half, place.scale + half],
        "rotation_sigma_deg": np.degrees(np.sqrt(np.diag(place.covariance)[:3])).tolist(),
        "surface_sigma": place.sigma_m,
        "surface_thicker_by": place.thicker_m,
        "symmetric_rotations": found.place.other_rotations.tolist(),
        "design_shown_share": found.seen,
        "as_designed": not found.regions and not found.turned,
        "panels": [_panel(turn, found) for turn in found.turns],
        "regions": [_finding(region, model.size_deviation) for region in found.regions],
    }


def _panel(turn: Turn, found: Inspection) -> dict:
    return {
        "part": found.parts[turn.plate.part],
        "middle": turn.plate.middle.tolist(),
        "extent": turn.plate.extent.tolist(),
        "normal": turn.plate.axes[2].tolist(),
        "turned": is_turned(turn),
        "angle_deg": float(np.degrees(turn.tilt_rad)),
        "angle_deg_interval_90": np.degrees(turn.interval).tolist(),
        "axis": turn.axis.tolist(),
        "sigmas": turn.significance,
    }


def _finding(region: Region, size_deviation: float) -> dict:
    def widened(value: float, interval: tuple[float, float]) -> list[float]:
        half = float(np.hypot((interval[1] - interval[0]) / 2, Z_90 * size_deviation * value))
        return [max(0.0, value - half), value + half]

    return {
        "kind": region.kind,
        "part": region.part,
        "whole_part": region.whole,
        "middle": region.middle.tolist(),
        "area": region.area_m2,
        "size": region.size_m,
        "size_interval_90": widened(region.size_m, region.size_interval),
        "stands_off": region.depth_m,
        "stands_off_interval_90": widened(region.depth_m, region.depth_interval),
    }


def cad_of_run(model: Model) -> CadMesh:
    """Return the seen surface of a run as a design for another: its flat faces are the parts, and what is left."""
    seen = model.mesh.part == 1
    mesh = CadMesh(model.mesh.vertices, model.mesh.triangles[seen], model.mesh.part[seen], model.mesh.names)
    return faces_as_parts(mesh, model.surface.pixel_m)


def write_inspection(run: Path, against: Path, out: Path) -> dict:
    """Compare a run with a design, or with another run; write inspection.json, .html and .glb, and return the values.

    Args:
        against: a mesh of the design, or another run's folder.
        out: the folder for the three files; it is made if need be.

    Raises:
        SessionError, ReconstructionError: the run cannot be used.
        CadError: the design cannot.
    """
    model = read_model(run)
    if against.is_dir():
        second = read_model(against)
        design, name = cad_of_run(second), f"run {second.name}"
    else:
        design, name = read_cad(against), against.name
    found, values = inspected(model, design, name)
    with written_to(out):
        out.mkdir(parents=True, exist_ok=True)
        write_whole(out / "inspection.glb", coloured_glb(found, design, model))
        write_whole(out / "inspection.html", inspection_page(found, values).encode())
        write_whole(out / "inspection.json", (json.dumps(values, indent=1) + "\n").encode())
    return values


def coloured_glb(found: Inspection, cad: CadMesh, model: Model) -> bytes:
    """Return the design in the body's axes, coloured by what was found of it, and what was added, as GLB."""
    import trimesh
    import trimesh.remesh

    pixel_m = model.surface.pixel_m
    placed = cad.moved(found.place.matrix())
    size = float(np.ptp(placed.vertices, axis=0).max())
    divided: Any = trimesh.remesh.subdivide_to_size(
        placed.vertices, placed.triangles, max(2 * pixel_m, size / 150), return_index=True
    )
    vertices, triangles, index = divided
    parts = placed.part[index]
    scene = trimesh.Scene()
    for number, name in enumerate(cad.names):
        own = triangles[parts == number]
        if not len(own):
            continue
        corners, local = np.unique(own, return_inverse=True)
        places = vertices[corners]
        state = _nearest_state(places, found, number)
        colours = np.array([COLOURS[STATES[k]] for k in state], dtype=np.uint8)
        mesh = trimesh.Trimesh(places, local.reshape(-1, 3), vertex_colors=colours, process=False)
        scene.add_geometry(mesh, geom_name=name, node_name=name, transform=Z_UP_TO_Y_UP)
    centres = model.mesh.corners().mean(axis=1)
    added = found.surface.points[found.added]
    if len(added):
        near = KDTree(added).query(centres)[0] < pixel_m
        colours = np.broadcast_to(np.array(COLOURS["added"], dtype=np.uint8), (len(model.mesh.vertices), 3))
        mesh = trimesh.Trimesh(
            model.mesh.vertices, model.mesh.triangles[near], vertex_colors=colours, process=True
        )
        scene.add_geometry(mesh, geom_name="added", node_name="added", transform=Z_UP_TO_Y_UP)
    content = scene.export(file_type="glb")
    assert isinstance(content, bytes)
    return content


def _nearest_state(places: np.ndarray, found: Inspection, part: int) -> np.ndarray:
    """Return the states [N] of places of a part as designed, by the nearest of its samples where they were designed."""
    design = found.designed
    own = np.flatnonzero(design.part == part)
    if not len(own):  # a part too small for a sample
        return np.full(len(places), STATES.index("not seen"))
    return found.state[own[KDTree(design.points[own]).query(places)[1]]]


def inspection_page(found: Inspection, values: dict) -> str:
    """Return the page that says what was found, with two pictures."""
    count = len(found.regions) + len(found.turned)
    unit = html.escape(values["unit"])
    low, high = values["scale_interval_90"]
    verdict = "as designed" if values["as_designed"] else f"{count} finding{'s' if count != 1 else ''}"
    figures = [
        (verdict, f"against {html.escape(values['against'])}, where the frames show the body"),
        (
            f"{100 * found.seen:.0f} %",
            "of the design's area is shown by the frames; nothing is said of the rest",
        ),
        (f"{values['scale']:.5g}", f"{unit} for one unit of the design (90 %: {low:.5g} to {high:.5g})"),
        (
            f"{values['surface_sigma']:.2g} {unit}",
            f"standard deviation of the model's surface from the design; a pixel is {values['pixel']:.2g} wide",
        ),
    ]
    note = "The design was laid on the model's surface, whatever its position, size and axes were."
    if turns := len(values["symmetric_rotations"]):
        note += (
            f" It fits almost as well in {turns} other position{'s' if turns > 1 else ''}: parts that such a turn "
            "exchanges may be named for each other."
        )
    colours = [(name, "rgb" + str(colour)) for name, colour in COLOURS.items()]
    views = "".join(
        picture(_picture(found, azimuth), f"the body from {azimuth} degrees", f"from azimuth {azimuth}°")
        for azimuth in (35, 125, 215, 305)
    )
    return page(
        f"Inspection of {values['run']}",
        f"Compared with {values['against']}.",
        [
            section("Result", note, cards(figures)),
            section(
                "Where",
                "Panels are drawn where they were found.",
                legend(colours) + f'<div class="grid beside">{views}</div>',
            ),
            section(
                "Parts",
                "Intervals hold the true value with a probability of 90 %.",
                _regions_table(values, unit),
            ),
            section(
                "Panels",
                "By how much the normal of each flat panel is turned against the rest of the body. A panel is told as "
                "turned where chance and the errors of the surface do not explain it.",
                _panels_table(values),
            ),
        ],
        plots=False,
    )


def _regions_table(values: dict, unit: str) -> str:
    rows = [
        [
            region["kind"],
            ("all of " if region["whole_part"] else "at " if region["kind"] == "added" else "of ")
            + region["part"],
            _interval(region["size"], region["size_interval_90"], unit),
            _interval(region["stands_off"], region["stands_off_interval_90"], unit),
            ", ".join(f"{x:.3g}" for x in region["middle"]),
        ]
        for region in values["regions"]
    ]
    return _rows(["", "part", "largest dimension", "stands off by", "middle, body axes"], rows)


def _panels_table(values: dict) -> str:
    rows = [
        [
            "turned" if panel["turned"] else "as designed",
            panel["part"],
            _interval(panel["angle_deg"], panel["angle_deg_interval_90"], "°"),
            " x ".join(f"{x:.3g}" for x in panel["extent"][:2]),
        ]
        for panel in values["panels"]
    ]
    return _rows(["", "part", "angle", "size"], rows)


def _interval(value: float, interval: list[float], unit: str) -> str:
    return f"{value:.3g} {unit} (90 %: {interval[0]:.3g} to {interval[1]:.3g})"


def _rows(heads: list[str], rows: list[list[str]]) -> str:
    if not rows:
        return "<p>none</p>"
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _picture(found: Inspection, azimuth_deg: float) -> np.ndarray:
    """Return the body [P, P, 3] bytes from the side, coloured by what was found; farther points are painted first."""
    azimuth = np.radians(azimuth_deg)
    away = np.array(
        [
            np.cos(azimuth) * np.cos(ELEVATION_RAD),
            np.sin(azimuth) * np.cos(ELEVATION_RAD),
            np.sin(ELEVATION_RAD),
        ]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    frame = np.stack([right, np.cross(away, right), away])
    added = found.surface.select(np.flatnonzero(found.added))
    points = np.concatenate([found.design.points, added.points])
    normals = np.concatenate([found.design.normals, added.normals])
    colours = np.array([COLOURS[state] for state in STATES], dtype=float)[found.state]
    colours = np.concatenate([colours, np.broadcast_to(COLOURS["added"], (len(added.points), 3))])
    at = points @ frame.T
    middle = (at.min(axis=0) + at.max(axis=0)) / 2
    per_m = 0.94 * PICTURE_PX / max(1e-9, float(np.ptp(at[:, :2], axis=0).max()))
    place = ((at[:, :2] - middle[:2]) * [per_m, -per_m] + PICTURE_PX / 2).astype(int)
    shade = 0.55 + 0.45 * np.abs(normals @ frame[2])
    image = np.full((PICTURE_PX, PICTURE_PX, 3), 250, dtype=np.uint8)
    reach = max(1, int(np.ceil(0.5 * found.surface.pixel_m * per_m)))
    order = np.argsort(at[:, 2])
    painted = (colours * shade[:, None]).clip(0, 255).astype(np.uint8)[order]
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            xy = (place[order] + [dx, dy]).clip(0, PICTURE_PX - 1)
            image[xy[:, 1], xy[:, 0]] = painted
    return image
