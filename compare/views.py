"""The few held-out views that a comparison keeps of each cell, for its page: one that all share, and the worst."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from compare.case import Case
from obbgs_base.files import write_whole
from obbgs_core.score.metrics import psnr_db
from obbgs_core.sensor import Sensor

SHOWN, WORST = "shown", "worst"


@dataclass(frozen=True)
class KeptView:
    """A held-out view: what was expected and what a method made of it, [H, W, C] in 0..1."""

    frame: int
    exposure_time_s: float
    expected: np.ndarray
    image: np.ndarray
    psnr_db: float
    sensor: Sensor  # of which only black level and full scale (1) count


def write_views(case: Case, images: list[Tensor], path: Path) -> None:
    """Keep the view in which the target is brightest, the same for every method, and the one with the least PSNR."""
    expected = case.clean or case.noisy
    values = [psnr_db(image, exact) for image, exact in zip(images, expected, strict=True)]
    chosen = {
        SHOWN: max(range(len(expected)), key=lambda i: expected[i].sum().item()),
        WORST: min(range(len(values)), key=values.__getitem__),
    }
    arrays: dict[str, np.ndarray] = {"black": np.array(case.sensor.black_dn / case.sensor.white_dn)}
    for name, i in chosen.items():
        frame = case.held_out[i]
        arrays[f"{name}_facts"] = np.array([frame.id, frame.exposure_time_s, values[i]])
        arrays[f"{name}_expected"] = expected[i].numpy().astype(np.float16)
        arrays[f"{name}_image"] = images[i].numpy().astype(np.float16)
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # pyright: ignore[reportArgumentType]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content.getvalue())


def read_views(path: Path) -> dict[str, KeptView]:
    """Return the kept views of a cell by `SHOWN` and `WORST`; nothing where none were kept."""
    if not path.exists():
        return {}
    with np.load(path) as arrays:
        sensor = Sensor(float(arrays["black"]), 1.0, 1.0, 1.0, 0.0)
        views = {}
        for name in (SHOWN, WORST):
            frame, exposure_s, value_db = arrays[f"{name}_facts"].tolist()
            expected, image = (arrays[f"{name}_{kind}"].astype(np.float32) for kind in ("expected", "image"))
            views[name] = KeptView(int(frame), exposure_s, expected, image, value_db, sensor)
    return views
