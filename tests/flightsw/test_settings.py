"""Commanded settings survive a restart, each as far as it can still hold."""

import dataclasses

import pytest

from flightsw.settings import Settings, load_settings, save_settings

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


@pytest.mark.parametrize("text", ["", "[]", '{"priority": "triage"}', '{"near": 999}'])
def test_a_damaged_file_is_reported_and_the_mission_decides(tmp_path, small_mission, text, caplog):
    (tmp_path / "settings.json").write_text(text)
    assert load_settings(tmp_path, small_mission) == Settings(small_mission.link.priority)
    assert "is not usable, the mission's own settings are used" in caplog.text
