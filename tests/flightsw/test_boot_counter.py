"""The number of starts: one more each time, and never that of the last start whatever became of the disk."""

import logging

from flightsw.storage.boot_counter import LOST, count_boot
from obbgs_base.checked import copy_of


def test_each_start_has_the_next_number_and_a_damaged_copy_is_made_good(tmp_path, caplog):
    assert [count_boot(tmp_path) for _ in range(3)] == [1, 2, 3]
    (tmp_path / "boots.json").write_bytes(b"\0" * 40)
    assert count_boot(tmp_path) == 4
    assert "its copy was damaged" in caplog.text
    copy_of(tmp_path / "boots.json").write_bytes(b"")
    assert [count_boot(tmp_path) for _ in range(2)] == [5, 6]


def test_a_number_that_is_lost_goes_on_at_random(tmp_path, caplog):
    caplog.set_level(logging.ERROR)
    count_boot(tmp_path)
    for each in (tmp_path / "boots.json", copy_of(tmp_path / "boots.json")):
        each.write_bytes(b"?")
    boot = count_boot(tmp_path)
    assert boot >= LOST and "the number of starts is lost" in caplog.text
    assert count_boot(tmp_path) == (boot + 1) % (1 << 32)


def test_on_a_disk_that_takes_nothing_starts_differ_all_the_same(tmp_path, monkeypatch):
    count_boot(tmp_path)

    def read_only(path, content, like=None):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("flightsw.storage.store.write_whole", read_only)
    first, second = count_boot(tmp_path), count_boot(tmp_path)
    assert first != second and min(first, second) >= LOST


def test_after_the_last_number_comes_zero(tmp_path, monkeypatch):
    monkeypatch.setattr("flightsw.storage.boot_counter.secrets.randbits", lambda bits: LOST - 1)
    (tmp_path / "boots.json").write_bytes(b"?")
    assert [count_boot(tmp_path) for _ in range(2)] == [0xFFFF_FFFF, 0]
