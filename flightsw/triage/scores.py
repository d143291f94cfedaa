"""Which frames are sent first: those that the uplinked model predicts worst and that show something new.

The residual alone would send the best lit side again and again: it has the most light and so the largest chi², and all
exposures of a bracket show it. So a residual counts less the closer its view is to one that the ground has already, or
will receive earlier. Needs onnxruntime and numpy only.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.errors import TriageError, TriageMissing
from flightsw.icd.frame import FLAG_ECLIPSE, FLAG_POSE_VALID, Frame, decode_frame, read_header
from flightsw.icd.model_file import MAX_MODEL_BYTES, SENSOR_METADATA, ModelUnfit, check_model
from flightsw.icd.packet import PacketError
from obbgs_base.errors import reason
from obbgs_base.extras import install_command

TILE_ROWS, TILE_COLUMNS = 20, 40  # px, as in the ground's densification
# views so far apart share exp(-1/2) of what they show: about how far a face can be seen from
SIMILAR_RAD = 0.7
NOISE_CHI2 = 1.25  # below it is the worst tile of pure noise: 1 on average, a deviation of 0.05 for 800 px
REPEAT = 0.05  # novelty of a view that was sent already: its noise differs
INPUTS = {"world_to_camera": [4, 4], "K": [3, 3], "exposure_time_s": []}
SUN_INPUT = {"sun_dir": [3]}  # of a model whose radiance turns with the Sun


@dataclass(frozen=True)
class Ranked:
    """How well the model predicts one frame: the mean chi² of its worst tile (1 is noise), and where that tile is.

    A frame taken in eclipse or with a pose that is not valid is not `comparable`: its chi² says nothing about
    the model. `view` is the direction from the target to the camera, then to the Sun: two unit vectors, body frame.
    """

    frame_id: int
    path: Path
    worst_chi2: float
    mean_chi2: float
    tile_row_px: int
    tile_column_px: int
    comparable: bool
    view: tuple[float, ...]

    @property
    def residual_sigmas(self) -> float:
        """The root mean square residual of the worst tile beyond what noise can do, in sigmas of a pixel's noise."""
        return math.sqrt(max(self.worst_chi2 - NOISE_CHI2, 0.0))


def verified_model(path: Path) -> bytes:
    """Return the bytes of a model file after looking at everything in it; one that is too large is not read.

    Raises:
        TriageError: unreadable, or not a model that may be run.
    """
    try:
        if (size_bytes := path.stat().st_size) > MAX_MODEL_BYTES:
            raise TriageError(f"{path} has {size_bytes} bytes; the limit is {MAX_MODEL_BYTES}")
        content = path.read_bytes()
        check_model(content)
    except OSError as error:
        raise TriageError(f"{path}: {reason(error)}") from error
    except ModelUnfit as error:
        raise TriageError(f"{path} {error}") from error
    return content


class Renderer:
    """An uplinked model, verified before it is run, on one core of onnxruntime.

    Raises:
        TriageError: not a model, too large, not of standard operators, not all in one file, or without what triage
            needs.
        TriageMissing: onnxruntime is not installed.
    """

    def __init__(self, path: Path, threads: int = 1):
        try:
            import onnxruntime
        except ImportError as error:
            raise TriageMissing(f"triage needs onnxruntime: {install_command('onnx')}") from error
        content = verified_model(path)
        self.sha256 = hashlib.sha256(content).digest()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 3
        options.add_session_config_entry("session.load_model_format", "ONNX")  # the format that was verified
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base class; the file is from the link
            raise TriageError(
                f"{path} is not a model that onnxruntime accepts: {str(error).rpartition(' : ')[2][:200]}"
            ) from error
        metadata = self._session.get_modelmeta().custom_metadata_map
        try:
            self.width, self.height = int(metadata["width"]), int(metadata["height"])
            self.sensor = {name: float(metadata[name]) for name in SENSOR_METADATA}
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
    """Return the stored frames, the most informative first, and how many could not be read.

    The order is that of the downlink if nothing was sent yet.

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
        ranked.append(rank_frame(renderer, frame, path, K))
    return sending_order(ranked, []), unreadable


def sending_order(
    ranked: Sequence[Ranked], sent: Sequence[tuple[float, ...]], first: int | None = None
) -> list[Ranked]:
    """Return frames in the order in which they should be sent.

    One by one, the frame comes next whose residual (sigmas, worst tile) times the novelty of its view is largest. The
    novelty is 1 - exp(-d²/2 SIMILAR_RAD²), at least REPEAT, with d the distance of camera and Sun direction from the
    nearest view sent or placed before. Exposures need no rule: of a bracket the one with most signal over noise has
    the largest residual, unless it is saturated, and the others are then repeats. Frames that are not comparable come
    last, oldest first.

    Args:
        sent: the views of frames that are on the ground or in flight.
        first: so many places are decided one by one, the others at once; None: all. It bounds the time.
    """
    candidates = sorted((r for r in ranked if r.comparable), key=lambda r: r.frame_id)
    rest = sorted((r for r in ranked if not r.comparable), key=lambda r: r.frame_id)
    if not candidates:
        return rest
    views = np.array([r.view for r in candidates])
    residuals = np.array([r.residual_sigmas for r in candidates])
    nearest2 = np.full(len(candidates), np.inf)  # squared distance from the nearest view sent or placed
    if sent:
        others = np.array(sent)
        nearest2 = ((others**2).sum(axis=1) - 2 * views @ others.T).min(axis=1) + (views**2).sum(axis=1)
    waiting = np.ones(len(candidates), dtype=bool)
    placed: list[int] = []
    while waiting.any():
        novelty = np.maximum(1 - np.exp(-nearest2 / (2 * SIMILAR_RAD**2)), REPEAT)
        worth = np.where(waiting, residuals * novelty, -1)
        if first is not None and len(placed) >= first:
            placed += np.argsort(-worth, kind="stable")[: waiting.sum()].tolist()
            break
        best = int(worth.argmax())
        placed.append(best)
        waiting[best] = False
        nearest2 = np.minimum(nearest2, ((views - views[best]) ** 2).sum(axis=1))
    return [candidates[i] for i in placed] + rest


def sent_view(header: bytes) -> tuple[float, ...] | None:
    """Return the view of the frame with this header of its container; None in eclipse or without a valid pose.

    Raises:
        PacketError: not a header.
    """
    values = read_header(header)
    if values["flags"] & FLAG_ECLIPSE or not values["flags"] & FLAG_POSE_VALID:
        return None
    return _view(np.array(values["position_body_m"]), np.array(values["sun_dir_body"]))


def _view(position_body_m: np.ndarray, sun_dir_body: np.ndarray) -> tuple[float, ...]:
    to_camera = position_body_m / max(float(np.linalg.norm(position_body_m)), 1e-9)
    return (*to_camera.tolist(), *sun_dir_body.tolist())


def rank_frame(renderer: Renderer, frame: Frame, path: Path, K: np.ndarray) -> Ranked:
    """Return how well the model predicts a frame.

    Raises:
        TriageError: the frame has another size or other channels, or the model fails while it renders.
    """
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
    view = _view(frame.pose.position_body_m, frame.pose.sun_dir_body)
    if frame.pose.source == "none":  # nothing to render it from
        return Ranked(frame.frame_id, path, 0.0, 0.0, 0, 0, False, view)
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
        view,
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
