"""Data snooping: which observations and given quantities contradict the others.

One after the other, the worst first, each tested as if those before it were not there; and every one of these anew as
if the later ones were not there, so that two errors neither hide each other nor make good observations suspect. This is
done in the linear model of one adjustment, whose residuals T v and cofactor matrix V = I - T B C_xx B' T', all of unit
weight, tell what any of them would be without some of the observations (Baarda's data snooping, with the forward and
backward steps of a regression).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from adjust.least_squares.iteration import Linearised
from adjust.least_squares.numbering import Numbering
from adjust.linear_algebra.factor import Factor
from adjust.linear_algebra.small_matrices import applied, eigen
from adjust.problem.probabilities import Probabilities
from adjust.problem.tested import Tested, TestedUnits
from adjust.quality.reliability import UNCHECKED, Misfits, Reliability, statistics, unit_rows
from adjust.quality.reweighting import Weighting, robust_scale

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

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


@dataclass(frozen=True)
class Search:
    """The tests of one adjustment: residuals and hat matrices, and what chance lets the statistics (N,) reach."""

    numbering: Numbering
    end: Linearised
    factor: Factor
    found: Misfits
    weighting: Weighting
    probabilities: Probabilities
    critical: Array


def search(
    numbering: Numbering,
    end: Linearised,
    factor: Factor,
    found: Misfits,
    weighting: Weighting,
    probabilities: Probabilities,
) -> Search:
    """The tests of an adjustment with their critical values."""
    tests = statistics(found, weighting.weights)
    critical = probabilities.critical(tests.sizes, int((tests.sizes > 0).sum()))
    tested = (tests.sizes > 0) & ~_impossible(numbering, end, tests.error)
    return Search(numbering, end, factor, found, weighting, probabilities, np.where(tested, critical, np.inf))


def _impossible(numbering: Numbering, end: Linearised, error: Array) -> NDArray[np.bool_]:
    """Which units (N,) cannot have the gross errors (N, 2) that the others see in them: a given principal distance is
    not wrong by more than itself.

    Over flat ground v'Pv hardly changes with the principal distance, and what change there is need not come from it:
    nearer stations let errors of given heights explain more of the image residuals. In the linear model that small
    slope looks like a gross error of metres.
    """
    positions = TestedUnits(numbering.problem).positions[:, 0]
    is_distance = np.isin(positions, [some[0] for some in numbering.problem.unknowns.camera.values()])
    impossible = is_distance & (np.abs(error[len(end.v_mm) :, 0]) > np.abs(end.state.values[positions]))
    return np.concatenate([np.zeros(len(end.v_mm), dtype=bool), impossible])


@dataclass(frozen=True)
class GrossError:
    """A unit that contradicts the others, the other such units left out: its statistic, and what chance lets it reach.

    error (2,): the gross error as the others see it. alike: units that explain the contradiction as well.
    """

    unit: int
    statistic: float
    limit: float
    error: Array
    alike: tuple[int, ...]


def contradictions(search: Search) -> list[GrossError]:
    """What contradicts the others beyond its limit, in the order in which it was found.

    Where the observations are worse than given, so that everything contradicts everything, limits are raised by their
    scale. That is learnt without what contradicts the others, for in a small network one gross error spoils all.
    """
    covariance = _Covariance(search)
    most = min(int(MOST_SUSPECT * len(search.critical)), MOST_AT_ONCE)
    scale = _median_scale(search, covariance, []) if len(search.end.v_mm) > MANY else 1.0
    while True:
        limits = scale**2 * search.critical
        chosen = _chosen(search, covariance, limits, most)
        if len(chosen) < most:
            learnt = _significant_scale(*_rest(search, covariance, chosen), search.probabilities)
        else:  # there may be more, which the sum of squares would take for a bad scale
            learnt = _median_scale(search, covariance, chosen)
        if learnt <= RAISED * scale:
            return [_contradiction(search, covariance, chosen, unit, limits) for unit in chosen]
        scale = learnt


def rest_after(search: Search, units: Sequence[int]) -> tuple[float, float]:
    """v'Pv and redundancy of an adjustment that would do without some units."""
    return _rest(search, _Covariance(search), units)


def _significant_scale(vpv: float, redundancy: float, probabilities: Probabilities) -> float:
    """Root of v'Pv over the redundancy, where that is larger than chance makes it, else 1."""
    chance = redundancy < 1.0 or special.chdtrc(redundancy, vpv) > probabilities.family
    return 1.0 if chance else float(np.sqrt(vpv / redundancy))


def limits(search: Search) -> Array:
    """What the statistics (N,) may reach in an adjustment that does without what contradicts the others."""
    scale = _significant_scale(*_rest(search, _Covariance(search), []), search.probabilities)
    return np.asarray(scale**2 * search.critical)


def _median_scale(search: Search, covariance: "_Covariance", left_out: Sequence[int]) -> float:
    """What the median of the other image points' statistics tells, no less than 1."""
    points = np.setdiff1d(np.arange(len(search.end.v_mm)), left_out)
    sizes = np.where(np.isfinite(search.critical[points]), 2, 0)
    return max(1.0, robust_scale(_reduced_statistics(search, covariance, left_out)[points], sizes))


def _chosen(search: Search, covariance: "_Covariance", limits: Array, most: int) -> list[int]:
    chosen: list[int] = []
    for _ in range(2 * most):
        statistic = _reduced_statistics(search, covariance, chosen)
        worst = int(np.argmax(statistic / limits))
        found = [worst] if statistic[worst] > limits[worst] else _hidden_pair(search, covariance, chosen, limits)
        if not found or len(chosen) + len(found) > most:
            break
        chosen += found
        confirmed = _joint(search, covariance, chosen)[1] > limits[chosen]
        chosen = [unit for unit, still in zip(chosen, confirmed, strict=True) if still or unit in found]
    return chosen


def _hidden_pair(search: Search, covariance: "_Covariance", chosen: Sequence[int], limits: Array) -> list[int]:
    """Two units that hide each other: each contradicts the others without the other one, and both do together.

    Looked for where all that is left contradicts itself (the test of v'Pv), and among the PAIRED worst units alone. In
    large networks, where no unit bears on so much of another's residual, they are not.
    """
    if len(limits) > MOST_PAIRED:
        return []
    finite = np.isfinite(limits)
    raised = float((limits[finite] / search.critical[finite]).max(initial=1.0))
    rest, redundancy = _rest(search, covariance, chosen)
    if special.chdtrc(redundancy, rest / raised) > search.probabilities.family:
        return []
    alone = _reduced_statistics(search, covariance, chosen)
    candidates = np.argsort(-alone / search.critical, kind="stable")[:PAIRED]
    covariance.prepare([int(unit) for unit in candidates])
    critical = raised * search.probabilities.critical(np.array([4]), len(candidates) * (len(candidates) - 1) // 2)[0]
    given = np.array([_reduced_statistics(search, covariance, [*chosen, int(unit)])[candidates] for unit in candidates])
    of_pair = alone[candidates][:, None] + given
    hidden = (of_pair > critical) & (given > limits[candidates]) & (limits[candidates][:, None] < given.T)
    if not hidden.any():
        return []
    first, second = np.unravel_index(np.argmax(np.where(hidden, of_pair, 0.0)), hidden.shape)
    return [int(candidates[first]), int(candidates[second])]


def _rest(search: Search, covariance: "_Covariance", chosen: Sequence[int]) -> tuple[float, float]:
    """v'Pv and redundancy that are left without some units."""
    residual, hat = search.found.residual, search.found.hat[search.weighting.used]
    vpv = float((residual**2).sum())
    redundancy = 2.0 * len(hat) - float(np.trace(hat, axis1=1, axis2=2).sum())
    if not chosen:
        return vpv, redundancy
    joint = covariance.columns(chosen)[chosen].reshape(2 * len(chosen), -1)
    explained = residual[chosen].ravel() @ _inverse(joint) @ residual[chosen].ravel()
    rank = int(np.linalg.matrix_rank(joint, tol=UNCHECKED, hermitian=True))
    return max(vpv - float(explained), 0.0), redundancy - rank


class _Covariance:
    """Columns of V, made when they are asked for and many at a time, for each costs a pass over all blocks."""

    def __init__(self, search: Search) -> None:
        self._search = search
        self._columns: dict[int, Array] = {}

    def columns(self, units: Sequence[int]) -> Array:
        """(N, 2, 2 k) of some units."""
        missing = [unit for unit in units if unit not in self._columns]
        if missing:
            self.prepare(self._likely(missing))
        size = len(self._search.critical)
        return np.concatenate([np.zeros((size, 2, 0)), *(self._columns[unit] for unit in units)], axis=2)

    def prepare(self, units: list[int]) -> None:
        """Make the columns of some units in one pass."""
        missing = [unit for unit in units if unit not in self._columns]
        if missing:
            self._columns |= _columns(self._search, missing)

    def _likely(self, missing: list[int]) -> list[int]:
        tests = statistics(self._search.found, self._search.weighting.weights)
        worst = np.argsort(-tests.statistic / self._search.critical)[:AT_ONCE]
        return [*missing, *(int(unit) for unit in worst if unit not in self._columns and unit not in missing)]


def _columns(search: Search, units: Sequence[int]) -> dict[int, Array]:
    """The columns (N, 2, 2) of V of some units."""
    homes: dict[int, tuple[int, int, Array, Array]] = {}  # what holds the unit's block, which it is there, own rows,
    triangle = search.factor.triangle  # and the covariances of its rows with the shared unknowns
    for part, rows in enumerate(unit_rows(search.numbering, search.end, search.factor)):
        for block, place in np.argwhere(np.isin(rows.units, units)):
            through = np.zeros((len(triangle), 2))
            np.add.at(through, rows.shared[block], rows.through[block, place].T)
            by_shared = triangle.cofactor_times(through)
            homes[int(rows.units[block, place])] = (part, int(block), rows.own[block, place], by_shared)
    columns = {unit: np.zeros((len(search.critical) + 1, 2, 2)) for unit in units}  # the last stands for ABSENT
    for part, rows in enumerate(unit_rows(search.numbering, search.end, search.factor)):
        for unit, (home, block, own, by_shared) in homes.items():
            columns[unit][rows.units] = -(rows.through @ by_shared[rows.shared][:, None])
            if part == home:
                columns[unit][rows.units[block]] -= rows.own[block] @ own.T
    columns = {unit: of_unit[:-1] for unit, of_unit in columns.items()}
    for unit in units:
        columns[unit][unit] = np.eye(2) - search.found.hat[unit]
    return columns


def _reduced_statistics(search: Search, covariance: _Covariance, left_out: Sequence[int]) -> Array:
    """The statistics (N,) as they would be without some units; 0 for these."""
    residual, cofactor = search.found.residual, np.eye(2) - search.found.hat
    if left_out:
        columns = covariance.columns(left_out)
        inverse = _inverse(columns[left_out].reshape(2 * len(left_out), -1))
        through = columns @ inverse
        residual = residual - through @ residual[left_out].ravel()
        cofactor = cofactor - through @ columns.transpose(0, 2, 1)
    variance, axes = eigen(cofactor)
    along = applied(axes.transpose(0, 2, 1), residual)
    visible = variance > UNCHECKED
    statistic: Array = np.where(visible, along**2 / np.where(visible, variance, 1.0), 0.0).sum(axis=1)
    statistic[left_out] = 0.0
    return statistic


def _inverse(cofactor: Array) -> Array:
    """The inverse, what nothing checks left out."""
    variance, axes = np.linalg.eigh(cofactor)
    visible = variance > UNCHECKED
    return np.asarray((axes[:, visible] / variance[visible]) @ axes[:, visible].T)


def _joint(search: Search, covariance: _Covariance, chosen: Sequence[int]) -> tuple[Array, Array]:
    """The gross errors (k, 2) of all chosen units together, in unit weight, and their statistics (k,)."""
    inverse = _inverse(covariance.columns(chosen)[chosen].reshape(2 * len(chosen), -1))
    errors = -(inverse @ search.found.residual[chosen].ravel()).reshape(-1, 2)
    own = inverse.reshape(len(chosen), 2, len(chosen), 2)
    variance, axes = np.linalg.eigh(np.einsum("kikj->kij", own))
    along = (axes.transpose(0, 2, 1) @ errors[..., None])[..., 0]
    visible = variance > UNCHECKED
    return errors, np.where(visible, along**2 / np.where(visible, variance, 1.0), 0.0).sum(axis=1)


def _contradiction(
    search: Search, covariance: _Covariance, chosen: Sequence[int], unit: int, limits: Array
) -> GrossError:
    errors, joint = _joint(search, covariance, chosen)
    at = chosen.index(unit)
    others = _reduced_statistics(search, covariance, [each for each in chosen if each != unit])
    near = np.flatnonzero((others > limits) & (others > joint[at] - TOLD_APART))
    alike = sorted((int(other) for other in near if other != unit), key=lambda other: -others[other])
    error = search.found.back[unit] @ errors[at]
    return GrossError(unit, float(joint[at]), float(limits[unit]), error, tuple(alike))


def suspects(
    search: Search,
    contradicting: Sequence[GrossError],
    removed: Sequence[GrossError],
    result: Reliability,
    probabilities: Probabilities,
    redundancy: int,
) -> tuple[Suspect, ...]:
    """What contradicts the others and what weighs less for that reason, with names, the worst first."""
    tests = statistics(search.found, search.weighting.weights)
    entries = {each.unit: each for each in contradicting}
    known = {each.unit: each.alike for each in removed}
    reach = limits(search)
    weakened = (search.weighting.weights < 1.0) & (tests.statistic > reach)
    for unit in map(int, np.flatnonzero(weakened)):
        measured = float(tests.statistic[unit]), float(reach[unit]), tests.error[unit]
        entries[unit] = GrossError(unit, *measured, known.get(unit, ()))
    count = int((tests.sizes > 0).sum())
    named = []
    for entry in sorted(entries.values(), key=lambda each: -each.statistic / each.limit):
        unit = entry.unit
        worst = int(np.abs(result.w[unit]).argmax())
        tested = result.tested[unit]
        named.append(
            Suspect(
                tested=tested,
                size=int(tests.sizes[unit]),
                statistic=entry.statistic,
                critical=entry.limit,
                w=float(result.w[unit, worst]),
                tau=float(result.tau[unit, worst]),
                critical_tau=probabilities.critical_tau(redundancy, count),
                error=tuple(float(value) for value in entry.error[: len(tested.coordinates)]),
                alike=tuple(result.tested[other].name for other in entry.alike[:ALIKE_SHOWN]),
                removed=not bool(search.weighting.used[unit]),
            )
        )
    return tuple(named)
