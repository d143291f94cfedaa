"""The radiance field of the baseline `nerf`: a multiresolution hash encoding and two small networks (Müller 2022)."""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import csr_matrix
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from obbgs_core.model.sh import sh_basis

COARSEST_CELLS = 16  # along each axis of the coarsest level, as published
PRIMES = (1, 2_654_435_761, 805_459_861)  # of the published hash
FIRST_FEATURE = 1e-4  # features start uniformly within plus and minus this, as published
WIDTH, GEOMETRY = 64, 16  # neurons of a hidden layer; numbers that the first network passes on
DIRECTION_COEFFICIENTS = 16  # spherical harmonics up to degree 3, which the authors call degree 4
LARGEST_EXPONENT = 15.0  # keeps densities finite


@dataclass(frozen=True)
class EncodingSize:
    """How many levels an encoding has, how many features each gives, and how many table rows each has at most.

    Finer levels than the rows allow share rows by hashing.
    """

    levels: int
    features: int
    table_rows: int


class _WeightedRows(torch.autograd.Function):
    """Sums of weighted table rows, [N, F] = sum over 8 of weights [N, 8] times table[rows [N, 8]].

    There is no gradient by the weights, that is by the positions.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.table_rows = len(table)
        return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        rows, weights = ctx.saved_tensors
        gradient_of = scattered if rows.is_cuda else multiplied
        return gradient_of(rows, weights, grad_outputs[0], ctx.table_rows), None, None


def multiplied(rows: Tensor, weights: Tensor, gradient: Tensor, table_rows: int) -> Tensor:
    """Return the gradient [table_rows, F] of a table as a product with the transposed sparse matrix of the weights.

    PyTorch's own backward pass takes ten times as long on a CPU.

    Args:
        rows, weights: [N, 8]; gradient: [N, F] by the sums of weighted rows; all on the CPU.
    """
    starts = np.arange(0, rows.numel() + 1, 8, dtype=np.int32)
    entries = (weights.numpy().ravel(), rows.numpy().ravel(), starts)
    matrix = csr_matrix(entries, shape=(len(rows), table_rows))
    return torch.from_numpy(matrix.T @ gradient.numpy())


def scattered(rows: Tensor, weights: Tensor, gradient: Tensor, table_rows: int) -> Tensor:
    """Return what `multiplied` does by adding row by row, fast on a GPU, where the order of the sums is by chance."""
    parts = (weights[:, :, None] * gradient[:, None]).flatten(0, 1)
    return gradient.new_zeros(table_rows, gradient.shape[1]).index_add_(0, rows.flatten(), parts)


class HashEncoding(nn.Module):
    """Features of positions in the unit cube, interpolated in grids of rising resolution; no gradient by position.

    A level whose vertices all fit into its table has one row for each; a finer one finds the row of a vertex by a hash.

    Source: Müller et al., Instant Neural Graphics Primitives with a Multiresolution Hash Encoding, 2022.
    """

    def __init__(self, size: EncodingSize, finest_cells: int, generator: torch.Generator):
        super().__init__()
        growth = (max(finest_cells, COARSEST_CELLS) / COARSEST_CELLS) ** (1 / (size.levels - 1))
        self.cells = [round(COARSEST_CELLS * growth**level) for level in range(size.levels)]
        self.rows = [min((n + 1) ** 3, size.table_rows) for n in self.cells]
        self.width = size.levels * size.features
        features = 2 * _random((sum(self.rows), size.features), generator) - 1
        self.table = nn.Parameter(features * FIRST_FEATURE)

    def forward(self, positions: Tensor) -> Tensor:
        """Return the features [N, width] at positions [N, 3] in 0..1, float32."""
        rows = positions.new_empty(len(positions), len(self.cells), 8, dtype=torch.int32)
        weights = positions.new_empty(len(positions), len(self.cells), 8)
        first_row = 0
        for level, (cells, count) in enumerate(zip(self.cells, self.rows, strict=True)):
            row, weight = corners(positions, cells, count)
            rows[:, level], weights[:, level] = (row + first_row).T, weight.T
            first_row += count
        features = _WeightedRows.apply(self.table, rows.view(-1, 8), weights.view(-1, 8))
        return features.view(len(positions), self.width)  # pyright: ignore[reportAttributeAccessIssue]


def corners(positions: Tensor, cells: int, rows: int) -> tuple[Tensor, Tensor]:
    """Return the table rows [8, N] (int32) and trilinear weights [8, N] of the vertices around positions [N, 3].

    Args:
        positions: in 0..1.
        cells: of the grid along each axis.
        rows: of the table; the cube of cells + 1, or a power of two below it.
    """
    hashed = rows < (cells + 1) ** 3
    strides = PRIMES if hashed else (1, cells + 1, (cells + 1) ** 2)
    row = positions.new_zeros(1, len(positions), dtype=torch.int32)
    weight = positions.new_ones(1, len(positions))
    for axis in range(3):
        scaled = positions[:, axis] * cells
        low = scaled.floor().clamp(0, cells - 1)
        vertex = torch.stack([low, low + 1]).long() * strides[axis]  # [2, N]
        # the lowest bits of a product do not depend on the higher ones, and XOR treats each bit by itself
        vertex = (vertex & (rows - 1) if hashed else vertex).int()[:, None]
        share = torch.stack([1 - scaled + low, scaled - low])[:, None]
        row = (vertex ^ row if hashed else vertex + row).flatten(0, 1)
        weight = (share * weight).flatten(0, 1)
    return row, weight


class Field(nn.Module):
    """Density and colour at positions in the unit cube; density is per side of the cube.

    Colours lie in 0..1 (sigmoid), or are positive without a bound (exponential).
    """

    def __init__(
        self,
        channels: int,
        bounded: bool,
        encoding: EncodingSize,
        finest_cells: int,
        generator: torch.Generator,
    ):
        super().__init__()
        self.bounded = bounded
        self.encoding = HashEncoding(encoding, finest_cells, generator)
        self.density_layers = _layers((self.encoding.width, WIDTH, GEOMETRY), generator)
        self.colour_layers = _layers((GEOMETRY + DIRECTION_COEFFICIENTS, WIDTH, WIDTH, channels), generator)

    def geometry(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return densities [N], and the numbers [N, GEOMETRY] from which `colour` goes on, at positions [N, 3]."""
        features = _applied(self.density_layers, self.encoding(positions))
        return features[:, 0].clamp(max=LARGEST_EXPONENT).exp(), features

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        """Return colours [N, C] seen along unit directions [N, 3] (from the camera)."""
        inputs = torch.cat([features, sh_basis(directions, DIRECTION_COEFFICIENTS)], dim=1)
        raw = _applied(self.colour_layers, inputs)
        return raw.sigmoid() if self.bounded else raw.clamp(max=LARGEST_EXPONENT).exp()

    def networks(self) -> list[nn.Parameter]:
        """Return the weights of the networks: the parameters that are not features of the encoding."""
        return [*self.density_layers, *self.colour_layers]


def _random(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Return numbers in 0..1 on the generator's device."""
    return torch.rand(shape, generator=generator, device=generator.device)


def _layers(widths: tuple[int, ...], generator: torch.Generator) -> nn.ParameterList:
    """Return the matrices of a network without biases, Glorot-uniform at the start, as the authors have it."""
    matrices = []
    for inputs, outputs in itertools.pairwise(widths):
        limit = math.sqrt(6 / (inputs + outputs))
        matrices.append(nn.Parameter((2 * _random((inputs, outputs), generator) - 1) * limit))
    return nn.ParameterList(matrices)


def _applied(layers: nn.ParameterList, values: Tensor) -> Tensor:
    for layer in layers[:-1]:
        values = (values @ layer).relu()
    return values @ layers[-1]
