"""The settings of the methods: presets as data, changes by name, and mistakes that are named."""

import json
import math

import numpy as np
import pytest

from flightsw.icd.config import ConfigError
from ground.run.settings import set_changes
from obbgs_core.methods.presets import PRESETS, preset, quality_changes
from obbgs_core.settings import changed


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rates.means", -1.0, "0 or more, got -1.0"),
        ("rates.means", math.nan, "0 or more, got nan"),
        ("growth.interval", 0, "at least 1, got 0"),
        ("parsimony.prune_at", (0.5, 1.5), "from 0 to 1, got 1.5"),
        ("published.coarse", ((0.5, 12),), "triples of an image scale"),
        ("published.coarse", ((0.5, 12, 0.6), (0.5, 12, 0.5)), "less than 1 in all"),
        ("published.sh_degree", 4, "from 0 to 3, got 4"),
    ],
)
def test_settings_that_no_training_can_have_are_refused(name, value, message):
    with pytest.raises(ValueError, match=f"{name} must be .*{message}"):
        preset("obbgs", {name: value})


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("exposure_aware", "no", "true or false, got 'no'"),
        ("exposure_aware", 1, "true or false, got 1"),
        ("loss.edge_weight", "abc", "a number, got 'abc'"),
        ("loss.edge_weight", True, "a number, got True"),
        ("steps", 2.5, "a whole number, got 2.5"),
        ("steps", "30", "a whole number, got '30'"),
        ("steps", True, "a whole number, got True"),
        ("steps", None, "a whole number, got nothing"),
        ("parsimony.prune_at", 0.5, "a list such as [0.5], got 0.5"),
        ("poses.refine", "sometimes", "one of never, always, auto, got 'sometimes'"),
    ],
)
def test_values_of_another_type_are_refused_in_the_words_of_the_command_line(name, value, expected):
    with pytest.raises(ValueError) as refused:
        preset("3dgs", {name: value})
    assert str(refused.value) == f"{name}: expected {expected}"
    if value is not None and not (isinstance(value, float) and math.isnan(value)):
        with pytest.raises(ConfigError) as by_command:
            set_changes([f"{name}={json.dumps(value)}"])
        assert str(by_command.value) == f"--set {refused.value}"


def test_whole_numbers_lists_and_numbers_of_numpy_are_taken():
    config = preset(
        "obbgs", {"loss.edge_weight": 1, "steps": np.int64(30), "parsimony.prune_at": [np.float32(0.5)]}
    )
    assert config == preset("obbgs", {"loss.edge_weight": 1.0, "steps": 30, "parsimony.prune_at": (0.5,)})
    assert type(config.loss.edge_weight) is float and type(config.steps) is int


def test_quality_scales_steps_and_what_goes_with_them_and_unknown_ones_are_refused():
    standard = preset("obbgs")
    assert changed(standard, quality_changes(standard, "standard")) == standard
    draft = changed(standard, quality_changes(standard, "draft"))
    assert draft.steps == round(0.3 * standard.steps)
    assert draft.growth.max_gaussians == standard.growth.max_gaussians
    for interval in ("interval", "obb_interval"):  # as often in the whole training
        times = [c.steps / getattr(c.growth, interval) for c in (draft, standard)]
        assert times[0] == pytest.approx(times[1], rel=0.1)
    assert draft.start.count > standard.start.count
    published = quality_changes(preset("3dgs"), "draft")
    assert "growth.obb_interval" not in published  # it does not grow in boxes, and does not begin to
    assert quality_changes(standard, "best")["growth.max_gaussians"] == 3 * standard.growth.max_gaussians
    with pytest.raises(ValueError, match="quality must be one of draft, standard, best"):
        quality_changes(standard, "ultra")


def test_presets_are_data_and_mistakes_are_named():
    assert set(PRESETS) == {"3dgs", "3dgs-mcmc", "pixel-gs", "mip-splatting", "mvgs", "jiang2025", "obbgs"}
    assert preset("jiang2025").loss.edge_weight == 0.2 and not preset("jiang2025").exposure_aware
    with pytest.raises(ValueError, match="no method 'nerf'; expected one of 3dgs, "):
        preset("nerf")
    with pytest.raises(
        ValueError, match=r"no setting magic; expected one of \d+ names, such as name, exposure_aware"
    ):
        preset("3dgs", {"magic": 1})
    with pytest.raises(ValueError, match=r"no setting step; expected one of .* nearest to it: .*steps"):
        preset("obbgs", {"step": 3})
    with pytest.raises(ValueError, match="steps must be at least 1"):
        preset("obbgs", {"steps": 0})


def test_variants_are_added_to_a_methods_name_in_any_order():
    known = preset("3dgs+exposure")
    assert known.exposure_aware and known.published.clamped and not preset("3dgs").published.clamped
    both = preset("3dgs+hull+exposure", {"steps": 7})
    assert both == preset("3dgs+exposure+hull", {"steps": 7}) and both.name == "3dgs+exposure+hull"
    assert both.start == preset("obbgs").start and both.growth == preset("3dgs").growth
    assert preset("obbgs+blind").exposure_aware is False and preset("obbgs+random").start.kind == "random"
    for wrong, message in (
        ("3dgs+magic", r"no variant 'magic' .* expected METHOD\+VARIANT with one of exposure, blind"),
        ("3dgs+", "no variant ''"),
        ("+exposure", "no method ''"),
        ("obbgs+exposure", "'exposure' changes nothing in 'obbgs'"),
        ("3dgs+blind", "'blind' changes nothing in '3dgs'"),
        ("3dgs+hull+hull", "'hull' changes nothing"),
        ("3dgs+exposure+blind", "contradict each other"),
        ("3dgs+hull+random", "contradict each other"),
    ):
        with pytest.raises(ValueError, match=message):
            preset(wrong)


def test_a_group_is_changed_setting_by_setting_and_keeps_the_others():
    config = preset("obbgs", {"growth.interval": 33, "light.sun_shading": "linear"})
    assert (config.growth.interval, config.light.sun_shading) == (33, "linear")
    assert (
        config.growth.grown_share == preset("obbgs").growth.grown_share
        and preset("obbgs").growth.interval == 24
    )
    for wrong, like in (
        ("growth", "growth.begin"),
        ("growth.magic", "growth.begin"),
        ("steps.magic", "steps"),
    ):
        with pytest.raises(ValueError, match=f"no setting {wrong}; expected one of .*{like}"):
            preset("obbgs", {wrong: 1})
    with pytest.raises(ValueError, match=r"published\.loss: expected one of l1_ssim, likelihood, got 'l2'"):
        preset("obbgs", {"published.loss": "l2"})
