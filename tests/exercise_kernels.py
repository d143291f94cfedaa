"""Calls every function of a compiled module with NumPy arrays, many threads and awkward shapes, without PyTorch.

`tests/sanitize.py` runs it under the sanitizers: python -m tests.exercise_kernels MODULE.so
"""

import importlib.machinery
import importlib.util
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType

import numpy as np

THREADS = (1, 2, 4)
FLOAT32_MAX = float(np.finfo(np.float32).max)
SIZES = [(33, 70), (1, 1), (97, 31)]  # height and width, px: neither is a multiple of a block or tile
# coefficients, channels, what lights them
KINDS = [(1, 1, "view"), (4, 3, "view"), (16, 3, "view"), (9, 1, "sun"), (1, 3, "lambert"), (4, 3, "lambert")]
# Images that the loss depends on, each with those before it: each choice has loops of its own.
ASKED = ("radiance", "depth")
CROWD = 20_000  # Gaussians in two views: enough work for four threads in every loop of the rasterizer


def load(path: str) -> ModuleType:
    """Return the compiled module in a file, whatever is installed."""
    loader = importlib.machinery.ExtensionFileLoader("_rasterizer", path)
    spec = importlib.util.spec_from_loader("_rasterizer", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def model(rng: np.random.Generator, count: int, coefficients: int, channels: int, hostile: bool) -> dict:
    """Return the arrays of a model; a hostile one holds infinities, NaN, zeros and huge numbers as well."""
    arrays = {
        "means": rng.normal(size=(count, 3)) * 0.5,
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.uniform(-5, -1, (count, 3)),
        "opacity_logits": 2 * rng.normal(size=count),
        "sh": rng.uniform(-0.3, 1.0, (count, coefficients, channels)),
    }
    if hostile and count:
        awkward = [np.nan, np.inf, -np.inf, 0.0, 1e30, -1e30, FLOAT32_MAX, 200.0, -200.0, 1e-40]
        for array in arrays.values():
            flat = array.reshape(-1)
            flat[rng.integers(0, flat.size, max(1, flat.size // 20))] = rng.choice(awkward)
            flat[rng.integers(0, flat.size, max(1, flat.size // 20))] = rng.choice(awkward)
        if count > 1:  # one that is drawn although its edge lies beyond 2^31 px
            arrays["means"][-1], arrays["quats"][-1] = 0.0, 1.0
            arrays["log_scales"][-1], arrays["opacity_logits"][-1], arrays["sh"][-1] = 18.0, 3.0, 0.5
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def cameras(rng: np.random.Generator, count: int, height: int, width: int) -> dict:
    """Return cameras that look at the origin from 4 m, their footprints, and the Sun's directions."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    poses[:, 2, 3] = 4.0
    K = np.array([[1.2 * width, 0, width / 2 - 0.7], [0, 1.1 * width, height / 2 + 1.3], [0, 0, 1]])
    suns = rng.normal(size=(count, 3))
    suns /= np.linalg.norm(suns, axis=1, keepdims=True)
    arrays = {"world_to_camera": poses, "K": np.tile(K, (count, 1, 1)), "sun_dir": suns}
    arrays["footprint_px2"] = rng.uniform(0.1, 0.4, count)
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}


def rasterize(
    module: ModuleType,
    kernel: str,
    scene: dict,
    size: tuple[int, int],
    threads: int,
    asked: str = "depth",
) -> list[np.ndarray]:
    """Return all that the forward and the backward pass write."""
    gaussians, views = len(scene["means"]), len(scene["world_to_camera"])
    rasterization = module.Rasterization(
        kernel=kernel, height=size[0], width=size[1], near_m=0.01, ambient=0.1, **{"added": None} | scene
    )
    channels = scene["sh"].shape[2]
    radiance = empty(views, *size, channels)
    alpha, depth, median_depth = (empty(views, *size) for _ in range(3))
    means2d, radii = empty(views, gaussians, 2), empty(views, gaussians)
    rasterization.forward(threads, radiance, alpha, depth, median_depth, means2d, radii)
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "world_to_camera")
    gradients = [np.empty_like(scene[name]) for name in names]
    gradients += [empty(1), empty(views)]
    of_added = None if scene.get("added") is None else np.full_like(scene["added"], np.nan)
    of_screen = [empty(views, gaussians, 2), empty(views, gaussians)]
    of_radiance = np.broadcast_to(np.float32(1), radiance.shape)  # its strides are zero
    of_depth = None if asked == "radiance" else np.ones_like(depth)
    of_means2d = None if asked == "radiance" else np.ones_like(means2d)
    rasterization.backward(
        threads,
        radiance,
        depth,
        of_radiance,
        np.ones_like(alpha),
        of_depth,
        of_means2d,
        *gradients,
        of_added,
        *of_screen,
    )
    gradients += of_screen if of_added is None else [*of_screen, of_added]
    assert rasterization.bytes >= rasterization.pairs >= 0
    images = [radiance, alpha, depth, median_depth]
    return [*images, means2d, radii, *gradients]


def empty(*shape: int) -> np.ndarray:
    return np.full(shape, np.nan, dtype=np.float32)


def same(results: list[list[np.ndarray]]) -> bool:
    """Return whether all hold the same numbers, bit for bit."""
    pairs = (pair for other in results[1:] for pair in zip(results[0], other, strict=True))
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def exercise_rasterizer(module: ModuleType, kernel: str) -> None:
    for coefficients, channels, shading in KINDS:
        for size in SIZES:
            for count in (0, 1, 17, 1500):
                rng = np.random.default_rng(count)
                scene = model(rng, count, coefficients, channels, hostile=False)
                scene |= cameras(rng, 2, *size)
                scene["sunlit"] = rng.random((2, count), dtype=np.float32) if shading == "lambert" else None
                scene["sun_dir"] = None if shading == "view" else scene["sun_dir"]
                scene["peak_lowered"] = channels == 3
                scene["added"] = rng.random((2, count, 3), dtype=np.float32) if channels == 3 else None
                for asked in ASKED if count == 17 else ["depth"]:
                    results = [rasterize(module, kernel, scene, size, threads, asked) for threads in THREADS]
                    assert same(results)  # the number of threads changes no bit
                    assert all(np.isfinite(array).all() for array in results[0])
                    hostile = scene | model(rng, count, coefficients, channels, hostile=True)
                    rasterize(module, kernel, hostile, size, 2, asked)


def exercise_threads(module: ModuleType, kernel: str) -> None:
    """Draw more Gaussians, which the helper threads share, also for two callers at the same time."""
    rng, size = np.random.default_rng(3), (200, 130)
    scene = model(rng, CROWD, 1, 3, hostile=False) | cameras(rng, 2, *size)
    scene["sunlit"], scene["peak_lowered"] = rng.random((2, CROWD), dtype=np.float32), True
    results = [rasterize(module, kernel, scene, size, threads) for threads in THREADS]
    with ThreadPoolExecutor(2) as callers:
        results += callers.map(lambda threads: rasterize(module, kernel, scene, size, threads), (2, 2))
    assert same(results)


def exercise_losses(module: ModuleType) -> None:
    """Call the losses on images with clipped and invalid readings."""
    rng = np.random.default_rng(1)
    for averaged_pixels, misfit in ((1.0, None), (4.0, None), (4.0, 0.1)):
        sensor = module.SensorModel(64.0, 4095.0, 2.0, 3.0, averaged_pixels)
        for shape in [(2, 53, 37, 3), (1, 3, 3, 1), (1, 1, 1, 3), (2, 2, 5, 1), (3, 130, 20, 1)]:
            dn = np.round(np.clip(rng.uniform(-200, 4500, shape), 0, 4095)).astype(np.float32)
            gains = np.full(shape[0], 4e3, dtype=np.float32)
            weighted = sensor, misfit, 0.8, 2, 3.0, 0.2
            radiance = ((dn - 64) / 4e3 * rng.uniform(0.8, 1.2, shape)).astype(np.float32)
            for invalid in (False, True):
                if invalid:
                    flat = radiance.reshape(-1)
                    flat[rng.integers(0, flat.size, 9)] = [
                        np.nan,
                        np.inf,
                        -np.inf,
                        1e38,
                        -1e38,
                        1e-40,
                        0,
                        1e9,
                        -1e9,
                    ]
                results = []
                drawn = (rng.random(shape[:3]) > 0.99).astype(np.float32)
                for threads in THREADS:
                    results.append([])
                    for part in (None, drawn):
                        residual, gradient = np.empty_like(dn), np.empty_like(dn)
                        value = module.likelihood(
                            radiance, dn, gains, *weighted, part, residual, gradient, threads
                        )
                        results[-1] += [np.float64(value), residual, gradient]
                    residual, gradient = np.empty_like(dn), np.empty_like(dn)
                    value = module.published(
                        radiance, dn, gains, sensor, 0.2, 0.1, True, residual, gradient, threads
                    )
                    results[-1] += [np.float64(value), residual, gradient]
                    alpha = rng.random(shape[:3], dtype=np.float32)
                    module.fit(radiance, alpha, dn, gains, sensor, 0.05, threads)
                    residual = np.empty_like(dn)
                    module.likelihood(radiance, dn, gains, *weighted, drawn, residual, None, threads)
                    module.published(radiance, dn, gains, sensor, 0.2, 0.1, False, residual, None, threads)
                assert same(results)


def exercise_adam(module: ModuleType) -> None:
    for count, period in ((1, 1), (1000, 1), (100_003, 1), (48 * 2100, 48), (3 * 5000, 5000)):
        rates = np.linspace(0.01, 0.02, period, dtype=np.float32)
        results = []
        for threads in THREADS:
            rng = np.random.default_rng(count)
            parameter, first, second = (rng.random(count, dtype=np.float32) for _ in range(3))
            for _ in range(3):
                gradient = rng.normal(size=count).astype(np.float32)
                module.adam_step(parameter, gradient, first, second, rates, 0.9, 0.999, 1e-15, threads)
            results.append([parameter, first, second])
        assert same(results)


def exercise_refusals(module: ModuleType) -> None:
    """Arrays of wrong sizes must raise errors before anything is read."""
    rng = np.random.default_rng(0)
    scene = (
        model(rng, 5, 4, 3, hostile=False) | cameras(rng, 1, 8, 8) | {"sunlit": None, "peak_lowered": False}
    )
    wrong = {
        "means": empty(4, 3),
        "sh": empty(5, 5, 3),
        "K": empty(2, 3, 3),
        "sun_dir": empty(2, 3),
        "footprint_px2": empty(2),
    }
    for name, array in wrong.items():
        try:
            rasterize(module, "portable", scene | {name: array}, (8, 8), 1)
        except ValueError:
            continue
        raise AssertionError(f"{name} of a wrong size was accepted")
    numbers = [np.zeros(10, np.float32) for _ in range(4)]
    for rates in (empty(0), empty(3)):
        try:
            module.adam_step(*numbers, rates, 0.9, 0.999, 1e-15, 1)
        except ValueError:
            continue
        raise AssertionError(f"{len(rates)} rates for ten numbers were accepted")


def main() -> None:
    module = load(sys.argv[1])
    exercise_refusals(module)
    for kernel in module.kernels():
        began = time.monotonic()
        module.use_kernel(kernel)
        exercise_rasterizer(module, kernel)
        exercise_threads(module, kernel)
        exercise_losses(module)
        exercise_adam(module)
        print(f"  {kernel}: {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
