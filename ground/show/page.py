"""Building blocks of a report's page: its style, sections, tables, and figures embedded in the one file."""

import base64
import html
from collections.abc import Iterable

import imagecodecs
import numpy as np
import plotly.graph_objects as go
import plotly.io
import yaml
from plotly.offline import get_plotlyjs

from ground.show.plots import INK

STYLE = """
:root { --ink: #1c2733; --soft: #5b6b7b; --line: #dde3ea; --card: #ffffff; }
* { box-sizing: border-box; }
body { margin: 0; background: #f3f5f8; color: var(--ink); font: 15px/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 19px; margin: 0 0 10px; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 20px 22px;
  margin-top: 20px; }
p.note { color: var(--soft); margin: 4px 0 14px; font-size: 13.5px; }
.cards { display: grid; grid-template-columns: repeat(4, 1fr); gap: 12px; }
.card { border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px; }
.card b { display: block; font-size: 23px; font-variant-numeric: tabular-nums; }
.card span { color: var(--soft); font-size: 13px; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
td, th { text-align: left; padding: 5px 10px; border-bottom: 1px solid var(--line); vertical-align: top; }
th.n { text-align: right; }
td.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.long { white-space: normal; }
.grid { display: grid; gap: 6px; }
.grid img { width: 100%; display: block; background: #000; border-radius: 3px; image-rendering: pixelated; }
.grid .label, .grid figcaption { overflow-wrap: anywhere; }
.grid .label { color: var(--soft); font-size: 13px; align-self: center; }
.grid figure { margin: 0; } .grid figcaption { color: var(--soft); font-size: 12px; text-align: center; }
details { margin: 10px 0; } summary { cursor: pointer; color: var(--soft); font-size: 13.5px; }
h3 { font-size: 15px; margin: 18px 0 8px; }
.scroll { overflow-x: auto; background:
  linear-gradient(to left, var(--card) 12px, transparent) right / 28px 100% no-repeat local,
  linear-gradient(to left, #1c273366, transparent) right / 14px 100% no-repeat scroll; }
.scores td, .scores th { white-space: nowrap; overflow-wrap: normal; padding: 5px 8px; }
.scores th { white-space: normal; vertical-align: bottom; } .scores th.n { min-width: 64px; }
.scores small { color: var(--soft); font-weight: normal; } .scores td.unrun { color: var(--soft); }
.scores td:first-child { white-space: normal; min-width: 130px; }
.map td:not(:first-child), .map th.n { text-align: center; } .map td small { color: inherit; }
.map td:not(:first-child) { border: 2px solid var(--card); }
.scores td.words { white-space: normal; min-width: 240px; }
.scores td:first-child, .scores th:first-child { position: sticky; left: 0; background: var(--card); }
.beside { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, var(--least)), 1fr)); gap: 0 16px; }
.beside > * { min-width: 0; }
.views { grid-template-columns: repeat(auto-fill, minmax(min(46%, 170px), 1fr)); }
.compared { grid-template-columns: minmax(0, 1.1fr) repeat(3, minmax(0, 1fr)); max-width: 840px; }
dl { display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: 4px 16px; margin: 8px 0;
  font-size: 13.5px; }
dt { color: var(--soft); } dd { margin: 0; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 18px; font-size: 13.5px; margin: 6px 0; }
.legend span::before { content: ""; display: inline-block; width: 12px; height: 12px; border-radius: 3px;
  background: var(--of); margin-right: 6px; vertical-align: -1px; }
.two { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 8px 32px; align-items: start; }
.ramp { display: inline-block; width: 90px; height: 10px; border-radius: 3px; margin: 0 6px;
  border: 1px solid var(--line); background: linear-gradient(90deg, #000, #f00, #ff0, #fff); }
ul.notes { background: #fff7e6; border: 1px solid #f0d9a8; border-radius: 8px; margin: 0 0 14px;
  padding: 10px 14px 10px 30px; }
pre { background: #f3f5f8; border-radius: 6px; padding: 12px; font-size: 12.5px; overflow-x: auto; margin: 0 0 12px; }
@media (max-width: 1170px) { .two { grid-template-columns: minmax(0, 1fr); } }
@media (max-width: 760px) {
  main { padding: 16px 8px 40px; } section { padding: 14px 12px; } h1 { font-size: 21px; overflow-wrap: anywhere; }
  .cards { grid-template-columns: minmax(0, 1fr); } .two > * { min-width: 0; }
  .card b { font-size: 20px; } td { padding: 5px 4px; overflow-wrap: anywhere; }
  td:first-child { overflow-wrap: break-word; }
  td.n { white-space: normal; overflow-wrap: normal; } .grid { gap: 3px; }
  .grid .label { font-size: 10px; } .grid figcaption { font-size: 9.5px; }
  dl { grid-template-columns: minmax(0, 1fr); } dd { margin: 0 0 6px; }
  .compared { grid-template-columns: repeat(3, minmax(0, 1fr)); }
  .scores td:first-child { overflow-wrap: normal; min-width: 32vw; } .scores td, .scores th { padding: 5px 4px; }
  .scores td.n { white-space: nowrap; } .scores td.words { min-width: 0; } .scores td.words div { width: 52vw; }
  .compared .label { grid-column: 1 / -1; font-size: 12px; margin-top: 8px; } .compared .head { display: none; }
}
"""

LONG = 24  # characters of a table's value that stay on one line

# while the page is read, a figure takes the room of those that will stand beside it
FITTED = (
    '<script>document.querySelectorAll(".js-plotly-plot").forEach(plot => Plotly.Plots.resize(plot))</script>'
)


def page(title: str, subtitle: str, sections: Iterable[str], plots: bool = True) -> str:
    """Return the whole page; title and subtitle are plain text, sections HTML; `plots`: some of them hold figures."""
    title = html.escape(title)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style>'
        f"{f'<script>{get_plotlyjs()}</script>' if plots else ''}</head><body><main><h1>{title}</h1>"
        f'<p class="note">{html.escape(subtitle)}</p>{"".join(sections)}</main>{FITTED if plots else ""}</body></html>'
    )


def section(title: str, note: str, body: str) -> str:
    """Return a section with a note under its title that says how to read it."""
    return f'<section><h2>{title}</h2><p class="note">{note}</p>{body}</section>'


def cards(entries: Iterable[tuple[str, str]]) -> str:
    """Return figures in large type, each with a sentence of what it means."""
    body = "".join(f'<div class="card"><b>{value}</b><span>{label}</span></div>' for value, label in entries)
    return f'<div class="cards">{body}</div>'


def two_tables(rows: list[tuple[str, str]]) -> str:
    """Return rows of label and value as two tables side by side, read down the left one first."""
    half = (len(rows) + 1) // 2
    while half < len(rows) and rows[half][0].startswith("…"):  # it belongs to the row before
        half += 1
    return f'<div class="two">{_table(rows[:half])}{_table(rows[half:])}</div>'


def _table(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table; values longer than a number with its error may take several lines, so that it fits its half."""
    cells = "".join(
        f'<tr><td>{html.escape(label)}</td><td class="n{" long" if len(value) > LONG else ""}">{value}</td></tr>'
        for label, value in rows
    )
    return f"<table>{cells}</table>"


def grid(columns: str, cells: list[str]) -> str:
    """Return cells in rows; `columns` are the widths as CSS has them."""
    return f'<div class="grid" style="grid-template-columns: {columns}">{"".join(cells)}</div>'


def beside(parts: Iterable[str], least_px: int = 420) -> str:
    """Return parts side by side where each has so much room, and one below another on a narrow screen."""
    cells = "".join(f"<div>{part}</div>" for part in parts)
    return f'<div class="beside" style="--least: {least_px}px">{cells}</div>'


def fold(title: str, body: str) -> str:
    """Return HTML that is seen when its title is clicked."""
    return f"<details><summary>{title}</summary>{body}</details>"


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """Return names, each with its colour before it, in as many lines as they need."""
    spans = "".join(f'<span style="--of: {colour}">{breakable(name)}</span>' for name, colour in entries)
    return f'<div class="legend">{spans}</div>'


def label(text: str) -> str:
    """Return a cell of a grid with text."""
    return f'<div class="label">{text}</div>'


def picture(image: np.ndarray, alt: str, caption: str) -> str:
    """Return an image of bytes [H, W, 3] with a caption, embedded as PNG."""
    png = imagecodecs.png_encode(np.ascontiguousarray(image), level=9)
    source = "data:image/png;base64," + base64.b64encode(bytes(png)).decode()
    return f'<figure><img alt="{alt}" src="{source}"><figcaption>{caption}</figcaption></figure>'


def breakable(name: str) -> str:
    """Return a name as HTML that needs no mid-word break: a new line may begin after each plus sign."""
    return html.escape(name).replace("+", "+<wbr>")


def unbroken(text: str) -> str:
    """Return text that stays in one line."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def plot(figure: go.Figure) -> str:
    """Return an interactive figure; the page holds Plotly itself."""
    figure.update_layout(template="plotly_white", font={"family": "system-ui, sans-serif", "color": INK})
    return plotly.io.to_html(
        figure,
        full_html=False,
        include_plotlyjs=False,
        config={"displaylogo": False, "displayModeBar": False, "responsive": True},
    )


def as_yaml(tree: dict) -> str:
    """Return settings as a block of YAML."""
    text = yaml.safe_dump(
        tree, sort_keys=False, default_flow_style=None if "method" in tree else False, width=80
    )
    return f"<pre>{html.escape(text)}</pre>"
