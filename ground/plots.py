"""The report's interactive figures: the model in 3D, training over time, the exposure histogram."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import plotly.graph_objects as go
import torch
from plotly.subplots import make_subplots

from ground.cameras import cameras_of, sun_direction
from ground.session import Session
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.lighting import mean_radiance
from obbgs_core.sensor import Sensor

POINTS_SHOWN = 15_000  # more make the page larger and the view no clearer
LEAST_OPACITY = 0.2  # fainter Gaussians would hide the others like fog
TRACK_RADIUS = 1.6  # of the model's radius: near enough to be seen together
SMOOTHED = 10  # logged steps
BINS = 128
INK, SPACE, SUN = "#1c2733", "#10161e", "#f0b429"
KNOWN_COLOUR, BLIND_COLOUR = "#1f6feb", "#d1652a"
EXPOSURE_COLOURS = ("#1f6feb", "#2a9d8f", "#d1652a", "#8e44ad", "#c0392b")
RADIANCE_SCALE = [[0.0, "#33465c"], [0.5, "#93a8bd"], [1.0, "#fff4d9"]]


def model_figure(gaussians: Gaussians, session: Session) -> tuple[go.Figure, int]:
    """Return the model in 3D (centres coloured by mean radiance, camera track, Sun), and how many centres it shows."""
    frames = session.frames
    solid = torch.nonzero(gaussians.opacities > LEAST_OPACITY)[:, 0]
    if len(solid) > POINTS_SHOWN:
        solid = solid[torch.randperm(len(solid), generator=torch.Generator().manual_seed(0))[:POINTS_SHOWN]]
    points = gaussians.means[solid].numpy()
    lit = [record for record in frames if sun_direction(record) is not None] or list(frames)
    radiance = mean_radiance(gaussians.select(solid), cameras_of(session, lit)).mean(dim=1).numpy()
    brightness = np.sqrt(radiance)
    reach_m = float(np.quantile(np.linalg.norm(points, axis=1), 0.995)) if len(points) else 1.0
    figure = go.Figure()
    figure.add_scatter3d(
        **_xyz(points),
        mode="markers",
        name="Gaussian centres",
        marker={
            "size": 2,
            "color": brightness,
            "cmin": 0,
            "cmax": float(np.quantile(brightness, 0.99)) if len(points) else 1.0,
            "colorscale": RADIANCE_SCALE,
            "colorbar": {"title": {"text": "√radiance"}, "thickness": 12, "len": 0.6},
        },
        customdata=radiance,
        hovertemplate="%{x:.2f}, %{y:.2f}, %{z:.2f} m<br>radiance %{customdata:.3f}<extra></extra>",
    )
    in_time = sorted(frames, key=lambda record: record.mid_exposure_utc_ns)
    centres = np.array([record.position_body_m for record in in_time])
    ranges_m = np.linalg.norm(centres, axis=1)
    figure.add_scatter3d(
        **_xyz(centres / np.maximum(ranges_m, 1e-9)[:, None] * reach_m * TRACK_RADIUS),
        mode="lines+markers",
        name="camera track",
        marker={"size": 3, "color": BLIND_COLOUR},
        line={"width": 1, "color": BLIND_COLOUR},
        text=[f"frame {r.id}, {d:.0f} m" for r, d in zip(in_time, ranges_m, strict=True)],
        hovertemplate="%{text}<extra></extra>",
    )
    sun = np.mean([record.sun_dir_body for record in in_time], axis=0) * reach_m * TRACK_RADIUS
    figure.add_scatter3d(
        **_xyz(np.array([np.zeros(3), sun])),
        mode="lines",
        name="to the Sun",
        line={"color": SUN, "width": 5},
        hoverinfo="skip",
    )
    axis = {"color": "#8795a5", "gridcolor": "#263140", "zeroline": False, "showbackground": False}
    figure.update_layout(
        scene={
            "aspectmode": "data",
            "bgcolor": SPACE,
            "camera": {"eye": {"x": 0.75, "y": 0.75, "z": 0.5}},
            **{f"{name}axis": {**axis, "title": {"text": f"{name}, m"}} for name in "xyz"},
        },
        height=580,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        legend={"x": 0.01, "y": 0.99, "bgcolor": "rgba(255,255,255,0.85)", "itemsizing": "constant"},
    )
    return figure, len(points)


def training_figure(history: Sequence[dict]) -> go.Figure:
    """Return loss and PSNR over time, as running means, of each training in the lines of metrics.jsonl."""
    figure = make_subplots(
        rows=1, cols=2, subplot_titles=("loss", "PSNR of each step's frames, dB"), horizontal_spacing=0.08
    )
    losses: list[float] = []
    for label, colour in (("known exposure", KNOWN_COLOUR), ("blind to exposure", BLIND_COLOUR)):
        rows = [line for line in history if line["training"] == label]
        if not rows:
            continue
        seconds = [line["seconds"] for line in rows]
        for column, key in ((1, "loss"), (2, "psnr_db")):
            values = running_mean([line[key] for line in rows])
            if key == "loss":
                losses += values
            figure.add_scatter(
                x=seconds,
                y=values,
                name=label,
                mode="lines" if len(rows) > 1 else "markers",
                line={"color": colour, "width": 2},
                showlegend=column == 1,
                row=1,
                col=column,
            )
    ticks = _ticks_1_2_5(losses)
    figure.update_yaxes(type="log", tickvals=ticks, ticktext=[f"{t:g}" for t in ticks], row=1, col=1)
    figure.update_xaxes(title_text="training time, s", rangemode="tozero")
    figure.update_layout(
        height=370,
        margin={"l": 50, "r": 20, "t": 40, "b": 45},
        legend={"orientation": "h", "y": -0.22, "x": 0.5, "xanchor": "center"},
    )
    return figure


def histogram_figure(session: Session, sensor: Sensor) -> go.Figure:
    """Return the histogram of the readings in all frames, one line for each exposure time."""
    figure = go.Figure()
    edges = np.linspace(0, sensor.white_dn + 1, BINS + 1)
    for index, exposure_s in enumerate(sorted({r.exposure_time_s for r in session.frames})):
        counts = np.zeros(BINS)
        for record in session.frames:
            if record.exposure_time_s == exposure_s:
                counts += np.histogram(session.dn(record), edges)[0]
        figure.add_scatter(
            x=(edges[:-1] + edges[1:]) / 2,
            y=np.where(counts > 0, counts, np.nan),
            name=f"{exposure_s * 1e3:g} ms",
            mode="lines",
            line={"shape": "hvh", "width": 2, "color": EXPOSURE_COLOURS[index % len(EXPOSURE_COLOURS)]},
            hovertemplate="%{y:,} pixels near %{x:.0f} DN",
        )
    for level, label, side in (
        (sensor.black_dn, "black level", "right"),
        (sensor.white_dn, "full scale", "left"),
    ):
        figure.add_vline(
            x=level,
            line={"dash": "dot", "color": "#5b6b7b"},
            annotation_text=f"{label}, {level:g}",
            annotation_position=f"top {side}",
        )
    figure.update_yaxes(type="log", title_text="pixels", dtick=1)
    figure.update_xaxes(title_text="digital number (DN)", range=[0, 1.02 * sensor.white_dn])
    figure.update_layout(height=350, margin={"l": 60, "r": 20, "t": 30, "b": 45})
    return figure


def running_mean(values: Sequence[float], window: int = SMOOTHED) -> list[float]:
    """Return for each value the mean of it and those before it, at most `window` of them."""
    total = np.cumsum([0.0, *values])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    return ((total[ends] - total[starts]) / (ends - starts)).tolist()


def _xyz(points: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", points.T, strict=True))


def _ticks_1_2_5(values: Iterable[float]) -> list[float]:
    """Return ticks at 1, 2 and 5 times powers of ten that cover the positive values; Plotly's own omit the power."""
    positive = [value for value in values if value > 0]
    if not positive:
        return [1.0]
    first, last = math.floor(math.log10(min(positive))), math.floor(math.log10(max(positive)))
    return [m * 10.0**power for power in range(first, last + 2) for m in (1, 2, 5)]
