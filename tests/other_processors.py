"""Runs the numerical tests again as processors with fewer instructions would (`make test-portable`).

Everything that chooses its code by the processor is told to choose otherwise: our kernels, numpy, OpenBLAS, torch and
MKL; one of the runs has a single thread, too. Arguments go to pytest.
"""

import os
import platform
import subprocess
import sys

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

from obbgs_core.compiled import kernels

# What computes in floating point; the trainings of tests/ground once only, they take longest.
NUMERICAL = {
    "avx2": ("tests/obbgs_core", "tests/ground", "tests/hil/test_sensor.py"),
    "portable": ("tests/obbgs_core", "tests/hil/test_sensor.py"),
}
OPENBLAS = {"x86_64": {"avx2": "Haswell", "portable": "Prescott"}, "aarch64": {"portable": "ARMV8"}}


def environment(kernel: str) -> dict[str, str]:
    """Return the environment variables of a processor whose best instruction set is that of `kernel`."""
    kept = ("X86_V3", "AVX2", "FMA3") if kernel == "avx2" else ()  # numpy's names for what AVX2 brings
    # numpy refuses to disable what it always needs and warns about what this processor lacks
    disabled = [name for name in __cpu_dispatch__ if __cpu_features__[name] and name not in kept]
    settings = {
        "OBBGS_KERNEL": kernel,
        "NPY_DISABLE_CPU_FEATURES": " ".join(disabled),
        "ATEN_CPU_CAPABILITY": "avx2" if kernel == "avx2" else "default",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2" if kernel == "avx2" else "SSE4_2",
        "OPENBLAS_CORETYPE": OPENBLAS.get(platform.machine(), {}).get(kernel, ""),
        "OMP_NUM_THREADS": "1" if kernel == "avx2" else "",
    }
    return {name: value for name, value in settings.items() if value}


def main() -> int:
    """Run pytest under each setting that this processor can imitate; return the first exit code that is not 0."""
    for kernel, tests in NUMERICAL.items():
        if kernel != "portable" and kernel not in kernels():
            print(
                f"the numerical tests as with {kernel}: skipped, this processor does not run it", flush=True
            )
            continue
        settings = environment(kernel)
        shown = " ".join(f'{name}="{value}"' for name, value in settings.items())
        print(f"the numerical tests as with {kernel}: {shown}", flush=True)
        command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "loadfile", *tests, *sys.argv[1:]]
        code = subprocess.run(command, env=os.environ | settings).returncode
        if code:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
