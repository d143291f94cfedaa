"""Builds the kernels for ARM and compares what they compute there with what they do here: python -m tests.arm

ARM is emulated. It needs Debian on another processor with g++-aarch64-linux-gnu and qemu-user. Python and NumPy for ARM
are downloaded below build/arm/ and nothing is installed. PyTorch is not needed, in whose tests each kernel is compared
with the reference: here the instruction set `portable` of this processor takes its place.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from tests import exercise_kernels
from tests.exercise_kernels import KINDS, SIZES, cameras, load, model, rasterize

ROOT = Path(__file__).parents[1]
KERNELS = ROOT / "obbgs_core" / "render" / "kernels"
BUILD = ROOT / "build" / "arm"
SITE, SYSTEM, MODULE = BUILD / "site", BUILD / "root", BUILD / "_rasterizer.so"
OF_EACH_SET = ("project", "project_backward", "bins", "composite", "composite_backward", "rows/rows")
OF_ALL = ("binding", "machine/threads", "likelihood", "training")
PACKAGES = (
    *(
        "python3.11-minimal",
        "python3.11",
        "libpython3.11-minimal",
        "libpython3.11-stdlib",
        "libpython3.11-dev",
    ),
    *(
        "libc6",
        "libgcc-s1",
        "libstdc++6",
        "libexpat1",
        "zlib1g",
        "libssl3",
        "libffi8",
        "libbz2-1.0",
        "liblzma5",
    ),
)
IMAGES = 6  # of what `rasterize` returns; gradients follow
TOLERANCES = (1e-5, 1e-4)  # of the largest value of an image and of a gradient: single precision
MOST_ON_AN_EDGE = 1e-3  # share of the values that rounding puts on the other side of a cutoff


def provide() -> None:
    """Download Python, NumPy and nanobind for ARM."""
    debs = BUILD / "debs"
    for folder in (debs, BUILD / "lists" / "partial", BUILD / "cache" / "archives" / "partial", SYSTEM):
        folder.mkdir(parents=True, exist_ok=True)
    own = [f"Dir::State::lists={BUILD}/lists", f"Dir::Cache={BUILD}/cache", "APT::Sandbox::User=root"]
    own += ["APT::Architectures::=amd64", "APT::Architectures::=arm64"]
    options = [part for option in own for part in ("-o", option)]
    subprocess.run(["apt-get", *options, "-qq", "update"], check=True)
    wanted = [f"{name}:arm64" for name in PACKAGES]
    subprocess.run(["apt-get", *options, "-qq", "download", *wanted], cwd=debs, check=True)
    for package in debs.glob("*.deb"):
        subprocess.run(["dpkg", "-x", package, SYSTEM], check=True)
    platforms = [f"--platform=manylinux_2_{minor}_aarch64" for minor in (17, 27, 28)]
    pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--target", str(SITE)]
    pip += ["--python-version=3.11", "--only-binary=:all:", "--no-deps", *platforms]
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), "numpy", "nanobind==3.1.0"], check=True)


def build() -> None:
    """Compile the module for ARM with the options of CMakeLists.txt."""
    nanobind, headers = SITE / "nanobind", SYSTEM / "usr" / "include"
    compiler = [
        "aarch64-linux-gnu-g++",
        "-std=c++17",
        "-fPIC",
        "-fvisibility=hidden",
        "-O3",
        "-fno-math-errno",
    ]
    compiler += ["-fno-trapping-math", "-ffp-contract=off", "-Wno-psabi", "-fno-strict-aliasing"]
    for folder in (nanobind / "include", nanobind / "ext/robin_map/include", headers / "python3.11", headers):
        compiler += [f"-I{folder}"]
    objects = []
    sources = [KERNELS / f"{name}.cpp" for name in (*OF_EACH_SET, *OF_ALL)] + [
        nanobind / "src/nb_combined.cpp"
    ]
    for source in sources:
        objects.append(BUILD / f"{source.stem}.o")
        instruction_set = ["-DKERNEL=portable"] if source.stem in OF_EACH_SET else []
        subprocess.run([*compiler, *instruction_set, "-c", source, "-o", objects[-1]], check=True)
    subprocess.run(["aarch64-linux-gnu-g++", "-shared", *objects, "-o", MODULE, "-lpthread"], check=True)


def results(path: str) -> dict[str, np.ndarray]:
    """Return what the kernel `portable` of a module makes of some scenes, and its losses."""
    module, found = load(path), {}
    module.use_kernel("portable")
    for coefficients, channels, shading in KINDS:
        for size in SIZES:
            rng = np.random.default_rng(coefficients)
            scene = model(rng, 200, coefficients, channels, hostile=False) | cameras(rng, 2, *size)
            scene["sunlit"] = rng.random((2, 200), dtype=np.float32) if shading == "lambert" else None
            scene["sun_dir"] = None if shading == "view" else scene["sun_dir"]
            scene["peak_lowered"] = channels == 3
            for number, array in enumerate(rasterize(module, "portable", scene, size, 1)):
                found[f"{coefficients} {channels} {shading} {size} {number:02}"] = array
    sensor, rng = module.SensorModel(64.0, 4095.0, 2.0, 3.0, 1.0), np.random.default_rng(1)
    dn = np.round(np.clip(rng.uniform(-200, 4500, (2, 53, 37, 3)), 0, 4095)).astype(np.float32)
    radiance = ((dn - 64) / 4e3 * rng.uniform(0.8, 1.2, dn.shape)).astype(np.float32)
    gains, residual, gradient = np.full(2, 4e3, dtype=np.float32), np.empty_like(dn), np.empty_like(dn)
    value = module.likelihood(radiance, dn, gains, sensor, 0.1, 0.8, 2, 3.0, 0.2, None, residual, gradient, 1)
    return found | {"loss 00": np.array([value]), "loss 01": residual, "loss 07": gradient}


def main() -> None:
    if len(sys.argv) == 3:  # emulated
        np.savez(sys.argv[2], **results(sys.argv[1]))
        exercise_kernels.exercise_adam(load(sys.argv[1]))
        return
    if not (SITE / "numpy").is_dir():
        provide()
    build()
    paths = f"{SITE}:{ROOT}"
    emulated = ["qemu-aarch64", "-L", str(SYSTEM), "-E", f"PYTHONPATH={paths}"]
    emulated += ["-E", f"LD_LIBRARY_PATH={SYSTEM}/usr/lib/aarch64-linux-gnu", f"{SYSTEM}/usr/bin/python3.11"]
    command = [*emulated, "-m", "tests.arm", str(MODULE), str(BUILD / "there.npz")]
    subprocess.run(command, cwd=ROOT, env=os.environ, check=True)
    here = results(str(next((ROOT / "obbgs_core").glob("_rasterizer*.so"))))
    there, worst = np.load(BUILD / "there.npz"), 0.0
    for name, expected in here.items():
        most = TOLERANCES[int(name[-2:]) >= IMAGES] * np.abs(expected).max(initial=1e-6)
        error = np.abs(there[name] - expected)
        assert np.isfinite(there[name]).all() and (error > most).mean() <= MOST_ON_AN_EDGE, name
        worst = max(worst, float(np.median(error) / np.abs(expected).max(initial=1e-6)))
    print(
        f"{len(here)} arrays of the kernels for ARM are those of this processor; worst median error {worst:.1g}"
    )


if __name__ == "__main__":
    main()
