"""Arithmetic of many small matrices at once, those of all marks say, element by element.

The shapes are (n, 2), (n, 2, 2), (n, 2, k) as everywhere, but in memory the n elements of one place stand together: an
operation on a place is then one pass over contiguous numbers. A loop over matrices takes longer to go from one to the
next than for its arithmetic. Everything may be complex, and works, only slower, on arrays that are laid out otherwise.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike

from adjust.array_types import Array, Indices, Mask


def zeros(count: int, *shape: int, dtype: DTypeLike = np.float64) -> Array:
    """(count, *shape)."""
    return _members_first(np.zeros((*shape, count), dtype=dtype))


def vectors(*elements: Array) -> Array:
    """(n, k) of k elements (n,)."""
    return np.stack(elements).T


def matrices(*rows: Sequence[Array]) -> Array:
    """(n, i, k) of i rows of k elements (n,) each."""
    stacked = np.stack([element for row in rows for element in row])
    return _members_first(stacked.reshape(len(rows), len(rows[0]), stacked.shape[1]))


def columns(members: Sequence[Array]) -> Array:
    """(n, i, k) of k columns (n, i)."""
    return np.stack([member.T for member in members]).T


def laid_out(array: Array) -> Array:
    """The same array (n, ...), in memory as it is described above."""
    return _members_first(np.ascontiguousarray(_members_last(array)))


def take_members(array: Array, numbers: Indices) -> Array:
    """The members (n, ...) of an array (m, ...) that have these numbers (n,)."""
    return _members_first(np.take(_members_last(array), numbers, axis=-1))


def _members_first(array: Array) -> Array:
    """(n, ...) of (..., n); `numpy.moveaxis` takes longer than the arithmetic of few members."""
    return array.transpose(-1, *range(array.ndim - 1))


def _members_last(array: Array) -> Array:
    """(..., n) of (n, ...)."""
    return array.transpose(*range(1, array.ndim), 0)


def product(left: Array, right: Array) -> Array:
    """(..., i, k) of matrices (..., i, j) and (..., j, k)."""
    total = left[..., :, 0, None] * right[..., None, 0, :]
    for j in range(1, left.shape[-1]):
        total += left[..., :, j, None] * right[..., None, j, :]
    return np.asarray(total)


def applied(matrix: Array, vector: Array) -> Array:
    """(..., i) of matrices (..., i, j) and vectors (..., j)."""
    return product(matrix, vector[..., None])[..., 0]


def cross(left: Array, right: Array) -> Array:
    """left x right (n, k, 3) of vectors (n, k, 3) and (n, k, 3), k of one of them may be 1."""
    (a, b, c), (u, v, w) = left.T, right.T
    return np.stack((b * w - c * v, c * u - a * w, a * v - b * u)).T


def determinant(matrix: Array) -> Array:
    """(...) of 2x2 matrices."""
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])


def solved(matrix: Array, right: Array, regular: Mask, of: Array) -> Array:
    """The solutions (n, 2) of 2x2 systems with their determinants; where they are not regular it means nothing."""
    divisor = np.where(regular, of, 1.0)
    x, y = right[..., 0], right[..., 1]
    first = (matrix[..., 1, 1] * x - matrix[..., 0, 1] * y) / divisor
    second = (matrix[..., 0, 0] * y - matrix[..., 1, 0] * x) / divisor
    return vectors(first, second)


def inverse(matrix: Array) -> Array:
    """Of regular 2x2 matrices (n, 2, 2)."""
    (a, b), (c, d) = matrix[..., 0, :].T, matrix[..., 1, :].T
    of = determinant(matrix)
    return matrices((d / of, -b / of), (-c / of, a / of))


def lower_root(matrix: Array) -> Array:
    """L of positive definite 2x2 matrices L L' (n, 2, 2), lower triangles (Cholesky)."""
    first = np.sqrt(matrix[:, 0, 0])
    below = matrix[:, 1, 0] / first
    return matrices((first, np.zeros_like(first)), (below, np.sqrt(matrix[:, 1, 1] - below**2)))


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues (n, 2), the smaller first, and eigenvectors (n, 2, 2), the columns, of symmetric 2x2 matrices."""
    a, b, d = matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 1, 1]
    middle, half = (a + d) / 2.0, (a - d) / 2.0
    radius = np.hypot(half, b)
    turn = np.arctan2(b, half) / 2.0  # of the axis of the larger
    cos, sin = np.cos(turn), np.sin(turn)
    return vectors(middle - radius, middle + radius), matrices((-sin, cos), (cos, sin))
