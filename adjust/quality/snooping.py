"""Data snooping: which observations and given quantities contradict the others.

One after the other, the worst first, each tested as if those before it were not there; and every one of these anew as
if the later ones were not there, so that two errors neither hide each other nor make good observations suspect. This is
done in the linear model of one adjustment, whose residuals T v and cofactor matrix V = I - T B C_xx B' T', all of unit
weight, tell what any of them would be without some of the observations (Baarda's data snooping, with the forward and
backward steps of a regression).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from adjust.array_types import Array, Mask
from adjust.linear_algebra.small_matrices import applied, eigen
from adjust.problem.probabilities import Probabilities
from adjust.problem.tested import Tested
from adjust.quality.reliability import Reliability
from adjust.quality.run import UNCHECKED, GrossError, Run
from adjust.quality.weighting import robust_scale

TOLD_APART = 7.0  # difference of two statistics from which on one explanation is clearly the better: odds of 30 to 1
ALIKE_SHOWN = 3
PAIRED = 300  # units among which pairs are looked for that hide each other
MOST_PAIRED = 2000  # what is tested in a network where they are looked for at all
AT_ONCE = 20  # columns of the residuals' cofactor matrix that are made in one pass
MOST_SUSPECT = 0.25  # part of all that is tested: where more contradicts the rest, who is to say which
MOST_AT_ONCE = 60  # in one adjustment; the next one goes on
MANY = 500  # image points: the median of so many is not moved by some gross errors
RAISED = 1.02  # a scale that is larger by less is no other


@dataclass(frozen=True)
class Suspect:
    """An observation or given quantity that contradicts the others beyond chance, given the other suspects left out.

    size: its coordinates that were tested together; statistic: chi-square with so many degrees of freedom; critical:
    what chance reaches in 1 of 100 adjustments (`Probabilities.family`). w, tau: of its worst coordinate in the
    adjustment as it stands; critical_tau: of tau. error: the gross error as the others see it, by coordinate, in mm,
    object units or rad. alike: what could as well be wrong in its place. removed: the adjustment does without it.
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
    """The search for gross errors in one adjustment.

    Columns of V are made when they are used and many at a time, for each costs a pass over all blocks.
    """

    def __init__(self, run: Run, probabilities: Probabilities) -> None:
        self.run, self.probabilities = run, probabilities
        self._columns: dict[int, Array] = {}

    @cached_property
    def critical(self) -> Array:
        """What chance lets the statistics (N,) reach; inf where nothing is tested."""
        tests = self.run.statistics
        is_tested = tests.sizes > 0
        critical = self.probabilities.critical(tests.sizes, int(is_tested.sum()))
        return np.where(is_tested & ~self._impossible, critical, np.inf)

    @property
    def _impossible(self) -> Mask:
        """Which units (N,) cannot have the gross errors (N, 2) that the others see in them: a given principal distance
        is not wrong by more than itself.

        Over flat ground v'Pv hardly changes with the principal distance, and what change there is need not come from
        it: nearer stations let errors of given heights explain more of the image residuals. In the linear model that
        small slope looks like a gross error of metres.
        """
        run, observed = self.run, len(self.run.end.v_mm)
        positions = run.units.positions[:, 0]
        is_distance = np.isin(positions, [some[0] for some in run.problem.unknowns.camera.values()])
        errors = np.abs(run.statistics.error[observed:, 0])
        impossible = is_distance & (errors > np.abs(run.end.state.values[positions]))
        return np.concatenate([np.zeros(observed, dtype=bool), impossible])

    @property
    def limits(self) -> Array:
        """What the statistics (N,) may reach in an adjustment that does without what contradicts the others."""
        return np.asarray(self._significant_scale([]) ** 2 * self.critical)

    @cached_property
    def contradictions(self) -> list[GrossError]:
        """What contradicts the others beyond its limit, in the order in which it was found.

        Where the observations are worse than given, so that everything contradicts everything, limits are raised by
        their scale. That is learnt without what contradicts the others, for in a small network one gross error spoils
        all.
        """
        most = min(int(MOST_SUSPECT * len(self.critical)), MOST_AT_ONCE)
        scale = self._median_scale([]) if len(self.run.end.v_mm) > MANY else 1.0
        while True:
            limits = scale**2 * self.critical
            chosen = self._chosen(limits, most)
            # Where there may be more, the sum of squares would take these for a bad scale.
            learnt = self._significant_scale(chosen) if len(chosen) < most else self._median_scale(chosen)
            if learnt <= RAISED * scale:
                return [self._contradiction(chosen, unit, limits) for unit in chosen]
            scale = learnt

    def rest(self, units: Sequence[int]) -> tuple[float, float]:
        """v'Pv and redundancy of an adjustment that would do without some units."""
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
        """What contradicts the others and what weighs less for that reason, with names, the worst first."""
        tests, weighting = self.run.statistics, self.run.weighting
        entries = {each.unit: each for each in self.contradictions}
        alike = {each.unit: each.alike for each in self.run.removed}
        limits = self.limits
        for unit in map(int, np.flatnonzero((weighting.weights < 1.0) & (tests.statistic > limits))):
            figures = float(tests.statistic[unit]), float(limits[unit]), tests.error[unit]
            entries[unit] = GrossError(unit, *figures, alike.get(unit, ()))
        critical_tau = self.probabilities.critical_tau(redundancy, int((tests.sizes > 0).sum()))
        worst_first = sorted(entries.values(), key=lambda each: -each.statistic / each.limit)
        return tuple(self._suspect(entry, result, critical_tau) for entry in worst_first)

    def _suspect(self, entry: GrossError, result: Reliability, critical_tau: float) -> Suspect:
        unit, tested = entry.unit, result.tested[entry.unit]
        worst = int(np.abs(result.w[unit]).argmax())
        return Suspect(
            tested=tested,
            size=int(result.sizes[unit]),
            statistic=entry.statistic,
            critical=entry.limit,
            w=float(result.w[unit, worst]),
            tau=float(result.tau[unit, worst]),
            critical_tau=critical_tau,
            error=tuple(float(value) for value in entry.error[: len(tested.coordinates)]),
            alike=tuple(result.tested[other].name for other in entry.alike[:ALIKE_SHOWN]),
            removed=not bool(self.run.weighting.used[unit]),
        )

    def _significant_scale(self, units: Sequence[int]) -> float:
        """Root of v'Pv over the redundancy without some units, where that is larger than chance makes it, else 1."""
        vpv, redundancy = self.rest(units)
        chance = redundancy < 1.0 or special.chdtrc(redundancy, vpv) > self.probabilities.family
        return 1.0 if chance else float(np.sqrt(vpv / redundancy))

    def _median_scale(self, units: Sequence[int]) -> float:
        """What the median of the other image points' statistics tells, no less than 1."""
        points = np.setdiff1d(np.arange(len(self.run.end.v_mm)), units)
        sizes = np.where(np.isfinite(self.critical[points]), 2, 0)
        return max(1.0, robust_scale(self._reduced_statistics(units)[points], sizes))

    def _chosen(self, limits: Array, most: int) -> list[int]:
        chosen: list[int] = []
        for _ in range(2 * most):
            statistic = self._reduced_statistics(chosen)
            worst = int(np.argmax(statistic / limits))
            found = [worst] if statistic[worst] > limits[worst] else self._hidden_pair(chosen, limits)
            if not found or len(chosen) + len(found) > most:
                break
            chosen += found
            confirmed = self._joint_errors(chosen)[1] > limits[chosen]
            chosen = [unit for unit, still in zip(chosen, confirmed, strict=True) if still or unit in found]
        return chosen

    def _hidden_pair(self, chosen: Sequence[int], limits: Array) -> list[int]:
        """Two units that hide each other: each contradicts the others without the other one, and both do together.

        Looked for where all that is left contradicts itself (the test of v'Pv), and among the PAIRED worst units alone.
        In large networks, where no unit bears on so much of another's residual, they are not.
        """
        if len(limits) > MOST_PAIRED:
            return []
        finite = np.isfinite(limits)
        raised = float((limits[finite] / self.critical[finite]).max(initial=1.0))
        rest, redundancy = self.rest(chosen)
        if special.chdtrc(redundancy, rest / raised) > self.probabilities.family:
            return []
        alone = self._reduced_statistics(chosen)
        candidates = np.argsort(-alone / self.critical, kind="stable")[:PAIRED]
        self._prepare([int(unit) for unit in candidates])
        pairs = len(candidates) * (len(candidates) - 1) // 2
        critical = raised * self.probabilities.critical(np.array([4]), pairs)[0]
        given = np.array([self._reduced_statistics([*chosen, int(unit)])[candidates] for unit in candidates])
        of_pair = alone[candidates][:, None] + given
        hidden = (of_pair > critical) & (given > limits[candidates]) & (limits[candidates][:, None] < given.T)
        if not hidden.any():
            return []
        first, second = np.unravel_index(np.argmax(np.where(hidden, of_pair, 0.0)), hidden.shape)
        return [int(candidates[first]), int(candidates[second])]

    def _contradiction(self, chosen: Sequence[int], unit: int, limits: Array) -> GrossError:
        errors, joint = self._joint_errors(chosen)
        at = chosen.index(unit)
        others = self._reduced_statistics([each for each in chosen if each != unit])
        near = np.flatnonzero((others > limits) & (others > joint[at] - TOLD_APART))
        alike = sorted((int(other) for other in near if other != unit), key=lambda other: -others[other])
        error = self.run.misfits.back[unit] @ errors[at]
        return GrossError(unit, float(joint[at]), float(limits[unit]), error, tuple(alike))

    def _reduced_statistics(self, left_out: Sequence[int]) -> Array:
        """The statistics (N,) as they would be without some units; 0 for these."""
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
        """The gross errors (k, 2) of all chosen units together, in unit weight, and their statistics (k,)."""
        inverse = _inverse(self._joint_cofactor(chosen))
        errors = -(inverse @ self.run.misfits.residual[chosen].ravel()).reshape(-1, 2)
        own = inverse.reshape(len(chosen), 2, len(chosen), 2)
        variance, axes = np.linalg.eigh(np.einsum("kikj->kij", own))
        return errors, _square_sums(variance, (axes.transpose(0, 2, 1) @ errors[..., None])[..., 0])

    def _joint_cofactor(self, units: Sequence[int]) -> Array:
        """(2 k, 2 k) of some units."""
        return self._cofactor_columns(units)[units].reshape(2 * len(units), -1)

    def _cofactor_columns(self, units: Sequence[int]) -> Array:
        """The columns (N, 2, 2 k) of V of some units."""
        missing = [unit for unit in units if unit not in self._columns]
        if missing:
            worst = np.argsort(-self.run.statistics.statistic / self.critical)[:AT_ONCE]  # that are likely to follow
            self._prepare([*missing, *(int(unit) for unit in worst if unit not in missing)])
        nothing = np.zeros((len(self.critical), 2, 0))
        return np.concatenate([nothing, *(self._columns[unit] for unit in units)], axis=2)

    def _prepare(self, units: list[int]) -> None:
        """Make the columns (N, 2, 2) of some units in one pass."""
        units = [unit for unit in units if unit not in self._columns]
        homes: dict[int, tuple[int, int, Array, Array]] = {}  # what holds the unit's block, which it is there, own
        triangle = self.run.factor.triangle  # rows, and the covariances of its rows with the shared unknowns
        for part, rows in enumerate(self.run.unit_rows()):
            for block, place in np.argwhere(np.isin(rows.units, units)):
                through = np.zeros((len(triangle), 2))
                np.add.at(through, rows.shared[block], rows.through[block, place].T)
                by_shared = triangle.cofactor_times(through)
                homes[int(rows.units[block, place])] = (part, int(block), rows.own[block, place], by_shared)
        columns = {unit: np.zeros((len(self.critical) + 1, 2, 2)) for unit in units}  # the last stands for ABSENT
        for part, rows in enumerate(self.run.unit_rows()):
            for unit, (home, block, own, by_shared) in homes.items():
                columns[unit][rows.units] = -(rows.through @ by_shared[rows.shared][:, None])
                if part == home:
                    columns[unit][rows.units[block]] -= rows.own[block] @ own.T
        for unit in units:
            self._columns[unit] = columns[unit][:-1]
            self._columns[unit][unit] = np.eye(2) - self.run.misfits.hat[unit]


def _square_sums(variance: Array, along: Array) -> Array:
    """Sums (n,) of squares over variances (n, 2), what nothing checks left out."""
    visible = variance > UNCHECKED
    return np.asarray(np.where(visible, along**2 / np.where(visible, variance, 1.0), 0.0).sum(axis=1))


def _inverse(cofactor: Array) -> Array:
    """The inverse, what nothing checks left out."""
    variance, axes = np.linalg.eigh(cofactor)
    visible = variance > UNCHECKED
    return np.asarray((axes[:, visible] / variance[visible]) @ axes[:, visible].T)
