"""One adjustment with given weights, and everything that is tested in it, brought to unit weight.

With C the covariance that the adjustment used, T'T = C^-1 and H = T B C_xx B' T' (the hat matrix), residuals T v have
the cofactor matrix I - H. What a unit contradicts the others by is d = -(I - H)^-1 T v, and the cofactor matrix of d is
(I - H)^-1 = I + H (I - H)^-1: its own and that of the others' prediction. Where the adjustment used a weight p times
that given, its own is p I in the given weight.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.least_squares.iteration import Linearised, Solution
from adjust.least_squares.numbering import Numbering
from adjust.least_squares.rows import prior_differences
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.linear_algebra.small_matrices import applied, eigen, inverse, laid_out, product
from adjust.problem.estimates import NullDirection
from adjust.problem.problem import ABSENT, Problem
from adjust.problem.tested import TestedUnits
from adjust.quality.weighting import Weighting
from adjust.rank_defect.flat_valleys import pseudo_square_sum

UNCHECKED = 1e-9  # an observation of a smaller redundancy is not checked by any other


@dataclass(frozen=True)
class GrossError:
    """A unit that contradicts the others, the other such units left out: its statistic, and what chance lets it reach.

    error (2,): the gross error as the others see it. alike: units that explain the contradiction as well.
    """

    unit: int
    statistic: float
    limit: float
    error: Array
    alike: tuple[int, ...] = ()


@dataclass(frozen=True)
class Misfits:
    """All that is tested, in unit weight: T, H (N, 2, 2), T v (N, 2); behind a single coordinate H is 1, T and v 0.

    back (N, 2, 2): from unit weight to the coordinates, the inverse of T where that is regular.
    """

    transform: Array
    back: Array
    hat: Array
    residual: Array


@dataclass(frozen=True)
class Statistics:
    """The tests of all units as they were given: see `Reliability`.

    discrepancy_weight (N, 2, 2): P Q_v P, the inverse of the cofactor matrix of what a unit contradicts the others by;
    error (N, 2): that contradiction, the gross error as the others see it.
    """

    w: Array
    statistic: Array
    sizes: Indices
    discrepancy_weight: Array
    error: Array
    checked: Mask


@dataclass(frozen=True)
class UnitRows:
    """The rows T B of what is tested, in b blocks of equal shape, reduced to the shared unknowns (see `ReducedRows`).

    units (b, u): their numbers, ABSENT for rows that are none. own (b, u, 2, o), through (b, u, 2, s): a pair of rows
    each, zeros behind a single one. shared (b, s).
    """

    units: Indices
    own: Array
    shared: Indices
    through: Array


@dataclass(frozen=True)
class Run:
    """One adjustment with given weights, and where it ended.

    problem: as it was given, `numbering` holds it with the priors' weights. singular: what is not determined at the
    end, be that a solution or not. settled: whether the residuals ask for no other weights. removed: what data snooping
    has taken out.
    """

    problem: Problem
    numbering: Numbering
    weighting: Weighting
    solution: Solution
    singular: tuple[NullDirection, ...]
    factor: Factor
    settled: bool = True
    removed: tuple[GrossError, ...] = ()

    @property
    def end(self) -> Linearised:
        return self.solution.end

    @property
    def vpv(self) -> float:
        """v'Pv of all that is observed or given."""
        return self.end.vpv - pseudo_square_sum(self.problem, self.end.state)

    @property
    def converged(self) -> bool:
        return self.solution.termination == "converged"

    @property
    def has_solution(self) -> bool:
        return self.solution.factor is not None

    @property
    def is_tested(self) -> bool:
        """Whether everything is determined, so that residuals can be tested."""
        return not self.singular

    @cached_property
    def units(self) -> TestedUnits:
        return TestedUnits(self.problem)

    @cached_property
    def misfits(self) -> Misfits:
        """Residuals and hat matrices of everything that is tested."""
        units, observed = self.units, len(self.end.v_mm)
        transform, back = self._transforms
        hat = np.zeros((len(units) + 1, 2, 2))  # the last stands for ABSENT
        for rows in self.unit_rows():
            through = rows.through @ self.factor.triangle.group_roots(rows.shared)[:, None]
            roots = np.concatenate([rows.own, through], axis=3)
            hat[rows.units] = roots @ roots.swapaxes(2, 3)
        hat = hat[:-1]
        hat[units.sizes == 1, 1, 1] = 1.0
        v = np.zeros((len(units), 2))
        v[:observed] = self.end.v_mm
        v[observed:] = -self.prior_pairs(prior_differences(self.numbering.problem, self.end.state))
        transform, hat = laid_out(transform), laid_out(hat)
        return Misfits(transform, laid_out(back), hat, applied(transform, laid_out(v)))

    @property
    def _transforms(self) -> tuple[Array, Array]:
        """T and what leads back (N, 2, 2); of a prior both are diagonal."""
        transform, back = np.zeros((2, len(self.units), 2, 2))
        count, root, a = len(self.end.v_mm), self.end.rows.root, self.end.by_observation
        transform[:count], back[:count] = product(inverse(root), a), product(inverse(a), root)
        weights = self.prior_pairs(self._prior_root_weights)
        transform[count:, [0, 1], [0, 1]] = weights
        back[count:, [0, 1], [0, 1]] = np.where(weights > 0.0, 1.0 / np.where(weights > 0.0, weights, 1.0), 0.0)
        return transform, back

    @cached_property
    def statistics(self) -> Statistics:
        """The test statistics of all units."""
        found, weights = self.misfits, self.weighting.weights
        adjusted, axes = eigen(found.hat)
        free = np.clip(1.0 - adjusted, 0.0, None)
        of_given = weights[:, None] * free + adjusted
        along = applied(axes.transpose(0, 2, 1), found.residual)
        visible = free > UNCHECKED
        squares = np.where(visible, along**2 / np.where(visible, free * of_given, 1.0), 0.0)
        inward = product(found.transform.transpose(0, 2, 1), axes)
        weight = product(inward * (free / of_given)[:, None, :], inward.transpose(0, 2, 1))
        pull = applied(inward, along / of_given)
        variance = np.einsum("nii->ni", weight)
        checked = variance > UNCHECKED * self.own_weights
        w = np.where(checked, pull / np.sqrt(np.where(checked, variance, 1.0)), 0.0)
        contradiction = applied(axes, np.where(visible, -along / np.where(visible, free, 1.0), 0.0))
        error = applied(found.back, contradiction)
        return Statistics(w, squares.sum(axis=1), visible.sum(axis=1), weight, error, checked)

    @property
    def own_weights(self) -> Array:
        """(N, 2) the diagonal of P as it was given."""
        return np.asarray((self.misfits.transform**2).sum(axis=1) / self.weighting.weights[:, None])

    @property
    def redundancies(self) -> Array:
        """The diagonal (N, 2) of Q_v P; its sum is the redundancy of the adjustment."""
        free = product(self.misfits.back, np.eye(2) - self.misfits.hat)
        return np.asarray((free * self.misfits.transform.transpose(0, 2, 1)).sum(axis=2))

    def group_sums(self, members: Mask) -> tuple[float, float]:
        """v'Pv and redundancy of some of what is tested."""
        vpv = float((self.misfits.residual[members] ** 2).sum())
        # Behind a single coordinate stands a 1 in the hat matrix.
        return vpv, float(2 * members.sum() - np.trace(self.misfits.hat[members], axis1=1, axis2=2).sum())

    def unit_rows(self) -> Iterator[UnitRows]:
        """The rows of everything that is tested: block by block, its own unknowns' priors behind; then the shared
        ones'."""
        numbering, units, factor, observed = self.numbering, self.units, self.factor, len(self.end.v_mm)
        alone = np.flatnonzero(units.positions[:, 1] == ABSENT)
        unit_of = np.full(len(numbering.free), ABSENT, dtype=np.intp)  # that tests the prior of a free unknown alone
        unit_of[numbering.numbers[units.positions[alone, 0]]] = observed + alone
        touched = numbering.touched
        with_priors = (
            self._append_priors(block) if i < len(touched) else block for i, block in enumerate(self.end.rows)
        )
        for block, rows in zip(touched, factor.reduced_rows(with_priors), strict=False):  # behind: further observations
            own_units = np.concatenate([block.rows, unit_of[block.own]], axis=1)
            pairs = (*own_units.shape, 2)
            own = rows.own.reshape(*pairs, rows.own.shape[2])
            yield UnitRows(own_units, own, rows.shared, rows.through.reshape(*pairs, rows.through.shape[2]))
        shared = numbering.numbers[units.positions]
        given = np.flatnonzero(shared[:, 0] < factor.shared_count)
        shared = np.where(shared[given] == ABSENT, 0, shared[given])
        weights = -self.prior_pairs(self._prior_root_weights)[given] / factor.scale[shared]
        through = weights[:, :, None] * np.eye(2)
        yield UnitRows(observed + given[:, None], np.zeros((len(given), 1, 2, 0)), shared, through[:, None])

    def _append_priors(self, blocks: Blocks) -> Blocks:
        """Blocks with the priors of their own unknowns behind: a pair of rows each, of which the second is zero."""
        count, width = blocks.own.shape
        weights = self._prior_root_weights[self.numbering.free]
        rows = np.zeros((count, width, 2, blocks.matrix.shape[2]))
        rows[:, np.arange(width), 0, np.arange(width)] = -weights[blocks.own]
        matrix = np.concatenate([blocks.matrix, rows.reshape(count, 2 * width, blocks.matrix.shape[2])], axis=1)
        return replace(blocks, matrix=matrix)

    @property
    def _prior_root_weights(self) -> Array:
        """One over the standard deviation of every prior (n,), 0 where there is none."""
        unknowns = self.numbering.problem.unknowns
        return np.where(unknowns.has_prior, 1.0 / np.where(unknowns.has_prior, unknowns.sigma, 1.0), 0.0)

    def prior_pairs(self, values: Array) -> Array:
        """Values (n,) of unknowns as (m, 2) of the priors that are tested, 0 for what is absent."""
        return np.append(values, 0.0)[self.units.positions]
