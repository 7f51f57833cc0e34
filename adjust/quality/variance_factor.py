"""The variance factor: by how much the given variances are too small, from observations that tell it.

Torlegård's sigma0² = v'Pv / r takes every observation for one of the same kind of error. What a camera's file gives
with a standard deviation of 1 mm to place the datum (F5 to F9) is an observation of another kind: it contradicts
nothing, and counts as redundancy. Such given values take no part in sigma0, and sigma0 does not multiply them.
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

UNCHECKED = 0.01  # redundancy of given values that place something alone, and contradict nothing
LEAST_REDUNDANCY = 1.0  # of observations that are to tell sigma0
TOO_GOOD = 1e-3  # probability of given values that agree so well with the others if their sigma were right
NO_EVIDENCE = 0.01  # part that the other observations' errors have in residuals, below which these show nothing of them
ERROR_FREE = 1e-4  # v'Pv over redundancy of observations that were computed, not made
APART = 3.0  # ratio of standard deviations of one camera's marks that belong to two sources


@dataclass(frozen=True)
class _Given:
    """Values that a file gives of one owner: positions of the unknowns, v'Pv, redundancy, and the least part that the
    other observations' errors have in any combination of the residuals."""

    group: GivenGroup
    positions: Indices
    vpv: float
    redundancy: float
    evidence: float


def variance_factor(run: Run, redundancy: int) -> VarianceFactor:
    """Estimate sigma0 from the observations that have redundancy of their own.

    The given values of fiducials (F5, F6), of interior orientations and distortion (F7 to F9), of scanners and of
    boards are left out where they agree with the other observations better than their standard deviations allow
    (F-test, `TOO_GOOD`); those of fiducials also where a camera shows nothing but fiducials and some combination of
    their residuals holds nothing of the measuring error (`NO_EVIDENCE`): nothing else would then tell how good they
    are. Where all that is not given by these files has a redundancy below 1, sigma0 is not estimated but 1, and
    standard deviations are a priori ones.

    Parameters
    ----------
    run : the adjustment; without a solution sigma0 is that of all
    redundancy : of the whole adjustment

    Notes
    -----
    With P^½ v the residuals of given values in their standard deviations and Q their cofactor matrix, the redundancy of
    a group is the trace of M = I - P^½ Q P^½. Along an eigenvector of M with the eigenvalue m the others' errors are
    1 - m of the residual's variance; m is 0 along what the group alone determines.
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
    """Whether given values place the datum and say nothing of the noise, whose variance factor the others tell."""
    alone = given.group.group == "datum" and given.group.owner in problem.network.idle_cameras
    if alone and given.evidence < NO_EVIDENCE:
        return True
    # Where the others hold gross errors, what is given is not too good for being better than these.
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
    """The given values that take part, by what they are of; those of fiducials by the size of their sigma, too."""
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
    """Positions apart where their standard deviations, in order, leap."""
    order = np.argsort(sigma, kind="stable")
    leaps = np.flatnonzero(sigma[order][1:] > APART * sigma[order][:-1]) + 1
    return [part for part in np.split(positions[order], leaps) if len(part)]
