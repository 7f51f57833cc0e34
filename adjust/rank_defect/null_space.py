"""Null space of an adjustment's factor: changes of the unknowns that the observations do not, or hardly, determine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import Factor
from adjust.linear_algebra.sparse_factor import Triangle, append_rows

SINGULAR = 1e-8  # relative singular value of the scaled rows below which the system is singular
DENSE = 100  # shared unknowns up to which a dense SVD is used
FIRST_COUNT = 24  # vectors of the first inverse iteration where there are more
ITERATIONS = 50
STANDSTILL = 1e-3  # change of small singular values at convergence, relative to the limit
ROUNDING = 1e-14  # rounding error of a singular value, relative to the largest


@dataclass(frozen=True)
class BlindBlock:
    """Block with null vectors within its own unknowns, independent of the shared ones.

    own (o,), shared (s,), triangle (o, o), border (o, s): as in the factor. left, right (o, d): null vectors of the
    triangle.
    """

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    left: Array
    right: Array


def blind_blocks(factor: Factor) -> list[BlindBlock]:
    """Find the blocks with a singular triangle, sorted by their unknowns."""
    found = []
    for blocks in factor.blocks:
        singular = np.linalg.svd(blocks.triangle, compute_uv=False)
        null = singular <= SINGULAR * singular.max(axis=1, initial=0.0, keepdims=True)
        for i in np.flatnonzero(null.any(axis=1)):
            left, _, right = np.linalg.svd(blocks.triangle[i])
            of_null = left[:, null[i]], right[null[i]].T
            found.append(BlindBlock(blocks.own[i], blocks.shared[i], blocks.triangle[i], blocks.border[i], *of_null))
    return sorted(found, key=lambda block: int(block.own[0]))


def null_vectors(factor: Factor) -> Array:
    """Orthonormal null vectors (n, d) of the scaled unknowns."""
    blind = blind_blocks(factor)
    within = []
    for block in blind:
        vectors = np.zeros((len(factor.scale), block.right.shape[1]))
        vectors[block.own] = block.right
        within.append(vectors)
    return np.linalg.qr(np.hstack([*within, null_space(factor, blind, SINGULAR)[0]]))[0]


def null_space(factor: Factor, blind: Sequence[BlindBlock], below: float) -> tuple[Array, Array]:
    """Orthonormal vectors (n, d) of the scaled unknowns with small singular values, and these values (d,).

    below: limit relative to the largest singular value. The vectors involve the shared unknowns and the unknowns of
    blocks that follow them; null vectors within blocks are not included.
    """
    count = factor.shared_count
    if count == 0:
        return np.zeros((len(factor.scale), 0)), np.zeros(0)
    # Blocks with null vectors of their own leave rows for the shared unknowns.
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
    """Small singular values (d,) of a triangle, relative to the largest, and their right vectors (s, d)."""
    if len(triangle) <= DENSE:
        _, singular, right = np.linalg.svd(triangle.toarray())
        hardly = singular <= max(below * singular[0], ROUNDING)  # the largest is at least 1: columns have length 1
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
    """Smallest singular values (count,) and right vectors (s, count) by inverse orthogonal iteration."""
    # Values above the limit need not have converged, and none if all are below it, since more vectors are then needed.
    # Source: Golub and Van Loan, Matrix Computations, section 8.2.
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(len(triangle), count)))[0]
    before = np.full(count, np.inf)
    for _ in range(ITERATIONS):
        half = np.linalg.qr(triangle.solve_transposed(vectors))[0]
        vectors = np.linalg.qr(triangle.solve(half))[0]
        _, singular, right = np.linalg.svd(triangle.times(vectors), full_matrices=False)
        vectors, singular = vectors @ right[::-1].T, singular[::-1]
        small = singular <= limit  # Ritz values are upper bounds of the singular values
        if small.all() or (np.abs(before - singular)[small] <= STANDSTILL * limit).all():
            break
        before = singular
    return singular, vectors
