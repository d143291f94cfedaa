"""Checked records: no single flipped bit, cut or missing file changes a value that is read."""

import json
import os
import re
import zlib

import pytest

from obbgs_base.checked import (
    checked_line,
    copy_of,
    has_checksum,
    parse_checked_line,
    read_twice,
    write_twice,
)

TREE = {"frame_id": 7, "text": "ä\n", "nested": {"crc32": "00000000"}, "list": [1.5, None, True]}


def test_a_line_is_json_and_its_last_key_is_the_crc_of_the_bytes_before_it():
    line = checked_line(TREE)
    assert b"\n" not in line and parse_checked_line(line) == TREE and has_checksum(line)
    tree = json.loads(line)
    before = line[: line.rindex(b', "crc32"')]
    assert list(tree)[-1] == "crc32" and int(tree["crc32"], 16) == zlib.crc32(before)


def test_no_flipped_bit_passes():
    line = checked_line(TREE)
    for at in range(8 * len(line)):
        damaged = bytearray(line)
        damaged[at // 8] ^= 1 << at % 8
        with pytest.raises(ValueError, match=r"checksum"):
            parse_checked_line(bytes(damaged))


def test_without_a_checksum_a_line_is_not_taken():
    with pytest.raises(ValueError, match="ends with its checksum"):
        parse_checked_line(b'{"frame_id": 7}')


def test_what_stands_twice_survives_the_damage_or_the_end_of_either(tmp_path):
    path, problems = tmp_path / "settings.json", []
    assert read_twice(path, problems.append) is None
    write_twice(path, {"safe_mode": False})
    write_twice(path, TREE)
    whole = path.read_bytes()
    for each in (path, copy_of(path)):
        for content in [
            *(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :] for at in range(len(whole))),
            b"",
            bytes(len(whole)),
            whole[:-9],
        ]:
            each.write_bytes(content)
            assert read_twice(path, problems.append) == TREE
            assert each.read_bytes() == whole  # as it was before
    assert len(problems) == 2 * (len(whole) + 2) + 2
    each.unlink()
    assert read_twice(path, problems.append) == TREE and each.read_bytes() == whole
    assert len(problems) == 2 * (len(whole) + 2) + 2  # the power went between the two


def test_the_first_of_the_two_is_the_newer_one(tmp_path):
    path = tmp_path / "settings.json"
    write_twice(path, {"safe_mode": False})
    path.write_bytes(checked_line({"safe_mode": True}) + b"\n")  # the power goes before the copy
    assert read_twice(path, pytest.fail) == {"safe_mode": True}
    os.unlink(path)
    assert read_twice(path, pytest.fail) == {"safe_mode": True}


def test_where_both_are_damaged_nothing_is_made_up(tmp_path):
    path = tmp_path / "settings.json"
    write_twice(path, TREE)
    path.write_bytes(b"")
    copy_of(path).write_bytes(b"\0")
    with pytest.raises(ValueError, match="checksum"):
        read_twice(path, pytest.fail)


def test_a_line_whose_checksum_does_not_fit_is_told_by_its_beginning():
    line = checked_line({"schema_version": 1, "name": "a\nb"}).replace(b"1", b"2", 1)
    with pytest.raises(
        ValueError, match=re.escape('the line, which begins with {"schema_version": 2, "name": "a')
    ):
        parse_checked_line(line.rstrip(b"\n"))
