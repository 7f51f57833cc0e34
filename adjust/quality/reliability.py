"""Inner and outer reliability (Baarda), and data snooping: detection of gross errors in observations and given values.

Redundancy numbers, test statistics, smallest detectable errors and their effect. The tests are those of a run in unit
weight, see `adjust.quality.run`.

Gross errors are found one after the other, the largest first, each tested without those found before; all of these are
then tested again without the later ones, so that two errors neither mask each other nor make good observations suspect
(Baarda's data snooping with forward and backward steps). The linear model of one adjustment suffices: its residuals T v
and cofactor matrix V = I - T B C_xx B' T', in unit weight, give the residuals without any subset of observations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from adjust.array_types import Array, Indices, Mask
from adjust.linear_algebra.small_matrices import applied, eigen, product
from adjust.problem.estimates import VarianceFactor
from adjust.problem.parameter import Parameter
from adjust.quality.critical_values import Probabilities, Tested, robust_scale
from adjust.quality.run import UNCHECKED, GrossError, Run, surplus

UNCONTROLLED = 1e-4  # redundancy number below which only errors of hundreds of standard deviations are detectable
DECISIVE = 7.0  # difference of two statistics that decides between explanations: odds of 30 to 1
ALIKE_SHOWN = 3  # observations named with a suspect that residuals do not tell from it
AT_ONCE = 20  # columns of V computed in one pass
MOST_SUSPECT = 0.25  # largest fraction of gross errors; beyond it, right and wrong cannot be distinguished
MOST_AT_ONCE = 60  # gross errors in one adjustment; the next one continues
MANY = 500  # image points whose median is robust against some gross errors
RAISED = 1.02  # least ratio of a scale that counts as larger


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
    outer: tuple[OuterEffect, ...]
    unchecked: tuple[str, ...]

    def __repr__(self) -> str:
        worst = np.abs(self.w).max(initial=0.0)
        return f"Reliability({len(self.tested)} tested, largest w {worst:.3g}, {len(self.unchecked)} unchecked)"


def reliability(run: Run, variance: VarianceFactor, probabilities: Probabilities) -> Reliability:
    """Compute the reliability of all observations and given quantities."""
    units, found, tests, own_weights = run.units, run.misfits, run.statistics, run.own_weights
    tested, shift = units.named(), probabilities.noncentrality(1)
    weights, sigma0 = np.einsum("nii->ni", tests.discrepancy_weight), variance.sigma0
    smallest = _over(shift, weights, tests.checked)
    hidden = (found.transform * product(found.hat, found.transform)).sum(axis=1)
    effect = np.where(tests.checked, np.where(tests.checked, smallest, 0.0) * np.sqrt(hidden), np.inf)
    effect[(units.sizes == 1), 1] = 0.0
    controlled = weights > UNCONTROLLED * own_weights
    uncontrolled = zip(*np.nonzero(~controlled & (np.arange(2) < units.sizes[:, None])), strict=True)
    return Reliability(
        probabilities=probabilities,
        tested=tested,
        v=applied(found.back, found.residual),
        sigma=np.sqrt((found.back**2).sum(axis=2)) * np.sqrt(run.weighting.weights)[:, None],
        redundancy=run.redundancies,
        w=tests.w,
        tau=tests.w / sigma0 if sigma0 > 0.0 else np.zeros_like(tests.w),
        critical_tau=probabilities.critical_tau(round(variance.redundancy)),
        smallest=smallest,
        effect=effect,
        statistic=tests.statistic,
        sizes=tests.sizes,
        outer=_outer_effects(run, np.where(controlled, smallest, 0.0), tested, shift),
        unchecked=tuple(tested[i].coordinate_name(axis) for i, axis in uncontrolled),
    )


def _over(shift: float, variance: Array, checked: Mask) -> Array:
    is_checked = checked & (variance > 0.0)  # rounding may leave the smaller of two eigenvalues below zero
    return np.where(is_checked, shift / np.sqrt(np.where(is_checked, variance, 1.0)), np.inf)


def _outer_effects(run: Run, errors: Array, tested: tuple[Tested, ...], shift: float) -> tuple[OuterEffect, ...]:
    """Largest effect of single errors on every free camera parameter."""
    # The errors are those of units (N, 2), and those of further observations that shift their test by `shift`:
    # dx = C_xx B' T' T h times the error.
    numbering, unknowns = run.numbering, run.numbering.problem.unknowns
    cameras = np.unique(np.concatenate([*unknowns.camera.values(), *unknowns.fiducial.values()]).astype(np.intp))
    cameras = cameras[unknowns.sigma[cameras] > 0.0]
    of_cameras = np.zeros((len(numbering.free), len(cameras)))
    of_cameras[numbering.numbers[cameras], np.arange(len(cameras))] = 1.0
    cofactor = run.factor.cofactor_times(of_cameras)
    by_units = (run.unit_functions @ cofactor).reshape(len(tested), 2, len(cameras))
    turned = run.misfits.transform * errors[:, None, :]
    effects = [-(turned.swapaxes(1, 2) @ by_units).reshape(2 * len(tested), -1)]
    names = list[str]()
    for each, block in zip(numbering.problem.further, run.end.rows.further, strict=True):
        inward = np.linalg.inv(np.linalg.cholesky(each.covariance))
        variance = np.diag(inward.T @ surplus(block, run.factor) @ inward)
        controlled = variance > UNCONTROLLED * (inward**2).sum(axis=0)
        own_errors = np.where(controlled, _over(shift, variance, controlled), 0.0)
        effects.append(own_errors[:, None] * (inward.T @ (block.matrix[0] @ cofactor[block.shared[0]])))
        names += [f"{each.group} {label}" for label in each.labels]
    together = np.concatenate(effects)
    found = []
    for k, position in enumerate(cameras):
        worst = int(np.abs(together[:, k]).argmax())
        effect, beyond = float(together[worst, k]), worst - 2 * len(tested)
        cause = names[beyond] if beyond >= 0 else tested[worst // 2].coordinate_name(worst % 2)
        in_sigmas = abs(effect) / float(np.sqrt(cofactor[numbering.numbers[position], k]))
        found.append(OuterEffect(unknowns.parameters[position], effect, in_sigmas, cause if effect else ""))
    return tuple(found)


@dataclass(frozen=True)
class Suspect:
    """A suspected gross error in an observation or given quantity, tested without the other suspects.

    Attributes
    ----------
    size : number of coordinates tested together.
    statistic : chi-square with `size` degrees of freedom.
    critical : critical value at the family-wise level `Probabilities.family`.
    w, tau, critical_tau : of its worst coordinate in the adjustment as it stands.
    error : estimated gross error by coordinate, in mm, object units or rad.
    alike : units that could be wrong in its place.
    removed : whether the adjustment rejects it.
    """

    tested: Tested
    size: int
    statistic: float
    critical: float
    w: float
    tau: float
    critical_tau: float
    error: tuple[float, ...]
    alike: tuple[str, ...]
    removed: bool


class Snooping:
    """Search for gross errors in one adjustment.

    Columns of V are computed on demand, many at a time, since each pass goes over all blocks.
    """

    def __init__(self, run: Run, probabilities: Probabilities) -> None:
        self.run, self.probabilities = run, probabilities
        self._columns: dict[int, Array] = {}

    @cached_property
    def critical(self) -> Array:
        """(N,) critical values of the statistics; inf for untested units, and for principal distances wrong by more
        than themselves."""
        # Over flat ground v'Pv hardly depends on the principal distance. Its small slope may come from elsewhere, such
        # as errors of given heights, and looks like a gross error of metres in the linear model.
        run, tests, observed = self.run, self.run.statistics, len(self.run.end.v_mm)
        positions, is_tested = run.units.positions[:, 0], tests.sizes > 0
        is_distance = np.isin(positions, [some[0] for some in run.problem.unknowns.camera.values()])
        errors = np.abs(tests.error[observed:, 0])
        is_possible = np.ones(len(tests.sizes), dtype=bool)
        is_possible[observed:] = ~(is_distance & (errors > np.abs(run.end.state.values[positions])))
        critical = self.probabilities.critical(tests.sizes, int(is_tested.sum()))
        return np.where(is_tested & is_possible, critical, np.inf)

    @property
    def limits(self) -> Array:
        """(N,) limits of the statistics in an adjustment without the gross errors."""
        return np.asarray(self._significant_scale([]) ** 2 * self.critical)

    @cached_property
    def contradictions(self) -> list[GrossError]:
        """Gross errors in the order in which they were found.

        Where all observations are less precise than given, the limits are raised by their scale. The scale is estimated
        without the gross errors, since in a small network one of them affects all residuals.
        """
        most = min(int(MOST_SUSPECT * len(self.critical)), MOST_AT_ONCE)
        scale = self._median_scale([]) if len(self.run.end.v_mm) > MANY else 1.0
        while True:
            limits = scale**2 * self.critical
            chosen = self._chosen(limits, most)
            # If there may be more gross errors, the sum of squares would include them: use the median.
            learnt = self._significant_scale(chosen) if len(chosen) < most else self._median_scale(chosen)
            if learnt <= RAISED * scale:
                return [self._contradiction(chosen, unit, limits) for unit in chosen]
            scale = learnt

    def rest(self, units: Sequence[int]) -> tuple[float, float]:
        """v'Pv and redundancy of the adjustment without some units."""
        found = self.run.misfits
        residual, hat = found.residual, found.hat[self.run.weighting.used]
        vpv = float((residual**2).sum())
        redundancy = 2.0 * len(hat) - float(np.trace(hat, axis1=1, axis2=2).sum())
        if not units:
            return vpv, redundancy
        joint = self._joint_cofactor(units)
        explained = residual[units].ravel() @ _inverse(joint) @ residual[units].ravel()
        rank = int(np.linalg.matrix_rank(joint, tol=UNCHECKED, hermitian=True))
        return max(vpv - float(explained), 0.0), redundancy - rank

    def suspects(self, result: Reliability, redundancy: int) -> tuple[Suspect, ...]:
        """Gross errors and down-weighted units, with names, the worst first."""
        tests, weighting = self.run.statistics, self.run.weighting
        entries = {each.unit: each for each in self.contradictions}
        alike = {each.unit: each.alike for each in self.run.removed}
        limits = self.limits
        for unit in map(int, np.flatnonzero((weighting.weights < 1.0) & (tests.statistic > limits))):
            figures = float(tests.statistic[unit]), float(limits[unit]), tests.error[unit]
            entries[unit] = GrossError(unit, *figures, alike.get(unit, ()))
        critical_tau = self.probabilities.critical_tau(redundancy, int((tests.sizes > 0).sum()))
        found = []
        for each in sorted(entries.values(), key=lambda each: -each.statistic / each.limit):
            tested, worst = result.tested[each.unit], int(np.abs(result.w[each.unit]).argmax())
            suspect = Suspect(
                tested=tested,
                size=int(result.sizes[each.unit]),
                statistic=each.statistic,
                critical=each.limit,
                w=float(result.w[each.unit, worst]),
                tau=float(result.tau[each.unit, worst]),
                critical_tau=critical_tau,
                error=tuple(each.error[: len(tested.coordinates)].tolist()),
                alike=tuple(result.tested[other].name for other in each.alike[:ALIKE_SHOWN]),
                removed=not bool(weighting.used[each.unit]),
            )
            found.append(suspect)
        return tuple(found)

    def _significant_scale(self, units: Sequence[int]) -> float:
        """Root of v'Pv over redundancy without some units if it is significantly above 1, else 1."""
        vpv, redundancy = self.rest(units)
        is_random = redundancy < 1.0 or special.chdtrc(redundancy, vpv) > self.probabilities.family
        return 1.0 if is_random else float(np.sqrt(vpv / redundancy))

    def _median_scale(self, units: Sequence[int]) -> float:
        """Robust scale from the median of the other image points' statistics, at least 1."""
        points = np.setdiff1d(np.arange(len(self.run.end.v_mm)), units)
        sizes = np.where(np.isfinite(self.critical[points]), 2, 0)
        return max(1.0, robust_scale(self._reduced_statistics(units)[points], sizes))

    def _chosen(self, limits: Array, most: int) -> list[int]:
        chosen: list[int] = []
        for _ in range(2 * most):
            statistic = self._reduced_statistics(chosen)
            worst = int(np.argmax(statistic / limits))
            if statistic[worst] <= limits[worst] or len(chosen) == most:
                break
            chosen.append(worst)
            confirmed = self._joint_errors(chosen)[1] > limits[chosen]
            chosen = [unit for unit, still in zip(chosen, confirmed, strict=True) if still or unit == worst]
        return chosen

    def _contradiction(self, chosen: Sequence[int], unit: int, limits: Array) -> GrossError:
        errors, joint = self._joint_errors(chosen)
        at = chosen.index(unit)
        others = self._reduced_statistics([each for each in chosen if each != unit])
        near = np.flatnonzero((others > limits) & (others > joint[at] - DECISIVE))
        alike = sorted((int(other) for other in near if other != unit), key=lambda other: -others[other])
        error = self.run.misfits.back[unit] @ errors[at]
        return GrossError(unit, float(joint[at]), float(limits[unit]), error, tuple(alike))

    def _reduced_statistics(self, left_out: Sequence[int]) -> Array:
        """(N,) statistics without some units; 0 for these."""
        residual, cofactor = self.run.misfits.residual, np.eye(2) - self.run.misfits.hat
        if left_out:
            columns = self._cofactor_columns(left_out)
            through = columns @ _inverse(columns[left_out].reshape(2 * len(left_out), -1))
            residual = residual - through @ residual[left_out].ravel()
            cofactor = cofactor - through @ columns.transpose(0, 2, 1)
        variance, axes = eigen(cofactor)
        statistic = _square_sums(variance, applied(axes.transpose(0, 2, 1), residual))
        statistic[left_out] = 0.0
        return statistic

    def _joint_errors(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Joint estimate of the gross errors (k, 2) of all chosen units, in unit weight, and their statistics (k,)."""
        inverse = _inverse(self._joint_cofactor(chosen))
        errors = -(inverse @ self.run.misfits.residual[chosen].ravel()).reshape(-1, 2)
        own = inverse.reshape(len(chosen), 2, len(chosen), 2)
        variance, axes = np.linalg.eigh(np.einsum("kikj->kij", own))
        return errors, _square_sums(variance, (axes.transpose(0, 2, 1) @ errors[..., None])[..., 0])

    def _joint_cofactor(self, units: Sequence[int]) -> Array:
        """(2 k, 2 k) block of V of some units."""
        return self._cofactor_columns(units)[units].reshape(2 * len(units), -1)

    def _cofactor_columns(self, units: Sequence[int]) -> Array:
        """(N, 2, 2 k) columns of V of some units."""
        if any(unit not in self._columns for unit in units):
            # Those likely to be needed next are computed in the same pass.
            worst = np.argsort(-self.run.statistics.statistic / self.critical)[:AT_ONCE].tolist()
            new = [unit for unit in dict.fromkeys([*units, *worst]) if unit not in self._columns]
            functions, hat = self.run.unit_functions, self.run.misfits.hat
            rows = (2 * np.array(new)[:, None] + np.arange(2)).ravel()
            columns = -(functions @ self.run.factor.cofactor_times(functions[rows].T.toarray()))
            for k, unit in enumerate(new):
                self._columns[unit] = columns[:, 2 * k : 2 * k + 2].reshape(-1, 2, 2)
                self._columns[unit][unit] = np.eye(2) - hat[unit]
        nothing = np.zeros((len(self.critical), 2, 0))
        return np.concatenate([nothing, *(self._columns[unit] for unit in units)], axis=2)


def _square_sums(variance: Array, along: Array) -> Array:
    """(n,) sums of squares over variances (n, 2), without unchecked components."""
    visible = variance > UNCHECKED
    return np.asarray(np.where(visible, along**2 / np.where(visible, variance, 1.0), 0.0).sum(axis=1))


def _inverse(cofactor: Array) -> Array:
    """Pseudo-inverse without unchecked components."""
    variance, axes = np.linalg.eigh(cofactor)
    visible = variance > UNCHECKED
    return np.asarray((axes[:, visible] / variance[visible]) @ axes[:, visible].T)
