"""What a process that trains sets for itself."""

import os

import pytest

from obbgs_core.process import prepare_process


@pytest.mark.parametrize("threads", [99_999, -1, 4 * (os.cpu_count() or 1) + 1])
def test_more_threads_than_a_machine_can_run_are_refused(threads):
    with pytest.raises(ValueError, match=rf"four for each of this machine's \d+ cores, got {threads}"):
        prepare_process(threads)
