"""The parts of a training: what follows a change of the model, what evidence justifies; words decide nothing."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.evidence import Evidence
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import PRESETS, preset
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.settings import known_names
from obbgs_core.train.adam import Average
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.parts import Change
from obbgs_core.train.trainer import Trainer
from tests.scenes import QUICK, SENSOR, photographed, random_gaussians, tagged, target

FRAMES = photographed(target(), 12, size_px=32, focal_px=65.0)
TRAINER = Trainer(FRAMES, SENSOR, preset("obbgs", {"start.count": 20}))


@settings(deadline=None, max_examples=30)
@given(st.lists(st.booleans(), min_size=9, max_size=9), st.integers(0, 4), st.booleans())
def test_optimizer_records_and_mean_follow_the_gaussians_that_a_change_keeps(mask, added, goes_on):
    """Each Gaussian is known by its place in x; the moments, the record and the mean of each tell the same place."""
    state, place = TRAINER.state, torch.arange(9.0)
    model = random_gaussians(9)
    model.means[:, 0] = place
    state.gaussians = model.trainable()
    for moments in (state.adam.first, state.adam.second):
        for name, tensor in state.gaussians.parameters().items():
            moments[name] = torch.zeros_like(tensor)
        moments["means"][:, 0] = moments["opacity_logits"][:] = place
    state.growth.gradient, state.growth.weight = place.clone(), place.clone()
    state.average = Average()
    state.average.observe(state.gaussians)
    kept = torch.nonzero(torch.tensor(mask))[:, 0]
    new = random_gaussians(added, seed=1) if added else model.select(kept[:0])
    new.means[:, 0] = -1
    state.apply(
        TRAINER.setup, Change(Gaussians.concatenate([model.select(kept), new]), kept, goes_on=goes_on)
    )
    wanted, none = place[kept], torch.zeros(added)
    assert torch.equal(state.gaussians.means[: len(kept), 0], wanted) and state.gaussians.means.requires_grad
    for moments in (state.adam.first, state.adam.second):
        assert torch.equal(moments["means"][:, 0], torch.cat([wanted, none]))
        assert torch.equal(moments["opacity_logits"], torch.cat([wanted, none]))
    recorded = torch.cat([wanted if goes_on else 0 * wanted, none])
    assert torch.equal(state.growth.gradient, recorded) and torch.equal(state.growth.weight, recorded)
    mean = state.average.gaussians
    assert (mean is None) == (added > 0)
    assert mean is None or torch.equal(mean.means[:, 0], wanted)


def test_evidence_justifies_what_gains_more_than_its_penalty_and_its_error():
    gains = torch.tensor([1.0, 3.0, 5.0])
    assert Evidence(gains, penalty=2.0).justifies.tolist() == [False, True, True]
    assert Evidence(gains, penalty=2.0, error=1.5).justifies.tolist() == [False, False, True]
    assert not Evidence(torch.tensor(float("nan"))).justifies


def test_rewording_what_a_training_reports_changes_no_training():
    frames = tagged(photographed(target(), 26, size_px=32, focal_px=65.0), False)
    config = preset("obbgs", QUICK | {"poses.refine": "auto"})
    plain, reworded = (Trainer(frames, SENSOR, config, seed=3) for _ in range(2))
    for trainer in (plain, reworded):
        while not trainer.stop_reason():
            trainer.step()
            if trainer is reworded:
                state = trainer.state
                state.poses.reason = state.harmonics.reason = state.highlights.reason = ""
    assert plain.state.poses.reason and plain.state.harmonics.reason
    assert plain.state.poses.decision is reworded.state.poses.decision
    for name, tensor in plain.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(reworded.gaussians, name)), name


@given(
    st.lists(st.sampled_from([0.1, 0.2, 0.4]), min_size=6, max_size=12),
    st.lists(st.sampled_from(["keep back", "leave out", "extend", "draw"]), max_size=8),
    st.booleans(),
)
def test_who_was_drawn_how_often_outlives_every_change_of_the_order(times_s, changes, by_exposure):
    order, rng, drawn = FrameOrder(times_s, by_exposure, []), torch.Generator().manual_seed(0), []
    for change in changes:
        if change == "keep back":
            order.keep_back([[1], [2, 3]] if not order.validation_brackets else [])
        elif change == "leave out":
            order.leave_out([] if 0 in order.left_out else [0])
        elif change == "extend":
            order.extend([*order.exposures_s, 0.2])
        else:
            drawn += order.draw(5, rng)
        assert order.visits == {i: drawn.count(i) for i in set(drawn)} and order.turn == len(drawn)
        kept_back = {i for bracket in order.validation_brackets for i in bracket} | set(order.left_out)
        groups = sorted(i for group in order.groups for i in group)
        assert groups == [i for i in range(len(order.exposures_s)) if i not in kept_back]


def test_obbgs_is_the_defaults_and_has_no_more_than_forty_settings():
    names = [n for n in known_names(MethodConfig) if n != "name" and not n.startswith("published.")]
    assert len(names) <= 40
    assert PRESETS["obbgs"] == MethodConfig("obbgs")
