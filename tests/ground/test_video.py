"""A video becomes a session: its sharp frames, evenly in time, with masks; a damaged end costs its own frames."""

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from ground import cli
from ground.formats.photographs.video import write_frames, write_masks
from ground.formats.pictures.files import FormatError, decode
from ground.session.folder import open_session

SHARP = 1  # of every three frames; the others are blurred
VIEWS = 10
MASKED_ROWS = 120
SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def ground(*arguments: object):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])


def write_video(path: Path, frames, times: list[int] | None = None, codec: str = "FFV1") -> Path:
    """Write frames [H, W, 3] by OpenCV's writer, 30 a second; with times, in thirtieths, as JPEGs at these times."""
    how = [] if times is None else [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1]
    kind = cv2.VideoWriter.fourcc(*(codec if times is None else "MJPG"))
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, kind, 30.0, frames[0].shape[1::-1], how)
    assert writer.isOpened()
    for i, frame in enumerate(frames):
        if times is None:
            writer.write(frame)
        else:
            writer.set(cv2.VIDEOWRITER_PROP_PTS, times[i])
            writer.set(cv2.VIDEOWRITER_PROP_KEY_FLAG, 1)
            writer.write(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
    writer.release()
    return path


def blurred(frame: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(frame, (0, 0), 2.5)


def noise(count: int, sharp: set[int]) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (48, 64, 3)).astype(np.uint8) for _ in range(count)]
    return [frame if i in sharp else blurred(frame) for i, frame in enumerate(frames)]


def cube(turn: Rotation, size_px: int = 240, focal_px: float = 560.0, away_m: float = 4.5) -> np.ndarray:
    """Return a picture [H, W, 3] of a turned cube of 1 m with chequered faces: those that face the camera, warped."""
    picture = np.zeros((size_px, size_px, 3), np.uint8)
    rng = np.random.default_rng(3)
    K = np.array([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for side in (-1, 1):
            cells = cv2.resize(rng.integers(40, 256, (12, 12)).astype(np.uint8), (240, 240), interpolation=0)
            normal, right, down = np.eye(3)[list(axes)] * [[side], [side], [1]]
            corners = 0.5 * np.array([normal + u * right + v * down for u, v in SQUARE])
            at = turn.apply(corners) + np.array([0, 0, away_m])
            if turn.apply(normal) @ at.mean(axis=0) < 0:
                image = (at / at[:, 2:]) @ K.T
                source = np.float32([[120 * (u + 1), 120 * (v + 1)] for u, v in SQUARE])
                warp = cv2.getPerspectiveTransform(source, np.float32(image[:, :2]))
                face, inside = (
                    cv2.warpPerspective(a, warp, (size_px, size_px), flags=cv2.INTER_AREA)
                    for a in (cells, np.full_like(cells, 255))
                )
                picture[inside > 0] = face[inside > 0][:, None]
    return picture


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    """A folder with a video about a cube, two frames of three shaken, and one of masks."""
    folder = tmp_path_factory.mktemp("walk")
    turns = [Rotation.from_euler("XY", [25 + 10 * np.sin(i), 12 * i], degrees=True) for i in range(VIEWS)]
    pictures = [cube(turn) for turn in turns]
    shown = [picture if k == SHARP else blurred(picture) for picture in pictures for k in range(3)]
    write_video(folder / "walk.mkv", shown)
    masks = [np.full_like(picture, 255) for picture in shown]
    for mask in masks:
        mask[:MASKED_ROWS] = 0
    write_video(folder / "masks.mkv", masks)
    return folder


def test_the_sharp_frames_of_a_video_get_cameras_and_masks(walk, tmp_path):
    session = tmp_path / "s"
    options = ("--frames", VIEWS, "--masks", walk / "masks.mkv")
    done = ground("import", "--format", "video", "--from", walk / "walk.mkv", "--session", session, *options)
    assert done.exit_code == 0, done.output
    opened = open_session(session)
    assert len(opened.frames) >= VIEWS - 2
    assert {path.name for path in session.iterdir()} == {"frames", "frames.jsonl", "session.json"}
    sharp = [cv2.Laplacian(opened.dn(r).astype(float)[..., 0], cv2.CV_64F).var() for r in opened.frames]
    assert min(sharp) > 0.3 * max(sharp)  # a blurred one has a fiftieth
    for record in opened.frames:
        above = slice(MASKED_ROWS - 30)  # the lens that was estimated moves the edge by some pixels
        assert not opened.dn(record)[above].any() and opened.dn(record)[MASKED_ROWS:].any()


def test_frames_are_the_sharpest_of_equal_spans_of_time(tmp_path):
    sharp = {3, 12, 28, 31}
    taken = write_frames(write_video(tmp_path / "a.mkv", noise(40, sharp)), tmp_path / "out", 4)
    assert taken == sorted(sharp)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"{i:06d}.png" for i in taken]
    # lossless: red first, as pictures have it
    np.testing.assert_array_equal(decode(tmp_path / "out" / "000012.png"), noise(40, sharp)[12][..., ::-1])


def test_spans_are_of_presentation_times_where_the_frame_rate_changes(tmp_path):
    """30 frames in the first second, then 2 in each of three."""
    times = [*range(30), 30, 45, 60, 75, 90, 105]
    video = write_video(tmp_path / "a.mp4", noise(36, {10, 31, 32, 35}), times)
    assert write_frames(video, tmp_path / "out", 4) == [10, 31, 32, 35]


def test_a_damaged_end_costs_its_own_frames(tmp_path, caplog):
    frames = noise(30, set(range(30)))
    whole = write_video(tmp_path / "a.avi", frames, codec="MJPG")
    with caplog.at_level(logging.WARNING):
        kept = write_frames(whole, tmp_path / "whole", 30)
    assert kept == list(range(30)) and not caplog.records
    content = whole.read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) * 2 // 3])
    with caplog.at_level(logging.WARNING):
        left = write_frames(tmp_path / "cut.avi", tmp_path / "cut", 20)
    assert "of the 1.0 s that it states" in caplog.text
    assert 10 < max(left) < 20
    for number in left:
        name = f"{number:06d}.png"
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "expected a video in"),
        (b"#EXTM3U\n#EXTINF:1,\n/etc/passwd\n", "expected a video in"),
        (b"\0\0\0\x18ftypisom" + bytes(100), "cannot be opened"),
        (None, "is not a file"),
    ],
)
def test_what_is_no_video_is_refused_in_a_line(tmp_path, content, said):
    video = tmp_path / "a.mp4"
    if content is not None:
        video.write_bytes(content)
    done = ground("import", "--format", "video", "--from", video, "--session", tmp_path / "s")
    assert isinstance(done.exception, FormatError) and len(str(done.exception).splitlines()) == 1
    with pytest.raises(FormatError, match=said):
        raise done.exception


def test_a_video_of_masks_that_is_shorter_is_told(walk, tmp_path):
    write_video(tmp_path / "short.mkv", [np.full((160, 160, 3), 255, np.uint8)] * 3)
    with pytest.raises(FormatError, match=r"lacks 1 of 2 frames, such as number 7"):
        write_masks(tmp_path / "short.mkv", tmp_path / "out", ["000001.png", "000007.png"])
