"""Multifrontal factorisation of large sparse equations: Householder QR of rows, or Cholesky of normal equations.

QR of the rows of a front gives a triangle for its own unknowns, a border in the later ones, and remaining rows, which
are passed to the front that owns the first of these. With normal equations, the Schur complement is passed on.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.linalg import solve_triangular

from adjust.array_types import Array, Indices
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.sparse_factor import Triangle

Rows = tuple[Indices, Array]  # unknowns (b, s) and rows (b, k, s + 1) in them, the right side last

ROWS_PER_COLUMN = 4  # pending rows are factorised when they exceed this number per column
CONDENSED_ROWS = 2000  # and this number in all


def reflected(
    fronts: Fronts, rows: Iterable[Rows], prior_root_weight: Array, prior_right: Array
) -> tuple[Triangle, Array]:
    """Factorise rows, and one prior row per unknown, by Householder QR; returns the triangle and right side (s,).

    All unknowns of a row must be in the front that owns the first of them.
    """
    of_front: list[list[Rows]] = [[] for _ in fronts]
    for i, some in _distributed(fronts, rows):
        of_front[i].append(some)
    own, borders = [], []
    right = np.empty(len(prior_right))
    for front, of_this in zip(fronts, of_front, strict=True):
        columns = front.columns
        local = [(front.places(unknowns), each) for unknowns, each in of_this]
        prior = np.zeros((front.count, front.width + 1))
        prior[:, : front.count] = np.diag(prior_root_weight[front.own])
        prior[:, -1] = prior_right[front.own]
        triangle = _condensed(local, prior)
        of_this.clear()
        own.append(triangle[: front.count, : front.count])
        borders.append(triangle[: front.count, front.count : -1])
        right[front.own] = triangle[: front.count, -1]
        left = triangle[front.count : front.width, front.count :]
        if left.size:
            home = int(fronts.home(front.after))
            of_front[home].append((columns[None, front.count :], left[None]))
    return Triangle(fronts, tuple(own), tuple(borders)), right


def append_rows(triangle: Triangle, rows: Iterable[tuple[Indices, Array]]) -> Triangle:
    """Update a triangle with further rows (k, s') in unknowns (s',)."""
    itself = [(front.columns, np.hstack(parts)) for front, *parts in triangle.parts]
    all_rows = [(unknowns[None], np.pad(each, ((0, 0), (0, 1)))[None]) for unknowns, each in (*itself, *rows)]
    nothing = np.zeros(len(triangle))
    return reflected(triangle.fronts, all_rows, nothing, nothing)[0]


def factorise_normal_equations(fronts: Fronts, squares: list[Array], right: Array) -> tuple[Triangle, Array]:
    """Factorise normal equations by Cholesky.

    Parameters
    ----------
    squares : normal matrices (k + a, k + a) of the fronts' own rows; only lower triangles are read. Destroyed.
    right : (s,) right side.

    Returns
    -------
    Triangle and right side (s,).

    Raises
    ------
    numpy.linalg.LinAlgError
        If the normal equations are not positive definite.
    """
    own, borders = [], []
    right = right.copy()
    for i, front in enumerate(fronts):
        square = squares[i]
        root = np.asarray(np.linalg.cholesky(square[: front.count, : front.count]), dtype=np.float64)
        border = solve_triangular(root, square[front.count :, : front.count].T, lower=True)
        right[front.own] = solve_triangular(root, right[front.own], lower=True)
        right[front.after] -= border.T @ right[front.own]
        if len(front.after):
            home = int(fronts.home(front.after))
            at = fronts[home].places(front.after)
            squares[home][np.ix_(at, at)] += square[front.count :, front.count :] - border.T @ border
        own.append(root.T)
        borders.append(border)
        squares[i] = np.empty((0, 0))
    return Triangle(fronts, tuple(own), tuple(borders)), right


def reflections_cost(fronts: Fronts, first: Indices, heights: Indices) -> float:
    """Cost of Householder QR: rows times columns squared, summed over the fronts.

    first, heights (b,): first unknown and number of rows of each block.
    """
    home = fronts.home(first[heights > 0, None])
    of_front = np.bincount(home, heights[heights > 0], len(fronts))
    return float((of_front * np.array([front.width for front in fronts]) ** 2).sum())


def _distributed(fronts: Fronts, rows: Iterable[Rows]) -> Iterator[tuple[int, Rows]]:
    """Assign rows to the fronts that own their first unknowns."""
    for unknowns, each in rows:
        if unknowns.shape[1] == 0:
            continue
        home = fronts.home(unknowns)
        if (home == home[0]).all():
            yield int(home[0]), (unknowns, each)
            continue
        order = np.argsort(home, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(home[order])) + 1):
            yield int(home[members[0]]), (unknowns[members], each[members])


def _condensed(rows: Sequence[Rows], priors: Array) -> Array:
    """Triangle (up to w + 1, w + 1) of prior rows (p, w + 1) and of rows in some of the w unknowns."""
    width = priors.shape[1] - 1
    together = max(CONDENSED_ROWS, ROWS_PER_COLUMN * (width + 1))
    triangle, pending, height = priors, list[Array](), 0
    for unknowns, each in rows:
        count = max(1, together // max(1, each.shape[1]))
        for first in range(0, len(each), count):
            pending.append(_spread(unknowns[first : first + count], each[first : first + count], width))
            height += len(pending[-1])
            if height >= together:
                triangle = qr_triangle(np.vstack([triangle, *pending]))
                pending, height = [], 0
    return qr_triangle(np.vstack([triangle, *pending]))


def _spread(unknowns: Indices, rows: Array, width: int) -> Array:
    """Expand rows (b, k, s + 1) in some unknowns (b, s) to rows (b k, w + 1) in all."""
    spread = np.zeros((*rows.shape[:2], width + 1))
    columns = np.concatenate([unknowns, np.full((len(unknowns), 1), width)], axis=1)
    np.put_along_axis(spread, np.broadcast_to(columns[:, None, :], rows.shape), rows, axis=2)
    return spread.reshape(-1, width + 1)


def qr_triangle(rows: Array) -> Array:
    """Factors R (..., k, n) of Householder QR of rows (..., m, n), k = min(m, n)."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
