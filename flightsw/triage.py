"""Which frames are worth sending first: those that the uplinked model predicts worst. onnxruntime and numpy only."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.errors import TriageError
from flightsw.icd.frame import Frame, decode_frame
from flightsw.icd.packet import PacketError

MAX_MODEL_BYTES = 64 * 1024 * 1024
TILE_ROWS, TILE_COLUMNS = 20, 40  # px, as in the ground's densification
FACTS = ("black_dn", "white_dn", "dn_per_radiance_s", "electrons_per_dn", "read_noise_dn")


@dataclass(frozen=True)
class Ranked:
    """One frame's place: the mean chi² of its worst tile (1 is noise), and where that tile is."""

    frame_id: int
    path: Path
    worst_chi2: float
    mean_chi2: float
    tile_row_px: int
    tile_column_px: int


class Renderer:
    """An uplinked model, verified before it is run, on one core of onnxruntime.

    Raises:
        TriageError: not a model, too large, not of standard operators, or without what triage needs.
    """

    def __init__(self, path: Path, threads: int = 1):
        try:
            import onnxruntime
        except ImportError as error:
            raise TriageError("triage needs onnxruntime: install obbgs[onnx]") from error
        try:
            size_bytes = path.stat().st_size
        except OSError as error:
            raise TriageError(f"{path}: {error.strerror}") from error
        if size_bytes > MAX_MODEL_BYTES:
            raise TriageError(f"{path} has {size_bytes} bytes; the limit is {MAX_MODEL_BYTES}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 3
        try:
            # without custom operator libraries registered, onnxruntime itself refuses any other operator
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's errors share no base class; the file is from the link
            raise TriageError(
                f"{path} is not a model that onnxruntime accepts: {str(error)[:200]}"
            ) from error
        inputs = {i.name for i in self._session.get_inputs()}
        outputs = {o.name for o in self._session.get_outputs()}
        if inputs != {"world_to_camera", "K", "exposure_time_s"} or not {"image", "alpha"} <= outputs:
            raise TriageError(
                f"{path} takes {sorted(inputs)} and gives {sorted(outputs)}: not a renderer of ours"
            )
        metadata = self._session.get_modelmeta().custom_metadata_map
        try:
            self.width, self.height = int(metadata["width"]), int(metadata["height"])
            self.sensor = {name: float(metadata[name]) for name in FACTS}
        except (KeyError, ValueError) as error:
            raise TriageError(f"{path} lacks metadata that triage needs: {error}") from error
        if not all(math.isfinite(value) for value in self.sensor.values()):
            raise TriageError(f"{path} has metadata that is not finite: {self.sensor}")

    def expected_dn(self, world_to_camera: np.ndarray, K: np.ndarray, exposure_time_s: float) -> np.ndarray:
        """Return the image [H, W, C] that the model expects, digital numbers, clipped at full scale."""
        feed = {
            "world_to_camera": world_to_camera.astype(np.float32),
            "K": K.astype(np.float32),
            "exposure_time_s": np.array(exposure_time_s, dtype=np.float32),
        }
        (image,) = self._session.run(["image"], feed)
        return np.asarray(image) * self.sensor["white_dn"]


def rank_frames(model: Path, frames: Path, K: np.ndarray) -> tuple[list[Ranked], int]:
    """Return the stored frames, worst predicted first, and how many containers could not be read.

    Args:
        frames: a folder of .obf containers, or a store that has one.
        K: [3, 3] px, the camera's.

    Raises:
        TriageError: no usable model, no frames, or frames of another size.
    """
    renderer = Renderer(model)
    folder = frames / "frames" if (frames / "frames").is_dir() else frames
    paths = sorted(folder.glob("*.obf"))
    if not paths:
        raise TriageError(f"{folder} holds no stored frames (*.obf)")
    ranked, unreadable = [], 0
    for path in paths:
        try:
            frame = decode_frame(path.read_bytes())
        except (PacketError, OSError):
            unreadable += 1
            continue
        ranked.append(_rank(renderer, frame, path, K))
    return sorted(ranked, key=lambda r: (-r.worst_chi2, r.frame_id)), unreadable


def _rank(renderer: Renderer, frame: Frame, path: Path, K: np.ndarray) -> Ranked:
    if frame.dn.shape[:2] != (renderer.height, renderer.width):
        raise TriageError(
            f"frame {frame.frame_id} is {frame.dn.shape[1]}x{frame.dn.shape[0]} px, the model renders "
            f"{renderer.width}x{renderer.height}: export one for this camera"
        )
    expected = renderer.expected_dn(frame.world_to_camera, K, frame.exposure_time_s)
    chi2 = chi2_map(frame.dn.reshape(expected.shape), expected, renderer.sensor)
    tiles = tile_means(chi2)
    row, column = np.unravel_index(int(tiles.argmax()), tiles.shape)
    return Ranked(
        frame.frame_id,
        path,
        float(tiles.max()),
        float(chi2.mean()),
        int(row) * TILE_ROWS,
        int(column) * TILE_COLUMNS,
    )


def chi2_map(dn: np.ndarray, expected_dn: np.ndarray, sensor: dict[str, float]) -> np.ndarray:
    """Return the squared residual over its variance (shot + read + rounding) at each pixel [H, W].

    A saturated reading says "at least this much": only a darker prediction counts.
    """
    signal_dn = np.maximum(expected_dn - sensor["black_dn"], 0)
    variance = signal_dn / sensor["electrons_per_dn"] + sensor["read_noise_dn"] ** 2 + 1 / 12
    residual = expected_dn - dn
    residual = np.where(dn >= sensor["white_dn"], np.minimum(residual, 0), residual)
    return (residual**2 / variance).mean(axis=-1)


def tile_means(image: np.ndarray) -> np.ndarray:
    """Return the means over 20 x 40 px tiles; tiles at the right and lower edge may be smaller."""
    rows = np.arange(0, image.shape[0], TILE_ROWS)
    columns = np.arange(0, image.shape[1], TILE_COLUMNS)
    sums, pixels = (
        np.add.reduceat(np.add.reduceat(a, rows, axis=0), columns, axis=1)
        for a in (image, np.ones_like(image))
    )
    return sums / pixels
