"""Normal equations of the poses of a pass: blocks for the brackets, what all share, and a surface that moves along.

Eliminating blocks one after another (Schur complement) is what bundle adjustment does; Triggs et al. 2000.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.poses.registration import CellInformation, CellShifts


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations with a block for each bracket and one for what all share; float64, priors included."""

    own: Tensor  # [P, 6, 6]
    mixed: Tensor  # [P, 6, S]
    shared: Tensor  # [S, S]
    own_right: Tensor  # [P, 6]
    shared_right: Tensor  # [S]

    def _reduced(self) -> tuple[Tensor, Tensor]:
        """Return the shared block with the brackets eliminated, and own⁻¹ mixed [P, 6, S]."""
        eliminated = torch.linalg.solve(self.own, self.mixed)
        return self.shared - (self.mixed.mT @ eliminated).sum(0), eliminated

    def solution(self) -> tuple[Tensor, Tensor]:
        """Return the shared parameters [S] and those of the brackets [P, 6]."""
        reduced, eliminated = self._reduced()
        shared = torch.linalg.solve(reduced, self.shared_right - times(eliminated.mT, self.own_right).sum(0))
        return shared, torch.linalg.solve(self.own, self.own_right) - eliminated @ shared

    def covariances(self) -> tuple[Tensor, Tensor]:
        """Return the covariance of the shared parameters [S, S] and those of the brackets [P, 6, 6]."""
        reduced, eliminated = self._reduced()
        shared = torch.linalg.inv(reduced)
        return shared, torch.linalg.inv(self.own) + eliminated @ shared @ eliminated.mT

    def with_cells(
        self,
        cells: list[CellInformation],
        brackets: list[int],
        root: Tensor,
        by_shared: Tensor,
        cell_m: float,
        sigma_m: float,
    ) -> "ReducedEquations":
        """Return the equations that remain when every cell of the surface goes where the pictures want it.

        Without this the model is taken for known, so that what moves the model along seems well determined: a model
        that was fitted to wrong poses confirms them.

        Args:
            cells: of some frames; brackets: [F] of these frames.
            root: [F, 6, 6], motion of a frame by its bracket's parameters; by_shared: [F, 6, S], by the shared ones.
            cell_m: their edge; sigma_m: prior deviation of a cell's shift.
        """
        count, size = len(self.own), 6 * len(self.own)
        numbers, places = torch.unique(torch.cat([c.numbers for c in cells]), return_inverse=True)
        mixed = torch.zeros(len(numbers), 3, size + len(self.shared), dtype=torch.float64)
        curvature = (torch.eye(3, dtype=torch.float64) / sigma_m**2).repeat(len(numbers), 1, 1)
        gradient = torch.zeros(len(numbers), 3, dtype=torch.float64)
        split = places.split([len(c.numbers) for c in cells])
        for at, cell, bracket, by_own, by_all in zip(split, cells, brackets, root, by_shared, strict=True):
            mixed[at, :, 6 * bracket : 6 * bracket + 6] += cell.mixed @ by_own
            mixed[at, :, size:] += cell.mixed @ by_all
            curvature[at] += cell.curvature
            gradient[at] += cell.gradient
        factor = torch.linalg.cholesky(curvature)
        mixed = _forward_substituted(factor, mixed).flatten(0, 1)
        gradient = _forward_substituted(factor, gradient[..., None]).flatten()
        whole = torch.block_diag(*self.own, self.shared)
        whole[:size, size:] = self.mixed.flatten(0, 1)
        whole[size:, :size] = self.mixed.flatten(0, 1).T
        right = torch.cat([self.own_right.flatten(), self.shared_right])
        eliminated = EliminatedCells(numbers, factor, mixed, gradient, cell_m)
        return ReducedEquations(whole - mixed.T @ mixed, right + mixed.T @ gradient, count, eliminated)


@dataclass(frozen=True)
class EliminatedCells:
    """The equations of the surface's cells, by which their shifts follow from all other parameters."""

    numbers: Tensor  # [k], sorted
    factor: Tensor  # [k, 3, 3] L, where L Lᵀ are the second derivatives by the shifts, prior included
    mixed: Tensor  # [3k, 6P + S] L⁻¹ times those by shifts and other parameters
    gradient: Tensor  # [3k] L⁻¹ times the slopes by the shifts
    cell_m: float

    def shifts(self, others: Tensor) -> CellShifts:
        """Return where the cells go when the other parameters change by others [6P + S]."""
        right = -(self.gradient + self.mixed @ others).view(-1, 3, 1)
        shifts = torch.linalg.solve_triangular(self.factor.mT, right, upper=True)[..., 0]
        return CellShifts(self.numbers, shifts, self.cell_m)


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations of all brackets' parameters [P, 6], then the shared ones [S]; float64, priors included."""

    matrix: Tensor  # [6P + S, 6P + S]
    right: Tensor  # [6P + S]
    brackets: int  # P
    cells: EliminatedCells

    def solution(self) -> tuple[Tensor, Tensor]:
        """Return the shared parameters [S] and those of the brackets [P, 6]."""
        found = torch.linalg.solve(self.matrix, self.right)
        return found[6 * self.brackets :], found[: 6 * self.brackets].view(-1, 6)

    def shifts(self, shared: Tensor, own: Tensor) -> CellShifts:
        """Return where the surface's cells go with a solution."""
        return self.cells.shifts(torch.cat([own.flatten(), shared]))

    def covariances(self) -> tuple[Tensor, Tensor]:
        """Return the covariance of the shared parameters [S, S] and those of the brackets [P, 6, 6]."""
        inverse, size = torch.linalg.inv(self.matrix), 6 * self.brackets
        own = inverse[:size, :size].view(self.brackets, 6, self.brackets, 6)
        return inverse[size:, size:], own.diagonal(dim1=0, dim2=2).movedim(-1, 0)


def _forward_substituted(factor: Tensor, right: Tensor) -> Tensor:
    """Return L⁻¹ R for lower triangles L [k, 3, 3] and R [k, 3, m]: all rows of one kind at once.

    `torch.linalg.solve_triangular` calls BLAS for each of the thousands of triangles.
    """
    solved = torch.empty_like(right)
    for row in range(3):
        left = right[:, row]
        for column in range(row):
            left = left - factor[:, row, column, None] * solved[:, column]
        torch.div(left, factor[:, row, row, None], out=solved[:, row])
    return solved


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Return the products [..., n] of matrices [..., n, m] and vectors [..., m]."""
    return (matrices @ vectors[..., None])[..., 0]
