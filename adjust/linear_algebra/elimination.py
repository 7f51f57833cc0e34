"""Least squares with bordered blocks: every block's own unknowns are eliminated onto those that blocks share.

The rows of an image, or of a point, touch its own unknowns and some shared ones. An orthogonal (Householder)
factorisation of these rows alone leaves a triangle for its own unknowns and fewer rows in the shared ones; all these
are factorised together. The cost is linear in the number of blocks, and the condition is that of the rows, not its
square as with normal equations (Golub and Van Loan, Matrix Computations, section 5.3; Triggs et al., Bundle
adjustment: a modern synthesis). Blocks of equal shape are factorised together.

Rows that connect what no single block owns are blocks without own unknowns: what they touch must be shared.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from adjust.linear_algebra.block_squares import Normal, by_squares, is_tall, normal_of
from adjust.linear_algebra.factor import BlockFactors, Blocks, Factor, of_columns
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.multifrontal import of_normal_equations, reflected, reflections_cost, triangle_of
from adjust.linear_algebra.normal_equations import Groups, border_square, spread_squares

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CHEAP = 1e8  # rows times columns squared in the shared unknowns up to which these rows are always reflected
REFLECTED = 1e9  # the same, up to which they are wherever their normal equations would cost digits
SAFE = 1e-6  # reciprocal condition of the shared triangle down to which normal equations will do beyond that
TEN_DIGITS = 1e-3  # the same up to that: variances keep them


@dataclass(frozen=True)
class Sums:
    """How the blocks' rows are summed up in the shared unknowns.

    rows: the same rows as blocks without own unknowns, arranged so that all rows of a block touch the same shared ones,
    the columns left out that blocks own. groups: shared unknowns that blocks meet together.
    """

    rows: Iterable[Blocks]
    groups: Groups


def eliminate(
    blocks: Iterable[Blocks],
    count: int,
    prior_root_weight: Array,
    prior_right: Array,
    damping: float = 0.0,
    sums: Sums | None = None,
    sharp: bool = True,
    fronts: Fronts | None = None,
) -> Factor:
    """Factorise the blocks and one row an unknown for its prior.

    The prior's row (count,) is prior_root_weight times unknown = prior_right. The shared unknowns are those that no
    block owns, and stand first. A damping holds every scaled unknown where it is (Levenberg and Marquardt).

    Blocks of many more rows than columns are squared, which is quickest, where all triangles turn out so well
    conditioned (STEADY) that it does not matter. Otherwise they are factorised by reflections, and so are the rows that
    are left in the shared unknowns. Where that would take long, and `sums` tell how, their normal equations are summed
    up and factorised (Cholesky). That squares the condition: of variances the relative error is at most some 1e-16
    times the squared condition, 1e-10 where the condition is 1e3; where it is worse, reflections take their time, but
    for rows of which they would take too much: there 1e6 will do. Not sharp: singular values below 1e-6 need not be
    told from that.

    fronts: of the shared unknowns, which stand in their order; a single one if they are not told.
    """
    squares, shared_count = prior_root_weight**2, count
    heights = []
    normals: list[Normal] | None = []
    for block in blocks:
        normals = None if normals is None or not is_tall(block) else [*normals, normal_of(block)]
        of_block = normals[-1].squares if normals else _column_squares(block)
        squares += np.bincount(of_columns(np.arange(count), block).ravel(), of_block.ravel(), count)
        shared_count -= block.own.size
        if block.shared.size:
            heights.append((block.shared, min(block.right.shape[1], block.shared.shape[1] + 1)))
    fronts = fronts or Fronts.single(shared_count)
    scale = np.where(squares > 0.0, np.sqrt(squares), 1.0)
    priors = _prior_rows(prior_root_weight / scale, prior_right, damping)
    if normals and len(fronts) == 1:
        factor = by_squares(normals, scale, priors, fronts)
        if factor is not None:
            return factor
    cost = reflections_cost(fronts, heights)
    if sums is not None and cost > (CHEAP if sharp else REFLECTED):
        lift = 0.0 if sharp else SAFE**2
        factor = _by_normal_equations(blocks, sums, scale, priors, fronts, lift)
        if factor is not None and (
            not sharp or factor.triangle.reciprocal_condition > (SAFE if cost > REFLECTED else TEN_DIGITS)
        ):
            return factor
    factors = []
    rests = []
    for block in blocks:
        eliminated, rest = _eliminate_blocks(block, scale, priors)
        factors.append(eliminated)
        rests.append((block.shared, rest))
    triangle, right = reflected(fronts, rests, *(prior[:shared_count] for prior in priors))
    return Factor(tuple(factors), triangle, right, scale)


def _column_squares(blocks: Blocks) -> Array:
    """The sums (b, o + s) of the squares in every column."""
    return np.asarray(np.einsum("bmk,bmk->bk", blocks.matrix, blocks.matrix))


def _prior_rows(root_weight: Array, right: Array, damping: float) -> tuple[Array, Array]:
    """One row an unknown that holds its prior's and its damping's together: its coefficient and its right side."""
    together = np.hypot(root_weight, np.sqrt(damping))
    return together, root_weight * right / np.where(together > 0.0, together, 1.0)


def _rows_of(priors: tuple[Array, Array], unknowns: Indices) -> Array:
    """The prior rows (..., k, k + 1) of some unknowns (..., k), the right side behind."""
    root_weight, right = priors
    rows = root_weight[unknowns][..., None] * np.eye(unknowns.shape[-1])
    return np.concatenate([rows, right[unknowns][..., None]], axis=-1)


def _eliminate_blocks(blocks: Blocks, scale: Array, priors: tuple[Array, Array]) -> tuple[BlockFactors, Array]:
    """The blocks' triangles, and their remaining rows (b, k, s + 1) in the shared unknowns, right side behind."""
    (count, height, width), own_count = blocks.matrix.shape, blocks.own.shape[1]
    rows = np.zeros((count, height + own_count, width + 1))
    np.divide(blocks.matrix, of_columns(scale, blocks)[:, None, :], out=rows[:, :height, :-1])
    rows[:, :height, -1] = blocks.right
    prior_rows = _rows_of(priors, blocks.own)
    rows[:, height:, :own_count] = prior_rows[..., :-1]
    rows[:, height:, -1] = prior_rows[..., -1]
    triangle = triangle_of(rows)
    own = triangle[:, :own_count]
    factor = BlockFactors(blocks.own, blocks.shared, own[..., :own_count], own[..., own_count:-1], own[..., -1])
    return factor, triangle[:, own_count:, own_count:]


def _by_normal_equations(
    blocks: Iterable[Blocks],
    sums: Sums,
    scale: Array,
    priors: tuple[Array, Array],
    fronts: Fronts,
    lift: float,
) -> Factor | None:
    """None where the normal equations of the shared unknowns are not positive definite."""
    root_weight, prior_right = (prior[: fronts.count] for prior in priors)
    normal = csr_array(diags_array(root_weight**2 + lift))
    right = root_weight * prior_right
    for rows in sums.rows:
        matrix = rows.matrix / scale[rows.shared][:, None, :]
        normal = normal + spread_squares(rows.shared, matrix.swapaxes(1, 2) @ matrix, fronts.count)
        np.add.at(right, rows.shared, (matrix.swapaxes(1, 2) @ rows.right[..., None])[..., 0])
    factors = [_own_triangles(block, scale, priors) for block in blocks]
    normal = normal - border_square(
        sums.groups, ((factor.shared, factor.border) for factor in factors if factor.own.size)
    )
    for factor in factors:
        np.subtract.at(right, factor.shared, (factor.border.swapaxes(1, 2) @ factor.right[..., None])[..., 0])
    try:
        triangle, right = of_normal_equations(fronts, normal, right)
    except np.linalg.LinAlgError:
        return None
    return Factor(tuple(factors), triangle, right, scale)


def _own_triangles(blocks: Blocks, scale: Array, priors: tuple[Array, Array]) -> BlockFactors:
    """The blocks' triangles, without what remains in the shared unknowns."""
    own_count = blocks.own.shape[1]
    matrix = blocks.matrix / of_columns(scale, blocks)[:, None, :]
    prior_rows = _rows_of(priors, blocks.own)
    own = np.concatenate([matrix[..., :own_count], prior_rows[..., :-1]], axis=1)
    orthonormal, triangle = np.linalg.qr(own)
    turned = orthonormal.swapaxes(1, 2)
    height = matrix.shape[1]
    right = turned[..., :height] @ blocks.right[..., None] + turned[..., height:] @ prior_rows[..., -1:]
    border = turned[..., :height] @ matrix[..., own_count:]
    return BlockFactors(blocks.own, blocks.shared, triangle, border, right[..., 0])
