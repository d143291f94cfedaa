"""Makes docs/obb.png from a session: python docs/make_obb_picture.py demo/session

A short training of the session; then one frame with its worst tile (red), the Gaussians in the frustum behind it
(yellow) and the oriented box around them (blue), as growth sees them.
"""

import sys
from pathlib import Path

import imagecodecs
import numpy as np
import torch

from ground.session.cameras import sensor_of
from ground.session.folder import open_session
from ground.session.training_frames import split, training_frame
from ground.show.pictures import tone
from obbgs_core.losses import likelihood_loss
from obbgs_core.methods.presets import preset
from obbgs_core.model import obb
from obbgs_core.render import render
from obbgs_core.train.trainer import Trainer

ZOOM, STEPS = 4, 250
RED, YELLOW, BLUE = (230, 60, 40), (250, 210, 60), (60, 140, 255)
EDGES = [
    (a, b) for a in range(8) for b in range(8) if a < b and (a ^ b).bit_count() == 1
]  # of a box, corners as bits


def main(session_dir: Path) -> None:
    session = open_session(session_dir)
    sensor = sensor_of(session.camera)
    frames = [training_frame(session, record) for record in split(session)[0]]
    trainer = Trainer(frames, sensor, preset("obbgs"))
    for _ in range(STEPS):
        trainer.step()
    gaussians = trainer.state.gaussians.detach()
    areas = [(f.dn > sensor.black_dn + 6 * sensor.read_noise_dn).sum() for f in frames]
    batch = trainer.setup.batches.batch([int(np.argmax(areas))], 1.0)
    rendered = render(gaussians, batch.cameras)
    _, residual = likelihood_loss(rendered.radiance, batch.exposure_time_s, batch.dn, sensor)
    tile = obb.worst_tile(residual[0])
    pose = batch.cameras.world_to_camera[0]
    behind = obb.behind_tile(gaussians.means, rendered.means2d[0], rendered.depth[0], pose, tile)
    box = obb.fit(gaussians.means[behind])
    image = np.repeat(np.repeat(tone((batch.dn[0] / sensor.white_dn).numpy(), sensor), ZOOM, 0), ZOOM, 1)
    signs = torch.tensor([[1.0 if corner >> axis & 1 else -1.0 for axis in range(3)] for corner in range(8)])
    corners = box.centre + (signs * box.half_extents) @ box.axes.T
    for point in _pixels(gaussians.means[behind], pose, batch.cameras.K[0]):
        _line(image, point - 0.3, point + 0.3, YELLOW)
    corners_px = _pixels(corners, pose, batch.cameras.K[0])
    for a, b in EDGES:
        _line(image, corners_px[a], corners_px[b], BLUE)
    top, left = tile
    bottom, right = top + obb.TILE_ROWS, left + obb.TILE_COLUMNS
    square = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=float)
    for a in range(4):
        _line(image, square[a], square[(a + 1) % 4], RED)
    out = Path(__file__).with_name("obb.png")
    out.write_bytes(bytes(imagecodecs.png_encode(image, level=9)))
    print(f"{out}: {int(behind.sum())} Gaussians behind the tile at row {top}, column {left}")


def _pixels(points: torch.Tensor, world_to_camera: torch.Tensor, K: torch.Tensor) -> np.ndarray:
    p = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ K.T
    return (p[:, :2] / p[:, 2:]).numpy()


def _line(image: np.ndarray, start: np.ndarray, end: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Draw a line between two places, px of the frame, on the enlarged image."""
    count = 2 + int(2 * ZOOM * np.abs(end - start).max())
    for x, y in np.linspace(start, end, count) * ZOOM:
        if 0 <= int(y) < image.shape[0] and 0 <= int(x) < image.shape[1]:
            image[int(y), int(x)] = colour


if __name__ == "__main__":
    main(Path(sys.argv[1]))
