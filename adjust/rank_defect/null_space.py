"""Changes of the unknowns that the rows of an adjustment do not see, or hardly: the null space of its factor."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import Factor
from adjust.linear_algebra.multifrontal import append_rows
from adjust.linear_algebra.sparse_factor import Triangle

SINGULAR = 1e-8  # singular values of the scaled rows, over the largest, below which there is no solution
DENSE = 100  # shared unknowns up to which all singular values are computed
FIRST_COUNT = 24  # vectors that are iterated at a time where there are more
ITERATIONS = 50
STANDSTILL = 1e-3  # change of small singular values that is none, in parts of what counts as small
ROUNDING = 1e-14  # what rounding adds to a singular value, in parts of the largest


@dataclass(frozen=True)
class BlindBlock:
    """A block whose own unknowns have null vectors of their own, which the shared unknowns have no part in.

    own (o,), shared (s,), triangle (o, o), border (o, s): as in its factor. left, right (o, d): the triangle's null
    vectors.
    """

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    left: Array
    right: Array


def blind_blocks(factor: Factor) -> list[BlindBlock]:
    """The blocks that do not determine their own unknowns, in the order of these."""
    found = []
    for blocks in factor.blocks:
        left, singular, right = np.linalg.svd(blocks.triangle)
        null = singular <= SINGULAR * singular.max(axis=1, initial=0.0, keepdims=True)
        for i in np.flatnonzero(null.any(axis=1)):
            of_null = left[i][:, null[i]], right[i][null[i]].T
            found.append(BlindBlock(blocks.own[i], blocks.shared[i], blocks.triangle[i], blocks.border[i], *of_null))
    return sorted(found, key=lambda block: int(block.own[0]))


def null_vectors(factor: Factor) -> Array:
    """Orthonormal vectors (n, d) of the scaled unknowns that no row sees."""
    blind = blind_blocks(factor)
    within = []
    for block in blind:
        vectors = np.zeros((len(factor.scale), block.right.shape[1]))
        vectors[block.own] = block.right
        within.append(vectors)
    return np.linalg.qr(np.hstack([*within, null_space(factor, blind, SINGULAR)[0]]))[0]


def null_space(factor: Factor, blind: Sequence[BlindBlock], below: float) -> tuple[Array, Array]:
    """Orthonormal vectors (n, d) of all scaled unknowns that are hardly seen, and how much they are seen (d,).

    These are the vectors whose singular values are below a part of the largest of all. They involve the shared unknowns
    and what follows these in the blocks; null vectors within blocks are not among them.
    """
    count = factor.shared_count
    if count == 0:
        return np.zeros((len(factor.scale), 0)), np.zeros(0)
    # Of blocks with null vectors of their own the rows that these leave over count as well.
    rows = [(block.shared, block.left.T @ block.border) for block in blind]
    singular, shared = _smallest(append_rows(factor.triangle, rows) if rows else factor.triangle, below)
    vectors = np.zeros((len(factor.scale), len(singular)))
    vectors[:count] = shared
    first_of_blind = [block.own[0] for block in blind]
    for blocks in factor.blocks:
        seeing = ~np.isin(blocks.own[:, :1], first_of_blind).any(axis=1)
        moved = blocks.border[seeing] @ shared[blocks.shared[seeing]]
        vectors[blocks.own[seeing]] = -np.linalg.solve(blocks.triangle[seeing], moved)
    for block in blind:
        vectors[block.own] = -np.linalg.pinv(block.triangle, rcond=SINGULAR) @ block.border @ shared[block.shared]
    return np.linalg.qr(vectors)[0], singular / np.linalg.norm(vectors, axis=0)


def _smallest(triangle: Triangle, below: float) -> tuple[Array, Array]:
    """The singular values (d,) of a triangle below a part of the largest, and their right vectors (s, d)."""
    if len(triangle) <= DENSE:
        _, singular, right = np.linalg.svd(triangle.toarray())
        hardly = singular <= max(below * singular[0], ROUNDING)  # of all columns of length one the largest is 1 or more
        return singular[hardly], right[hardly].T
    largest = triangle.largest_singular
    count = FIRST_COUNT
    while True:
        singular, vectors = _inverse_iteration(triangle.lifted(ROUNDING * largest), count, below * largest)
        hardly = singular <= below * largest
        if not hardly.all() or count == len(triangle):
            return singular[hardly], vectors[:, hardly]
        count = min(2 * count, len(triangle))


def _inverse_iteration(triangle: Triangle, count: int, limit: float) -> tuple[Array, Array]:
    """The smallest singular values (count,) and right vectors (s, count) by orthogonal iteration with the inverse.

    Those above the limit need not have converged; nor any where all are below it, so that there are more. Source: Golub
    and Van Loan, Matrix Computations, section 8.2.
    """
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(len(triangle), count)))[0]
    before = np.full(count, np.inf)
    for _ in range(ITERATIONS):
        half = np.linalg.qr(triangle.solve_transposed(vectors))[0]
        vectors = np.linalg.qr(triangle.solve(half))[0]
        _, singular, right = np.linalg.svd(triangle.times(vectors), full_matrices=False)
        vectors, singular = vectors @ right[::-1].T, singular[::-1]
        small = singular <= limit  # no singular value is larger than what is found for it in these vectors
        if small.all() or (np.abs(before - singular)[small] <= STANDSTILL * limit).all():
            break
        before = singular
    return singular, vectors
