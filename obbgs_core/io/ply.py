"""Models and surfaces as PLY files, which other viewers show; a model is read back exactly.

Viewers of 3DGS files compute a display colour as `0.5 + SH(direction)`, clipped to 0..1. Our coefficients mean
`softplus(SH(direction))` in scene-linear light, so f_dc and f_rest hold display colours, `(radiance / white)^(1/2.2)`
fitted with spherical harmonics, and our own coefficients follow as radiance_sh_<coefficient>_<channel>, which viewers
ignore. Everything else means the same there and here: metres, logarithms of sigmas, logits, quaternions w, x, y, z.

If our radiance depends on the Sun's direction instead of the viewing direction, a comment of the header says so, and
f_dc and f_rest hold the colours with the Sun in the direction that the comment names.

A model with highlights has lobe_log_weight, before it lobe_x, lobe_y and lobe_z where lobes have axes of their own
(`Gaussians.lobes`), and the material that they share in a comment. Viewers show them as harmonics of degree 3 in f_dc
and f_rest, wider and fainter than they are.

Most viewers widen every Gaussian by 0.3 px² of their screen and keep its peak, the footprint `kerbl`. Another footprint
stands in a comment, and `opacity` is then made for such viewers: the model's own, which follows as fitted_opacity,
times the root of the share by which 0.3 px² would lower the peak at the distance of the cameras. All of the share would
match there and let a viewer see through the surface from nearer.

Tools that write a PLY again drop its comments, so what reading a model needs stands in columns too, with the same value
in every row: shading, ambient, footprint, psf_sigma_px, gloss_0 and so on, static_sun_0 and so on. The last
column, row_check, is a hash of its row: rows may be left out or sorted anew, but none that was changed is taken.
"""

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from obbgs_base.errors import reason
from obbgs_base.files import write_whole
from obbgs_base.ply import PlyError, read_ply
from obbgs_core.errors import ExportError, ReconstructionError
from obbgs_core.model import sh
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.footprint import KERBL_PX2, PIXEL_PX2, lowers_peak
from obbgs_core.model.gaussians import Footprint, Gaussians, Shading
from obbgs_core.render import lit_from, project

DISPLAY_GAMMA = 2.2
TURNS_WITH_SUN = "comment radiance_sh turn with the Sun"
FOOTPRINT = "comment footprint "
LOBE_NAMES = ("lobe_x", "lobe_y", "lobe_z", "lobe_log_weight")
HIGHLIGHTS = "comment highlights: GGX of alpha "
STATIC_SUN = ", Sun towards "
LAMBERT = "comment radiance_sh are albedos in units of the Sun's light, ambient light "
SHADINGS: tuple[Shading, ...] = ("view", "sun", "lambert")  # a column holds the place in this list
FOOTPRINTS: tuple[Footprint, ...] = ("kerbl", "camera", "mip-splatting")
ROW_CHECK = "row_check"
RADIANCE = re.compile(r"radiance_sh_(\d{1,2})_(\d)", re.ASCII)
FACTS = re.compile(r"shading|ambient|footprint|psf_sigma_px|(gloss|static_sun)_\d", re.ASCII)
OWN_COLUMNS = re.compile(
    rf"[xyz]|(f_dc|f_rest|scale|rot)_\d+|(fitted_)?opacity|lobe_\w+|{FACTS.pattern}|{RADIANCE.pattern}",
    re.ASCII,
)


def display_sh(gaussians: Gaussians, white_radiance: float) -> Tensor:
    """Return coefficients [N, K, 3] of display colours, as 3DGS viewers expect them; `white_radiance` is shown as 1."""
    directions, to_coefficients = sh.fit(gaussians.sh.shape[1])
    shown = torch.stack(
        [(sh.radiance(gaussians.sh, d.expand(len(gaussians), 3)) / white_radiance) for d in directions], dim=1
    )
    shown = shown.expand(-1, -1, 3) ** (1 / DISPLAY_GAMMA)  # [N, directions, 3]
    return torch.einsum("kd,ndc->nkc", to_coefficients, shown - 0.5)


def radiance_sh(display: Tensor, white_radiance: float, channels: int) -> Tensor:
    """Return our coefficients [N, K, channels] for coefficients of display colours [N, K, 3]."""
    directions, to_coefficients = sh.fit(display.shape[1])
    shown = 0.5 + torch.einsum("dk,nkc->ndc", sh.sh_basis(directions, display.shape[1]), display)
    if channels == 1:
        shown = shown.mean(dim=2, keepdim=True)
    before_softplus = sh.C0 * sh.from_radiance(white_radiance * shown.clamp(min=0) ** DISPLAY_GAMMA)
    return torch.einsum("kd,ndc->nkc", to_coefficients, before_softplus)


def require_writable(gaussians: Gaussians, white_radiance: float) -> None:
    """Raise ExportError if there is no Gaussian, a parameter that is not finite, or no radiance to show as white."""
    if len(gaussians) == 0:
        raise ExportError("there is no Gaussian to write")
    for name, tensor in gaussians.tensors().items():
        if not tensor.isfinite().all():
            raise ExportError(f"{name} holds values that are not finite")
    if not (math.isfinite(white_radiance) and white_radiance > 0):
        raise ExportError(f"white_radiance must be a positive radiance, got {white_radiance}")


def save_ply(
    gaussians: Gaussians,
    path: Path,
    white_radiance: float = 1.0,
    sun_dir: Tensor | None = None,
    cameras: Cameras | None = None,
) -> None:
    """Write the model; the file appears whole or not at all.

    Args:
        white_radiance: the radiance that viewers show as white.
        sun_dir: [3] unit, body frame, towards the Sun: what viewers show, if the radiance depends on it.
        cameras: from which opacities are made for viewers that keep peaks; None: viewers get the model's own.

    Raises:
        ValueError: the radiance depends on the Sun's direction, and sun_dir is not given.
        ExportError: the model is empty or not finite.
    """
    gaussians = gaussians.detach()
    require_writable(gaussians, white_radiance)
    for_viewers = viewer_logits(gaussians, cameras)
    count, coefficients, channels = gaussians.sh.shape
    shown = display_sh(lit_from(gaussians, sun_dir), white_radiance)
    rest = shown[:, 1:].transpose(1, 2).flatten(1)  # all of red, then of green, then of blue
    table: dict[str, Tensor] = {}
    for i, axis in enumerate("xyz"):
        table[axis] = gaussians.means[:, i]
    for axis in ("nx", "ny", "nz"):
        table[axis] = torch.zeros(count)
    table |= {f"f_dc_{i}": shown[:, 0, i] for i in range(3)}
    table |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    table["opacity"] = gaussians.opacity_logits if for_viewers is None else for_viewers
    table |= {f"scale_{i}": gaussians.log_scales[:, i] for i in range(3)}
    table |= {f"rot_{i}": gaussians.quats[:, i] for i in range(4)}
    for k in range(coefficients):
        table |= {f"radiance_sh_{k}_{c}": gaussians.sh[:, k, c] for c in range(channels)}
    if gaussians.has_highlights:
        table |= {
            name: gaussians.lobes[:, i] for i, name in enumerate(LOBE_NAMES[-gaussians.lobes.shape[1] :])
        }
    if for_viewers is not None:
        table["fitted_opacity"] = gaussians.opacity_logits
    table |= _facts(gaussians)
    table[ROW_CHECK] = _row_check(table)
    comments = [
        f"comment f_dc and f_rest: (radiance / {white_radiance:.9g})^(1/{DISPLAY_GAMMA}); radiance_sh: scene-linear"
    ]
    if gaussians.shading != "view" and sun_dir is not None:
        x, y, z = sun_dir.tolist()
        kind = f"{LAMBERT}{gaussians.ambient:.9g}" if gaussians.shading == "lambert" else TURNS_WITH_SUN
        comments.append(f"{kind}; f_dc: with the Sun towards {x:.6f} {y:.6f} {z:.6f}, body frame")
    if gaussians.footprint != "kerbl":
        comments.append(f"{FOOTPRINT}{gaussians.footprint}, psf_sigma_px {gaussians.psf_sigma_px.item():.9g}")
    if gaussians.has_highlights:
        alpha, *peak = (f"{value:.9g}" for value in gaussians.gloss.exp().tolist())
        material = f"{alpha}, peak radiance {' '.join(peak)}{_towards(gaussians.static_sun)}"
        comments.append(f"{HIGHLIGHTS}{material}; in f_dc and f_rest of degree 3, wider")
    write_whole(path, _ply(table, *comments))


def _towards(static_sun: Tensor) -> str:
    """Return the direction of a Sun that stands still, as a header tells it; nothing where it is not known."""
    direction = " ".join(f"{value:.9g}" for value in static_sun.tolist())
    return f"{STATIC_SUN}{direction}" if direction else ""


def viewer_logits(gaussians: Gaussians, cameras: Cameras | None) -> Tensor | None:
    """Return opacity logits [N] for viewers that widen by 0.3 px² and keep the peak, seen from about these cameras.

    None where the model's own serve: it keeps the peak too, or no cameras are known.
    """
    if cameras is None or not lowers_peak(gaussians):
        return None
    psf_sigma_px = torch.tensor(KERBL_PX2 - PIXEL_PX2).sqrt()
    widened = dataclasses.replace(gaussians, footprint="camera", psf_sigma_px=psf_sigma_px)
    total, count = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    for c in range(len(cameras)):  # of all at once, large models of many frames would not fit into the memory
        projected = project(widened, dataclasses.replace(cameras.one(c), psf_sigma_px=None, scale=1.0))
        seen = projected.depths[0] > 0
        total += projected.peak_shares[0] * seen
        count += seen
    share = total / count.clamp(min=1)
    return torch.logit(gaussians.opacities * share.sqrt(), eps=1e-6)


def save_surface_ply(points: Tensor, normals: Tensor, path: Path) -> None:
    """Write oriented points [M, 3] m, [M, 3]; the file appears whole or not at all."""
    table = {axis: points[:, i] for i, axis in enumerate("xyz")}
    table |= {axis: normals[:, i] for i, axis in enumerate(("nx", "ny", "nz"))}
    write_whole(path, _ply(table, "comment metres, target body frame; normals outwards"))


def _ply(table: dict[str, Tensor], *comments: str) -> bytes:
    values = torch.stack(list(table.values()), dim=1).detach().cpu().numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", *comments]
    header += [f"element vertex {len(values)}", *(f"property float {name}" for name in table), "end_header\n"]
    return "\n".join(header).encode("ascii") + values.tobytes()


def load_ply(path: Path) -> Gaussians:
    """Return the model in a PLY that `save_ply` wrote, also if another tool wrote its columns and rows again.

    Byte order, order of the columns and of the rows do not matter, rows may be missing, and so may comments.

    Raises:
        ReconstructionError: the file is something else, is cut off, or its Gaussians are not those that were written:
            another tool rotated, scaled, coloured or rounded them, or dropped what the model needs.
    """
    try:
        content = read_ply(path)
    except (PlyError, OSError) as error:
        raise ReconstructionError(
            f"{path} is not a model written by this software: {reason(error)}"
        ) from error
    columns = content.tables.get("vertex", {})
    if "radiance_sh_0_0" not in columns:
        raise ReconstructionError(
            f"{path} is not a model written by this software: it has no column radiance_sh_0_0"
        )
    if any(values.ndim != 1 or values.dtype.kind != "f" for values in columns.values()):
        raise ReconstructionError(f"{path} is damaged: expected every column of vertex to be of type float")
    table = {name: torch.from_numpy(values.astype(np.float32)) for name, values in columns.items()}
    if ROW_CHECK in table and (changed := int((_row_check(table) != table[ROW_CHECK]).sum())):
        raise ReconstructionError(
            f"{path}: another tool changed {changed} of its {len(table[ROW_CHECK])} Gaussians (rotated, scaled, "
            "coloured or rounded them), so that what they mean together is lost; take the file as it was written"
        )
    try:
        return _model_of(table, content.comments)
    except (LookupError, RuntimeError, ValueError) as error:
        raise ReconstructionError(
            f"{path} is damaged: its header does not describe a model: {error}"
        ) from error


def _row_check(table: dict[str, Tensor]) -> Tensor:
    """Return 24 bits [N] of a hash over each row's own columns, by name, as whole numbers that a float holds exactly.

    Source: FNV-1a (Fowler, Noll, Vo), over words of 32 bits.
    """
    names = sorted(name for name in table if OWN_COLUMNS.fullmatch(name))
    hashed = np.full(len(table[names[0]]), 0x811C9DC5, dtype=np.uint32)
    for name in names:
        hashed = (hashed ^ table[name].detach().cpu().numpy().astype("<f4").view("<u4")) * np.uint32(
            0x01000193
        )
    return torch.from_numpy((hashed >> np.uint32(8)).astype(np.float32))


def _facts(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return what the model is beside its Gaussians, as columns [N] with one value each; none of a plain model."""
    facts: dict[str, Tensor] = {}
    if gaussians.shading != "view":
        facts["shading"] = torch.tensor(float(SHADINGS.index(gaussians.shading)))
        facts["ambient"] = gaussians.ambient
    if gaussians.footprint != "kerbl":
        facts["footprint"] = torch.tensor(float(FOOTPRINTS.index(gaussians.footprint)))
        facts["psf_sigma_px"] = gaussians.psf_sigma_px
    if gaussians.has_highlights:
        facts |= {f"gloss_{i}": value for i, value in enumerate(gaussians.gloss)}
        facts |= {f"static_sun_{i}": value for i, value in enumerate(gaussians.static_sun)}
    return {name: value.float().expand(len(gaussians)) for name, value in facts.items()}


def _read_facts(table: dict[str, Tensor]) -> dict[str, Any]:
    """Return the arguments of Gaussians that columns of `_facts` hold."""
    values = {}
    for name, column in table.items():
        if FACTS.fullmatch(name):
            if len(column) and not (column == column[0]).all():
                raise ValueError(f"{name} differs between Gaussians, as if two models were joined")
            values[name] = column[0].clone()
    found: dict[str, Any] = {}
    if "shading" in values:
        found |= {"shading": SHADINGS[int(values["shading"])], "ambient": values["ambient"]}
    if "footprint" in values:
        found |= {
            "footprint": FOOTPRINTS[int(values["footprint"])],
            "psf_sigma_px": values["psf_sigma_px"],
        }
    for name in ("gloss", "static_sun"):
        count = sum(key.startswith(f"{name}_") for key in values)
        if count:
            found[name] = torch.stack([values[f"{name}_{i}"] for i in range(count)])
    return found


def _read_comments(comments: Sequence[str]) -> dict[str, Any]:
    """Return the same from comments, where alone files of version 0.2 and before hold it."""
    found: dict[str, Any] = {}
    for line in (f"comment {text}" for text in comments):
        if line.startswith(FOOTPRINT):
            footprint, _, psf_sigma_px = line.removeprefix(FOOTPRINT).partition(", psf_sigma_px ")
            found |= {"footprint": footprint, "psf_sigma_px": torch.tensor(float(psf_sigma_px))}
        if line.startswith(HIGHLIGHTS):
            material, _, sun = line.removeprefix(HIGHLIGHTS).partition(";")[0].partition(STATIC_SUN)
            alpha, _, peak = material.partition(", peak radiance ")
            found["gloss"] = torch.tensor([float(value) for value in (alpha, *peak.split())]).log()
            found["static_sun"] = torch.tensor([float(value) for value in sun.split()])
        if line.startswith(TURNS_WITH_SUN):
            found["shading"] = "sun"
        elif line.startswith(LAMBERT):
            ambient = float(line.removeprefix(LAMBERT).partition(";")[0])
            found |= {"shading": "lambert", "ambient": torch.tensor(ambient)}
    return found


def _model_of(table: dict[str, Tensor], comments: Sequence[str]) -> Gaussians:
    """Return the model of a PLY's columns and comments; the columns' order means nothing."""
    indices = [tuple(map(int, m.groups())) for name in table if (m := RADIANCE.fullmatch(name))]
    coefficients, channels = (1 + max(index) for index in zip(*indices, strict=True))
    facts = _read_comments(comments) | _read_facts(table)
    if "fitted_opacity" in table and "footprint" not in facts:
        raise ValueError("its footprint is missing, which its comments told; another tool dropped them")
    lobes = [table[name] for name in LOBE_NAMES if name in table]
    if bool(lobes) != ("gloss" in facts):
        raise ValueError("its highlights have no material or no lobes; another tool dropped them")
    if lobes:
        facts["lobes"] = torch.stack(lobes, 1)
    radiance = [table[f"radiance_sh_{k}_{c}"] for k in range(coefficients) for c in range(channels)]
    return Gaussians(
        means=torch.stack([table[a] for a in "xyz"], 1),
        quats=torch.stack([table[f"rot_{i}"] for i in range(4)], 1),
        log_scales=torch.stack([table[f"scale_{i}"] for i in range(3)], 1),
        opacity_logits=table["fitted_opacity"] if "fitted_opacity" in table else table["opacity"],
        sh=torch.stack(radiance, 1).reshape(len(table["x"]), coefficients, channels),
        **facts,
    )
