"""Builds the compiled module with GCC's sanitizers and runs the kernels under them: python -m tests.sanitize

AddressSanitizer and UndefinedBehaviorSanitizer find accesses outside arrays, uses of freed memory and undefined
operations; ThreadSanitizer finds data races. Both run every function on NumPy arrays (`tests/exercise_kernels.py`),
the first also the tests of the rasterizer, the losses and Adam. Everything is built below build/sanitize/.
`python -m tests.sanitize address` or `thread` runs only one of the two.
"""

import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
BUILD = ROOT / "build" / "sanitize"
RUNTIMES = {
    "address": ("libasan.so", "libstdc++.so"),
    "thread": ("libtsan.so",),
}  # to be loaded before Python
TESTS = ["test_render.py", "test_compiled.py", "test_losses.py", "test_adam.py"]
# CPython never frees all of its memory, so leaks are not looked for; a report ends the process.
OPTIONS = {
    "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:exitcode=66",
    "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
    "TSAN_OPTIONS": f"halt_on_error=1:exitcode=66:suppressions={ROOT / 'tests' / 'sanitize-thread.supp'}",
}
# One thread for each library that is not ours: ThreadSanitizer does not see how they synchronise theirs.
THREADS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}


def build(sanitizer: str) -> Path:
    """Return the module built with a sanitizer, as the package is built otherwise."""
    folder = BUILD / sanitizer
    shutil.rmtree(folder / "wheel", ignore_errors=True)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--disable-pip-version-check",
        "--no-deps",
        str(ROOT),
    ]
    command += ["--wheel-dir", str(folder / "wheel"), "--config-settings", f"build-dir={folder / 'cmake'}"]
    command += ["--config-settings", f"cmake.define.OBBGS_SANITIZE={sanitizer}"]
    command += ["--config-settings", "install.strip=false"]
    subprocess.run(command, check=True)
    (wheel,) = (folder / "wheel").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (member,) = (name for name in archive.namelist() if name.startswith("obbgs_core/_rasterizer.c"))
        return Path(archive.extract(member, folder))


def run(sanitizer: str, *arguments: str) -> None:
    """Run Python with the sanitizer's runtime preloaded; exit if it reports anything or fails."""
    preload = " ".join(runtime(name) for name in RUNTIMES[sanitizer])
    environment = os.environ | OPTIONS | THREADS | {"LD_PRELOAD": preload}
    # GCC 12's ThreadSanitizer does not find its memory where addresses are randomised by more than 28 bits
    fixed_addresses = ["setarch", platform.machine(), "-R"] if sanitizer == "thread" else []
    command = [*fixed_addresses, sys.executable, *arguments]
    code = subprocess.run(command, cwd=ROOT, env=environment).returncode
    if code:
        sys.exit(f"sanitize: {sanitizer}: Python ended with {code}; the report stands above")


def runtime(library: str) -> str:
    """Return the path of one of the compiler's libraries."""
    done = subprocess.run(
        [os.environ.get("CXX", "g++"), f"-print-file-name={library}"], capture_output=True, text=True
    )
    if done.returncode or not os.path.isabs(done.stdout.strip()):
        sys.exit(f"sanitize: {library} was not found; install g++ (Debian: apt-get install g++)")
    return str(Path(done.stdout.strip()).resolve())


# Takes the place of the installed module before the tests import it.
RUN_TESTS = """
import sys
import obbgs_core
from tests.exercise_kernels import load
module = load(sys.argv[1])
obbgs_core._rasterizer = sys.modules["obbgs_core._rasterizer"] = module
import pytest
sys.exit(pytest.main(["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-o", "timeout=0", *sys.argv[2:]]))
"""


def main() -> None:
    wanted = sys.argv[1:] or list(RUNTIMES)
    if not set(wanted) <= set(RUNTIMES):
        sys.exit(f"usage: python -m tests.sanitize [{'|'.join(RUNTIMES)}]")
    for sanitizer in wanted:
        print(f"{sanitizer}: building", flush=True)
        module = build(sanitizer)
        print(f"{sanitizer}: every function of the module on NumPy arrays", flush=True)
        run(sanitizer, "-m", "tests.exercise_kernels", str(module))
        if sanitizer == "address":
            print(f"{sanitizer}: {', '.join(TESTS)}", flush=True)
            run(sanitizer, "-c", RUN_TESTS, str(module), *(f"tests/obbgs_core/{name}" for name in TESTS))
    print("sanitize: nothing found")


if __name__ == "__main__":
    main()
