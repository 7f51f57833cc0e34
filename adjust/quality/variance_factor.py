"""The variance factor sigma0², estimated from observations with redundancy of their own.

Torlegård's sigma0² = v'Pv / r treats all observations alike. Given values of a camera file (F5 to F9) with a standard
deviation of 1 mm, which only place the datum, are different: they contradict nothing but count as redundancy. Such
values are left out of sigma0, and sigma0 does not scale them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.special import fdtr

from adjust.array_types import Array, Indices
from adjust.least_squares.rows import prior_differences
from adjust.problem.estimates import GivenGroup, VarianceFactor
from adjust.problem.problem import ABSENT, Problem
from adjust.quality.run import Run

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
