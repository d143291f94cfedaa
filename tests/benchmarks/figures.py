"""The figures of README and docs/measured.md, and the rows that each comes from: `python -m tests.benchmarks.figures`.

A paragraph or list item that holds figures ends with a comment, which a reader of the page does not see. It holds
the queries that give them, divided by semicolons, and after `given` the numbers that are conditions, not results. The
comment below a table has a line of queries for each of its rows.

    On TDRS 44.2 dB. <!-- rows: mean(six400, psnr, target="TDRS-400") -->

A query is an expression in Python of `mean`, `least`, `most` and the like, each with the name of a file of rows, the
key of a figure and what rows must hold. `psnr` and the like are short for keys, `o200` and the like for files. Rows are
those `as taken` and of all steps unless the query says otherwise; seeds are averaged first, then targets.
"""

import json
import re
import statistics
import sys
from collections.abc import Iterator
from functools import cache
from typing import Any

from tests.benchmarks.rows import FOLDER, ROOT

PAGES = (ROOT / "README.md", ROOT / "docs" / "measured.md")
COMMENT = re.compile(r"<!-- rows:(.*?)-->", re.DOTALL)
BELOW_A_TABLE = re.compile(r"<!-- rows of the table, a line each:\n(.*?)\n-->", re.DOTALL)
# what is no result: code, links' targets, comments, names of experiments, picture sizes and counts in words beside them
NO_FIGURE = re.compile(r"`[^`]*`|\]\([^)]*\)|\[\d{3}\]|<!--.*?-->|\d+x\d+|https?://\S+", re.DOTALL)
UNIT = r"(?:dB|%|s\b|Gaussians|times|degrees|pixels|px|of 6\b)"
FIGURE = re.compile(  # decimals, thousands, whole numbers before a unit or a further number with one, those of a table
    rf"(?<![\w.,])(\d[\d,]*\.\d+|\d{{1,3}}(?:,\d{{3}})+|\d+(?=(?:(?: to| and| or|,) \d+)* {UNIT})|(?<=\| )\d+(?= ))"
    r"(?!\w|\.\d)"
)
KEYS = {
    "psnr": "psnr_clean_db",
    "foreground": "psnr_foreground_db",
    "pooled": "psnr_clean_pooled_db",
    "settled": "psnr_clean_settled_db",
    "noisy": "psnr_noisy_db",
    "best": "psnr_best_db",
    "chamfer": "chamfer",
    "hausdorff": "hausdorff",
    "surface": "completeness_surface",
    "accuracy": "accuracy_surface",
    "f01": "f_01_surface",
    "f02": "f_02_surface",
    "chamfer_seen": "chamfer_surface",
    "mu": "psnr_mu_db",
    "to35": "seconds_to_35_db",
    "to38": "seconds_to_38_db",
    "to40": "seconds_to_40_db",
    "gaussians": "gaussians",
    "seconds": "seconds",
    "cpu": "cpu_seconds",
    "CHI2": "chi2_held_out_both",
    "tagged_px": "pose_error_tagged_px",
    "pose_px": "pose_error_px",
}
# the opponents of README's table at their best
AT_BEST = {
    "BEST_3DGS": "3dgs+exposure+hull+mask+l1+fast",
    "BEST_MIP": "mip-splatting+exposure+hull+mask+l1+fast",
}
FILES = {
    "o200": "opponents-200x200",
    "o400": "opponents-400x400",
    "six400": "six-targets-400x400",
    "o800": "paper-size-800x800",
    "frozen": "frozen-targets-200x200",
    "moving": "moving-sun-200x200",
    "stability": "stability-200x200",
    "robustness": "robustness-200x200",
    "drafts": "drafts-400x400",
    "foil": "foil-400x400",
    "sector": "sector-200x200",
    "breaks": "stability-100x100",
    "sky": "sky-100x100",
    "bars": "sky-bars-100x100",
    "camera": "camera-100x100",
    "best100": "best-100x100",
    "best200": "best-200x200",
    "cap200": "best-cap-200x200",
    "size": "size-200x200",
    "mesh": "mesh-400x400",
    "demo": "demo",
    "live": "live",
    "lego": "lego",
    "ngp": "instant-ngp-200x200",
    "bodies": "bodies",
    "brackets": "brackets",
    "poses": "poses",
    "photographs": "photographs",
    "rasterizer": "rasterizer",
}


def by_target(file: str, key: str, method: str | None = "obbgs", **where: Any) -> list[float]:
    """Return a figure of each target, the mean of its seeds; `where` holds what a row must say, None for anything."""
    asked = {"method": method, "condition": "as taken", "steps_share": 1.0} | where
    found: dict[str, list[float]] = {}
    for row in _rows(file):
        if all(value is None or row.get(name, value) == value for name, value in asked.items()):
            value = row.get(key)
            if value is not None:
                found.setdefault(row.get("target", ""), []).append(float(value))
    if not found:
        raise LookupError(f"no row of results/{file}.jsonl has {key} where {asked}")
    return [statistics.fmean(values) for values in found.values()]


def mean(file: str, key: str, method: str | None = "obbgs", **where: Any) -> float:
    """Return the mean over targets of the mean over seeds."""
    return statistics.fmean(by_target(file, key, method, **where))


def means(file: str, keys: str, method: str | None = "obbgs", **where: Any) -> list[float]:
    """Return the means of several figures, named in one text by their short names."""
    return [mean(file, KEYS[key], method, **where) for key in keys.split()]


def of_pass(keys: str, scenario: str = "") -> list[float]:
    """Return figures of a demo in front of the real sky, of one of the scenarios; `black`: of one without a sky."""
    sky = "realistic navigation errors" + ", real sky" * (scenario != "black")
    condition = sky if scenario in ("", "black") else f"scenario {scenario}, {sky}"
    return means("demo", keys, condition=condition)


def least(file: str, key: str, method: str | None = "obbgs", **where: Any) -> float:
    """Return the least of the targets' means over seeds."""
    return min(by_target(file, key, method, **where))


def most(file: str, key: str, method: str | None = "obbgs", **where: Any) -> float:
    """Return the largest of the targets' means over seeds."""
    return max(by_target(file, key, method, **where))


def best_of(file: str, key: str, *methods: str) -> list[float]:
    """Return a figure of each target, of the method that has most of it there."""
    return [max(values) for values in zip(*(by_target(file, key, m) for m in methods), strict=True)]


def reached(file: str, level_db: float, method: str = "obbgs") -> float:
    """Return on how many targets the curve of a method comes to a clean PSNR; `to38` is the mean of these alone."""
    return float(sum(value >= level_db for value in by_target(file, KEYS["best"], method)))


def line(file: str, method: str = "obbgs") -> list[float]:
    """Return a line of README's table: what the rows of a method hold of its columns, older ones less than all.

    Seconds are by the clock where none has processor time. The last is on how many targets 38 dB are reached, where
    that is not all or where it is not known how soon.
    """
    found: dict[str, list[float]] = {}
    for key in ("psnr", "foreground", "f01", "f02", "gaussians", "to38", "cpu", "seconds", "best"):
        try:
            found[key] = by_target(file, KEYS[key], method)
        except LookupError:
            continue
    found.pop("seconds" if "cpu" in found else "cpu", None)
    trained, soon = "best" in found, len(found.get("to38", ()))
    columns = [statistics.fmean(values) for key, values in found.items() if key != "best"]
    return [*columns, reached(file, 38, method)] if trained and soon < len(found["psnr"]) else columns


def blocks(page: str) -> Iterator[str]:
    """Yield the paragraphs, list items and lines of tables of a page, each with the comment of its queries."""
    page = re.sub(r"```.*?```", "", page, flags=re.DOTALL)
    parts = re.split(r"\n\s*\n", page)
    for part, following in zip(parts, [*parts[1:], ""], strict=True):
        if part.lstrip().startswith("|"):
            _, _, *lines = part.splitlines()  # without the titles and the line below them
            below = BELOW_A_TABLE.match(following)
            queries = below.group(1).splitlines() if below else [""] * len(lines)
            yield from (f"{line} <!-- rows: {query} -->" for line, query in zip(lines, queries, strict=True))
        elif not BELOW_A_TABLE.match(part):
            yield from re.split(r"(?m)^(?=- )", part)


def wrong(block: str) -> list[str]:
    """Return what is wrong with a block: figures that no query gives, and queries that give no figure of it."""
    comment = COMMENT.search(block)
    queries, _, given = (comment.group(1) if comment else "").partition("given")
    conditions = FIGURE.findall(given) + re.findall(r"[\d.,]*\d", given)
    figures = [text for text in FIGURE.findall(NO_FIGURE.sub("", block)) if text not in conditions]
    names: dict[str, Any] = {
        **{
            function.__name__: function
            for function in (by_target, best_of, mean, means, of_pass, least, most, reached, line)
        },
        **KEYS,
        **FILES,
        **AT_BEST,
        "__builtins__": {},
    }
    values = {}
    for query in filter(None, map(str.strip, queries.split(";"))):
        value = eval(query, names)  # our own pages, nobody else's
        values |= (
            {query: value} if isinstance(value, float) else {f"{query}[{i}]": v for i, v in enumerate(value)}
        )
    found = [
        f"{text} comes from no row" for text in figures if not any(_shows(text, v) for v in values.values())
    ]
    idle = [
        f"no figure shows {query} = {value:.6g}"
        for query, value in values.items()
        if not any(_shows(text, value) for text in figures)
    ]
    return found + idle


@cache
def _rows(file: str) -> list[dict[str, Any]]:
    from compare.charts.results import with_best

    return [
        with_best(json.loads(line)) for line in (FOLDER / f"{file}.jsonl").read_text().splitlines() if line
    ]


def _shows(text: str, value: float) -> bool:
    digits = text.replace(",", "")
    decimals = len(digits.partition(".")[2])
    return abs(float(digits) - value) <= 0.5 * 10**-decimals * (1 + 1e-9)


def main() -> None:
    """Print what is wrong with the figures of the pages; exit code 1 if anything is."""
    found = [
        (page, block, problems)
        for page in PAGES
        for block in blocks(page.read_text())
        if (problems := wrong(block))
    ]
    for page, block, problems in found:
        print(f"{page.relative_to(ROOT)}: {' '.join(block.split())[:90]}")
        print("".join(f"    {problem}\n" for problem in problems), end="")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
