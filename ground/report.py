"""A run as one HTML file that opens offline: figures, frames, errors, the model in 3D, and where every byte went."""

import base64
import html
import json
import math
from collections.abc import Iterable
from pathlib import Path

import imagecodecs
import numpy as np
import plotly.graph_objects as go
import plotly.io
import torch
import yaml
from plotly.offline import get_plotlyjs

from ground.card import chi2_explained, frames_captured, scored_frames
from ground.evaluate import Run, clean_image, open_run
from ground.plots import INK, histogram_figure, model_figure, training_figure
from ground.reconstruct import predicted_image, written_to
from ground.session import FrameRecord, SessionError
from ground.truth import Truth
from obbgs_base.files import write_whole
from obbgs_core.score.metrics import COMPLETENESS_RADIUS, psnr_db
from obbgs_core.sensor import Sensor

COLUMNS = 6  # brackets shown for each exposure
VIEWS_SHOWN = 3
MARGIN_PX = 10
ABOVE_BLACK = 0.01  # of full scale: brighter pixels are the target, as far as cropping goes
ERROR_FULL_SCALE = 0.1  # of full scale: shown as white

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
td.n { text-align: right; font-variant-numeric: tabular-nums; }
.grid { display: grid; gap: 6px; }
.grid img { width: 100%; display: block; background: #000; border-radius: 3px; image-rendering: pixelated; }
.grid .label { color: var(--soft); font-size: 13px; align-self: center; }
.grid figure { margin: 0; } .grid figcaption { color: var(--soft); font-size: 12px; text-align: center; }
h3 { font-size: 15px; margin: 18px 0 8px; }
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 8px 32px; align-items: start; }
.ramp { display: inline-block; width: 90px; height: 10px; border-radius: 3px; margin: 0 6px;
  border: 1px solid var(--line); background: linear-gradient(90deg, #000, #f00, #ff0, #fff); }
ul.notes { background: #fff7e6; border: 1px solid #f0d9a8; border-radius: 8px; margin: 0 0 14px;
  padding: 10px 14px 10px 30px; }
pre { background: #f3f5f8; border-radius: 6px; padding: 12px; font-size: 12.5px; overflow-x: auto; margin: 0 0 12px; }
"""


def write_report(session_dir: Path, name: str, out: Path | None = None) -> Path:
    """Write report.html into a run's folder and return its path; `out` is the folder of runs, if not the session's own.

    Raises:
        SessionError: no such session or run, or one that cannot be written to.
    """
    run = open_run(session_dir, name, out)
    truth = Truth(run.session) if Truth.exists(run.session) else None
    sections = [
        _headline(run, truth),
        _frames(run),
        _scored_views(run, truth),
        _model(run),
        _training(run),
        _histogram(run),
        _link(run),
        _simulation(truth),
        _configuration(run),
    ]
    title = (
        f"Reconstruction of {html.escape(run.session.path.resolve().parent.name)}, run {html.escape(name)}"
    )
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style>'
        f"<script>{get_plotlyjs()}</script></head><body><main><h1>{title}</h1>"
        f'<p class="note">Method {html.escape(str(run.metrics["method"]))}, {run.metrics["frames_received"]} frames '
        f"received, session of {html.escape(run.session.created_utc)}.</p>{''.join(sections)}</main></body></html>"
    )
    path = run.folder / "report.html"
    with written_to(run.folder):
        write_whole(path, page.encode())
    return path


def _section(title: str, note: str, body: str) -> str:
    return f'<section><h2>{title}</h2><p class="note">{note}</p>{body}</section>'


def _headline(run: Run, truth: Truth | None) -> str:
    m = run.metrics
    scored = scored_frames(m)
    cards: list[tuple[str, str]] = []
    if "psnr_clean_db" in m:
        cards.append((f"{m['psnr_clean_db']:.2f} dB", f"clean PSNR of {scored}, exposure known"))
    elif "psnr_noisy_db" in m:
        cards.append((f"{m['psnr_noisy_db']:.2f} dB", f"PSNR of {scored} against their noisy readings"))
    if "psnr_clean_blind_db" in m:
        gain_db = m["psnr_clean_db"] - m["psnr_clean_blind_db"]
        label = f"the same training blind to exposure (knowing it is worth {gain_db:+.2f} dB)"
        cards.append((f"{m['psnr_clean_blind_db']:.2f} dB", label))
    if "psnr_clean_foreground_db" in m:
        label = "clean PSNR of the foreground: the pixels that the target covers, without the sky"
        cards.append((f"{m['psnr_clean_foreground_db']:.2f} dB", label))
    if "chamfer" in m:
        cards.append((f"{m['chamfer']:.4f}", "Chamfer distance of the centres (largest dimension = 2)"))
    if "completeness_surface" in m:
        label = f"of the true surface lies within {COMPLETENESS_RADIUS} of the model's"
        cards.append((f"{m['completeness_surface']:.1f} %", label))
    cards.append((f"{m['gaussians']:,}", "Gaussians"))
    cards.append((f"{m['train_seconds']:.0f} s", f"training; {html.escape(m['stop_reason'])}"))
    cards.append((f"{m['frames_received']:,} / {frames_captured(m)}", "frames received / captured"))
    if m.get("onnx_bytes") is not None and m.get("onnx_parity_db") is not None:
        label = f"ONNX renderer against ours, worst of its views; {m['onnx_bytes'] / 1e6:.2f} MB"
        cards.append((f"{m['onnx_parity_db']:.0f} dB", label))
    if (chi2 := _finite(m.get("chi2"))) is not None:
        cards.append((f"{chi2:,.1f}", f"residual chi²: {chi2_explained(chi2)}"))
    body = "".join(f'<div class="card"><b>{value}</b><span>{label}</span></div>' for value, label in cards)
    seen = "of the very views it was trained on" if m["scored_frames"] == "training" else "never trained on"
    note = (
        f"Clean: against noiseless exposures of views {seen}, full scale = 1. Distances: in units where the target's "
        "largest dimension is 2."
        if truth
        else "No truth beside this session: figures are against the received frames themselves."
    )
    lines = [*m.get("notes", []), *(f"{k} is missing: {v}" for k, v in m.get("missing_outputs", {}).items())]
    notes = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    callout = f'<ul class="notes">{notes}</ul>' if notes else ""
    return _section("Result", note, f'{callout}<div class="cards">{body}</div>{_details(m, scored)}')


def _details(m: dict, scored: str) -> str:
    names = {
        "psnr_clean_db": "clean PSNR, dB",
        **{key: f"… at {_exposure_ms(key)} ms, dB" for key in m if _exposure_ms(key)},
        "psnr_clean_foreground_db": "… of the foreground, dB",
        "psnr_clean_blind_db": "… of the training blind to exposure, dB",
        "psnr_noisy_db": f"PSNR of {scored} against their noisy readings, dB",
        "psnr_radiance_db": "PSNR of scene-linear radiance (brightest = 1), dB",
        "ssim_clean": "SSIM, clean",
        "chamfer": "Chamfer distance of the centres",
        "chamfer_surface": "Chamfer distance of 100,000 surface points",
        "hausdorff": "Hausdorff distance of the centres",
        "accuracy": "mean distance of the centres to the true surface",
        "completeness": f"true points within {COMPLETENESS_RADIUS} of a centre, %",
        "completeness_surface": f"true points within {COMPLETENESS_RADIUS} of a surface point, %",
    }
    rows = [
        (label, f"{value:.4g}") for key, label in names.items() if (value := _finite(m.get(key))) is not None
    ]
    return f'<div style="margin-top:16px">{_two_tables(rows)}</div>'


def _finite(value: float | None) -> float | None:
    """Return a figure; None for one that was not measured or is not finite."""
    return value if value is not None and math.isfinite(value) else None


def _exposure_ms(key: str) -> str:
    """Return the exposure of a key such as psnr_clean_0.05ms_db; empty for other keys."""
    if not (key.startswith("psnr_clean_") and key.endswith("ms_db")):
        return ""
    return key.removeprefix("psnr_clean_").removesuffix("ms_db")


def _two_tables(rows: list[tuple[str, str]]) -> str:
    """Return rows of label and value as two tables side by side, read down the left one first."""
    half = (len(rows) + 1) // 2
    return f'<div class="two">{_table(rows[:half])}{_table(rows[half:])}</div>'


def _table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(
        f'<tr><td>{html.escape(label)}</td><td class="n">{value}</td></tr>' for label, value in rows
    )
    return f"<table>{cells}</table>"


def _frames(run: Run) -> str:
    exposures = sorted({r.exposure_time_s for r in run.session.frames})
    by_key = {(r.bracket, r.exposure_time_s): r for r in run.session.frames}
    picked = _spread(sorted({r.bracket for r in run.session.frames}), COLUMNS)
    cells = []
    for exposure_s in exposures:
        cells.append(f'<div class="label">{exposure_s * 1e3:g} ms</div>')
        for bracket in picked:
            record = by_key.get((bracket, exposure_s))
            if record is None:
                cells.append('<div class="label">missing</div>')
                continue
            caption = f"frame {record.id}, {_range_m(record):.0f} m"
            if record.saturated:
                caption += f"<br>{record.saturated:,} px saturated"
            cells.append(_picture(tone(_noisy_image(run, record), run.sensor), f"frame {record.id}", caption))
    return _section(
        "Frames by exposure",
        "As received: one column a bracket, one row an exposure time; below each its number and range. "
        "Brightness is the square root of the signal above black, full scale white.",
        _grid(f"60px repeat({len(picked)}, 1fr)", cells),
    )


def _scored_views(run: Run, truth: Truth | None) -> str:
    m = run.metrics
    records = [truth.posed(r) for r in run.scored] if truth else run.scored
    by_key = {(r.bracket, r.exposure_time_s): r for r in records}
    reference = "truth" if truth else "frame"
    names = [reference, "render", "error"] + (["blind render", "blind error"] if run.blind else [])
    views = _spread(sorted({r.bracket for r in run.scored}), VIEWS_SHOWN)
    body = []
    for bracket in views:
        of_view = [by_key[key] for key in sorted(by_key) if key[0] == bracket]
        expected = [
            clean_image(run, truth, r) if truth else torch.from_numpy(_noisy_image(run, r)) for r in of_view
        ]
        black = run.sensor.black_dn / run.sensor.white_dn
        box = bounding_box(expected[-1].mean(-1) > black + ABOVE_BLACK, MARGIN_PX)  # of the longest exposure
        cells = ['<div class="label"></div>', *(f'<div class="label">{name}</div>' for name in names)]
        for record, image in zip(of_view, expected, strict=True):
            cells.append(f'<div class="label">{record.exposure_time_s * 1e3:g} ms</div>')
            cells.append(_picture(tone(image[box].numpy(), run.sensor), reference, f"frame {record.id}"))
            models = [(run.gaussians, m.get("reference_exposure_s"))]
            if run.blind:
                models.append((run.blind, m["blind_reference_exposure_s"]))
            for gaussians, taken_for_s in models:
                exposure_s = taken_for_s or record.exposure_time_s
                render = predicted_image(gaussians, run.session, record, run.sensor, exposure_s)
                error = ((render - image).abs().mean(-1, keepdim=True) / ERROR_FULL_SCALE).clamp(0, 1)
                decibels = f"{psnr_db(render, image):.1f} dB"
                cells.append(_picture(tone(render[box].numpy(), run.sensor), "render", decibels))
                cells.append(_picture(heat(error[box].numpy()), "error", "&nbsp;"))
        body.append(f"<h3>Bracket {bracket}, {_range_m(of_view[0]):.0f} m</h3>")
        body.append(_grid(f"60px repeat({len(names)}, 1fr)", cells))
    training = m["scored_frames"] == "training"
    seen = "trained on: the session has too few brackets to hold one out" if training else "never trained on"
    note = (
        f"{len(views)} of {len({r.bracket for r in run.scored})} brackets, {seen}; cropped to the target. Brightness "
        f"as above. Error: absolute difference, 0<span class='ramp'></span>{ERROR_FULL_SCALE:.0%} of full scale or "
        f"more. PSNR is of the whole frame against the {'noiseless exposure' if truth else 'noisy frame'}."
    )
    if run.blind:
        note += " Blind: the same training with every exposure taken for their mean."
    title = "Training views (nothing was held out)" if training else "Held-out views"
    return _section(f"{title}: {reference}, render, error", note, "".join(body))


def _model(run: Run) -> str:
    figure, shown = model_figure(run.gaussians, run.session)
    ranges_m = [_range_m(record) for record in run.session.frames]
    note = (
        f"{shown:,} of {len(run.gaussians):,} Gaussians (the solid ones), target body frame. The camera's directions "
        f"are true but drawn at one range; flown ranges were {min(ranges_m):.0f} to {max(ranges_m):.0f} m. Drag to "
        "turn, scroll to zoom."
    )
    if "appearance" in run.metrics:
        note += (
            f" Radiance {html.escape(run.metrics['appearance'])}; the Sun's direction spans "
            f"{run.metrics['sun_span_deg']:.1f} degrees, and points are coloured by the mean over it."
        )
    return _section("Model and camera track", note, _plot(figure))


def _training(run: Run) -> str:
    path = run.folder / "metrics.jsonl"
    try:
        history = [json.loads(line) for line in path.read_text().splitlines()]
        if not history:
            return _section("Training", "No step was done: the model is its untrained start.", "")
        figure = training_figure(history)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SessionError(f"{path} is damaged: {error!r}") from error
    note = "Running mean over ten logged steps. The PSNR is of the noisy frames that the step trained on."
    if run.metrics["method"] == "obbgs":
        note += (
            " Early steps see averaged, less noisy pixels, so both curves jump where the resolution rises."
        )
    return _section("Training", note, _plot(figure))


def _histogram(run: Run) -> str:
    saturated = sum(r.saturated for r in run.session.frames)
    note = (
        f"All pixels of all received frames, logarithmic. {saturated:,} are saturated: the sensor says “at least this "
        "much”, and training takes them as that lower bound."
    )
    return _section("Exposure histogram", note, _plot(histogram_figure(run.session, run.sensor)))


def _link(run: Run) -> str:
    captured, received = run.metrics.get("frames_captured"), run.metrics["frames_received"]
    flight = run.session.flight
    if captured is None:  # frames are numbered from 0 without gaps, so a gap is a frame that never came
        missing = f"at least {run.session.frames[-1].id + 1 - received:,}"
    else:
        missing = f"{captured - received:,}"
    rows = [
        ("frames captured", frames_captured(run.metrics)),
        ("frames received", f"{received:,}"),
        ("frames missing", missing),
    ]
    if flight is not None:
        rows += [
            ("… deleted on board undelivered, to make room", f"{flight.frames_dropped:,}"),
            ("… refused on board: the store had no room", f"{flight.frames_refused:,}"),
            ("exposures that failed on board", f"{flight.frames_failed:,}"),
        ]
    rows.append(("bytes received", f"{run.session.bytes_received:,}"))
    rows += [(_spelled(key), f"{value:,}") for key, value in run.session.losses.items()]
    note = (
        "Captured: as flight's telemetry told when it was last heard, unknown where none was. The rest is what the "
        "ground counted: segments that were lost or damaged are asked for again, and counted as resent."
    )
    return _section("Losses on the link", note, _two_tables(rows))


def _simulation(truth: Truth | None) -> str:
    """Return what the simulator says it did; nothing without a simulator."""
    if truth is None or not truth.simulation:
        return ""
    rows = [
        (f"{part}: {_spelled(name)}", f"{value:,}" if isinstance(value, int) else html.escape(f"{value}"))
        for part, facts in truth.simulation.items()
        for name, value in facts.items()
    ]
    note = "The simulator's own record of scenario, camera, link and navigation; faults are counted in both directions."
    return _section("The simulated world", note, _two_tables(rows))


def _spelled(key: str) -> str:
    words = key.replace("_", " ").replace("crc", "CRC").replace("pdus", "PDUs")
    return words.replace("skipped bytes", "bytes skipped: in no good packet")


def _configuration(run: Run) -> str:
    path = run.folder / "config.yaml"
    try:
        config = yaml.safe_load(path.read_text())
        method = {"method": config.pop("method")}
    except (OSError, yaml.YAMLError, AttributeError, KeyError) as error:
        raise SessionError(f"{path} is damaged: {error!r}") from error
    camera = {"camera": vars(run.session.camera)}
    tles = {"tles": {name: list(lines) for name, lines in run.session.tles.items()}}
    body = f'<div class="two"><div>{_yaml(method)}</div><div>{_yaml(config)}{_yaml(camera)}</div></div>{_yaml(tles)}'
    return _section("Configuration and versions", "Everything needed to repeat the run.", body)


def _yaml(tree: dict) -> str:
    text = yaml.safe_dump(
        tree, sort_keys=False, default_flow_style=None if "method" in tree else False, width=80
    )
    return f"<pre>{html.escape(text)}</pre>"


def _spread(values: list[int], count: int) -> list[int]:
    """Return at most `count` of the values, evenly spread, first and last included."""
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))]


def _range_m(record: FrameRecord) -> float:
    return float(np.linalg.norm(record.position_body_m))


def _grid(columns: str, cells: list[str]) -> str:
    return f'<div class="grid" style="grid-template-columns: {columns}">{"".join(cells)}</div>'


def _picture(image: np.ndarray, alt: str, caption: str) -> str:
    return f'<figure><img alt="{alt}" src="{_png(image)}"><figcaption>{caption}</figcaption></figure>'


def _plot(figure: go.Figure) -> str:
    figure.update_layout(template="plotly_white", font={"family": "system-ui, sans-serif", "color": INK})
    return plotly.io.to_html(
        figure,
        full_html=False,
        include_plotlyjs=False,
        config={"displaylogo": False, "displayModeBar": False},
    )


def _noisy_image(run: Run, record: FrameRecord) -> np.ndarray:
    dn = run.session.dn(record).astype(np.float32)
    return dn.reshape(*dn.shape[:2], -1) / run.sensor.white_dn


def tone(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Return the square root of the signal above black, full scale white, as bytes [H, W, 3]."""
    black = sensor.black_dn / sensor.white_dn
    shown = np.sqrt(np.clip((image - black) / (1 - black), 0, 1))
    return np.broadcast_to((255 * shown).round().astype(np.uint8), (*image.shape[:2], 3))


def heat(error: np.ndarray) -> np.ndarray:
    """Return black-red-yellow-white for 0..1, as bytes [H, W, 3]."""
    shown = np.clip(3 * error - np.array([0.0, 1.0, 2.0]), 0, 1)
    return (255 * shown).round().astype(np.uint8)


def bounding_box(mask: torch.Tensor, margin_px: int) -> tuple[slice, slice]:
    """Return the rows and columns around a mask [H, W] with a margin; the whole image when it is empty."""
    rows, columns = torch.nonzero(mask.any(dim=1))[:, 0], torch.nonzero(mask.any(dim=0))[:, 0]
    if len(rows) == 0:
        return slice(None), slice(None)
    top, left = max(0, int(rows[0]) - margin_px), max(0, int(columns[0]) - margin_px)
    return slice(top, int(rows[-1]) + margin_px + 1), slice(left, int(columns[-1]) + margin_px + 1)


def _png(image: np.ndarray) -> str:
    png = imagecodecs.png_encode(np.ascontiguousarray(image), level=9)
    return "data:image/png;base64," + base64.b64encode(bytes(png)).decode()
