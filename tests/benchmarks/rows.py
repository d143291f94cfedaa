"""Rows of benchmarks: where a figure comes from, and the page that is made of committed rows.

Every row that a benchmark prints with --json says the commit, machine, load, date and command that it came from. Rows
worth keeping are appended to `results/NAME.jsonl` and committed; `python -m tests.benchmarks.rows` writes
`results/RESULTS.md` from them: a section a file, a line a method (or condition) and target, means over seeds.
"""

import json
import statistics
from collections.abc import Iterable
from pathlib import Path

from compare.grid.origin import this_command, with_origin

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "results"
# what a line of a table is called by, where a row has it
NAMES = ("method", "backend", "ablation", "condition", "scenario", "target")
# and these where rows differ in them
BUDGETS = {
    "steps_share": "share of the steps",
    "largest": "at most Gaussians",
    "size_px": "pixels along a side, where not the usual number",
}
WITHOUT_TRAINING = ("black", "mean", "untrained")
NO_METHODS = (*WITHOUT_TRAINING, "noise", "ceiling")
FIGURES = {  # key of a row: column title and format
    "psnr_clean_db": ("clean PSNR", "{:.2f} dB"),
    "psnr_settled_db": ("from settled poses", "{:.2f} dB"),
    "psnr_similarity_db": ("of the true size", "{:.2f} dB"),
    "psnr_exact_db": ("with exact tags", "{:.2f} dB"),
    "pose_error_deg": ("pose error", "{:.3f} deg"),
    "pose_error_range": ("of the range", "{:.2%}"),
    "pose_error_px": ("in the picture", "{:.2f} px"),
    "size_error_percent": ("too large by", "{:.2f} %"),
    "similarity_pose_error_deg": ("pose error, true size", "{:.3f} deg"),
    "similarity_pose_error_range": ("of the range", "{:.2%}"),
    "similarity_pose_error_px": ("in the picture", "{:.2f} px"),
    "psnr_srgb_db": ("sRGB PSNR", "{:.2f} dB"),
    "psnr_foreground_db": ("foreground", "{:.2f} dB"),
    "psnr_clean_pooled_db": ("pooled", "{:.2f} dB"),
    "psnr_mu_db": ("mu-law", "{:.2f} dB"),
    "psnr_best_db": ("best on the way", "{:.2f} dB"),
    "ssim_clean": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "precision_01_surface": ("precision .01", "{:.1f} %"),
    "recall_01_surface": ("recall .01", "{:.1f} %"),
    "f_01_surface": ("F .01", "{:.1f} %"),
    "precision_02_surface": ("precision .02", "{:.1f} %"),
    "recall_02_surface": ("recall .02", "{:.1f} %"),
    "f_02_surface": ("F .02", "{:.1f} %"),
    "chamfer_surface": ("Chamfer of the surface", "{:.4f}"),
    "chamfer": ("Chamfer of centres", "{:.4f}"),
    "hausdorff": ("Hausdorff of centres", "{:.3f}"),
    "completeness_surface": ("surface complete", "{:.1f} %"),
    "completeness_shown_surface": ("complete of what is shown", "{:.1f} %"),
    "accuracy_surface": ("accuracy", "{:.4f}"),
    "chi2_held_out_both": ("chi² over noise and own error", "{:.2f}"),
    "completeness_mesh": ("mesh complete", "{:.1f} %"),
    "completeness_shown_mesh": ("mesh complete of what is shown", "{:.1f} %"),
    "accuracy_mesh": ("accuracy of the mesh", "{:.4f}"),
    "surface_shown": ("of the surface is shown", "{:.1f} %"),
    "mesh_triangles": ("triangles", "{:,.0f}"),
    "seconds_to_35_db": ("to 35 dB", "{:.1f} s"),
    "seconds_to_38_db": ("to 38 dB", "{:.1f} s"),
    "seconds_to_40_db": ("to 40 dB", "{:.1f} s"),
    "seconds_to_f60": ("to F .02 of 60 %", "{:.1f} s"),
    "cpu_seconds": ("processor time", "{:.1f} s"),
    "gaussians": ("Gaussians", "{:,.0f}"),
    "seconds": ("seconds", "{:.1f}"),
    "forward_ms": ("rendering", "{:.1f} ms"),
    "backward_ms": ("gradient", "{:.1f} ms"),
    "over_best_kernel": ("over the best kernel", "{:.2f}"),
    "step_ms": ("one step", "{:.1f} ms"),
    "step_over_rasterizer": ("over its rendering and gradient", "{:.2f}"),
    "psnr_after_a_third_db": ("after a third of the pass", "{:.1f} dB"),
    "psnr_live_db": ("live, at the end", "{:.2f} dB"),
    "psnr_afterwards_db": ("trained afterwards", "{:.2f} dB"),
    "cpu_seconds_to_half_db": ("processor time to within 0.5 dB", "{:.1f} s"),
    "seconds_to_half_db": ("within 0.5 dB after", "{:.0f} s"),
    "latency_live_median_s": ("latency, live", "{:.2f} s"),
    "latency_alone_median_s": ("latency, no training", "{:.2f} s"),
    "pass_seconds": ("seconds of a pass", "{:.2f} s"),
    "passes": ("passes", "{:.0f}"),
    "passes_repeating": ("of them sent segments twice", "{:.0f}"),
    "passes_losing_the_end": ("lost their last packets", "{:.0f}"),
    "efficiency": ("of what the wire carries", "{:.1%}"),
    "flight_rss_mb": ("flight's memory", "{:.1f} MB"),
    "frames_a_second": ("frames a second", "{:.0f}"),
    "longest_turn_ms": ("longest turn", "{:.1f} ms"),
    "longest_turn_deleting_ms": ("longest turn while deleting", "{:.1f} ms"),
    "segments_resent": ("segments sent again", "{:.0f}"),
    "peak_gb_frames": ("peak memory when the frames are there", "{:.2f} GB"),
    "peak_gb_start": ("after the start", "{:.2f} GB"),
    "peak_gb": ("of the training", "{:.2f} GB"),
    "rss_mb": ("resident memory", "{:.1f} MB"),
    "handles": ("open handles", "{:.0f}"),
    "store_files": ("files of the store", "{:.0f}"),
    "session_files_besides_frames": ("files of the session besides frames", "{:.0f}"),
    "events_of_the_clock": ("events of the clock", "{:.0f}"),
    "trials": ("trials", "{:,.0f}"),
    "trials_failed": ("of them failed", "{:.0f}"),
}


def shown(row: dict, bench: str, as_json: bool) -> str:
    """Return the line that a benchmark prints for a row: JSON with its origin, or the row as text."""
    if as_json:
        command = this_command(f"python -m tests.benchmarks.{bench}")
        return json.dumps(with_origin(row, bench, command))
    return "  ".join(f"{key} {value}" for key, value in row.items())


def page(files: Iterable[Path]) -> str:
    """Return the page of some files of rows as Markdown."""
    # not above, since it loads every method, which the benchmarks of links do not need
    from compare.charts.results import with_best

    parts = [
        "# Results\n",
        "Made from `results/*.jsonl` by `python -m tests.benchmarks.rows`; do not edit.\n",
        "A command is that of its commit: check that out to repeat it, since later ones rename options and grids.\n",
    ]
    for file in files:
        rows = [with_best(json.loads(line)) for line in file.read_text().splitlines() if line]
        parts.append(f"## {file.stem.replace('-', ' ')}\n")
        for key, title in (("commit", "Commit"), ("machine", "Machine"), ("command", "Command")):
            values = sorted({str(row[key]) for row in rows if key in row})
            parts += [f"- {title}: " + "; ".join(f"`{v}`" if key == "command" else v for v in values)]
        loads = [row["load"] for row in rows if "load" in row]
        if loads:
            parts.append(f"- Load while they ran: {min(loads):g} to {max(loads):g}")
        parts += ["", *_table(rows), "", *_breaking(rows), *_below(rows)]
    return "\n".join(parts)


def _table(rows: list[dict]) -> list[str]:
    names = [key for key in NAMES if any(key in row for row in rows)]
    names += [key for key in BUDGETS if len({row.get(key) for row in rows}) > 1]
    figures = [key for key in FIGURES if any(row.get(key) is not None for row in rows)]
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key, "") for key in names), []).append(row)
    titles = [*(BUDGETS.get(name, name) for name in names), "seeds", *(FIGURES[key][0] for key in figures)]
    lines = ["| " + " | ".join(titles) + " |", "| " + " | ".join(["---"] * len(titles)) + " |"]
    for name, members in groups.items():
        cells = [*map(str, name), str(len(members))]
        cells += [
            _cell([m[key] for m in members if m.get(key) is not None], FIGURES[key][1]) for key in figures
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _breaking(rows: list[dict]) -> list[str]:
    """Return the table of where methods break, of rows of `ground compare` under conditions of different severity."""
    from compare.charts.results import UNJUDGED, Results
    from compare.charts.severity import LEAST_F_PERCENT, breaking_points

    if not all("digest" in row for row in rows):  # another benchmark's
        return []
    results = Results(rows)
    found = breaking_points(results)
    if len(results.trained) < 2 or not found:
        return []
    lines = []
    for series, points in found:
        cells = []
        for method in results.trained:
            point, words = points.get(method), []
            if point is not None:
                broken = zip(point.broken_at, point.why, strict=True)
                words += [f"**{series.label(value)}** ({why})" for value, why in broken]
                words += [f"holds at {series.label(value)}" for value in point.held]
                words += [] if point.is_judged else [UNJUDGED]
            cells.append(", ".join(words))
        if any(cells):
            lines.append(f"| {' | '.join([series.kind.title, *cells])} |")
    if not lines:
        return []
    about = (
        "Where methods break: the mildest condition, in bold, at which one ends in an error, is below the better one "
        "of a black image and the mean image, or has an F of the surface within .02 of less than "
        f"{LEAST_F_PERCENT:g} % on any target, with the first reason; else the most severe one that it was tried at."
    )
    titles = ["condition", *results.trained]
    head = [f"| {' | '.join(titles)} |", f"| {' | '.join(['---'] * len(titles))} |"]
    return [about, "", *head, *lines, ""]


def ending_below(rows: list[dict]) -> list[tuple[dict, list[str]]]:
    """Return the trainings that end below images without training, and which of these are better, the best first."""
    references: dict[tuple, dict[str, float]] = {}
    for row in rows:
        if row.get("method") in WITHOUT_TRAINING and "psnr_clean_db" in row:
            references.setdefault(_case(row), {})[row["method"]] = row["psnr_clean_db"]
    found = []
    for row in rows:
        better = references.get(_case(row), {})
        if row.get("method") not in NO_METHODS and "psnr_clean_db" in row:
            names = [name for name, psnr_db in better.items() if psnr_db > row["psnr_clean_db"]]
            if names:
                found.append((row, sorted(names, key=lambda name: -better[name])))
    return found


def _case(row: dict) -> tuple:
    return row.get("target"), row.get("condition")


def _below(rows: list[dict]) -> list[str]:
    """Return the lines that say which trainings end below images without training, and why where the row says so."""
    lines = [
        f"- {row['method']}, {row['target']}, {row.get('condition', 'as taken')}, seed {row.get('seed', 0)}: "
        f"{row['psnr_clean_db']:.2f} dB, below {', '.join(names)}"
        + (f"; {row['why_below']}" if "why_below" in row else "")
        for row, names in ending_below(rows)
    ]
    return ["Trainings that end below an image without training:", "", *lines, ""] if lines else []


def _cell(values: list[float], form: str) -> str:
    """Return the mean of some values, with their deviation where there are several."""
    if not values:
        return ""
    mean = form.format(statistics.fmean(values))
    return mean if len(values) < 2 else f"{mean} ± {form.split(' ')[0].format(statistics.stdev(values))}"


def main() -> None:
    target = FOLDER / "RESULTS.md"
    target.write_text(page(sorted(FOLDER.glob("*.jsonl"))))
    print(target.relative_to(ROOT))


if __name__ == "__main__":
    main()
