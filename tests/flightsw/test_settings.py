"""Commanded settings survive a restart, each as far as it can still hold."""

import dataclasses

import pytest

from flightsw.errors import StoreError
from flightsw.storage.settings import Settings, load_settings, save_settings

COMMANDED = Settings("triage", exposure_times_ms=(100.0, 200.0, 400.0), max_error_dn=2, safe_mode=True)


def test_what_was_commanded_comes_back(tmp_path, small_mission):
    assert load_settings(tmp_path, small_mission) == Settings(small_mission.link.priority)
    save_settings(tmp_path, COMMANDED)
    assert load_settings(tmp_path, small_mission) == COMMANDED


def test_exposure_times_that_do_not_fit_a_new_mission_do_not_end_safe_mode(tmp_path, small_mission):
    save_settings(tmp_path, COMMANDED)
    closer = dataclasses.replace(small_mission.bracket, frame_spacing_s=0.2)
    loaded = load_settings(tmp_path, dataclasses.replace(small_mission, bracket=closer))
    assert loaded == dataclasses.replace(COMMANDED, exposure_times_ms=None)


def test_one_damaged_copy_changes_nothing_and_is_told_once(tmp_path, small_mission, caplog):
    save_settings(tmp_path, COMMANDED)
    for path in (tmp_path / "settings.json", tmp_path / "settings.json.copy"):
        caplog.clear()
        damaged = bytearray(path.read_bytes())
        damaged[damaged.index(b"triage")] ^= 1
        path.write_bytes(damaged)
        assert [load_settings(tmp_path, small_mission) for _ in range(2)] == [COMMANDED] * 2
        assert caplog.text.count("was damaged") == 1


@pytest.mark.parametrize("text", ["", "[]", '{"priority": "triage"}', '{"near": 999}'])
def test_settings_that_cannot_be_read_mean_safe_mode_and_that_is_kept(tmp_path, small_mission, text, caplog):
    safe = Settings(small_mission.link.priority, safe_mode=True)
    for path in (tmp_path / "settings.json", tmp_path / "settings.json.copy"):
        path.write_text(text)
    assert [load_settings(tmp_path, small_mission) for _ in range(2)] == [safe] * 2
    assert caplog.text.count("is not usable: safe mode, and the mission's own settings") == 1
    assert len(list(tmp_path.glob("settings.json*unused*"))) == 2  # for whoever wants to know


def test_settings_of_an_earlier_version_are_taken(tmp_path, small_mission):
    text = '{"priority": "triage", "exposure_times_ms": null, "safe_mode": true, "near": 2}'
    (tmp_path / "settings.json").write_text(text)
    assert load_settings(tmp_path, small_mission) == Settings("triage", max_error_dn=2, safe_mode=True)


@pytest.mark.parametrize(
    "wrong", [{"priority": "newest"}, {"max_error_dn": 256}, {"max_error_dn": True}, {"safe_mode": 1}]
)
def test_settings_that_no_command_can_give_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        dataclasses.replace(COMMANDED, **wrong)


def test_settings_that_the_disk_refuses_are_an_error_and_those_before_stay(tmp_path, small_mission):
    save_settings(tmp_path, COMMANDED)
    (tmp_path / "settings.json.part").mkdir()  # the disk takes no file of this name
    with pytest.raises(StoreError, match="cannot keep the settings"):
        save_settings(tmp_path, dataclasses.replace(COMMANDED, safe_mode=False))
    assert load_settings(tmp_path, small_mission) == COMMANDED
