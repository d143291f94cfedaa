"""The model card: what a model is, how good it is, and what limited its size; and phrases the report shares with it."""

import math

from obbgs_base.errors import counted

SHOWN_SIZE_ERROR_PERCENT = 0.1  # of refined poses; a smaller one costs no picture anything
NOISE_LIKE_CHI2 = 1.5  # up to here the model's own error is under 0.7 sigma of the noise
SIZES = {
    "model.ply": "ply_bytes",
    "model.spz": "spz_bytes",
    "splats.glb": "splats_bytes",
    "model.glb": "glb_bytes",
    "model.onnx": "onnx_bytes",
}
USES = {
    "model.ply": "the model without loss",
    "model.spz": "quantised, for viewers and storage",
    "splats.glb": "splats as glTF (KHR_gaussian_splatting), for viewers",
    "model.glb": "a closed mesh with a texture, for other software",
    "model.onnx": "the renderer for use on board",
}


def one_frame(imported: bool) -> str:
    """Return what one of a session's frames is called: imported pictures are nobody's frames."""
    return "picture" if imported else "frame"


def frames(imported: bool) -> str:
    """Return what a session's frames are called."""
    return f"{one_frame(imported)}s"


def readings(imported: bool) -> str:
    """Return what a model without truth is compared with; how noisy an imported picture is nobody stated."""
    return "the pictures as imported" if imported else "their noisy readings"


def is_imported(metrics: dict) -> bool:
    """Return whether a run's pictures were imported, so that none was received or captured."""
    return metrics.get("frames_imported") is not None


def scored_frames(metrics: dict) -> str:
    """Return in words which frames or pictures a run's image quality was measured on."""
    what = frames(is_imported(metrics))
    if metrics.get("scored_frames") == "training":
        return f"training {what} (nothing was held out)"
    return f"held-out {what}"


def frames_received(metrics: dict) -> tuple[str, str]:
    """Return how many frames came down of those that were taken, or pictures were imported, and what was counted."""
    if is_imported(metrics):
        return f"{metrics['frames_imported']:,}", "pictures imported"
    count = f"{metrics['frames_received']:,} / {frames_captured(metrics)}"
    return count, "frames received / captured on board"


def frames_captured(metrics: dict) -> str:
    """Return how many frames the spacecraft reported to have taken; "unknown" without its telemetry."""
    captured = metrics.get("frames_captured")
    return "unknown" if captured is None else f"{captured:,}"


def size_explained(metrics: dict) -> str:
    """Return by how much a model of refined poses has the wrong size, and its score without that; "" if by nothing."""
    error = metrics.get("size_error_percent")
    if error is None or abs(error) < SHOWN_SIZE_ERROR_PERCENT:
        return ""
    return (
        f"{abs(error):.1f} % too {'large' if error > 0 else 'small'}, at a range that is as wrong, which pictures do "
        f"not show; {metrics['similarity_psnr_clean_db']:.2f} dB against noiseless exposures once it is corrected"
    )


def chi2_explained(chi2: float) -> str:
    """Return in one sentence what a residual chi² of this size means."""
    meaning = "mean squared residual divided by the noise variance, over pixels that show the model; 1 is noise alone"
    if chi2 <= NOISE_LIKE_CHI2:
        return meaning + "."
    at, times = (f"{x:.1f}" if x < 10 else f"{x:,.0f}" for x in (chi2, math.sqrt(chi2 - 1)))
    return f"{meaning}, and at {at} the model's own error is {times} times as large as the noise."


def model_card(session_created_utc: str, metrics: dict) -> str:
    """Return the card as Markdown; figures that were not measured are left out."""
    trained_on = counted(metrics["frames_trained"], one_frame(is_imported(metrics)))
    lines = [
        "# Model card",
        "",
        f"{counted(metrics['gaussians'], 'Gaussian')}, radiance of spherical-harmonic degree {metrics['sh_degree']}, "
        f"made by {metrics['method']} from {trained_on} of the session of {session_created_utc}.",
        "",
        *_training(metrics),
        *_appearance(metrics),
        *_quality(metrics),
    ]
    lines += [
        f"- {name} is missing: {reason}." for name, reason in metrics.get("missing_outputs", {}).items()
    ]
    lines += ["", "| file | bytes | use |", "| --- | --- | --- |"]
    lines += [
        f"| {name} | {metrics[key]:,} | {USES[name]} |"
        for name, key in SIZES.items()
        if metrics.get(key) is not None
    ]
    return "\n".join([*lines, ""])


def _training(metrics: dict) -> list[str]:
    """Return how the model came about; runs made by older versions did not record all of it."""
    exposures_ms = [1e3 * exposure_s for exposure_s in metrics["exposures_s"]]
    called = frames(is_imported(metrics))
    lines = [
        f"- Start: {metrics['start']}. Training ended after {metrics['train_seconds']:.0f} s: "
        f"{metrics['stop_reason']}.",
    ]
    if not metrics.get("nominal_exposures"):
        lines.append(
            f"- Exposure times of the training {called}: {exposures_ms[0]:g} to {exposures_ms[-1]:g} ms. Between them "
            "images are as good as stated below; outside them the model extrapolates linearly."
        )
    count, what = frames_received(metrics)
    lines.append(f"- {what.capitalize()}: {count}.")
    for key, name in (
        ("budget", "Budget"),
        ("growth", "Growth"),
        ("poses", "Poses"),
    ):
        if key in metrics:
            lines.append(f"- {name}: {metrics[key]}.")
    if misfits := metrics.get("misfit_frames"):
        listed = ", ".join(map(str, misfits))
        lines.append(f"- Left out, because they fit no pose that their tags allow: {called} {listed}.")
    if metrics.get("removed_not_finite"):
        lines.append(
            f"- {metrics['removed_not_finite']:,} Gaussians were removed: a parameter became NaN or infinite."
        )
    return lines


def _appearance(metrics: dict) -> list[str]:
    """Return what the radiance depends on; nothing for runs that did not record it."""
    if "appearance" not in metrics:
        return []
    radiance = f"- Radiance: {metrics['appearance']}."
    if metrics.get("shown_under_sun_dir_body", ()) is not None:  # null: no frame tells the Sun
        radiance += f" The Sun's direction spans {metrics['sun_span_deg']:.1f} degrees in the target's frame."
    lines = [radiance]
    shading = metrics.get("shading", metrics.get("sh_direction"))  # its name in older runs
    if shading != "view":
        x, y, z = metrics["shown_under_sun_dir_body"]
        shadows = "cast" if shading == "lambert" else "not modelled"
        lines.append(
            f"- Shadows of parts on one another are {shadows}. model.ply and model.onnx hold the model for every Sun "
            "direction; model.spz, splats.glb, and what other viewers show of model.ply, are lit from "
            f"({x:.3f}, {y:.3f}, {z:.3f}), target body frame."
        )
    if highlights := metrics.get("highlights"):
        light = (
            "the Sun"
            if metrics.get("shown_under_sun_dir_body", ()) is not None
            else "a light that stands still"
        )
        lines.append(
            f"- Highlights: each Gaussian mirrors {light} in one lobe (GGX, alpha {highlights['alpha']:.2f}). "
            "model.ply and model.onnx hold them; model.spz, splats.glb, and what other viewers show of model.ply, hold "
            "them as harmonics of degree 3, far wider and fainter; the colours of model.glb do not follow the view."
        )
    if metrics.get("background"):
        lines.append(
            f"- Trained in front of a background of radiance {metrics['background']:g}, which model.onnx draws. "
            "model.ply, model.spz and splats.glb do not hold it: set it in the viewer."
        )
    return lines


def _quality(metrics: dict) -> list[str]:
    lines, called = [], frames(is_imported(metrics))
    if isinstance(level := metrics.get("sky_level"), str):
        lines.append(f"- Sky: {level}.")
    if isinstance(response := metrics.get("response"), str):
        lines.append(f"- Camera: {response}.")
    if isinstance(chi2 := metrics.get("chi2"), int | float) and math.isfinite(chi2):
        lines.append(f"- Residual chi² {chi2:.2f}: {chi2_explained(chi2)}")
    if isinstance(misfit := metrics.get("misfit"), float):
        line = f"- The model's own error, beside the noise: {100 * misfit:.0f} % of the light"
        if factor := metrics.get("misfit_unseen_factor"):
            line += (
                f" under Suns that it has not seen, {100 * misfit / factor:.0f} % under those of its {called}"
            )
        if both := metrics.get("chi2_held_out_both"):
            line += (
                f". Held-out {called} have a chi² of {metrics['chi2_held_out']:.2f} over the noise and of {both:.2f} "
                "over noise and own error together; 1 means that the errors are as large as stated"
            )
        lines.append(line + ".")
    scored, what = scored_frames(metrics), readings(is_imported(metrics))
    for key, text in (
        ("psnr_noisy_db", f"PSNR of {scored} against {what}: {{:.2f}} dB."),
        ("psnr_srgb_db", "The same of display values (sRGB): {:.2f} dB."),
        ("psnr_linear_db", "The same of values that are linear in light: {:.2f} dB."),
        ("psnr_clean_db", f"PSNR of {scored} against their noiseless exposures: {{:.2f}} dB."),
        ("psnr_clean_foreground_db", "The same on the pixels that the target covers: {:.2f} dB."),
        ("chamfer", "Chamfer distance of the centres (the target's largest dimension = 2): {:.4f}."),
        ("completeness_surface", "Of the true surface, {:.1f} % lies within 0.01 of surface.ply."),
        ("completeness_shown_surface", "Of the part of it that the frames show, {:.1f} % does."),
        ("completeness_mesh", "Of the true surface, {:.1f} % lies within 0.01 of model.glb."),
        ("completeness_shown_mesh", "Of the part of it that the frames show, {:.1f} % does."),
    ):
        if key in metrics:
            lines.append("- " + text.format(metrics[key]))
    if size := size_explained(metrics):
        lines.append(f"- The model is {size}.")
    for key, of in (("interval_90_noisy", "readings"), ("interval_90_clean", "noiseless exposures")):
        if key in metrics:
            lines.append(
                f"- Stated uncertainty: intervals that should hold 90 % hold {100 * metrics[key]:.0f} % of the {of} "
                f"on the target in held-out {called}."
            )
    if "mesh_triangles" in metrics:
        unseen = f"In {100 * metrics['mesh_unseen_share']:.1f} % of its area"
        lines.append(
            f"- Mesh: {metrics['mesh_triangles']:,} triangles, closed. {unseen}, triangles with a corner "
            f"that none of {metrics['mesh_views']} views saw, the surface may only bound what no view saw. The vertex "
            "attribute _SEEN_BY_VIEWS counts the views that see each vertex."
        )
    if metrics.get("onnx_fits_uplink") is False:
        lines.append("- model.onnx is too large for the uplink: train with a smaller --budget.")
    return lines
