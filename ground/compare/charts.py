"""The interactive figures of a comparison's page."""

from collections.abc import Callable

import plotly.graph_objects as go
from plotly.colors import qualitative
from plotly.subplots import make_subplots

from ground.compare.results import GAINS, METRICS, VERDICTS, Results, pareto

COLOURS = (*qualitative.D3, *qualitative.Set2)
VERDICT_COLOURS = ("#2a9d8f", "#e9c46a", "#f4a261", "#c0392b", "#8795a5")  # of VERDICTS
REFERENCE_COLOUR, FRONT_COLOUR = "#8795a5", "#1c2733"


def colour_of(results: Results) -> Callable[[str], str]:
    """Return the function from a method's label to its colour, the same in every figure."""
    colours = {label: COLOURS[i % len(COLOURS)] for i, label in enumerate(results.trained)}
    return lambda label: colours.get(label, REFERENCE_COLOUR)


def speed_figure(results: Results, target: str) -> go.Figure:
    """Return score and Chamfer distance of one target against seconds: curves, final scores, their Pareto fronts."""
    colour, score = colour_of(results), results.score
    shown = ((score.key, score.title, 1.0), ("chamfer", "Chamfer distance", -1.0))
    figure = make_subplots(
        rows=1, cols=2, subplot_titles=[title for _, title, _ in shown], horizontal_spacing=0.1
    )
    for column, (key, _, sign) in enumerate(shown, start=1):
        ends: list[tuple[float, float]] = []
        for label in results.trained:
            for row in results.of(label, target, results.base):
                curve = [point for point in row.get("curve", []) if key in point]
                figure.add_scatter(
                    x=[point["seconds"] for point in curve],
                    y=[point[key] for point in curve],
                    mode="lines",
                    line={"color": colour(label), "width": 2},
                    legendgroup=label,
                    showlegend=False,
                    hovertemplate=f"{label}<br>%{{x:.1f}} s: %{{y:.4g}}<extra></extra>",
                    row=1,
                    col=column,
                )
                if row.get(key) is None or not row.get("seconds"):
                    continue
                ends.append((row["seconds"], sign * row[key]))
                first = row["seed"] == min(r["seed"] for r in results.of(label, target, results.base))
                figure.add_scatter(
                    x=[row["seconds"]],
                    y=[row[key]],
                    mode="markers",
                    name=label,
                    marker={"color": colour(label), "size": 10, "symbol": "diamond"},
                    legendgroup=label,
                    showlegend=column == 1 and first,
                    hovertemplate=f"{label}, seed {row['seed']}<br>%{{x:.1f}} s: %{{y:.4g}}<extra></extra>",
                    row=1,
                    col=column,
                )
        front = pareto(ends)
        figure.add_scatter(
            x=[cost for cost, _ in front],
            y=[sign * value for _, value in front],
            mode="lines",
            name="Pareto front",
            line={"color": FRONT_COLOUR, "dash": "dot", "shape": "hv", "width": 1.5},
            showlegend=column == 1,
            hoverinfo="skip",
            row=1,
            col=column,
        )
    for label in results.labels:
        value = results.mean(label, target, results.base, score.key)
        if label not in results.trained and value is not None and results.method_of[label] != "ceiling":
            figure.add_hline(
                y=value,
                line={"dash": "dash", "color": REFERENCE_COLOUR, "width": 1},
                annotation={"text": label, "font": {"size": 11, "color": REFERENCE_COLOUR}},
                row=1,  # pyright: ignore[reportArgumentType]
                col=1,  # pyright: ignore[reportArgumentType]
            )
    figure.update_xaxes(type="log", title_text="seconds of training")
    figure.update_yaxes(type="log", row=1, col=2)
    return _sized(figure, 430)


def size_figure(results: Results) -> go.Figure:
    """Return score against the number of Gaussians and against bytes, a marker for each method and target."""
    colour, score = colour_of(results), results.score
    figure = make_subplots(rows=1, cols=2, subplot_titles=["Gaussians", "kB that one would keep"])
    for label in results.trained:
        for column, (key, unit) in enumerate((("gaussians", 1.0), ("bytes", 1e-3)), start=1):
            points = [
                (size * unit, value, target)
                for target in results.targets
                if (size := results.mean(label, target, results.base, key))
                and (value := results.mean(label, target, results.base, score.key)) is not None
            ]
            figure.add_scatter(
                x=[size for size, _, _ in points],
                y=[value for _, value, _ in points],
                text=[target for _, _, target in points],
                mode="markers",
                name=label,
                legendgroup=label,
                showlegend=column == 2,
                marker={"color": colour(label), "size": 10},
                hovertemplate=f"{label}, %{{text}}<br>%{{x:,.0f}}: %{{y:.2f}} dB<extra></extra>",
                row=1,
                col=column,
            )
    figure.update_xaxes(type="log")
    figure.update_yaxes(title_text=score.title, row=1, col=1)
    return _sized(figure, 400)


def failure_figure(results: Results) -> go.Figure:
    """Return the map of conditions and methods, coloured by verdict, with the mean score in each cell."""
    labels, conditions = results.trained, results.conditions[::-1]
    found = [[results.verdict(label, condition) for label in labels] for condition in conditions]
    scores = [
        [results.over_targets(label, condition, results.score.key)[0] for label in labels]
        for condition in conditions
    ]
    levels = len(VERDICTS)
    scale = [[(i + side) / levels, colour] for i, colour in enumerate(VERDICT_COLOURS) for side in (0, 1)]
    figure = go.Figure(
        go.Heatmap(
            z=[[VERDICTS.index(verdict) if verdict else None for verdict, _ in row] for row in found],
            x=labels,
            y=conditions,
            text=[
                ["" if not v else v if s is None else f"{s:.1f}" for (v, _), s in zip(row, of, strict=True)]
                for row, of in zip(found, scores, strict=True)
            ],
            customdata=[[f"{verdict}<br>{words}" for verdict, words in row] for row in found],
            texttemplate="%{text}",
            hovertemplate="%{x}, %{y}<br>%{customdata}<extra></extra>",
            zmin=-0.5,
            zmax=levels - 0.5,
            colorscale=scale,
            xgap=2,
            ygap=2,
            colorbar={"tickvals": list(range(levels)), "ticktext": list(VERDICTS), "thickness": 12},
        )
    )
    figure.update_xaxes(side="top")
    return _sized(figure, 110 + 30 * len(conditions))


def gain_figure(results: Results, label: str, base: str) -> go.Figure:
    """Return the relative gains of a method over a base method, a tile for each metric and target."""
    titles = {metric.key: metric.title for metric in METRICS}
    values = [[results.gain(label, base, target, key) for target in results.targets] for key in GAINS]
    largest = max((abs(value) for row in values for value in row if value is not None), default=1.0)
    figure = go.Figure(
        go.Heatmap(
            z=values,
            x=results.targets,
            y=[titles[key] for key in GAINS],
            text=[["" if value is None else f"{value:+.1f} %" for value in row] for row in values],
            texttemplate="%{text}",
            hovertemplate="%{y}, %{x}: %{z:+.1f} %<extra></extra>",
            colorscale="Viridis",
            zmin=min(0.0, min((v for row in values for v in row if v is not None), default=0.0)),
            zmax=largest,
            xgap=2,
            ygap=2,
            colorbar={"title": {"text": "%"}, "thickness": 12},
        )
    )
    figure.update_yaxes(autorange="reversed")
    return _sized(figure, 300)


def _sized(figure: go.Figure, height_px: int) -> go.Figure:
    figure.update_layout(height=height_px, margin={"l": 60, "r": 20, "t": 50, "b": 50})
    return figure
