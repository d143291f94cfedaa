"""The report's pictures: the frames as they were received, and scored views beside the model's."""

from collections.abc import Iterator

import numpy as np
import torch

from ground.run.card import frames, is_imported, one_frame
from ground.run.estimated_poses import as_estimated, read_estimate, scored_records
from ground.run.evaluate import clean_image, model_image, noisy_image
from ground.run.runs import Run
from ground.session.cameras import exposed, predicted_image, range_in_words
from ground.session.exposures import in_ms
from ground.session.folder import FrameRecord
from ground.session.spread import evenly_spread
from ground.session.truth import Truth
from ground.show.page import grid, label, picture, section, unbroken
from ground.show.pictures import ERROR_FULL_SCALE, bounding_box, heat, tone
from ground.show.sizes import states_scale
from obbgs_base.errors import counted
from obbgs_core.score.metrics import psnr_db

LABEL_WIDTH = "fit-content(60px)"
PICTURE_WIDTH = "minmax(0, 1fr)"  # on a phone pictures are small, but all are seen
COLUMNS = 6  # brackets shown for each exposure
VIEWS_SHOWN = 3
MARGIN_PX = 10
# of full scale: pixels that differ more from the background are target when pictures are cropped
ABOVE_EMPTY = 0.01
NOISE_DEVIATIONS = 5.0  # no pixel of a frame rises by so many for noise alone


def frames_section(run: Run) -> str:
    posed = as_estimated(run.session, read_estimate(run.folder)).frames
    by_place = {(r.bracket, r.bracket_index): r for r in posed}
    bracketed, frame = run.session.is_bracketed, one_frame(is_imported(run.metrics))
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
            caption = unbroken(f"{frame} {record.id}") + _range(run, record)
            if not is_same:
                caption += f", {_exposure(run, record)}"
            if record.saturated:
                caption += f"<br>{unbroken(f'{record.saturated:,} px')} saturated"
            received = run.session.dn(record).astype(np.float32) / run.sensor.white_dn
            image = _tone(run, received.reshape(*received.shape[:2], -1))
            cells.append(picture(image, f"{frame} {record.id}", caption))
    return section(
        f"{frames(is_imported(run.metrics)).capitalize()}{' by exposure' if bracketed else ''}",
        f"{len(picked)} of {counted(len(run.session.frames), 'imported picture')}, {brightness(run)}."
        if not bracketed
        else f"{_as_they_came(run)}: each column is a bracket, each row one of its exposures; below each stand its "
        f"number{', the range to the target' if states_scale(run.session) else ''} and, where they differ in a row, "
        f"the exposure time. Brightness is {brightness(run)}.",
        grid(f"{LABEL_WIDTH} repeat({len(picked)}, {PICTURE_WIDTH})", cells),
    )


def scored_section(run: Run, truth: Truth | None) -> str:
    estimate = read_estimate(run.folder)
    range_of = {r.id: _range(run, r) for r in as_estimated(run.session, estimate).frames}
    bracketed, brackets = run.session.is_bracketed, sorted({r.bracket for r in run.scored})
    shown = evenly_spread(brackets, VIEWS_SHOWN)
    records = scored_records(run, truth, [r for r in run.scored if r.bracket in shown])
    body = []
    for bracket in shown:
        of_view = sorted((r for r in records if r.bracket == bracket), key=lambda r: r.exposure_time_s)
        named = (f"Bracket {bracket}" if bracketed else f"Picture {of_view[0].id}") + range_of[of_view[0].id]
        body.append(f"<h3>{named}</h3>")
        body.append(_compared(run, truth, of_view))
    training, imported = run.metrics["scored_frames"] == "training", is_imported(run.metrics)
    frame = one_frame(imported)
    group = "bracket" if bracketed else "picture"
    few = f"trained on: the session has too few {group}s to hold one out"
    seen = few if training else "never trained on"
    against = "the noiseless exposure" if truth else "the imported one" if imported else "the noisy frame"
    note = (
        f"{len(shown)} of {counted(len(brackets), group)}, {seen}; cropped to the target, brightness as above. Error "
        f"is the absolute difference: 0<span class='ramp'></span>{ERROR_FULL_SCALE:.0%} of full scale or more. PSNR is "
        f"of the whole picture against {against}{_mean(run, truth)}."
    )
    if estimate is not None:
        note += (
            " Poses were refined: each frame is seen from its true pose, moved as the model moved with its poses."
            if truth
            else f" Poses were refined: each {frame} is seen from the pose that settles on it."
        )
    if run.blind:
        note += " Blind: the same training from the same poses, every exposure time replaced by their mean."
    title = "Training views (nothing was held out)" if training else "Held-out views"
    return section(f"{title}: {'truth' if truth else frame}, render, error", note, "".join(body))


def _range(run: Run, record: FrameRecord) -> str:
    """Return ", 4.5 m"; nothing where nobody stated that the poses are in metres."""
    return f", {unbroken(range_in_words(record))}" if states_scale(run.session) else ""


def _mean(run: Run, truth: Truth | None) -> str:
    """Return in words the mean PSNR of all scored frames; nothing for a run that was not scored."""
    mean_db = run.metrics.get("psnr_clean_db" if truth else "psnr_noisy_db")
    what = counted(len(run.scored), one_frame(is_imported(run.metrics)))
    return "" if mean_db is None else f"; its mean over all {what} is {mean_db:.2f} dB"


def _compared(run: Run, truth: Truth | None, of_view: list[FrameRecord]) -> str:
    """Return the frames of a bracket, shortest exposure first, beside the renders of each model and their errors."""
    frame = one_frame(is_imported(run.metrics))
    reference = "truth" if truth else frame
    names = [reference, "render", "error"] + (["blind render", "blind error"] if run.blind else [])
    expected = [clean_image(run, truth, r) if truth else noisy_image(run, r) for r in of_view]
    background = torch.tensor(run.session.background)
    empty = exposed(background, run.sensor, of_view[-1].exposure_time_s)
    signal = expected[-1] - empty  # of the longest exposure
    if run.session.background:
        signal = signal.abs()
    noise = 0.0 if truth else NOISE_DEVIATIONS * run.sensor.read_noise_dn / run.sensor.white_dn
    box = bounding_box(signal.mean(-1) > max(ABOVE_EMPTY, noise), MARGIN_PX)
    cells = [label(""), *(label(name) for name in names)]

    def renders(record: FrameRecord) -> Iterator[torch.Tensor]:
        yield model_image(run, record)
        if run.blind:
            exposure_s = run.metrics["blind_reference_exposure_s"]
            yield predicted_image(run.blind, run.session, record, run.sensor, exposure_s)

    for record, image in zip(of_view, expected, strict=True):
        cells.append(label(_exposure(run, record)))
        cells.append(picture(_tone(run, image[box].numpy()), reference, f"{frame} {record.id}"))
        for render in renders(record):
            error = ((render - image).abs().mean(-1, keepdim=True) / ERROR_FULL_SCALE).clamp(0, 1)
            caption = f"{psnr_db(render, image):.1f} dB"
            cells.append(picture(_tone(run, render[box].numpy()), "render", caption))
            cells.append(picture(heat(error[box].numpy()), "error", "&nbsp;"))
    return grid(f"{LABEL_WIDTH} repeat({len(names)}, {PICTURE_WIDTH})", cells)


def _as_they_came(run: Run) -> str:
    return "Pictures as imported" if is_imported(run.metrics) else "Frames as received"


def _exposure(run: Run, record: FrameRecord) -> str:
    """Return a frame's exposure time in words; nothing where it is made up."""
    return "" if run.session.nominal_exposures else f"{in_ms(record.exposure_time_s)} ms"


def brightness(run: Run) -> str:
    """Return in words how pixel values become brightness on the page."""
    if run.session.encoding == "srgb":
        return "shown as they are"
    return "the square root of the signal above black, full scale is white"


def _tone(run: Run, image: np.ndarray) -> np.ndarray:
    return tone(image, run.sensor, run.session.encoding)
