"""A sample of the benchmark of damaged files: whatever bit flips, flight answers, and the ground's session opens."""

import pytest

from tests.benchmarks.flips import KINDS, Case, measure


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("side", "trials"), [("flight", 45), ("ground", 40)])
def test_no_damage_to_one_file_silences_flight_or_closes_a_session(
    small_mission, tmp_path, side, trials, kind
):
    row = measure(Case(side, kind, trials), 0, trials, tmp_path / "small.yaml")
    assert row["failures"] == {} and row["trials_failed"] == 0
