"""The variance factor sigma0², and variance components of groups of observations.

Torlegård's sigma0² = v'Pv / r treats all observations alike. Given values of a camera file (F5 to F9) with a standard
deviation of 1 mm, which only place the datum, are different: they contradict nothing but count as redundancy. Such
values are left out of sigma0, and sigma0 does not scale them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import brentq
from scipy.sparse import csr_array
from scipy.special import fdtr

from adjust.array_types import Array, Indices, Mask
from adjust.least_squares.equations import prior_differences
from adjust.linear_algebra.factor import Factor
from adjust.linear_algebra.sparse_rows import spread_squares
from adjust.problem.estimates import GivenGroup, VarianceFactor
from adjust.problem.problem import ABSENT, Problem
from adjust.quality.run import Run
from adjust.quality.tested import Weighting

UNCHECKED = 0.01  # redundancy below which given values only place something
LEAST_REDUNDANCY = 1.0  # of the observations that determine sigma0
TOO_GOOD = 1e-3  # p-value below which given values agree too well for their standard deviations
NO_EVIDENCE = 0.01  # least share of the other observations' errors in residuals that are evidence of them
ERROR_FREE = 1e-4  # v'Pv over redundancy of simulated observations without errors
APART = 3.0  # ratio of standard deviations that separates two sources of one camera's marks


@dataclass(frozen=True)
class _Given:
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

    Parameters
    ----------
    run : the adjustment; without a solution, sigma0 is that of all observations
    redundancy : of the whole adjustment

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
    out = [each for each in given if variance > ERROR_FREE and _places_only(problem, each, variance, left)]
    if not out:
        return VarianceFactor(float(np.sqrt(vpv / redundancy)), redundancy)
    own = redundancy - sum(each.redundancy for each in out)
    sigma0 = np.sqrt((vpv - sum(each.vpv for each in out)) / own)
    groups = tuple(dict.fromkeys(each.group for each in out))
    return VarianceFactor(float(sigma0), own, groups, np.concatenate([each.positions for each in out]))


def _places_only(problem: Problem, given: _Given, variance: float, redundancy: float) -> bool:
    """Whether given values only place the datum and are no evidence of the noise."""
    alone = given.group.group == "datum" and given.group.owner in problem.network.idle_cameras
    if alone and given.evidence < NO_EVIDENCE:
        return True
    # If the others contain gross errors, given values must not count as too good for being better than these.
    return bool(fdtr(given.redundancy, redundancy, given.vpv / given.redundancy / min(variance, 1.0)) < TOO_GOOD)


def _given_groups(run: Run) -> Iterator[_Given]:
    numbering = run.numbering
    sigma = numbering.problem.unknowns.sigma
    differences = prior_differences(numbering.problem, run.end.state)
    for group, positions in _given_positions(run):
        count = len(positions)
        shape = count, len(numbering.free)
        entries = np.arange(count), numbering.numbers[positions]
        q = run.factor.function_cofactor(csr_array((np.ones(count), entries), shape=shape))
        free = np.eye(len(positions)) - q / np.outer(sigma[positions], sigma[positions])
        vpv = float(((differences[positions] / sigma[positions]) ** 2).sum())
        redundancy = float(np.trace(free))
        evidence = 1.0 - float(np.linalg.eigvalsh(free)[-1])
        yield _Given(group, positions, vpv, redundancy, evidence)


def _given_positions(run: Run) -> Iterator[tuple[GivenGroup, Indices]]:
    """Given values with weight, by owner; those of fiducials also by the size of their standard deviations."""
    unknowns = run.problem.unknowns
    used = run.units.positions[run.weighting.used[len(run.end.v_mm) :]]
    takes_part = np.zeros(len(unknowns), dtype=bool)
    takes_part[used[used != ABSENT]] = True
    fiducials: dict[str, list[int]] = {}
    for (camera, _), pair in unknowns.fiducial.items():
        fiducials.setdefault(camera, []).extend(pair[takes_part[pair]].tolist())
    for camera, members in fiducials.items():
        positions = np.array(members, dtype=np.intp)
        for some in _split_sources(positions, run.numbering.problem.unknowns.sigma[positions]):
            yield GivenGroup("datum", camera), some
    for name, owned in (("interior", unknowns.camera), ("scanner", unknowns.scanner), ("board", unknowns.board)):
        for owner, positions in owned.items():
            if takes_part[positions].any():
                yield GivenGroup(name, owner), positions[takes_part[positions]]


def _split_sources(positions: Indices, sigma: Array) -> list[Indices]:
    """Split positions where their sorted standard deviations jump."""
    order = np.argsort(sigma, kind="stable")
    leaps = np.flatnonzero(sigma[order][1:] > APART * sigma[order][:-1]) + 1
    return [part for part in np.split(positions[order], leaps) if len(part)]


def added_variance(squares: Array, variances: Array, redundancy: float) -> float | None:
    """Variance that makes v'Pv equal the redundancy when added to those of residuals of given squares.

    Förstner's condition for a variance component, here an additive one; None where no such variance exists.
    """
    most = 2.0 * float(squares.sum()) / redundancy if redundancy > 0.0 else 0.0

    def excess(added: float) -> float:
        return float((squares / np.maximum(variances + added, 1e-300)).sum()) - redundancy

    return float(brentq(excess, 0.0, most)) if most > 0.0 and excess(0.0) > 0.0 else None


COLUMNS_AT_ONCE = 500  # columns of the cofactor matrix of the shared unknowns held at a time


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
    # Rows of one block share the block's own unknowns. Different blocks are connected only by the shared unknowns, for
    # which the normal matrices of the groups are summed first.
    factor = run.factor
    within = np.zeros((len(members), len(members)))
    normals = [csr_array((factor.shared_count, factor.shared_count)) for _ in members]
    is_member = np.append(
        np.array(members), np.zeros((len(members), 1), dtype=bool), axis=1
    )  # the last stands for ABSENT
    for rows in run.unit_rows():
        count = len(rows.units)
        masks = is_member[:, rows.units][..., None, None]
        shape = len(members), count, 2 * rows.units.shape[1]
        own = (masks * rows.own).reshape(*shape, rows.own.shape[3])
        through = (masks * rows.through).reshape(*shape, rows.through.shape[3])
        roots = through @ factor.triangle.group_roots(rows.shared)
        for i, j in product(range(len(members)), repeat=2):
            between = roots[i] @ roots[j].swapaxes(1, 2)
            within[i, j] += ((own[i] @ own[j].swapaxes(1, 2) + between) ** 2).sum() - (between**2).sum()
        for i, of_group in enumerate(through):
            normals[i] = normals[i] + spread_squares(
                rows.shared, of_group.swapaxes(1, 2) @ of_group, factor.shared_count
            )
    return within + _shared_traces(factor, normals)


def _shared_traces(factor: Factor, normals: Sequence[csr_array]) -> Array:
    """(g, g) traces of N_i Q N_j Q, with N (s, s) the reduced normal matrix of a group and Q the cofactor matrix of the
    shared unknowns. Computed in blocks of columns of Q, which is too large as a whole in a large network."""
    traces = np.zeros((len(normals), len(normals)))
    for first in range(0, factor.shared_count, COLUMNS_AT_ONCE):
        unit = np.eye(factor.shared_count, COLUMNS_AT_ONCE, -first)
        some = slice(first, first + COLUMNS_AT_ONCE)
        columns = factor.triangle.cofactor_times(unit)
        for j, of_group in enumerate(normals):
            through_group = factor.triangle.cofactor_times(of_group @ columns)
            traces[:, j] += [np.trace(normal[some] @ through_group) for normal in normals]
    return traces
