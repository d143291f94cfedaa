"""Files written whole on file systems that cannot do everything."""

import errno
import os
import stat

import pytest

from obbgs_base.files import append_line, write_whole


def test_a_folder_that_cannot_be_synced_is_written_to_all_the_same(tmp_path, monkeypatch):
    real, answer = os.fsync, [errno.EINVAL]

    def fsync(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(answer[0], os.strerror(answer[0]))
        real(descriptor)

    monkeypatch.setattr("obbgs_base.files.os.fsync", fsync)
    write_whole(tmp_path / "session.json", b"{}")
    append_line(tmp_path / "frames.jsonl", b"{}")
    assert (tmp_path / "session.json").read_bytes() == b"{}"
    answer[0] = errno.EIO  # the disk has failed
    with pytest.raises(OSError, match="Input/output"):
        write_whole(tmp_path / "session.json", b"[]")


def test_a_file_that_is_written_anew_keeps_its_mode_and_leaves_none_of_a_killed_command(tmp_path):
    path = tmp_path / "mission.key"
    path.write_bytes(b"old")
    path.chmod(0o600)
    part = tmp_path / "mission.key.part"  # of a command that was killed
    part.write_bytes(b"half")
    part.chmod(0o400)
    write_whole(path, b"new")
    assert path.read_bytes() == b"new" and stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not part.exists()
    path.chmod(0o664)
    write_whole(path, b"newer")
    assert stat.S_IMODE(path.stat().st_mode) == 0o664


@pytest.mark.parametrize("name", ["none/out", "file/out", "/proc/zz"])
def test_an_error_names_the_file_that_was_asked_for(tmp_path, name):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError) as caught:
        write_whole(tmp_path / name, b"{}")
    assert caught.value.filename == str(tmp_path / name)


def test_a_folder_in_the_place_of_a_file_is_named_and_no_part_is_left(tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(IsADirectoryError) as caught:
        write_whole(tmp_path / "out", b"{}")
    assert caught.value.filename == str(tmp_path / "out") and [p.name for p in tmp_path.iterdir()] == ["out"]
