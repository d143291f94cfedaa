"""The training as a whole: repeatable, resumable, and honest about what it leaves out."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter

from obbgs_base.errors import Interrupted
from obbgs_core import compiled
from obbgs_core.errors import Diverged, ReconstructionError, TooFewFrames
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import TENSORS
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.growth import finite
from obbgs_core.train.state import SAVED, Identity
from obbgs_core.train.trainer import Trainer, train
from tests.scenes import QUICK, SENSOR, SIZE_PX, move_poses_in, photographed, target


@pytest.fixture(scope="module")
def frames() -> list[TrainingFrame]:
    return photographed(target())


@pytest.mark.parametrize("killed_at", [23, 38], ids=["before averaging", "while models are averaged"])
def test_a_killed_training_resumes_to_the_same_model(frames, tmp_path, monkeypatch, killed_at):
    move_poses_in(monkeypatch, 8)  # else poses move in each of so few steps
    config = preset("obbgs", QUICK | {"poses.refine": "always", "parsimony.prune_at": (0.5,)})
    tagged = [dataclasses.replace(f, pose_covariance=1e-6 * torch.eye(6).double()) for f in frames]
    whole = train(tagged, SENSOR, config, seed=3)
    first = Trainer(tagged, SENSOR, config, seed=3)
    for _ in range(killed_at):
        first.step()
    first.save(tmp_path / "training.checkpoint")
    steps = []
    resumed = train(
        tagged,
        SENSOR,
        config,
        3,
        lambda info: steps.append(info.step),
        checkpoint=tmp_path / "training.checkpoint",
    )
    every = [info.step for info in whole.history]
    assert every[-1] == 40 and steps == every[killed_at:]
    assert [info.step for info in resumed.history] == every
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(resumed.gaussians, name)), name


def test_a_step_wakes_threads_for_the_compiled_module_alone(frames, monkeypatch, use_threads):
    seen = []

    def watched(*args, **kwargs):
        seen.append((torch.get_num_threads(), compiled.threads()))
        return render(*args, **kwargs)

    monkeypatch.setattr("obbgs_core.train.trainer.render", watched)
    use_threads(3)
    Trainer(frames, SENSOR, preset("obbgs", QUICK), seed=3).step()
    assert set(seen) == {(1, 3)} and (torch.get_num_threads(), compiled.threads()) == (3, 3)


def test_start_decisions_and_steps_do_not_depend_on_the_number_of_threads(frames, use_threads, monkeypatch):
    monkeypatch.setattr("obbgs_core.start.hull.POINTS_AT_ONCE", 1 << 16)  # several threads carve
    config = preset("obbgs", QUICK | {"parsimony.prune_at": (0.5,)})
    found = []
    for threads in (1, 3):
        use_threads(threads)
        result = train(frames, SENSOR, config, seed=3)
        found.append((result.gaussians.tensors(), result.history[-1].loss, str(result.response)))
    (one, *told), (three, *told_again) = found
    assert told == told_again and all(torch.equal(tensor, three[name]) for name, tensor in one.items())


def test_the_result_is_the_mean_of_the_models_of_the_last_steps(frames):
    config = preset("obbgs", QUICK | {"averaged_from": 0.8, "parsimony.prune_at": ()})
    trainer, models = Trainer(frames, SENSOR, config, seed=3), []
    while not (reason := trainer.stop_reason()):
        trainer.step()
        now = trainer.state.gaussians.parameters()
        models.append({name: tensor.detach().double().numpy() for name, tensor in now.items()})
        if trainer.state.steps_done <= 32:  # of 40
            assert torch.equal(trainer.gaussians.means, trainer.state.gaussians.means)
    result = trainer.result(reason).gaussians.parameters()
    for name, last in models[-1].items():
        expected = np.mean([model[name] for model in models[32:]], axis=0)
        np.testing.assert_allclose(result[name].numpy(), expected, rtol=1e-5, atol=1e-6, err_msg=name)
        if name in TENSORS:
            assert np.abs(expected - last).max() > 1e-5, name


def test_a_gaussian_that_is_not_finite_leaves_the_mean_as_well(frames):
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK | {"averaged_from": 0.8}), seed=3)
    while not (reason := trainer.stop_reason()):
        trainer.step()
    averaged = trainer.gaussians
    with torch.no_grad():
        trainer.state.gaussians.means[5] = torch.nan
    result = trainer.result(reason)
    kept = torch.arange(len(averaged)) != 5
    assert result.removed_not_finite == 1 and torch.equal(result.gaussians.means, averaged.means[kept])


def test_the_mean_begins_anew_when_poses_move(frames, monkeypatch):
    move_poses_in(monkeypatch, 8)  # the last round is answered in the 35th of 40 steps
    tagged = [dataclasses.replace(f, pose_covariance=1e-6 * torch.eye(6).double()) for f in frames]
    config = preset("obbgs", QUICK | {"poses.refine": "always", "averaged_from": 0.8})
    trainer = Trainer(tagged, SENSOR, config, seed=3)
    assert trainer.state.adam.betas == (0.9, 0.999)
    while not trainer.stop_reason():
        trainer.step()
    assert trainer.state.average.gaussians is not None and trainer.state.average.steps == 6


def test_the_mean_begins_anew_when_frames_join(frames):
    trainer = Trainer(frames[:-3], SENSOR, preset("obbgs", QUICK | {"averaged_from": 0.8}), seed=3)
    while not trainer.stop_reason():
        trainer.step()
    assert not torch.equal(trainer.gaussians.means, trainer.state.gaussians.means)
    trainer.join(frames[-3:])
    assert torch.equal(trainer.gaussians.means, trainer.state.gaussians.means)


def test_a_checkpoint_of_another_training_is_not_used(frames, tmp_path):
    Trainer(frames, SENSOR, preset("obbgs", QUICK), seed=1).save(tmp_path / "saved")
    doubted = [dataclasses.replace(f, pose_covariance=1e-18 * torch.eye(6).double()) for f in frames]
    others = [
        Trainer(frames, SENSOR, preset("obbgs", QUICK), seed=2),
        Trainer(frames[:-1], SENSOR, preset("obbgs", QUICK), seed=1),
        Trainer(doubted, SENSOR, preset("obbgs", QUICK), seed=1),
        Trainer(frames, SENSOR, preset("obbgs", QUICK | {"growth.max_gaussians": 50}), seed=1),
    ]
    for number, other in enumerate(others, 1):
        shutil.copy(tmp_path / "saved", tmp_path / "c")
        assert not other.resume(tmp_path / "c")
        other.save(tmp_path / "c")  # does not replace what was found there
        assert (tmp_path / f"c.unused-{number}").read_bytes() == (tmp_path / "saved").read_bytes()
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK), seed=1)
    assert not trainer.resume(tmp_path / "none") and trainer.resume(tmp_path / "c.unused-1")


@pytest.mark.parametrize(
    "content",
    [{"format": 1, "identity": "{}"}, {"identity": ""}, {"format": 2, "identity": "[]", "state": Sensor}],
)
def test_a_checkpoint_of_another_version_is_not_used_and_nothing_else_in_it_is_built(
    frames, tmp_path, caplog, content
):
    torch.save(content, tmp_path / "c")  # the sensor's class is not among those that a checkpoint may hold
    found, trainer = (tmp_path / "c").read_bytes(), Trainer(frames, SENSOR, preset("obbgs", QUICK))
    assert not trainer.resume(tmp_path / "c")
    assert "it is not used; it is kept as c.unused-1" in caplog.text
    trainer.save(tmp_path / "c")
    assert (tmp_path / "c.unused-1").read_bytes() == found and trainer.resume(tmp_path / "c")


def test_a_checkpoint_outlives_settings_that_are_added_later(frames, tmp_path, caplog):
    """A file without a setting was saved before there was one: it is used where the setting has its default."""
    config = preset("obbgs", QUICK)
    trainer = Trainer(frames, SENSOR, config)
    trainer.step()
    trainer.save(tmp_path / "c")
    with torch.serialization.safe_globals(SAVED):
        saved = torch.load(tmp_path / "c", weights_only=True)
    older = json.loads(saved["identity"])
    del older["settings"]["growth.obb_interval"]
    torch.save(saved | {"identity": json.dumps(older)}, tmp_path / "older")
    by_default = Trainer(frames, SENSOR, config)
    assert by_default.resume(tmp_path / "older") and by_default.state.steps_done == 1
    without = preset("obbgs", QUICK | {"growth.obb_interval": 0})
    assert not Trainer(frames, SENSOR, without).resume(tmp_path / "older")
    assert "another training, which differs in growth.obb_interval: it is not used" in caplog.text


def test_a_default_that_changed_since_a_checkpoint_is_noticed(frames):
    """The file holds every setting as it was, so that it does not matter where today's value comes from."""
    saved = Identity.of(Trainer(frames, SENSOR, preset("obbgs", QUICK)).setup)
    raised = saved.defaults | {"published.prune_size": 0.3}
    now = dataclasses.replace(saved, settings=saved.settings | {"published.prune_size": 0.3}, defaults=raised)
    assert now.difference(saved.text()) == "in published.prune_size" and not saved.difference(saved.text())
    gone = {name: value for name, value in saved.settings.items() if name != "published.prune_size"}
    assert dataclasses.replace(saved, settings=gone).difference(saved.text()) == "in published.prune_size"


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_damaged_checkpoint_is_not_used(frames, tmp_path, caplog, share):
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK))
    trainer.save(tmp_path / "c")
    whole = (tmp_path / "c").read_bytes()
    (tmp_path / "c").write_bytes(whole[: round(share * len(whole))])
    assert not trainer.resume(tmp_path / "c") and "is damaged" in caplog.text


def test_the_time_limit_ends_the_training_and_says_so(frames):
    result = train(frames, SENSOR, preset("obbgs", QUICK), time_limit_s=0.0)
    assert len(result.history) == 0 and len(result.gaussians) > 0
    assert result.stop_reason == "time limit of 0 s, before the first step: the model is its untrained start"
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK))
    trainer.step()
    assert trainer.stop_reason(0.0) == "time limit of 0 s"


def test_an_interrupted_training_is_saved_at_once_and_goes_on_to_the_same_model(frames, tmp_path):
    config, checkpoint, steps = preset("obbgs", QUICK), tmp_path / "c", []
    whole = train(frames, SENSOR, config, seed=3)
    with pytest.raises(Interrupted, match=r"step 13 of 40, saved in .*: the same command goes on"):
        train(
            frames,
            SENSOR,
            config,
            3,
            lambda info: steps.append(info.step),
            checkpoint=checkpoint,
            should_stop=lambda: len(steps) == 13,
        )
    resumed = train(frames, SENSOR, config, 3, lambda info: steps.append(info.step), checkpoint=checkpoint)
    assert steps == list(range(1, 41))
    again = train(frames, SENSOR, config, 3, lambda info: steps.append(info.step), checkpoint=checkpoint)
    assert len(steps) == 40 and again.stop_reason == whole.stop_reason  # a finished one is kept too
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(resumed.gaussians, name)), name
        assert torch.equal(tensor, getattr(again.gaussians, name)), name


def test_a_checkpoint_that_the_disk_does_not_take_costs_no_training(frames, tmp_path, caplog):
    (tmp_path / "file").write_text("")
    checkpoint = tmp_path / "file" / "training.checkpoint"
    result = train(frames, SENSOR, preset("obbgs", QUICK | {"steps": 3}), checkpoint=checkpoint)
    assert len(result.history) == 3 and f"{checkpoint} cannot be written" in caplog.text
    with pytest.raises(Interrupted, match="step 1 of 3, not saved"):
        train(
            frames,
            SENSOR,
            preset("obbgs", QUICK | {"steps": 3}),
            checkpoint=checkpoint,
            should_stop=lambda: True,
        )


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", TENSORS)
def test_gaussians_that_are_not_finite_are_removed_and_counted(frames, tmp_path, caplog, name, value):
    config = preset("obbgs", QUICK | {"growth.interval": 10})
    trainer = Trainer(frames, SENSOR, config, seed=3)
    for _ in range(8):
        trainer.step()
    with torch.no_grad():
        trainer.state.gaussians.opacity_logits[
            :3
        ] = -20.0  # none of the three is drawn, as most that are not finite
        getattr(trainer.state.gaussians, name)[:3] = value
    while trainer.state.steps_done < 12:  # densification is due at step 10
        trainer.step()
    assert trainer.state.removed_not_finite == 3 and "3 Gaussians were not finite" in caplog.text
    assert all(tensor.isfinite().all() for tensor in trainer.state.gaussians.tensors().values())
    trainer.save(tmp_path / "c")
    with torch.no_grad():
        getattr(trainer.state.gaussians, name)[5] = value  # too late for any densification
    assert trainer.result("").removed_not_finite == 4
    resumed = Trainer(frames, SENSOR, config, seed=3)
    assert resumed.resume(tmp_path / "c")
    assert resumed.result("").removed_not_finite == 3


def test_a_size_beyond_all_numbers_counts_as_not_finite():
    gaussians = target(5)
    gaussians.log_scales[2] = 200.0
    assert finite(gaussians).tolist() == [True, True, False, True, True]


def test_a_model_of_which_nothing_is_finite_has_diverged(frames):
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK))
    with torch.no_grad():
        trainer.state.gaussians.quats[:] = math.nan
    with pytest.raises(Diverged, match=r"none of [0-9]+ Gaussians has finite parameters"):
        trainer.result("")


def test_a_model_has_no_more_gaussians_than_the_lit_pixels_of_the_long_exposures_allow(frames):
    long_s = sorted({f.exposure_time_s for f in frames})[1:]  # six frames of the longest alone are too few
    dark_dn = SENSOR.black_dn + 3 * SENSOR.read_noise_dn
    lit = [uniform_filter(f.dn[..., 0].numpy(), 3) > dark_dn for f in frames if f.exposure_time_s in long_s]
    wanted = QUICK | {"start.count": 100_000, "growth.max_gaussians": 100_000}
    few = Trainer(frames, SENSOR, preset("obbgs", wanted | {"growth.gaussians_per_root_pixel": 2}))
    assert (
        len(few.state.gaussians)
        <= few.setup.config.growth.max_gaussians
        == pytest.approx(2 * np.sqrt(np.mean(np.sum(lit, axis=(1, 2))) * 35), rel=0.08)
    )
    assert (
        f"at most {few.setup.config.growth.max_gaussians:,} Gaussians instead of 100,000: 2 times the square root"
        in few.setup.budget
    )
    half = Trainer(frames[::2], SENSOR, preset("obbgs", wanted | {"growth.gaussians_per_root_pixel": 2}))
    assert half.setup.config.growth.max_gaussians == pytest.approx(
        few.setup.config.growth.max_gaussians, rel=0.1
    )
    result = few.result("")
    assert result.config == few.setup.config and result.budget == few.setup.budget
    many = Trainer(frames, SENSOR, preset("obbgs", wanted | {"growth.gaussians_per_root_pixel": 0}))
    assert (
        many.setup.config.growth.max_gaussians == 100_000 and many.setup.budget == "at most 100,000 Gaussians"
    )
    start = Trainer(frames, SENSOR, preset("3dgs", QUICK | {"start.count": 500, "growth.max_gaussians": 100}))
    assert len(start.state.gaussians) == start.setup.config.start.count == 100


def test_the_chi2_of_a_good_model_is_near_one(frames):
    result = train(
        frames,
        SENSOR,
        preset("obbgs", QUICK | {"steps": 700, "start.count": 1000, "growth.max_gaussians": 1500}),
    )
    assert result.history[-1].chi2 < 3
    assert result.history[-1].seconds_left == pytest.approx(0, abs=1e-6)


def test_what_came_before_the_first_step_tells_nothing_of_the_time_left(frames):
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK))
    trainer.state.seconds += 1e6  # such as a start on a machine that does much else
    first, second = trainer.step(), trainer.step()
    assert first.seconds_left is None
    assert second.seconds_left is not None and 0 < second.seconds_left < 1e6


def test_a_decision_that_took_long_is_not_taken_for_the_pace_of_steps(frames):
    trainer = Trainer(frames, SENSOR, preset("obbgs", QUICK))
    for _ in range(6):
        trainer.step()
    trainer.state.seconds += 1e6
    left_s = trainer.step().seconds_left
    assert left_s is not None and 0 < left_s < 1e5


def test_black_frames_are_left_out_and_counted(frames):
    black = dataclasses.replace(frames[0], dn=torch.full_like(frames[0].dn, SENSOR.black_dn))
    trainer = Trainer([*frames, black, black], SENSOR, preset("obbgs", QUICK))
    assert trainer.setup.dark_frames == 2 and len(trainer.setup.frames) == len(frames)
    with pytest.raises(ReconstructionError, match="5 of 5 frames are black"):
        Trainer([black] * 5, SENSOR, preset("obbgs", QUICK))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("dn", torch.full((SIZE_PX, SIZE_PX, 1), math.nan)),
        ("world_to_camera", torch.full((4, 4), math.inf)),
        ("K", torch.full((3, 3), math.nan)),
        ("exposure_time_s", 0.0),
        ("exposure_time_s", math.nan),
    ],
)
def test_hostile_frames_are_named(frames, field, value):
    hostile = dataclasses.replace(frames[0], id=77, **{field: value})
    with pytest.raises(ReconstructionError, match="frame 77"):
        Trainer([*frames, hostile], SENSOR, preset("obbgs", QUICK))


def test_arrays_of_other_precision_train_as_those_of_single_precision(frames):
    double = [
        dataclasses.replace(
            f, dn=f.dn.to(torch.int32), world_to_camera=f.world_to_camera.double(), K=f.K.double()
        )
        for f in frames
    ]
    config = preset("obbgs", QUICK | {"steps": 3})
    single = [dataclasses.replace(f, dn=f.dn.to(torch.int32).float()) for f in frames]
    ours, theirs = (train(given, SENSOR, config, seed=3) for given in (double, single))
    for name, tensor in ours.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(theirs.gaussians, name)), name


@pytest.mark.parametrize(
    "changes",
    [
        {"dn": torch.zeros(16, 16)},
        {"dn": torch.zeros(16, 16, 4)},
        {"dn": torch.zeros(2, 16, 1)},
        {"world_to_camera": torch.eye(3)},
        {"K": torch.eye(4)},
    ],
)
def test_a_wrong_shape_is_named_with_its_frame(frames, changes):
    wrong = [*frames[:5], dataclasses.replace(frames[5], id=41, **changes), *frames[6:]]
    with pytest.raises(ReconstructionError, match=r"frame 41: expected"):
        train(wrong, SENSOR, preset("obbgs", QUICK))


def moved(frames: list[TrainingFrame], scale: float, shift=(0.0, 0.0, 0.0)) -> list[TrainingFrame]:
    """Return the frames as if a metre were `scale` m, with the body's origin moved by `shift` m."""
    poses = []
    for f in frames:
        pose = f.world_to_camera.clone()
        pose[:3, 3] = scale * pose[:3, 3] + pose[:3, :3] @ torch.tensor(shift)
        poses.append(dataclasses.replace(f, world_to_camera=pose))
    return poses


@pytest.mark.parametrize("scale", [1e-3, 1e-7])
def test_a_target_too_near_to_be_drawn_is_refused_with_advice(frames, scale):
    with pytest.raises(ReconstructionError, match=r"nearer to the cameras than 0\.01 m .*in metres"):
        Trainer(moved(frames, scale), SENSOR, preset("obbgs", QUICK))
    assert Trainer(moved(frames, 1e3), SENSOR, preset("obbgs", QUICK)).setup.radius_m > 100


def test_an_origin_behind_all_cameras_is_not_taken_for_darkness(frames):
    away = [dataclasses.replace(f, world_to_camera=f.world_to_camera.clone()) for f in frames]
    for f in away:
        f.world_to_camera[:3, 3] = torch.tensor([0.0, 0.0, -5.0])
    with pytest.raises(ReconstructionError, match="behind every camera that sees light"):
        Trainer(away, SENSOR, preset("obbgs", QUICK))


def test_a_single_first_gaussian_is_refused():
    with pytest.raises(ValueError, match=r"start\.count must be 2 or more, got 1"):
        preset("obbgs", {"start.count": 1})


def test_too_few_frames_and_a_diverging_rate_are_named_errors(frames):
    with pytest.raises(TooFewFrames, match="at least 3 frames, got 2"):
        train(frames[:2], SENSOR, preset("obbgs", QUICK))
    # all Gaussians in every step: those that a step leaves out stay finite in it
    wild = {"rates.sh": 1e38, "rates.log_scales": 1e30, "sparse.dropout": 0.0}
    with pytest.raises(Diverged, match="smaller learning rates"):
        train(frames, SENSOR, preset("obbgs", QUICK | wild))


def test_cameras_that_never_meet_end_in_a_finite_model():
    apart = []
    for i, frame in enumerate(photographed(target(), 6)):
        moved = frame.world_to_camera.clone()
        moved[:3, 3] += torch.tensor([40.0 * i, 0, 0])
        apart.append(dataclasses.replace(frame, world_to_camera=moved))
    result = train(apart, SENSOR, preset("obbgs", QUICK | {"steps": 5}))
    assert all(torch.isfinite(t).all() for t in result.gaussians.tensors().values())
