"""The variance factor sigma0², and variance components of groups of observations.

Torlegård's sigma0² = v'Pv / r treats all observations alike. Given values of a camera file (F5 to F9) with a standard
deviation of 1 mm, which only place the datum, are different: they contradict nothing but count as redundancy. Such
values are left out of sigma0, and sigma0 does not scale them.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.sparse import csr_array
from scipy.special import fdtr

from adjust.array_types import Array, Indices, Mask
from adjust.least_squares.equations import prior_differences
from adjust.problem.estimates import GivenGroup, VarianceFactor
from adjust.problem.problem import ABSENT
from adjust.quality.critical_values import Weighting
from adjust.quality.run import Run

UNCHECKED = 0.01  # redundancy below which given values only place something
LEAST_REDUNDANCY = 1.0  # of the observations that determine sigma0
TOO_GOOD = 1e-3  # p-value below which given values agree too well for their standard deviations
NO_EVIDENCE = 0.01  # least share of the other observations' errors in residuals that are evidence of them
ERROR_FREE = 1e-4  # v'Pv over redundancy of simulated observations without errors
APART = 3.0  # ratio of standard deviations that separates two sources of one camera's marks
MOST_COLUMNS, SIGNS = 500, 200  # columns of a part of the hat matrix; random sums of more than these


class _Given(NamedTuple):
    """Given values of one owner: positions of the unknowns, v'Pv, redundancy, and the smallest share of the other
    observations' errors in any combination of the residuals."""

    group: GivenGroup
    positions: Indices
    vpv: float
    redundancy: float
    evidence: float


def variance_factor(run: Run, redundancy: int) -> VarianceFactor:
    """Estimate sigma0 from the observations that have redundancy of their own.

    Given values of fiducials (F5, F6), interior orientation and distortion (F7 to F9), scanners and boards are left out
    if they agree with the other observations better than their standard deviations allow (F-test, `TOO_GOOD`). Those of
    fiducials are also left out if a camera shows only fiducials and some combination of their residuals contains no
    measuring error (`NO_EVIDENCE`). If the remaining observations have a redundancy below 1, sigma0 is 1 and standard
    deviations are a priori.

    redundancy: of the whole adjustment. Without a solution, sigma0 is that of all observations.

    Notes
    -----
    With P^½ v the residuals of given values in their standard deviations and Q their cofactor matrix, the redundancy of
    a group is the trace of M = I - P^½ Q P^½. Along an eigenvector of M with the eigenvalue m, the errors of the other
    observations are 1 - m of the residual's variance; m is 0 where the group alone determines a quantity.
    """
    problem, vpv = run.numbering.problem, run.vpv
    if not run.has_solution:
        return VarianceFactor(float(np.sqrt(vpv / redundancy)) if redundancy > 0 else 1.0, max(redundancy, 0))
    given = [each for each in _given_groups(run) if each.redundancy > UNCHECKED]
    left = redundancy - sum(each.redundancy for each in given)
    if left < LEAST_REDUNDANCY:
        return VarianceFactor(1.0, 0.0)
    variance = (vpv - sum(each.vpv for each in given)) / left
    out = list[_Given]()
    for each in given if variance > ERROR_FREE else ():
        is_alone = each.group.group == "datum" and each.group.owner in problem.network.idle_cameras
        # If the others contain gross errors, given values must not count as too good for being better than these.
        p = fdtr(each.redundancy, left, each.vpv / each.redundancy / min(variance, 1.0))
        if (is_alone and each.evidence < NO_EVIDENCE) or p < TOO_GOOD:
            out.append(each)
    if not out:
        return VarianceFactor(float(np.sqrt(vpv / redundancy)), redundancy)
    own = redundancy - sum(each.redundancy for each in out)
    sigma0 = np.sqrt((vpv - sum(each.vpv for each in out)) / own)
    groups = tuple(dict.fromkeys(each.group for each in out))
    return VarianceFactor(float(sigma0), own, groups, np.concatenate([each.positions for each in out]))


def _given_groups(run: Run) -> Iterator[_Given]:
    """Given values with weight, by owner; those of fiducials also where their sorted standard deviations jump."""
    numbering, unknowns = run.numbering, run.problem.unknowns
    sigma, differences = numbering.problem.unknowns.sigma, prior_differences(numbering.problem, run.end.state)
    used = run.units.positions[run.weighting.used[len(run.end.v_mm) :]]
    takes_part = np.zeros(len(unknowns), dtype=bool)
    takes_part[used[used != ABSENT]] = True
    owned = [(GivenGroup("datum", camera), pair) for (camera, _), pair in unknowns.fiducial.items()]
    for name, owners in (("interior", unknowns.camera), ("scanner", unknowns.scanner), ("board", unknowns.board)):
        owned += [(GivenGroup(name, owner), positions) for owner, positions in owners.items()]
    for group in dict.fromkeys(group for group, _ in owned):
        positions = np.concatenate([each for owner, each in owned if owner == group])
        positions = positions[takes_part[positions]]
        parts = [positions]
        if group.group == "datum":
            positions = positions[np.argsort(sigma[positions], kind="stable")]
            parts = np.split(positions, np.flatnonzero(sigma[positions][1:] > APART * sigma[positions][:-1]) + 1)
        for some in filter(len, parts):
            entries = np.ones(len(some)), (np.arange(len(some)), numbering.numbers[some])
            q = run.factor.function_cofactor(csr_array(entries, shape=(len(some), len(numbering.free))))
            free = np.eye(len(some)) - q / np.outer(sigma[some], sigma[some])
            vpv = float(((differences[some] / sigma[some]) ** 2).sum())
            yield _Given(group, some, vpv, float(np.trace(free)), 1.0 - float(np.linalg.eigvalsh(free)[-1]))


def added_variance(squares: Array, variances: Array, redundancy: float) -> float | None:
    """Variance that makes v'Pv equal the redundancy when added to those of residuals of given squares.

    Förstner's condition for a variance component, here an additive one; None where no such variance exists.
    """
    most = 2.0 * float(squares.sum()) / redundancy if redundancy > 0.0 else 0.0

    def excess(added: float) -> float:
        return float((squares / np.maximum(variances + added, 1e-300)).sum()) - redundancy

    return float(brentq(excess, 0.0, most)) if most > 0.0 and excess(0.0) > 0.0 else None


def refined_factors(run: Run) -> Weighting:
    """Multiply every factor by its group's v'Pv over redundancy.

    Iterated to convergence, this is Helmert's estimate and the restricted maximum likelihood of normally distributed
    errors. Source: W. Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, 1979.
    """
    factors = {}
    for group, factor in run.weighting.factors.items():
        vpv, redundancy = run.group_sums((run.units.groups == group) & run.weighting.used)
        lacking = vpv / redundancy if redundancy > LEAST_REDUNDANCY and vpv > 0.0 else 1.0
        factors[group] = factor * lacking
    return Weighting(run.weighting.weights, factors)


def factor_sigmas(run: Run) -> dict[str, float]:
    """Standard deviations of the converged factors.

    From twice the inverse of Helmert's matrix, S_gh = trace of (P Q_v)_gh (P Q_v)_hg, over all jointly estimated
    groups, so that their correlations are included. 0 for a group that keeps its variance. Source: K.-R. Koch,
    Parameter Estimation and Hypothesis Testing in Linear Models, section 36.
    """
    units, factors = run.units, run.weighting.factors
    names = list(factors)
    members = [(units.groups == group) & run.weighting.used for group in names]
    helmert = _traces(run, members)
    redundancies = np.array([run.group_sums(of_group)[1] for of_group in members])
    helmert += np.diag(2.0 * redundancies - [units.sizes[of_group].sum() for of_group in members])
    estimated = np.flatnonzero(redundancies > LEAST_REDUNDANCY)
    sigmas = dict.fromkeys(names, 0.0)
    variances = np.diag(np.linalg.pinv(helmert[np.ix_(estimated, estimated)]))
    for name, variance in zip([names[i] for i in estimated], variances, strict=True):
        sigmas[name] = float(factors[name] * np.sqrt(2.0 * variance))
    return sigmas


def _traces(run: Run, members: Sequence[Mask]) -> Array:
    """(g, g) squared norms of the parts of the hat matrix between groups."""
    # The squares of all columns of a part; of a large one, of sums of its columns with random signs, whose expected
    # squares these are (Hutchinson 1990).
    squares = []
    for of_group in members:
        functions = run.unit_functions[np.repeat(of_group, 2)]
        if (count := functions.shape[0]) > MOST_COLUMNS:
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (count, SIGNS)) / np.sqrt(SIGNS)
            columns = functions.T @ signs
        else:
            columns = functions.T.toarray()
        squares.append(((run.unit_functions @ run.factor.cofactor_times(columns)) ** 2).sum(axis=1))
    return np.asarray(np.repeat(members, 2, axis=1) @ np.array(squares).T)
