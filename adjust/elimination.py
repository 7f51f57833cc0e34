"""Least squares with bordered blocks: every block's own unknowns are eliminated onto those that blocks share.

The rows of an image, or of a point, touch its own unknowns and some shared ones. An orthogonal (Householder)
factorisation of these rows alone leaves a triangle for its own unknowns and fewer rows in the shared ones; all these
are factorised together. The cost is linear in the number of blocks, and the condition is that of the rows, not its
square as with normal equations (Golub and Van Loan, Matrix Computations, section 5.3; Triggs et al., Bundle
adjustment: a modern synthesis).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dgeqrf, dormqr
from scipy.sparse import csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

LAPACK_BLOCK = 64  # working space for dormqr, in columns
ROWS_PER_COLUMN = 4  # rows in the shared unknowns are condensed when there are more of them than this


@dataclass(frozen=True)
class Block:
    """The rows of one block: matrix (m, own + shared) times the unknowns = right (m,), of unit weight.

    own: numbers of its own unknowns among all; shared: numbers of the others that it touches, among the shared ones.
    """

    own: Indices
    shared: Indices
    matrix: Array
    right: Array


@dataclass(frozen=True)
class BlockFactor:
    """A block's triangle: triangle own + border shared = right."""

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    right: Array


@dataclass(frozen=True)
class Factor:
    """The square root of the normal equations: the blocks' triangles, and that of the shared unknowns (s, s).

    All columns are scaled: the unknowns are those of the rows times `scale` (n,), which makes every column's norm 1.
    The shared unknowns are the first s.
    """

    blocks: tuple[BlockFactor, ...]
    triangle: Array
    right: Array
    scale: Array

    @property
    def shared_count(self) -> int:
        return len(self.right)

    def solution(self) -> Array:
        """The unknowns (n,). Raises numpy.linalg.LinAlgError where a triangle is singular."""
        solution = np.empty(len(self.scale))
        shared = solve_triangular(self.triangle, self.right)
        solution[: self.shared_count] = shared
        for block in self.blocks:
            solution[block.own] = solve_triangular(block.triangle, block.right - block.border @ shared[block.shared])
        return solution / self.scale

    def variances(self) -> Array:
        """The diagonal (n,) of the cofactor matrix."""
        shared = self._shared_root()
        variances = np.empty(len(self.scale))
        variances[: self.shared_count] = (shared**2).sum(axis=1)
        for block in self.blocks:
            own, through = _roots(block, shared)
            variances[block.own] = (own**2).sum(axis=1) + (through**2).sum(axis=1)
        return variances / self.scale**2

    def cofactor_of(self, functions: csr_array) -> Array:
        """The cofactor matrix (k, k) of linear functions (k, n) of the unknowns."""
        columns = (functions / self.scale).tocsc()
        shared = np.asarray(columns[:, : self.shared_count].toarray(), dtype=np.float64)
        used = np.diff(columns.indptr) > 0
        cofactor = np.zeros((len(shared), len(shared)))
        for block in self.blocks:
            if used[block.own].any():
                own = columns[:, block.own].toarray()
                rows = np.flatnonzero(own.any(axis=1))
                root = np.asarray(solve_triangular(block.triangle, own[rows].T, trans="T"), dtype=np.float64)
                cofactor[np.ix_(rows, rows)] += root.T @ root
                shared[np.ix_(rows, block.shared)] -= root.T @ block.border
        through = solve_triangular(self.triangle, shared.T, trans="T")
        return np.asarray(cofactor + through.T @ through)

    def cofactor_times(self, columns: Array) -> Array:
        """The cofactor matrix times columns (n, d)."""
        scaled = columns / self.scale[:, None]
        shared = scaled[: self.shared_count].copy()
        own = []
        for block in self.blocks:
            own.append(solve_triangular(block.triangle, scaled[block.own], trans="T"))
            shared[block.shared] -= block.border.T @ own[-1]
        result = np.empty_like(scaled)
        shared = solve_triangular(self.triangle, solve_triangular(self.triangle, shared, trans="T"))
        result[: self.shared_count] = shared
        for block, root in zip(self.blocks, own, strict=True):
            result[block.own] = solve_triangular(block.triangle, root - block.border @ shared[block.shared])
        return result / self.scale[:, None]

    def row_roots(self, blocks: Sequence[Block]) -> list[Array]:
        """Per block G (m, k), where G G' is the cofactor matrix of the block's adjusted rows, matrix times unknowns."""
        shared = self._shared_root()
        roots = []
        for block, factor in zip(blocks, self.blocks, strict=True):
            own_count = len(block.own)
            own, through = _roots(factor, shared)
            own_rows = block.matrix[:, :own_count] / self.scale[block.own]
            shared_rows = block.matrix[:, own_count:] / self.scale[block.shared]
            roots.append(np.hstack([own_rows @ own, own_rows @ through + shared_rows @ shared[block.shared]]))
        return roots

    def _shared_root(self) -> Array:
        """The inverse (s, s) of the shared triangle."""
        return solve_triangular(self.triangle, np.eye(self.shared_count))


def _roots(block: BlockFactor, shared: Array) -> tuple[Array, Array]:
    """Roots of the own unknowns' cofactor matrix: for shared unknowns held fixed, and what these add."""
    own = solve_triangular(block.triangle, np.eye(len(block.own)))
    return own, -own @ (block.border @ shared[block.shared])


def eliminate(
    blocks: Sequence[Block], count: int, prior_root_weight: Array, prior_right: Array, damping: float = 0.0
) -> Factor:
    """Factorise the blocks and one row an unknown for its prior.

    The prior's row (count,) is prior_root_weight times unknown = prior_right. The shared unknowns are those that no
    block owns, and stand first. A damping holds every scaled unknown where it is (Levenberg and Marquardt).
    """
    shared_count = count - sum(len(block.own) for block in blocks)
    scale = _column_norms(blocks, prior_root_weight)
    priors = _prior_rows(prior_root_weight / scale, prior_right, damping)
    factors = []
    rests = []
    for block in blocks:
        factor, rest = _eliminate_block(block, scale, priors)
        factors.append(factor)
        rests.append((block.shared, rest))
    shared_priors = _rows_of(priors, np.arange(shared_count))
    triangle = _condensed(rests, shared_priors, shared_count)
    return Factor(tuple(factors), triangle[:, :-1], triangle[:, -1], scale)


def _column_norms(blocks: Iterable[Block], prior_root_weight: Array) -> Array:
    squares = prior_root_weight**2
    for block in blocks:
        columns = np.concatenate([block.own, block.shared])
        squares[columns] += (block.matrix**2).sum(axis=0)
    return np.asarray(np.where(squares > 0.0, np.sqrt(squares), 1.0))


def _prior_rows(root_weight: Array, right: Array, damping: float) -> tuple[Array, Array]:
    """One row an unknown that holds its prior's and its damping's together: its coefficient and its right side."""
    together = np.hypot(root_weight, np.sqrt(damping))
    return together, root_weight * right / np.where(together > 0.0, together, 1.0)


def _rows_of(priors: tuple[Array, Array], unknowns: Indices) -> Array:
    """The prior rows (k, k + 1) of some unknowns, the right side behind."""
    root_weight, right = priors
    return np.hstack([np.diag(root_weight[unknowns]), right[unknowns, None]])


def _eliminate_block(block: Block, scale: Array, priors: tuple[Array, Array]) -> tuple[BlockFactor, Array]:
    """The block's triangle, and its remaining rows (k, shared + 1) in the shared unknowns, right side behind."""
    own_count, shared_count = len(block.own), len(block.shared)
    rows = np.zeros((len(block.matrix) + own_count, own_count + shared_count + 1))
    rows[: len(block.matrix), :-1] = block.matrix / scale[np.concatenate([block.own, block.shared])]
    rows[: len(block.matrix), -1] = block.right
    prior_rows = _rows_of(priors, block.own)
    rows[len(block.matrix) :, :own_count] = prior_rows[:, :-1]
    rows[len(block.matrix) :, -1] = prior_rows[:, -1]
    reflected, tau, _, _ = dgeqrf(rows[:, :own_count])
    others = _reflected(reflected, tau, rows[:, own_count:])
    factor = BlockFactor(
        block.own, block.shared, np.triu(reflected[:own_count]), others[:own_count, :-1], others[:own_count, -1]
    )
    rest = others[own_count:]
    return factor, _triangle(rest) if len(rest) > shared_count + 1 else rest


def _reflected(reflectors: Array, tau: Array, columns: Array) -> Array:
    """Q' times columns (m, k), Q as the Householder vectors of dgeqrf."""
    if reflectors.shape[1] == 0:
        return columns
    work = max(1, columns.shape[1]) * LAPACK_BLOCK
    result, _, _ = dormqr("L", "T", reflectors, tau, columns, work)
    return np.asarray(result, dtype=np.float64)


def _condensed(rests: Iterable[tuple[Indices, Array]], shared_priors: Array, shared_count: int) -> Array:
    """The triangle (s, s + 1) of all rows in the shared unknowns, right side behind."""
    pending = [shared_priors]
    height = len(shared_priors)
    for shared, rest in rests:
        rows = np.zeros((len(rest), shared_count + 1))
        rows[:, shared] = rest[:, :-1]
        rows[:, -1] = rest[:, -1]
        pending.append(rows)
        height += len(rows)
        if height > ROWS_PER_COLUMN * (shared_count + 1):
            pending = [_triangle(np.vstack(pending))]
            height = len(pending[0])
    return _triangle(np.vstack(pending))[:shared_count]


def _triangle(rows: Array) -> Array:
    """The factor R (k, n) of a Householder factorisation of rows (m, n), k the smaller of m and n."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
