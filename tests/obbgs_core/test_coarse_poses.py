"""Poses that err by a period of a pattern: what pictures say of them at their size, and averaged."""

import numpy as np
import torch

from obbgs_core.batches import Batches
from obbgs_core.frames import TrainingFrame
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance
from obbgs_core.poses.answers import Question
from obbgs_core.render import render
from tests.scenes import FOCAL_PX, RANGE_M, SENSOR, SIZE_PX, intrinsics, pose

PERIOD_PX = 5.0


def solar_cells() -> Gaussians:
    """Return a panel of 7x7 equal bright spots, 5 px apart in pictures."""
    places = torch.arange(-3, 4) * PERIOD_PX * RANGE_M / FOCAL_PX
    means = torch.cartesian_prod(places, places, torch.zeros(1))
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count, 3), 0.07).log(),
        torch.full((count,), 4.0),
        from_radiance(torch.full((count, 1, 1), 0.5)),
    )


def test_averaged_pictures_lead_back_over_a_period_of_a_pattern_and_whole_ones_do_not():
    """Four frames of one pose, of which the first and the third are asked in pictures of a quarter of their size."""
    model, true, K = solar_cells(), pose(np.eye(3)), intrinsics()
    cameras = Cameras(true[None], K[None], SIZE_PX, SIZE_PX)
    dn = SENSOR.expected_dn(render(model, cameras).radiance[0], 1e-4)
    frames = [TrainingFrame(dn, 1e-4, true, K, number) for number in range(4)]
    px_m = RANGE_M / FOCAL_PX
    errors_px = torch.full((4,), PERIOD_PX, dtype=torch.float64)
    batches, coarse = Batches(frames, SENSOR.white_dn), {0: 0.25, 2: 0.25}
    for _ in range(8):
        erring = true.repeat(4, 1, 1)
        erring[:, 0, 3] += errors_px.float() * px_m
        answer = Question(model, batches, [0, 1, 2, 3], erring, SENSOR, 1.0, coarse).answer()
        told = answer.information
        errors_px -= told.gradient[:, 3] / told.curvature[:, 3, 3] / px_m
    assert told.cells is not None and len(told.cells) == 4 and answer.indices == [0, 1, 2, 3]
    assert abs(errors_px[0]) < 1 and errors_px[2] == errors_px[0]
    assert abs(errors_px[1] - PERIOD_PX) < 1 and errors_px[3] == errors_px[1]  # as if it was right
