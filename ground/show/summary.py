"""A run's figures as rows of a table with units, for the command line and the demo."""

from rich.table import Table
from rich.text import Text

from ground.run.card import (
    chi2_explained,
    frames_received,
    is_imported,
    readings,
    scored_frames,
    size_explained,
)

PSNR_LABELS = {
    "psnr_clean_db": "against noiseless exposures",
    "psnr_clean_foreground_db": "the same, pixels that show the target",
    "psnr_noisy_db": "against {readings}",
    "psnr_srgb_db": "the same of display values (sRGB)",
    "psnr_linear_db": "the same of linear values",
}
REMOVED = {
    "dark_frames": "black frames",
    "removed_outliers": "stray Gaussians",
    "removed_not_finite": "Gaussians with NaN or infinite parameters",
}


def model_rows(metrics: dict) -> list[tuple[str, str]]:
    """Return label and value with unit for each of a model's figures that was measured."""

    def known(key: str) -> bool:
        return metrics.get(key) is not None

    rows = [("method", str(metrics["method"]))]
    for key, label in PSNR_LABELS.items():
        if known(key):
            blind = metrics.get("psnr_clean_blind_db") if key == "psnr_clean_db" else None
            more = "" if blind is None else f" ({blind:.2f} dB blind to exposure)"
            label = label.format(readings=readings(is_imported(metrics)))
            rows.append((f"PSNR of {scored_frames(metrics)}, {label}", f"{metrics[key]:.2f} dB{more}"))
    if known("chi2"):
        chi2 = metrics["chi2"]
        rows.append(("residual chi²", f"{chi2:.2f}: {chi2_explained(chi2)}"))
    if known("chamfer"):
        rows.append(("Chamfer distance of the centres", f"{metrics['chamfer']:.4f} (largest dimension = 2)"))
    if known("completeness_surface"):
        shown = metrics.get("completeness_shown_surface")
        more = "" if shown is None else f" ({shown:.1f} % of what the frames show)"
        text = f"{metrics['completeness_surface']:.1f} %{more}"
        rows.append(("true surface within 0.01 of the model's", text))
    if size := size_explained(metrics):
        rows.append(("size of the model", size))
    rows.append(("Gaussians", f"{metrics['gaussians']:,}"))
    if known("budget"):
        rows.append(("budget", metrics["budget"]))
    if misfits := metrics.get("misfit_frames"):
        rows.append(("left out, fit no pose that their tags allow", f"frames {', '.join(map(str, misfits))}"))
    removed = [f"{metrics[key]:,} {label}" for key, label in REMOVED.items() if metrics.get(key)]
    if removed:
        rows.append(("left out", ", ".join(removed)))
    rows.append(("training", f"{metrics['train_seconds']:.0f} s; {metrics['stop_reason']}"))
    if known("blind_train_seconds"):
        rows.append(("training blind to exposure", f"{metrics['blind_train_seconds']:.0f} s"))
    if known("onnx_parity_db"):
        rows.append(("ONNX renderer agrees to", f"{metrics['onnx_parity_db']:.1f} dB"))
    for name in ("ply", "spz", "onnx"):
        if known(f"{name}_bytes"):
            heavy = name == "onnx" and metrics.get("onnx_fits_uplink") is False
            more = ", too large for the uplink: train with a smaller --budget" if heavy else ""
            rows.append((f"model.{name}", f"{metrics[f'{name}_bytes'] / 1e6:.2f} MB{more}"))
    rows += [(f"not made: {name}", reason) for name, reason in metrics.get("missing_outputs", {}).items()]
    return rows


def frames_row(metrics: dict) -> tuple[str, str]:
    """Return as a row how many frames came down, or pictures were imported, and what they were used for."""
    counts = ("trained on", metrics["frames_trained"]), ("held out", metrics["frames_held_out"])
    used = ", ".join(f"{count:,} {what}" for what, count in counts)
    count, what = frames_received(metrics)
    return what, f"{count}, {used}"


def runs_table(runs: dict[str, dict | str]) -> Table:
    """Return the figures of one run of each of some sessions as a table, or why there is none, by the session."""
    made = Table()
    for heading in ("session", "frames", "PSNR", "Gaussians", "training"):
        made.add_column(heading, overflow="fold")
    for session, metrics in runs.items():
        if isinstance(metrics, str):
            made.add_row(*map(Text, (session, "", "", "", f"not made: {metrics}")))
            continue
        key = next((key for key in PSNR_LABELS if metrics.get(key) is not None), None)
        noisy = f" (against {readings(is_imported(metrics))})" if key == "psnr_noisy_db" else ""
        psnr = "" if key is None else f"{metrics[key]:.2f} dB{noisy}"
        counts = f"{metrics['frames_trained']:,}", psnr, f"{metrics['gaussians']:,}"
        made.add_row(*map(Text, (session, *counts, f"{metrics['train_seconds']:.0f} s")))
    return made


def table(title: str, rows: list[tuple[str, str]]) -> Table:
    """Return rows as a table for a terminal."""
    made = Table(title=title, show_header=False)
    made.add_column(overflow="fold")
    made.add_column(overflow="fold")
    for label, value in rows:
        made.add_row(Text(label), Text(value))  # Text: brackets in a reason are not rich's markup
    return made
