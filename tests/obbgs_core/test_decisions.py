"""What a training decides on the way: pruning by BIC, harmonics, and poses by validation brackets."""

import dataclasses

import pytest
import torch

from obbgs_core.batches import Batches
from obbgs_core.evidence import gains
from obbgs_core.evidence.gains import (
    SHOWN_RADII,
    SHOWN_RADII_LAMBERT,
    VIEWS,
    justified,
    likelihood_gains,
    next_degree_gain,
    shown_frames,
)
from obbgs_core.evidence.poses import CorrectionEvidence
from obbgs_core.frames import TrainingFrame, cameras_of, sampling_rates
from obbgs_core.methods.presets import preset
from obbgs_core.misfit import Compared, stated_misfit
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance
from obbgs_core.render import render
from obbgs_core.train import poses
from obbgs_core.train.fit import UNSEEN_UNTIL
from obbgs_core.train.poses import SET_BACK_TO, PoseDecision
from obbgs_core.train.trainer import Trainer, train
from tests.scenes import QUICK, SENSOR, decide, move_poses_in, photographed, tagged, target


def test_the_likelihood_gain_of_a_gaussian_matches_removing_it():
    model = target(8, seed=2)
    frames = photographed(model, count=12)
    batches = Batches(frames, SENSOR.white_dn)
    rng = torch.Generator().manual_seed(1)
    estimates = torch.stack([likelihood_gains(model, batches, SENSOR, rng)[0].gain for _ in range(60)])
    exact = torch.zeros(len(model))
    for j in range(len(model)):
        fewer = model.select(torch.arange(len(model)) != j)
        for index in range(len(frames)):
            batch = batches.batch([index], 1.0)
            with torch.no_grad():
                all_dn = SENSOR.expected_dn(render(model, batch.cameras).radiance, batch.exposure_time_s)
                dn = SENSOR.expected_dn(render(fewer, batch.cameras).radiance, batch.exposure_time_s)
            lit = batch.dn < SENSOR.white_dn
            exact[j] += 0.5 * ((dn - all_dn) ** 2 / SENSOR.variance_dn2(all_dn) * lit).sum()
    # 60 draws of 12 frames with a relative deviation of about 1.4 each: 5 % a Gaussian; alpha cutoffs add a little
    torch.testing.assert_close(estimates.mean(0), exact, rtol=0.25, atol=0)


def test_the_pixels_that_show_a_gaussian_are_its_weights_in_the_reference_renderer():
    model = target(8, seed=2)
    frames = photographed(model, count=5)
    batches = Batches(frames, SENSOR.white_dn)
    most = torch.zeros(len(model))
    for index in range(len(frames)):
        cameras = batches.batch([index], 1.0).cameras
        for j in range(len(model)):  # it alone is bright: what is seen is its weight
            sh = torch.full((len(model), 1, 1), from_radiance(torch.tensor(0.0)).item())
            sh[j] = from_radiance(torch.tensor(1e4))
            alone = dataclasses.replace(model.detach(), sh=sh)
            weights = render(alone, cameras, backend="reference").radiance / 1e4
            most[j] = torch.maximum(most[j], weights.sum())
    _, shown_px = likelihood_gains(model, batches, SENSOR, torch.Generator().manual_seed(0))
    torch.testing.assert_close(shown_px, most, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("count", [12, 105, 117, 120, 231, 363])
def test_the_frames_that_decide_are_spread_evenly_over_the_exposure_times_of_the_brackets(count):
    frame = photographed(target(8, seed=2), count=1)[0]
    frames = [dataclasses.replace(frame, exposure_time_s=(1.0, 2.0, 4.0)[i % 3]) for i in range(count)]
    shown = [frames[i].exposure_time_s for i in shown_frames(Batches(frames, SENSOR.white_dn))]
    of_each = [shown.count(seconds) for seconds in (1.0, 2.0, 4.0)]
    assert max(of_each) - min(of_each) <= 1
    assert min(count, 0.7 * VIEWS) <= len(shown) <= VIEWS


def test_opaque_gaussians_are_pruned_where_no_picture_shows_them_and_dark_ones_are_not():
    model = dataclasses.replace(target(8, seed=2).detach(), footprint="camera")
    frames = photographed(model, count=12)
    dark = dataclasses.replace(model, sh=torch.full_like(model.sh, from_radiance(torch.tensor(0.0)).item()))
    dust = dataclasses.replace(model, log_scales=model.log_scales - 6)  # far thinner than a pixel
    both = Gaussians.concatenate([dark, dust])
    both.opacity_logits[:] = 3.0
    rng = torch.Generator().manual_seed(0)
    kept = justified(both, Batches(frames, SENSOR.white_dn), SENSOR, 1.0, 0.65, rng)
    assert kept.tolist() == [True] * 8 + [False] * 8


def test_opaque_gaussians_are_pruned_by_what_they_show_of_the_target_and_sooner_under_a_moving_sun(
    monkeypatch,
):
    """The same picture of a larger target: what was more than a strip of it is less."""
    model = dataclasses.replace(target(8, seed=2).detach(), footprint="camera")
    model.opacity_logits[:] = 3.0
    sun = torch.tensor([0.0, 0.0, 1.0])
    frames = [dataclasses.replace(f, sun_dir=sun) for f in photographed(model, count=12)]
    batches = Batches(frames, SENSOR.white_dn)
    # no likelihood is enough
    monkeypatch.setattr(gains, "bic_penalty", lambda *_: 1e12)
    _, shown_px = likelihood_gains(model, batches, SENSOR, torch.Generator().manual_seed(0))
    per_m = sampling_rates(model.means.median(dim=0).values[None], frames).item()
    for shading, radii in (("view", SHOWN_RADII), ("lambert", SHOWN_RADII_LAMBERT)):
        gaussians = dataclasses.replace(model, shading=shading)
        for least_px, shown in ((0.8 * shown_px.min().item(), True), (1.2 * shown_px.max().item(), False)):
            rng = torch.Generator().manual_seed(0)
            kept = justified(gaussians, batches, SENSOR, least_px / radii / per_m, 0.65, rng)
            assert kept.tolist() == [shown] * len(model)


def test_colour_that_turns_with_the_view_justifies_harmonics_and_plain_colour_does_not():
    plain = target(10, seed=4)
    turning = Gaussians(
        **{**plain.tensors(), "sh": torch.cat([plain.sh, torch.full((10, 3, 1), 0.3)], dim=1)}
    )
    for seen, justifies in ((plain, False), (turning, True)):
        batches = Batches(photographed(seen, 24), SENSOR.white_dn)
        evidence = next_degree_gain(plain, batches, SENSOR, torch.Generator().manual_seed(0))
        assert bool(evidence.justifies) == justifies


# with these a training of `tagged` frames tells right poses from wrong ones
TELLING = {
    "steps": 400,
    "start.count": 1500,
    "growth.max_gaussians": 2000,
    "poses.refine": "auto",
}


@pytest.fixture
def tested_late(monkeypatch):
    monkeypatch.setattr(poses, "REFINED_FROM", 0.4)


@pytest.mark.usefixtures("tested_late")
@pytest.mark.parametrize("wrong", [True, False])
def test_wrong_poses_are_refined_and_exact_ones_are_left_alone(wrong):
    frames = tagged(photographed(target(80, seed=5), 42), wrong, sigma_rad=0.01)
    trainer = Trainer(frames, SENSOR, preset("obbgs", TELLING))
    while trainer.state.poses.decision is PoseDecision.OPEN:
        assert trainer.state.order.validation_brackets == [[i] for i in range(3, 42, 7)]
        trainer.step()
    assert trainer.state.order.validation_brackets == [] and trainer.state.history[-1].step == 161
    assert trainer.state.steps_done == (
        400 * SET_BACK_TO if wrong else 161
    )  # a refinement sets the schedule back
    assert trainer.state.poses.decision is (PoseDecision.REFINED if wrong else PoseDecision.TAGS_HOLD)
    assert trainer.state.poses.report.startswith("refined (step 161" if wrong else "as tagged (step 161")
    assert (trainer.state.poses.corrections is not None) == wrong
    assert trainer.result("").poses == trainer.state.poses.report
    # who was drawn how often is not forgotten: frames that join late are drawn more often
    order = trainer.state.order
    assert sum(order.visits.values()) == order.turn > 0


def under_a_moving_sun() -> tuple[list[TrainingFrame], list[int]]:
    """Return frames that each have a Sun of their own, and the indices of those that are kept back at first."""
    suns = torch.nn.functional.normalize(
        torch.randn(42, 3, generator=torch.Generator().manual_seed(2)), dim=1
    )
    return photographed(target(80, seed=5), 42, suns=suns), list(range(3, 42, 7))


def own_error(model: Gaussians, frames: list[TrainingFrame], indices: list[int]) -> float:
    compared = []
    for i in indices:
        seen = render(model, cameras_of([frames[i]]))
        times_s = torch.tensor(frames[i].exposure_time_s).view(1, 1, 1, 1)
        compared.append(Compared(seen.radiance, seen.alpha > 0.05, times_s, frames[i].dn[None]))
    return stated_misfit(compared, SENSOR)


@pytest.mark.usefixtures("tested_late")
@pytest.mark.parametrize("tags", ["exact", "uncertain, and no evidence against them"])
def test_where_the_sun_moves_brackets_not_yet_seen_tell_the_models_own_error(tags, monkeypatch):
    no_evidence = CorrectionEvidence(torch.tensor([-1.0, -2.0, -3.0]), torch.zeros(3), torch.ones(3))
    monkeypatch.setattr(poses, "correction_evidence", lambda *_: no_evidence)
    frames, unseen = under_a_moving_sun()
    frames = frames if tags == "exact" else tagged(frames, wrong=False)
    trainer = Trainer(frames, SENSOR, preset("obbgs", TELLING))
    trainer.withhold()  # as where frames may join, of which none came
    while trainer.state.steps_done <= TELLING["steps"] * UNSEEN_UNTIL:
        model, misfit = trainer.state.model.copied(), trainer.state.fit.misfit
        trainer.state.fit.chi2 = 0.5  # of noise alone: the training goes on until all frames are trained on
        assert trainer.stop_reason() == ""
        assert trainer.state.order.validation_brackets == [[i] for i in unseen]
        assert trainer.state.fit.unseen_factor is None
        trainer.step()
        assert not set(unseen) & set(trainer.state.order.visits)
    assert trainer.state.order.validation_brackets == [] and misfit is not None
    # of the model of one step before, and here of whole pictures
    assert trainer.state.fit.unseen_factor == pytest.approx(
        own_error(model, frames, unseen) / misfit, rel=0.25
    )
    while not (reason := trainer.stop_reason()):
        trainer.step()
    assert set(unseen) <= set(trainer.state.order.visits)
    result = trainer.result(reason)
    assert result.misfit == trainer.state.fit.misfit * trainer.state.fit.unseen_factor
    assert result.unseen_factor == trainer.state.fit.unseen_factor


@pytest.mark.usefixtures("tested_late")
def test_a_training_that_ends_before_states_the_error_on_the_brackets_that_it_has_not_seen():
    frames, unseen = under_a_moving_sun()
    trainer = Trainer(frames, SENSOR, preset("obbgs", TELLING))
    for _ in range(150):
        trainer.step()
    result = trainer.result("time limit of 1 s")
    assert trainer.state.fit.unseen_factor is None and result.unseen_factor is not None
    assert result.misfit == pytest.approx(own_error(result.gaussians, frames, unseen), rel=0.25)


@pytest.mark.parametrize(
    "changes", [{"published.loss": "l1_ssim"}, {"loss.misfit": False}, {"published.compensation": True}]
)
def test_where_no_own_error_is_learnt_no_bracket_is_kept_back_for_it(changes):
    frames, _ = under_a_moving_sun()
    trainer = Trainer(frames, SENSOR, preset("obbgs", TELLING | changes))
    assert trainer.state.order.validation_brackets == []


def test_brackets_that_do_not_tell_an_error_leave_that_of_the_others(caplog):
    frames, unseen = under_a_moving_sun()
    trainer = Trainer(frames, SENSOR, preset("obbgs", TELLING))
    for _ in range(5):
        trainer.step()
    for i in unseen:  # nothing but full scale is read
        trainer.setup.batches.frames[i].dn.fill_(SENSOR.white_dn)
    trainer.setup.batches._images.clear()
    decide(trainer, trainer.state.fit)
    assert trainer.state.fit.unseen_factor is None and trainer.state.order.validation_brackets == []
    assert "do not tell the model's own error" in caplog.text
    assert trainer.state.fit.misfit == Trainer.result(trainer, "").misfit


def test_with_exact_poses_or_few_frames_no_bracket_is_kept_for_validation():
    exact = photographed(target(), 24)
    config = preset("obbgs", QUICK | {"poses.refine": "auto"})
    for frames, why in ((exact, "the tags are exact"), (tagged(exact, True)[:23], "too few brackets")):
        trainer = Trainer(frames, SENSOR, config)
        assert (
            why in trainer.state.poses.report
            and not trainer.state.order.validation_brackets
            and trainer.state.poses.corrections is None
        )
    assert "before this was decided" in Trainer(tagged(exact, True), SENSOR, config).result("").poses


@pytest.mark.parametrize("killed_at", [12, 19, 35])
def test_a_training_killed_about_its_decisions_resumes_to_the_same_model(tmp_path, monkeypatch, killed_at):
    move_poses_in(monkeypatch, 8)  # else poses move in each of so few steps
    monkeypatch.setattr(poses, "REFINED_FROM", 0.35)
    frames = tagged(photographed(target(), 28), True)
    changes = {"poses.refine": "auto", "growth.interval": 5}
    config = preset("obbgs", QUICK | changes | {"parsimony.prune_at": (0.5,)})
    whole = train(frames, SENSOR, config, seed=3)
    first = Trainer(frames, SENSOR, config, seed=3)
    for _ in range(killed_at):
        first.step()
    first.save(tmp_path / "checkpoint")
    resumed = train(frames, SENSOR, config, 3, checkpoint=tmp_path / "checkpoint")
    assert (resumed.poses, resumed.growth) == (whole.poses, whole.growth)
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(resumed.gaussians, name)), name
