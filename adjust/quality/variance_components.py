"""Variance components: factors on the given variances of groups of observations."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.sparse import csr_array

from adjust.array_types import Array, Mask
from adjust.linear_algebra.factor import Factor
from adjust.linear_algebra.sparse_rows import spread_squares
from adjust.quality.run import Run
from adjust.quality.weighting import Weighting

COLUMNS_AT_ONCE = 500  # columns of the cofactor matrix of the shared unknowns held at a time
LEAST_REDUNDANCY = 1.0  # a group with less redundancy keeps its variance


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
    """(g, g) squared norms of the parts of the hat matrix between groups.

    Rows of one block share the block's own unknowns. Different blocks are connected only by the shared unknowns, for
    which the normal matrices of the groups are summed first.
    """
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
