"""The model as SPZ (Niantic, version 3), a compact file that viewers show: 20 bytes a Gaussian before gzip.

gsply quantises and packs; this file converts our radiance to display colours (see `ply`) and our axes to SPZ's. SPZ's y
axis points up and its z axis backwards, those of 3DGS PLYs down and forwards, so y and z change sign, as in Niantic's
own converter: both files then look alike in a viewer. The comment of the gzip header holds what is needed to turn the
display colours back into radiance: the white radiance and the number of channels. A model whose radiance depends on the
Sun's direction is written as it looks with the Sun in one direction, and highlights as harmonics of degree 3, wider and
fainter than they are. A model whose footprint lowers the peak of thin
Gaussians sets SPZ's flag `antialiased`: viewers that know it do the same, with 0.3 px² on their own screen.

Rounding errors: means half of 2^-bits m with as many bits as the model's extent allows, sigmas 3 %, opacities 1/510,
display colours 1/270. Sigmas are clamped to 45 um .. 380 m, display colours to 1.44, which is 2.2 times the white
radiance, their higher harmonics to -1 .. 1.
"""

import gzip
import math
import re
import struct
import tempfile
import zlib
from pathlib import Path

import gsply
import torch

from obbgs_base.errors import reason
from obbgs_base.files import write_whole
from obbgs_core.errors import ExportError, ReconstructionError
from obbgs_core.io.ply import display_sh, radiance_sh, require_writable
from obbgs_core.model import sh
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import unit
from obbgs_core.render import lit_from

FLIP = torch.tensor([1.0, -1.0, -1.0])  # a rotation by 180 degrees about x, its own inverse
LARGEST_FIXED_POINT = 2**23 - 1
MAX_FRACTIONAL_BITS = 16  # 15 um: finer than any sigma that SPZ can hold
CONTENT_HEADER, SPZ_MAGIC = struct.Struct("<IIIBBBB"), 0x5053474E
BYTES_EACH = 20  # of a Gaussian without harmonics, in version 3
MOST_GAUSSIANS, PIECE_BYTES = 10_000_000, 1 << 20  # as many as Niantic's own reader takes
GZIP_HEADER_BYTES = 10
GZIP_HAS_COMMENT = 0x10
FLAGS_BYTE, FLAG_ANTIALIASED = (
    14,
    0x01,
)  # of the content: "rendered with the peak lowered" (Niantic, load-spz.cc)
COMMENT = re.compile(
    rb"obbgs white_radiance=(\S+) channels=([13])(?: footprint=(camera|mip-splatting) psf_sigma_px=([^\s\0]+))?"
)


def save_spz(
    gaussians: Gaussians, path: Path, white_radiance: float = 1.0, sun_dir: torch.Tensor | None = None
) -> None:
    """Write the model; the file appears whole or not at all, and is the same for the same model.

    Args:
        sun_dir: [3] unit, body frame, towards the Sun: the illumination, if the radiance depends on it.

    Raises:
        ValueError: the radiance depends on the Sun's direction, and sun_dir is not given.
        ExportError: the model is empty, not finite, or reaches farther than 24 bits of fixed point allow.
    """
    gaussians = lit_from(gaussians.detach(), sun_dir)
    require_writable(gaussians, white_radiance)
    extent_m = float(gaussians.means.abs().max())
    bits = min(MAX_FRACTIONAL_BITS, math.floor(math.log2(LARGEST_FIXED_POINT / max(extent_m, 1e-6))))
    if bits < 1:
        raise ExportError(f"means reach {extent_m:.3g} m; SPZ holds at most {LARGEST_FIXED_POINT / 2:.3g} m")
    quats = unit(gaussians.quats)
    shown = display_sh(gaussians, white_radiance) * _sh_signs(gaussians.sh.shape[1])
    packed = gsply.GSData(
        means=(gaussians.means * FLIP).numpy(),
        scales=gaussians.log_scales.numpy(),
        quats=torch.cat([quats[:, :1], quats[:, 1:] * FLIP], dim=1).numpy(),
        opacities=gaussians.opacity_logits.numpy(),
        sh0=shown[:, 0].numpy(),
        shN=shown[:, 1:].numpy(),
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.spz"
        gsply.write_spz(file, packed, fractional_bits=bits)
        payload = bytearray(gzip.decompress(file.read_bytes()))
    payload[FLAGS_BYTE] |= FLAG_ANTIALIASED if gaussians.footprint != "kerbl" else 0
    content = gzip.compress(payload, mtime=0)
    comment = f"obbgs white_radiance={float(white_radiance)!r} channels={gaussians.sh.shape[2]}"
    if gaussians.footprint != "kerbl":
        comment += f" footprint={gaussians.footprint} psf_sigma_px={gaussians.psf_sigma_px.item():.6g}"
    header = content[:3] + bytes([content[3] | GZIP_HAS_COMMENT]) + content[4:GZIP_HEADER_BYTES]  # RFC 1952
    write_whole(path, header + comment.encode("ascii") + b"\0" + content[GZIP_HEADER_BYTES:])


def load_spz(path: Path) -> Gaussians:
    """Return the model in an SPZ that `save_spz` wrote, up to its rounding errors.

    Raises:
        ReconstructionError: the file is something else, or damaged.
    """
    with open(path, "rb") as file:
        start = file.read(GZIP_HEADER_BYTES + 200)
    note = COMMENT.match(start, GZIP_HEADER_BYTES)
    if not start.startswith(b"\x1f\x8b") or not note:
        raise ReconstructionError(f"{path} is not an SPZ written by this software: no radiance scale in it")
    try:
        _check_size(path.read_bytes())
        packed = gsply.read_spz(path)
    except (ValueError, zlib.error, EOFError, OSError) as error:
        raise ReconstructionError(f"{path} is damaged: {reason(error)}") from error
    means, log_scales, quats, opacity_logits, f_dc = (
        torch.from_numpy(array.copy())
        for array in (packed.means, packed.scales, packed.quats, packed.opacities, packed.sh0)
    )
    shown = f_dc[:, None]
    if packed.shN is not None:  # None if colours do not depend on the direction
        shown = torch.cat([shown, torch.from_numpy(packed.shN.copy())], dim=1)
    shown = shown * _sh_signs(shown.shape[1])
    fitted = (
        {}
        if note[3] is None
        else {"footprint": note[3].decode(), "psf_sigma_px": torch.tensor(float(note[4]))}
    )
    return Gaussians(
        means=means * FLIP,
        quats=torch.cat([quats[:, :1], quats[:, 1:] * FLIP], dim=1),
        log_scales=log_scales,
        opacity_logits=opacity_logits,
        sh=radiance_sh(shown, float(note[1]), int(note[2])),
        **fitted,
    )


def _check_size(content: bytes) -> None:
    """Check, before all of it is inflated, that a file holds as many bytes as its header says, and not too many.

    Raises:
        ValueError: it does not.
        zlib.error: it is no gzip.
    """
    stream = zlib.decompressobj(wbits=31)  # one gzip member
    header = stream.decompress(content, CONTENT_HEADER.size)
    if len(header) < CONTENT_HEADER.size:
        raise ValueError("it ends before its header does")
    magic, version, count, degree, *_ = CONTENT_HEADER.unpack(header)
    if magic != SPZ_MAGIC or version != 3 or degree > 3:
        raise ValueError(
            f"expected SPZ of version 3 and degree 0 to 3, got version {version}, degree {degree}"
        )
    if count > MOST_GAUSSIANS:
        raise ValueError(f"it says that it holds {count} Gaussians; at most {MOST_GAUSSIANS} are read")
    left = count * (BYTES_EACH + 3 * ((degree + 1) ** 2 - 1))
    while left >= 0 and not stream.eof:
        piece = stream.decompress(stream.unconsumed_tail, min(left + 1, PIECE_BYTES))
        if not piece and not stream.unconsumed_tail and not stream.eof:
            break
        left -= len(piece)
    if left or not stream.eof or stream.unused_data:
        raise ValueError(f"it does not hold the {count} Gaussians that its header says")


def _sh_signs(count: int) -> torch.Tensor:
    """Return the factors [count, 1] that the coefficients take when y and z change sign."""
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, 0.5, 0.8]]), dim=1)  # no harmonic is 0 here
    return torch.sign(sh.sh_basis(direction, count) * sh.sh_basis(direction * FLIP, count))[0, :, None]
