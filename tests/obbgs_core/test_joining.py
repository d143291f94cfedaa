"""Frames that join a training under way: nothing is lost, nothing starts from zero, and the end is as good."""

import dataclasses

import cv2
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial import KDTree

from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import TENSORS, Gaussians
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db
from obbgs_core.train.joining import JOINED_AT, NEW_SPACINGS, SETTLED_ROUNDS
from obbgs_core.train.poses import SET_BACKS, PoseDecision
from obbgs_core.train.trainer import Trainer
from tests.scenes import EXPOSURES_S, QUICK, SENSOR, SIZE_PX, photographed, tagged, target

STEPS = 120
# as `ground live` trains: what helps few frames alone is left off while more are to come
MANY_EXPECTED = {"sparse.dropout": 0.0}
CONFIG = preset("obbgs", QUICK | MANY_EXPECTED | {"steps": STEPS})


@pytest.fixture(scope="module")
def frames() -> list[TrainingFrame]:
    return photographed(target(), 36)


def trained(frames: list[TrainingFrame], counts: list[int], steps: int) -> Trainer:
    """Return a training that began with the first count of frames, each next one joining after some steps."""
    trainer = Trainer(frames[: counts[0]], SENSOR, CONFIG, seed=3)
    for before, count in zip([*counts, len(frames)], [*counts[1:], None], strict=False):
        for _ in range(steps):
            trainer.step()
        if count is not None:
            trainer.join(frames[before:count])
    return trainer


def mean_psnr_db(model: Gaussians, frames: list[TrainingFrame]) -> float:
    with torch.no_grad():
        radiance = render(model, cameras_of(frames)).radiance
    expected = [SENSOR.expected_dn(r, f.exposure_time_s) for r, f in zip(radiance, frames, strict=True)]
    values = [
        psnr_db(e / SENSOR.white_dn, f.dn / SENSOR.white_dn) for e, f in zip(expected, frames, strict=True)
    ]
    return sum(values) / len(values)


def test_a_training_that_frames_joined_ends_as_good_as_one_that_had_them_from_the_start(frames):
    """Measured: 27.4 dB with frames that joined, 28.5 dB with all from the start, 19.1 dB with the first four alone."""
    unseen = photographed(target(), 8, seed=9)
    joined = trained(frames, [12, 24, 36], 20)
    assert joined.state.steps_done <= round(JOINED_AT * STEPS) + 20
    scores = {}
    whole, few = Trainer(frames, SENSOR, CONFIG, seed=3), Trainer(frames[:4], SENSOR, CONFIG, seed=3)
    for name, trainer in (("joined", joined), ("whole", whole), ("few", few)):
        while not trainer.stop_reason():
            trainer.step()
        scores[name] = mean_psnr_db(trainer.gaussians, unseen)
    assert scores["joined"] > scores["whole"] - 3
    assert scores["joined"] > scores["few"] + 3


def test_joining_keeps_what_was_learnt_and_sets_the_schedule_back(frames):
    trainer = trained(frames, [18], 70)
    before, moments = trainer.gaussians, trainer.state.adam.second["means"].clone()
    trainer.join(frames[18:])
    after = trainer.gaussians
    kept = (before.means[:, None] == after.means[None]).all(dim=2)
    assert kept.any(dim=1).float().mean() > 0.9  # of the Gaussians are still there, to the bit
    old, new = torch.nonzero(kept, as_tuple=True)
    for name in TENSORS:
        assert torch.equal(getattr(before, name)[old], getattr(after, name)[new]), name
    assert torch.equal(trainer.state.adam.second["means"][new], moments[old])
    assert trainer.state.steps_done == round(JOINED_AT * STEPS) and len(trainer.state.history) == 70
    assert len(trainer.setup.frames) == 36
    early = trained(frames, [18], 10)
    early.join(frames[18:])
    assert early.state.steps_done == 10  # nothing to set back


def test_when_no_more_join_the_training_ends_as_one_that_had_all_frames_from_the_start(frames, tmp_path):
    trainer, whole = trained(frames, [12, 36], 20), Trainer(frames, SENSOR, CONFIG, seed=3)
    steps, seconds = len(trainer.state.history), trainer.state.seconds
    trainer.end_joining()
    assert trainer.state.steps_done == 0 and len(trainer.state.history) == steps
    assert trainer.state.seconds > seconds
    for each in (trainer, whole):
        for _ in range(10):
            each.step()
    trainer.save(tmp_path / "checkpoint")
    resumed = Trainer(frames, SENSOR, CONFIG, seed=3)
    assert resumed.resume(tmp_path / "checkpoint")
    for each in (trainer, resumed, whole):
        each.end_joining()  # it has begun again already, or nothing has joined
        assert each.state.steps_done == 10
        each.step()
    for name, tensor in whole.gaussians.tensors().items():
        for each in (trainer, resumed):
            assert torch.equal(tensor, getattr(each.gaussians, name)), name


def test_silhouettes_that_were_made_before_a_joining_are_those_of_a_training_of_all_frames(frames):
    joined, whole = trained(frames, [4, 12], 1), Trainer(frames[:12], SENSOR, CONFIG, seed=3)
    assert list(joined.setup.silhouettes) == list(whole.setup.silhouettes)
    for i, silhouette in whole.setup.silhouettes.items():
        for name in ("certain", "likely", "sky", "world_to_camera", "K"):
            assert torch.equal(getattr(joined.setup.silhouettes[i], name), getattr(silhouette, name))


def test_gaussians_where_the_new_silhouettes_see_nothing_are_given_up(frames):
    trainer = trained(frames, [4], 10)
    stray = trainer.state.gaussians.detach().select(torch.zeros(100, dtype=torch.long))
    stray.means = 4 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) - 2
    everything = Gaussians.concatenate([trainer.state.gaussians.detach(), stray])
    trainer.state.adam.follow(torch.arange(len(trainer.state.gaussians)), 100)
    trainer.state.gaussians = everything.trainable()
    trainer.join(frames[4:])
    left = (stray.means[:, None] == trainer.gaussians.means[None]).all(dim=2).any(dim=1)
    long = [f for f in frames if f.exposure_time_s == max(EXPOSURES_S)]  # these carve
    empty_views = torch.zeros(100)  # in which a point is in view with no light of the true model within 4 px
    with torch.no_grad():
        around = F.max_pool2d(render(target(), cameras_of(long)).alpha, 9, 1, 4)
    for f, alpha in zip(long, around, strict=True):
        pose, points = f.world_to_camera.double().numpy(), stray.means.double().numpy()
        turn, _ = cv2.Rodrigues(pose[:3, :3])
        pixels, _ = cv2.projectPoints(points, turn, pose[:3, 3], f.K.double().numpy(), None)
        u, v = torch.from_numpy(pixels[:, 0]).floor().long().unbind(dim=1)
        in_view = (u >= 0) & (u < SIZE_PX) & (v >= 0) & (v < SIZE_PX)
        empty_views += in_view & (alpha[v.clamp(0, SIZE_PX - 1), u.clamp(0, SIZE_PX - 1)] < 1e-3)
    empty = empty_views >= len(long) / 2
    assert empty.sum() > 10 and not (left & empty).any()
    trainer.step()


def test_no_surface_that_only_the_new_silhouettes_carve_stays_bare(frames):
    trainer = trained(frames, [4], 10)
    earlier = trainer.setup.start_means
    untouched = trainer.gaussians.means
    trainer.join(frames[4:])
    start = Trainer(frames, SENSOR, CONFIG, seed=3).gaussians
    near_m = NEW_SPACINGS * start.scales[:, 0].numpy()

    def is_near(means: torch.Tensor):
        return KDTree(means.numpy()).query(start.means.numpy())[0] <= near_m

    assert not (is_near(earlier) | is_near(untouched)).all()  # the four views left some of it hidden
    assert (is_near(earlier) | is_near(trainer.gaussians.means)).all()


def test_a_killed_training_goes_on_to_the_same_model_after_frames_have_joined(frames, tmp_path):
    whole = trained(frames, [12, 24], 20)
    whole.save(tmp_path / "checkpoint")
    resumed = Trainer(frames[:24], SENSOR, CONFIG, seed=3)
    assert resumed.resume(tmp_path / "checkpoint")
    for trainer in (whole, resumed):
        for _ in range(5):
            trainer.step()
        trainer.join(frames[24:])
        trainer.step()
    assert len(resumed.setup.frames) == 36 and len(resumed.state.history) == 46
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(resumed.gaussians, name)), name


def test_a_killed_training_of_refined_poses_goes_on_to_the_same_model(frames, tmp_path):
    """Windows and budget are those of the poses at the joining, which are not those of the tags."""
    doubted = tagged(frames, True, sigma_rad=0.02)
    config = preset("obbgs", QUICK | MANY_EXPECTED | {"poses.refine": "always"})
    whole = Trainer(doubted[:24], SENSOR, config, seed=3)
    for _ in range(24):
        whole.step()
    whole.join(doubted[24:30])
    for _ in range(8):  # poses go on moving after what was carved with them
        whole.step()
    whole.save(tmp_path / "joined")
    joined = Trainer(doubted[:30], SENSOR, config, seed=3)
    carved_as_tagged = joined.setup.start_means
    assert joined.resume(tmp_path / "joined")
    assert torch.equal(joined.setup.start_means, whole.setup.start_means)
    assert not torch.equal(joined.setup.start_means, carved_as_tagged)
    for trainer in (whole, joined):
        trainer.join(doubted[30:])
        trainer.step()
        trainer.end_joining()
        trainer.step()
    whole.save(tmp_path / "ended")
    ended = Trainer(doubted, SENSOR, config, seed=3)
    assert ended.resume(tmp_path / "ended")
    for trainer in (whole, joined, ended):
        for _ in range(3):
            trainer.step()
    for name, tensor in whole.gaussians.tensors().items():
        for trainer in (joined, ended):
            assert torch.equal(tensor, getattr(trainer.gaussians, name)), name


def test_brackets_that_decide_on_the_poses_have_never_been_trained_on(frames):
    doubted = tagged(photographed(target(), 42), True, sigma_rad=0.01)
    config = preset("obbgs", QUICK | {"poses.refine": "auto"})
    trainer = Trainer(doubted[:6], SENSOR, config)
    trainer.withhold()
    for first in range(6, 42, 6):
        assert trainer.state.poses.decision is (
            PoseDecision.TOO_FEW_BRACKETS if first < 24 else PoseDecision.OPEN
        )
        assert trainer.state.poses.corrections is None
        drawn = {index for group in trainer.state.order.groups for index in group}
        assert drawn == {i for i in range(first) if i % 7 != 3}
        trainer.join(doubted[first : first + 6])
    while trainer.state.poses.decision is PoseDecision.OPEN:
        trainer.step()
    assert "that a validation bracket's pose errs" in trainer.state.poses.report
    assert sorted(index for group in trainer.state.order.groups for index in group) == list(range(42))


def test_corrections_of_brackets_are_kept_when_others_join(frames):
    doubted = tagged(frames, True)
    trainer = Trainer(doubted[:18], SENSOR, preset("obbgs", QUICK | {"poses.refine": "always"}))
    for _ in range(24):  # every frame has spoken at least once
        trainer.step()
    assert trainer.state.poses.corrections is not None
    before = trainer.state.poses.corrections.value.clone()
    trainer.join(doubted[18:])
    assert before.any() and torch.equal(trainer.state.poses.corrections.value[:18], before)
    assert (
        trainer.state.poses.corrections.value.shape == (36, 6)
        and not trainer.state.poses.corrections.value[18:].any()
    )
    trainer.step()


def test_refined_poses_are_what_the_training_begins_again_with(frames):
    doubted = tagged(frames, True)
    trainer = Trainer(doubted[:30], SENSOR, preset("obbgs", QUICK | {"poses.refine": "always"}))
    for _ in range(24):
        trainer.step()
    rounds = trainer.state.poses.moved
    assert rounds > 1
    trainer.join(doubted[30:])
    assert trainer.state.poses.moved == pytest.approx(rounds * 30 / 36)
    before = trainer.state.poses.corrections.value.clone()
    for many, holds in ((SETTLED_ROUNDS, 0), (SETTLED_ROUNDS - 1, SET_BACKS)):
        trainer.state.poses.moved, trainer.state.has_joined = many, True
        trainer.end_joining()
        assert torch.equal(trainer.state.poses.corrections.value, before) and before.any()
        assert trainer.state.steps_done == 0 and trainer.state.poses.set_backs == holds
    trainer.step()


def test_too_few_brackets_to_decide_are_trained_on_when_no_more_come(frames):
    doubted = tagged(frames[:18], True)
    trainer = Trainer(doubted, SENSOR, preset("obbgs", QUICK | {"poses.refine": "auto"}))
    trainer.withhold()
    assert trainer.state.order.validation_brackets == [[3], [10], [17]]
    trainer.end_joining()
    assert sorted(index for group in trainer.state.order.groups for index in group) == list(range(18))
    assert trainer.state.poses.decision is PoseDecision.TOO_FEW_BRACKETS


def test_a_sun_that_moves_only_later_is_tested_then(frames):
    def lit(some: list[TrainingFrame], sun: tuple[float, float, float]) -> list[TrainingFrame]:
        return [dataclasses.replace(f, sun_dir=torch.tensor(sun)) for f in some]

    trainer = Trainer(lit(frames[:18], (0.0, 0.0, 1.0)), SENSOR, CONFIG)
    for _ in range(20):
        trainer.step()
    view = trainer.state.gaussians.detach()
    view.sh = torch.cat([view.sh, torch.full((len(view), 3, 1), 0.1)], dim=1)  # as if it turned with the view
    trainer.state.gaussians = view.trainable()
    trainer.state.adam.widen(trainer.state.gaussians)
    assert not trainer.setup.sun_moves and trainer.state.adam.betas == (0.9, 0.99)
    trainer.join(lit(frames[18:], (1.0, 0.0, 0.0)))
    assert trainer.setup.sun_moves and trainer.state.adam.betas == (0.9, 0.999)
    assert trainer.gaussians.sh.shape[1] == 1
    trainer.step()
    assert "with the sun it would gain" in trainer.result("").appearance


def test_brackets_that_are_to_tell_the_own_error_stay_unseen_while_frames_join(frames):
    suns = F.normalize(torch.randn(36, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    moving = [dataclasses.replace(f, sun_dir=sun) for f, sun in zip(frames, suns, strict=True)]
    trainer = Trainer(moving[:24], SENSOR, CONFIG)
    trainer.withhold()
    for count, unseen in ((24, [3, 10, 17]), (36, [3, 10, 17, 24, 31])):
        trainer.join(moving[24:count])
        assert trainer.state.order.validation_brackets == [[i] for i in unseen]
        for _ in range(15):
            trainer.step()
        assert not set(unseen) & set(trainer.state.order.visits)
    trainer.end_joining()  # begins again as a training of all frames would
    assert trainer.state.order.validation_brackets == [[i] for i in unseen]
    assert trainer.state.steps_done == 0


def test_frames_join_no_training_whose_first_step_depends_on_their_number(frames):
    trainer = Trainer(frames[:18], SENSOR, preset("3dgs", {"start.count": 100}))
    with pytest.raises(
        ValueError, match="no frames can join a training of 3dgs: it must know exposure times"
    ):
        trainer.join(frames[18:])


def test_dark_frames_that_join_are_counted_and_left_out(frames):
    dark = [dataclasses.replace(f, dn=torch.full_like(f.dn, 64.0)) for f in frames[30:]]
    trainer = trained([*frames[:30], *dark], [18, 36], 5)
    assert trainer.setup.dark_frames == 6 and len(trainer.setup.frames) == 30
