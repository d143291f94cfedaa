"""Makes docs/demo.png from a finished demo: python docs/make_picture.py demo/session demo"""

import sys
from pathlib import Path

import imagecodecs
import numpy as np
import torch

from ground.run.estimated_poses import scored_records
from ground.run.evaluate import clean_image, model_image
from ground.run.runs import open_run
from ground.session.spread import evenly_spread
from ground.session.truth import Truth
from ground.show.pictures import ERROR_FULL_SCALE, bounding_box, heat, tone

OUT = Path(__file__).with_name("demo.png")
SIZE_PX = 200


def main(session: Path, name: str, out: Path = OUT) -> None:
    run = open_run(session, name)
    truth = Truth(run.session)
    rows, scored = [], scored_records(run, truth)
    brackets = sorted({r.bracket for r in scored})
    for exposure_s in sorted({r.exposure_time_s for r in scored}):
        cells = []
        for bracket in evenly_spread(brackets, 2):
            record = next(r for r in scored if (r.bracket, r.exposure_time_s) == (bracket, exposure_s))
            clean = clean_image(run, truth, record)
            render = model_image(run, record)
            box = bounding_box(torch.from_numpy(truth.radiance(record)[1] > 0), 4)
            error = ((render - clean).abs().mean(-1, keepdim=True) / ERROR_FULL_SCALE).clamp(0, 1)
            cells += [_fitted(tone(image[box].numpy(), run.sensor)) for image in (clean, render)]
            cells.append(_fitted(heat(error[box].numpy())))
        rows.append(np.hstack(cells))
    out.write_bytes(bytes(imagecodecs.png_encode(np.vstack(rows), level=9)))
    print(out)


def _fitted(image: np.ndarray) -> np.ndarray:
    """Return the picture in the middle of a black square, enlarged to fill it by whole pixels."""
    zoom = max(1, SIZE_PX // max(image.shape[:2]))
    image = np.repeat(np.repeat(image, zoom, axis=0), zoom, axis=1)[:SIZE_PX, :SIZE_PX]
    square = np.zeros((SIZE_PX, SIZE_PX, 3), dtype=np.uint8)
    top, left = (SIZE_PX - image.shape[0]) // 2, (SIZE_PX - image.shape[1]) // 2
    square[top : top + image.shape[0], left : left + image.shape[1]] = image
    return square


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
