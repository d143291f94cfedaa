"""The model card: what a model is, how good, and why it is no larger."""

SIZES = {"model.ply": "ply_bytes", "model.spz": "spz_bytes", "model.onnx": "onnx_bytes"}
USES = {
    "model.ply": "every number, read back exactly",
    "model.spz": "quantised, for viewers and storage",
    "model.onnx": "the renderer for use on board",
}


def appearance(metrics: dict) -> list[str]:
    """Return what the radiance turns with and why, as a point of a list; nothing for runs that did not note it."""
    if "appearance" not in metrics:
        return []
    lines = [
        f"- Radiance {metrics['appearance']}. The Sun's direction spans {metrics['sun_span_deg']:.1f} degrees in the "
        "target's frame."
    ]
    shading = metrics.get("shading", metrics.get("sh_direction"))  # as older runs called it
    if shading != "view":
        x, y, z = metrics["shown_under_sun_dir_body"]
        shadows = "cast" if shading == "lambert" else "not modelled"
        lines.append(
            f"- Shadows of parts on one another are {shadows}. model.ply and model.onnx hold every Sun; "
            f"model.spz, and what viewers show of model.ply, are lit from ({x:.3f}, {y:.3f}, {z:.3f}), target body "
            "frame."
        )
    return lines


def model_card(session_created_utc: str, metrics: dict) -> str:
    """Return the card as Markdown: figures that were not measured are left out."""
    measured = metrics["chi2"] is not None  # not where no step was done
    exposures_ms = [1e3 * exposure_s for exposure_s in metrics["exposures_s"]]
    lines = [
        "# Model card",
        "",
        f"{metrics['gaussians']:,} Gaussians with radiance of degree {metrics['sh_degree']}, by method "
        f"{metrics['method']} from {metrics['frames_trained']} frames of the session of {session_created_utc}.",
        "",
        f"- Started from: {metrics['start']}. Stopped because: {metrics['stop_reason']}, after "
        f"{metrics['train_seconds']:.0f} s.",
        *([f"- Budget: {metrics['budget']}."] if "budget" in metrics else []),  # older runs did not note it
        f"- Exposure times it was trained on: {exposures_ms[0]:g} to {exposures_ms[-1]:g} ms. Between them its images "
        "are as good as below; outside them it extrapolates linearly.",
        *([f"- Residual chi² on the target: {metrics['chi2']:.2f} (1 is pure noise)."] if measured else []),
        *appearance(metrics),
    ]
    for key, text in (
        ("growth", "Growth ran {}."),
        ("poses", "Poses {}."),
        ("exposures", "Exposure times {}."),
    ):
        if key in metrics:  # older runs did not note it
            lines.append("- " + text.format(metrics[key]))
    for key, text in (
        ("psnr_noisy_db", "Held-out PSNR against the noisy frames: {:.2f} dB."),
        ("psnr_clean_db", "Held-out PSNR against the noiseless exposures: {:.2f} dB."),
        ("chamfer", "Chamfer distance of the centres (largest dimension = 2): {:.4f}."),
        ("completeness_surface", "Of the true surface, {:.1f} % lies within 0.01 of surface.ply."),
    ):
        if key in metrics:
            lines.append("- " + text.format(metrics[key]))
    if metrics.get("removed_not_finite"):
        lines.append(f"- {metrics['removed_not_finite']:,} Gaussians stopped being numbers and were removed.")
    if metrics.get("onnx_fits_uplink") is False:
        lines.append("- model.onnx is too large for the uplink: a smaller budget makes a smaller one.")
    lines += [
        f"- {name} is missing: {reason}." for name, reason in metrics.get("missing_outputs", {}).items()
    ]
    lines += ["", "| file | bytes | for |", "| --- | --- | --- |"]
    there = {name: metrics[key] for name, key in SIZES.items() if metrics[key] is not None}
    lines += [f"| {name} | {size_bytes:,} | {USES[name]} |" for name, size_bytes in there.items()]
    return "\n".join([*lines, ""])
