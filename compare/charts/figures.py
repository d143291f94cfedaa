"""The figures of a comparison as PNG files, for papers and pages that cannot hold interactive ones."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from compare.charts.charts import COLOURS, shares_of_rows
from compare.charts.page import error_of, shown_view
from compare.charts.results import VERDICTS, Results, pareto
from compare.charts.tables import VERDICT_COLOURS
from compare.grid.rows import Rows
from ground.show.pictures import heat, tone
from ground.show.plots import ticks_1_2_5
from obbgs_base.files import keep_mode

DPI = 110


def write_figures(out: Path, asked: Mapping[str, tuple[str, str]] = MappingProxyType({})) -> list[Path]:
    """Write the figures of a comparison's rows into its folder and return their paths.

    Args:
        asked: as for `Results`.

    Raises:
        CompareError: the rows are damaged.
        OSError: the folder cannot be written.
    """
    results = Results(Rows(out).rows.values(), asked)
    if not results.trained:
        return []
    figures: dict[str, Figure] = {
        "failures": _failures(results),
        "size": _size(results),
        **{f"speed-{target}": _speed(results, target) for target in results.targets},
        **{f"views-{target}": _views(results, out, target) for target in results.targets},
    }
    base = results.gain_base
    if base is not None:
        for label in results.trained:
            if label != base and results.gains(label, base):
                figures[f"gain-{label}"] = _gain(results, label, base)
    paths = []
    for name, figure in figures.items():
        path = out / f"{_file_name(name)}.png"
        part = path.with_suffix(".part")
        figure.savefig(part, dpi=DPI, format="png")
        keep_mode(path, part)
        part.replace(path)
        paths.append(path)
    return paths


def _colour_of(results: Results) -> Callable[[str], str]:
    colours = {label: COLOURS[i % len(COLOURS)] for i, label in enumerate(results.trained)}
    return lambda label: _plain(colours[label])


def _plain(colour: str) -> str:
    """Return Plotly's `rgb(1,2,3)` as `#010203`."""
    if colour.startswith("rgb"):
        return "#" + "".join(f"{int(part):02x}" for part in colour[4:-1].split(","))
    return colour


def _speed(results: Results, target: str) -> Figure:
    colour, score = _colour_of(results), results.score_of(target)
    rows = [row for label in results.trained for row in results.of(label, target, results.base)]
    measured = any("chamfer" in row for row in rows)  # imported pictures have no true surface
    figure = Figure(figsize=(11 if measured else 5.8, 4.2), layout="constrained")
    drawn = ((score.key, 1.0), ("chamfer", -1.0)) if measured else ((score.key, 1.0),)
    clock, words = results.clock(target, (score.key, "chamfer"))
    axes = figure.subplots(1, len(drawn), squeeze=False)[0]
    for axis, (key, sign) in zip(axes, drawn, strict=True):
        ends = []
        for label in results.trained:
            for i, row in enumerate(results.of(label, target, results.base)):
                curve = [point for point in row.get("curve", []) if key in point]
                axis.plot([p[clock] for p in curve], [p[key] for p in curve], color=colour(label), lw=1.4)
                if row.get(key) is not None and row.get(clock):
                    ends.append((row[clock], sign * row[key]))
                    name = label if i == 0 else None
                    axis.plot(row[clock], row[key], "D", color=colour(label), label=name)
        front = pareto(ends)
        axis.step([x for x, _ in front], [sign * y for _, y in front], "k:", where="post", lw=1)
        axis.set(xscale="log", xlabel=words)
        _ticks_1_2_5(axis)
        axis.grid(alpha=0.3)
    left = axes[0]
    left.set_title(f"{target}: {score.title}")
    if measured:
        axes[1].set(title="Chamfer distance of the centres", yscale="log")
    shown = [label for label in results.labels if label not in results.trained]
    for i, label in enumerate(shown):
        value = results.mean(label, target, results.base, score.key)
        if value is not None and results.method_of[label] != "ceiling":
            left.axhline(value, color="0.6", ls="--", lw=0.8)
            place = (0.02 + 0.15 * i, value)  # side by side: black and mean are nearly alike
            left.annotate(label, place, xycoords=("axes fraction", "data"), va="bottom", fontsize=7)
    if left.get_legend_handles_labels()[0]:
        left.legend(fontsize=8)
    return figure


def _ticks_1_2_5(axis: Axes) -> None:
    """Label a logarithmic x axis of what is drawn as the page does; Matplotlib's own labels overlap."""
    drawn = [float(value) for line in axis.lines for value in np.asarray(line.get_xdata())]
    axis.xaxis.set_major_locator(FixedLocator(ticks_1_2_5(drawn)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _size(results: Results) -> Figure:
    figure, colour = Figure(figsize=(11, 4.2), layout="constrained"), _colour_of(results)
    for axis, key, unit, title in zip(
        figure.subplots(1, 2),
        ("gaussians", "bytes"),
        (1.0, 1e-3),
        ("Gaussians", "kB that one would keep"),
        strict=True,
    ):
        for label in results.trained:
            points = [
                (size * unit, value)
                for target in results.targets
                if (size := results.mean(label, target, results.base, key))
                and (value := results.mean(label, target, results.base, results.score.key)) is not None
            ]
            axis.plot([x for x, _ in points], [y for _, y in points], "o", color=colour(label), label=label)
        axis.set(xscale="log", xlabel=title, ylabel=results.score.title)
        _ticks_1_2_5(axis)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return figure


def _failures(results: Results) -> Figure:
    labels, conditions = results.trained, results.trained_conditions
    figure = Figure(figsize=(2.5 + 1.1 * len(labels), 1.6 + 0.35 * len(conditions)), layout="constrained")
    axis = figure.subplots()
    verdicts = [[results.verdict(label, condition)[0] for label in labels] for condition in conditions]
    levels = np.array([[VERDICTS.index(v) if v else np.nan for v in row] for row in verdicts], float)
    axis.imshow(levels, ListedColormap(VERDICT_COLOURS), vmin=-0.5, vmax=len(VERDICTS) - 0.5, aspect="auto")
    texts = []
    for row, condition in zip(verdicts, conditions, strict=True):
        means = [results.over_targets(label, condition, results.score.key)[0] for label in labels]
        words = [v or results.unjudged(label, condition) for v, label in zip(row, labels, strict=True)]
        texts.append([w if mean is None else f"{mean:.1f}" for w, mean in zip(words, means, strict=True)])
    _tiles(axis, texts, labels, conditions)
    handles = [Patch(color=c, label=v) for v, c in zip(VERDICTS, VERDICT_COLOURS, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(VERDICTS), fontsize=8)
    return figure


def _gain(results: Results, label: str, base: str) -> Figure:
    figure = Figure(figsize=(2.8 + 1.2 * len(results.targets), 4), layout="constrained")
    axis = figure.subplots()
    gains = results.gains(label, base)
    values = shares_of_rows([row for _, row in gains])
    shown = np.array([[np.nan if value is None else value for value in row] for row in values], float)
    least = min(0.0, float(np.nanmin(shown))) if np.isfinite(shown).any() else 0.0
    axis.imshow(shown, "viridis", vmin=least, vmax=1.0, aspect="auto")
    texts = [[metric.gain(value) for value in row] for metric, row in gains]
    _tiles(axis, texts, results.targets, [metric.title for metric, _ in gains])
    axis.set_title(f"gains of {label} over {base}", fontsize=10)
    return figure


def _tiles(axis: Axes, texts: list[list[str]], columns: list[str], rows: list[str]) -> None:
    """Write a text into every tile, with the names of columns and rows."""
    for y, row in enumerate(texts):
        for x, text in enumerate(row):
            box = {"facecolor": "white", "alpha": 0.65, "edgecolor": "none", "pad": 1}
            axis.text(x, y, text, ha="center", va="center", fontsize=8, bbox=box if text else None)
    axis.set_xticks(range(len(columns)), columns, fontsize=8, rotation=20, ha="right")
    axis.set_yticks(range(len(rows)), rows, fontsize=8)


def _views(results: Results, out: Path, target: str) -> Figure:
    """Return the view that all methods share: truth first, renders above, their errors below."""
    kept = [
        (name, view)
        for name in results.labels
        if (view := shown_view(results, out, name, target)) is not None
    ]
    figure = Figure(figsize=(1.9 * (1 + len(kept)), 4.1), layout="constrained")
    axes = figure.subplots(2, 1 + len(kept), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    if kept:
        axes[0, 0].imshow(tone(kept[0][1].expected, kept[0][1].sensor))
        axes[0, 0].set_title(f"{target}\nframe {kept[0][1].frame}", fontsize=9)
    for column, (name, view) in enumerate(kept, start=1):
        axes[0, column].imshow(tone(view.image, view.sensor))
        axes[0, column].set_title(f"{name}\n{view.psnr_db:.1f} dB", fontsize=9)
        axes[1, column].imshow(heat(error_of(view)))
    return figure


def _file_name(name: str) -> str:
    """Return a figure's name with only such characters as every file system takes."""
    return "".join(character if character.isalnum() or character in "-_+." else "-" for character in name)
