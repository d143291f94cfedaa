"""A sample of the benchmark of damaged files: whatever bit of a store flips, flight answers and its frames arrive."""

import pytest

from tests.benchmarks.flips import KINDS, measure


@pytest.mark.parametrize("kind", KINDS)
def test_no_damage_to_one_file_of_a_store_silences_flight(small_mission, tmp_path, kind):
    row, failures = measure(kind, 45, tmp_path / "small.yaml")
    assert failures == {} and row["trials_failed"] == 0
