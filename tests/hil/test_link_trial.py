"""Passes under faults at reduced size: flight and ground as processes, every frame once and bit-identical.

`run_trial` itself compares SHA-256 and pixels and looks for duplicates and frames that were not delivered; the whole
matrix with 64 frames is `python -m tests.benchmarks.link`.
"""

import pytest

from hil.links.faults import Faults
from tests.link_trial import Trial, TrialError, TrialResult, noise_containers, run_trial

FAULTS = Faults(loss=0.1, bit_flip=0.02, duplicate=0.02, reorder=0.02)
ALL = {"cut_s": 2.0, "kills": 3, "full_disks": True, "seed": 5}


@pytest.fixture
def trial(tmp_path, small_mission, monkeypatch):
    """Runs a pass of a few frames of 5 kB, in which a disk stays full for half as long as in the whole matrix."""
    monkeypatch.setattr("tests.link_trial.FULL_S", 1.5)

    def run(trial: Trial, frames: int, limit_s: float = 120) -> TrialResult:
        result = run_trial(
            trial, tmp_path / "pass", tmp_path / "small.yaml", noise_containers(frames, 48), limit_s
        )
        assert result.frames == frames
        return result

    return run


def test_every_packet_lost_on_a_serial_line_is_counted_as_missing(trial):
    result = trial(Trial("serial", Faults(loss=0.1), seed=3), 40)
    lost = result.lanes["down"]["packets_lost"]
    # the ground cannot know of the first zero byte, nor of losses before the first or after the last packet of an APID
    apids = 5
    assert lost - apids <= result.ground["packets_missing"] <= lost
    assert result.ground["crc_errors"] == result.ground["skipped_bytes"] == 0
    assert result.flight["downlink"]["segments_resent"] > 0


def test_damaged_doubled_and_swapped_packets_are_counted(trial):
    result = trial(Trial("serial", Faults(bit_flip=0.05, duplicate=0.05, reorder=0.05), seed=3), 40)
    down = result.lanes["down"]
    assert down["packets_flipped"] > 0
    assert result.ground["crc_errors"] >= down["packets_flipped"] / 2  # a flipped zero byte joins two packets
    assert result.ground["skipped_bytes"] > 0


@pytest.mark.parametrize(
    ("case", "frames"),
    [
        (Trial("serial", Faults(loss=0.3), seed=2), 6),
        (Trial("serial", kills=3, seed=1), 24),
        (Trial("serial", full_disks=True), 12),
        (Trial("serial", FAULTS, **ALL), 24),
        (Trial("can", Faults(loss=0.3), kills=3, seed=4), 10),
        (Trial("can", Faults(bit_flip=0.01, duplicate=0.02, reorder=0.01), seed=2), 2),
        (Trial("canfd", FAULTS, **ALL), 24),
        (Trial("canfd", Faults(loss=0.1), one_shot=True), 4),
    ],
    ids=lambda value: f"{value.link}-{value.seed}" if isinstance(value, Trial) else "",
)
def test_every_frame_arrives_once_and_unchanged(trial, case, frames):
    trial(case, frames)


@pytest.mark.parametrize(
    ("case", "frames"),
    [
        (Trial("can"), 8),
        (Trial("canfd"), 8),
        (Trial("canfd", stalls=2, stall_s=0.3, seed=1), 48),
        (Trial("canfd", stalls=1, stall_s=1.0, seed=2), 48),
    ],
    ids=lambda value: f"{value.link}-{value.stall_s:g}" if isinstance(value, Trial) else "",
)
def test_a_can_bus_without_faults_carries_a_pass_without_a_loss_or_a_repetition(trial, case, frames):
    """Nor when one side is stopped for a while, as when it waits for its disk."""
    result = trial(case, frames)
    downlink = result.flight["downlink"]
    assert downlink["segments_resent"] == downlink["transfers_failed"] == 0
    assert result.ground["packets_missing"] == result.ground["crc_errors"] == 0
    assert result.ground["packets_received"] == downlink["packets_sent"]  # flight's last packets too
    assert set(result.ground["link_losses"].values()) == {0}
    for lane in result.lanes.values():
        assert lane["frames_lost"] == lane["frames_overrun"] == 0
    # up, a second answer to an offer that was repeated may come when flight has gone
    down = result.lanes["down"]
    assert down["frames_in"] == down["frames_out"]


def test_a_pass_that_cannot_end_is_an_error(trial):
    with pytest.raises(TrialError, match="0 of 2 frames"):
        trial(Trial("serial", Faults(loss=1.0)), 2, limit_s=2)
