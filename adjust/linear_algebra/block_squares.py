"""Factors of blocks of many more rows than columns by their normal equations, where these are well conditioned.

Rows times columns squared is the cost of a square, and of reflections a multiple of it. A square squares the condition:
with columns of the norm 1 its relative rounding errors, some 1e-16, reach the cofactors times the square of the norm of
the triangle's inverse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from adjust.linear_algebra.factor import BlockFactors, Blocks, DenseBlocks, Factor
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.sparse_factor import Triangle

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Norm of the inverse of triangles up to which squares will do: variances are then right to some 1e-10. No singular
# value of the rows can then be below 1e-6 over the norm of a border, which is about 1.
STEADY = 1e3
TALL = 3  # rows over columns of a block from which on its square is quicker than its reflections


@dataclass(frozen=True)
class Normal:
    """Normal equations of b blocks of equal shape: matrix (b, o + s, o + s) times the unknowns = right (b, o + s)."""

    own: Indices
    shared: Indices
    matrix: Array
    right: Array

    @property
    def squares(self) -> Array:
        """The diagonals (b, o + s)."""
        return np.asarray(np.einsum("bkk->bk", self.matrix))


def is_tall(blocks: Blocks) -> bool:
    """Whether squares are less than the rows; blocks without own unknowns, of some distances say, are few."""
    height, width = blocks.matrix.shape[1:]
    return height >= TALL * width or blocks.own.size == 0


def normal_of(blocks: Blocks) -> Normal:
    transposed = blocks.matrix.swapaxes(1, 2)
    right = (transposed @ blocks.right[..., None])[..., 0]
    return Normal(blocks.own, blocks.shared, transposed @ blocks.matrix, right)


def by_squares(normals: Sequence[Normal], scale: Array, priors: tuple[Array, Array]) -> Factor | None:
    """The factor from normal equations of the blocks; None where a triangle is not well conditioned."""
    count = len(scale) - sum(each.own.size for each in normals)
    root_weight, prior_right = priors
    square, right = np.diag(root_weight[:count] ** 2), (root_weight * prior_right)[:count]
    factors = []
    try:
        for each in normals:
            factors.append(_own_factors(each, scale, priors))
            if _norm_of_inverse(factors[-1].triangle) > STEADY:
                return None
            _reduce(square, right, each, factors[-1], scale)
        root = np.asarray(np.linalg.cholesky(square), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    if _norm_of_inverse(root[None]) > STEADY:
        return None
    triangle = Triangle(Fronts.single(count), (root.T,), (np.zeros((count, 0)),))
    return Factor(DenseBlocks(tuple(factors)), triangle, solve_triangular(root, right, lower=True), scale, steady=True)


def _own_factors(normal: Normal, scale: Array, priors: tuple[Array, Array]) -> BlockFactors:
    count = normal.own.shape[1]
    own_scale, shared_scale = scale[normal.own], scale[normal.shared]
    root_weight, prior_right = (each[normal.own] for each in priors)
    own = normal.matrix[:, :count, :count] / (own_scale[:, :, None] * own_scale[:, None, :])
    own[:, np.arange(count), np.arange(count)] += root_weight**2
    rest = np.empty((len(own), count, normal.shared.shape[1] + 1))
    rest[..., :-1] = normal.matrix[:, :count, count:] / (own_scale[:, :, None] * shared_scale[:, None, :])
    rest[..., -1] = normal.right[:, :count] / own_scale + root_weight * prior_right
    root = np.asarray(np.linalg.cholesky(own), dtype=np.float64)
    rest = np.asarray(np.linalg.solve(root, rest), dtype=np.float64)
    return BlockFactors(normal.own, normal.shared, root.swapaxes(1, 2), rest[..., :-1], rest[..., -1])


def _reduce(square: Array, right: Array, normal: Normal, factor: BlockFactors, scale: Array) -> None:
    """Add what blocks leave in the shared unknowns to these unknowns' normal equations."""
    count, shared_scale = normal.own.shape[1], scale[normal.shared]
    turned = factor.border.swapaxes(1, 2)
    left = normal.matrix[:, count:, count:] / (shared_scale[:, :, None] * shared_scale[:, None, :])
    left -= turned @ factor.border
    of_right = normal.right[:, count:] / shared_scale - (turned @ factor.right[..., None])[..., 0]
    np.add.at(square, (normal.shared[:, :, None], normal.shared[:, None, :]), left)
    np.add.at(right, normal.shared, of_right)


def _norm_of_inverse(triangles: Array) -> float:
    """The largest of triangles (b, o, o), by Frobenius; raises numpy.linalg.LinAlgError where one is singular."""
    inverse = np.linalg.inv(triangles)
    return float(np.sqrt((inverse**2).sum(axis=(1, 2)).max(initial=0.0)))
