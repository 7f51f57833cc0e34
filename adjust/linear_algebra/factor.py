"""Square root of the normal equations of bordered blocks: solution, variances, cofactors."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array

from adjust.array_types import Array, Indices
from adjust.linear_algebra.sparse_factor import TEN_DIGITS, Triangle

Number = TypeVar("Number", bound=np.generic)

STEADY = 1e3  # norm of the triangles' inverses up to which no singular value of the design matrix is near 0


@dataclass(frozen=True)
class Blocks:
    """Observation equations of unit weight of b blocks of equal shape."""

    own: Indices  # (b, o) numbers of each block's own unknowns
    shared: Indices  # (b, s) numbers of the shared unknowns that it involves
    matrix: Array  # (b, m, o + s) design matrices
    right: Array  # (b, m) right sides


@dataclass(frozen=True)
class BlockFactors:
    """Eliminated blocks: triangle (b, o, o) own + border (b, o, s) shared = right (b, o)."""

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    right: Array


class Eliminated(Protocol):
    """All blocks after elimination of their own unknowns."""

    @property
    def blocks(self) -> tuple[BlockFactors, ...]:
        """Factors in the order of the blocks, those of equal shape together."""

    def substitute(self, solution: Array) -> None:
        """Compute the own unknowns by back substitution in a scaled solution (n,) with the shared ones solved."""

    def square_sum(self) -> float:
        """Sum of the squared right sides."""

    def norm_of_inverse(self) -> float:
        """Largest Frobenius norm of the scaled triangles' inverses; inf if one is singular."""

    def own_cofactors(self, triangle: Triangle) -> Iterator[tuple[Indices, Array]]:
        """Own unknowns (b, o), -1 for none, and their scaled cofactor matrices (b, o, o).

        The sum of those with the shared unknowns fixed and of the contribution of the shared unknowns, whose factor is
        triangle.
        """


@dataclass(frozen=True)
class DenseBlocks:
    """Eliminated blocks in dense form."""

    blocks: tuple[BlockFactors, ...]

    def substitute(self, solution: Array) -> None:
        for block in self.blocks:
            through = (block.border @ solution[block.shared][..., None])[..., 0]
            solution[block.own] = np.linalg.solve(block.triangle, (block.right - through)[..., None])[..., 0]

    def square_sum(self) -> float:
        return float(sum((block.right**2).sum() for block in self.blocks))

    def norm_of_inverse(self) -> float:
        if not all(np.einsum("bii->bi", block.triangle).all() for block in self.blocks):
            return np.inf
        norms = [np.linalg.norm(own, axis=(1, 2)).max(initial=0.0) for own in self._inverses]
        return float(max(norms, default=0.0))

    @cached_property
    def _inverses(self) -> list[Array]:
        """Inverses (b, o, o) of the triangles."""
        return [np.asarray(np.linalg.inv(block.triangle), dtype=np.float64) for block in self.blocks]

    def own_cofactors(self, triangle: Triangle) -> Iterator[tuple[Indices, Array]]:
        for block, own in zip(self.blocks, self._inverses, strict=True):
            inner = triangle.through(block.border, block.shared) + np.eye(block.own.shape[1])
            yield block.own, own @ inner @ own.swapaxes(1, 2)


@dataclass(frozen=True)
class ReducedRows:
    """Rows of b blocks in terms of uncorrelated quantities.

    Each is own (b, m, o) times quantities of unit covariance, which are not correlated with the shared unknowns, plus
    through (b, m, s) times the scaled shared unknowns, with numbers shared (b, s).
    """

    own: Array
    shared: Indices
    through: Array


@dataclass(frozen=True)
class Factor:
    """Square root of the normal equations: the triangles of the blocks, and that of the s shared unknowns."""

    eliminated: Eliminated  # blocks, with their own unknowns eliminated
    # triangle, right: factor and right side (s,) of the shared unknowns, which are the first s
    triangle: Triangle
    right: Array
    scale: Array  # (n,) norms of the columns, priors included; the scaled unknowns are the unknowns times scale
    lift: float = 0.0  # its square was added to the diagonal of the scaled normal equations of the shared unknowns

    @cached_property
    def is_steady(self) -> bool:
        """Whether the triangles' inverses are small, so that no singular value of the design matrix is near 0."""
        # Columns have a norm of 1: a lone shared unknown that the blocks take up has a condition of 1, and no length.
        if self.lift or self.triangle.smallest_singular <= TEN_DIGITS:
            return False
        return self.eliminated.norm_of_inverse() <= STEADY

    @property
    def shared_count(self) -> int:
        return len(self.right)

    @property
    def blocks(self) -> tuple[BlockFactors, ...]:
        return self.eliminated.blocks

    @cached_property
    def solution(self) -> Array:
        """Solution (n,). Raises numpy.linalg.LinAlgError if a triangle is singular."""
        solution = np.empty(len(self.scale))
        solution[: self.shared_count] = self.triangle.solve(self.right)
        self.eliminated.substitute(solution)
        return solution / self.scale

    def length(self) -> float:
        """Length of the solution in standard deviations: the largest change of any function of the unknowns."""
        return float(np.sqrt((self.right**2).sum() + self.eliminated.square_sum()))

    def variances(self) -> Array:
        """Diagonal (n,) of the cofactor matrix."""
        variances = np.empty(len(self.scale) + 1)
        for own, cofactors in self._own_cofactors:
            variances[own] = np.einsum("bii->bi", cofactors)
        variances[: self.shared_count] = self.triangle.variances
        return variances[:-1] / self.scale**2

    def cofactors(self, groups: Indices) -> Array:
        """Cofactor matrices (g, k, k) of groups (g, k) of unknowns, each all own of one block or all shared."""
        cofactors = np.empty((*groups.shape, groups.shape[1]))
        shared = groups[:, 0] < self.shared_count
        cofactors[shared] = self.triangle.group_cofactors(groups[shared])
        place = np.full(len(self.scale) + 1, -1, dtype=np.intp)
        for own, of_own in self._own_cofactors:
            place[own] = np.arange(own.size).reshape(own.shape)
            place[-1] = -1
            members = np.flatnonzero(place[groups[:, 0]] >= 0)
            if len(members):
                block, at = np.divmod(place[groups[members]], own.shape[1])
                cofactors[members] = of_own[block[:, :, None], at[:, :, None], at[:, None, :]]
            place[own] = -1
        scale = self.scale[groups]
        return cofactors / (scale[:, :, None] * scale[:, None, :])

    def function_cofactor(self, functions: csr_array) -> Array:
        """Cofactor matrix (k, k) of linear functions (k, n) of the unknowns."""
        columns = (functions / self.scale).tocsc()
        shared = np.asarray(columns[:, : self.shared_count].toarray(), dtype=np.float64)
        used = np.diff(columns.indptr) > 0
        cofactor = np.zeros((len(shared), len(shared)))
        for block in self.blocks if used[self.shared_count :].any() else ():
            for i in np.flatnonzero(used[block.own].any(axis=1)):
                own = columns[:, block.own[i]].toarray()
                rows = np.flatnonzero(own.any(axis=1))
                root = np.asarray(solve_triangular(block.triangle[i], own[rows].T, trans="T"), dtype=np.float64)
                cofactor[np.ix_(rows, rows)] += root.T @ root
                shared[np.ix_(rows, block.shared[i])] -= root.T @ block.border[i]
        through = self.triangle.solve_transposed(shared.T)
        return np.asarray(cofactor + through.T @ through)

    def cofactor_times(self, columns: Array) -> Array:
        """Product of the cofactor matrix with columns (n, d)."""
        scaled = columns / self.scale[:, None]
        shared = scaled[: self.shared_count].copy()
        own = []
        for block in self.blocks:
            own.append(np.linalg.solve(block.triangle.transpose(0, 2, 1), scaled[block.own]))
            np.subtract.at(shared, block.shared, block.border.transpose(0, 2, 1) @ own[-1])
        result = np.empty_like(scaled)
        shared = self.triangle.cofactor_times(shared)
        result[: self.shared_count] = shared
        for block, root in zip(self.blocks, own, strict=True):
            result[block.own] = np.linalg.solve(block.triangle, root - block.border @ shared[block.shared])
        return result / self.scale[:, None]

    def reduced_rows(self, blocks: Iterable[Blocks]) -> Iterator["ReducedRows"]:
        """Reduce rows of blocks with the same own and shared unknowns as the factorised blocks, in the same order."""
        for rows, block in zip(blocks, self.blocks, strict=True):
            count = block.own.shape[1]
            matrix = rows.matrix / column_values(self.scale, rows)[:, None, :]
            own = matrix[..., :count] @ np.linalg.inv(block.triangle)
            yield ReducedRows(own, rows.shared, matrix[..., count:] - own @ block.border)

    @cached_property
    def _own_cofactors(self) -> tuple[tuple[Indices, Array], ...]:
        return tuple(self.eliminated.own_cofactors(self.triangle))


def column_values(values: NDArray[Number], blocks: Blocks) -> NDArray[Number]:
    """Values (b, o + s) of the unknowns in the blocks' columns."""
    return np.concatenate([values[blocks.own], values[blocks.shared]], axis=1)
