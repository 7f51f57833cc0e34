"""Sparse upper triangular factors in fronts: multifrontal factorisation, solution of systems, selected inversion.

The images of a strip or block share points only with their neighbours, and all share the camera: their reduced normal
equations are banded and bordered. The Cuthill-McKee order of the groups of unknowns, one group per image, makes the
band narrow; the border is eliminated last. A front is a run of neighbouring groups that are eliminated together as one
dense matrix. Its Schur complement is passed to the front that owns the first remaining unknown (Duff and Reid 1983, The
multifrontal solution of indefinite sparse symmetric linear equations). A small network is a single front.

Selected inversion computes only the elements of the cofactor matrix that lie in the fronts, from the last front to the
first (Erisman and Tinney 1975, On computing certain elements of the inverse of a sparse matrix). It computes a root of
the cofactor matrix, so that the condition number is not squared.

QR of the rows of a front gives a triangle for its own unknowns, a border in the later ones, and remaining rows, which
are passed to the front that owns the first of these. With normal equations, the Schur complement is passed on.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import rq, solve_triangular
from scipy.linalg.lapack import dtrcon, dtrtrs
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from adjust.array_types import Array, Indices

FRONT_COST = 1e6  # overhead of a front, in unknowns times columns squared of dense algebra in the same time
WIDE = 500  # unknowns of a single front up to which roots of cofactor matrices keep all its columns
SAFE = 1e-6  # reciprocal condition of a root down to which its square is accurate enough in a large network
TEN_DIGITS = 1e-3  # and in a small one: variances keep ten digits
NARROW = 50  # unknowns up to which singular values are computed in full
ELEMENTS_AT_ONCE = 2_000_000  # elements of the roots in one batch
POWERS = 20  # steps of the power iteration
ROWS_PER_COLUMN = 4  # pending rows are factorised when they exceed this number per column
CONDENSED_ROWS = 2000  # and this number in all


@dataclass(frozen=True)
class Front:
    """Front: unknowns first to stop (excluded), eliminated together, and the later ones (a,) connected with them."""

    first: int
    stop: int
    after: Indices

    @property
    def own(self) -> slice:
        return slice(self.first, self.stop)

    @property
    def count(self) -> int:
        return self.stop - self.first

    @property
    def width(self) -> int:
        """Number of unknowns of the front, own and later ones."""
        return self.count + len(self.after)

    @property
    def columns(self) -> Indices:
        """Unknowns (k + a,) of the front, own ones first."""
        return np.concatenate([np.arange(self.first, self.stop), self.after])

    def places(self, unknowns: Indices) -> Indices:
        """Positions of unknowns within the front."""
        behind = self.count + np.searchsorted(self.after, unknowns)
        return np.where(unknowns < self.stop, unknowns - self.first, behind)


@dataclass(frozen=True)
class Fronts:
    """All fronts of a network, in the order of elimination."""

    members: tuple[Front, ...]

    @staticmethod
    def single(count: int) -> "Fronts":
        """A single front of all unknowns."""
        return Fronts((Front(0, count, np.empty(0, dtype=np.intp)),))

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Front]:
        return iter(self.members)

    def __getitem__(self, i: int) -> Front:
        return self.members[i]

    @property
    def count(self) -> int:
        """Number of unknowns of all fronts."""
        return self.members[-1].stop

    def home(self, unknowns: Indices) -> Indices:
        """Front (...,) that holds unknowns (..., s) together: the owner of the first of them."""
        return np.asarray(np.searchsorted(self._starts, unknowns.min(axis=-1), side="right") - 1)

    @cached_property
    def table(self) -> Indices:
        """(f, 5) table of the fronts, for the compiled kernels.

        Columns: first unknown, number of own unknowns, offset of the front's matrix in an array of all, offset of its
        later unknowns in `later_unknowns`, and their number.
        """
        count, later = np.array([(front.count, len(front.after)) for front in self], dtype=np.intp).T
        sizes = (count + later) ** 2
        return np.column_stack([self._starts, count, np.cumsum(sizes) - sizes, np.cumsum(later) - later, later])

    @cached_property
    def later_unknowns(self) -> Indices:
        """Later unknowns of all fronts, one front after the other."""
        return np.concatenate([front.after for front in self])

    @cached_property
    def _starts(self) -> Indices:
        return np.array([front.first for front in self.members], dtype=np.intp)


def band_order(meeting: csr_array) -> Indices:
    """Order groups (g,) of unknowns by the reverse Cuthill-McKee algorithm, so that connected groups are close.

    meeting (g, g): adjacency matrix, with an entry for any two groups that occur in the same block of observations.
    """
    return np.asarray(reverse_cuthill_mckee(meeting, symmetric_mode=True), dtype=np.intp)


def make_fronts(meeting: csr_array, sizes: Indices, border: int) -> Fronts:
    """Divide ordered groups of unknowns and a border into fronts.

    Parameters
    ----------
    meeting : (g, g) adjacency matrix of the groups, as in `band_order`, in elimination order.
    sizes : (g,) numbers of unknowns of the groups.
    border : number of unknowns that may be connected with all groups.

    Notes
    -----
    Neighbouring groups are merged as long as this lowers the cost per eliminated unknown. The later unknowns of a run
    are passed on, all of them, to its first later group.
    """
    size, count = np.append(sizes, border), len(sizes)
    handed_on: list[set[int]] = [set() for _ in range(count + 1)]
    runs: list[_Run] = []
    for group in range(count + 1):
        neighbours = meeting.indices[slice(*meeting.indptr[group : group + 2])] if group < count else ()
        later = {int(i) for i in neighbours if i > group} | handed_on[group] | {count}
        if runs:
            last = runs[-1]
            together = _Run(last.first, group + 1, (last.later | later) - {group})
            if together.cost(size) <= last.cost(size):
                runs[-1] = together
                continue
            handed_on[min(last.later)] |= last.later
            later |= handed_on[group]
        runs.append(_Run(group, group + 1, later - {group}))
    stops = np.cumsum(size)
    starts = stops - size
    fronts = [
        Front(
            int(starts[run.first]),
            int(stops[run.stop - 1]),
            np.concatenate([np.arange(starts[i], stops[i]) for i in sorted(run.later)] or [np.empty(0, np.intp)]),
        )
        for run in runs
        if stops[run.stop - 1] > starts[run.first]
    ]
    return Fronts(tuple(fronts)) if fronts else Fronts.single(0)


@dataclass(frozen=True)
class _Run:
    """Groups first to stop (excluded), and the later ones connected with them."""

    first: int
    stop: int
    later: set[int]

    def cost(self, size: Indices) -> float:
        """Cost per eliminated unknown; size (g + 1,): numbers of unknowns of the groups."""
        own = int(size[self.first : self.stop].sum())
        width = own + int(size[list(self.later)].sum())
        return width**2 + FRONT_COST / max(own, 1)


@dataclass(frozen=True)
class Triangle:
    """Sparse upper triangular factor R (s, s): of each front the triangle (k, k) and the border (k, a)."""

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
        """Solve R x = b for right sides b (s,) or (s, d). Raises numpy.linalg.LinAlgError if R is singular."""
        result = np.array(right, dtype=np.float64)
        for front, own, border in reversed(list(self.parts)):
            result[front.own] = _solve_fronts(own, result[front.own] - border @ result[front.after])
        return result

    def solve_transposed(self, right: Array) -> Array:
        """Solve R' x = b for right sides b (s,) or (s, d)."""
        result = np.array(right, dtype=np.float64)
        for front, own, border in self.parts:
            result[front.own] = _solve_fronts(own, result[front.own], transposed=True)
            result[front.after] -= border.T @ result[front.own]
        return result

    def times(self, vectors: Array) -> Array:
        """Product R x with vectors x (s,) or (s, d)."""
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
        """Product of the cofactor matrix, the inverse of R'R, with vectors (s, d)."""
        return self.solve(self.solve_transposed(vectors))

    def lifted(self, least: float) -> "Triangle":
        """Raise diagonal elements to at least `least` in absolute value; singular values change by no more."""
        lifted = []
        for own in self.own:
            diagonal = np.diag(own)
            lift = np.where(np.abs(diagonal) < least, np.where(diagonal < 0.0, -least, least) - diagonal, 0.0)
            lifted.append(np.asarray(own + np.diag(lift)))
        return replace(self, own=tuple(lifted))

    @cached_property
    def largest_singular(self) -> float:
        """Largest singular value, in a wide triangle to a few percent."""
        if 0 < len(self) <= NARROW:
            return float(self._singulars[0])
        return self._singular(lambda vector: self.transposed_times(self.times(vector)))

    @cached_property
    def smallest_singular(self) -> float:
        """Smallest singular value, in a wide triangle to some tens of percent; 0 if R is singular, inf if empty."""
        if not all(np.diag(own).all() for own in self.own):
            return 0.0
        if len(self) <= NARROW:
            return float(self._singulars[-1]) if len(self) else np.inf
        return self._singular(self.cofactor_times)

    @property
    def reciprocal_condition(self) -> float:
        """Smallest over largest singular value; 1 if R is empty."""
        return self.smallest_singular / self.largest_singular if len(self) else 1.0

    @cached_property
    def _singulars(self) -> Array:
        return np.asarray(np.linalg.svd(self.toarray(), compute_uv=False), dtype=np.float64)

    def _singular(self, multiplied: Callable[[Array], Array]) -> float:
        """Singular value by power iteration; multiplied: the product with R'R (largest) or its inverse (smallest)."""
        vector = np.random.default_rng(0).normal(size=len(self))
        for _ in range(POWERS):
            vector = multiplied(vector)
            vector /= np.linalg.norm(vector)
        return float(np.linalg.norm(self.times(vector)))

    @cached_property
    def roots(self) -> tuple[Array, ...]:
        """Upper roots G (k + a, k + a) of the fronts: G G' is the cofactor matrix of the unknowns of the front."""
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
        """Cofactor matrices (k + a, k + a) of the unknowns of each front."""
        return tuple(root @ root.T for root in self.roots)

    @property
    def variances(self) -> Array:
        """Diagonal (s,) of the cofactor matrix."""
        of_fronts = [(root[: f.count] ** 2).sum(axis=1) for f, root in zip(self.fronts, self.roots, strict=True)]
        return np.concatenate([np.empty(0), *of_fronts])

    def group_cofactors(self, groups: Indices) -> Array:
        """Cofactor matrices (b, s', s') of groups (b, s') of unknowns, each group within one front."""
        result = np.empty((*groups.shape, groups.shape[1]))
        home = self.fronts.home(groups)
        for i in np.unique(home):
            result[home == i] = self._local_cofactors(int(i), self.fronts[i].places(groups[home == i]))
        return result

    def through(self, rows: Array, groups: Indices) -> Array:
        """Cofactor matrices (b, r, r) of linear functions (b, r, s') of groups (b, s') of unknowns.

        By the cofactor matrix of the front where the condition allows, otherwise by its roots.
        """
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
        """Whether the roots are well enough conditioned to be replaced by their squares, the cofactor matrices."""
        return min(self._conditions, default=1.0) > self._least_condition

    @property
    def _least_condition(self) -> float:
        return TEN_DIGITS if self._is_narrow else SAFE

    @property
    def _is_narrow(self) -> bool:
        return len(self.fronts) == 1 and len(self) <= WIDE

    @cached_property
    def _conditions(self) -> list[float]:
        """Reciprocal condition numbers of the fronts' roots."""
        return [float(dtrcon(root)[0]) for root in self.roots]

    def group_roots(self, groups: Indices) -> Array:
        """Roots (b, s', k) of the cofactor matrices of groups (b, s') of unknowns, each group within one front."""
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
        """Roots (b, s', s') of the cofactor matrices of unknowns of front i, given by their places (b, s') in it."""
        rows = self.roots[i][places].swapaxes(1, 2)
        return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64).swapaxes(1, 2)

    def _local_cofactors(self, i: int, places: Indices) -> Array:
        """Cofactor matrices (b, s', s') of unknowns of front i, given by their places (b, s') in it."""
        width = self.fronts[i].width
        return self.squares[i].take(places[:, :, None] * width + places[:, None, :])


def _solve_fronts(triangle: Array, right: Array, transposed: bool = False) -> Array:
    """Solve an upper triangular system, or its transpose, without SciPy's further checks."""
    if not len(triangle):
        return right
    solved, singular = dtrtrs(triangle, right, trans=transposed)
    if singular:
        raise np.linalg.LinAlgError("the sparse factor is singular")
    return np.asarray(solved)


Rows = tuple[Indices, Array]  # unknowns (b, s) and rows (b, k, s + 1) in them, the right side last


def reflect_fronts(
    fronts: Fronts, rows: Iterable[Rows], prior_root_weight: Array, prior_right: Array
) -> tuple[Triangle, Array]:
    """Factorise rows, and one prior row per unknown, by Householder QR; returns the triangle and right side (s,).

    All unknowns of a row must be in the front that owns the first of them.
    """
    of_front: list[list[Rows]] = [[] for _ in fronts]
    for unknowns, each in rows:
        if unknowns.shape[1] == 0:
            continue
        home = fronts.home(unknowns)
        if (home == home[0]).all():
            of_front[home[0]].append((unknowns, each))
            continue
        order = np.argsort(home, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(home[order])) + 1):
            of_front[home[members[0]]].append((unknowns[members], each[members]))
    own, borders = [], []
    right = np.empty(len(prior_right))
    for front, of_this in zip(fronts, of_front, strict=True):
        columns = front.columns
        local = [(front.places(unknowns), each) for unknowns, each in of_this]
        prior = np.zeros((front.count, front.width + 1))
        prior[:, : front.count] = np.diag(prior_root_weight[front.own])
        prior[:, -1] = prior_right[front.own]
        triangle = _condense(local, prior)
        of_this.clear()
        own.append(triangle[: front.count, : front.count])
        borders.append(triangle[: front.count, front.count : -1])
        right[front.own] = triangle[: front.count, -1]
        left = triangle[front.count : front.width, front.count :]
        if left.size:
            of_front[int(fronts.home(front.after))].append((columns[None, front.count :], left[None]))
    return Triangle(fronts, tuple(own), tuple(borders)), right


def append_rows(triangle: Triangle, rows: Iterable[tuple[Indices, Array]]) -> Triangle:
    """Update a triangle with further rows (k, s') in unknowns (s',)."""
    itself = [(front.columns, np.hstack(parts)) for front, *parts in triangle.parts]
    all_rows = [(unknowns[None], np.pad(each, ((0, 0), (0, 1)))[None]) for unknowns, each in (*itself, *rows)]
    nothing = np.zeros(len(triangle))
    return reflect_fronts(triangle.fronts, all_rows, nothing, nothing)[0]


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


def _condense(rows: Sequence[Rows], priors: Array) -> Array:
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
