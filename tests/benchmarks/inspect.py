"""How surely faults of a body are found: python -m tests.benchmarks.inspect --runs DIR --cads DIR TDRS DSCOVR ACE

The runs are kept and the designs get the faults, so that a fault costs no training: a panel that is turned in the
design is turned the other way in the body, a part that is put onto the design is missing of the body, and one that is
cut off the design was added to the body. Each design is also moved, turned and scaled at random. DIR of the runs holds
NAME-100/runs/run, made by `ground reconstruct` of the sessions of tests.benchmarks.targets (--size 100 --sun); DIR of
the designs holds NAME.glb. Findings are appended to --out, one row a fault; those that are there are not made again.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ground.show.inspection import Model, read_model
from obbgs_core.inspect.alignment import Similarity, aligned
from obbgs_core.inspect.cad import CadMesh, Samples, groups_within, read_cad, sampled
from obbgs_core.inspect.findings import FEWEST_VIEWS, Inspection, inspect
from obbgs_core.inspect.plates import is_turned, plates_of
from obbgs_core.inspect.shown import views_showing
from tests.benchmarks.rows import shown

KINDS = ("panel", "missing", "added", "none")
DEGREES, SIZES_PX = (2.0, 20.0), (3.0, 20.0)
SHOWN = 0.6  # of a faulty part, at least: what no frame shows cannot be found
BOX_SHOWN = (
    0.3  # of a box, at least: one face lies on the body, and one Sun lights three of the others at most
)
TRIES = 200  # of places for a fault


class Target:
    """A run, its design in the body's axes, and which of the design's samples the frames show."""

    def __init__(self, run: Path, cad: Path):
        self.model: Model = read_model(run)
        self.cad = read_cad(cad)
        self.place: Similarity = aligned(self.cad, self.model.surface)
        self.body: CadMesh = self.cad.moved(self.place.matrix())
        self.pixel_m = self.model.surface.pixel_m
        self.design: Samples = sampled(self.body, 0.7 * self.pixel_m)
        self.shown = views_showing(self.design, self.model.views, self.pixel_m) >= FEWEST_VIEWS
        # a fault is put where the model is as designed: what the frames show and the model has
        there = KDTree(self.model.surface.points).query(self.design.points)[0] < 2 * self.pixel_m
        self.usable = self.shown & there
        self.plates = [
            plate
            for plate in plates_of(self.design, self.pixel_m)
            if self.usable[plate.members].mean() > SHOWN
        ]


def faulted(target: Target, kind: str, rng: np.random.Generator) -> tuple[CadMesh, dict]:
    """Return the design (body axes, m) with a fault, and its truth: where, and how large."""
    if kind == "none":
        return target.body, {}
    return {"panel": _turned, "missing": _put_on, "added": _cut_off}[kind](target, rng)


def _turned(target: Target, rng: np.random.Generator) -> tuple[CadMesh, dict]:
    """Turn a panel and what is fixed to it about an axis in it, through its middle or an edge."""
    if not target.plates:
        raise NoPlace
    plate = target.plates[rng.integers(len(target.plates))]
    angle = rng.uniform(*DEGREES)
    axis = int(rng.integers(2))
    pivot = plate.middle + rng.integers(-1, 2) * plate.axes[1 - axis] * plate.extent[1 - axis] / 2
    turn = Rotation.from_rotvec(np.radians(angle) * rng.choice([-1, 1]) * plate.axes[axis]).as_matrix()
    corners = target.body.corners()
    inside = (np.abs((corners - plate.middle) @ plate.axes.T) <= plate.extent / 2 + 2 * target.pixel_m).all(
        axis=(1, 2)
    )
    inside &= np.isin(target.body.part, np.unique(target.design.part[plate.members]))
    moved = pivot + (corners - pivot) @ turn.T
    vertices = np.where(inside[:, None, None], moved, corners).reshape(-1, 3)
    cad = CadMesh(vertices, np.arange(len(vertices)).reshape(-1, 3), target.body.part, target.body.names)
    middle = pivot + turn @ (plate.middle - pivot)
    width_px = plate.extent[1 - axis] / target.pixel_m  # across the axis: what the turn is seen by
    return cad, {"degrees": angle, "place": middle.tolist(), "across_px": float(width_px)}


def _put_on(target: Target, rng: np.random.Generator) -> tuple[CadMesh, dict]:
    """Put a box onto the outside of the design, on a place that the frames show, where there is room for it."""
    size_px = float(np.exp(rng.uniform(*np.log(SIZES_PX))))
    size = size_px * target.pixel_m
    tree, spacing = KDTree(target.design.points), 0.7 * target.pixel_m
    for _ in range(TRIES):
        i = rng.choice(np.flatnonzero(target.usable))
        towards = target.design.normals[i] * rng.choice([-1, 1])
        middle = target.design.points[i] + towards * size / 2
        beside = tree.query_ball_point(middle + towards * 0.25 * size, 0.6 * size)
        if len(beside) > 0.02 * (size / spacing) ** 2:
            continue
        frame = np.linalg.svd(towards[None])[2]
        box = trimesh.creation.box([size] * 3)
        vertices = middle + box.vertices @ np.concatenate([frame[1:], frame[:1]])
        new = len(target.body.names)
        alone = CadMesh(vertices, box.faces, np.full(len(box.faces), new), ("",) * new + ("put on",))
        both = joined(target.design, sampled(alone, spacing))
        by = views_showing(both, target.model.views, target.pixel_m) >= FEWEST_VIEWS
        if by[both.part == new].mean() > BOX_SHOWN:
            cad = CadMesh(
                np.concatenate([target.body.vertices, vertices]),
                np.concatenate([target.body.triangles, box.faces + len(target.body.vertices)]),
                np.concatenate([target.body.part, alone.part]),
                (*target.body.names, "put on"),
            )
            return cad, {"fault_px": size_px, "place": middle.tolist(), "depth_px": size_px}
    raise NoPlace


def joined(first: Samples, second: Samples) -> Samples:
    return Samples(
        *(np.concatenate([getattr(s, name) for s in (first, second)]) for name in ("points", "normals")),
        *(np.concatenate([getattr(s, name) for s in (first, second)]) for name in ("part", "area")),
    )


def _cut_off(target: Target, rng: np.random.Generator) -> tuple[CadMesh, dict]:
    """Cut the end off a piece of the design, or a whole piece, that stands off from the rest by its size or so."""
    reach = 1.5 * target.pixel_m
    for _ in range(10 * TRIES):
        size_px = float(np.exp(rng.uniform(*np.log(SIZES_PX))))
        size = size_px * target.pixel_m
        part = rng.choice(np.unique(target.design.part[target.usable]))
        own = np.flatnonzero(target.design.part == part)
        groups = groups_within(target.design.points[own], reach)
        piece = own[groups == rng.choice(groups)]
        points = target.design.points[piece]
        axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0] * rng.choice([-1, 1])
        end = points @ axis > (points @ axis).max() - size
        cut = points[end]
        if len(cut) < 15 or target.usable[piece[end]].mean() < SHOWN:
            continue
        rest = np.delete(np.arange(len(target.design.points)), piece[end])
        stands_off = KDTree(target.design.points[rest]).query(cut)[0]
        if np.quantile(stands_off, 0.95) < 0.6 * size or np.ptp(cut, axis=0).max() > 1.5 * size:
            continue
        low, high = cut.min(axis=0) - 0.1 * target.pixel_m, cut.max(axis=0) + 0.1 * target.pixel_m
        cad = _without(target.body, part, low, high, axis, float((points @ axis).max() - size))
        depth_px = float(np.quantile(stands_off, 0.95)) / target.pixel_m
        return cad, {"fault_px": size_px, "place": cut.mean(axis=0).tolist(), "depth_px": depth_px}
    raise NoPlace


def _without(
    mesh: CadMesh, part: int, low: np.ndarray, high: np.ndarray, axis: np.ndarray, level: float
) -> CadMesh:
    """Return a mesh without what of a part lies in a box and beyond a plane."""
    corners = mesh.corners()
    near = (
        (mesh.part == part)
        & (corners.max(axis=1) >= low).all(axis=1)
        & (corners.min(axis=1) <= high).all(axis=1)
    )
    vertices, triangles = trimesh.intersections.slice_faces_plane(
        corners[near].reshape(-1, 3), np.arange(3 * near.sum()).reshape(-1, 3), -axis, level * axis
    )[:2]
    kept = corners[~near].reshape(-1, 3)
    return CadMesh(
        np.concatenate([kept, vertices]),
        np.concatenate([np.arange(len(kept)).reshape(-1, 3), np.asarray(triangles) + len(kept)]),
        np.concatenate([mesh.part[~near], np.full(len(triangles), part)]),
        mesh.names,
    )


class NoPlace(Exception):
    """A target has no place for a fault of a kind that the frames show well enough."""


def _possible(target: Target, number: int, rng: np.random.Generator) -> tuple[str, CadMesh, dict]:
    """Return the next kind of fault that a target can have, and the design with it as `faulted` has it.

    No frame shows a panel of DSCOVR's, and nothing of it that the frames show stands off far enough to be cut off.
    """
    for turn in range(len(KINDS)):
        kind = KINDS[(number + turn) % len(KINDS)]
        try:
            return kind, *faulted(target, kind, rng)
        except NoPlace:
            continue
    raise AssertionError("an unfaulted design is always possible")


def row_of(target: Target, name: str, number: int) -> dict:
    """Return what was found of one fault: whether it was, its stated interval, and what else was told."""
    rng = np.random.default_rng([number, sum(map(ord, name))])
    kind, cad, truth = _possible(target, number, rng)
    anywhere = np.eye(4)
    anywhere[:3, :3] = 10 ** rng.uniform(-2, 3) * Rotation.random(rng=rng).as_matrix()
    anywhere[:3, 3] = rng.normal(size=3) * np.cbrt(np.abs(np.linalg.det(anywhere[:3, :3])))
    began = time.process_time()
    model = target.model
    found = inspect(cad.moved(anywhere), model.surface, model.solid, model.views, seed=number)
    seconds = time.process_time() - began
    # a fault of the design is where the design was found to lie, which of a symmetric one may be turned
    there = found.place.matrix() @ anywhere if kind in ("panel", "missing") else np.eye(4)
    place = there[:3, :3] @ truth["place"] + there[:3, 3] if truth else np.full(3, np.inf)
    # what is told of a symmetric body holds as well for the places that it can be turned to, which is told with it
    turned = (found.place.other_rotations @ (place - found.place.pivot) + found.place.pivot) if truth else []
    scored = [_told(found, truth, kind, target.pixel_m, p) for p in (place, *turned)]
    told, others = max(scored, key=lambda one: one[0]["found"])
    # the size that a point of the design gets: the true one is that of the design that is not moved
    scale = found.place.scale * np.cbrt(np.linalg.det(anywhere[:3, :3]))
    return {
        "target": name,
        "number": number,
        "kind": kind,
        **truth,
        **told,
        "others": others,
        "parts": len(found.parts),
        "panels": len(found.turns),
        "scale_ratio": scale,
        "scale_sigma": float(found.place.covariance[6, 6] ** 0.5),
        "cpu_seconds": round(seconds, 1),
    }


def _told(found: Inspection, truth: dict, kind: str, pixel_m: float, place: np.ndarray) -> tuple[dict, list]:
    """Return what was told of the fault at a place [3] m of the body, and the findings that are none of it."""
    panels = [(turn, np.degrees(turn.tilt_rad), np.degrees(turn.interval).tolist()) for turn in found.turns]
    told: dict = {}
    others: list = []
    reach = {
        "panel": 3 * pixel_m,
        "missing": (0.9 * truth.get("fault_px", 0) + 2) * pixel_m,
        "added": (0.9 * truth.get("fault_px", 0) + 2) * pixel_m,
        "none": -1.0,
    }[kind]
    for turn, degrees, interval in panels:
        here = float(np.linalg.norm(turn.plate.middle - place)) < reach
        if kind == "panel" and here and "told_degrees" not in told:
            told |= {"found": is_turned(turn), "told_degrees": degrees, "interval": interval}
        elif is_turned(turn):
            others.append(["turned", round(degrees, 1), round(turn.significance, 1)])
    for region in found.regions:
        here = float(np.linalg.norm(region.middle - place)) < reach
        if here and kind == region.kind and "told_depth_px" not in told:
            interval = [value / pixel_m for value in region.depth_interval]
            told |= {"found": True, "told_depth_px": region.depth_m / pixel_m, "interval": interval}
        elif not (kind == "panel" and _near_panel(found, region.middle, place, pixel_m)) and not here:
            sizes = (region.area_m2 / pixel_m**2, region.size_m / pixel_m, region.depth_m / pixel_m)
            others.append([region.kind, *(round(float(x), 1) for x in sizes)])
    return {"found": False} | told, others


def _near_panel(found: Inspection, middle: np.ndarray, place: np.ndarray, pixel_m: float) -> bool:
    """Return whether a finding lies at the panel that is at fault: as missing and added it is found too."""
    plates = [turn.plate for turn in found.turns if np.linalg.norm(turn.plate.middle - place) < 3 * pixel_m]
    return any(np.linalg.norm(middle - plate.middle) < np.linalg.norm(plate.extent) / 2 for plate in plates)


def summary(rows: list[dict]) -> dict:
    """Return the shares that the bars are about."""

    def share(chosen: list[bool]) -> str:
        return f"{sum(chosen)} of {len(chosen)}"

    panels = [row for row in rows if row["kind"] == "panel"]
    parts = [row for row in rows if row["kind"] in ("missing", "added")]
    inside = [
        row["interval"][0] <= row[truth] <= row["interval"][1]
        for truth, chosen in (("degrees", panels), ("depth_px", parts))
        for row in chosen
        if "interval" in row
    ]
    checked = sum(row["parts"] + row["panels"] for row in rows)
    return {
        "panels of 10 degrees or more found": share([r["found"] for r in panels if r["degrees"] >= 10]),
        "panels of less found": share([r["found"] for r in panels if r["degrees"] < 10]),
        "missing of 5 px or more found": share(
            [r["found"] for r in parts if r["fault_px"] >= 5 and r["kind"] == "missing"]
        ),
        "added of 5 px or more found": share(
            [r["found"] for r in parts if r["fault_px"] >= 5 and r["kind"] == "added"]
        ),
        "smaller parts found": share([r["found"] for r in parts if r["fault_px"] < 5]),
        "intervals that hold": share(inside),
        "false alarms of parts and panels looked at": f"{sum(len(r['others']) for r in rows)} of {checked}",
        "inspections with a false alarm": share([bool(r["others"]) for r in rows]),
        "unfaulted designs with an alarm": share([bool(r["others"]) for r in rows if r["kind"] == "none"]),
        "stated scales that hold 90 %": share(
            [abs(np.log(r["scale_ratio"])) < 1.645 * r["scale_sigma"] for r in rows]
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="+")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--cads", type=Path, required=True)
    parser.add_argument("--faults", type=int, default=200, help="of all targets together")
    parser.add_argument("--out", type=Path, default=Path("inspect.jsonl"))
    arguments = parser.parse_args()
    rows = (
        [json.loads(line) for line in arguments.out.read_text().splitlines()]
        if arguments.out.exists()
        else []
    )
    done = {(row["target"], row["number"]) for row in rows}
    targets: dict[str, Target] = {}
    for count in range(arguments.faults):
        number, which = divmod(count, len(arguments.targets))
        name = arguments.targets[which]
        if (name, number) in done:
            continue
        if name not in targets:
            targets[name] = Target(arguments.runs / f"{name}-100/runs/run", arguments.cads / f"{name}.glb")
        rows.append(json.loads(shown(row_of(targets[name], name, number), "inspect", as_json=True)))
        with arguments.out.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(json.dumps(rows[-1]), flush=True)
    for name in arguments.targets:
        print(name, json.dumps(summary([row for row in rows if row["target"] == name]), indent=1))
    print("all", json.dumps(summary(rows), indent=1))


if __name__ == "__main__":
    main()
