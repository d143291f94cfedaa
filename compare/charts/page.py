"""The page of a comparison: one HTML file that opens without a network, made of all rows in the folder."""

import html
import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from compare.charts.charts import (
    colour_of,
    gain_figure,
    severity_figure,
    size_figures,
    speed_figures,
)
from compare.charts.results import (
    HOLDS_DB,
    LEVELS_DB,
    MARGIN_DB,
    METRICS,
    NOT_RUN,
    SHAKEN_DB,
    UNJUDGED,
    VERDICTS,
    Results,
    budget_of,
)
from compare.charts.severity import LEAST_F_PERCENT, Breaking, F, Series, breaking_points
from compare.charts.tables import VERDICT_COLOURS, failure_table, score_table
from compare.grid.rows import Rows
from compare.grid.worker import VIEWS
from compare.methods import reference_names
from compare.views import SHOWN, WORST, KeptView, read_views
from ground.show.page import beside, breakable, fold, label, legend, page, picture, plot, section
from ground.show.pictures import ERROR_FULL_SCALE, heat, tone
from obbgs_base.errors import counted
from obbgs_base.files import write_whole

PAGE = "compare.html"
WORST_SHOWN = 6
NAMES_PX, TILE_PX = 170, 62  # of the names beside the tiles of gains, and of a tile at least
COLUMNS = (  # ends of the keys of columns, and what these mean
    (
        ("_clean_db", "ssim_clean"),
        "Clean figures compare with noiseless exposures of held-out views, full scale as 1.",
    ),
    (("psnr_noisy_db",), "Noisy PSNR compares with held-out frames as received: their own noise bounds it."),
    (("_srgb_db", "_srgb"), "Figures of sRGB compare display values with those of held-out pictures."),
    (("foreground_db",), "Foreground counts only the pixels that the target covers."),
    (
        ("pooled_db",),
        "Pooled is of the mean squared error over all views together, which single nearly exact views do not lift.",
    ),
    (
        ("best_db",),
        "Best on the way is the highest clean PSNR of a curve: what a method would reach if the truth told it when to "
        "stop.",
    ),
    (("mu_db",), "Mu-law is of radiance after log(1 + 5000 x)."),
    (("ssim_clean", "ssim_srgb"), "SSIM is the structural similarity, 1 of identical pictures."),
    (("lpips", "lpips_srgb"), "LPIPS is the difference that a network sees, 0 of identical pictures."),
    (
        ("_surface", "chamfer", "_centres"),
        "Distances are in units where the target's largest dimension is 2.",
    ),
    (
        ("f_01_surface", "f_02_surface", "chamfer_surface"),
        "Precision, recall and their mean F, within .01 and .02, and Chamfer of the surface compare the surface that "
        "the training views see with the true one, both thinned to one point in each cell of 0.005.",
    ),
    (
        ("completeness_surface", "accuracy_surface"),
        "Surface complete and accuracy are of 100,000 points on it (complete: within 0.01 of a point).",
    ),
    (
        ("chamfer", "hausdorff", "_centres"),
        "Those of centres, of Gaussians that may be out of sight, only help to find faults.",
    ),
    (("bytes",), "kB are those of the model that one would keep."),
    (
        ("seconds_to_f60", *(f"seconds_to_{level}_db" for level in LEVELS_DB)),
        "Seconds to a quality are of the processor, read on the way without measuring.",
    ),
    (
        ("cpu_seconds",),
        "Processor time is that of the training alone, which other work on the machine does not change.",
    ),
    (("seconds",), "Seconds are of the training alone, by the clock."),
    (("energy_j",), "Energy is what the processor packages took, with all that ran beside."),
)


def write_page(out: Path, asked: Mapping[str, tuple[str, str]] = MappingProxyType({})) -> Path:
    """Write compare.html into a comparison's folder and return its path.

    Args:
        asked: as for `Results`.

    Raises:
        CompareError: the rows are damaged.
        OSError: the folder cannot be written.
    """
    results = Results(Rows(out).rows.values(), asked)
    replaced = ""
    if results.replaced:
        more = f"{counted(results.replaced, 'more row')} {'is' if results.replaced == 1 else 'are'}"
        replaced = (
            f" {more} left out: of the same names, but of another condition, session or settings than now, or than "
            "those asked for."
        )
    rows, methods, targets, conditions = (
        counted(len(those), word)
        for those, word in (
            (results.rows, "row"),
            (set(results.method_of.values()), "method"),
            (results.targets, "target"),
            (results.conditions, "condition"),
        )
    )
    content = page(
        "Comparison of methods",
        f"{rows}: {methods}, {targets}, {conditions}.{_shortened(results)}{replaced}",
        [
            _tables(results),
            _speed(results),
            _failures(results, out),
            _breaking(results),
            _size(results),
            _gains(results),
            _side_by_side(results, out),
            _origin(results),
        ],
    )
    path = out / PAGE
    write_whole(path, content.encode())
    return path


def _shortened(results: Results) -> str:
    """Return in a sentence which trainings had other steps than their method asks for, or fewer Gaussians."""
    methods: dict[str, dict[str, None]] = {}
    for row in results.rows:
        if row["steps_share"] != 1 or "largest" in row:
            methods.setdefault(budget_of(row), {})[row["method"]] = None
    limits = [f"{budget} ({', '.join(names)})" for budget, names in methods.items()]
    return f" Trainings with limits: {'; '.join(limits)}." if limits else ""


def _tables(results: Results) -> str:
    """Return the table of means over the targets, and one of each target."""
    body = ""
    if len(results.targets) > 1:
        body = f"<h3>Mean of the targets</h3>{score_table(results, None)}"
    for target in results.targets:
        body += f"<h3>{html.escape(target)}</h3>{score_table(results, target)}"
    keys = [metric.key for metric in results.known()]
    columns = " ".join(words for ends, words in COLUMNS if any(key.endswith(ends) for key in keys))
    folded = fold("What the columns mean", f'<p class="note">{columns}</p>') if columns else ""
    return section(f"Scores, {html.escape(results.base)}", _explained(results), folded + body)


def _explained(results: Results) -> str:
    """Return what the columns and rows that are there mean."""
    methods = {row["method"] for row in results.rows if not (row.get("error") or row.get("failed"))}
    notes = []
    if results.truth:
        notes.append(
            "Clean PSNR compares with noiseless exposures of held-out views; 6 dB more halve the error."
        )
    if not all(results.score_of(target).key == "psnr_clean_db" for target in results.targets):
        which = (
            "Of some of these sessions no truth is known"
            if results.truth
            else "No truth is known of these sessions"
        )
        notes.append(
            f"{which}: their methods are compared with held-out frames as received, whose own noise bounds the PSNR."
        )
    notes.append("Bold: the best of those that reconstruct something. Wide tables scroll sideways.")
    if "ceiling" in methods:
        notes.append(
            "The ceiling is a perfect model that ignores exposure: true radiance at the geometric mean of the exposure "
            "times; at that exposure it is exact (120 dB), so that only its pooled figure tells."
        )
    if "noise" in methods:
        notes.append("Noise is the noisy frame itself, which of course equals itself (120 dB).")
    if any(len(results.of(label, t, results.base)) > 1 for label in results.labels for t in results.targets):
        notes.append("± is the deviation over seeds.")
    return " ".join(notes)


def _methods_legend(results: Results, *others: str) -> str:
    """Return the colours of methods that have a score, or one of the other figures that are drawn beside it."""
    keys = {*(results.score_of(target).key for target in results.targets), *others}
    scored = {row["method"] for row in results.rows if any(row.get(key) is not None for key in keys)}
    colour = colour_of(results)
    return legend((name, colour(name)) for name in results.trained if results.method_of[name] in scored)


def _speed(results: Results) -> str:
    note = (
        "Curves are measured on the way, on up to 16 of the held-out views; measuring is not counted as time, which is "
        "the processor's where all trainings of a target have it. "
        "Diamonds are final scores over all held-out views, and the dotted line their Pareto front: no other "
        "method is both faster and better than those on it."
    )
    body = ""
    for target in results.targets:
        figures = speed_figures(results, target)
        drawn = beside(map(plot, figures)) if figures else "<p>No method has a score on this target.</p>"
        body += f"<h3>{html.escape(target)}</h3>{drawn}"
    if not results.trained:
        return section("Speed against accuracy", note, "No method was trained.")
    return section("Speed against accuracy", note, _methods_legend(results, "chamfer") + body)


def _failures(results: Results, out: Path) -> str:
    """Return the map of conditions and methods, and the worst views of all."""
    note = (
        f"Numbers are mean scores over targets and seeds; the colour is that of the worst target. Holds: at most "
        f"{HOLDS_DB:g} dB below {html.escape(results.base)}; shaken: at most {SHAKEN_DB:g} dB; suffers: more; fails: "
        f"less than {MARGIN_DB:g} dB above the best image without training (black, mean, untrained); not judged: none "
        f"of these was scored, or the method not trained {html.escape(results.base)}; refused: ended in an error that "
        "says why. Point at a cell for its figures."
    )
    worst: dict[tuple[str, str], tuple[str, KeptView]] = {}  # of each method and target
    for row in results.rows:
        view = read_views(out / VIEWS / f"{row['digest']}.npz").get(WORST)
        if view is None or row["method"] in reference_names():
            continue
        key = (results.label_of(row), row["target"])
        if key not in worst or view.psnr_db < worst[key][1].psnr_db:
            worst[key] = (f"{key[0]}, {row['target']}, {row['condition']}", view)
    shown = sorted(worst.values(), key=lambda entry: entry[1].psnr_db)[:WORST_SHOWN]
    cells = [f'<div class="label head">{words}</div>' for words in ("", "expected", "render", "error")]
    for words, view in shown:
        cells += [label(f"{breakable(words)}, frame {view.frame}"), *_compared(view)]
    title = "<h3>Worst views, one of each method and target</h3>"
    pictures = f'{title}<div class="grid compared">{"".join(cells)}</div>' if shown else ""
    drawn = failure_table(results)
    if drawn:
        drawn = legend(zip(VERDICTS, VERDICT_COLOURS, strict=True)) + drawn
    return section("Where methods fail", note, drawn + pictures) if drawn or pictures else ""


def _breaking(results: Results) -> str:
    """Return where each method breaks, kind of condition by kind, and the curves of its scores until there."""
    found = breaking_points(results)
    if not found:
        return ""
    of_surface = f", or F of the surface within .02 is below {LEAST_F_PERCENT:g} %" if results.truth else ""
    note = (
        "The mildest condition, in bold, at which a method is broken on any target: it ends in an error, or its score "
        f"is below the better one of a black image and the mean image{of_surface}. Where it never broke, the most "
        "severe condition that it was tried at; not judged: neither image was scored. Point at a cell for the reason. "
        "The curves are means over the targets that were run at each point, their bands from the lowest to the highest "
        "seed: where points have other targets, as the table says, a curve compares these as well."
    )
    labels = [label for label in results.trained if any(label in points for _, points in found)]
    head = "".join(f"<th>{breakable(label)}</th>" for label in labels)
    lines, curves = [], ""
    metrics = [results.score, next(metric for metric in METRICS if metric.key == F)]
    for series, points in found:
        cells = "".join(_breaking_cell(series, points.get(label)) for label in labels)
        lines.append(f"<tr><td>{html.escape(series.kind.title)}</td>{cells}</tr>")
        figures = [severity_figure(results, series, metric) for metric in metrics]
        curves += beside(plot(figure) for figure in figures if figure is not None)
    table = f'<div class="scroll"><table class="scores"><tr><th>condition</th>{head}</tr>{"".join(lines)}</table></div>'
    return section("Where each method breaks", note, table + _methods_legend(results, F) + curves)


def _breaking_cell(series: Series, point: Breaking | None) -> str:
    """Return a cell of the table of breaking points."""
    if point is None:
        return f'<td class="unrun">{NOT_RUN}</td>'
    words = [f"<b>{html.escape(series.label(value))}</b>" for value in point.broken_at]
    words += [f"holds at {html.escape(series.label(value))}" for value in point.held]
    words += [] if point.is_judged else [UNJUDGED]
    return f'<td title="{html.escape("; ".join(point.why))}">{", ".join(words)}</td>'


def _size(results: Results) -> str:
    note = "A marker for each method and target: left up is what one wants, no more model than a scene needs."
    figures = size_figures(results)
    return (
        section("Size against accuracy", note, _methods_legend(results) + beside(map(plot, figures)))
        if figures
        else ""
    )


def _gains(results: Results) -> str:
    base = results.gain_base
    others = [name for name in results.trained if name != base]
    if base is None or not others:
        return ""
    note = (
        f"By how much a method is better than {html.escape(base)}, tile by tile: the difference of scores in their own "
        "unit, and of distances and LPIPS, which are errors, the per cent that are saved. A positive gain is always an "
        "improvement; colours compare the tiles of a row."
    )
    figures = [(name, gain_figure(results, name, base)) for name in others if results.gains(name, base)]
    width_px = NAMES_PX + TILE_PX * len(
        results.targets
    )  # narrower, tiles would have no room for their numbers
    body = "".join(
        f'<h3>{breakable(name)}</h3><div class="scroll"><div style="min-width: {width_px}px">{plot(figure)}</div></div>'
        for name, figure in figures
    )
    return section(f"Gains over {html.escape(base)}", note, body) if body else ""


def _side_by_side(results: Results, out: Path) -> str:
    """Return for each target the view that all methods share: truth, renders, errors."""
    note = (
        "The held-out view in which the target is brightest, the same for all methods; brightness is the square root "
        "of the signal above black. Error is the absolute difference: 0<span class='ramp'></span>"
        f"{ERROR_FULL_SCALE:.0%} of full scale or more."
    )
    body = []
    for target in results.targets:
        kept = [
            (name, view)
            for name in results.labels
            if (view := shown_view(results, out, name, target)) is not None
        ]
        if not kept:
            continue
        body.append(f"<h3>{html.escape(target)}, frame {kept[0][1].frame}</h3>")
        truth = tone(kept[0][1].expected, kept[0][1].sensor)
        cells = [picture(truth, "expected", "expected")]
        for name, view in kept:
            _, render, error = _compared(view, f"{breakable(name)}, ")
            cells.append(f"<div>{render}{error}</div>")
        body.append(f'<div class="grid views">{"".join(cells)}</div>')
    return section("Side by side", note, "".join(body)) if body else ""


def shown_view(results: Results, out: Path, name: str, target: str) -> KeptView | None:
    """Return the view of a target that all methods share, of a method's first seed; None where none was kept."""
    rows = results.of(name, target, results.base)
    views = [read_views(out / VIEWS / f"{row['digest']}.npz").get(SHOWN) for row in rows]
    return next((view for view in views if view is not None), None)


def error_of(view: KeptView) -> np.ndarray:
    """Return the error of a view's image [H, W, 1], 1 at `ERROR_FULL_SCALE` of full scale and above."""
    error = np.abs(view.image - view.expected).mean(axis=2, keepdims=True)
    return np.clip(error / ERROR_FULL_SCALE, 0, 1)


def _compared(view: KeptView, name: str = "") -> list[str]:
    return [
        picture(tone(view.expected, view.sensor), "expected", f"{view.exposure_time_s * 1e3:g} ms"),
        picture(tone(view.image, view.sensor), "render", f"{name}{view.psnr_db:.1f} dB"),
        picture(heat(error_of(view)), "error", "&nbsp;"),
    ]


def _origin(results: Results) -> str:
    """Return where the rows come from."""
    lines = []
    for key, title in (
        ("commit", "commit"),
        ("machine", "machine"),
        ("threads", "threads"),
        ("command", "command"),
    ):
        values = list(dict.fromkeys(str(row[key]) for row in results.rows if key in row))
        lines += [f"<tr><td>{title}</td><td>{html.escape(value)}</td></tr>" for value in values]
    loads = [row["load"] for row in results.rows if "load" in row]
    if loads:
        lines.append(f"<tr><td>load</td><td>{min(loads):g} to {max(loads):g}</td></tr>")
    changes = {row["condition"]: row["changes"] for row in results.rows if "changes" in row}
    lines += [
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(json.dumps(change))}</td></tr>"
        for name, change in changes.items()
    ]
    count = sum(bool(row.get("converged")) for row in results.rows)
    early = counted(count, "training") if count else "No training"
    note = (
        f"Every row is a line of rows.jsonl with its own commit, machine, load and date. {early} ended early "
        "because its curve had moved by less than 0.05 dB over its last fifth (converged)."
    )
    return section(
        "Where the rows come from", note, f'<div class="scroll"><table>{"".join(lines)}</table></div>'
    )
