"""The charts of README, drawn from the committed rows: `python -m tests.benchmarks.charts`.

Each says in its metadata of which rows it was drawn, so that a test can tell whether it is up to date.
"""

import hashlib
import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axis import XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from tests.benchmarks.rows import FOLDER, ROOT

Row = dict[str, Any]

DPI = 110
ROWS = "Rows"  # the key of a chart's metadata
AS_TAKEN = "as taken"
COLOURS = {
    "obbgs": "#c0392b",
    "nerf+exposure": "#2a6f97",
    "3dgs+affine": "#7a5195",
    "mip-splatting+exposure": "#2a9d8f",
    "3dgs+exposure": "#e9a23b",
}
REFERENCE = "#8795a5"
TARGET_COLOURS = {"TDRS-200": "#c0392b", "DSCOVR-200": "#2a6f97", "tumbling": "#2a9d8f", "v-bar": "#e9a23b"}
# of the conditions whose rows are drawn, the title
CONDITIONS = {
    AS_TAKEN: "105 frames, exposures 1:2:4",
    "24 frames": "24 frames",
    "12 frames": "12 frames",
    "noise x4": "four times the noise",
    "ratios 1:16:256": "exposures 1:16:256",
    "pose error 0.3 deg": "poses off by 0.3 degrees",
    "exposure error 10 %": "exposure times off by 10 %",
}


def speed() -> tuple[Figure, list[Row]]:
    """Return PSNR and Chamfer distance against processor time, the mean of the six targets, and the rows drawn."""
    rows = [row for row in _rows("opponents-200x200") if row["condition"] == AS_TAKEN and not row["seed"]]
    targets = {row["target"] for row in rows}
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    drawn = []
    for method, colour in COLOURS.items():
        found = [row for row in rows if row["method"] == method]
        if {row["target"] for row in found} != targets:
            continue
        drawn += found
        for axis, key in ((left, "psnr_clean_db"), (right, "chamfer")):
            seconds, values = _mean_curve(found, key)
            axis.plot(seconds, values, color=colour, lw=1.6)
            axis.plot(seconds[-1], values[-1], "D", color=colour, label=method)
    for method, title in (("black", "black image"), ("noise", "the noisy views themselves")):
        found = [row for row in rows if row["method"] == method]
        drawn += found
        value = statistics.fmean(row["psnr_clean_db"] for row in found)
        left.axhline(value, color=REFERENCE, ls="--", lw=0.8)
        left.annotate(
            title, (0.01, value), xycoords=("axes fraction", "data"), va="bottom", color=REFERENCE, fontsize=8
        )
    left.set(title="clean PSNR, dB", xscale="log", xlabel="seconds of one processor core")
    right.set(title="Chamfer distance", xscale="log", yscale="log", xlabel="seconds of one processor core")
    for axis in (left, right):
        _ticks_1_2_5(axis.xaxis)
        axis.grid(alpha=0.3)
    _ticks_1_2_5(right.yaxis)
    figure.legend(
        *left.get_legend_handles_labels(), fontsize=9, loc="outside lower center", ncols=len(COLOURS)
    )
    return figure, drawn


def failures() -> tuple[Figure, list[Row]]:
    """Return the PSNR of methods on TDRS as the passes become worse, beside images without training, and the rows."""
    rows = [row for row in _rows("stability-200x200") if row["target"] == "TDRS-200"]
    rows += [row for row in _rows("opponents-200x200") if row["target"] == "TDRS-200" and not row["seed"]]
    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axis, drawn = figure.subplots(), []
    for y, condition in enumerate(CONDITIONS):
        of_it = {row["method"]: row for row in rows if row["condition"] == condition}
        references = [of_it[method] for method in ("black", "mean")]
        drawn += references
        best = max(row["psnr_clean_db"] for row in references)
        axis.plot([best, best], [y - 0.35, y + 0.35], color=REFERENCE, lw=3, solid_capstyle="butt")
        for place, (method, colour) in enumerate(COLOURS.items()):
            if method in of_it:
                drawn.append(of_it[method])
                name = method if condition == AS_TAKEN else None
                beside = y + 0.12 * (place - 2)  # equal ones do not hide each other
                axis.plot(of_it[method]["psnr_clean_db"], beside, "o", color=colour, label=name, ms=7)
        axis.axhline(y, color="0.9", lw=0.8, zorder=0)
    axis.set_yticks(range(len(CONDITIONS)), list(CONDITIONS.values()), fontsize=9)
    axis.invert_yaxis()
    axis.set(xlabel="clean PSNR of held-out views, dB", title="Where methods fail (TDRS)")
    axis.grid(axis="x", alpha=0.3)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    return figure, drawn


def size() -> tuple[Figure, list[Row]]:
    """Return PSNR against the number of Gaussians, by budgets and as chosen, beside other methods, and the rows."""
    of_obbgs = [row for row in _rows("size-200x200") if not row["seed"]]
    opponents = [
        row
        for row in _rows("opponents-200x200")
        if row["target"] in TARGET_COLOURS and row["condition"] == AS_TAKEN and not row["seed"]
    ]
    opponents = [
        row
        for row in opponents
        if row["method"] in COLOURS and row["method"] != "obbgs" and "gaussians" in row
    ]
    figure = Figure(figsize=(5.4, 4.0), layout="constrained")
    axis = figure.subplots()
    for target, colour in TARGET_COLOURS.items():
        asked = sorted(
            (row["gaussians"], row["psnr_clean_db"])
            for row in of_obbgs
            if row["target"] == target and "largest" in row
        )
        axis.plot(
            *zip(*asked, strict=True), "o-", color=colour, ms=3, lw=1.2, label=target.removesuffix("-200")
        )
        (chosen,) = (row for row in of_obbgs if row["target"] == target and "largest" not in row)
        axis.plot(chosen["gaussians"], chosen["psnr_clean_db"], "*", color=colour, ms=13, mec="white")
        for row in opponents:
            if row["target"] == target:
                axis.plot(row["gaussians"], row["psnr_clean_db"], "x", color=colour, ms=6)
    axis.set(xscale="log", xlabel="Gaussians", ylabel="clean PSNR, dB", title="Quality against size")
    _ticks_1_2_5(axis.xaxis)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure, of_obbgs + opponents


# name of the file in docs/ and the function that draws it
CHARTS: dict[str, Callable[[], tuple[Figure, list[Row]]]] = {
    "speed": speed,
    "failures": failures,
    "size": size,
}


def digest(rows: Sequence[Row]) -> str:
    """Return the SHA-256 of some rows."""
    return hashlib.sha256("".join(json.dumps(row, sort_keys=True) for row in rows).encode()).hexdigest()


def drawn_from(path: Path) -> str | None:
    """Return the digest of the rows that a chart was drawn from; None where it does not say."""
    with Image.open(path) as image:
        return image.info.get(ROWS)


def _rows(name: str) -> list[Row]:
    return [json.loads(line) for line in (FOLDER / f"{name}.jsonl").read_text().splitlines()]


def _mean_curve(rows: Sequence[Row], key: str) -> tuple[list[float], list[float]]:
    """Return seconds and value at the shares of the work that the curves of all rows have, as means over the rows.

    Seconds are of the processor where a row knows how many of all its seconds it had.
    """
    shares = set.intersection(*({p["share"] for p in row["curve"] if key in p} for row in rows))
    seconds, values = [], []
    for share in sorted(shares):
        points = [(row, next(p for p in row["curve"] if p["share"] == share)) for row in rows]
        used = [p["seconds"] * row.get("cpu_seconds", row["seconds"]) / row["seconds"] for row, p in points]
        seconds.append(statistics.fmean(used))
        values.append(statistics.fmean(p[key] for _, p in points))
    return seconds, values


def _ticks_1_2_5(side: XAxis | YAxis) -> None:
    """Label a logarithmic axis at 1, 2 and 5 times powers of ten only; Matplotlib's own labels overlap."""
    side.set_major_locator(LogLocator(subs=(1, 2, 5)))
    side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    side.set_minor_formatter(NullFormatter())


def main() -> None:
    for name, draw in CHARTS.items():
        figure, rows = draw()
        path = ROOT / "docs" / f"{name}.png"
        figure.savefig(path, dpi=DPI, metadata={ROWS: digest(rows)})
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
