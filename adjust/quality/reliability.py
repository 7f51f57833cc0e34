"""Redundancy, test statistics, smallest detectable errors and their effect (Baarda's inner and outer reliability).

Everything that is tested is brought to unit weight: with C the covariance that the adjustment used, T'T = C^-1 and
H = T B C_xx B' T' (the hat matrix), its residuals T v have the cofactor matrix I - H. What it contradicts the others by
is d = -(I - H)^-1 T v, and the cofactor matrix of d is (I - H)^-1 = I + H (I - H)^-1: its own and that of the others'
prediction. Where the adjustment used a weight p times that given, its own is p I in the given weight.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from adjust.least_squares.iteration import Linearised
from adjust.least_squares.numbering import Numbering
from adjust.least_squares.rows import prior_differences
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.linear_algebra.small_matrices import applied, eigen, inverse, laid_out, product
from adjust.problem.further_observations import FurtherObservation
from adjust.problem.parameter import Parameter
from adjust.problem.probabilities import Probabilities
from adjust.problem.problem import ABSENT, Problem
from adjust.problem.tested import Tested, TestedUnits

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

Effects = tuple[Array, Callable[[int], str]]  # of errors on the cameras' parameters (k, c), and the errors' names

UNCHECKED = 1e-9  # an observation of a smaller redundancy is not checked by any other
UNCONTROLLED = 1e-4  # below this an error must be hundreds of standard deviations to show: counted apart


@dataclass(frozen=True)
class OuterEffect:
    """What the worst undetected error does to a camera parameter.

    effect: in the parameter's unit, of an error of the smallest detectable size in `cause`; in_sigmas: over the
    parameter's a-priori standard deviation.
    """

    parameter: Parameter
    effect: float
    in_sigmas: float
    cause: str


@dataclass(frozen=True, repr=False)
class Reliability:
    """How well the observations check each other: one row for everything that is tested.

    All (N, 2) by coordinate; a quantity of one coordinate has zeros in the place of a second, and inf for errors. With
    C the covariance given, Q_v the cofactor matrix of v, P the inverse of C, h one coordinate:
    v: adjusted less given, sigma: the a-priori standard deviation, in mm, object units or rad. redundancy: diagonal of
    Q_v P, with the weights that were used. w: h'P v / root(h'P Q_v P h), v / sigma_v where P is diagonal; 0 where
    nothing checks the coordinate. tau: w / sigma0. smallest: the gross error that the test of the coordinate detects
    with the probability `power`, delta0 / root(h'P Q_v P h); inf where nothing checks it. effect: how far an undetected
    one moves any function of the unknowns at most, in its standard deviations. (Baarda's inner and outer reliability.)
    statistic (N,): v'P (P Q_v P)^- P v of all coordinates together, chi-square of `sizes` (N,); smallest_together (N,):
    the gross error of a pair in its least favourable direction.
    An observation that has lost weight is tested as it was given, against all the others with the weights that these
    have left.
    outer: one entry a free camera parameter; unchecked: what no other observation checks, left out there.
    """

    probabilities: Probabilities
    tested: tuple[Tested, ...]
    v: Array
    sigma: Array
    redundancy: Array
    w: Array
    tau: Array
    critical_tau: float
    smallest: Array
    effect: Array
    statistic: Array
    sizes: NDArray[np.intp]
    smallest_together: Array
    outer: tuple[OuterEffect, ...]
    unchecked: tuple[str, ...]

    def __repr__(self) -> str:
        worst = np.abs(self.w).max(initial=0.0)
        return f"Reliability({len(self.tested)} tested, largest w {worst:.3g}, {len(self.unchecked)} unchecked)"


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
class Misfits:
    """All that is tested, in unit weight: T, H (N, 2, 2), T v (N, 2); behind a single coordinate H is 1, T and v 0.

    back (N, 2, 2): from unit weight to the coordinates, the inverse of T where that is regular.
    """

    transform: Array
    back: Array
    hat: Array
    residual: Array


def misfits(numbering: Numbering, end: Linearised, factor: Factor) -> Misfits:
    """Residuals and hat matrices of everything that is tested."""
    units = TestedUnits(numbering.problem)
    transform, back = _transforms(numbering.problem, end, units)
    hat = np.zeros((len(units) + 1, 2, 2))  # the last stands for ABSENT
    for rows in unit_rows(numbering, end, factor):
        roots = np.concatenate([rows.own, rows.through @ factor.triangle.group_roots(rows.shared)[:, None]], axis=3)
        hat[rows.units] = roots @ roots.swapaxes(2, 3)
    hat = hat[:-1]
    hat[units.sizes == 1, 1, 1] = 1.0
    v = np.zeros((len(units), 2))
    v[: len(end.v_mm)] = end.v_mm
    v[len(end.v_mm) :] = -_prior_pairs(units, prior_differences(numbering.problem, end.state))
    transform, hat = laid_out(transform), laid_out(hat)
    return Misfits(transform, laid_out(back), hat, applied(transform, laid_out(v)))


def unit_rows(numbering: Numbering, end: Linearised, factor: Factor) -> Iterator[UnitRows]:
    """The rows of everything that is tested: block by block, its own unknowns' priors behind; then the shared ones'."""
    units = TestedUnits(numbering.problem)
    unit_of = _prior_units(numbering, units)
    touched = numbering.touched
    with_priors = (_append_priors(numbering, block) if i < len(touched) else block for i, block in enumerate(end.rows))
    for block, rows in zip(touched, factor.reduced_rows(with_priors), strict=False):  # behind: further observations
        own_units = np.concatenate([block.rows, unit_of[block.own]], axis=1)
        pairs = (*own_units.shape, 2)
        own = rows.own.reshape(*pairs, rows.own.shape[2])
        yield UnitRows(own_units, own, rows.shared, rows.through.reshape(*pairs, rows.through.shape[2]))
    shared = numbering.numbers[units.positions]
    given = np.flatnonzero(shared[:, 0] < factor.shared_count)
    shared = np.where(shared[given] == ABSENT, 0, shared[given])
    weights = -_prior_pairs(units, _prior_root_weights(numbering.problem))[given] / factor.scale[shared]
    through = weights[:, :, None] * np.eye(2)
    nothing = np.zeros((len(given), 1, 2, 0))
    yield UnitRows(len(end.v_mm) + given[:, None], nothing, shared, through[:, None])


def _prior_units(numbering: Numbering, units: TestedUnits) -> Indices:
    """(f,) the unit that tests the prior of a free unknown alone, ABSENT where there is none."""
    unit_of = np.full(len(numbering.free), ABSENT, dtype=np.intp)
    alone = np.flatnonzero(units.positions[:, 1] == ABSENT)
    observed = len(units) - len(units.positions)
    unit_of[numbering.numbers[units.positions[alone, 0]]] = observed + alone
    return unit_of


def _append_priors(numbering: Numbering, blocks: Blocks) -> Blocks:
    """Blocks with the priors of their own unknowns behind: a pair of rows each, of which the second is zero."""
    count, width = blocks.own.shape
    weights = _prior_root_weights(numbering.problem)[numbering.free]
    rows = np.zeros((count, width, 2, blocks.matrix.shape[2]))
    rows[:, np.arange(width), 0, np.arange(width)] = -weights[blocks.own]
    matrix = np.concatenate([blocks.matrix, rows.reshape(count, 2 * width, blocks.matrix.shape[2])], axis=1)
    return replace(blocks, matrix=matrix)


def _prior_root_weights(problem: Problem) -> Array:
    """One over the standard deviation of every prior (n,), 0 where there is none."""
    unknowns = problem.unknowns
    return np.where(unknowns.has_prior, 1.0 / np.where(unknowns.has_prior, unknowns.sigma, 1.0), 0.0)


def _prior_pairs(units: TestedUnits, values: Array) -> Array:
    """Values (n,) of unknowns as (m, 2) of the priors that are tested, 0 for what is absent."""
    return np.append(values, 0.0)[units.positions]


def _transforms(problem: Problem, end: Linearised, units: TestedUnits) -> tuple[Array, Array]:
    """T and what leads back (N, 2, 2); of a prior both are diagonal."""
    transform, back = np.zeros((2, len(units), 2, 2))
    count, root, a = len(end.v_mm), end.rows.root, end.by_observation
    transform[:count], back[:count] = product(inverse(root), a), product(inverse(a), root)
    weights = _prior_pairs(units, _prior_root_weights(problem))
    transform[count:, [0, 1], [0, 1]] = weights
    back[count:, [0, 1], [0, 1]] = np.where(weights > 0.0, 1.0 / np.where(weights > 0.0, weights, 1.0), 0.0)
    return transform, back


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
    checked: NDArray[np.bool_]


def statistics(misfits: Misfits, weights: Array) -> Statistics:
    """The test statistics of all units, weights (N,) the parts of the given weights that the adjustment used."""
    adjusted, axes = eigen(misfits.hat)
    free = np.clip(1.0 - adjusted, 0.0, None)
    of_given = weights[:, None] * free + adjusted
    along = applied(axes.transpose(0, 2, 1), misfits.residual)
    visible = free > UNCHECKED
    squares = np.where(visible, along**2 / np.where(visible, free * of_given, 1.0), 0.0)
    inward = product(misfits.transform.transpose(0, 2, 1), axes)
    weight = product(inward * (free / of_given)[:, None, :], inward.transpose(0, 2, 1))
    pull = applied(inward, along / of_given)
    own_weight = (misfits.transform**2).sum(axis=1) / weights[:, None]
    variance = np.einsum("nii->ni", weight)
    checked = variance > UNCHECKED * own_weight
    w = np.where(checked, pull / np.sqrt(np.where(checked, variance, 1.0)), 0.0)
    contradiction = applied(axes, np.where(visible, -along / np.where(visible, free, 1.0), 0.0))
    error = applied(misfits.back, contradiction)
    return Statistics(w, squares.sum(axis=1), visible.sum(axis=1), weight, error, checked)


def redundancies(misfits: Misfits) -> Array:
    """The diagonal (N, 2) of Q_v P; its sum is the redundancy of the adjustment."""
    free = product(misfits.back, np.eye(2) - misfits.hat)
    return np.asarray((free * misfits.transform.transpose(0, 2, 1)).sum(axis=2))


def reliability(
    numbering: Numbering,
    end: Linearised,
    factor: Factor,
    found: Misfits,
    weights: Array,
    sigma0: float,
    redundancy: int,
    probabilities: Probabilities,
) -> Reliability:
    """Tests of all observations and given quantities, and what they would not show."""
    units = TestedUnits(numbering.problem)
    tested = units.named()
    tests = statistics(found, weights)
    variance = np.einsum("nii->ni", tests.discrepancy_weight)
    smallest = _over(probabilities.noncentrality(1), variance, tests.checked)
    hidden = (found.transform * product(found.hat, found.transform)).sum(axis=1)
    effect = np.where(tests.checked, np.where(tests.checked, smallest, 0.0) * np.sqrt(hidden), np.inf)
    effect[(units.sizes == 1), 1] = 0.0
    least = eigen(tests.discrepancy_weight)[0][:, 0]
    own_weight = (found.transform**2).sum(axis=1) / weights[:, None]
    both = np.asarray(tests.checked.all(axis=1))
    everywhere = both & (least > UNCHECKED * own_weight.min(axis=1))
    together = np.where(both, _over(probabilities.noncentrality(2), least, everywhere), smallest.min(axis=1))
    controlled = variance > UNCONTROLLED * own_weight
    shift = probabilities.noncentrality(1)
    errors = np.where(controlled, smallest, 0.0)
    outer = _outer(numbering, end, factor, found, errors, tested, shift)
    uncontrolled = zip(*np.nonzero(~controlled & (np.arange(2) < units.sizes[:, None])), strict=True)
    return Reliability(
        probabilities=probabilities,
        tested=tested,
        v=applied(found.back, found.residual),
        sigma=np.sqrt((found.back**2).sum(axis=2)) * np.sqrt(weights)[:, None],
        redundancy=redundancies(found),
        w=tests.w,
        tau=tests.w / sigma0 if sigma0 > 0.0 else np.zeros_like(tests.w),
        critical_tau=probabilities.critical_tau(redundancy),
        smallest=smallest,
        effect=effect,
        statistic=tests.statistic,
        sizes=tests.sizes,
        smallest_together=together,
        outer=outer,
        unchecked=tuple(tested[i].coordinate_name(axis) for i, axis in uncontrolled),
    )


def _over(shift: float, variance: Array, checked: NDArray[np.bool_]) -> Array:
    is_checked = checked & (variance > 0.0)  # rounding may leave the smaller of two eigenvalues below zero
    return np.where(is_checked, shift / np.sqrt(np.where(is_checked, variance, 1.0)), np.inf)


def _outer(
    numbering: Numbering,
    end: Linearised,
    factor: Factor,
    found: Misfits,
    errors: Array,
    tested: tuple[Tested, ...],
    shift: float,
) -> tuple[OuterEffect, ...]:
    """The largest effect of any of the errors (N, 2), one at a time, on every free camera parameter.

    And of any error in a further observation that shifts its test by `shift`.
    """
    unknowns = numbering.problem.unknowns
    cameras = np.concatenate([*unknowns.camera.values(), *unknowns.fiducial.values()]).astype(np.intp)
    free = numbering.free[: factor.shared_count]
    members = np.flatnonzero(np.isin(free, cameras))
    of_cameras = np.zeros((factor.shared_count, len(members)))
    of_cameras[members, np.arange(len(members))] = 1.0 / factor.scale[members]
    by_shared = factor.triangle.cofactor_times(of_cameras)
    largest = np.zeros(len(members))
    causes = np.full(len(members), "", dtype=object)
    of_units = _unit_effects(numbering, end, factor, found, errors, by_shared, tested)
    for effects, name_of in (*of_units, *_further_effects(numbering, end, factor, by_shared, shift)):
        if len(effects) == 0:
            continue
        worst = np.abs(effects).argmax(axis=0)
        values = effects[worst, np.arange(len(members))]
        for i in np.flatnonzero(np.abs(values) > np.abs(largest)):
            largest[i], causes[i] = values[i], name_of(int(worst[i]))
    sigma = np.sqrt((of_cameras * by_shared).sum(axis=0))
    return tuple(
        OuterEffect(
            unknowns.parameters[free[members[i]]], float(largest[i]), float(abs(largest[i]) / sigma[i]), causes[i]
        )
        for i in np.argsort(free[members])
    )


def _unit_effects(
    numbering: Numbering,
    end: Linearised,
    factor: Factor,
    found: Misfits,
    errors: Array,
    by_shared: Array,
    tested: tuple[Tested, ...],
) -> Iterator[Effects]:
    """dx = C_xx B' T' T h times the error; what a block has for itself is not correlated with the cameras."""
    turned = np.append(found.transform * errors[:, None, :], np.zeros((1, 2, 2)), axis=0)  # the last is of ABSENT
    for rows in unit_rows(numbering, end, factor):
        moved = rows.through @ by_shared[rows.shared][:, None]
        effects = -(turned[rows.units].swapaxes(2, 3) @ moved).reshape(2 * rows.units.size, by_shared.shape[1])
        units = rows.units.ravel()
        yield effects, partial(_unit_name, tested, units)


def _unit_name(tested: tuple[Tested, ...], units: Indices, row: int) -> str:
    return tested[int(units[row // 2])].coordinate_name(row % 2)


def _further_effects(
    numbering: Numbering, end: Linearised, factor: Factor, by_shared: Array, shift: float
) -> Iterator[Effects]:
    """The same of further observations, whose whitened rows are L^-1 J: dx = C_xx J' L^-T L^-1 h times the error."""
    for each, block in zip(numbering.problem.further, end.rows.further, strict=True):
        inward = np.linalg.inv(np.linalg.cholesky(each.covariance))
        through = block.matrix[0] / factor.scale[block.shared[0]]
        roots = through @ factor.triangle.group_roots(block.shared)[0]
        variance = np.diag(inward.T @ (np.eye(len(roots)) - roots @ roots.T) @ inward)
        controlled = variance > UNCONTROLLED * (inward**2).sum(axis=0)
        errors = np.where(controlled, _over(shift, variance, controlled), 0.0)
        effects = errors[:, None] * (inward.T @ (through @ by_shared[block.shared[0]]))
        yield effects, partial(_further_name, each)


def _further_name(each: FurtherObservation, row: int) -> str:
    return f"{each.group} {each.labels[row]}"
