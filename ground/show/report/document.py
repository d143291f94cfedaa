"""A run's report: one HTML file that opens without a network, for the operators of the spacecraft."""

import html
import json
import math
from datetime import datetime
from pathlib import Path

from ground.run.card import (
    chi2_explained,
    frames,
    frames_captured,
    frames_received,
    is_imported,
    one_frame,
    readings,
    scored_frames,
)
from ground.run.runs import Run, open_run, read_config, written_to
from ground.session.cameras import median_sun_direction
from ground.session.folder import SessionError, pass_name, read_header
from ground.session.truth import Truth
from ground.show.page import as_yaml, beside, cards, fold, legend, page, plot, section, two_tables
from ground.show.plots import histogram_figure, training_figures
from ground.show.report.attitude import attitude_section
from ground.show.report.frames import brightness, frames_section, scored_section
from ground.show.report.poses import poses_section
from ground.show.report.sizes import sizes_section
from ground.show.report.sky import sky_section
from ground.show.splat_view import splat_view
from ground.show.telemetry_plots import broken_limits, housekeeping_series, telemetry_figures
from obbgs_base.errors import counted
from obbgs_base.files import write_whole
from obbgs_core.score.metrics import COMPLETENESS_RADIUS

TELEMETRY_PX = 280  # least width of a plot
DECISIONS = {  # of metrics.json
    "appearance": "the light of a Gaussian",
    "poses": "poses",
    "growth": "growth",
    "budget": "budget",
    "start": "start",
}


def write_report(session_dir: Path, name: str, out: Path | None = None) -> Path:
    """Write report.html into a run's folder and return its path; `out` is the folder of runs, if not the session's own.

    Raises:
        SessionError: no such session or run, or one that cannot be written to.
    """
    run = open_run(session_dir, name, out)
    truth = Truth(run.session) if Truth.exists(run.session) else None
    count, called = run.metrics["frames_received"], one_frame(is_imported(run.metrics))
    content = page(
        f"Reconstruction of {pass_name(run.session.path)}, run {name}",
        f"Method {run.metrics['method']}, {counted(count, called)}, session of "
        f"{datetime.fromisoformat(run.session.created_utc):%Y-%m-%d %H:%M} UTC.",
        [
            _model(run),
            _result(run, truth),
            sizes_section(run),
            frames_section(run),
            scored_section(run, truth),
            attitude_section(run),
            poses_section(run),
            _registration(run),
            _training(run),
            _histogram(run),
            sky_section(run),
            _losses(run),
            _telemetry(run),
            _simulation(truth),
            _configuration(run),
        ],
    )
    path = run.folder / "report.html"
    with written_to(run.folder):
        write_whole(path, content.encode())
    return path


def _result(run: Run, truth: Truth | None) -> str:
    m = run.metrics
    seen = (
        "that the model was also trained on"
        if m["scored_frames"] == "training"
        else "it was never trained on"
    )
    note = "PSNR tells how closely the model's images match real ones; 6 dB more halve the error. "
    note += (
        f"Clean figures compare the model with noiseless exposures of views {seen}, full scale as 1. Distances are in "
        "units where the target's largest dimension is 2."
        if truth
        else f"No simulator left a truth for this session, so the model is compared with "
        f"{'imported pictures' if is_imported(m) else 'received frames'} {seen}."
    )
    imported = read_header(run.session.path).get("imported_from")
    source = [] if imported is None else [f"Imported from {imported}."]
    lines = [
        *source,
        *m.get("notes", []),
        *(f"{k} is missing: {v}" for k, v in m.get("missing_outputs", {}).items()),
    ]
    notes = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    callout = f'<ul class="notes">{notes}</ul>' if notes else ""
    details = f'<div style="margin-top:16px">{two_tables(_details(m))}</div>'
    return section("Result", note, callout + cards(_main_figures(m)) + details)


def _main_figures(m: dict) -> list[tuple[str, str]]:
    """Return the most important figures, each with a sentence of what it means, as HTML."""
    scored = scored_frames(m)
    figures: list[tuple[str, str]] = []
    if "psnr_clean_db" in m:
        figures.append(
            (f"{m['psnr_clean_db']:.2f} dB", f"clean PSNR of {scored}, trained with exposure known")
        )
    elif "psnr_noisy_db" in m:
        text = f"PSNR of {scored} against {readings(is_imported(m))}"
        figures.append((f"{m['psnr_noisy_db']:.2f} dB", text))
    if "psnr_clean_foreground_db" in m:
        text = "clean PSNR of the foreground: only pixels that the target covers, without the easy black sky"
        figures.append((f"{m['psnr_clean_foreground_db']:.2f} dB", text))
    if "psnr_clean_blind_db" in m:
        gain_db = m["psnr_clean_db"] - m["psnr_clean_blind_db"]
        text = f"clean PSNR of {scored} trained without exposure times: knowing them brings {gain_db:+.2f} dB"
        figures.append((f"{m['psnr_clean_blind_db']:.2f} dB", text))
    if "chamfer" in m:
        text = (
            "Chamfer distance: mean distance between the Gaussians' centres and the true surface, both ways"
        )
        figures.append((f"{m['chamfer']:.4f}", text))
    if "completeness_surface" in m:
        text = f"of the true surface lies within {COMPLETENESS_RADIUS} of the model's surface"
        if "completeness_shown_surface" in m:
            text += (
                f"; {m['completeness_shown_surface']:.1f} % of the part that the frames show, which is "
                f"{m['surface_shown']:.0f} % of it"
            )
        figures.append((f"{m['completeness_surface']:.1f} %", text))
    words = "Gaussian makes up the model" if m["gaussians"] == 1 else "Gaussians make up the model"
    figures.append((f"{m['gaussians']:,}", words))
    figures.append(
        (f"{m['train_seconds']:.0f} s", f"of training; it ended with: {html.escape(m['stop_reason'])}")
    )
    figures.append(frames_received(m))
    if m.get("onnx_bytes") is not None and m.get("onnx_parity_db") is not None:
        text = f"agreement of the on-board ONNX renderer ({m['onnx_bytes'] / 1e6:.2f} MB) with ours, in its worst view"
        figures.append((f"{m['onnx_parity_db']:.0f} dB", text))
    if (chi2 := _finite(m.get("chi2"))) is not None:
        figures.append((f"{chi2:,.1f}", f"residual chi²: {chi2_explained(chi2)}"))
    return figures


def _details(m: dict) -> list[tuple[str, str]]:
    names = {
        "psnr_clean_db": "clean PSNR, dB",
        **{key: f"… at {_exposure_ms(key)} ms, dB" for key in m if _exposure_ms(key)},
        "psnr_clean_foreground_db": "… of the foreground, dB",
        "size_error_percent": "… the model is too large by, %",
        "similarity_psnr_clean_db": "… with the model's size corrected, dB",
        "psnr_clean_blind_db": "… of the training without exposure times, dB",
        "psnr_noisy_db": f"PSNR of {scored_frames(m)} against {readings(is_imported(m))}, dB",
        "psnr_srgb_db": "… of display values (sRGB), dB",
        "psnr_linear_db": "… of values that are linear in light, dB",
        "ssim_srgb": "SSIM of display values",
        "lpips_srgb": "LPIPS of display values (AlexNet, 0 is identical)",
        "psnr_radiance_db": "PSNR of scene-linear radiance (brightest pixel = 1), dB",
        "ssim_clean": "SSIM, clean (structural similarity, 1 is identical)",
        "chi2_held_out": f"residual chi² of {scored_frames(m)}: squared error over the variance of the noise",
        "chi2_held_out_both": "… over that of noise and the model's own error together (1: errors as large as stated)",
        "chamfer": "Chamfer distance of the centres",
        "chamfer_surface": "Chamfer distance of the points in surface.ply",
        "hausdorff": "Hausdorff distance of the centres (the largest error, both ways)",
        "accuracy": "mean distance from the centres to the true surface",
        "completeness": f"true surface within {COMPLETENESS_RADIUS} of a centre, %",
        "completeness_surface": f"true surface within {COMPLETENESS_RADIUS} of a point in surface.ply, %",
        "completeness_shown_surface": "… of the part that the frames show, %",
        "completeness_mesh": f"true surface within {COMPLETENESS_RADIUS} of model.glb, %",
        "completeness_shown_mesh": "… of the part that the frames show, %",
        "accuracy_mesh": "mean distance from model.glb to the true surface",
        "surface_shown": "part of the true surface of which each point by itself is above the noise of the frames, %",
    }
    return [
        (text, f"{value:.4g}") for key, text in names.items() if (value := _finite(m.get(key))) is not None
    ]


def _finite(value: float | None) -> float | None:
    """Return a figure; None for one that was not measured or is not finite."""
    return value if value is not None and math.isfinite(value) else None


def _exposure_ms(key: str) -> str:
    """Return the exposure of a key such as psnr_clean_0.05ms_db; empty for other keys."""
    if not (key.startswith("psnr_clean_") and key.endswith("ms_db")):
        return ""
    return key.removeprefix("psnr_clean_").removesuffix("ms_db")


def _model(run: Run) -> str:
    m, called = run.metrics, frames(is_imported(run.metrics))
    made_from = counted(m["frames_trained"], one_frame(is_imported(m)))
    note = (
        f"The target in 3D, made from {made_from} and drawn as the camera would see it at the chosen "
        f"{'brightness' if run.session.nominal_exposures else 'exposure'}. Drag to turn, wheel or pinch to zoom, shift "
        "and drag to move."
    )
    if m["scored_frames"] == "held_out":
        note += f" The next section says how well it matches {called} that it was not made from."
    decisions = [("made of", counted(len(run.gaussians), "Gaussian")), ("brightness", brightness(run))]
    if "appearance" in m and median_sun_direction(list(run.session.frames)) is not None:
        decisions.append(("the Sun's direction spans", f"{m['sun_span_deg']:.1f} degrees"))
    for key, words in DECISIONS.items():
        if m.get(key):
            decisions.append((words, html.escape(m[key])))
    details = "".join(f"<dt>{words}</dt><dd>{value}</dd>" for words, value in decisions)
    return section("Model", note, splat_view(run) + fold("What the training decided", f"<dl>{details}</dl>"))


def _registration(run: Run) -> str:
    """Return which photographs structure from motion registered; nothing for frames that came with their poses."""
    found = run.session.registration
    if found is None:
        return ""
    left_out = ", ".join(map(str, found["left_out"])) or "none"
    rows = [
        ("photographs registered", f"{len(run.session.frames):,}"),
        ("left out, because they could not be", html.escape(left_out)),
    ]
    if turned := found.get("turned"):
        rows.append(("turned by 180 degrees against the others", html.escape(", ".join(map(str, turned)))))
    note = (
        "Structure from motion found the cameras of these photographs. Their scale is unknown: one metre is the radius "
        "that holds nine tenths of the points."
    )
    return section("Registration", note, two_tables(rows))


def _training(run: Run) -> str:
    path = run.folder / "metrics.jsonl"
    try:
        history = [json.loads(line) for line in path.read_text().splitlines()]
        if not history:
            return section("Training", "No step was done: the model is its untrained start.", "")
        figures, named = training_figures(history)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SessionError(f"{path} is damaged: {error!r}") from error
    note = (
        "First the loss that training minimises, then the PSNR of each step's "
        f"{'pictures' if is_imported(run.metrics) else 'noisy frames'}. Both are running means; "
        "where they have levelled off, more steps would change little. Time counts from the start of the work: "
        "the curves begin when the model's first guess has been made."
    )
    if len(named) > 1:
        note += " Blind to exposure is the same training with every exposure time replaced by their mean."
    key = legend(named) if len(named) > 1 else ""
    return section("Training", note, key + beside(map(plot, figures)))


def _histogram(run: Run) -> str:
    saturated = sum(r.saturated for r in run.session.frames)
    nominal = run.session.nominal_exposures
    title, by_time = ("Histogram", "") if nominal else ("Exposure histogram", ", by exposure time")
    note = (
        f"How many pixels of all {frames(is_imported(run.metrics))} have which reading{by_time}; both the peak at the "
        f"black level and a pile at full scale carry little information. {counted(saturated, 'pixel')} "
        f"{'is' if saturated == 1 else 'are'} saturated: training "
        "takes such a reading as a lower bound of the light."
    )
    figure, named = histogram_figure(run.session, run.sensor, nominal)
    return section(title, note, legend(named) + plot(figure))


def _losses(run: Run) -> str:
    if run.session.frames_imported is not None:
        return ""  # nothing came over a link
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
            ("… deleted on board before delivery, to make room", f"{flight.frames_dropped:,}"),
            ("… refused on board: the store had no room", f"{flight.frames_refused:,}"),
            ("exposures that failed on board", f"{flight.frames_failed:,}"),
        ]
    rows.append(("bytes received", f"{run.session.bytes_received:,}"))
    rows += [(_spelled(key), f"{value:,}") for key, value in run.session.losses.items()]
    note = (
        "Where frames and bytes were lost between shutter and session. Frames captured is what the spacecraft's last "
        "telemetry said, unknown without telemetry; all else was counted on the ground. Lost or damaged segments are "
        "requested again and counted as resent."
    )
    return section("Losses on the link", note, two_tables(rows))


def _telemetry(run: Run) -> str:
    """Return the spacecraft's housekeeping over time; nothing where none was received."""
    series = housekeeping_series(run.session.path)
    if not series:
        return ""
    broken = ", ".join(f"{name.replace('_', ' ')} ({limit})" for name, limit in broken_limits(series))
    note = (
        f"Housekeeping over {series[0].seconds[-1]:.0f} s, {counted(len(series[0].seconds), 'packet')}. Values beyond "
        f"a limit of the telemetry dictionary are yellow or red, dotted lines are the limits. Limits were broken by: "
        f"{broken or 'none'}."
    )
    return section("Telemetry", note, beside(map(plot, telemetry_figures(series)), TELEMETRY_PX))


def _simulation(truth: Truth | None) -> str:
    """Return what the simulator recorded of its own work; nothing without a simulator."""
    if truth is None or not truth.simulation:
        return ""
    rows = [
        (f"{part}: {_with_unit(name)}", f"{value:,}" if isinstance(value, int) else html.escape(f"{value}"))
        for part, facts in truth.simulation.items()
        for name, value in facts.items()
    ]
    note = (
        "What the simulator recorded of its scenario, camera, link and navigation; link faults are counted in both "
        "directions."
    )
    return section("The simulated world", note, two_tables(rows))


def _with_unit(key: str) -> str:
    """Return a key in words, with a comma before its unit."""
    name, _, unit = key.rpartition("_")
    units = {"s": "s", "m": "m", "deg": "deg", "percent": "%"}
    return f"{_spelled(name)}, {units[unit]}" if name and unit in units else _spelled(key)


def _spelled(key: str) -> str:
    words = key.replace("_", " ").replace("crc", "CRC").replace("pdus", "PDUs")
    return words.replace("skipped bytes", "bytes skipped: in no good packet")


def _configuration(run: Run) -> str:
    config = read_config(run.folder)
    method = {"method": config.pop("method")}
    camera = {"camera": vars(run.session.camera)}
    tles = {"tles": {name: list(lines) for name, lines in run.session.tles.items()}}
    columns = f"<div>{as_yaml(method)}</div><div>{as_yaml(config)}{as_yaml(camera)}</div>"
    body = f'<div class="two">{columns}</div>{as_yaml(tles)}'
    return section("Configuration and versions", "Everything needed to repeat this run.", body)
