"""The tables of a comparison's page: scores of methods, and the map of conditions and methods."""

import html
from collections.abc import Iterable

from compare.charts.results import VERDICTS, Metric, Results
from ground.show.page import breakable, fold

VERDICT_COLOURS = ("#2a9d8f", "#e9c46a", "#f4a261", "#d9dee3", "#c0392b", "#8795a5")  # of VERDICTS
DARK = ("holds", "fails", "refused")  # verdicts whose colour needs white letters
MAIN = (  # the columns that are seen at once; all others are behind a fold
    *("psnr_clean_db", "psnr_foreground_db", "psnr_noisy_db", "ssim_clean", "lpips"),
    *("psnr_srgb_db", "ssim_srgb", "lpips_srgb"),  # of pictures whose truth is not known
    *("f_01_surface", "f_02_surface", "gaussians", "bytes", "seconds"),
)


def score_table(results: Results, target: str | None) -> str:
    """Return the table of one target, or of the means over all; methods that were not run there are named below it.

    Its other figures are behind a fold, a row for each figure and a column for each method.
    """
    labels = results.labels if target is None else results.run_on(target)
    known = results.known(target)
    cells = {(name, metric.key): _cell(results, target, name, metric) for name in labels for metric in known}
    for metric in known:
        best = _best(results, labels, target, metric)
        for name in labels:
            value, text = cells[name, metric.key]
            cells[name, metric.key] = value, f"<b>{text}</b>" if value is not None and value == best else text
    shown = [metric for metric in known if metric.key in MAIN]
    lines = []
    for name in labels:
        reason = None if target is None else results.error(name, target, results.base)
        few = results.runs(name) if target is None and results.runs(name) < len(results.targets) else 0
        more = f" <small>({few} of {len(results.targets)} targets)</small>" if few else ""
        first = f"<td>{breakable(name)}{more}</td>"
        if reason is None:
            rest = "".join(f'<td class="n">{cells[name, m.key][1]}</td>' for m in shown)
        else:
            words = f"No result: {html.escape(reason.rstrip('.'))}."
            rest = f'<td class="words" colspan="{max(1, len(shown))}"><div>{words}</div></td>'
        lines.append(f"<tr>{first}{rest}</tr>")
    table = _table("method", [html.escape(m.title) for m in shown], lines)
    missing = [name for name in results.labels if name not in labels]
    if missing and target is not None:
        table += f'<p class="note">Not run on {html.escape(target)}: {_names(missing)}.</p>'
    if len(shown) == len(known):
        return table
    valued = [n for n in labels if any(cells[n, m.key][0] is not None for m in known)]
    lines = [
        f"<tr><td>{html.escape(m.title)}</td>"
        + "".join(f'<td class="n">{cells[n, m.key][1]}</td>' for n in valued)
        + "</tr>"
        for m in known
    ]
    everything = _table("figure", [breakable(name) for name in valued], lines)
    return table + fold(f"All {len(known)} figures", everything)


def failure_table(results: Results) -> str:
    """Return the map of conditions and methods, coloured by verdict, with the mean score in each cell.

    Conditions under which none of them was run are left out. References stand in it where nothing else was run.
    """
    labels = results.trained or results.labels
    refused = any(results.verdict(label, c)[0] == "refused" for label in labels for c in results.conditions)
    if not (results.trained or refused or len(results.conditions) > 1):
        return ""
    lines = []
    for condition in results.trained_conditions or results.conditions:
        row = "".join(_verdict_cell(results, label, condition) for label in labels)
        lines.append(f"<tr><td>{html.escape(condition)}</td>{row}</tr>")
    return _table("condition", [breakable(label) for label in labels], lines, "scores map") if lines else ""


def _verdict_cell(results: Results, label: str, condition: str) -> str:
    """Return the cell of a method under a condition, with its figures as a tip."""
    verdict, words = results.verdict(label, condition)
    if not verdict:
        return f'<td class="unrun">{results.unjudged(label, condition)}</td>'
    score, count = results.over_targets(label, condition, results.score.key)
    of = len(results.targets)
    text = verdict if score is None else f"{score:.1f}"
    text += f" <small>({count} of {of})</small>" if 0 < count < of else ""
    if label not in results.trained and verdict != "refused":
        return f'<td class="n">{text}</td>'
    ink = "#fff" if verdict in DARK else "inherit"
    colour = VERDICT_COLOURS[VERDICTS.index(verdict)]
    title = html.escape(f"{label}, {condition}: {verdict}; {words}")
    return f'<td title="{title}" style="background: {colour}; color: {ink}">{text}</td>'


def _cell(results: Results, target: str | None, name: str, metric: Metric) -> tuple[float | None, str]:
    """Return a method's mean of one figure and how it is written, with the deviation over seeds in a line below."""
    if target is None:
        mean, count = results.over_targets(name, results.base, metric.key)
        more = f"{count} of {len(results.targets)}" if 0 < count < results.runs(name) else ""
    else:
        mean = results.mean(name, target, results.base, metric.key)
        spread = results.spread(name, target, results.base, metric.key)
        more = "" if spread is None else f"± {metric.form.format(_scaled(metric, spread))}"
    if mean is None:
        return None, ""
    text = metric.form.format(_scaled(metric, mean))
    return mean, f"{text}<br><small>{more}</small>" if more else text


def _scaled(metric: Metric, value: float) -> float:
    return value / 1e3 if metric.key == "bytes" else value


def _best(results: Results, labels: list[str], target: str | None, metric: Metric) -> float | None:
    """Return the best value among methods that reconstruct something; of means, among those over most targets."""
    if metric.more_is_better is None:
        return None
    names = [name for name in labels if name in results.trained]
    if target is None:
        means = [results.over_targets(name, results.base, metric.key) for name in names]
        most = max((count for _, count in means), default=0)
        known = [mean for mean, count in means if mean is not None and count == most]
    else:
        found = [results.mean(name, target, results.base, metric.key) for name in names]
        known = [mean for mean in found if mean is not None]
    if not known:
        return None
    return max(known) if metric.more_is_better else min(known)


def _names(names: Iterable[str]) -> str:
    return ", ".join(map(breakable, names))


def _table(first: str, heads: Iterable[str], lines: Iterable[str], kind: str = "scores") -> str:
    """Return a table that scrolls sideways where it has no room, under the first column."""
    head = "".join(f'<th class="n">{words}</th>' for words in heads)
    rows = f"<tr><th>{first}</th>{head}</tr>{''.join(lines)}"
    return f'<div class="scroll"><table class="{kind}">{rows}</table></div>'
