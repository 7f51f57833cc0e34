"""The square root of normal equations of bordered blocks, and what follows from it: solution, variances, cofactors."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array

from adjust.array_types import Array, Indices
from adjust.linear_algebra.sparse_factor import Triangle

Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True)
class Blocks:
    """The rows of b blocks of equal shape: matrix (b, m, o + s) times the unknowns = right (b, m), of unit weight.

    own (b, o): numbers of every block's own unknowns among all; shared (b, s): numbers of the others that it touches,
    among the shared ones.
    """

    own: Indices
    shared: Indices
    matrix: Array
    right: Array


@dataclass(frozen=True)
class BlockFactors:
    """Their triangles (b, o, o): triangle own + border (b, o, s) shared = right (b, o)."""

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    right: Array


class Eliminated(Protocol):
    """All blocks, their own unknowns eliminated."""

    @property
    def blocks(self) -> tuple[BlockFactors, ...]:
        """In the order of the blocks, those of equal shape together."""

    def substitute(self, solution: Array) -> None:
        """Put own unknowns into a solution (n,), scaled, whose shared ones are found."""

    def square_sum(self) -> float:
        """Of the right sides."""

    def own_cofactors(self, triangle: Triangle) -> Iterator[tuple[Indices, Array]]:
        """Own unknowns (b, o), -1 for none, and their cofactor matrices (b, o, o), scaled; triangle: of what is shared.

        For shared unknowns held fixed, and what these add.
        """


@dataclass(frozen=True)
class DenseBlocks:
    """Blocks that were eliminated as they stand here."""

    blocks: tuple[BlockFactors, ...]

    def substitute(self, solution: Array) -> None:
        for block in self.blocks:
            through = (block.border @ solution[block.shared][..., None])[..., 0]
            solution[block.own] = np.linalg.solve(block.triangle, (block.right - through)[..., None])[..., 0]

    def square_sum(self) -> float:
        return float(sum((block.right**2).sum() for block in self.blocks))

    def own_cofactors(self, triangle: Triangle) -> Iterator[tuple[Indices, Array]]:
        for block in self.blocks:
            own = np.asarray(np.linalg.inv(block.triangle), dtype=np.float64)
            inner = triangle.through(block.border, block.shared) + np.eye(block.own.shape[1])
            yield block.own, own @ inner @ own.swapaxes(1, 2)


@dataclass(frozen=True)
class ReducedRows:
    """Rows of b blocks as own (b, m, o) times quantities of unit covariance plus through (b, m, s) times the scaled
    shared unknowns (b, s); these quantities are not correlated with each other nor with the shared unknowns.
    """

    own: Array
    shared: Indices
    through: Array


@dataclass(frozen=True)
class Factor:
    """The square root of the normal equations: the blocks' triangles, and that of the s shared unknowns.

    All columns are scaled: the unknowns are those of the rows times `scale` (n,), which makes every column's norm 1.
    The shared unknowns are the first s. steady: the inverses of its triangles are known to be so small that no singular
    value of the rows is near 0.
    """

    eliminated: Eliminated
    triangle: Triangle
    right: Array
    scale: Array
    steady: bool = False

    @property
    def shared_count(self) -> int:
        return len(self.right)

    @property
    def blocks(self) -> tuple[BlockFactors, ...]:
        return self.eliminated.blocks

    @cached_property
    def solution(self) -> Array:
        """The unknowns (n,). Raises numpy.linalg.LinAlgError where a triangle is singular."""
        solution = np.empty(len(self.scale))
        solution[: self.shared_count] = self.triangle.solve(self.right)
        self.eliminated.substitute(solution)
        return solution / self.scale

    def length(self) -> float:
        """Of the solution, in standard deviations: what that function of the unknowns moves which moves most."""
        return float(np.sqrt((self.right**2).sum() + self.eliminated.square_sum()))

    def variances(self) -> Array:
        """The diagonal (n,) of the cofactor matrix."""
        variances = np.empty(len(self.scale) + 1)
        for own, cofactors in self._own_cofactors:
            variances[own] = np.einsum("bii->bi", cofactors)
        variances[: self.shared_count] = self.triangle.variances
        return variances[:-1] / self.scale**2

    def cofactors(self, groups: Indices) -> Array:
        """The cofactor matrices (g, k, k) of groups of unknowns (g, k), each of one block's own or of shared ones."""
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
        """The cofactor matrix (k, k) of linear functions (k, n) of the unknowns."""
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
        """The cofactor matrix times columns (n, d)."""
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
        """The adjusted rows of blocks that own and share what those factorised do, one after the other."""
        for rows, block in zip(blocks, self.blocks, strict=True):
            count = block.own.shape[1]
            matrix = rows.matrix / column_values(self.scale, rows)[:, None, :]
            own = matrix[..., :count] @ np.linalg.inv(block.triangle)
            yield ReducedRows(own, rows.shared, matrix[..., count:] - own @ block.border)

    @cached_property
    def _own_cofactors(self) -> tuple[tuple[Indices, Array], ...]:
        return tuple(self.eliminated.own_cofactors(self.triangle))


def column_values(values: NDArray[Number], blocks: Blocks) -> NDArray[Number]:
    """The values (b, o + s), one an unknown, of what the blocks' columns stand for."""
    return np.concatenate([values[blocks.own], values[blocks.shared]], axis=1)
