"""Baselines without training, on targets small enough to work them out, and bars that they do not pass."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor
from obbgs_core.train.presets import preset
from tests import baselines
from tests.benchmarks import stability, targets

GOLDEN = Path(__file__).parent / "golden" / "session"
SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=4.0, read_noise_dn=8.0)
K = torch.tensor([[60.0, 0, 8], [0, 60.0, 8], [0, 0, 1]])
QUICK = {"steps": 30, "start.count": 300, "growth.max_gaussians": 300}


def view(dn: float, exposure_s: float) -> TrainingFrame:
    pose = torch.eye(4)
    pose[2, 3] = 5.0
    return TrainingFrame(torch.full((16, 16, 1), dn), exposure_s, pose, K)


def flat_target(*training_dn: float) -> targets.Target:
    """Return a target whose held-out frame reads 64 + 403.1 DN (0.1 of full scale) in its upper half, 64 below."""
    exact = torch.full((16, 16, 1), 64 / 4095)
    exact[:8] += 403.1 / 4095
    coverage = torch.zeros(16, 16)
    coverage[:8] = 1
    frames = [view(dn, 1e-4) for dn in training_dn] + [view(4000.0, 2e-4)]
    return targets.Target("flat", SENSOR, frames, [view(0.0, 1e-4)], [exact], [coverage], np.zeros((1, 3)))


def test_a_black_image_is_the_black_level_everywhere():
    score = baselines.black(flat_target(64.0))
    signal = 403.1 / 4095
    assert score.clean_db == pytest.approx(-10 * math.log10(signal**2 / 2), abs=1e-3)
    assert score.foreground_db == pytest.approx(-20 * math.log10(signal), abs=1e-3)


def test_the_mean_image_is_of_the_frames_of_the_same_exposure():
    below = flat_target(44.0, 64.0, 84.0)  # their mean is the black level
    assert baselines.mean_image(below).clean_db == pytest.approx(baselines.black(below).clean_db, abs=1e-4)
    assert baselines.mean_image(flat_target()).clean_db < 2  # only a bright frame of another exposure


def test_on_the_golden_session_a_black_image_passes_a_bar_of_30_db_and_no_bar_of_its_own():
    target = targets.from_session(GOLDEN)
    config = preset("obbgs", QUICK)
    black, mean = baselines.black(target), baselines.mean_image(target)
    start = baselines.untrained(target, config)
    assert black.clean_db > 33 and mean.clean_db < black.clean_db and start.clean_db < black.clean_db
    assert not stability.exceeds(black.clean_db, black.clean_db, mean.clean_db, start.clean_db)


@pytest.mark.parametrize(("psnr_db", "ok"), [(math.nan, False), (24.6, False), (25.3, False), (25.5, True)])
def test_a_stability_row_is_ok_only_clearly_above_every_baseline(psnr_db, ok):
    assert stability.exceeds(psnr_db, 24.43, 20.0, 22.0) == ok
    assert stability.exceeds(psnr_db, 20.0, 24.43, 22.0) == ok
    assert stability.exceeds(psnr_db, 20.0, 22.0, 24.43) == ok


def test_a_stability_row_shows_its_baselines():
    target, config = targets.from_session(GOLDEN), preset("obbgs", QUICK)
    row = stability.baselines_of(target, config, seed=0)
    assert list(row) == ["mean_image_db", "black_db", "untrained_db"]
    assert row["untrained_db"] == round(baselines.untrained(target, config).clean_db, 3)
    with pytest.raises(ReconstructionError):
        stability.baselines_of(stability.in_eclipse(target, 0.0, 1.0), config, 0)
