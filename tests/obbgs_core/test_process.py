"""What a process that trains sets for itself."""

import os

import pytest

from obbgs_core.process import prepare_process


@pytest.mark.parametrize("threads", [99_999, -1, 4 * (os.cpu_count() or 1) + 1])
def test_more_threads_than_a_machine_can_run_are_refused(threads):
    with pytest.raises(ValueError, match=rf"four for each of this machine's \d+ cores, got '{threads}'"):
        prepare_process(threads)


@pytest.mark.parametrize("stated", ["9999", "0", "-2", "many"])
def test_a_number_of_threads_in_the_environment_is_refused_though_pytorch_lets_it_pass(stated, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    with pytest.raises(ValueError, match=rf"OMP_NUM_THREADS: expected 1 to \d+, .* got '{stated}'"):
        prepare_process()
