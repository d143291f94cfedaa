"""Which frames are worth sending first: those that the uplinked model predicts worst. onnxruntime and numpy only."""

import hashlib
import logging
import math
import os
import queue
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.errors import TriageError
from flightsw.icd.frame import Frame, decode_frame
from flightsw.icd.packet import PacketError
from flightsw.model_file import verified_model

log = logging.getLogger(__name__)

TILE_ROWS, TILE_COLUMNS = 20, 40  # px, as in the ground's densification
FACTS = ("black_dn", "white_dn", "dn_per_radiance_s", "electrons_per_dn", "read_noise_dn")
NICENESS = 10  # of the ranking thread: the link goes first
INPUTS = {"world_to_camera": [4, 4], "K": [3, 3], "exposure_time_s": []}
SUN_INPUT = {"sun_dir": [3]}  # of a model whose radiance turns with the Sun


@dataclass(frozen=True)
class Ranked:
    """One frame's place: the mean chi² of its worst tile (1 is noise), and where that tile is.

    A frame taken in eclipse or with a pose that is not valid is not `comparable`: its chi² says nothing about
    the model.
    """

    frame_id: int
    path: Path
    worst_chi2: float
    mean_chi2: float
    tile_row_px: int
    tile_column_px: int
    comparable: bool


class Renderer:
    """An uplinked model, verified before it is run, on one core of onnxruntime.

    Raises:
        TriageError: not a model, too large, not of standard operators, not all in one file, or without what triage
            needs.
    """

    def __init__(self, path: Path, threads: int = 1):
        try:
            import onnxruntime
        except ImportError as error:
            raise TriageError("triage needs onnxruntime: install obbgs[onnx]") from error
        content = verified_model(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 3
        options.add_session_config_entry("session.load_model_format", "ONNX")  # the format that was verified
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base class; the file is from the link
            raise TriageError(
                f"{path} is not a model that onnxruntime accepts: {str(error)[:200]}"
            ) from error
        metadata = self._session.get_modelmeta().custom_metadata_map
        try:
            self.width, self.height = int(metadata["width"]), int(metadata["height"])
            self.sensor = {name: float(metadata[name]) for name in FACTS}
        except (KeyError, ValueError) as error:
            raise TriageError(f"{path} lacks metadata that triage needs: {error}") from error
        sensor = self.sensor
        if not (
            all(math.isfinite(value) for value in sensor.values())
            and sensor["white_dn"] > sensor["black_dn"] >= 0 <= sensor["read_noise_dn"]
            and sensor["electrons_per_dn"] > 0
        ):
            raise TriageError(f"{path} has metadata that is no sensor: {sensor}")
        inputs = {i.name: i.shape for i in self._session.get_inputs()}
        outputs = {o.name: o.shape for o in self._session.get_outputs()}
        size = [self.height, self.width]
        self.turns_with_sun = "sun_dir" in inputs
        known = INPUTS | SUN_INPUT if self.turns_with_sun else INPUTS
        if inputs != known or outputs.get("image") not in ([*size, 1], [*size, 3]):
            raise TriageError(f"{path} takes {inputs} and gives {outputs}: not a renderer of ours")
        self.channels: int = outputs["image"][2]

    def expected_dn(
        self,
        world_to_camera: np.ndarray,
        K: np.ndarray,
        exposure_time_s: float,
        sun_dir: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the image [H, W, C] that the model expects, digital numbers, clipped at full scale.

        Args:
            sun_dir: [3] unit, target to Sun, body frame; needed where the model's radiance turns with the Sun.

        Raises:
            TriageError: the model fails while it runs, its image is not of numbers or of another shape, or it needs the
                Sun's direction and there is none.
        """
        feed = {
            "world_to_camera": world_to_camera.astype(np.float32),
            "K": K.astype(np.float32),
            "exposure_time_s": np.array(exposure_time_s, dtype=np.float32),
        }
        if self.turns_with_sun:
            if sun_dir is None:
                raise TriageError(
                    "the model's radiance turns with the Sun: give sun_dir, the Sun's direction"
                )
            feed["sun_dir"] = sun_dir.astype(np.float32)
        try:
            image = np.asarray(self._session.run(["image"], feed)[0])
        except Exception as error:  # as above
            raise TriageError(f"the model fails while it renders: {str(error)[:200]}") from error
        if image.shape != (self.height, self.width, self.channels) or not np.isfinite(image).all():
            raise TriageError(f"the model's image {image.shape} is not finite or not of the promised shape")
        return image * self.sensor["white_dn"]


def rank_frames(model: Path, frames: Path, K: np.ndarray) -> tuple[list[Ranked], int]:
    """Return the stored frames, worst predicted first, and how many containers could not be read.

    Frames that are not comparable come last, whatever their chi².

    Args:
        frames: a folder of .obf containers, or a store that has one.
        K: [3, 3] px, the camera's.

    Raises:
        TriageError: no usable model, no frames, or frames of another size or number of channels.
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
    return sorted(ranked, key=lambda r: (not r.comparable, -r.worst_chi2, r.frame_id)), unreadable


def _rank(renderer: Renderer, frame: Frame, path: Path, K: np.ndarray) -> Ranked:
    if frame.dn.shape[:2] != (renderer.height, renderer.width):
        raise TriageError(
            f"frame {frame.frame_id} is {frame.dn.shape[1]}x{frame.dn.shape[0]} px, the model renders "
            f"{renderer.width}x{renderer.height}: export one for this camera"
        )
    channels = 1 if frame.dn.ndim == 2 else frame.dn.shape[2]
    if channels != renderer.channels:
        raise TriageError(
            f"frame {frame.frame_id} has {channels} channels, the model renders {renderer.channels}"
        )
    expected = renderer.expected_dn(frame.world_to_camera, K, frame.exposure_time_s, frame.pose.sun_dir_body)
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
        frame.pose.valid and not frame.pose.in_eclipse,
    )


@dataclass(frozen=True)
class ModelVerified:
    """How the verification of a model file ended; `problem` is None for one that ranks frames from now on."""

    path: Path
    sha256: bytes
    problem: str | None


class TriageWorker:
    """Verifies models and ranks frames in a thread of its own, while the link goes on."""

    def __init__(self, K: np.ndarray, width: int, height: int):
        self._K, self._size = K, (width, height)
        self._renderer: Renderer | None = None
        self._tasks: queue.SimpleQueue[tuple[Path, bool] | None] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[ModelVerified | tuple[Path, Ranked | None]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="triage", daemon=True)

    def verify(self, model: Path) -> None:
        """Look at a model file; if it is good, later frames are ranked by it."""
        self._put(model, True)

    def rank(self, container: Path) -> None:
        """Rank a stored frame by the newest model."""
        self._put(container, False)

    def results(self) -> list[ModelVerified | tuple[Path, Ranked | None]]:
        """Return what was done since the last call, in order; None for a frame that cannot be ranked."""
        done = []
        while not self._results.empty():
            done.append(self._results.get())
        return done

    def stop(self) -> None:
        """End after the task under way; the others are forgotten."""
        if self._thread.is_alive():
            while not self._tasks.empty():
                self._tasks.get()
            self._tasks.put(None)
            self._thread.join()

    def _put(self, path: Path, is_model: bool) -> None:
        if not self._thread.is_alive():
            self._thread.start()
        self._tasks.put((path, is_model))

    def _run(self) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)  # of this thread alone, on Linux
        while (task := self._tasks.get()) is not None:
            path, is_model = task
            if is_model:
                self._results.put(self._verified(path))
            else:
                self._results.put((path, self._ranked(path)))

    def _ranked(self, path: Path) -> Ranked | None:
        if self._renderer is None:
            return None
        try:
            return _rank(self._renderer, decode_frame(path.read_bytes()), path, self._K)
        except (PacketError, OSError, TriageError) as error:
            log.warning("%s cannot be ranked: %s", path.name, error)
            return None

    def _verified(self, path: Path) -> ModelVerified:
        try:
            sha256 = hashlib.sha256(path.read_bytes()).digest()
            renderer = Renderer(path)
            if (renderer.width, renderer.height) != self._size:
                width, height = self._size
                raise TriageError(
                    f"the model renders {renderer.width}x{renderer.height}, the camera has {width}x{height}"
                )
        except (TriageError, OSError) as error:
            return ModelVerified(path, b"", str(error))
        self._renderer = renderer
        return ModelVerified(path, sha256, None)


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
