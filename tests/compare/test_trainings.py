"""Trainings as compared methods: interrupted and resumed, ended early, and followed on the way."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from compare import trainings
from compare.case import Case, load_case
from compare.energy import EnergyMeter
from compare.follow import MARKS, SURFACE_MARKS, Follower, image_of
from compare.opponents.reconstruction import Reconstruction, Work
from compare.trainings import reconstruct_gaussians
from compare.validation import withheld
from ground.session.cameras import exposed
from obbgs_base.errors import Interrupted
from obbgs_core.methods.presets import preset
from obbgs_core.score.metrics import psnr_db
from tests.small_sessions import small_session

STEPS = 24
PUBLISHED = preset("3dgs+exposure", {"steps": STEPS, "start.count": 150, "growth.max_gaussians": 200})
OURS = preset("obbgs", {"steps": STEPS, "start.count": 150, "chi2_end": 1e-9})


@pytest.fixture(autouse=True)
def few_surface_points(monkeypatch) -> None:
    monkeypatch.setattr(trainings, "SURFACE_POINTS", 300)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return load_case(small_session(tmp_path_factory.mktemp("sessions") / "target"))


def trained(case: Case, config, work: Work, **options) -> Reconstruction:
    return reconstruct_gaussians(case.training, case.sensor, config, 0, work, **options)


def test_an_interrupted_training_goes_on_to_the_same_model(case, tmp_path):
    asked = iter(range(1000))
    with pytest.raises(Interrupted, match=f"interrupted at step 10 of {STEPS}"):
        trained(case, PUBLISHED, Work(tmp_path, should_stop=lambda: next(asked) == 9))
    resumed, whole = trained(case, PUBLISHED, Work(tmp_path)), trained(case, PUBLISHED, Work())
    assert resumed.figures["resumed_at"] == 10 and "resumed_at" not in whole.figures
    assert torch.equal(resumed.points, whole.points) and torch.equal(resumed.surface, whole.surface)
    assert (tmp_path / "model.ply").is_file()
    # mono, degree 3; the ambient light and the point spread are one number each
    assert whole.size_bytes == 4 * (whole.figures["gaussians"] * (3 + 4 + 3 + 1 + 16) + 2)


def test_a_training_ends_early_only_after_half_of_its_steps_and_not_against_its_own_rule(case):
    early = trained(case, PUBLISHED, Work(), settled=lambda: True)
    assert early.figures["converged"] and early.figures["steps"] == STEPS // 2
    whole = trained(case, OURS, Work(), settled=lambda: True)
    assert not whole.figures["converged"] and whole.figures["steps"] == STEPS


def test_a_training_that_estimates_its_poses_hands_them_on_and_its_curve_is_measured_after_alignment(
    case, tmp_path, monkeypatch
):
    monkeypatch.setattr("obbgs_core.train.poses.REFINED_FROM", 0.1)
    doubt = torch.diag(torch.tensor([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2)
    frames = [dataclasses.replace(frame, pose_covariance=doubt) for frame in case.training]
    dark = dataclasses.replace(frames[0], dn=torch.full_like(frames[0].dn, case.sensor.black_dn))
    frames[0] = dark
    # twice the steps: by the models of fewer a frame may stay where it is
    changes = {"steps": 2 * STEPS, "start.count": 150, "poses.refine": "always"}
    followed = Follower(case, tmp_path, tmp_path / "stop")
    config = preset("obbgs", changes | {"chi2_end": 1e-9})
    result = reconstruct_gaussians(frames, case.sensor, config, 0, Work(None, followed.on_step))
    assert result.poses is not None and result.poses.estimate.frame_ids == [f.id for f in frames[1:]]
    seen, figures = case.seen_by(result)
    assert (
        figures["pose_error_px"] < 20 and figures["pose_error_tagged_px"] < 1e-2
    )  # exact tags were moved a little
    curve = followed.finish(result)
    views = [image_of(result, frame) for frame in seen.held_out]
    assert curve[-1]["psnr_clean_db"] == pytest.approx(seen.image_scores(views)["psnr_clean_db"], abs=1e-3)
    tagged = [dataclasses.replace(frame, pose_covariance=doubt) for frame in case.held_out]
    for before, after in zip(tagged, result.poses.settled(tagged), strict=True):
        assert not torch.equal(before.world_to_camera, after.world_to_camera)


def test_a_training_states_its_errors_where_it_knows_the_exposure(case):
    ours = trained(case, OURS, Work()).stated_errors
    assert ours is not None
    assert {"interval_90_noisy", "interval_90_clean", "chi2_held_out", "chi2_held_out_both"} <= set(
        ours(case.held_out, case.radiance, ())
    )
    theirs = trained(case, PUBLISHED, Work()).stated_errors
    assert theirs is not None and "chi2_held_out_both" not in theirs(case.held_out, case.radiance, ())
    assert trained(case, preset("3dgs", {"steps": 3, "start.count": 150}), Work()).stated_errors is None


def test_a_validated_training_ends_with_the_model_that_shows_best_what_was_kept_back(case, tmp_path):
    spoilt = dataclasses.replace(
        PUBLISHED, rates=dataclasses.replace(PUBLISHED.rates, means=1e-5, sh=0.02, final_share=1e4)
    )  # rates that rise make it worse in the end
    _, kept_back = withheld(case.training)
    assert 0 < len(kept_back) < len(case.training) / 5

    def shown(made: Reconstruction) -> float:
        pairs = [(image_of(made, f), f.dn / case.sensor.white_dn) for f in kept_back]
        return sum(psnr_db(*pair) for pair in pairs) / len(pairs)

    best, last = trained(case, spoilt, Work(), validated=True), trained(case, spoilt, Work())
    assert 0 < best.figures["best_step"] < STEPS and shown(best) > shown(last) + 0.5
    asked = iter(range(1000))
    with pytest.raises(Interrupted):
        trained(case, spoilt, Work(tmp_path, should_stop=lambda: next(asked) == 9), validated=True)
    resumed = trained(case, spoilt, Work(tmp_path), validated=True)
    assert (
        torch.equal(resumed.points, best.points) and resumed.figures["best_step"] == best.figures["best_step"]
    )


def test_images_of_the_true_radiance_are_exact_also_where_readings_would_be_clipped(case):
    of_camera = {tuple(f.world_to_camera.flatten().tolist()): i for i, f in enumerate(case.held_out)}

    def image(camera, exposure_s: float) -> torch.Tensor:
        light = case.radiance[of_camera[tuple(camera.world_to_camera[0].flatten().tolist())]]
        return exposed(light, case.sensor, exposure_s)

    assert case.radiance_scores(image)["psnr_mu_db"] > 100
    brighter = case.radiance_scores(lambda camera, s: (0.01 + image(camera, s)).clamp(max=1))["psnr_mu_db"]
    assert brighter < 20  # 0.01 of the brightest is nearly half of the scale


def test_a_time_limit_of_nothing_is_the_untrained_start(case):
    start = trained(case, OURS, Work(), time_limit_s=0.0)
    assert start.figures["steps"] == 0 and not start.figures["converged"]


def test_the_curve_is_measured_on_the_way_and_goes_on_after_an_interruption(case, tmp_path):
    followed = Follower(case, tmp_path, tmp_path / "stop")
    result = trained(case, PUBLISHED, Work(None, followed.on_step))
    curve = followed.finish(result)
    due = {math.ceil(mark * STEPS - 1e-9) for mark in MARKS}  # the first step that reaches each mark
    assert [round(point["share"] * STEPS) for point in curve] == [*sorted(due - {STEPS}), STEPS]
    assert all({"seconds", "cpu_seconds", "psnr_clean_db", "chamfer"} <= set(point) for point in curve)
    of_surface = [round(point["share"] * STEPS) for point in curve[:-1] if "f_02_surface" in point]
    assert of_surface == sorted({math.ceil(mark * STEPS - 1e-9) for mark in SURFACE_MARKS})
    assert curve[-1]["share"] == 1
    assert curve[-1]["psnr_clean_db"] == pytest.approx(
        case.image_scores([image_of(result, f) for f in case.held_out])["psnr_clean_db"],
        abs=1e-3,
    )
    again = Follower(case, tmp_path, tmp_path / "stop")
    again.on_step(0.5, result.seconds / 2, lambda _: result)  # resumed from a checkpoint in the middle
    assert followed.cpu_seconds / 2 < again.cpu_seconds < followed.cpu_seconds + 1
    assert max(point["share"] for point in again.points) <= 0.5 and len(again.points) >= 9


def test_costs_are_of_the_parts_that_the_work_went_on_from(case, tmp_path):
    result = trained(case, PUBLISHED, Work())

    def follower() -> Follower:
        told = {"share": 0.9, "seconds": 90.0, "cpu_seconds": 80.0, "pid": 1}
        (tmp_path / "progress.json").write_text(json.dumps(told))
        return Follower(case, tmp_path, tmp_path / "stop")

    anew = follower()
    anew.on_step(0.01, 0.0, lambda _: result)  # its checkpoint could not be used
    assert anew.cpu_seconds < 5
    resumed = follower()
    resumed.on_step(0.5, 45.0, lambda _: result)
    assert resumed.cpu_seconds == pytest.approx(40, abs=5)
    complete = follower()
    complete.finish(dataclasses.replace(result, seconds=90.0))
    assert complete.cpu_seconds == pytest.approx(80)


@pytest.mark.parametrize(
    ("values", "settled"),
    [
        ([30.0, 31.0, 31.01, 31.02, 31.03], True),
        ([30.0, 31.0, 31.01, 31.03, 31.06], False),
        ([30.0, 31.0, 31.01, 31.06, 31.01], False),  # it ended where it was, but it moved
        ([31.0, 31.0], False),  # too few to tell
    ],
)
def test_a_curve_has_settled_when_it_moved_little_over_its_last_fifth(case, tmp_path, values, settled):
    followed = Follower(case, tmp_path, tmp_path / "stop")
    shares = (0.2, 0.4, 0.44, 0.48, 0.5)
    followed.points = [{"share": s, "psnr_clean_db": v} for s, v in zip(shares, values, strict=False)]
    assert followed.settled() == settled


def test_work_stops_when_the_file_appears(case, tmp_path):
    followed = Follower(case, tmp_path, tmp_path / "stop")
    assert not followed.should_stop()
    (tmp_path / "stop").touch()
    assert Follower(case, tmp_path, tmp_path / "stop").should_stop()


def test_energy_is_summed_over_packages_and_through_a_wrap_of_the_counter(tmp_path):
    def tell(package: int, uj: int) -> None:
        folder = tmp_path / f"intel-rapl:{package}"
        folder.mkdir(exist_ok=True)
        (folder / "energy_uj").write_text(f"{uj}\n")
        (folder / "max_energy_range_uj").write_text("10000000\n")

    tell(0, 9_000_000)
    tell(1, 1_000_000)
    (tmp_path / "intel-rapl:0:0").mkdir()  # a core's share of package 0, which must not count twice
    meter = EnergyMeter(tmp_path)
    tell(0, 500_000)
    tell(1, 3_000_000)
    assert meter.sample() == pytest.approx(1.5 + 2.0)
    assert EnergyMeter(Path(tmp_path / "none")).sample() is None
