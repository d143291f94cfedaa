"""The report's section on poses: what training found of their errors, how surely, and which frames still disagree."""

import html
import math
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go
import torch
from plotly.subplots import make_subplots

from ground.run.card import is_imported, one_frame
from ground.run.estimated_poses import doubts_left, read_estimate
from ground.run.runs import Run
from ground.session.spread import evenly_spread
from ground.show.page import legend, plot, section, two_tables, unbroken
from ground.show.plots import ticks_1_2_5
from ground.show.sizes import states_scale, states_time, with_deviation
from obbgs_base.errors import counted
from obbgs_base.physics.navigation_errors import LENGTHS
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.losses import fit_figures
from obbgs_core.model.motions import motion_vectors
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.render import render

MARGINS_PX = {"l": 60, "r": 20, "t": 20, "b": 45}
AXES = {"x": "#1f6feb", "y": "#2a9d8f", "z": "#d1652a"}
ELLIPSES = {"as the tags state": "rgba(91,107,123,0.4)", "left in doubt": "#1f6feb"}
PATH = "#b9c4d0"  # of the corrections from bracket to bracket
RESIDUALS = {"from the tagged pose": "#d1652a", "from the estimated pose": "#1f6feb"}
ORBIT, BODY = ("radial", "transverse", "normal"), ("x", "y", "z")
SHOWN = {  # the parameters that a pass shares: words, unit, axes
    "position_m": ("relative position,", "m", ORBIT),
    "velocity_m_s": ("relative velocity,", "m/s", ORBIT),
    "attitude_rad": ("attitude of the target at the start, body", "deg", BODY),
    "rate_rad_s": ("rate of the target, body", "deg/s", BODY),
    "inertia_ratios": ("relative moment of inertia, body", "", BODY),
    "boresight_rad": ("boresight, camera", "deg", BODY),
    "clock_s": ("clock", "s", ()),
    "focal": ("relative focal length", "", ()),
}
ELLIPSES_SHOWN = 60
MOST_TICKS = 9  # of a logarithmic axis of residuals; above, at powers of ten only
AS_GOOD_AS_KNOWN = 1e-3  # of the largest deviation that is stated along another axis
MISFIT_DEVIATIONS = 6.0  # of the median absolute deviation, scaled to that of a normal distribution


@dataclass(frozen=True)
class PoseHistory:
    """The poses' corrections along the pass, a row for each bracket, or frame that errs alone, in the order of time.

    A correction is the small motion in front of the tagged pose that gives the estimated one: a rotation vector (rad),
    then a shift (m), along the camera's axes.
    """

    frame_ids: list[int]  # of the frame that stands for each bracket, its longest exposure
    along: np.ndarray  # [P] minutes since the first, or the numbers of pictures of which no time is stated
    along_name: str  # what these are
    unit: str  # of shifts
    called: str  # what a frame is called
    correction: np.ndarray  # [P, 6]
    prior: np.ndarray  # [P, 6, 6] covariance that the tags state, shared errors included
    posterior: np.ndarray  # [P, 6, 6] that is left
    chi2_tagged: np.ndarray  # [P] residual of the finished model from the tagged pose
    chi2_estimated: np.ndarray  # [P] and from the estimated one

    @property
    def misfits(self) -> list[int]:
        """The frames whose residual is far above that of most others, which speaks for an error of their poses."""
        middle = float(np.nanmedian(self.chi2_estimated))
        spread = 1.4826 * float(np.nanmedian(np.abs(self.chi2_estimated - middle)))
        high = self.chi2_estimated > max(middle + MISFIT_DEVIATIONS * spread, 2 * middle)
        return [number for number, is_high in zip(self.frame_ids, high, strict=True) if is_high]


def pose_history(run: Run, estimate: PoseEstimate) -> PoseHistory:
    """Return the corrections of a run's training frames.

    Raises:
        SessionError: a picture cannot be read.
    """
    records = {record.id: record for record in run.session.frames}
    longest: dict[int, int] = {}  # the place of the frame that stands for each bracket
    for place, (number, row) in enumerate(zip(estimate.frame_ids, estimate.brackets, strict=True)):
        best = longest.setdefault(row, place)
        if records[number].exposure_time_s > records[estimate.frame_ids[best]].exposure_time_s:
            longest[row] = place
    rows = sorted(longest, key=lambda row: records[estimate.frame_ids[longest[row]]].mid_exposure_utc_ns)
    places = [longest[row] for row in rows]
    ids = [estimate.frame_ids[place] for place in places]
    tagged, estimated = (torch.from_numpy(poses[places]) for poses in (estimate.tagged, estimate.estimated))
    frames = [
        run.on_black_sky(records[number], pose.float()) for number, pose in zip(ids, estimated, strict=True)
    ]
    times_ns = np.array([records[number].mid_exposure_utc_ns for number in ids])
    timed = all(states_time(run.session, records[number]) for number in ids)
    return PoseHistory(
        ids,
        (times_ns - times_ns[0]) / 60e9 if timed else np.array(ids),
        "minutes" if timed else "picture",
        "m" if states_scale(run.session) else "units",
        one_frame(is_imported(run.metrics)),
        motion_vectors(estimated @ torch.linalg.inv(tagged)).numpy(),
        PoseCorrections(frames).covariances.numpy(),
        doubts_left(run.session, [records[number] for number in ids], estimate),
        *_residuals(run, frames, tagged, estimated),
    )


@torch.no_grad()
def _residuals(
    run: Run, frames: list[TrainingFrame], tagged: torch.Tensor, estimated: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Return chi² on the target of the finished model from the tagged and from the estimated poses, [P] each.

    Both count the pixels that show the model from either pose, so that a tag which places the target beside the picture
    has the residual of a picture without it; NaN where it is in the picture from neither.
    """
    found: tuple[list[float], list[float]] = ([], [])
    for frame, *poses in zip(frames, tagged, estimated, strict=True):
        both = [
            render(run.gaussians, cameras_of([replace(frame, world_to_camera=pose.float())]))
            for pose in poses
        ]
        seen = torch.maximum(both[0].alpha, both[1].alpha)
        exposure_s = torch.tensor([run.metrics.get("reference_exposure_s") or frame.exposure_time_s])
        for values, rendered in zip(found, both, strict=True):
            values.append(fit_figures(rendered.radiance, seen, exposure_s, frame.dn[None], run.sensor)[0])
    return np.array(found[0]), np.array(found[1])


def poses_section(run: Run) -> str:
    """Return the section; nothing for a run whose poses are as tagged."""
    estimate = read_estimate(run.folder)
    if estimate is None:
        return ""
    history = pose_history(run, estimate)
    misfits = history.misfits
    alone = len(history.frame_ids) == len(estimate.frame_ids)  # each frame has a correction of its own
    called = history.called
    each = called if alone else "bracket"
    tags, state = (
        ("stated cameras", "come with them") if called == "picture" else ("pose tags", "the tags state")
    )
    note = (
        f"What the training found the {tags} to err by. Corrections are along the camera's axes (z along the line of "
        f"sight), dotted lines are the standard deviations that {state}. Ellipses lie across the line of sight: "
        "pale what these allow, dark what is left in doubt, one standard deviation each. The residual chi² is 1 where "
        "only noise is left; it compares the finished model with "
        f"{f'each {called}' if alone else 'the longest exposure of each bracket'}."
    )
    told = (
        f"No {each}'s residual chi² stands out from the others."
        if not misfits
        else (
            f"The residual chi² of {len(misfits)} of {counted(len(history.frame_ids), each)} stands out ({called}"
            f"{'s' * (len(misfits) > 1)} {', '.join(map(str, misfits))}): the poses may err by more than the {tags} "
            f"say, or something passed before the camera.{_of_earth(run, misfits, called)}"
        )
    )
    if left_out := run.metrics.get("misfit_frames"):
        names = html.escape(", ".join(map(str, left_out)))
        told += f" The {called}s {names} were left out of the training: they fitted no pose that their tags allow."
    body = two_tables(shared_rows(estimate)) if estimate.shared_prior.vector().any() else ""
    body += legend([(f"along {axis}", colour) for axis, colour in AXES.items()]) + plot(
        correction_figure(history)
    )
    body += legend(
        [*ELLIPSES.items(), (f"corrections, {each} after {each} in the order of time", PATH)]
    ) + plot(ellipse_figure(history))
    body += legend(RESIDUALS.items()) + plot(residual_figure(history))
    return section("Poses as estimated", note, f"{body}<p>{told}</p>")


def _of_earth(run: Run, misfits: list[int], called: str) -> str:
    """Return in words how many of the frames that stand out have the Earth in view; nothing where none has."""
    records = [record for record in run.session.frames if record.id in misfits]
    count = sum(run.without_sky_level(record).earth_m is not None for record in records)
    if not count:
        return ""
    which = "All" if count == len(misfits) else f"{count}"
    return f" {which} of these {called}s have the Earth in view, whose light is known less surely than a black sky."


def shared_rows(estimate: PoseEstimate) -> list[tuple[str, str]]:
    """Return a row for each parameter that the whole pass shares: its value with its deviation, and the prior's.

    Along an axis on which it is stated a thousand times as surely as on another, it is as good as known and left out.
    """
    rows, doubted = [], set(estimate.unobservable())
    for name in LENGTHS:
        words, unit, axes = SHOWN[name]
        factor = math.degrees(1) if unit.startswith("deg") else 1.0
        values, priors, left = (
            factor * getattr(part, name)
            for part in (estimate.shared, estimate.shared_prior, estimate.shared_posterior)
        )
        for i in np.flatnonzero(priors > AS_GOOD_AS_KNOWN * priors.max()):
            axis = f" {axes[i]}" if axes else ""
            doubt = ": not determined by the frames" if {name, f"{name}[{i}]"} & doubted else ""
            value = unbroken(with_deviation(values[i], left[i])) + " "
            value += unbroken(f"(stated ± {priors[i]:.2g}) {unit}")
            rows.append((f"{words}{axis}{doubt}", value))
    return rows


def correction_figure(history: PoseHistory) -> go.Figure:
    """Return the corrections along the pass, rotation above shift, with the deviations that the tags state."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    deviations = np.sqrt(np.maximum(np.diagonal(history.prior, axis1=1, axis2=2), 0))
    for row, (first, factor, unit) in enumerate(
        ((0, math.degrees(1), "deg"), (3, 1.0, history.unit)), start=1
    ):
        for i, (axis, colour) in enumerate(AXES.items()):
            line = {"x": history.along, "legendgroup": axis, "row": row, "col": 1}
            figure.add_scatter(
                **line,
                y=factor * history.correction[:, first + i],
                name=axis,
                line={"color": colour},
                mode="lines+markers",
                marker={"size": 4},
                customdata=history.frame_ids,
                hovertemplate=f"{history.called} %{{customdata}}: %{{y:.4g}} {unit}<extra></extra>",
            )
            for sign in (-1, 1):
                figure.add_scatter(
                    **line,
                    y=sign * factor * deviations[:, first + i],
                    mode="lines",
                    hoverinfo="skip",
                    line={"color": colour, "dash": "dot", "width": 1},
                )
        figure.update_yaxes(title_text=f"{'rotation' if row == 1 else 'shift'}, {unit}", row=row, col=1)
    figure.update_xaxes(title_text=history.along_name, row=2, col=1)
    figure.update_layout(height=460, margin=MARGINS_PX, showlegend=False)
    return figure


def ellipse_figure(history: PoseHistory) -> go.Figure:
    """Return the shifts across the line of sight, in the order of time, with their ellipses before and after."""
    figure = go.Figure()
    shifts = history.correction[:, 3:5]
    shown = evenly_spread(range(len(shifts)), ELLIPSES_SHOWN)
    for covariances, centres, name in (
        (history.prior, np.zeros_like(shifts), "as the tags state"),
        (history.posterior, shifts, "left in doubt"),
    ):
        outline = [_ellipse(covariances[i, 3:5, 3:5]) + centres[i] for i in shown]
        gap = np.full((1, 2), np.nan)
        points = np.concatenate([part for one in outline for part in (one, gap)])
        figure.add_scatter(
            x=points[:, 0],
            y=points[:, 1],
            mode="lines",
            name=name,
            line={"color": ELLIPSES[name]},
            hoverinfo="skip",
        )
    figure.add_scatter(
        x=shifts[:, 0],
        y=shifts[:, 1],
        mode="lines+markers",
        name="correction",
        line={"color": PATH, "width": 1},
        marker={
            "color": history.along,
            "colorscale": "Viridis",
            "colorbar": {"title": {"text": history.along_name}},
        },
        customdata=history.frame_ids,
        hovertemplate=f"{history.called} %{{customdata}}: %{{x:.3g}}, %{{y:.3g}} {history.unit}<extra></extra>",
    )
    figure.update_yaxes(title_text=f"shift along camera y, {history.unit}", scaleanchor="x")
    figure.update_xaxes(title_text=f"shift along camera x, {history.unit}")
    figure.update_layout(height=460, margin=MARGINS_PX, showlegend=False)
    return figure


def _ellipse(covariance: np.ndarray) -> np.ndarray:
    """Return points [33, 2] at one standard deviation of a covariance [2, 2]."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 33)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return circle * np.sqrt(np.maximum(values, 0)) @ vectors.T


def residual_figure(history: PoseHistory) -> go.Figure:
    """Return the residual of each bracket from its tagged and from its estimated pose."""
    figure = go.Figure()
    for values, (name, colour) in zip(
        (history.chi2_tagged, history.chi2_estimated), RESIDUALS.items(), strict=True
    ):
        figure.add_scatter(
            x=history.along,
            y=values,
            name=name,
            mode="lines+markers",
            line={"color": colour},
            customdata=history.frame_ids,
            hovertemplate=f"{history.called} %{{customdata}}: %{{y:.3g}}<extra></extra>",
        )
    both = np.concatenate([history.chi2_tagged, history.chi2_estimated])
    ticks = ticks_1_2_5(both[np.isfinite(both)])
    if len(ticks) > MOST_TICKS:
        ticks = [tick for tick in ticks if math.log10(tick) % 1 == 0]
    figure.update_yaxes(
        title_text="residual chi²", type="log", tickvals=ticks, ticktext=[f"{tick:,g}" for tick in ticks]
    )
    figure.update_xaxes(title_text=history.along_name)
    figure.update_layout(height=320, margin=MARGINS_PX, showlegend=False)
    return figure
