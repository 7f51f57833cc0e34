"""Triangles of large sparse equations, front by front: by reflections of their rows, or by Cholesky.

A front's rows are factorised: a triangle for the unknowns that it owns, a border in those that it meets later, and rows
that are handed on to the front that owns the first of these. Or normal equations are, and squares are handed on.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.linalg import solve_triangular

from adjust.array_types import Array, Indices
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.sparse_factor import Triangle

Rows = tuple[Indices, Array]  # unknowns (b, s) and rows (b, k, s + 1) in them, the right side behind

ROWS_PER_COLUMN = 4  # rows are condensed when there are more of them than this
CONDENSED_ROWS = 2000  # and more than this


def reflected(
    fronts: Fronts, rows: Iterable[Rows], prior_root_weight: Array, prior_right: Array
) -> tuple[Triangle, Array]:
    """The triangle and right side (s,) of rows, and of a row an unknown for its prior, by reflections.

    The unknowns of a row are in one front: that which owns the first of them.
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
    """The triangle of further rows (k, s') in some unknowns (s',) each, besides its own rows."""
    itself = [(front.columns, np.hstack(parts)) for front, *parts in triangle.parts]
    all_rows = [(unknowns[None], np.pad(each, ((0, 0), (0, 1)))[None]) for unknowns, each in (*itself, *rows)]
    nothing = np.zeros(len(triangle))
    return reflected(triangle.fronts, all_rows, nothing, nothing)[0]


def factorise_normal_equations(fronts: Fronts, squares: list[Array], right: Array) -> tuple[Triangle, Array]:
    """The triangle and right side (s,) of normal equations, by Cholesky.

    squares: of every front those (k + a, k + a) of the rows that belong to it, whose lower triangle is read and which
    are used up; right (s,). Raises numpy.linalg.LinAlgError where they are not positive definite.
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
    """Rows times columns squared, of all fronts; heights (b,): the rows of blocks whose first unknown is that."""
    home = fronts.home(first[heights > 0, None])
    of_front = np.bincount(home, heights[heights > 0], len(fronts))
    return float((of_front * np.array([front.width for front in fronts]) ** 2).sum())


def _distributed(fronts: Fronts, rows: Iterable[Rows]) -> Iterator[tuple[int, Rows]]:
    """The rows by the front to which they belong."""
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
    """The triangle (up to w + 1, w + 1) of prior rows (p, w + 1) and of rows in some of the w unknowns."""
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
    """Rows (b, k, s + 1) in some unknowns (b, s) as rows (b k, w + 1) in all."""
    spread = np.zeros((*rows.shape[:2], width + 1))
    columns = np.concatenate([unknowns, np.full((len(unknowns), 1), width)], axis=1)
    np.put_along_axis(spread, np.broadcast_to(columns[:, None, :], rows.shape), rows, axis=2)
    return spread.reshape(-1, width + 1)


def qr_triangle(rows: Array) -> Array:
    """The factors R (..., k, n) of Householder factorisations of rows (..., m, n), k the smaller of m and n."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
