"""Block elimination in bordered least-squares problems: each block's own unknowns are reduced onto the shared ones.

The observations of an image, or of a point, depend on its own unknowns and on some shared ones. An orthogonal
(Householder) factorisation of these rows gives a triangle for the own unknowns and fewer rows in the shared ones; the
remaining rows of all blocks are factorised together. The cost is linear in the number of blocks, and the condition
number is that of the design matrix, not its square as with normal equations (Golub and Van Loan, Matrix Computations,
section 5.3; Triggs et al., Bundle adjustment: a modern synthesis). Blocks of equal shape are factorised together.

Observations that no single block contains form blocks without own unknowns: all their unknowns must be shared.
"""

from collections.abc import Iterable

import numpy as np

from adjust.array_types import Array
from adjust.linear_algebra.factor import BlockFactors, Blocks, DenseBlocks, Factor, column_values
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.schur_complement import eliminated
from adjust.linear_algebra.sparse_factor import (
    TEN_DIGITS,
    factorise_normal_equations,
    qr_triangle,
    reflected,
    reflections_cost,
)
from adjust.linear_algebra.sparse_rows import SharedEquations, SparseRows

CHEAP = 1e7  # rows times columns squared of the shared unknowns, up to which Householder QR is always used
REFLECTED = 1e9  # the same, up to which it is used where normal equations would lose digits
SAFE = 1e-6  # reciprocal condition of the shared triangle down to which normal equations suffice beyond that
STEADY = 1e3  # norm of the triangles' inverses up to which no singular value of the design matrix is near 0


def eliminate(
    blocks: Iterable[Blocks],
    count: int,
    prior_root_weight: Array,
    prior_right: Array,
    damping: float = 0.0,
    sparse: SparseRows | None = None,
    sharp: bool = True,
    fronts: Fronts | None = None,
) -> Factor:
    """Factorise the observation equations of all blocks together with the priors.

    Parameters
    ----------
    blocks : observation equations; the unknowns that no block owns are shared, and are numbered first.
    count : number of unknowns n.
    prior_root_weight, prior_right : (n,) pseudo-observations: prior_root_weight times unknown = prior_right.
    damping : added to the normal equations of the scaled unknowns (Levenberg and Marquardt).
    sparse : the same equations in sparse form.
    sharp : False: singular values below 1e-6 need not be distinguished from 1e-6.
    fronts : fronts of the shared unknowns, which are numbered in elimination order; default a single front.

    Notes
    -----
    Large problems with `sparse` equations avoid Householder QR. Their own unknowns are eliminated by Gram-Schmidt
    orthonormalisation, and the reduced normal equations of the shared unknowns are factorised (Cholesky). This squares
    the condition number: the relative error of variances is at most about 1e-16 times the squared condition, 1e-10 for
    a condition of 1e3. Worse conditioned problems are factorised by Householder QR; those too large for that are
    accepted up to a condition of 1e6.
    """
    cost = reflections_cost(fronts, *sparse.pattern.left_over) if sparse is not None and fronts is not None else 0.0
    is_large = sparse is not None and cost > (CHEAP if sharp else REFLECTED)
    blocks = blocks if is_large else list(blocks)  # laid out once
    equations = sparse.equations(fronts) if sparse is not None and fronts is not None and is_large else None
    if sparse is not None and equations is not None:
        squares = sparse.column_squares(count, equations)
    else:
        squares = _column_squares(blocks, count)
    squares += prior_root_weight**2
    scale = np.where(squares > 0.0, np.sqrt(squares), 1.0)
    # Combine prior and damping of each unknown in one row: coefficient and right side.
    together = np.hypot(prior_root_weight / scale, np.sqrt(damping))
    priors = together, prior_root_weight / scale * prior_right / np.where(together > 0.0, together, 1.0)
    if sparse is not None and equations is not None:
        factor = _eliminate_normally(sparse, scale, priors, equations, 0.0 if sharp else SAFE)
        least = SAFE if cost > REFLECTED else TEN_DIGITS
        if factor is not None and (not sharp or factor.triangle.reciprocal_condition > least):
            return factor
    return _reflect_all(blocks, scale, priors, fronts)


def _column_squares(blocks: Iterable[Blocks], count: int) -> Array:
    """Sums of squares (n,) of the columns."""
    squares = np.zeros(count)
    for block in blocks:
        of_block = np.einsum("bmk,bmk->bk", block.matrix, block.matrix)
        squares += np.bincount(column_values(np.arange(count), block).ravel(), of_block.ravel(), count)
    return squares


def _reflect_all(blocks: Iterable[Blocks], scale: Array, priors: tuple[Array, Array], fronts: Fronts | None) -> Factor:
    factors = []
    rests = []
    for block in blocks:
        factor, rest = _eliminate_blocks(block, scale, priors)
        factors.append(factor)
        rests.append((block.shared, rest))
    fronts = fronts or Fronts.single(len(scale) - sum(block.own.size for block in factors))
    triangle, right = reflected(fronts, rests, *(prior[: fronts.count] for prior in priors))
    return Factor(DenseBlocks(tuple(factors)), triangle, right, scale)


def _eliminate_blocks(blocks: Blocks, scale: Array, priors: tuple[Array, Array]) -> tuple[BlockFactors, Array]:
    """Triangles of blocks, and their remaining rows (b, k, s + 1) in the shared unknowns, the right side last."""
    (count, height, width), own_count = blocks.matrix.shape, blocks.own.shape[1]
    rows = np.zeros((count, height + own_count, width + 1))
    np.divide(blocks.matrix, column_values(scale, blocks)[:, None, :], out=rows[:, :height, :-1])
    rows[:, :height, -1] = blocks.right
    rows[:, height:, :own_count] = priors[0][blocks.own][..., None] * np.eye(own_count)
    rows[:, height:, -1] = priors[1][blocks.own]
    triangle = qr_triangle(rows)
    own = triangle[:, :own_count]
    factor = BlockFactors(blocks.own, blocks.shared, own[..., :own_count], own[..., own_count:-1], own[..., -1])
    return factor, triangle[:, own_count:, own_count:]


def _eliminate_normally(
    rows: SparseRows, scale: Array, priors: tuple[Array, Array], equations: SharedEquations, lift: float
) -> Factor | None:
    """Factorise with reduced normal equations of the shared unknowns; None if these are not positive definite."""
    # lift: its square is added to the diagonal of the scaled normal equations.
    fronts, squares = equations.fronts, equations.squares
    root_weight, prior_right = (prior[: fronts.count] for prior in priors)
    blocks = eliminated(rows, *priors, scale, equations)
    over = 1.0 / scale[: fronts.count]
    for front, square in zip(fronts, squares, strict=True):
        square *= over[front.columns]
        square *= over[front.columns, None]
        square[range(front.count), range(front.count)] += root_weight[front.own] ** 2 + lift**2
    right = over * equations.right + root_weight * prior_right
    try:
        triangle, right = factorise_normal_equations(fronts, squares, right)
    except np.linalg.LinAlgError:
        return None
    steady = lift == 0.0 and triangle.reciprocal_condition > TEN_DIGITS and blocks.norm_of_inverse() <= STEADY
    return Factor(blocks, triangle, right, scale, steady)
