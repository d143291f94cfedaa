"""The report's section on a target whose attitude nobody knew: how it turns, how surely, and its axis on the model."""

import numpy as np
import plotly.graph_objects as go

from ground.run.attitude import FILE, FoundAttitude, refined_motion
from ground.run.estimated_poses import read_estimate
from ground.run.runs import Run
from ground.show.page import legend, plot, section, two_tables
from ground.show.sizes import with_deviation
from obbgs_base.physics.free_rotation import free_rotation
from obbgs_core.attitude.target_motion import TargetMotion
from obbgs_core.model.gaussians import Gaussians

REACH = 1.3  # of the axis, in radii of the model
POINTS_SHOWN = 4000
COLOURS = {
    "model": "#8a97a5",
    "axis of rotation": "#d1652a",
    "two deviations": "#e9a27c",
    (PATH := "path of the axis"): "#1f6feb",
}
LEAST_OPACITY = 0.3
PATH_POINTS = 300


def attitude_section(run: Run) -> str:
    """Return the section; nothing for a run whose tags gave the attitude.

    Raises:
        SessionError: a file of the run is damaged.
    """
    found = FoundAttitude.read(run.folder / FILE)
    if found is None:
        return ""
    estimate = read_estimate(run.folder)
    motion = refined_motion(found, run.session, estimate)
    times_s = np.array([(r.mid_exposure_utc_ns - found.epoch_utc_ns) / 1e9 for r in run.session.frames])
    note = (
        "Nobody knew how the target turns: its rotation was found from the outlines in the frames"
        + (" and refined together with the model." if estimate is not None else ".")
        + " The axis is that of the angular momentum in inertial axes (GCRS), rates are those at the middle of the "
        "pass; deviations are standard deviations. The figure shows the centres of the model's Gaussians in the "
        "target's own axes, the axis of rotation at that time with a cone of two deviations"
        + (", and the path of that axis through the body during the pass." if motion.tumbles else ".")
    )
    body = two_tables(rotation_rows(motion, None if estimate is None else found.motion))
    figure = axis_figure(run.gaussians, motion, times_s)
    named = [item for item in COLOURS.items() if motion.tumbles or item[0] != PATH]
    return section("Rotation as found", note, body + legend(named) + plot(figure))


def rotation_rows(motion: TargetMotion, before: TargetMotion | None) -> list[tuple[str, str]]:
    """Return label and value of a motion; `before` is what the outlines alone gave, None where nothing refined it."""
    facts = motion.facts()
    rows = [
        ("motion", "torque-free tumble" if motion.tumbles else "steady spin"),
        ("axis, inertial", _axis(facts)),
        ("rate", _rate(facts)),
        ("one turn", _turn(facts)),
    ]
    for name, value, sigma in zip("xy", facts["inertia_ratios"], facts["inertia_ratios_sigma"], strict=False):
        rows.append((f"moment of inertia about {name} over that about z", with_deviation(value, sigma)))
    if before is not None:
        outlines = before.facts()
        rows += [
            ("axis from outlines alone", _axis(outlines)),
            ("rate from outlines alone", _rate(outlines)),
        ]
    rows.append(("outlines compared", str(facts["outlines_compared"])))
    return rows


def _turn(facts: dict) -> str:
    """Return the time of one turn with its deviation, which is relatively that of the rate."""
    sigma_s = facts["period_s"] * facts["rate_sigma_deg_s"] / facts["rate_deg_s"]
    return f"{with_deviation(facts['period_s'], sigma_s)} s"


def _axis(facts: dict) -> str:
    axis = ", ".join(f"{x:.4f}" for x in facts["axis_inertial"])
    return f"({axis}) ± {facts['axis_sigma_deg']:.2g} deg"


def _rate(facts: dict) -> str:
    return f"{with_deviation(facts['rate_deg_s'], facts['rate_sigma_deg_s'])} deg/s"


def axis_figure(gaussians: Gaussians, motion: TargetMotion, times_s: np.ndarray) -> go.Figure:
    """Return the model with its axis of rotation at time 0 and, of a tumble, that axis' path during the pass."""
    points = gaussians.means[gaussians.opacities > LEAST_OPACITY].double().numpy()
    points = points[:: max(1, len(points) // POINTS_SHOWN)]
    reach_m = REACH * float(np.linalg.norm(points, axis=1).max(initial=0.0)) or 1.0
    rate = motion.rate_body_rad_s
    along = rate / np.linalg.norm(rate)
    figure = go.Figure()
    x, y, z = points.T.round(4)
    dots = {"size": 1.5, "color": COLOURS["model"]}
    figure.add_scatter3d(x=x, y=y, z=z, name="model", mode="markers", hoverinfo="name", marker=dots)
    _lines(figure, np.stack([-along, along]) * reach_m, "axis of rotation", width=6)
    cone = _cone(along, 2 * np.radians(motion.facts()["axis_sigma_deg"])) * reach_m
    _lines(figure, cone, "two deviations", width=2)
    if motion.tumbles:
        at_s = np.linspace(times_s.min(), times_s.max(), PATH_POINTS)
        rates = free_rotation(at_s, rate[None], motion.moments[None])[1][0]
        path = rates / np.linalg.norm(rates, axis=1, keepdims=True)
        _lines(figure, path * reach_m, PATH, width=3)
    scene = {f"{name}axis": {"title": {"text": f"{name}, m"}} for name in "xyz"}
    figure.update_layout(
        height=520,
        margin={"l": 0, "r": 0, "t": 10, "b": 0},
        scene={**scene, "aspectmode": "data"},
        showlegend=False,
    )
    return figure


def _lines(figure: go.Figure, points: np.ndarray, name: str, width: float) -> None:
    x, y, z = points.T.round(4)
    line = {"color": COLOURS[name], "width": width}
    figure.add_scatter3d(x=x, y=y, z=z, name=name, mode="lines", hoverinfo="name", line=line)


def _cone(along: np.ndarray, angle_rad: float) -> np.ndarray:
    """Return lines [M, 3] from the origin to a circle of unit vectors at an angle to a unit vector, and its rim."""
    across = np.linalg.svd(along[None])[2][1:]  # [2, 3]
    turn = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    rim = np.cos(angle_rad) * along + np.sin(angle_rad) * circle
    spokes = np.stack([np.zeros((4, 3)), rim[:24:6]], axis=1).reshape(-1, 3)
    return np.concatenate([spokes, rim[18:], rim[:19]])
