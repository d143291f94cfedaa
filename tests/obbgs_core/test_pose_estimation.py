"""What the frames of a pass say of its poses together: the shared parameters, their certainty, and fair scores."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from skimage import transform

from obbgs_base.physics.navigation_errors import NominalMotion, SharedParameters, displaced_motion
from obbgs_core.errors import ReconstructionError
from obbgs_core.evidence.gains import justified
from obbgs_core.frames import Navigation, TrainingFrame, cameras_of, usable
from obbgs_core.losses import likelihood_loss
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.motions import adjoints, motion_vectors, rigid_motions
from obbgs_core.model.sh import from_radiance
from obbgs_core.poses import corrections, registration
from obbgs_core.poses.corrections import PoseCorrections, with_estimate
from obbgs_core.poses.gauge import best_motion, joined, seen_after, size_of
from obbgs_core.poses.normal_equations import NormalEquations, ReducedEquations
from obbgs_core.poses.registration import CellShifts, pose_information
from obbgs_core.render import render
from obbgs_core.render.slopes import render_with_slopes
from obbgs_core.score.poses import moved, pose_errors, settled_poses
from obbgs_core.start.alignment import _aligned, settled
from obbgs_core.start.initialisation import silhouettes
from obbgs_core.start.silhouette_coherence import _open_directions, coherence, most_coherent, seen_from
from obbgs_core.train.poses import SET_BACK_AT, SET_BACK_TO, SET_BACKS
from obbgs_core.train.trainer import Trainer
from tests import scenes
from tests.scenes import QUICK, SENSOR, target

SIZE, RANGE_M = 48, 60.0
FOCAL_PX = 100.0 * RANGE_M / scenes.RANGE_M
MODEL = target(40, seed=5)
ERRORS = SharedParameters(
    position_m=[0.5, -0.8, 0.3], boresight_rad=[0.012, -0.008, 0.004], rate_rad_s=[0, 0, 3e-5]
)
SIGMAS = SharedParameters(
    position_m=[1, 1, 1], velocity_m_s=[1e-3] * 3, boresight_rad=[0.01] * 3, rate_rad_s=[3e-5] * 3
)
OWN = torch.diag(torch.tensor([1e-5] * 3 + [1e-4] * 3).double() ** 2)


def a_pass(count: int = 24) -> tuple[list[TrainingFrame], NominalMotion]:
    """Return true frames of a camera that flies around a spinning body, and its motion."""
    times, rate = np.linspace(0, 1500, count), np.array([0.0, 0.0, 0.02])
    bodies = Rotation.from_rotvec(-rate * times[:, None]).as_matrix()
    angle = 1e-3 * times
    places = RANGE_M * np.stack([np.cos(angle), np.sin(angle) * 0.6, np.sin(angle) * 0.8], 1)
    cameras = []
    for place in places:
        z = -place / RANGE_M
        x = np.cross([0.0, 0.6, 0.8], z) / np.linalg.norm(np.cross([0.0, 0.6, 0.8], z))
        cameras.append(np.stack([x, np.cross(z, x), z]))
    motion = NominalMotion(times, places, np.array(cameras), bodies, 1e-3, rate_rad_s=rate)
    K, frames = scenes.intrinsics(SIZE, FOCAL_PX), []
    for i, pose in enumerate(motion.world_to_camera):
        frame = TrainingFrame(torch.zeros(SIZE, SIZE, 1), 1e-4, torch.from_numpy(pose).float(), K, i, i)
        with torch.no_grad():
            expected = SENSOR.expected_dn(render(MODEL, cameras_of([frame])).radiance[0], 1e-4)
        noise = torch.randn(expected.shape, generator=torch.Generator().manual_seed(i))
        dn = (expected + noise * SENSOR.variance_dn2(expected).sqrt()).round().clamp(0, SENSOR.white_dn)
        frames.append(dataclasses.replace(frame, dn=dn))
    return frames, motion


def tagged(frames: list[TrainingFrame], motion: NominalMotion) -> list[TrainingFrame]:
    """Return frames with the poses of a motion, and the deviations of what they share stated."""
    navigation = Navigation(SIGMAS, motion.mean_motion_rad_s, motion.inertial_to_rtn, motion.rate_rad_s)
    return [
        dataclasses.replace(
            f,
            world_to_camera=torch.from_numpy(motion.world_to_camera[i]).float(),
            pose_covariance=OWN,
            navigation=navigation,
            time_s=float(motion.times_s[i]),
            inertial_to_body=torch.from_numpy(motion.inertial_to_body[i]),
        )
        for i, f in enumerate(frames)
    ]


@pytest.fixture(scope="module")
def erring() -> tuple[list[TrainingFrame], list[TrainingFrame]]:
    """Frames with true poses, and with tags that err by what they share."""
    true, motion = a_pass()
    return true, tagged(true, displaced_motion(motion, ERRORS))


def gathered(poses: PoseCorrections, frames: list[TrainingFrame]) -> None:
    """Let the true model's pictures say what they say of the poses."""
    indices = list(range(len(frames)))
    cameras = poses.cameras(indices, cameras_of(frames))
    r, slopes = render_with_slopes(MODEL, cameras)
    readings = torch.full((len(frames), 1, 1, 1), 1e-4), torch.stack([f.dn for f in frames]), SENSOR
    poses.gather(indices, pose_information(r.radiance, slopes, r.alpha, r.depth, cameras, *readings))


def errors(poses: torch.Tensor, true: list[TrainingFrame]):
    truth = torch.stack([f.world_to_camera for f in true])
    return pose_errors(poses, truth, best_motion(poses, truth, 1.0), 1.0, FOCAL_PX)


def test_the_gradient_by_a_pose_is_that_of_autograd(erring):
    """For errors below a pixel the image flow stands for rendering anew; what edges uncover is a part of it."""
    true, _ = erring
    frame, xi = true[3], torch.tensor([[1e-3, -5e-4, 2e-3, 0.01, 0.02, -0.02]])
    cameras = cameras_of([frame])
    away = rigid_motions(xi) @ frame.world_to_camera

    def loss(motion: torch.Tensor) -> torch.Tensor:
        at = dataclasses.replace(cameras, world_to_camera=rigid_motions(motion) @ away)
        radiance = render(MODEL, at).radiance
        value, _ = likelihood_loss(radiance, torch.tensor(1e-4).view(1, 1, 1, 1), frame.dn[None], SENSOR)
        return value * frame.dn.numel()

    leaf = torch.zeros(1, 6, requires_grad=True)
    loss(leaf).backward()
    at = dataclasses.replace(cameras, world_to_camera=away)
    r, slopes = render_with_slopes(MODEL, at)
    images = (r.radiance, slopes, r.alpha, r.depth, at, torch.tensor(1e-4).view(1, 1, 1, 1), frame.dn[None])
    ours = pose_information(*images, SENSOR).gradient[0]
    true_gradient = leaf.grad[0].double()
    scale = torch.tensor([1.0, 1, 0.1, 1 / RANGE_M, 1 / RANGE_M, 1 / RANGE_M]).double()
    a, b = ours * scale, true_gradient * scale
    assert float(a @ b / a.norm() / b.norm()) > 0.97


def seen_with_cells(model, true: list[TrainingFrame], indices: list[int], cell_m: float):
    """Return what pictures of a model say of true poses and of the surface's cells."""
    chosen = [true[i] for i in indices]
    cameras = cameras_of(chosen)
    r, slopes = render_with_slopes(model, cameras)
    dn, exposure_s = torch.stack([f.dn for f in chosen]), torch.full((len(chosen), 1, 1, 1), 1e-4)
    images = (r.radiance, slopes, r.alpha, r.depth, cameras, exposure_s, dn, SENSOR)
    return pose_information(*images, cell_m=cell_m)


def test_a_surface_that_moves_as_one_is_a_motion_of_the_camera(erring):
    """The derivatives by the pose, which autograd confirms above, are those by a common shift of all cells."""
    true, _ = erring
    information = seen_with_cells(MODEL, true, [4], 0.2)
    assert information.cells is not None
    (cells,) = information.cells
    shift = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    to_camera = true[4].world_to_camera[:3, :3].double()
    by_camera = information.curvature[0][:, 3:] @ to_camera @ shift
    torch.testing.assert_close((cells.mixed.mT @ shift).sum(0), by_camera)
    # the pose is a rotation up to rounding in float32
    torch.testing.assert_close(
        to_camera @ cells.gradient.sum(0), information.gradient[0][3:], rtol=1e-6, atol=1e-5
    )


def test_eliminating_the_cells_solves_the_whole_system(erring):
    """NumPy solves for brackets, shared parameters and cells at once; less is known than of a surface that stays."""
    true, frames = erring
    indices = [0, 3, 8, 15]
    information = seen_with_cells(MODEL, true, indices, 0.3)
    poses = PoseCorrections([frames[i] for i in indices])
    poses.gather([0, 1, 2, 3], information)
    equations = poses._normal_equations()
    shared, own = equations.solution()
    assert information.cells is not None
    numbers = np.unique(np.concatenate([c.numbers for c in information.cells]))
    P, S = len(poses.value), poses.by_shared.shape[2]
    n = 6 * P + S
    size = n + 3 * len(numbers)
    whole, right = np.eye(size), np.zeros(size)
    whole[n:, n:] /= 0.3**2
    for f, (cells, bracket) in enumerate(zip(information.cells, poses.of_frame, strict=True)):
        design = np.zeros((6, n))
        design[:, 6 * bracket : 6 * bracket + 6] = poses.whitening.root[bracket].double()
        design[:, 6 * P :] = poses.by_shared[f]
        whole[:n, :n] += design.T @ information.curvature[f].numpy() @ design
        right[:n] -= design.T @ information.gradient[f].numpy()
        for k, number in enumerate(cells.numbers.numpy()):
            at = n + 3 * int(np.searchsorted(numbers, number))
            whole[at : at + 3, at : at + 3] += cells.curvature[k].numpy()
            whole[at : at + 3, :n] += cells.mixed[k].numpy() @ design
            whole[:n, at : at + 3] += (cells.mixed[k].numpy() @ design).T
            right[at : at + 3] -= cells.gradient[k].numpy()
    solved, covariance = np.linalg.solve(whole, right), np.linalg.inv(whole)
    np.testing.assert_allclose(own.flatten(), solved[: 6 * P], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(shared, solved[6 * P : n], rtol=1e-6, atol=1e-8)
    assert isinstance(equations, ReducedEquations)
    found = equations.shifts(shared, own)
    np.testing.assert_array_equal(found.numbers, numbers)
    np.testing.assert_allclose(found.shifts.flatten(), solved[n:], rtol=1e-6, atol=1e-8)
    of_shared, of_own = equations.covariances()
    np.testing.assert_allclose(of_shared, covariance[6 * P : n, 6 * P : n], rtol=1e-6, atol=1e-10)
    for p in range(P):
        at = slice(6 * p, 6 * p + 6)
        np.testing.assert_allclose(of_own[p], covariance[at, at], rtol=1e-6, atol=1e-10)
    poses.cells = {}
    fixed, _ = poses._normal_equations().covariances()
    assert (of_shared.diagonal() >= fixed.diagonal() - 1e-12).all()


def test_a_motion_of_the_body_is_seen_as_one_of_the_cameras(erring):
    """Points that `after_motion` moves project to where the cameras' motions of `body_motions` bring them."""
    _, frames = erring
    poses, K = PoseCorrections(frames), frames[0].K.double()
    at = poses.corrected(list(range(len(frames)))).double()

    def projected(points: torch.Tensor, cameras: torch.Tensor) -> torch.Tensor:
        seen = (points @ cameras[:, :3, :3].mT + cameras[:, None, :3, 3]) @ K.T
        return seen[..., :2] / seen[..., 2:]

    model = dataclasses.replace(MODEL, means=MODEL.means.double())
    for k in range(7):
        change = 1e-4 * torch.eye(7, dtype=torch.float64)[k]
        after = poses.after_motion(model, change).means
        moved_cameras = rigid_motions(poses.body_motions() @ change) @ at
        before = projected(model.means, at)
        by_body, by_cameras = projected(after, at) - before, projected(model.means, moved_cameras) - before
        # of second order in the motion; the float32 of `after_motion` is 2e-6 m, 2e-5 px
        torch.testing.assert_close(
            by_body, by_cameras, rtol=0, atol=1e-4 + 2e-3 * float(by_cameras.abs().max())
        )


def test_a_body_that_is_off_as_a_whole_comes_back_in_two_steps(erring):
    """Its cells would each be held by their prior, and all of them together much more than any."""
    true, _ = erring
    sigma = torch.diag(torch.tensor([1e-6] * 3 + [1e-6] * 3).double() ** 2)
    frames = [dataclasses.replace(f, pose_covariance=sigma) for f in true]
    off = rigid_motions(torch.tensor([[0.004, -0.006, 0.003, 0.01, 0.02, -0.015]]).double())[0]
    model, poses, indices = moved(MODEL, off), PoseCorrections(frames), list(range(len(true)))
    distance = (model.means - MODEL.means).norm(dim=1).mean()
    for _ in range(2):
        poses.gather(indices, seen_with_cells(model, true, indices, 0.3))
        change, _ = poses.step(frames, poses.body_motions(), reach_m=1e-3)
        model = poses.after_motion(model, change)
    assert (model.means - MODEL.means).norm(dim=1).mean() < 0.1 * distance


def test_a_surface_that_cannot_move_is_a_known_model(erring):
    true, frames = erring
    indices = [0, 3, 8, 15]
    chosen, told = [frames[i] for i in indices], seen_with_cells(MODEL, true, indices, 0.3)
    held, known = PoseCorrections(chosen), PoseCorrections(chosen)
    held.gather([0, 1, 2, 3], told)
    known.gather([0, 1, 2, 3], dataclasses.replace(told, cells=None))
    _, shifts = held.step(chosen, reach_m=1e-9)
    known.step(chosen)
    assert shifts is not None and float(shifts.shifts.abs().max()) < 1e-9
    torch.testing.assert_close(held.shared, known.shared, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(held.value, known.value, rtol=1e-4, atol=1e-6)


def test_points_go_with_their_cell_but_no_farther_than_half_of_it():
    points = torch.tensor([[0.05, 0.05, 0.05], [0.15, 0.05, 0.05], [-0.05, 0.05, 0.05]])
    numbers, order = registration._cell_numbers(points[:2].double(), 0.1).sort()
    shifts = torch.tensor([[0.01, -0.02, 0.03], [0.2, -0.2, 0.0]]).double()[order]
    found = CellShifts(numbers, shifts, 0.1).of_points(points)
    torch.testing.assert_close(found[0], torch.tensor([0.01, -0.02, 0.03]))
    torch.testing.assert_close(found[1], torch.tensor([0.05, -0.05, 0.0]))
    assert not found[2].any()


def test_slopes_are_differences_of_pictures_taken_half_a_pixel_to_both_sides(erring):
    cameras = cameras_of([erring[0][2], erring[0][9]])
    rendered, slopes = render_with_slopes(MODEL, cameras)
    torch.testing.assert_close(rendered.radiance, render(MODEL, cameras).radiance, rtol=0, atol=0)
    for axis in (0, 1):
        before, after = cameras.K.clone(), cameras.K.clone()
        before[:, axis, 2] += 0.5
        after[:, axis, 2] -= 0.5
        sides = [render(MODEL, dataclasses.replace(cameras, K=K)).radiance for K in (before, after)]
        # contributions under 1/255 are skipped at other places of a grid: float32 sums of others
        torch.testing.assert_close(slopes[..., axis], sides[1] - sides[0], rtol=1e-4, atol=1e-5)


def test_a_panel_seen_edge_on_is_found_in_two_steps():
    """It is thinner than a pixel; slopes between the pixels of its picture would go a part of the way in each step."""
    focal_px = 400.0
    panel = Gaussians(
        means=torch.tensor([[x, 0.0, 0.0] for x in np.linspace(-2, 2, 9)]).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(9, 1),
        log_scales=torch.log(torch.tensor([[0.25, 0.01, 0.4]])).repeat(9, 1),
        opacity_logits=torch.full((9,), 3.0),
        sh=from_radiance(torch.linspace(0.2, 0.6, 9).view(9, 1, 1)),
    )
    pose = torch.eye(4)
    pose[2, 3] = RANGE_M
    frame = TrainingFrame(torch.zeros(SIZE, SIZE, 1), 1e-4, pose, scenes.intrinsics(SIZE, focal_px))
    with torch.no_grad():
        dn = SENSOR.expected_dn(render(panel, cameras_of([frame])).radiance[0], 1e-4)
    pixel_m = RANGE_M / focal_px
    away = pose.clone()
    away[:2, 3] = torch.tensor([0.1, 0.3]) * pixel_m
    covariance = torch.diag(torch.tensor([0, 0, 0, pixel_m, pixel_m, 0]).double() ** 2)
    wrong = dataclasses.replace(frame, dn=dn, world_to_camera=away, pose_covariance=covariance)
    poses, readings = PoseCorrections([wrong]), (torch.tensor(1e-4).view(1, 1, 1, 1), dn[None], SENSOR)
    for _ in range(2):
        cameras = poses.cameras([0], cameras_of([wrong]))
        r, slopes = render_with_slopes(panel, cameras)
        poses.gather([0], pose_information(r.radiance, slopes, r.alpha, r.depth, cameras, *readings))
        poses.step([wrong])
    left_px = (poses.corrected([0])[0, :2, 3] / pixel_m).abs()
    assert left_px.max() < 0.02


def test_eliminating_the_brackets_solves_the_whole_system():
    rng = np.random.default_rng(0)
    P, S = 4, 5
    root = rng.normal(size=(6 * P + S, 6 * P + S))
    full = root @ root.T + 10 * np.eye(6 * P + S)
    for p in range(P):
        for q in range(P):
            if p != q:
                full[6 * p : 6 * p + 6, 6 * q : 6 * q + 6] = 0
    right = rng.normal(size=6 * P + S)
    blocks = [slice(6 * p, 6 * p + 6) for p in range(P)]
    tensors = (
        np.stack([full[b, b] for b in blocks]),
        np.stack([full[b, 6 * P :] for b in blocks]),
        full[6 * P :, 6 * P :],
        right[: 6 * P].reshape(P, 6),
        right[6 * P :],
    )
    normal = NormalEquations(*map(torch.from_numpy, tensors))
    expected, inverse = np.linalg.solve(full, right), np.linalg.inv(full)
    shared, own = normal.solution()
    np.testing.assert_allclose(shared, expected[6 * P :], rtol=1e-9)
    np.testing.assert_allclose(own.ravel(), expected[: 6 * P], rtol=1e-9)
    shared_covariance, own_covariances = normal.covariances()
    np.testing.assert_allclose(shared_covariance, inverse[6 * P :, 6 * P :], rtol=1e-9, atol=1e-12)
    for b, found in zip(blocks, own_covariances, strict=True):
        np.testing.assert_allclose(found, inverse[b, b], rtol=1e-9, atol=1e-12)


def test_shared_errors_are_found_with_a_known_model_and_what_does_not_show_is_said(erring):
    true, wrong = erring
    outlines, poses, why = settled(wrong, silhouettes(wrong, SENSOR), may_move=True)
    assert poses is not None and "light as tagged" in why and len(outlines) == len(wrong)
    before = errors(poses.tags, true)
    aligned = errors(poses.corrected(list(range(len(true)))), true)
    assert before.pixels > 5 and aligned.pixels < 0.2 * before.pixels
    for _ in range(4):
        gathered(poses, wrong)
        poses.step(wrong)
    gathered(poses, wrong)
    after = errors(poses.corrected(list(range(len(true)))), true)
    assert after.pixels < 0.1 and after.rotation_deg < 0.1
    estimate = poses.estimate(wrong)
    prior, posterior = estimate.shared_prior.vector(), estimate.shared_posterior.vector()
    assert np.all(posterior <= prior * (1 + 1e-9))
    # a rotation about the camera's axis and a shift across the line of sight show; the whole orbit's scale does not
    assert estimate.shared_posterior.boresight_rad[2] < 0.2 * estimate.shared_prior.boresight_rad[2]
    tree = estimate.tree()
    assert tree["unobservable"] == estimate.unobservable() and len(tree["frames"]) == len(true)


def test_silhouettes_are_aligned_also_where_tags_have_the_target_behind_the_camera():
    """Errors of the velocity grow along the orbit until the camera that is tagged has passed the target."""
    true, motion = a_pass()
    far = SharedParameters(
        position_m=[12, 2, -3], velocity_m_s=[-0.06, -0.05, -0.06], boresight_rad=[0.02, 0, 0]
    )
    sigmas = SharedParameters(position_m=[6] * 3, velocity_m_s=[0.05] * 3, boresight_rad=[0.02] * 3)
    wrong = [
        dataclasses.replace(f, navigation=dataclasses.replace(f.navigation, sigmas=sigmas))
        for f in tagged(true, displaced_motion(motion, far))
    ]
    depths_m = torch.stack([f.world_to_camera[2, 3] for f in wrong])
    assert depths_m.min() < -20 and depths_m.max() > 20
    _, poses, why = settled(wrong, silhouettes(wrong, SENSOR), may_move=True)
    assert poses is not None, why
    aligned = errors(poses.corrected(list(range(len(true)))), true)
    assert aligned.pixels < 1  # where a silhouette's centre lies about the one point that is taken for it


def _times(by: SharedParameters, factor: float) -> SharedParameters:
    return SharedParameters.of(factor * by.vector())


@pytest.mark.parametrize("factor, searched", [(1, False), (10, True)])
def test_what_the_silhouettes_centres_leave_open_is_where_the_hull_is_most_coherent(factor, searched):
    true, motion = a_pass()
    wrong = tagged(true, displaced_motion(motion, _times(ERRORS, factor)))
    stated = [dataclasses.replace(f.navigation, sigmas=_times(SIGMAS, factor)) for f in wrong]
    wrong = [dataclasses.replace(f, navigation=n) for f, n in zip(wrong, stated, strict=True)]
    outlines = silhouettes(wrong, SENSOR)
    aligned, _ = _aligned(wrong, outlines)
    found = most_coherent(wrong, outlines, aligned)
    assert (found is not aligned) == searched
    before, after = (errors(p.corrected(list(range(len(true)))), true) for p in (aligned, found))
    if searched:
        assert coherence(seen_from(outlines, found)) > coherence(seen_from(outlines, aligned))
        assert after.pixels < 0.75 * before.pixels and after.rotation_deg < 0.75 * before.rotation_deg


def test_a_target_beside_the_camera_says_nothing_of_what_the_centres_leave_open(erring):
    _, wrong = erring
    poses, outlines = PoseCorrections(wrong), silhouettes(wrong, SENSOR)
    assert _open_directions(wrong, outlines, poses).shape[1] > 0
    poses.moved[0] = torch.eye(4)
    poses.moved[0, 0, 3] = 5.0  # in the plane of the camera, where the flow of a point has a pole
    assert _open_directions(wrong, outlines, poses).isfinite().all()


def test_frames_that_were_not_trained_on_follow_the_estimate(erring):
    true, wrong = erring
    poses = settled(wrong, silhouettes(wrong, SENSOR), may_move=True)[1]
    assert poses is not None
    for _ in range(2):
        gathered(poses, wrong)
        poses.step(wrong)
    estimate = poses.estimate(wrong)
    followed = with_estimate(wrong[::4], estimate)
    found = torch.stack([f.world_to_camera for f in followed])
    own = poses.corrected(list(range(0, len(true), 4)))
    # what is left in between are the brackets' own corrections
    left = motion_vectors((found @ torch.linalg.inv(own)).double())
    np.testing.assert_allclose(left[:, :3], 0, atol=1e-4)
    np.testing.assert_allclose(left[:, 3:], 0, atol=2e-3)
    assert all(f.navigation is None and f.pose_covariance is not None for f in followed)


def test_a_pose_is_settled_on_its_picture_and_an_exact_one_stays(erring):
    true, _ = erring
    sigma = torch.tensor([0.004] * 3 + [0.05] * 3).double()
    away = rigid_motions(torch.tensor([[0.006, -0.004, 0.01, 0.02, 0.03, 0.05]]))[0]
    wrong = [
        dataclasses.replace(f, world_to_camera=away @ f.world_to_camera, pose_covariance=torch.diag(sigma**2))
        for f in true[:3]
    ]
    found = settled_poses(MODEL, wrong, SENSOR)
    identity = torch.eye(4)
    before = pose_errors(
        torch.stack([f.world_to_camera for f in wrong]), _poses(true[:3]), identity, 1.0, FOCAL_PX
    )
    after = pose_errors(found, _poses(true[:3]), identity, 1.0, FOCAL_PX)
    assert before.pixels > 3 and after.pixels < 0.2
    exact = [dataclasses.replace(f, pose_covariance=None) for f in true[:2]]
    assert torch.equal(settled_poses(MODEL, exact, SENSOR), _poses(exact))


def _poses(frames: list[TrainingFrame]) -> torch.Tensor:
    return torch.stack([f.world_to_camera for f in frames])


@settings(max_examples=8)
@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_the_best_motion_is_the_one_that_moved_all_poses(draw):
    true = _poses(a_pass(6)[0]).double()
    motion = rigid_motions(torch.tensor([draw]).double())[0]
    estimated = true @ motion
    found = best_motion(estimated, true, 1.0)
    torch.testing.assert_close(found, motion, rtol=0, atol=1e-6)
    left = pose_errors(estimated, true, found, 1.0, FOCAL_PX)
    assert left.rotation_deg < 1e-4 and left.range_share < 1e-6 and left.pixels < 1e-3


@pytest.mark.parametrize("with_size", [False, True])
@pytest.mark.parametrize("degrees", [90, 140, 179, 180])
def test_the_best_motion_may_turn_the_body_around(degrees, with_size):
    true = _poses(a_pass(6)[0]).double()
    turn = np.deg2rad(degrees) * np.array([0.48, 0.6, 0.64])
    motion = rigid_motions(torch.tensor([[*turn, 0.1, -0.2, 0.05]]).double())[0]
    found = best_motion(true @ motion, true, 1.0, with_size)
    torch.testing.assert_close(found, motion, rtol=0, atol=1e-6)


@settings(max_examples=8)
@given(st.lists(st.floats(-0.2, 0.2), min_size=7, max_size=7))
def test_a_model_of_another_size_is_undone_by_the_similarity_alone(draw):
    """Cameras as much farther away see the larger model as before, with Umeyama's similarity of their centres."""
    true, size = _poses(a_pass(6)[0]).double(), float(np.exp(draw[6]))
    motion = rigid_motions(torch.tensor([draw[:6]]).double())[0]
    estimated = true @ motion
    estimated[:, :3, 3] *= size  # of a model that is as much too large
    found = best_motion(estimated, true, 1.0, with_size=True)
    assert size_of(found) == pytest.approx(1 / size, rel=1e-6)
    torch.testing.assert_close(seen_after(true, found), estimated, rtol=0, atol=1e-5)
    centres, goal = (np.linalg.inv(p.numpy())[:, :3, 3].T for p in (estimated, true))
    expected = transform.estimate_transform("similarity", centres.T, goal.T).params
    np.testing.assert_allclose(found, expected, atol=1e-5)
    left = pose_errors(estimated, true, found, 1.0, FOCAL_PX)
    assert left.rotation_deg < 1e-4 and left.range_share < 1e-6 and left.pixels < 1e-3
    rigid = best_motion(estimated, true, 1.0)
    assert size_of(rigid) == pytest.approx(1)
    if abs(draw[6]) > 0.01:
        assert pose_errors(estimated, true, rigid, 1.0, FOCAL_PX).range_share > 0.005


def test_a_size_that_no_picture_shows_is_what_the_shared_errors_say():
    """Poses that fit a body too small by 3 % are not held there by a pattern of a few thousandths of the path.

    The relative orbit is free motion (Clohessy and Wiltshire) and 0.1 m of something else.
    """
    times, rate = np.linspace(0, 5000, 48), 1e-3
    phase = rate * times
    in_plane = np.stack([30 * np.cos(phase), -60 * np.sin(phase), 25 * np.cos(phase)], 1)
    in_plane += 0.1 * np.stack([np.sin(7 * phase), np.cos(5 * phase), np.sin(11 * phase)], 1)
    places = Rotation.from_rotvec(phase[:, None] * [0, 0, 1.0]).apply(in_plane)
    cameras = []
    for place in places:
        z = -place / np.linalg.norm(place)
        x = np.cross([0.0, 0.3, 1.0], z)
        cameras.append(np.stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z]))
    bodies = np.broadcast_to(np.eye(3), (len(times), 3, 3))
    motion = NominalMotion(times, places, np.array(cameras), bodies, rate)
    nothing = torch.zeros(SIZE, SIZE, 1)
    true = [
        TrainingFrame(nothing, 1e-4, torch.from_numpy(pose).float(), scenes.intrinsics(SIZE, 100.0), i, i)
        for i, pose in enumerate(motion.world_to_camera)
    ]
    errors_of_it = SharedParameters(position_m=[0.5, -0.4, 0.3], boresight_rad=[0.012, -0.008, 0.004])
    own = torch.diag(torch.tensor([2e-4] * 3 + [3e-3] * 3).double() ** 2)
    tags = [
        dataclasses.replace(f, pose_covariance=own)
        for f in tagged(true, displaced_motion(motion, errors_of_it))
    ]
    poses, truth = PoseCorrections(tags), torch.from_numpy(motion.world_to_camera)
    nearer = truth.clone()
    nearer[:, :3, 3] *= 0.97
    unit = torch.tensor([1.0, 1, 1, RANGE_M, RANGE_M, RANGE_M]).double()
    for _ in range(4):  # the shared parameters that place the cameras most nearly so
        left = (motion_vectors(nearer @ torch.linalg.inv(poses.moved)) / unit).flatten()
        columns = (poses.by_shared / unit[:, None]).flatten(0, 1)
        poses._change_shared(tags, torch.linalg.lstsq(columns, left[:, None])[0][:, 0])

    def size() -> float:
        return size_of(best_motion(poses.corrected(list(range(len(true)))), truth, 1.0, with_size=True))

    assert size() == pytest.approx(1 / 0.97, abs=3e-3)
    poses.fix_gauge(MODEL, tags, as_one=True)
    assert size() == pytest.approx(1.0, abs=0.01)


def test_frames_that_join_are_where_silhouettes_say_as_the_model_sees_them(erring):
    """What the first third of a pass says of the shared parameters leads the rest of it astray."""
    true, tags = erring
    drift = SharedParameters(velocity_m_s=[6e-4, -4e-4, 6e-4])  # 1.3 m at the end of the pass
    refined, aligned = PoseCorrections(tags[:8]), PoseCorrections(tags)
    wrong = torch.from_numpy(drift.vector() - ERRORS.vector())[refined.free] / refined.sigmas[refined.free]
    refined = refined.changed(tags[:8], wrong)
    turn = rigid_motions(torch.tensor([[0.05, -0.08, 0.03, 0.1, -0.2, 0.1]]).double())[0]
    # the silhouettes' body lies in another way
    aligned.corrected = lambda indices: seen_after(_poses(true).double()[indices], turn).float()
    extended = refined.extended(tags)
    found = joined(refined, aligned, tags, 1.0)
    everything, known = list(range(24)), list(range(8))
    now, before = (errors(poses.corrected(everything), true).pixels for poses in (found, extended))
    assert before > 5 and now < 2  # 7.0 and 1.5 px, of the first eight alone 1.8
    left = pose_errors(found.corrected(known), refined.corrected(known), torch.eye(4).double(), 1.0, FOCAL_PX)
    assert left.pixels < 1.5  # the model stays where it is
    assert not found.cells and not found.gradient.any()


def test_moving_model_and_poses_changes_no_picture(erring):
    true, _ = erring
    motion = rigid_motions(torch.tensor([[0.2, -0.3, 0.1, 0.3, -0.1, 0.2]]))[0]
    cameras = cameras_of(true[:4])
    back = cameras.world_to_camera @ torch.linalg.inv(motion)
    with torch.no_grad():
        before = render(MODEL, cameras).radiance
        after = render(
            moved(MODEL, motion.double()), dataclasses.replace(cameras, world_to_camera=back)
        ).radiance
    assert (before - after).abs().mean() < 1e-4 * before.mean()  # float32 at 60 m


@given(st.integers(0, 10_000))
def test_motion_vectors_and_adjoints_match_their_definitions(seed):
    rng = np.random.default_rng(seed)
    xi = torch.from_numpy(rng.normal(size=(3, 6)) * 0.5)
    torch.testing.assert_close(motion_vectors(rigid_motions(xi)), xi, rtol=1e-9, atol=1e-9)
    poses, small = rigid_motions(torch.from_numpy(rng.normal(size=(3, 6)))), 1e-6 * xi[:1]
    around = poses @ rigid_motions(small) @ torch.linalg.inv(poses)
    torch.testing.assert_close(motion_vectors(around), (adjoints(poses) @ small[0]), rtol=0, atol=1e-11)


def test_a_training_finds_what_the_pass_shares(erring):
    true, wrong = erring
    changes = {"steps": 200, "start.count": 800, "growth.max_gaussians": 1200, "poses.refine": "auto"}
    trainer = Trainer(wrong, SENSOR, preset("obbgs", QUICK | changes))
    while not trainer.stop_reason():
        trainer.step()
    result = trainer.result("")
    assert result.pose_estimate is not None and result.poses.startswith("refined (the hull")
    before = errors(torch.from_numpy(result.pose_estimate.tagged), true)
    after = errors(torch.from_numpy(result.pose_estimate.estimated), true)
    assert after.pixels < 0.3 * before.pixels
    estimate, allowed = result.pose_estimate, SIGMAS.vector() > 0
    prior, posterior = estimate.shared_prior.vector()[allowed], estimate.shared_posterior.vector()[allowed]
    assert (
        trainer.state.poses.corrections is not None and trainer.state.poses.corrections.together is not None
    )
    assert (posterior <= prior * (1 + 1e-6)).all() and posterior[9:].max() < 0.5 * prior[9:].max()
    # what leads from the tags back to the true poses is -ERRORS but for products of errors, a hundredth of a deviation
    off = (estimate.shared.vector() + ERRORS.vector())[allowed] / posterior
    assert (np.abs(off) < 3).mean() > 0.75, off
    trainer.state.poses.corrections.together = (
        None  # the deviations of the likelihood of the finished model alone
    )
    assert (
        posterior > trainer.result("").pose_estimate.shared_posterior.vector()[allowed] * (1 - 1e-6)
    ).all()


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_pictures_that_count_less_leave_more_open_but_no_more_than_the_prior(seed, size):
    """An eigenvalue t of the information, beside the prior of 1, becomes t / DOUBT squared in the same direction."""
    rng = np.random.default_rng(seed)
    turn, told = (
        np.linalg.qr(rng.normal(size=(size, size)))[0],
        rng.exponential(size=size) * 10 ** rng.uniform(-3, 4),
    )
    covariance = torch.from_numpy(turn / (1 + told) @ turn.T)
    expected = turn / (1 + told / corrections.DOUBT**2) @ turn.T
    np.testing.assert_allclose(corrections._doubted(covariance), expected, atol=1e-8)


def test_frames_of_two_passes_are_refused(erring):
    _, wrong = erring
    other = Navigation(dataclasses.replace(SIGMAS, clock_s=np.ones(1)))
    with pytest.raises(ReconstructionError, match="the same navigation"):
        usable([*wrong[:5], dataclasses.replace(wrong[5], navigation=other)], True)


def test_pruning_sees_the_target_from_the_refined_poses(erring):
    """From the tags, ten pixels off, most Gaussians of the true model would explain nothing that a picture shows."""
    true, wrong = erring
    settings = preset("obbgs", QUICK | {"poses.refine": "auto"})
    trainer, exact = (Trainer(frames, SENSOR, settings) for frames in (wrong, true))
    trainer.state.poses.corrections._move_shared(wrong, -torch.from_numpy(ERRORS.vector()))
    trainer.state.poses.corrections.value.zero_()
    for one in (trainer, exact):
        one.state.gaussians = MODEL.trainable()
    poses = torch.stack([f.world_to_camera for f in scenes.now_of(trainer).batches.frames])
    assert errors(poses, true).pixels < 0.3
    kept = [
        justified(
            one.state.model,
            scenes.now_of(one).batches,
            SENSOR,
            one.setup.radius_m,
            1.0,
            torch.Generator().manual_seed(0),
        )
        for one in (trainer, exact)
    ]
    # a Gaussian near the limit may fall to either side
    assert (kept[0] != kept[1]).sum() <= 1 and kept[1].sum() > 0.8 * len(kept[1])


def test_the_schedule_is_set_back_for_aligned_poses_as_often_as_it_says(erring):
    trainer = Trainer(erring[1], SENSOR, preset("obbgs", QUICK | {"poses.refine": "auto"}))
    assert trainer.state.poses.aligned
    seen = []
    while not trainer.stop_reason():
        info = trainer.step()
        counts_on = bool(seen) and info.step == seen[-1] + 1  # else there is no pace yet, or none any more
        assert (info.seconds_left is not None) == counts_on
        assert info.seconds_left is None or 0 <= info.seconds_left < 1e4
        seen.append(info.step)
    held_at, held_from = (round(share * 40) for share in (SET_BACK_AT, SET_BACK_TO))
    again = list(range(held_from + 1, held_at + 1))
    assert seen == [*range(1, held_at + 1), *(SET_BACKS * again), *range(held_at + 1, 41)]
