"""Pictures of a video: the sharpest of each of some equal spans of time, as files that structure from motion reads.

The reader is that of FFmpeg in OpenCV, which turns frames upright as the file says and gives 8 bits a colour.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from ground.formats.pictures.files import MOST_PX, FormatError
from obbgs_base.errors import Interrupted
from obbgs_base.files import write_whole

FRAMES = 120  # of a video, unless it is said otherwise
# containers whose contents are the video itself; playlists, which FFmpeg reads too, could lead anywhere
CONTAINERS = {
    "Matroska or WebM": ((0, b"\x1a\x45\xdf\xa3"),),
    "AVI": ((0, b"RIFF"),),
    "MP4 or MOV": tuple((4, kind) for kind in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")),
    "MPEG": ((0, b"\0\0\x01\xba"), (0, b"\0\0\x01\xb3"), (0, b"\x47")),
}
ENDS_EARLY = 2.0  # times the longest step between frames that a file may lack at its end
SHARPNESS_PX = 640  # of the longer side, at which frames are judged
log = logging.getLogger(__name__)


def frame_name(number: int) -> str:
    """Return the name of the picture of a video's frame, counted from 0."""
    return f"{number:06d}.png"


def write_frames(
    video: Path, folder: Path, count: int = FRAMES, should_stop: Callable[[], bool] = lambda: False
) -> list[int]:
    """Write the sharpest frame of each of `count` equal spans of a video's time into a folder; return their numbers.

    Spans are of presentation times, so that a frame rate that changes does not matter; a span without a frame gives
    none. Sharpness is the variance of the Laplacian (Pech-Pacheco et al. 2000), which tells only frames of like content
    apart, such as those of one span. What cannot be decoded is passed over; where the file ends before the time that it
    states, the last frame may be half a frame and is left out.

    Raises:
        FormatError: it is no video, or no frame can be read.
        Interrupted: `should_stop` returned true.
    """
    import cv2  # here and below: the ground station starts without it

    times_s, sharpness, numbers = [], [], []
    with_frames = _opened(video)
    rate, stated = (float(with_frames.get(key)) for key in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
    for number, time_s, frame in _frames(with_frames, video, should_stop):
        numbers.append(number)
        times_s.append(time_s)
        sharpness.append(_sharpness(frame))
    if not numbers:
        raise FormatError(f"{video}: no frame can be read; it may be cut off or damaged: copy it again")
    at = np.array(times_s)
    if (np.diff(at) <= 0).any():
        log.warning("%s: states no increasing times for its frames: they count as evenly spread", video)
        at = np.array(numbers) / (rate if rate > 0 else 1.0)
    steps = np.diff(at) if len(at) > 1 else np.ones(1)
    length_s = stated / rate if rate > 0 and stated > 0 else 0.0
    if len(at) > 1 and length_s - at[-1] > ENDS_EARLY * steps.max():
        log.warning(
            "%s: ends after %.1f of the %.1f s that it states: it is cut off or damaged; the last frame that could be "
            "read is left out, as it may be half",
            *(video, at[-1], length_s),
        )
        at, numbers, sharpness = at[:-1], numbers[:-1], sharpness[:-1]
    span_s = (at[-1] - at[0] + float(np.median(steps))) / count
    chosen: dict[int, int] = {}
    for i, time_s in enumerate(at):
        span = min(int((time_s - at[0]) / span_s), count - 1)
        if span not in chosen or sharpness[i] > sharpness[chosen[span]]:
            chosen[span] = i
    taken = sorted(numbers[i] for i in chosen.values())
    log.info("%s: %d of %d frames, the sharpest in every %.3g s", video, len(taken), len(numbers), span_s)
    _write(video, folder, taken, should_stop)
    return taken


def write_masks(
    video: Path, folder: Path, names: Sequence[str], should_stop: Callable[[], bool] = lambda: False
) -> None:
    """Write the frames of a video of masks that belong to pictures which `write_frames` wrote, by their numbers.

    Raises:
        FormatError: it is no video, or lacks such a frame.
    """
    _write(video, folder, [int(Path(name).stem) for name in names], should_stop)


def _write(video: Path, folder: Path, numbers: Sequence[int], should_stop: Callable[[], bool]) -> None:
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    wanted = set(numbers)
    for number, _, frame in _frames(_opened(video), video, should_stop):
        if number in wanted:
            colours = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            write_whole(folder / frame_name(number), bytes(imagecodecs.png_encode(colours, level=1)))
            wanted.discard(number)
            if not wanted:
                return
    raise FormatError(
        f"{video}: lacks {len(wanted)} of {len(numbers)} frames, such as number {min(wanted)}; a video of masks has "
        "a frame for each of the pictures' video"
    )


def _opened(video: Path) -> Any:
    """Return an open reader of a video."""
    import cv2

    if not video.is_file():
        raise FormatError(f"{video} is not a file: expected a video")
    with open(video, "rb") as file:
        head = file.read(16)
    marks = [mark for kind in CONTAINERS.values() for mark in kind]
    if not any(head[offset:].startswith(mark) for offset, mark in marks):
        raise FormatError(
            f"{video}: expected a video in {', '.join(CONTAINERS)}; its first bytes are of none"
        )
    reader = cv2.VideoCapture(str(video.resolve()), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    if not reader.isOpened():
        raise FormatError(
            f"{video}: the video cannot be opened: it is cut off, damaged, or of a kind that FFmpeg does not know"
        )
    return reader


def _frames(
    reader: Any, video: Path, should_stop: Callable[[], bool]
) -> Iterator[tuple[int, float, np.ndarray]]:
    """Yield number, presentation time, s, and pixels [H, W, 3] bytes, blue first, of the frames that can be decoded."""
    import cv2

    number = -1
    try:
        while reader.grab():
            number += 1
            if should_stop():
                raise Interrupted(f"stopped at frame {number} of {video}; nothing was written")
            good, frame = reader.retrieve()
            if not good:
                continue
            if max(frame.shape[:2]) > MOST_PX:
                raise FormatError(
                    f"{video}: expected at most {MOST_PX} pixels a side, got {frame.shape[1]}x{frame.shape[0]}"
                )
            yield number, reader.get(cv2.CAP_PROP_POS_MSEC) / 1e3, frame
    finally:
        reader.release()


def _sharpness(frame: np.ndarray) -> float:
    import cv2

    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    share = SHARPNESS_PX / max(grey.shape)
    if share < 1:
        grey = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())
