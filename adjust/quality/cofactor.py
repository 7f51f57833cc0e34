"""Cofactor matrix of a result (covariance at sigma0 = 1), computed on demand from the factor."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from adjust.array_types import Array, Indices
from adjust.functional_model.rotation import vector_by_angles
from adjust.least_squares.numbering import Numbering
from adjust.linear_algebra.factor import Factor
from adjust.problem.problem import Problem, State
from adjust.rank_defect.datum import free_motion


@dataclass(frozen=True)
class NoCofactor:
    """Placeholder for the cofactor matrix where there is no solution: zeros without meaning."""

    count: int

    @property
    def variances(self) -> Array:
        return np.zeros(self.count)

    def part(self, at: Indices) -> Array:
        return np.zeros((len(at), len(at)))

    def parts(self, groups: Indices) -> Array:
        return np.zeros((*groups.shape, groups.shape[1]))


@dataclass(frozen=True)
class InnerDatum:
    """Baarda's S-transformation of cofactors: with V = Q P', Q becomes Q - M V' - V M' + M P V M'.

    motion M (n, d): motions of the quantities in the free directions of the datum; through V (n, d); inner P V (d, d).
    """

    motion: Array
    through: Array
    inner: Array

    def part(self, at: Indices) -> Array:
        """(k, k) term added to the cofactors of some quantities."""
        motion, through = self.motion[at], self.through[at]
        crossed = motion @ through.T
        return np.asarray(motion @ self.inner @ motion.T - crossed - crossed.T)

    @property
    def variances(self) -> Array:
        """(n,) term added to the variances."""
        return np.asarray(((self.motion @ self.inner - 2.0 * self.through) * self.motion).sum(axis=1))


@dataclass(frozen=True)
class FactorCofactor:
    """Cofactor matrix of all quantities (n, n) from the factor of the free unknowns (f).

    by_free (n, f): derivatives of the reported quantities by the free unknowns: omega, phi, kappa by rotation vectors,
    film parameters by centred ones; empty rows for fixed quantities.
    """

    factor: Factor
    by_free: csr_array
    datum: InnerDatum | None = None

    def part(self, at: Indices) -> Array:
        """Cofactor matrix (k, k) of some quantities, by their positions in the result."""
        cofactor = self.factor.function_cofactor(self.by_free[at])
        return cofactor if self.datum is None else cofactor + self.datum.part(at)

    def parts(self, groups: Indices) -> Array:
        """Cofactor matrices (g, k, k) of groups of quantities (g, k), each of one point or one image."""
        functions = self.by_free[groups.ravel()]
        (count, width), free = groups.shape, self.by_free.shape[1]
        row = np.repeat(np.arange(groups.size), np.diff(functions.indptr))
        # All pairs of a group and an unknown that it depends on, sorted by group.
        pairs, place = np.unique(row // width * free + functions.indices, return_inverse=True)
        first = np.searchsorted(pairs, np.arange(count) * free)
        widths = np.diff(first, append=len(pairs))
        by_unknowns = np.zeros((count, width, int(widths.max(initial=0))))
        by_unknowns[row // width, row % width, place - first[row // width]] = functions.data
        cofactors = np.zeros((*groups.shape, width))
        for some in (np.flatnonzero(widths == each) for each in np.unique(widths[widths > 0])):
            numbers = pairs[first[some][:, None] + np.arange(widths[some[0]])] % free
            by = by_unknowns[some][..., : numbers.shape[1]]
            cofactors[some] = by @ self.factor.cofactors(numbers) @ by.swapaxes(1, 2)
        return cofactors if self.datum is None else cofactors + np.array([self.datum.part(at) for at in groups])

    @cached_property
    def variances(self) -> Array:
        """(n,) diagonal."""
        plain = self.factor.variances()
        entries = np.diff(self.by_free.indptr)
        variances = self.by_free.multiply(self.by_free) @ plain
        for count in np.unique(entries[entries > 1]):  # functions of `count` unknowns, all of one image
            rows = np.flatnonzero(entries == count)
            functions = self.by_free[rows]
            by_unknowns = functions.data.reshape(-1, 1, count)
            cofactors = self.factor.cofactors(functions.indices.reshape(-1, count).astype(np.intp))
            variances[rows] = (by_unknowns @ cofactors @ by_unknowns.swapaxes(1, 2))[:, 0, 0]
        return np.asarray(variances if self.datum is None else np.maximum(variances + self.datum.variances, 0.0))


def free_cofactor(numbering: Numbering, state: State, factor: Factor) -> FactorCofactor:
    """Cofactor matrix in the datum of the numbering."""
    return FactorCofactor(factor, _reported(numbering.problem, state)[:, numbering.free])


def inner_cofactor(
    problem: Problem, numbering: Numbering, state: State, factor: Factor, members: Indices
) -> FactorCofactor:
    """Cofactor matrix transformed from the numbering's minimum constraints to inner constraints over some coordinates.

    With G the motions of the free datum and G_p their rows of these coordinates, P = (G_p' G_p)^-1 G_p'.
    """
    reported = _reported(problem, state)
    by_free = reported[:, numbering.free]
    motion = free_motion(problem, state)
    part = np.zeros((len(problem.unknowns), motion.shape[1]))
    part[members] = np.linalg.pinv(motion[members]).T
    through = factor.cofactor_times(part[numbering.free])
    datum = InnerDatum(reported @ motion, by_free @ through, part[numbering.free].T @ through)
    return FactorCofactor(factor, by_free, datum)


def _reported(problem: Problem, state: State) -> csr_array:
    """(n, n) derivatives of the reported quantities by the unknowns of the iteration."""
    # These are omega, phi, kappa by rotation vectors, and film parameters by centred ones. Where phi is +-90 degrees,
    # only the sum or difference of omega and kappa is determined (pseudo-inverse).
    count = len(problem.unknowns)
    angles = np.unique(problem.exterior[~problem.keeps_angles, 3:], axis=0)  # scans of one frame have one attitude
    by_vector = np.linalg.pinv(vector_by_angles(state.values[angles]))
    groups = [(angles, by_vector), *problem.films_by_centred(state)]
    others = np.setdiff1d(np.arange(count), np.concatenate([positions.ravel() for positions, _ in groups]))
    rows, columns, values = [others], [others], [np.ones(len(others), dtype=np.float64)]
    for positions, derivatives in groups:
        at = np.broadcast_to(positions[:, :, None], derivatives.shape)
        rows.append(at.ravel())
        columns.append(at.swapaxes(1, 2).ravel())
        values.append(derivatives.ravel().astype(np.float64))
    entries = (np.concatenate(rows), np.concatenate(columns))
    matrix = csr_array((np.concatenate(values), entries), shape=(count, count))
    matrix.eliminate_zeros()
    return matrix
