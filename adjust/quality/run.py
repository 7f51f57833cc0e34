"""One adjustment with given weights, with all tested units in unit weight; residuals and statistics of groups.

With C the covariance used, T'T = C^-1 and H = T B C_xx B' T' (hat matrix), the residuals T v have the cofactor matrix
I - H. The discrepancy between a unit and the prediction from the others is d = -(I - H)^-1 T v, with the cofactor
matrix (I - H)^-1 = I + H (I - H)^-1: its own plus that of the prediction. Where the adjustment used p times the given
weight, the unit's own part is p I in the given weight.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, vstack

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.least_squares.equations import Numbering, prior_differences
from adjust.least_squares.iteration import Linearised, Solution, linearise
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.linear_algebra.small_matrices import applied, eigen, inverse, laid_out, product
from adjust.problem.estimates import NullDirection
from adjust.problem.further_observations import square_sum
from adjust.problem.problem import ABSENT, Problem, State
from adjust.quality.critical_values import TestedUnits, Weighting
from adjust.rank_defect.diagnosis import pseudo_square_sum

UNCHECKED = 1e-9  # redundancy below which an observation is unchecked
NEARLY_ONE = 0.99  # least redundancy of a group with a sigma0 of its own


@dataclass(frozen=True)
class GrossError:
    """A gross error: a unit whose statistic exceeds its critical value, the other gross errors left out.

    error (2,): estimated gross error. alike: units that would explain the contradiction as well.
    """

    unit: int
    statistic: float
    limit: float
    error: Array
    alike: tuple[int, ...] = ()


@dataclass(frozen=True)
class Misfits:
    """Tested units in unit weight: T and H (N, 2, 2), T v (N, 2). For a missing second coordinate H is 1, T and v are
    0.

    back (N, 2, 2): from unit weight to the coordinates, the inverse of T where that is regular.
    """

    transform: Array
    back: Array
    hat: Array
    residual: Array


@dataclass(frozen=True)
class Statistics:
    """Test statistics of all units with their given weights, see `Reliability`.

    discrepancy_weight (N, 2, 2): P Q_v P, inverse of the cofactor matrix of the discrepancy between a unit and the
    others; error (N, 2): that discrepancy, the estimated gross error.
    """

    w: Array
    statistic: Array
    sizes: Indices
    discrepancy_weight: Array
    error: Array
    checked: Mask


@dataclass(frozen=True)
class Run:
    """One adjustment with given weights, and its end."""

    problem: Problem  # as given; `numbering` holds it with the weights applied to the priors
    weighting: Weighting
    solution: Solution
    singular: tuple[NullDirection, ...]  # null directions at the end, with or without a solution
    settled: bool = True  # whether reweighting has converged
    removed: tuple[GrossError, ...] = ()  # gross errors removed by data snooping

    @property
    def end(self) -> Linearised:
        return self.solution.end

    @property
    def numbering(self) -> Numbering:
        return self.end.rows.numbering

    @property
    def factor(self) -> Factor:
        """Square root of the normal equations at the end, with or without a solution."""
        return self.end.factor

    def linearised(
        self, problem: Problem, state: State | None = None, free: Indices | None = None
    ) -> Linearised | None:
        """Linearise another problem with the same weights, at its start by default; None if some point has no image.

        free: positions of quantities without their given values.
        """
        weighted, covariance = self.weighting.apply(problem)
        at = state or weighted.start()
        return linearise(Numbering(weighted if free is None else free_quantities(weighted, free)), covariance, at)

    @property
    def vpv(self) -> float:
        """v'Pv of all observations and given values, without pseudo-observations."""
        return self.end.vpv - pseudo_square_sum(self.problem, self.end.state)

    @property
    def converged(self) -> bool:
        return self.solution.termination == "converged"

    @property
    def has_solution(self) -> bool:
        """Whether the iteration ended with a solution; its system is regular."""
        return self.solution.factor is not None

    @property
    def is_tested(self) -> bool:
        """Whether the system is regular, so that residuals can be tested."""
        return not self.singular

    @cached_property
    def units(self) -> TestedUnits:
        return TestedUnits(self.problem)

    @cached_property
    def misfits(self) -> Misfits:
        """Residuals and hat matrices of all tested units."""
        units, factor, end, count = self.units, self.factor, self.end, len(self.end.v_mm)
        transform, back, hat = np.zeros((3, len(units), 2, 2))
        root, a = end.rows.root, end.by_observation
        transform[:count], back[:count] = product(inverse(root), a), product(inverse(a), root)
        for touched, rows in zip(self.numbering.touched, factor.reduced_rows(end.rows), strict=False):
            roots = np.concatenate([rows.own, rows.through @ factor.triangle.group_roots(rows.shared)], axis=2)
            roots = roots.reshape(*touched.rows.shape, 2, roots.shape[2])
            hat[touched.rows] = roots @ roots.swapaxes(2, 3)
        weights, given = self._prior_weights, np.arange(count, len(units))
        transform[count:, [0, 1], [0, 1]] = weights
        back[count:, [0, 1], [0, 1]] = np.where(weights > 0.0, 1.0 / np.where(weights > 0.0, weights, 1.0), 0.0)
        for size in (1, 2):
            some = units.sizes[count:] == size
            cofactors = factor.cofactors(self.numbering.numbers[units.positions[some, :size]])
            hat[given[some], :size, :size] = weights[some, :size, None] * cofactors * weights[some, None, :size]
        hat[units.sizes == 1, 1, 1] = 1.0
        v = np.concatenate([end.v_mm, -self._prior_pairs(prior_differences(self.numbering.problem, end.state))])
        transform, back, hat = map(laid_out, (transform, back, hat))
        return Misfits(transform, back, hat, applied(transform, laid_out(v)))

    @cached_property
    def statistics(self) -> Statistics:
        """Test statistics of all units."""
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
        """(N, 2) diagonal of the given P."""
        return np.asarray((self.misfits.transform**2).sum(axis=1) / self.weighting.weights[:, None])

    @property
    def redundancies(self) -> Array:
        """(N, 2) diagonal of Q_v P; its sum is the redundancy of the adjustment."""
        free = product(self.misfits.back, np.eye(2) - self.misfits.hat)
        return np.asarray((free * self.misfits.transform.transpose(0, 2, 1)).sum(axis=2))

    def group_sums(self, members: Mask) -> tuple[float, float]:
        """v'Pv and redundancy of some units."""
        vpv = float((self.misfits.residual[members] ** 2).sum())
        # A missing second coordinate has a 1 in the hat matrix and so adds no redundancy.
        return vpv, float(2 * members.sum() - np.trace(self.misfits.hat[members], axis1=1, axis2=2).sum())

    @cached_property
    def unit_functions(self) -> csr_array:
        """(2 N, n) rows T B of all tested units in the free unknowns; 0 for a missing second coordinate."""
        numbering, pairs = self.numbering, self.units.positions.ravel()
        given = np.flatnonzero(pairs != ABSENT)
        entries = -self._prior_weights.ravel()[given], (given, numbering.numbers[pairs[given]])
        priors = csr_array(entries, shape=(len(pairs), len(numbering.free)))
        return csr_array(vstack([linear_derivatives(numbering.problem, self.end.rows.matrix, numbering.free), priors]))

    @property
    def _prior_weights(self) -> Array:
        """(m, 2) inverse standard deviations of the tested priors, 0 where absent."""
        return self._prior_pairs(
            1.0 / np.where(self.problem.unknowns.has_prior, self.numbering.problem.unknowns.sigma, np.inf)
        )

    def _prior_pairs(self, values: Array) -> Array:
        """Arrange values (n,) of unknowns as the pairs (m, 2) of tested priors, 0 where absent."""
        return np.append(values, 0.0)[self.units.positions]


def free_quantities(problem: Problem, positions: Indices) -> Problem:
    """Drop the given values of some quantities of a problem."""
    sigma = problem.unknowns.sigma.copy()
    sigma[positions] = np.inf
    return replace(problem, unknowns=replace(problem.unknowns, sigma=sigma))


def linear_derivatives(problem: Problem, matrix: Array, positions: Indices, rows: Indices | None = None) -> csr_array:
    """(2 n, k) derivatives of all observations, or of some rows, by some quantities.

    matrix (n, 2, j): derivatives by the quantities at `Problem.columns`.
    """
    place = np.full(len(problem.unknowns) + 1, ABSENT, dtype=np.intp)
    place[positions] = np.arange(len(positions))
    column = place[problem.columns if rows is None else problem.columns[rows]]
    row, at = np.nonzero(column != ABSENT)
    values = matrix[row, :, at].ravel()
    entries = values, (np.stack([2 * row, 2 * row + 1], axis=1).ravel(), column[row, at].repeat(2))
    return csr_array(entries, shape=(2 * len(column), len(positions)))


@dataclass(frozen=True, repr=False)
class Residuals:
    """Residuals of the n observations of the network, in its order.

    v_mm (n, 2): adjusted minus observed comparator coordinates; redundancy (n, 2): redundancy numbers of x and y;
    w (n, 2): standardised residuals, v / sigma_v where the coordinates are uncorrelated (see `Reliability`).
    """

    v_mm: Array
    redundancy: Array
    w: Array

    def __repr__(self) -> str:
        rms_um = 1000.0 * np.sqrt(np.mean(np.square(self.v_mm), axis=0)) if len(self.v_mm) else np.zeros(2)
        return f"Residuals({len(self.v_mm)} of rms {rms_um[0]:.3g}, {rms_um[1]:.3g} µm)"


@dataclass(frozen=True)
class FurtherResidual:
    """Residual of a further observation, such as a distance, in its own unit.

    group, name: see `FurtherObservation`; v: adjusted minus observed; sigma: a-priori standard deviation; redundancy:
    redundancy number; w: v / sigma_v; detectable: smallest detectable error (Baarda), inf if unchecked.
    """

    group: str
    name: str
    observed: float
    v: float
    sigma: float
    redundancy: float
    w: float
    detectable: float


@dataclass(frozen=True)
class Group:
    """Statistics of a group of observations: sigma0 (root of v'Pv over redundancy), rms per axis, redundancy.

    sigma0 is 0, without meaning, where the redundancy is below 1. The rms is in µm for `target`, `fiducial`
    (comparator) and `datum` (given fiducial places, F5 and F6), in millionths of the object unit for `control`, and 0
    for groups of mixed units. `target`, `fiducial` and `control` always exist.
    """

    sigma0: float
    rms_x_um: float
    rms_y_um: float
    redundancy: float


def residuals(run: Run) -> Residuals:
    """Residuals with redundancy numbers and standardised residuals; the latter two are 0 without a solution."""
    v_mm = run.end.v_mm
    if not run.has_solution:
        return Residuals(v_mm, np.zeros_like(v_mm), np.zeros_like(v_mm))
    return Residuals(v_mm, run.redundancies[: len(v_mm)], run.statistics.w[: len(v_mm)])


def further_residuals(run: Run, noncentrality: float) -> Iterator[FurtherResidual]:
    """Residuals of further observations; unchecked without a solution.

    With C = L L' and H the cofactor matrix of the adjusted rows in unit weight, Q_vv = L (I - H) L'.
    """
    for each, block in zip(run.problem.further, run.end.rows.further, strict=True):
        v = each.computed(run.end.state.values) - each.observed
        root = np.linalg.cholesky(each.covariance)
        free = surplus(block, run.factor) if run.has_solution else np.zeros_like(root)
        cofactor_v = root @ free @ root.T
        weighted = np.linalg.inv(root).T @ free @ np.linalg.inv(root)
        redundancy = np.einsum("ij,ji->i", cofactor_v, np.linalg.inv(each.covariance))
        checked = redundancy > UNCHECKED
        w = np.where(checked, v / np.sqrt(np.where(checked, np.diag(cofactor_v), 1.0)), 0.0)
        smallest = np.where(checked, noncentrality / np.sqrt(np.where(checked, np.diag(weighted), 1.0)), np.inf)
        sigma = np.sqrt(np.diag(each.covariance))
        for row in zip(each.names, each.observed, v, sigma, redundancy, w, smallest, strict=True):
            yield FurtherResidual(each.group, row[0], *map(float, row[1:]))


def surplus(block: Blocks, factor: Factor) -> Array:
    """(m, m) matrix I - H of a block without own unknowns."""
    roots = (block.matrix / factor.scale[block.shared][:, None, :] @ factor.triangle.group_roots(block.shared))[0]
    return np.asarray(np.eye(len(roots)) - roots @ roots.T)


def groups(run: Run, further: Sequence[FurtherResidual]) -> dict[str, Group]:
    """Statistics by group: marks in the comparator (target, tie, fiducial, join), priors, and further observations.

    See `Group` for units. Rejected observations belong to no group.
    """
    problem, result = run.problem, {}
    for name in ("target", "tie", "fiducial", "join", "control", "datum", "interior", "scanner", "board", "exterior"):
        members = (run.units.groups == name) & run.weighting.used
        if not members.any() and name not in ("target", "fiducial", "control"):
            continue
        sums = run.group_sums(members) if run.has_solution else (0.0, 0.0)
        result[name] = _group(*sums, *_rms_um(run, name, members))
    for name in dict.fromkeys(each.group for each in problem.further):
        vpv = square_sum(tuple(each for each in problem.further if each.group == name), run.end.state.values)
        result[name] = _group(vpv, sum(each.redundancy for each in further if each.group == name), 0.0, 0.0)
    return result


def _group(vpv: float, redundancy: float, rms_x_um: float, rms_y_um: float) -> Group:
    sigma0 = float(np.sqrt(vpv / redundancy)) if redundancy > NEARLY_ONE else 0.0
    return Group(sigma0, rms_x_um, rms_y_um, redundancy)


def _rms_um(run: Run, group: str, members: Mask) -> tuple[float, float]:
    """Rms of a group by axis, in µm or in millionths of the object unit; 0 for mixed units."""
    problem, v_mm = run.problem, run.end.v_mm
    if group in problem.network.observations.kind or group in ("target", "fiducial"):
        v_um = UM_PER_MM * v_mm[members[: len(v_mm)]]
        return _rms(v_um[:, 0]), _rms(v_um[:, 1])
    if group not in ("control", "datum"):
        return 0.0, 0.0
    given = run.units.positions[members[len(v_mm) :]].ravel()
    given = given[given != ABSENT]
    quantities = np.array([problem.unknowns.parameters[i].quantity for i in given], dtype=np.str_)
    v = (1e6 if group == "control" else UM_PER_MM) * prior_differences(problem, run.end.state)[given]
    x, y = ("X", "Y") if group == "control" else ("x", "y")
    return _rms(v[quantities == x]), _rms(v[quantities == y])


def _rms(v: Array) -> float:
    return float(np.sqrt(np.mean(v**2))) if len(v) else 0.0
