"""Whether stated deviations of poses hold: many passes are drawn from the priors, and errors compared with deviations.

Pictures are linear here, so that the posterior is known to be normal; how far real models break this is what the
benchmark `poses` measures and `DOUBT` is for.
"""

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from obbgs_base.physics.navigation_errors import NominalMotion, SharedParameters
from obbgs_core.frames import Navigation, TrainingFrame
from obbgs_core.poses.corrections import DOUBT, PoseCorrections
from obbgs_core.poses.registration import PoseInformation, _cell_information
from tests import scenes

FRAMES, CUBES, DRAWS = 12, 5, 60
VALUES = 40  # compared in each picture
RANGE_M, CELL_M = 60.0, 0.1
SIGMAS = SharedParameters(
    position_m=[1, 1, 1], velocity_m_s=[1e-3] * 3, boresight_rad=[0.01] * 3, rate_rad_s=[3e-5] * 3
)
UNITS = torch.tensor([1e-3] * 3 + [RANGE_M * 1e-3] * 3).double()  # motions that move values by a deviation


def frames_of_a_pass() -> list[TrainingFrame]:
    """Return frames of a camera that stands beside a spinning body, with what their tags state."""
    times, rate = np.linspace(0, 1500, FRAMES), np.array([0.0, 0.0, 0.02])
    angles = rate[2] * times
    bodies = np.stack([[[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles])
    camera = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    places = np.tile([RANGE_M, 0.0, 0.0], (FRAMES, 1))
    motion = NominalMotion(times, places, np.tile(camera, (FRAMES, 1, 1)), bodies, 1e-3, rate_rad_s=rate)
    navigation = Navigation(SIGMAS, motion.mean_motion_rad_s, motion.inertial_to_rtn, motion.rate_rad_s)
    own = torch.diag(torch.tensor([1e-4] * 3 + [1e-3] * 3).double() ** 2)
    return [
        TrainingFrame(
            torch.zeros(1, 1, 1),
            1e-4,
            torch.from_numpy(motion.world_to_camera[i]).float(),
            scenes.intrinsics(1, 1.0),
            i,
            i,
            pose_covariance=own,
            navigation=navigation,
            time_s=float(times[i]),
            inertial_to_body=torch.from_numpy(bodies[i]),
        )
        for i in range(FRAMES)
    ]


def gather_a_draw(poses: PoseCorrections, moving: bool, generator: torch.Generator) -> tuple:
    """Let pictures tell of errors that are drawn from the priors; return these, shared [S] and own [P, 6].

    Args:
        moving: whether the surface's cubes and the body as a whole are where their priors put them too.
    """

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    shared, own, cubes, body = drawn(poses.by_shared.shape[2]), drawn(FRAMES, 6), drawn(CUBES, 3), drawn(7)
    told = []
    for i in range(FRAMES):
        rows = drawn(VALUES, 6) / UNITS
        numbers, place = torch.arange(CUBES), torch.arange(VALUES) % CUBES
        by_point = rows[:, 3:] @ poses.tags[i, :3, :3]
        motion = poses.whitening.root[i].double() @ own[i] + poses.by_shared[i] @ shared
        residual = drawn(VALUES)
        if moving:
            motion = motion + poses.body_motions()[i] @ body
            residual = residual - (by_point * CELL_M * cubes[place]).sum(1)
        residual = residual - rows @ motion
        cells = _cell_information(numbers, place, rows, by_point, torch.ones(VALUES).double(), residual)
        told.append((rows.T @ residual, rows.T @ rows, cells))
    gradients, curvatures, cells = zip(*told, strict=True)
    pictures = torch.stack(gradients), torch.stack(curvatures)
    poses.gather(list(range(FRAMES)), PoseInformation(*pictures, list(cells) if moving else None, CELL_M))
    return shared, own


@pytest.mark.parametrize("moving", [False, True], ids=["a model that is known", "a surface that moves along"])
def test_errors_are_as_large_as_the_deviations_say(moving):
    """Squares of the errors in the posterior's own axes follow chi² of as many degrees of freedom as were drawn."""
    frames, generator = frames_of_a_pass(), torch.Generator().manual_seed(3)
    of_shared, of_own, stated = 0.0, 0.0, 0.0
    for _ in range(DRAWS):
        poses = PoseCorrections(frames)
        shared, own = gather_a_draw(poses, moving, generator)
        of_all, of_brackets = poses.left_open()
        covariance = torch.from_numpy(poses.estimate(frames).shared_covariance)[poses.free][:, poses.free]
        poses.step(frames, poses.body_motions() if moving else None, CELL_M)
        off = (poses.shared / poses.sigmas)[poses.free] - shared
        off_own = poses.value[0].double() - own[0]
        of_shared += float(off @ torch.linalg.solve(of_all, off))
        of_own += float(off_own @ torch.linalg.solve(of_brackets[0], off_own))
        scaled = covariance / (poses.sigmas[poses.free][:, None] * poses.sigmas[poses.free])
        stated += float(off @ torch.linalg.solve(scaled, off))
    for found, count in ((of_shared, 12 * DRAWS), (of_own, 6 * DRAWS)):
        # one draw of a million lies outside
        assert chi2.ppf(5e-7, count) < found < chi2.ppf(1 - 5e-7, count), found / count
    # what is stated is wider, by `DOUBT` at most
    assert of_shared / DOUBT**2 < stated < 0.7 * of_shared
