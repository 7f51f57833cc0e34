"""Vectorised arithmetic of many small matrices, for example of all marks.

The shapes are (n, 2), (n, 2, 2), (n, 2, k) as usual, but in memory the n values of each element are contiguous: an
operation on an element is one pass over contiguous numbers. A loop over matrices would take longer for its overhead
than for its arithmetic. All functions accept complex arrays, and arrays in any memory layout, only more slowly.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import DTypeLike

from adjust.array_types import Array, Indices, Mask

NEWTON_STEPS = 30


def zeros(count: int, *shape: int, dtype: DTypeLike = np.float64) -> Array:
    """Zeros (count, *shape) in this layout."""
    return _members_first(np.zeros((*shape, count), dtype=dtype))


def vectors(*elements: Array) -> Array:
    """Vectors (n, k) from k elements (n,)."""
    return np.stack(elements).T


def matrices(*rows: Sequence[Array]) -> Array:
    """Matrices (n, i, k) from i rows of k elements (n,) each."""
    stacked = np.stack([element for row in rows for element in row])
    return _members_first(stacked.reshape(len(rows), len(rows[0]), stacked.shape[1]))


def columns(members: Sequence[Array]) -> Array:
    """Matrices (n, i, k) from k columns (n, i)."""
    return np.stack([member.T for member in members]).T


def laid_out(array: Array) -> Array:
    """Copy an array (n, ...) into the memory layout of this module."""
    return _members_first(np.ascontiguousarray(_members_last(array)))


def take_members(array: Array, numbers: Indices) -> Array:
    """Members (n, ...) of an array (m, ...) by their numbers (n,)."""
    return _members_first(np.take(_members_last(array), numbers, axis=-1))


def _members_first(array: Array) -> Array:
    """View (..., n) as (n, ...); `numpy.moveaxis` takes longer than the arithmetic of few members."""
    return array.transpose(-1, *range(array.ndim - 1))


def _members_last(array: Array) -> Array:
    """View (n, ...) as (..., n)."""
    return array.transpose(*range(1, array.ndim), 0)


def product(left: Array, right: Array) -> Array:
    """Products (..., i, k) of matrices (..., i, j) and (..., j, k)."""
    total = left[..., :, 0, None] * right[..., None, 0, :]
    for j in range(1, left.shape[-1]):
        total += left[..., :, j, None] * right[..., None, j, :]
    return np.asarray(total)


def applied(matrix: Array, vector: Array) -> Array:
    """Products (..., i) of matrices (..., i, j) and vectors (..., j)."""
    return product(matrix, vector[..., None])[..., 0]


def cross(left: Array, right: Array) -> Array:
    """Cross products left x right (n, k, 3) of vectors (n, k, 3); k of one of them may be 1."""
    (a, b, c), (u, v, w) = left.T, right.T
    return np.stack((b * w - c * v, c * u - a * w, a * v - b * u)).T


def determinant(matrix: Array) -> Array:
    """Determinants (...) of 2x2 matrices."""
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])


def solve_pairs(matrix: Array, right: Array, regular: Mask, det: Array) -> Array:
    """Solve 2x2 systems with known determinants det (n,); the result is meaningless where not regular."""
    divisor = np.where(regular, det, 1.0)
    x, y = right[..., 0], right[..., 1]
    first = (matrix[..., 1, 1] * x - matrix[..., 0, 1] * y) / divisor
    second = (matrix[..., 0, 0] * y - matrix[..., 1, 0] * x) / divisor
    return vectors(first, second)


def newton(
    start: Array, misclosure: Callable[[Array], tuple[Array, Array]], tolerance: Callable[[Array], Array | float]
) -> tuple[Array, Mask]:
    """Solve n pairs of equations by Newton's method; returns the unknowns (n, 2) and the mask of those found.

    misclosure: values (n, 2) and derivatives (n, 2, 2) at unknowns (n, 2). A solution is found where the last step is
    within the tolerance and the determinant of the derivatives is positive, so that the image is not folded over.
    """
    xy, found = start, np.zeros(len(start), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(NEWTON_STEPS):
            value, gradient = misclosure(xy)
            side = determinant(gradient)
            regular = np.isfinite(side) & (side > 0.0)
            step = solve_pairs(gradient, value, regular, side)
            xy = xy - step
            found = regular & (np.abs(step).max(axis=1) <= tolerance(xy))
            if found.all():
                break
    return xy, found


def inverse(matrix: Array) -> Array:
    """Inverses of regular 2x2 matrices (n, 2, 2)."""
    (a, b), (c, d) = matrix[..., 0, :].T, matrix[..., 1, :].T
    det = determinant(matrix)
    return matrices((d / det, -b / det), (-c / det, a / det))


def lower_root(matrix: Array) -> Array:
    """Cholesky factors L of positive definite 2x2 matrices L L' (n, 2, 2)."""
    first = np.sqrt(matrix[:, 0, 0])
    below = matrix[:, 1, 0] / first
    return matrices((first, np.zeros_like(first)), (below, np.sqrt(matrix[:, 1, 1] - below**2)))


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues (n, 2), the smaller first, and eigenvectors (n, 2, 2), the columns, of symmetric 2x2 matrices."""
    a, b, d = matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 1, 1]
    middle, half = (a + d) / 2.0, (a - d) / 2.0
    radius = np.hypot(half, b)
    turn = np.arctan2(b, half) / 2.0  # direction of the major axis
    cos, sin = np.cos(turn), np.sin(turn)
    return vectors(middle - radius, middle + radius), matrices((-sin, cos), (cos, sin))
