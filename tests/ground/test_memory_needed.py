"""What a training is estimated to need in memory, against what trainings were seen to take."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from ground.run.cluster import frames_mb, needed_mb
from ground.session.folder import open_session
from tests.benchmarks.rows import FOLDER, ROOT

ROWS = [json.loads(line) for line in (FOLDER / "memory.jsonl").read_text().splitlines()]
NOW = [row for row in ROWS if "before" not in row["condition"]]
SMALL = ROOT / "examples" / "small_session"
RNG = np.random.default_rng(0)


def estimated_mb(dn: np.ndarray, count: int) -> float:
    camera = SimpleNamespace(width=dn.shape[1], height=dn.shape[0], channels=1)
    frames = list(range(count))
    return frames_mb(
        SimpleNamespace(camera=camera, frames=frames, dn=lambda record: dn, is_whole=lambda record: True)
    )


@pytest.mark.parametrize("row", NOW, ids=lambda row: row["condition"])
def test_a_training_is_estimated_to_need_what_one_was_seen_to_take(row):
    dn = np.full((3072, 4096), 64, dtype=np.uint16)
    dn[512:2560, 1024:3072] = RNG.integers(
        64, 4095, (2048, 2048)
    )  # a third of the picture, as in the benchmark
    estimate_gb = needed_mb(estimated_mb(dn, int(row["condition"].split()[0])), 5000) / 1e3
    assert 0.95 * row["peak_gb"] < estimate_gb < 1.3 * row["peak_gb"]


def test_frames_that_are_mostly_black_are_estimated_to_need_less():
    lit = RNG.integers(64, 4095, (1000, 1200)).astype(np.uint16)
    strip = np.where(abs(np.arange(1200) - 600) <= 60, lit, 64).astype(np.uint16)
    of_each_mb = [(estimated_mb(dn, 100) - estimated_mb(dn, 0)) / 100 for dn in (lit, strip)]
    assert of_each_mb == pytest.approx([1.55 * 2.4, 1.55 * 0.24], rel=0.02)  # 16 bits a pixel, and the start


def test_a_damaged_picture_is_not_asked_what_frames_need(tmp_path):
    shutil.copytree(SMALL, tmp_path / "s")
    whole_mb = frames_mb(open_session(tmp_path / "s"))
    picture = tmp_path / "s" / "frames" / "000000.png"
    picture.write_bytes(picture.read_bytes()[:-20])
    assert frames_mb(open_session(tmp_path / "s")) == whole_mb
