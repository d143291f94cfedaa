"""A run as one HTML file that opens offline: figures, frames, errors, the model in 3D, and where every byte went."""

import base64
import html
import json
from pathlib import Path

import imagecodecs
import numpy as np
import plotly.graph_objects as go
import plotly.io
import torch
import yaml
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from ground.evaluate import Run, Truth, bounding_box, clean_image, open_run
from ground.reconstruct import predicted_image
from ground.session import FrameRecord, write_whole
from obbgs_core import sh
from obbgs_core.sensor import Sensor

COLUMNS = 6  # brackets shown for each exposure
TRIPLE_VIEWS = 3
MARGIN_PX = 10
POINTS_SHOWN = 15_000
ERROR_FULL_SCALE = 0.1  # of full scale: shown as white
INK, ACCENT, WARM = "#1c2733", "#1f6feb", "#d1652a"
EXPOSURE_COLOURS = ("#1f6feb", "#2a9d8f", "#d1652a", "#8e44ad", "#c0392b")

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
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 24px; }
pre { background: #f3f5f8; border-radius: 6px; padding: 12px; font-size: 12.5px; overflow-x: auto; margin: 0; }
"""


def write_report(session_dir: Path, name: str) -> Path:
    """Write report.html into a run's folder and return its path.

    Raises:
        SessionError: no such session or run.
    """
    run = open_run(session_dir, name)
    truth = Truth(run.session) if Truth.exists(run.session) else None
    history = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    sections = [
        _headline(run, truth),
        _frames(run),
        _triples(run, truth),
        _model(run),
        _training(history),
        _histogram(run),
        _link(run),
        _configuration(run),
    ]
    title = (
        f"Reconstruction of {html.escape(run.session.path.resolve().parent.name)}, run {html.escape(name)}"
    )
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style>'
        f"<script>{get_plotlyjs()}</script></head><body><main><h1>{title}</h1>"
        f'<p class="note">{run.metrics["method"]} on {run.metrics["frames_received"]} frames received, session of '
        f"{html.escape(run.session.created_utc)}</p>{''.join(sections)}</main></body></html>"
    )
    path = run.folder / "report.html"
    write_whole(path, page.encode())
    return path


def _section(title: str, note: str, body: str) -> str:
    return f'<section><h2>{title}</h2><p class="note">{note}</p>{body}</section>'


def _headline(run: Run, truth: Truth | None) -> str:
    m = run.metrics
    cards: list[tuple[str, str]] = []
    if "psnr_clean_db" in m:
        cards.append((f"{m['psnr_clean_db']:.2f} dB", "clean held-out PSNR, exposure known"))
    if "psnr_clean_blind_db" in m:
        gain = m["psnr_clean_db"] - m["psnr_clean_blind_db"]
        cards.append(
            (
                f"{m['psnr_clean_blind_db']:.2f} dB",
                f"the same training blind to exposure ({gain:+.2f} dB gained)",
            )
        )
    elif "psnr_noisy_db" in m:
        cards.append((f"{m['psnr_noisy_db']:.2f} dB", "held-out PSNR against the noisy frames"))
    if "chamfer" in m:
        cards.append((f"{m['chamfer']:.4f}", "Chamfer distance of the centres (largest dimension = 2)"))
        cards.append((f"{m['completeness_surface']:.1f} %", "of the true surface within 0.01 of the model's"))
    cards.append((f"{m['gaussians']:,}", "Gaussians"))
    cards.append((f"{m['train_seconds']:.0f} s", f"training; {html.escape(m['stop_reason'])}"))
    cards.append((f"{m['frames_received']} / {m['frames_captured']}", "frames received / captured"))
    cards.append(
        (f"{m['onnx_parity_db']:.0f} dB", f"ONNX renderer against ours, {m['onnx_bytes'] / 1e6:.2f} MB")
    )
    body = "".join(f'<div class="card"><b>{value}</b><span>{label}</span></div>' for value, label in cards)
    note = (
        "Clean: against noiseless exposures of views that were never trained on, full scale = 1."
        if truth
        else "No truth beside this session: figures are against the received frames themselves."
    )
    table = _details(m)
    return _section("Result", note, f'<div class="cards">{body}</div>{table}')


def _details(m: dict) -> str:
    names = {
        "psnr_noisy_db": "PSNR against the noisy held-out frames, dB",
        "psnr_clean_foreground_db": "clean PSNR inside the target's bounding box, dB",
        "psnr_radiance_db": "PSNR of scene-linear radiance (brightest = 1), dB",
        "ssim_clean": "SSIM, clean",
        "chamfer_surface": "Chamfer distance of 100,000 surface points",
        "hausdorff": "Hausdorff distance of the centres",
        "accuracy": "mean distance of the centres to the true surface",
        "completeness": "true points within 0.01 of a centre, %",
        "chi2": "residual chi² where the model is (1 is noise)",
    }
    rows = [(label, m[key]) for key, label in names.items() if key in m]
    rows += [
        (f"clean PSNR at {key.removeprefix('psnr_clean_').removesuffix('ms_db')} ms, dB", value)
        for key, value in m.items()
        if key.startswith("psnr_clean_") and key.endswith("ms_db")
    ]
    cells = "".join(
        f'<tr><td>{html.escape(label)}</td><td class="n">{value:.4g}</td></tr>' for label, value in rows
    )
    return f'<table style="margin-top:16px">{cells}</table>'


def _frames(run: Run) -> str:
    exposures = sorted({r.exposure_time_s for r in run.session.frames})
    brackets = sorted({r.bracket for r in run.session.frames})
    picked = [brackets[i] for i in np.unique(np.linspace(0, len(brackets) - 1, COLUMNS).round().astype(int))]
    cells = []
    for exposure_s in exposures:
        cells.append(f'<div class="label">{exposure_s * 1e3:g} ms</div>')
        for bracket in picked:
            record = next(
                (r for r in run.session.frames if r.bracket == bracket and r.exposure_time_s == exposure_s),
                None,
            )
            if record is None:
                cells.append('<div class="label">missing</div>')
                continue
            image = _noisy_image(run, record)
            range_m = float(np.linalg.norm(record.position_body_m))
            cells.append(
                f'<figure><img alt="frame {record.id}" src="{_png(tone(image, run.sensor))}">'
                f"<figcaption>frame {record.id}, {range_m:.0f} m, {record.saturated} saturated</figcaption></figure>"
            )
    grid = f'<div class="grid" style="grid-template-columns: 60px repeat({len(picked)}, 1fr)">{"".join(cells)}</div>'
    return _section(
        "Frames by exposure",
        "As received, one column a bracket, one row an exposure time. Shown as the square root of the signal.",
        grid,
    )


def _triples(run: Run, truth: Truth | None) -> str:
    exposures = sorted({r.exposure_time_s for r in run.held_out})
    brackets = sorted({r.bracket for r in run.held_out})
    views = [
        brackets[i] for i in np.unique(np.linspace(0, len(brackets) - 1, TRIPLE_VIEWS).round().astype(int))
    ]
    names = ["truth" if truth else "frame", "render", "error"]
    cells = ['<div class="label"></div>', *(f'<div class="label">{n}</div>' for _ in views for n in names)]
    for exposure_s in exposures:
        cells.append(f'<div class="label">{exposure_s * 1e3:g} ms</div>')
        for bracket in views:
            record = next(
                (r for r in run.held_out if (r.bracket, r.exposure_time_s) == (bracket, exposure_s)), None
            )
            if record is None:
                cells += ['<div class="label">missing</div>'] * 3
                continue
            seen_at_s = run.metrics.get("reference_exposure_s") or exposure_s
            render = predicted_image(run.gaussians, run.session, record, run.sensor, seen_at_s)
            expected = (
                clean_image(run, truth, record) if truth else torch.from_numpy(_noisy_image(run, record))
            )
            black = run.sensor.black_dn / run.sensor.white_dn
            box = bounding_box(expected.mean(-1) > black + 0.01, MARGIN_PX)
            error = ((render - expected).abs().mean(-1, keepdim=True) / ERROR_FULL_SCALE).clamp(0, 1)
            for image in (
                tone(expected[box].numpy(), run.sensor),
                tone(render[box].numpy(), run.sensor),
                heat(error[box].numpy()),
            ):
                cells.append(f'<figure><img alt="frame {record.id}" src="{_png(image)}"></figure>')
    columns = f"60px repeat({3 * len(views)}, 1fr)"
    grid = f'<div class="grid" style="grid-template-columns: {columns}; align-items: center">{"".join(cells)}</div>'
    return _section(
        "Held-out views: truth, render, error",
        f"{len(views)} brackets that were never trained on, cropped to the target. Square-root scale; the error is the "
        f"absolute difference, white at {ERROR_FULL_SCALE:.0%} of full scale.",
        grid,
    )


def _model(run: Run) -> str:
    g = run.gaussians
    solid = torch.nonzero(g.opacities > 0.2)[:, 0]
    if len(solid) > POINTS_SHOWN:
        solid = solid[torch.randperm(len(solid), generator=torch.Generator().manual_seed(0))[:POINTS_SHOWN]]
    radiance = sh.radiance(g.sh[solid, :1], torch.zeros(len(solid), 3)).mean(dim=1).numpy()
    points = g.means[solid].numpy()
    reach_m = float(np.quantile(np.linalg.norm(points, axis=1), 0.995)) if len(points) else 1.0
    figure = go.Figure()
    figure.add_scatter3d(
        x=points[:, 0],
        y=points[:, 1],
        z=points[:, 2],
        mode="markers",
        name="Gaussian centres",
        marker={
            "size": 1.8,
            "color": np.sqrt(radiance),
            "colorscale": "Cividis",
            "colorbar": {"title": {"text": "√radiance"}, "thickness": 12, "len": 0.6},
        },
        hovertemplate="%{x:.2f}, %{y:.2f}, %{z:.2f} m<extra></extra>",
    )
    frames = sorted(run.session.frames, key=lambda r: r.mid_exposure_utc_ns)
    centres = np.array([r.position_body_m for r in frames])
    ranges_m = np.linalg.norm(centres, axis=1)
    shown = (
        centres / ranges_m[:, None] * reach_m * 2.2
    )  # true directions at one drawn range: the track is far away
    figure.add_scatter3d(
        x=shown[:, 0],
        y=shown[:, 1],
        z=shown[:, 2],
        mode="markers",
        name="camera directions",
        marker={"size": 3, "color": WARM},
        text=[f"frame {r.id}, {d:.0f} m" for r, d in zip(frames, ranges_m, strict=True)],
        hovertemplate="%{text}<extra></extra>",
    )
    sun = np.mean([r.sun_dir_body for r in frames], axis=0) * reach_m * 2.2
    figure.add_scatter3d(
        x=[0, sun[0]],
        y=[0, sun[1]],
        z=[0, sun[2]],
        mode="lines",
        name="to the Sun",
        line={"color": "#e0a100", "width": 4},
    )
    figure.update_layout(
        scene={"aspectmode": "data", "xaxis_title": "x, m", "yaxis_title": "y, m", "zaxis_title": "z, m"},
        height=560,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        legend={"x": 0, "y": 1},
        scene_camera={"eye": {"x": 0.9, "y": 0.9, "z": 0.6}},
    )
    note = (
        f"{len(points):,} of {len(g):,} Gaussians, body frame. Camera directions are true, drawn at one range; flown "
        f"ranges were {ranges_m.min():.0f} to {ranges_m.max():.0f} m. Drag to turn, scroll to zoom."
    )
    return _section("Model and camera track", note, _plot(figure))


def _training(history: list[dict]) -> str:
    figure = make_subplots(rows=1, cols=2, subplot_titles=("loss", "PSNR of the step's frames, dB"))
    for label, colour in (("known exposure", ACCENT), ("blind to exposure", WARM)):
        rows = [h for h in history if h["training"] == label]
        if not rows:
            continue
        seconds = [h["seconds"] for h in rows]
        for column, key in ((1, "loss"), (2, "psnr_db")):
            figure.add_scatter(
                x=seconds,
                y=_smooth([h[key] for h in rows]),
                name=label,
                line={"color": colour, "width": 2},
                showlegend=column == 1,
                row=1,
                col=column,
            )
    figure.update_yaxes(type="log", row=1, col=1)
    figure.update_xaxes(title_text="seconds")
    figure.update_layout(
        height=360, margin={"l": 50, "r": 20, "t": 40, "b": 45}, legend={"orientation": "h", "y": -0.2}
    )
    return _section(
        "Training",
        "Running mean over ten logged steps. Steps before 40 % of the way are at reduced resolution, where averaging "
        "suppresses noise, so PSNR jumps when the resolution changes.",
        _plot(figure),
    )


def _histogram(run: Run) -> str:
    figure = go.Figure()
    edges = np.linspace(0, run.sensor.white_dn + 1, 129)
    for index, exposure_s in enumerate(sorted({r.exposure_time_s for r in run.session.frames})):
        counts = np.zeros(128)
        for record in run.session.frames:
            if record.exposure_time_s == exposure_s:
                counts += np.histogram(run.session.dn(record), edges)[0]
        figure.add_scatter(
            x=(edges[:-1] + edges[1:]) / 2,
            y=np.where(counts > 0, counts, np.nan),
            name=f"{exposure_s * 1e3:g} ms",
            mode="lines",
            line={"shape": "hvh", "width": 2, "color": EXPOSURE_COLOURS[index % len(EXPOSURE_COLOURS)]},
        )
    for level, label in ((run.sensor.black_dn, "black"), (run.sensor.white_dn, "full scale")):
        figure.add_vline(x=level, line={"dash": "dot", "color": "#8795a5"}, annotation_text=label)
    figure.update_yaxes(type="log", title_text="pixels")
    figure.update_xaxes(title_text="digital number")
    figure.update_layout(height=340, margin={"l": 60, "r": 20, "t": 30, "b": 45})
    saturated = sum(r.saturated for r in run.session.frames)
    note = (
        f"All received frames. {saturated:,} saturated pixels; they count only as a lower bound in training."
    )
    return _section("Exposure histogram", note, _plot(figure))


def _link(run: Run) -> str:
    captured, received = run.metrics["frames_captured"], run.metrics["frames_received"]
    rows = [
        ("frames captured (by their numbers)", captured),
        ("frames received", received),
        ("frames missing", captured - received),
        ("bytes received", run.session.bytes_received),
        *((key.replace("_", " "), value) for key, value in run.session.losses.items()),
    ]
    cells = "".join(f'<tr><td>{html.escape(k)}</td><td class="n">{v:,}</td></tr>' for k, v in rows)
    note = "What the ground counted. Segments that were lost or damaged were asked for again."
    return _section("Link", note, f"<table>{cells}</table>")


def _configuration(run: Run) -> str:
    config = (run.folder / "config.yaml").read_text()
    camera = yaml.safe_dump({"camera": vars(run.session.camera)}, sort_keys=False)
    tles = yaml.safe_dump({"tles": {k: list(v) for k, v in run.session.tles.items()}}, sort_keys=False)
    body = f'<div class="two"><pre>{html.escape(config)}</pre><pre>{html.escape(camera + tles)}</pre></div>'
    return _section("Configuration and versions", "Everything needed to repeat the run.", body)


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


def _png(image: np.ndarray) -> str:
    png = imagecodecs.png_encode(np.ascontiguousarray(image), level=9)
    return "data:image/png;base64," + base64.b64encode(bytes(png)).decode()


def _smooth(values: list[float], window: int = 10) -> list[float]:
    total = np.cumsum([0.0, *values])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    return ((total[ends] - total[starts]) / (ends - starts)).tolist()
