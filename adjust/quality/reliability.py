"""Inner and outer reliability (Baarda): redundancy numbers, test statistics, smallest detectable errors, their effect.

The tests are those of a run in unit weight, see `adjust.quality.run`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.linear_algebra.small_matrices import applied, eigen, product
from adjust.problem.parameter import Parameter
from adjust.problem.tested import Probabilities, Tested
from adjust.quality.run import UNCHECKED, Run

Effects = tuple[Array, Callable[[int], str]]  # effects (k, c) of errors on the cameras' parameters, and their names

UNCONTROLLED = 1e-4  # redundancy number below which only errors of hundreds of standard deviations are detectable


@dataclass(frozen=True)
class OuterEffect:
    """Largest effect of an undetected error on a camera parameter (outer reliability).

    effect: of a smallest detectable error in `cause`, in the parameter's unit; in_sigmas: in a-priori standard
    deviations of the parameter.
    """

    parameter: Parameter
    effect: float
    in_sigmas: float
    cause: str


@dataclass(frozen=True, repr=False)
class Reliability:
    """Inner and outer reliability of all N tested units (Baarda).

    Arrays (N, 2) are by coordinate; the missing second coordinate of a single quantity is 0, or inf for errors. With C
    the given covariance, P its inverse, Q_v the cofactor matrix of v, and h the unit vector of a coordinate:

    Attributes
    ----------
    v : (N, 2) adjusted minus given, in mm, object units or rad.
    sigma : (N, 2) a-priori standard deviation.
    redundancy : (N, 2) diagonal of Q_v P, with the weights used.
    w : (N, 2) h'P v / root(h'P Q_v P h), that is v / sigma_v where P is diagonal; 0 for an unchecked coordinate.
    tau : (N, 2) w / sigma0.
    smallest : (N, 2) smallest error detectable with the probability `power`, delta0 / root(h'P Q_v P h); inf if
        unchecked.
    effect : (N, 2) largest effect of an undetected error on any function of the unknowns, in its standard deviations.
    statistic : (N,) v'P (P Q_v P)^- P v of all coordinates together, chi-square with `sizes` degrees of freedom.
    sizes : (N,) number of tested coordinates.
    smallest_together : (N,) smallest detectable error of a pair in its least favourable direction.
    outer : one entry for each free camera parameter.
    unchecked : coordinates without redundancy, which `outer` leaves out.

    Notes
    -----
    A down-weighted observation is tested with its given weight, against the others with their used weights.
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
    sizes: Indices
    smallest_together: Array
    outer: tuple[OuterEffect, ...]
    unchecked: tuple[str, ...]

    def __repr__(self) -> str:
        worst = np.abs(self.w).max(initial=0.0)
        return f"Reliability({len(self.tested)} tested, largest w {worst:.3g}, {len(self.unchecked)} unchecked)"


def reliability(run: Run, sigma0: float, redundancy: int, probabilities: Probabilities) -> Reliability:
    """Compute the reliability of all observations and given quantities."""
    units, found, tests, own_weights = run.units, run.misfits, run.statistics, run.own_weights
    tested, shift = units.named(), probabilities.noncentrality(1)
    variance = np.einsum("nii->ni", tests.discrepancy_weight)
    smallest = _over(shift, variance, tests.checked)
    hidden = (found.transform * product(found.hat, found.transform)).sum(axis=1)
    effect = np.where(tests.checked, np.where(tests.checked, smallest, 0.0) * np.sqrt(hidden), np.inf)
    effect[(units.sizes == 1), 1] = 0.0
    least = eigen(tests.discrepancy_weight)[0][:, 0]
    both = np.asarray(tests.checked.all(axis=1))
    everywhere = both & (least > UNCHECKED * own_weights.min(axis=1))
    together = np.where(both, _over(probabilities.noncentrality(2), least, everywhere), smallest.min(axis=1))
    controlled = variance > UNCONTROLLED * own_weights
    uncontrolled = zip(*np.nonzero(~controlled & (np.arange(2) < units.sizes[:, None])), strict=True)
    return Reliability(
        probabilities=probabilities,
        tested=tested,
        v=applied(found.back, found.residual),
        sigma=np.sqrt((found.back**2).sum(axis=2)) * np.sqrt(run.weighting.weights)[:, None],
        redundancy=run.redundancies,
        w=tests.w,
        tau=tests.w / sigma0 if sigma0 > 0.0 else np.zeros_like(tests.w),
        critical_tau=probabilities.critical_tau(redundancy),
        smallest=smallest,
        effect=effect,
        statistic=tests.statistic,
        sizes=tests.sizes,
        smallest_together=together,
        outer=_outer_effects(run, np.where(controlled, smallest, 0.0), tested, shift),
        unchecked=tuple(tested[i].coordinate_name(axis) for i, axis in uncontrolled),
    )


def _over(shift: float, variance: Array, checked: Mask) -> Array:
    is_checked = checked & (variance > 0.0)  # rounding may leave the smaller of two eigenvalues below zero
    return np.where(is_checked, shift / np.sqrt(np.where(is_checked, variance, 1.0)), np.inf)


def _outer_effects(run: Run, errors: Array, tested: tuple[Tested, ...], shift: float) -> tuple[OuterEffect, ...]:
    """Largest effect of single errors on every free camera parameter."""
    # The errors are those of units (N, 2), and those of further observations that shift their test by `shift`.
    unknowns, factor = run.numbering.problem.unknowns, run.factor
    cameras = np.concatenate([*unknowns.camera.values(), *unknowns.fiducial.values()]).astype(np.intp)
    free = run.numbering.free[: factor.shared_count]
    members = np.flatnonzero(np.isin(free, cameras))
    of_cameras = np.zeros((factor.shared_count, len(members)))
    of_cameras[members, np.arange(len(members))] = 1.0 / factor.scale[members]
    by_shared = factor.triangle.cofactor_times(of_cameras)
    largest = np.zeros(len(members))
    causes = np.full(len(members), "", dtype=object)
    for effects, name_of in (*_unit_effects(run, errors, by_shared, tested), *_further_effects(run, by_shared, shift)):
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


def _unit_effects(run: Run, errors: Array, by_shared: Array, tested: tuple[Tested, ...]) -> Iterator[Effects]:
    """dx = C_xx B' T' T h times the error; the own unknowns of a block are eliminated."""
    turned = np.append(run.misfits.transform * errors[:, None, :], np.zeros((1, 2, 2)), axis=0)  # last is of ABSENT
    for rows in run.unit_rows():
        units: Indices = rows.units.ravel()

        def unit_name(row: int, units: Indices = units) -> str:
            return tested[int(units[row // 2])].coordinate_name(row % 2)

        moved = rows.through @ by_shared[rows.shared][:, None]
        yield -(turned[rows.units].swapaxes(2, 3) @ moved).reshape(2 * len(units), by_shared.shape[1]), unit_name


def _further_effects(run: Run, by_shared: Array, shift: float) -> Iterator[Effects]:
    """Effects of errors in further observations with whitened rows L^-1 J: dx = C_xx J' L^-T L^-1 h times the error."""
    for each, block in zip(run.numbering.problem.further, run.end.rows.further, strict=True):
        inward = np.linalg.inv(np.linalg.cholesky(each.covariance))
        through = block.matrix[0] / run.factor.scale[block.shared[0]]
        roots = through @ run.factor.triangle.group_roots(block.shared)[0]
        variance = np.diag(inward.T @ (np.eye(len(roots)) - roots @ roots.T) @ inward)
        controlled = variance > UNCONTROLLED * (inward**2).sum(axis=0)
        errors = np.where(controlled, _over(shift, variance, controlled), 0.0)
        names = [f"{each.group} {label}" for label in each.labels]
        yield errors[:, None] * (inward.T @ (through @ by_shared[block.shared[0]])), names.__getitem__
