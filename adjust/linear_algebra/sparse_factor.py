"""Upper triangles of many unknowns, most of them zero, in fronts: solved, and inverted where they are not zero.

Of the inverse only that is computed which lies in the fronts, from the last to the first (Erisman and Tinney 1975, On
computing certain elements of the inverse of a sparse matrix), and as a root of the cofactor matrix, so that the
condition is not squared.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import rq, solve_triangular
from scipy.linalg.lapack import dtrcon, dtrtrs

from adjust.array_types import Array, Indices
from adjust.linear_algebra.fronts import Front, Fronts

WIDE = 500  # unknowns of a front up to which roots of cofactors run over all of them
SAFE = 1e-6  # reciprocal condition of a root down to which its square will do in a large network
TEN_DIGITS = 1e-3  # and in a small one: variances keep them
ELEMENTS_AT_ONCE = 2_000_000  # of roots that are handled together
POWERS = 20  # steps of power iterations


@dataclass(frozen=True)
class Triangle:
    """An upper triangle (s, s) in fronts: of each its triangle (k, k) and its border (k, a)."""

    fronts: Fronts
    own: tuple[Array, ...]
    border: tuple[Array, ...]

    def __len__(self) -> int:
        return self.fronts.count

    @property
    def parts(self) -> Iterator[tuple[Front, Array, Array]]:
        return zip(self.fronts, self.own, self.border, strict=True)

    def toarray(self) -> Array:
        result = np.zeros((len(self), len(self)))
        for front, own, border in self.parts:
            result[front.own, front.own] = own
            result[front.own, front.after] = border
        return result

    def solve(self, right: Array) -> Array:
        """The inverse times right sides (s,) or (s, d). Raises numpy.linalg.LinAlgError where it is singular."""
        result = np.array(right, dtype=np.float64)
        for front, own, border in reversed(list(self.parts)):
            result[front.own] = _solved(own, result[front.own] - border @ result[front.after])
        return result

    def solve_transposed(self, right: Array) -> Array:
        """The inverse of the transpose times right sides (s,) or (s, d)."""
        result = np.array(right, dtype=np.float64)
        for front, own, border in self.parts:
            result[front.own] = _solved(own, result[front.own], transposed=True)
            result[front.after] -= border.T @ result[front.own]
        return result

    def times(self, vectors: Array) -> Array:
        """Its product with vectors (s,) or (s, d)."""
        result = np.empty_like(vectors)
        for front, own, border in self.parts:
            result[front.own] = own @ vectors[front.own] + border @ vectors[front.after]
        return result

    def transposed_times(self, vectors: Array) -> Array:
        result = np.zeros_like(vectors)
        for front, own, border in self.parts:
            result[front.own] += own.T @ vectors[front.own]
            result[front.after] += border.T @ vectors[front.own]
        return result

    def cofactor_times(self, vectors: Array) -> Array:
        """The cofactor matrix, the inverse of its square R'R, times vectors (s, d)."""
        return self.solve(self.solve_transposed(vectors))

    def lifted(self, least: float) -> "Triangle":
        """With no diagonal element nearer to 0 than that: no singular value changes by more."""
        return replace(self, own=tuple(_lifted(own, least) for own in self.own))

    @cached_property
    def largest_singular(self) -> float:
        """By power iteration, to a few percent."""
        return self._singular(lambda vector: self.transposed_times(self.times(vector)))

    @cached_property
    def reciprocal_condition(self) -> float:
        """The smallest singular value over the largest, to some tens of percent; 0 where it is singular."""
        if not all(np.diag(own).all() for own in self.own):
            return 0.0
        smallest = self._singular(self.cofactor_times)
        return smallest / self.largest_singular if smallest > 0.0 else 1.0

    def _singular(self, multiplied: Callable[[Array], Array]) -> float:
        """The singular value whose vector grows most where its square, or that of the inverse, is multiplied with."""
        vector = np.random.default_rng(0).normal(size=len(self))
        for _ in range(POWERS):
            vector = multiplied(vector)
            vector /= np.linalg.norm(vector)
        return float(np.linalg.norm(self.times(vector)))

    @cached_property
    def roots(self) -> tuple[Array, ...]:
        """Of every front the upper root G (k + a, k + a): G G' is the cofactor matrix of what it touches."""
        roots: list[Array] = [np.empty((0, 0))] * len(self.fronts)
        for i in reversed(range(len(self.fronts))):
            front = self.fronts[i]
            root = np.zeros((front.width, front.width))
            root[: front.count, : front.count] = solve_triangular(self.own[i], np.eye(front.count))
            if len(front.after):
                home = int(self.fronts.home(front.after))
                later = roots[home][self.fronts[home].places(front.after)]
                later = np.asarray(rq(later, mode="r"), dtype=np.float64)[:, -len(front.after) :]
                through = root[: front.count, : front.count] @ self.border[i]
                root[: front.count, front.count :] = -through @ later
                root[front.count :, front.count :] = later
            roots[i] = root
        return tuple(roots)

    @cached_property
    def squares(self) -> tuple[Array, ...]:
        """Of every front the cofactor matrix (k + a, k + a) of what it touches."""
        return tuple(root @ root.T for root in self.roots)

    @property
    def variances(self) -> Array:
        """The diagonal (s,) of the cofactor matrix."""
        of_fronts = [(root[: f.count] ** 2).sum(axis=1) for f, root in zip(self.fronts, self.roots, strict=True)]
        return np.concatenate([np.empty(0), *of_fronts])

    def group_cofactors(self, groups: Indices) -> Array:
        """The cofactor matrices (b, s', s') of groups (b, s') of unknowns that some front touches."""
        result = np.empty((*groups.shape, groups.shape[1]))
        home = self.fronts.home(groups)
        for i in np.unique(home):
            result[home == i] = self._local_cofactors(int(i), self.fronts[i].places(groups[home == i]))
        return result

    def through(self, rows: Array, groups: Indices) -> Array:
        """The cofactor matrices (b, r, r) of rows (b, r, s') of functions of groups (b, s') of unknowns."""
        result = np.zeros((*rows.shape[:2], rows.shape[1]))
        home = self.fronts.home(groups) if groups.size else np.empty(0, dtype=np.intp)
        for i in np.unique(home):
            members = np.flatnonzero(home == i)
            if self._conditions[i] > self._least_condition:
                cofactors = self._local_cofactors(int(i), self.fronts[i].places(groups[members]))
                result[members] = rows[members] @ cofactors @ rows[members].swapaxes(1, 2)
                continue
            at_once = max(1, ELEMENTS_AT_ONCE // (groups.shape[1] * len(self)))
            for some in np.split(members, range(at_once, len(members), at_once)):
                roots = rows[some] @ self.group_roots(groups[some])
                result[some] = roots @ roots.swapaxes(1, 2)
        return result

    @property
    def is_safely_squared(self) -> bool:
        """Whether the condition of the fronts' roots allows for products with their squares."""
        return min(self._conditions, default=1.0) > self._least_condition

    @property
    def _least_condition(self) -> float:
        return TEN_DIGITS if self._is_narrow else SAFE

    @property
    def _is_narrow(self) -> bool:
        return len(self.fronts) == 1 and len(self) <= WIDE

    @cached_property
    def _conditions(self) -> list[float]:
        """The reciprocal conditions of the fronts' roots."""
        return [float(dtrcon(root)[0]) for root in self.roots]

    def group_roots(self, groups: Indices) -> Array:
        """Roots (b, s', k) of the cofactor matrices of groups (b, s') of unknowns that some front touches."""
        if self._is_narrow:
            return self.roots[0][groups]
        different, which = np.unique(groups, axis=0, return_inverse=True)
        result = np.empty((*different.shape, different.shape[1]))
        home = self.fronts.home(different)
        for i in np.unique(home):
            members = home == i
            result[members] = self._local_roots(int(i), self.fronts[i].places(different[members]))
        return np.asarray(result[which.reshape(-1)])

    def _local_roots(self, i: int, places: Indices) -> Array:
        """Roots (b, s', s') of the cofactor matrices of some of what a front touches, by their places (b, s') in it."""
        if self._conditions[i] > SAFE:
            try:
                return np.asarray(np.linalg.cholesky(self._local_cofactors(i, places)), dtype=np.float64)
            except np.linalg.LinAlgError:  # the condition of the cofactor matrix is the square of that of its root
                pass
        rows = self.roots[i][places].swapaxes(1, 2)
        return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64).swapaxes(1, 2)

    def _local_cofactors(self, i: int, places: Indices) -> Array:
        """The cofactor matrices (b, s', s') themselves."""
        width = self.fronts[i].width
        return self.squares[i].take(places[:, :, None] * width + places[:, None, :])


def _solved(triangle: Array, right: Array, transposed: bool = False) -> Array:
    """An upper triangle's inverse, or that of its transpose, times right sides, without what SciPy checks besides."""
    if not len(triangle):
        return right
    solved, singular = dtrtrs(triangle, right, trans=transposed)
    if singular:
        raise np.linalg.LinAlgError("a triangle is singular")
    return np.asarray(solved)


def _lifted(triangle: Array, least: float) -> Array:
    diagonal = np.diag(triangle)
    lift = np.where(np.abs(diagonal) < least, np.where(diagonal < 0.0, -least, least) - diagonal, 0.0)
    return np.asarray(triangle + np.diag(lift))
