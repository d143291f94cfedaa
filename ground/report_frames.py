"""The report's pictures: the frames as they were received, and scored views beside the model's."""

import numpy as np
import torch

from ground.cameras import exposed, predicted_image
from ground.evaluate import clean_image
from ground.exposures import in_ms
from ground.page import grid, label, picture, section
from ground.pictures import ERROR_FULL_SCALE, bounding_box, heat, tone
from ground.runs import Run
from ground.session import FrameRecord
from ground.spread import evenly_spread
from ground.truth import Truth
from obbgs_core.score.metrics import psnr_db

LABEL_WIDTH = "minmax(0, 60px)"
COLUMNS = 6  # brackets shown for each exposure
VIEWS_SHOWN = 3
MARGIN_PX = 10
# of full scale: pixels that differ more from the background are target when pictures are cropped
ABOVE_EMPTY = 0.01


def frames_section(run: Run) -> str:
    nominal = run.session.nominal_exposures
    by_place = {(r.bracket, r.bracket_index): r for r in run.session.frames}
    picked = evenly_spread(sorted({r.bracket for r in run.session.frames}), COLUMNS)
    cells = []
    for place in sorted({r.bracket_index for r in run.session.frames}):
        row = [by_place.get((bracket, place)) for bracket in picked]
        times = {_exposure(run, record) for record in row if record is not None}
        is_same = len(times) == 1
        cells.append(label(*times) if is_same else label(f"exposure {place + 1}"))
        for record in row:
            if record is None:
                cells.append(label("missing"))
                continue
            caption = f"frame {record.id}" + ("" if nominal else f", {_range_m(record):.0f} m")
            if not is_same:
                caption += f", {_exposure(run, record)}"
            if record.saturated:
                caption += f"<br>{record.saturated:,} px saturated"
            cells.append(picture(_tone(run, _noisy_image(run, record)), f"frame {record.id}", caption))
    return section(
        "Pictures" if nominal else "Frames by exposure",
        f"{len(picked)} of the {len(run.session.frames):,} imported pictures, {_brightness(run)}."
        if nominal
        else "Frames as received: each column is a bracket, each row one of its exposures; below each frame stand its "
        "number, the range to the target and, where they differ in a row, the exposure time. "
        f"Brightness is {_brightness(run)}.",
        grid(f"{LABEL_WIDTH} repeat({len(picked)}, minmax(0, 1fr))", cells),
    )


def scored_section(run: Run, truth: Truth | None) -> str:
    records = [truth.posed(r) for r in run.scored] if truth else run.scored
    nominal, brackets = run.session.nominal_exposures, sorted({r.bracket for r in run.scored})
    shown = evenly_spread(brackets, VIEWS_SHOWN)
    body = []
    for bracket in shown:
        of_view = sorted((r for r in records if r.bracket == bracket), key=lambda r: r.exposure_time_s)
        named = f"Picture {of_view[0].id}" if nominal else f"Bracket {bracket}, {_range_m(of_view[0]):.0f} m"
        body.append(f"<h3>{named}</h3>")
        body.append(_compared(run, truth, of_view))
    training = run.metrics["scored_frames"] == "training"
    seen = "trained on: the session has too few brackets to hold one out" if training else "never trained on"
    note = (
        f"{len(shown)} of {len(brackets)} brackets, {seen}; cropped to the target, brightness as above. Error is the "
        f"absolute difference: 0<span class='ramp'></span>{ERROR_FULL_SCALE:.0%} of full scale or more. PSNR is of the "
        f"whole frame against the {'noiseless exposure' if truth else 'noisy frame'}."
    )
    if run.blind:
        note += " Blind: the same training with every exposure time replaced by their mean."
    title = "Training views (nothing was held out)" if training else "Held-out views"
    return section(f"{title}: {'truth' if truth else 'frame'}, render, error", note, "".join(body))


def _compared(run: Run, truth: Truth | None, of_view: list[FrameRecord]) -> str:
    """Return the frames of a bracket, shortest exposure first, beside the renders of each model and their errors."""
    reference = "truth" if truth else "frame"
    names = [reference, "render", "error"] + (["blind render", "blind error"] if run.blind else [])
    expected = [
        clean_image(run, truth, r) if truth else torch.from_numpy(_noisy_image(run, r)) for r in of_view
    ]
    background = torch.tensor(run.session.background)
    empty = exposed(background, run.sensor, of_view[-1].exposure_time_s)
    signal = expected[-1] - empty  # of the longest exposure
    if run.session.background:
        signal = signal.abs()
    box = bounding_box(signal.mean(-1) > ABOVE_EMPTY, MARGIN_PX)
    cells = [label(""), *(label(name) for name in names)]
    models = [(run.gaussians, run.metrics.get("reference_exposure_s"))]
    if run.blind:
        models.append((run.blind, run.metrics["blind_reference_exposure_s"]))
    for record, image in zip(of_view, expected, strict=True):
        cells.append(label(_exposure(run, record)))
        cells.append(picture(_tone(run, image[box].numpy()), reference, f"frame {record.id}"))
        for gaussians, reference_exposure_s in models:
            exposure_s = reference_exposure_s or record.exposure_time_s
            render = predicted_image(gaussians, run.session, record, run.sensor, exposure_s)
            error = ((render - image).abs().mean(-1, keepdim=True) / ERROR_FULL_SCALE).clamp(0, 1)
            caption = f"{psnr_db(render, image):.1f} dB"
            cells.append(picture(_tone(run, render[box].numpy()), "render", caption))
            cells.append(picture(heat(error[box].numpy()), "error", "&nbsp;"))
    return grid(f"{LABEL_WIDTH} repeat({len(names)}, minmax(0, 1fr))", cells)


def _exposure(run: Run, record: FrameRecord) -> str:
    """Return a frame's exposure time in words; nothing where it is made up."""
    return "" if run.session.nominal_exposures else f"{in_ms(record.exposure_time_s)} ms"


def _range_m(record: FrameRecord) -> float:
    return float(np.linalg.norm(record.position_body_m))


def _brightness(run: Run) -> str:
    """Return in words how pixel values become brightness on the page."""
    if run.session.encoding == "srgb":
        return "shown as they are"
    return "the square root of the signal above black, full scale is white"


def _tone(run: Run, image: np.ndarray) -> np.ndarray:
    return tone(image, run.sensor, run.session.encoding)


def _noisy_image(run: Run, record: FrameRecord) -> np.ndarray:
    """Return a frame as received [H, W, C], as a fraction of full scale."""
    dn = run.session.dn(record).astype(np.float32)
    return dn.reshape(*dn.shape[:2], -1) / run.sensor.white_dn
