"""The latest picture of a session for a terminal: two pixels to a character, an upper half block and its background."""

import itertools
from pathlib import Path

import imagecodecs
import numpy as np
from rich.text import Text

COLUMNS = 36  # characters
BRIGHTEST = 99.8  # percentile that is shown white, so that single hot pixels do not darken the rest


class LatestPicture:
    """The picture that came last into a session: a thumbnail or a whole frame, drawn again only when there is another.

    A picture that cannot be read is left out: the one before it stays.
    """

    def __init__(self, session: Path):
        self._session = session
        self._counts: tuple[int, int] | None = None
        self._shown = Text("none yet")
        self.name = ""

    def after(self, thumbnails: int, frames: int) -> Text:
        """Return the picture when so many thumbnails and frames have come."""
        if (thumbnails, frames) != self._counts:
            self._counts = thumbnails, frames
            try:
                newest = max(self._pictures(), key=lambda path: path.stat().st_mtime_ns, default=None)
                if newest is not None:
                    self._shown = half_blocks(stretched(imagecodecs.png_decode(newest.read_bytes())))
                    self.name = f"{newest.parent.name.removesuffix('s')} {int(newest.stem)}"
            except (OSError, ValueError, RuntimeError):
                pass
        return self._shown

    def _pictures(self) -> list[Path]:
        """Return the thumbnails and frames with the highest number, one each."""
        folders = (self._session / name for name in ("thumbnails", "frames"))
        return [max(pictures) for folder in folders if (pictures := list(folder.glob("[0-9]*.png")))]


def stretched(dn: np.ndarray) -> np.ndarray:
    """Return readings [H, W] or [H, W, 3] as bytes [rows, columns, 3], even rows: the root of them, black to white."""
    image = dn.reshape(*dn.shape[:2], -1).astype(np.float32)
    step = max(1, -(-max(dn.shape[:2]) // COLUMNS))
    blocks = image[::step, ::step]
    black, white = float(np.median(blocks)), float(np.percentile(blocks, BRIGHTEST))
    shown = np.sqrt(np.clip((blocks - black) / max(white - black, 1.0), 0, 1))
    rows = len(shown) // 2 * 2
    return np.broadcast_to((255 * shown[:rows]).round().astype(np.uint8), (rows, shown.shape[1], 3))


def half_blocks(image: np.ndarray) -> Text:
    """Return bytes [H, W, 3] as H / 2 lines of text."""
    text = Text()
    for upper, lower in zip(image[::2].tolist(), image[1::2].tolist(), strict=True):
        for alike, run in itertools.groupby(zip(map(tuple, upper), map(tuple, lower), strict=True)):
            (r, g, b), (s, h, c) = alike
            text.append("▀" * len(list(run)), f"rgb({r},{g},{b}) on rgb({s},{h},{c})")
        text.append("\n")
    return text
