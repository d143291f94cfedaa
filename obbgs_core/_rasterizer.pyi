"""Types of the compiled module; its source is render/kernels/. Arrays are float32, C-contiguous and on the CPU."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array: TypeAlias = NDArray[np.float32] | Tensor

MIN_ALPHA: float
LOG2_MIN_ALPHA: float
MAX_ALPHA: float
MIN_TRANSMITTANCE: float
MIN_PEAK_SHARE: float
MIN_DEPTH_ALPHA: float
FOV_MARGIN: float
SOFTNESS: float

def kernels() -> list[str]: ...
def use_kernel(name: str) -> None: ...

class Rasterization:
    def __init__(
        self,
        kernel: str,
        width: int,
        height: int,
        near_m: float,
        means: Array,
        quats: Array,
        log_scales: Array,
        opacity_logits: Array,
        sh: Array,
        world_to_camera: Array,
        K: Array,
        sun_dir: Array | None,
        sunlit: Array | None,
        ambient: float,
        added: Array | None,
        footprint_px2: Array,
        peak_lowered: bool,
    ) -> None: ...
    def forward(
        self,
        threads: int,
        radiance: Array,
        alpha: Array,
        depth: Array,
        median_depth: Array,
        means2d: Array,
        radii: Array,
    ) -> None: ...
    def backward(
        self,
        threads: int,
        radiance: Array,
        depth: Array,
        grad_radiance: Array | None,
        grad_alpha: Array | None,
        grad_depth: Array | None,
        grad_means2d: Array | None,
        means: Array,
        quats: Array,
        log_scales: Array,
        opacity_logits: Array,
        sh: Array,
        world_to_camera: Array,
        ambient: Array,
        footprint_px2: Array,
        added: Array | None,
        screen_means2d: Array,
        pixels: Array,
    ) -> None: ...
    @property
    def pairs(self) -> int: ...
    @property
    def bytes(self) -> int: ...

class SensorModel:
    def __init__(
        self,
        black_dn: float,
        white_dn: float,
        electrons_per_dn: float,
        read_noise_dn: float,
        averaged_pixels: float,
    ) -> None: ...

def likelihood(
    radiance: Array,
    dn: Array,
    gains: Array,
    sensor: SensorModel,
    misfit: float | None,
    own: float,
    stride: int,
    factor: float,
    edge_weight: float,
    drawn: Array | None,
    residual: Array,
    gradient: Array | None,
    threads: int,
) -> float: ...
def published(
    radiance: Array,
    dn: Array,
    gains: Array,
    sensor: SensorModel,
    ssim_weight: float,
    edge_weight: float,
    clamped: bool,
    residual: Array,
    gradient: Array | None,
    threads: int,
) -> float: ...
def fit(
    radiance: Array,
    alpha: Array,
    dn: Array,
    gains: Array,
    sensor: SensorModel,
    least_alpha: float,
    threads: int,
) -> tuple[float, float, float]: ...
def adam_step(
    parameter: Array,
    gradient: Array,
    first: Array,
    second: Array,
    rates: Array,
    b1: float,
    b2: float,
    eps: float,
    threads: int,
) -> None: ...
