"""Cells, budgets, conditions and rows of a comparison, without a training."""

import dataclasses
import io
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given as generated
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from compare.case import Case, content_digest, load_case
from compare.conditions import AS_TAKEN, Condition, _blurred, _moved_px, given, load_conditions, read_out
from compare.errors import CompareError
from compare.grid.cells import Budget, cells_of, parse_budgets, session_facts
from compare.grid.rows import Rows, locked
from compare.grid.worker import _rounded_all, run_cell
from compare.methods import method
from flightsw.icd.config import ConfigError
from ground.session.folder import SessionError
from obbgs_core.frames import cameras_of
from obbgs_core.methods.presets import preset, quality_changes
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from tests import scenes
from tests.benchmarks import targets
from tests.small_sessions import small_session

GRIDS = Path(targets.__file__).parent / "grids"
PLAIN = {AS_TAKEN: Condition()}


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    return small_session(tmp_path_factory.mktemp("sessions") / "target")


@pytest.fixture(scope="module")
def case(session) -> Case:
    return load_case(session)


def frames_under(case: Case, **changes):
    return given(case, Condition(**changes))[0]


def test_a_session_holds_every_eighth_view_out_with_its_truth(case):
    assert [frame.id for frame in case.held_out] == [7, 15, 23] and len(case.training) == 21
    for clean, noisy, coverage in zip(case.clean, case.noisy, case.coverage, strict=True):
        assert clean.shape == noisy.shape == (40, 40, 1) and coverage.shape == (40, 40)
        expected_dn = clean * case.sensor.white_dn
        normalised = (expected_dn - noisy * case.sensor.white_dn) / case.sensor.variance_dn2(
            expected_dn
        ).sqrt()
        assert 0.9 < normalised.std() < 1.1  # of 1,600 readings: deviation 2 %
    assert case.units_per_m == 1 and case.cloud_m is not None


def test_the_digest_of_a_session_is_of_its_content(session, tmp_path):
    copy = tmp_path / "elsewhere"
    shutil.copytree(session, copy)
    header = json.loads((copy / "session.json").read_text())
    (copy / "session.json").write_text(json.dumps(header | {"created_utc": "2030-01-01T00:00:00+00:00"}))
    assert content_digest(copy) == content_digest(session)
    lines = (copy / "frames.jsonl").read_text().splitlines()
    record = json.loads(lines[3])
    lines[3] = json.dumps(record | {"exposure_time_s": record["exposure_time_s"] * 1.001})
    (copy / "frames.jsonl").write_text("\n".join(lines) + "\n")
    assert content_digest(copy) != content_digest(session)


def test_a_session_that_changed_since_the_grid_was_made_gives_no_row(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    (cell,) = cells_of([session_facts(tmp_path / "s")], ["black"], 1, [Budget()], PLAIN)
    assert run_cell(cell, tmp_path / "out", tmp_path / "stop", "compare")["digest"] == cell.digest
    lines = (tmp_path / "s" / "frames.jsonl").read_text().splitlines()
    (tmp_path / "s" / "frames.jsonl").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(SessionError, match="has changed since the command started"):
        run_cell(cell, tmp_path / "out", tmp_path / "stop", "compare")


@pytest.mark.skipif("TDRS" not in targets.names(), reason="the rendered targets are not there")
def test_a_rendered_target_is_the_same_as_a_session(tmp_path):
    expected = targets.load("TDRS", 100)
    targets.write(targets.expose("TDRS", 100), tmp_path / "TDRS-100")
    case = load_case(tmp_path / "TDRS-100")
    assert case.sensor == expected.sensor
    for side in ("training", "held_out"):
        for made, wanted in zip(getattr(case, side), getattr(expected, side), strict=True):
            assert torch.equal(made.dn, wanted.dn) and torch.equal(made.K, wanted.K)
            assert torch.equal(made.world_to_camera, wanted.world_to_camera)
            assert (made.exposure_time_s, made.id) == (wanted.exposure_time_s, wanted.id)
    half_precision, eight_bits = 2**-11, 0.5 / 255
    for made, wanted in zip(case.clean, expected.clean, strict=True):
        torch.testing.assert_close(made, wanted, rtol=half_precision, atol=1e-6)
    for made, wanted in zip(case.coverage, expected.coverage, strict=True):
        torch.testing.assert_close(made, wanted, rtol=0, atol=eight_bits + 1e-6)
    np.testing.assert_allclose(case.cloud_m, expected.cloud_m, rtol=1e-6, atol=1e-7)


def test_a_cell_stands_once_where_axes_mean_nothing_to_its_method(session):
    budgets = parse_budgets("1,0.5@300")
    cells = cells_of([session_facts(session)], ["black", "mvs", "3dgs", "3dgs+exposure"], 3, budgets, PLAIN)
    counts = {
        name: sum(cell.method == name for cell in cells) for name in ("black", "mvs", "3dgs", "3dgs+exposure")
    }
    assert counts == {"black": 1, "mvs": 1, "3dgs": 6, "3dgs+exposure": 6}
    assert len({cell.digest for cell in cells}) == len(cells)
    small, full = (
        next(c for c in cells if c.method == "3dgs" and c.budget == b) for b in (budgets[1], budgets[0])
    )
    assert small.memory_mb < full.memory_mb


def test_settings_of_a_training_hold_only_for_trainings(session):
    conditions = PLAIN | {"no Sobel": Condition(set={"loss.edge_weight": 0.0})}
    cells = cells_of([session_facts(session)], ["black", "obbgs"], 1, [Budget()], conditions)
    assert [(c.method, c.condition_name) for c in cells] == [
        ("black", AS_TAKEN), ("obbgs", AS_TAKEN), ("obbgs", "no Sobel")
    ]  # fmt: skip


def test_the_same_grid_has_the_same_digests_whatever_its_conditions_are_called(session):
    facts = session_facts(session)
    first, second = (
        cells_of([facts], ["obbgs"], 1, [Budget()], {name: Condition(noise=2.0)})
        for name in ("loud", "noisy")
    )
    assert first[0].digest == second[0].digest
    other = cells_of([facts], ["obbgs"], 1, [Budget()], {"loud": Condition(noise=2.5)})
    assert other[0].digest != first[0].digest


def test_unknown_methods_are_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"no method 'nerg'.*3dgs.*black, mean"):
        method("nerg")
    with pytest.raises(ValueError, match="no variant 'exposed'"):
        method("3dgs+exposed")
    with pytest.raises(ValueError, match="'exposure' changes nothing in 'obbgs'") as refused:
        method("obbgs+exposure+exposure")
    assert "black" not in str(refused.value)


def test_two_sessions_of_one_content_are_refused(session, tmp_path):
    shutil.copytree(session, tmp_path / "copy")
    with pytest.raises(CompareError, match=r"have the same content: leave one out$"):
        cells_of([session_facts(session), session_facts(tmp_path / "copy")], ["black"], 1, [Budget()], PLAIN)


@pytest.mark.parametrize("text", ["", "0", "-1", "a", "1@", "1@0", "1@1", "1@2.5", "nan", "inf", "1,,2"])
def test_budgets_that_are_none_are_refused(text):
    with pytest.raises(ValueError, match="--budgets: expected shares of the steps"):
        parse_budgets(text)


def test_frames_exposed_anew_have_the_ratios_and_the_noise_of_their_condition(case):
    frames = frames_under(case, exposure_ratios=(1.0, 4.0, 16.0), noise=2.0)
    times_s = sorted({frame.exposure_time_s for frame in frames})
    assert times_s == pytest.approx([5e-5, 2e-4, 8e-4])
    dark = torch.cat([f.dn[:4, :4].flatten() for f in frames])  # corners show no target
    assert dark.std() == pytest.approx(2 * case.sensor.read_noise_dn, rel=0.2)  # 336 readings: 4 % each
    assert dark.mean() == pytest.approx(case.sensor.black_dn, abs=2)


def test_exposure_times_are_wrong_by_setting_and_drift_while_tags_stay(case):
    def longer(**condition: float) -> np.ndarray:
        """Return ln of the light of each frame over that with the exposure time of its tag."""
        sums = []
        for changes in ({}, condition):
            frames = frames_under(case, exposure_ratios=(1.0, 1.5, 2.0), noise=1e-6, **changes)
            assert len({f.exposure_time_s for f in frames}) == 3
            sums.append([float((f.dn - case.sensor.black_dn).sum()) for f in frames])
        return np.log(np.divide(sums[1], sums[0]))

    exposures_s = [f.exposure_time_s for f in case.training]
    drifted, by_setting = longer(exposure_drift=-0.4), longer(setting_error=0.1)
    np.testing.assert_allclose(drifted, np.linspace(0.2, -0.2, len(drifted)), atol=0.02)
    of = [by_setting[np.array(exposures_s) == s] for s in sorted(set(exposures_s))]
    assert max(np.ptp(values) for values in of) < 0.02
    means = np.array([values.mean() for values in of])
    assert abs(np.median(means)) < 0.01 and np.abs(means).max() > 0.02


@generated(st.floats(0.1, 3.0), st.floats(0.5, 2.0))
def test_the_response_bends_the_signal_and_not_its_ends(noise, gamma):
    sensor = Sensor(64, 4095, 1.0, 1e9, 1e-6)
    condition = Condition(noise=noise, response_gamma=gamma)
    signal = np.linspace(0, 1, 9)
    dn = read_out(signal * 4031, 1.0, sensor, condition, np.random.default_rng(0))
    expected = 64 + 4031 * signal**gamma
    rounding, shot_dn = 0.5, 5 * 3 * np.sqrt(4031 / 1e9)  # five deviations at most
    np.testing.assert_allclose(dn, expected, atol=rounding + shot_dn + 1e-4)


def test_shot_noise_has_the_variance_of_its_electrons():
    sensor = Sensor(64, 4095, 1.0, 4.0, 2.0)
    dn = read_out(np.full((200, 200), 1000.0), 1.0, sensor, Condition(), np.random.default_rng(1))
    expected = float(sensor.variance_dn2(torch.tensor(1064.0)))  # shot, read and rounding
    assert dn.var() == pytest.approx(expected, rel=0.04)  # 40,000 readings: deviation 0.7 %


def test_blurred_frames_are_what_a_moving_target_looks_like_at_the_told_rate(case):
    """The true model, as `small_session` made it, drawn with the rates and without."""
    true, sensor = scenes.target(), case.sensor
    frames = frames_under(case, blur_px=4.0, noise=1e-3)
    still = [dataclasses.replace(frame, rates=None) for frame in frames]
    rms_dn = []
    for told in (frames, still):
        errors = [
            sensor.expected_dn(render(true, cameras_of([f])).radiance[0], torch.tensor(f.exposure_time_s))
            - f.dn
            for f in told
            if f.dn.max() < sensor.white_dn
        ]
        rms_dn.append(torch.stack(errors).square().mean().sqrt())
    assert rms_dn[0] < 0.15 * rms_dn[1]
    turns = torch.stack([frame.rates[:3] * frame.exposure_time_s for frame in frames])
    focal_px = torch.stack([frame.K[0, 0] for frame in frames])
    torch.testing.assert_close(turns.norm(dim=1) * focal_px, torch.full((len(frames),), 4.0))


@pytest.mark.parametrize(("n", "most"), [(4, 0.015), (1, 0.06)])
def test_finer_light_tells_how_a_sharp_edge_moves(case, n, most):
    """Interpolated between pixels, an edge is wrong by some hundredths of its height."""
    frame, size = case.training[0], case.training[0].shape[0]
    x, y = _moved_px(frame, 2.0)

    def edge(pixels: int, moved: float) -> np.ndarray:
        """Return a bright half of the picture, seen in so many pixels, each the mean over 8x8 points."""
        at = (np.arange(8 * pixels) + 0.5) / (8 * pixels) * size - size / 2
        bright = (at[None] - moved * x) * 0.8 + (at[:, None] - moved * y) * 0.6 > 0.37
        return (
            bright.reshape(pixels, 8, pixels, 8).mean(axis=(1, 3))[..., None].repeat(frame.shape[2], axis=2)
        )

    exact = np.mean([edge(size, moved) for moved in (np.arange(16) + 0.5) / 16 - 0.5], axis=0)
    inside = slice(4, -4)
    error = np.abs(_blurred(edge(n * size, 0.0), frame, 2.0) - exact)[inside, inside].max()
    assert error < most and (n > 1 or error > 0.015)


def test_hot_pixels_are_the_same_in_all_frames(case):
    pairs = zip(frames_under(case), frames_under(case, hot_pixels=0.01), strict=True)
    more = torch.stack([hot.dn - plain.dn for plain, hot in pairs])
    changed = (more > 0).any(dim=3)
    assert more.min() == 0 and changed[0].sum() > 5
    unsaturated = torch.stack([f.dn for f in frames_under(case, hot_pixels=0.01)]) < case.sensor.white_dn
    assert all(
        len(set(m[u].tolist())) <= 1 for m, u in zip(more.flatten(1).T, unsaturated.flatten(1).T, strict=True)
    )


def test_frames_stored_as_jpeg_are_those_that_pillow_reads_and_their_tables_are_told(case):
    frames, sensor = given(case, Condition(jpeg=70))
    assert sensor.jpeg is not None and given(case, Condition())[1].jpeg is None
    values = (case.training[0].dn * 255 / sensor.white_dn).round().numpy().astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(values.squeeze()).save(file, "JPEG", quality=70)
    read = torch.from_numpy(np.array(Image.open(file), np.float32)).reshape(values.shape)
    torch.testing.assert_close(frames[0].dn, read * sensor.white_dn / 255)


def test_a_pedestal_and_a_gradient_are_added_before_readings_are_clipped(case):
    range_dn = case.sensor.white_dn - case.sensor.black_dn
    for plain, raised in zip(
        frames_under(case, noise=1e-6), frames_under(case, noise=1e-6, pedestal=0.1), strict=True
    ):
        expected = (plain.dn + 0.1 * range_dn).clamp(max=case.sensor.white_dn)
        assert (
            raised.dn - expected
        ).abs().max() <= 1.5  # rounding of both, and the shot noise of few electrons
    for plain, slanted in zip(
        frames_under(case, noise=1e-6), frames_under(case, noise=1e-6, stray_gradient=0.1), strict=True
    ):
        added = (slanted.dn - plain.dn)[..., 0]
        corners = added[[0, 0, -1, -1], [0, -1, 0, -1]]  # show no target
        assert corners.min() == pytest.approx(0, abs=2) and corners.max() == pytest.approx(
            0.1 * range_dn, abs=2
        )
        steps = added[0].diff()  # along the uppermost row, which shows none either
        assert (steps - steps.mean()).abs().max() <= 2


def test_pose_errors_turn_the_camera_and_say_so(case):
    frames = frames_under(case, pose_error_deg=1.0)
    angles = []
    for turned, frame in zip(frames, case.training, strict=True):
        motion = (turned.world_to_camera @ torch.linalg.inv(frame.world_to_camera)).double().numpy()
        angles.append(Rotation.from_matrix(motion[:3, :3]).as_rotvec())
        assert turned.pose_covariance is not None
        assert turned.pose_covariance[0, 0] == pytest.approx(np.radians(1.0) ** 2)
    assert np.degrees(np.std(angles)) == pytest.approx(1.0, rel=0.3)  # 63 numbers: deviation 9 %


def test_frames_are_lost_as_the_condition_says(case):
    assert [f.id for f in frames_under(case, frames=3)] == [case.training[i].id for i in (0, 10, 20)]
    assert len(frames_under(case, lost_percent=50)) == 11  # of 21, rounded in favour of the method
    longest = frames_under(case, missing_exposure=3)
    assert max(f.exposure_time_s for f in longest) == pytest.approx(1e-4)
    for i, unlit in enumerate(frames_under(case, eclipse=(0.0, 0.5))):
        dark = unlit.dn.max() < case.sensor.black_dn + 6 * case.sensor.read_noise_dn
        assert dark == (i < 10.5)  # of 21
    noisy = torch.stack([f.dn for f in frames_under(case, eclipse=(0.0, 0.5), noise=5.0)[:10]])
    assert noisy.std() == pytest.approx(5 * case.sensor.read_noise_dn, rel=0.1)


def test_a_method_is_told_the_beliefs_of_a_condition(case):
    _, sensor = given(case, Condition(believed_noise=2.0, believed_gain=1.05))
    signal, rounding = torch.tensor(500.0), 1 / 12
    told, true = (float(s.variance_dn2(signal)) - rounding for s in (sensor, case.sensor))
    assert told == pytest.approx(4 * true, rel=1e-5)
    assert sensor.dn_per_radiance_s == pytest.approx(1.05 * case.sensor.dn_per_radiance_s)
    assert given(case, Condition())[1] == case.sensor


def test_a_session_without_truth_cannot_be_exposed_anew(session, tmp_path):
    shutil.copytree(session, tmp_path / "imported", ignore=shutil.ignore_patterns("truth"))
    case = load_case(tmp_path / "imported")
    assert case.clean == [] and list(case.image_scores(case.noisy)) == ["psnr_noisy_db"]
    with pytest.raises(CompareError, match="imported has no truth"):
        given(case, Condition(noise=2.0))
    assert len(given(case, Condition(lost_percent=50))[0]) == 11


def test_photographs_become_a_bracket_without_any_truth(session, tmp_path):
    shutil.copytree(session, tmp_path / "imported", ignore=shutil.ignore_patterns("truth"))
    case = load_case(tmp_path / "imported")
    frames = frames_under(case, synthetic_bracket=(0.25, 1.0, 4.0))
    ratios = [f.exposure_time_s / old.exposure_time_s for f, old in zip(frames, case.training, strict=True)]
    assert ratios == pytest.approx([0.25, 1.0, 4.0] * 7)
    for frame, old in list(zip(frames, case.training, strict=True))[::3]:  # those of the shortest exposure
        expected = (old.dn - case.sensor.black_dn) / 4 + case.sensor.black_dn
        off = (frame.dn - expected) / case.sensor.variance_dn2(expected).sqrt()
        assert off.square().mean().sqrt() == pytest.approx(1, abs=0.3)  # noise of its own
    coded = dataclasses.replace(case, session=dataclasses.replace(case.session, encoding="srgb"))
    with pytest.raises(CompareError, match="imported are srgb-coded"):
        given(coded, Condition(synthetic_bracket=(0.25, 1.0)))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"exposure_ratios": (1.0, 2.0)}, "has 3 exposure times"),
        ({"frames": 22}, "only 21"),
        ({"missing_exposure": 4}, "only 3 exposure times"),
    ],
)
def test_conditions_that_do_not_fit_a_session_are_refused(case, changes, told):
    with pytest.raises(CompareError, match=told):
        given(case, Condition(**changes))
    one = [frame for frame in case.training if frame.exposure_time_s == case.training[0].exposure_time_s]
    with pytest.raises(CompareError, match="leaves no training frame"):
        given(dataclasses.replace(case, training=one), Condition(missing_exposure=1))


def test_a_sector_that_leaves_no_frame_gives_a_row_that_says_so(session, tmp_path):
    wide = {"wide": Condition(held_out_sector_deg=350.0)}
    (cell,) = cells_of([session_facts(session)], ["mean"], 1, [Budget()], wide)
    row = run_cell(cell, tmp_path / "out", tmp_path / "stop", "compare")
    assert "leaves no frame" in row["error"] and row["method"] == "mean"


def test_the_share_of_the_steps_is_of_those_that_a_condition_sets(session, tmp_path):
    few = {"few": Condition(set={"steps": 40})}
    (cell,) = cells_of([session_facts(session)], ["obbgs"], 1, [Budget(0.1)], few)
    row = run_cell(cell, tmp_path / "out", tmp_path / "stop", "compare")
    assert row["steps"] == 4
    # and its curve has images alone on the way
    assert len(row["curve"]) > 2 and not [point for point in row["curve"][:-1] if "f_02_surface" in point]


def test_a_figure_that_is_no_number_is_left_out_of_a_row():
    assert _rounded_all({"a": 1.0000001, "b": math.nan, "c": math.inf, "d": 3}) == {"a": 1.0, "d": 3}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "expected a mapping of names"),
        ("a: {nois: 2}", "conditions.a.nois: unknown key"),
        ("a: {noise: 0}", "conditions.a.noise: expected more than 0"),
        ("a: {exposure_error: 1000}", "conditions.a.exposure_error: expected at most 3"),
        ("a: {exposure_drift: -4}", "conditions.a.exposure_drift: expected at most 3, got 4"),
        ("a: {noise: loud}", "conditions.a.noise: expected a number"),
        ("a: {eclipse: [0.7, 0.4]}", "conditions.a.eclipse: expected two shares"),
        ("a: {synthetic_bracket: [1, 0]}", "conditions.a.synthetic_bracket: expected numbers above 0"),
        ("a: {synthetic_bracket: [1, 4], noise: 2}", "leave one out"),
        ("a: {held_out_sector_deg: 360}", "conditions.a.held_out_sector_deg: expected 0 to less than 360"),
        ("a: {lost_percent: 100}", "expected 0 to less than 100"),
        ("a: {set: {growth.intervall: 60}}", "growth.intervall: unknown key"),
        ("a: {set: {growth.interval: 0}}", "growth.interval must be at least 1"),
        ("a: {noise: 2}\nb: {noise: 2.0}", "conditions.b: is the same as a"),
        ("a: {}\na: {noise: 2}", "is written twice"),
    ],
)
def test_files_of_conditions_are_read_strictly(tmp_path, text, told):
    (tmp_path / "conditions.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_conditions(tmp_path / "conditions.yaml")
    assert told in str(caught.value) and "conditions.yaml" in str(caught.value)


def test_a_file_of_conditions_that_is_not_there_is_named(tmp_path):
    with pytest.raises(CompareError, match=r"nope\.yaml is not there"):
        load_conditions(tmp_path / "nope.yaml")


@pytest.mark.parametrize("path", sorted(GRIDS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_grids_of_the_benchmarks_are_conditions(path):
    conditions = load_conditions(path)
    assert next(iter(conditions.values())) == Condition()  # what the others are compared with stands first
    for condition in conditions.values():
        assert dataclasses.replace(method("obbgs")).settable or not condition.set


def test_the_grid_of_qualities_has_the_settings_of_a_draft():
    draft = load_conditions(GRIDS / "quality.yaml")["draft"]
    assert dict(draft.set) == quality_changes(preset("obbgs"), "draft")


def test_rows_are_whole_and_a_half_line_is_cut_off(tmp_path):
    rows = Rows(tmp_path)
    rows.add({"digest": "a", "value": 1.0})
    with open(tmp_path / "rows.jsonl", "ab") as file:
        file.write(b'{"digest": "b", "val')
    again = Rows(tmp_path)
    assert set(again.rows) == {"a"}
    again.add({"digest": "c"})
    assert [json.loads(line)["digest"] for line in (tmp_path / "rows.jsonl").read_text().splitlines()] == [
        "a",
        "c",
    ]
    with pytest.raises(ValueError, match="not JSON compliant"):
        again.add({"digest": "d", "value": float("nan")})
    assert set(Rows(tmp_path).rows) == {"a", "c"}


def test_a_damaged_row_is_named(tmp_path):
    (tmp_path / "rows.jsonl").write_text('{"digest": "a"}\n{"dig\n')
    with pytest.raises(CompareError, match=r"rows\.jsonl line 2 is no row"):
        Rows(tmp_path)


def test_one_command_at_a_time_works_in_a_folder(tmp_path):
    with (
        locked(tmp_path / "out"),
        pytest.raises(CompareError, match="another command works in"),
        locked(tmp_path / "out"),
    ):
        pass
    with locked(tmp_path / "out"):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(CompareError, match="is a file: give a folder"), locked(tmp_path / "file"):
        pass
