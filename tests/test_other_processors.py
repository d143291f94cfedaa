"""What `make test-portable` sets takes effect: the process computes as the other processor would."""

import json
import os
import subprocess
import sys

import pytest

from obbgs_core.compiled import kernels
from tests.other_processors import environment

FACTS = """
import json, numpy, torch
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from obbgs_core.compiled import kernels
print(json.dumps({
    "kernel": kernels()[:1],
    "torch": torch.backends.cpu.get_cpu_capability(),
    "threads": torch.get_num_threads(),
    "numpy": [name for name in __cpu_dispatch__ if __cpu_features__[name]],
}))
"""


@pytest.mark.parametrize("kernel", [name for name in kernels() if name != "avx512"])
def test_a_process_runs_what_the_other_processor_would(kernel):
    settings = environment(kernel)
    command = [sys.executable, "-W", "error", "-c", FACTS]
    done = subprocess.run(command, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["kernel"] == [kernel] and (kernel == "portable" or facts["threads"] == 1)
    assert facts["torch"] == {"avx2": "AVX2", "portable": "DEFAULT"}[kernel]
    assert facts["numpy"] == (["X86_V3"] if kernel == "avx2" else [])
