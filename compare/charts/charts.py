"""The interactive figures of a comparison's page."""

from collections.abc import Callable
from statistics import fmean
from typing import Any

import plotly.graph_objects as go
from plotly.colors import qualitative

from compare.charts.results import Metric, Results, pareto
from compare.charts.severity import Series
from ground.show.plots import ticks_1_2_5

COLOURS = (*qualitative.D3, *qualitative.Set2)
REFERENCE_COLOUR, FRONT_COLOUR = "#5b6b7b", "#1c2733"
LABELS_APART = 0.06  # of the values drawn: names of lines that are nearer would cover one another
EXACT_DB = 119.0  # the score of a picture that is compared with itself, which would squeeze all others


def colour_of(results: Results) -> Callable[[str], str]:
    """Return the function from a method's label to its colour, the same in every figure."""
    colours = {label: COLOURS[i % len(COLOURS)] for i, label in enumerate(results.trained)}
    return lambda label: colours.get(label, REFERENCE_COLOUR)


def speed_figures(results: Results, target: str) -> list[go.Figure]:
    """Return score and Chamfer distance of one target against the training's time, each where any method has it.

    Curves, final scores and their Pareto front; the score's figure also has the methods without training as lines.
    """
    score = results.score_of(target)
    figures = []
    for key, title, sign in (
        (score.key, score.title, 1.0),
        ("chamfer", "Chamfer distance of the centres", -1.0),
    ):
        figure = _speed(results, target, key, sign)
        if figure.data:
            figure.update_layout(title={"text": title, "font": {"size": 14}})
            figures.append(figure)
            if key == score.key:
                _draw_references(figure, results, target, key)
            else:
                ticks = ticks_1_2_5(_drawn(figure, "y"))
                figure.update_yaxes(type="log", tickvals=ticks, ticktext=[f"{t:g}" for t in ticks])
    return figures


def _speed(results: Results, target: str, key: str, sign: float) -> go.Figure:
    """Return curves, ends and Pareto front of one metric; `sign` is -1 where less is better."""
    figure, colour = go.Figure(), colour_of(results)
    clock, axis = results.clock(target, (results.score_of(target).key, "chamfer"))
    ends: list[tuple[float, float]] = []
    for label in results.trained:
        for row in results.of(label, target, results.base):
            curve = [point for point in row.get("curve", []) if key in point]
            if curve:
                figure.add_scatter(
                    x=[point[clock] for point in curve],
                    y=[point[key] for point in curve],
                    mode="lines",
                    line={"color": colour(label), "width": 2},
                    hovertemplate=f"{label}<br>%{{x:.1f}} s: %{{y:.4g}}<extra></extra>",
                )
            if row.get(key) is None or not row.get(clock):
                continue
            ends.append((row[clock], sign * row[key]))
            figure.add_scatter(
                x=[row[clock]],
                y=[row[key]],
                mode="markers",
                name=label,
                marker={"color": colour(label), "size": 10, "symbol": "diamond"},
                hovertemplate=f"{label}, seed {row['seed']}<br>%{{x:.1f}} s: %{{y:.4g}}<extra></extra>",
            )
    if front := pareto(ends):
        figure.add_scatter(
            x=[cost for cost, _ in front],
            y=[sign * value for _, value in front],
            mode="lines",
            name="Pareto front",
            line={"color": FRONT_COLOUR, "dash": "dot", "shape": "hv", "width": 1.5},
            hoverinfo="skip",
        )
    _draw_log_axis(figure, axis)
    return _sized(figure, 380)


def _draw_references(figure: go.Figure, results: Results, target: str, key: str) -> None:
    """Draw a line for each method without training, and one name for those that lie too close to be told apart."""
    shown = [label for label in results.labels if label not in results.trained]
    values = {
        label: value
        for label in shown
        if results.method_of[label] != "ceiling"
        and (value := results.mean(label, target, results.base, key)) is not None
        and value < EXACT_DB
    }
    drawn = [*_drawn(figure, "y"), *values.values()]
    apart = LABELS_APART * (max(drawn) - min(drawn))
    groups: list[list[str]] = []
    for label in sorted(values, key=lambda label: values[label]):
        if groups and values[label] - values[groups[-1][0]] < apart:
            groups[-1].append(label)
        else:
            groups.append([label])
        figure.add_hline(y=values[label], line={"dash": "dash", "color": REFERENCE_COLOUR, "width": 1})
    for group in groups:
        figure.add_annotation(
            **{"x": 0, "xref": "paper", "xanchor": "left", "y": values[group[-1]], "yanchor": "bottom"},
            text=", ".join(group),
            showarrow=False,
            font={"size": 11, "color": REFERENCE_COLOUR},
            bgcolor="rgba(255,255,255,0.8)",
        )


def size_figures(results: Results) -> list[go.Figure]:
    """Return score against the number of Gaussians and against bytes, a marker for each method and target."""
    colour, figures = colour_of(results), []
    for key, title, unit in (("gaussians", "Gaussians", 1.0), ("bytes", "kB that one would keep", 1e-3)):
        figure = go.Figure()
        for label in results.trained:
            points = [
                (size * unit, value, target)
                for target in results.targets
                if (size := results.mean(label, target, results.base, key))
                and (value := results.mean(label, target, results.base, results.score.key)) is not None
            ]
            if points:
                figure.add_scatter(
                    x=[size for size, _, _ in points],
                    y=[value for _, value, _ in points],
                    text=[target for _, _, target in points],
                    mode="markers",
                    name=label,
                    marker={"color": colour(label), "size": 10},
                    hovertemplate=f"{label}, %{{text}}<br>%{{x:,.0f}}: %{{y:.2f}} dB<extra></extra>",
                )
        if figure.data:
            _draw_log_axis(figure, title)
            figure.update_yaxes(title_text=results.score.title)
            figures.append(_sized(figure, 360))
    return figures


def severity_figure(results: Results, series: Series, metric: Metric) -> go.Figure | None:
    """Return a score against the severity of conditions of one kind, a line a method; None where nothing has it.

    Means over targets; the band is from the lowest to the highest seed.
    """
    figure, colour = go.Figure(), colour_of(results)
    places = [series.label(value) for value, _ in series.conditions]
    for label in results.trained:
        rows = [
            [row for t in results.targets for row in results.of(label, t, c)] for _, c in series.conditions
        ]
        by_seed = [
            {seed: fmean(v) for seed in {row["seed"] for row in of} if (v := _values(of, metric.key, seed))}
            for of in rows
        ]
        drawn = [(place, list(of.values())) for place, of in zip(places, by_seed, strict=True) if of]
        if len(drawn) < 2:
            continue
        x = [place for place, _ in drawn]
        if any(len(values) > 1 for _, values in drawn):
            figure.add_scatter(
                x=[*x, *x[::-1]],
                y=[*(max(values) for _, values in drawn), *(min(values) for _, values in drawn[::-1])],
                fill="toself",
                line={"width": 0},
                fillcolor=colour(label),
                opacity=0.2,
                mode="lines",
                hoverinfo="skip",
            )
        figure.add_scatter(
            x=x,
            y=[fmean(values) for _, values in drawn],
            mode="lines+markers",
            name=label,
            line={"color": colour(label), "width": 2},
            hovertemplate=f"{label}, %{{x}}: %{{y:.2f}}<extra></extra>",
        )
    if not figure.data:
        return None
    figure.update_xaxes(
        type="category", categoryorder="array", categoryarray=places, title_text=series.kind.title
    )
    figure.update_yaxes(title_text=metric.title)
    return _sized(figure, 300)


def _values(rows: list[dict[str, Any]], key: str, seed: int) -> list[float]:
    return [row[key] for row in rows if row["seed"] == seed and row.get(key) is not None]


def gain_figure(results: Results, label: str, base: str) -> go.Figure:
    """Return the gains of a method over a base method, a tile for each metric and target.

    Units differ from row to row: a tile's colour compares it with the largest of its own row.
    """
    gains = results.gains(label, base)
    texts = [[metric.gain(value) for value in row] for metric, row in gains]
    values = shares_of_rows([row for _, row in gains])
    figure = go.Figure(
        go.Heatmap(
            z=values,
            x=results.targets,
            y=[metric.title for metric, _ in gains],
            text=texts,
            texttemplate="%{text}",
            hovertemplate="%{y}, %{x}: %{text}<extra></extra>",
            colorscale="Viridis",
            zmin=min(0.0, min((v for row in values for v in row if v is not None), default=0.0)),
            zmax=1.0,
            xgap=2,
            ygap=2,
            showscale=False,
        )
    )
    figure.update_yaxes(autorange="reversed")
    return _sized(figure, 110 + 32 * len(gains))


def shares_of_rows(rows: list[list[float | None]]) -> list[list[float | None]]:
    """Return the values of each row as shares of the largest in it, whatever its sign."""
    found: list[list[float | None]] = []
    for row in rows:
        largest = max((abs(value) for value in row if value is not None), default=0.0) or 1.0
        found.append([None if value is None else value / largest for value in row])
    return found


def _draw_log_axis(figure: go.Figure, title: str) -> None:
    """Make the x axis logarithmic, with whole numbers at its ticks."""
    ticks = ticks_1_2_5(_drawn(figure, "x"))
    figure.update_xaxes(type="log", title_text=title, tickvals=ticks, ticktext=[f"{t:,g}" for t in ticks])


def _drawn(figure: go.Figure, axis: str) -> list[float]:
    """Return the values of all marks along an axis."""
    traces: Any = figure.data
    return [value for trace in traces for value in trace[axis]]


def _sized(figure: go.Figure, height_px: int) -> go.Figure:
    figure.update_layout(height=height_px, margin={"l": 60, "r": 20, "t": 50, "b": 50}, showlegend=False)
    return figure
