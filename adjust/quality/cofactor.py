"""Cofactor matrix of a result (covariance at sigma0 = 1), computed on demand, and a covariance by clusters.

In the cluster-robust covariance of the cameras, residuals within an image may be correlated; images are the clusters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from adjust.array_types import Array, Indices
from adjust.functional_model.rotation import vector_by_angles
from adjust.least_squares.iteration import Linearised
from adjust.linear_algebra.factor import Factor
from adjust.problem.estimates import Cofactor
from adjust.problem.problem import Problem, State
from adjust.quality.run import Run, linear_derivatives
from adjust.rank_defect.datum import free_motion

FEWEST_IMAGES = 3  # needed to leave one out
PRIOR_FREEDOM = 4.0  # degrees of freedom of a group's common variance ratio against those of a single jackknife
MOST_SHARED = 300  # shared quantities: with many unknown points the dense matrix would be too large
LARGEST_SHARE = 0.999  # of one image in the information on some combination of unknowns; above, it rests on that image
UNDETERMINED = 1e-9  # relative singular value of an image's equations, below which a direction is not determined
RANK = 1e-12  # eigenvalue of a scaled covariance, below which a direction is fixed


@dataclass(frozen=True)
class NoCofactor:
    """Placeholder for the cofactor matrix where there is no solution: zeros without meaning."""

    count: int

    @property
    def variances(self) -> Array:
        return np.zeros(self.count)

    def part(self, at: Indices) -> Array:
        return np.zeros((len(at), len(at)))

    def parts(self, groups: Indices) -> Array:
        return np.zeros((*groups.shape, groups.shape[1]))


@dataclass(frozen=True)
class InnerDatum:
    """Baarda's S-transformation of cofactors: with V = Q P', Q becomes Q - M V' - V M' + M P V M'.

    motion M (n, d): motions of the quantities in the free directions of the datum; through V (n, d); inner P V (d, d).
    """

    motion: Array
    through: Array
    inner: Array

    def part(self, at: Indices) -> Array:
        """Terms (..., k, k) added to the cofactors of some quantities (..., k)."""
        motion, through = self.motion[at], self.through[at]
        crossed = motion @ through.swapaxes(-1, -2)
        return np.asarray(motion @ self.inner @ motion.swapaxes(-1, -2) - crossed - crossed.swapaxes(-1, -2))


@dataclass(frozen=True)
class FactorCofactor:
    """Cofactor matrix of all quantities (n, n) from the factor of the free unknowns (f).

    by_free (n, f): derivatives of the reported quantities by the free unknowns: omega, phi, kappa by rotation vectors,
    film parameters by centred ones; empty rows for fixed quantities.
    """

    factor: Factor
    by_free: csr_array
    datum: InnerDatum | None = None

    def part(self, at: Indices) -> Array:
        """Cofactor matrix (k, k) of some quantities, by their positions in the result."""
        cofactor = self.factor.function_cofactor(self.by_free[at])
        return cofactor if self.datum is None else cofactor + self.datum.part(at)

    def parts(self, groups: Indices) -> Array:
        """Cofactor matrices (g, k, k) of groups of quantities (g, k), each of one point or one image."""
        functions = self.by_free[groups.ravel()]
        (count, width), free = groups.shape, self.by_free.shape[1]
        row = np.repeat(np.arange(groups.size), np.diff(functions.indptr))
        # All pairs of a group and an unknown that it depends on, sorted by group.
        pairs, place = np.unique(row // width * free + functions.indices, return_inverse=True)
        first = np.searchsorted(pairs, np.arange(count) * free)
        widths = np.diff(first, append=len(pairs))
        by_unknowns = np.zeros((count, width, int(widths.max(initial=0))))
        by_unknowns[row // width, row % width, place - first[row // width]] = functions.data
        cofactors = np.zeros((*groups.shape, width))
        for some in (np.flatnonzero(widths == each) for each in np.unique(widths[widths > 0])):
            numbers = pairs[first[some][:, None] + np.arange(widths[some[0]])] % free
            by = by_unknowns[some][..., : numbers.shape[1]]
            cofactors[some] = by @ self.factor.cofactors(numbers) @ by.swapaxes(1, 2)
        return cofactors if self.datum is None else cofactors + self.datum.part(groups)

    @cached_property
    def variances(self) -> Array:
        """(n,) diagonal."""
        variances = self.parts(np.arange(self.by_free.shape[0])[:, None])[:, 0, 0]
        return np.maximum(variances, 0.0)


def free_cofactor(at: Linearised) -> FactorCofactor:
    """Cofactor matrix in the datum of the equations."""
    numbering = at.rows.numbering
    return FactorCofactor(at.factor, _reported_by_unknowns(numbering.problem, at.state)[:, numbering.free])


def inner_cofactor(problem: Problem, at: Linearised, members: Indices) -> FactorCofactor:
    """Cofactor matrix of a problem transformed from the equations' minimum constraints to inner constraints over some
    coordinates.

    With G the motions of the free datum and G_p their rows of these coordinates, P = (G_p' G_p)^-1 G_p'.
    """
    reported, free = _reported_by_unknowns(problem, at.state), at.rows.numbering.free
    by_free, motion = reported[:, free], free_motion(problem, at.state)
    part = np.zeros((len(problem.unknowns), motion.shape[1]))
    part[members] = np.linalg.pinv(motion[members]).T
    through = at.factor.cofactor_times(part[free])
    datum = InnerDatum(reported @ motion, by_free @ through, part[free].T @ through)
    return FactorCofactor(at.factor, by_free, datum)


def _reported_by_unknowns(problem: Problem, state: State) -> csr_array:
    """(n, n) derivatives of the reported quantities by the unknowns of the iteration."""
    # These are omega, phi, kappa by rotation vectors, and film parameters by centred ones. Where phi is +-90 degrees,
    # only the sum or difference of omega and kappa is determined (pseudo-inverse).
    count = len(problem.unknowns)
    angles = np.unique(problem.exterior[~problem.keeps_angles, 3:], axis=0)  # scans of one frame have one attitude
    by_vector = np.linalg.pinv(vector_by_angles(state.values[angles]))
    groups = [(angles, by_vector), *problem.films_by_centred(state)]
    others = np.setdiff1d(np.arange(count), np.concatenate([positions.ravel() for positions, _ in groups]))
    rows, columns, values = [others], [others], [np.ones(len(others), dtype=np.float64)]
    for positions, derivatives in groups:
        at = np.broadcast_to(positions[:, :, None], derivatives.shape)
        rows.append(at.ravel())
        columns.append(at.swapaxes(1, 2).ravel())
        values.append(derivatives.ravel().astype(np.float64))
    entries = (np.concatenate(rows), np.concatenate(columns))
    matrix = csr_array((np.concatenate(values), entries), shape=(count, count))
    matrix.eliminate_zeros()
    return matrix


def cluster_covariance(run: Run, cofactor: Cofactor, variance: float) -> Array | None:
    """Covariance (n, n) of the quantities shared by images, 0 of others, by a delete-one-image jackknife.

    Each image is left out of the normal equations in turn. With N the normal matrix of the shared unknowns, N_i the
    part of image i, its own unknowns eliminated, and g_i its share of the right side, the shared unknowns change by
    d_i = -(N - N_i)^-1 g_i. The covariance is (m - 1) / m times the sum of (d_i - d)(d_i - d)' (Efron 1982; MacKinnon
    and White 1985, with images as clusters). It holds for any correlation of errors within an image, such as unmodelled
    distortion causes. Of few images it is itself poorly known, hence `_moderated`. None with fewer than FEWEST_IMAGES
    images, or where some quantity rests on one image. variance: of unit weight, for the model's covariance.
    """
    if (shares := _shares(run, cofactor)) is None or len(shares.of_images) < FEWEST_IMAGES:
        return None
    moves = [_move(by_shared, right) for by_shared, right in shares.of_images]
    if any(move is None for move in moves):
        return None
    spread = np.array(moves) @ shares.root.T
    spread -= spread.mean(axis=0)
    freedom = len(moves) - 1
    clusters = freedom / len(moves) * spread.T @ spread
    parameters = (run.problem.unknowns.parameters[position] for position in shares.positions)
    owners = [f"{each.kind} {each.owner}" for each in parameters]
    covariance = np.zeros((len(run.problem.unknowns),) * 2)
    # Without the part of pseudo-observations, a datum's for one, which leaving out an image does not show.
    derivatives = np.concatenate([by_shared @ shares.root.T for by_shared, _ in shares.of_images])
    model = variance * derivatives.T @ derivatives
    covariance[np.ix_(shares.positions, shares.positions)] = _moderated(clusters, model, owners, freedom)
    return covariance


def _moderated(clusters: Array, model: Array, owners: Sequence[str], freedom: int) -> Array:
    """Jackknife covariance (k, k) drawn towards the model's, enlarged by the common variance ratio of each owner.

    As variances of few degrees of freedom are drawn towards a common one (Smyth 2004), in proportion to the degrees of
    freedom; the ratio, at least 1, is the geometric mean over the owner's quantities.
    """
    ratios = np.maximum(np.diagonal(clusters) / np.maximum(np.diagonal(model), np.finfo(float).tiny), 1.0)
    groups = np.unique(owners, return_inverse=True)[1]
    factors = np.exp(np.bincount(groups, np.log(ratios)) / np.bincount(groups) / 2.0)[groups]
    common = factors[:, None] * model * factors
    return np.asarray((freedom * clusters + PRIOR_FREEDOM * common) / (freedom + PRIOR_FREEDOM))


def larger_covariance(model: Array, clusters: Array) -> Array:
    """Covariance (k, k) of the adjustment, enlarged in each direction in which the jackknife's is larger."""
    total = model + clusters
    scale = np.sqrt(np.where(np.diagonal(total) > 0.0, np.diagonal(total), 1.0))
    variances, axes = np.linalg.eigh(total / np.outer(scale, scale))
    known = variances > RANK
    root = axes[:, known] * np.sqrt(variances[known])
    inverse = root.T / variances[known, None] / scale
    shares, directions = np.linalg.eigh(inverse @ model @ inverse.T)  # of the model in the total
    spread = scale[:, None] * root @ directions * np.sqrt(np.maximum(shares, 1.0 - shares))
    return np.asarray(spread @ spread.T)


def prediction_errors(run: Run, cofactor: Cofactor, folds: int) -> Array | None:
    """Cross-validation over images: mean square (m,) of the normalised lengths of each image's residuals.

    One fold of images at a time is left out and oriented by the camera from the others. Without them the shared
    unknowns change by d, as in `cluster_covariance`, and their residuals r become r - B d (PRESS: Allen 1974, with
    images in place of observations). nan where some quantity rests on the images of a fold;
    None with too many shared unknowns.
    """
    if (shares := _shares(run, cofactor)) is None:
        return None
    images = shares.of_images
    errors = np.full(len(images), np.nan)
    for fold in (range(first, len(images), folds) for first in range(min(folds, len(images)))):
        move = _move(*map(np.concatenate, zip(*(images[image] for image in fold), strict=True)))
        if move is None:
            continue
        for image in fold:
            by_shared, right = images[image]
            errors[image] = 2.0 * float(np.mean((right - by_shared @ move) ** 2))
    return errors


class _Shares(NamedTuple):
    """Positions (k,) of the free quantities shared by images, the root of their cofactor matrix, in units of which N is
    the unit matrix, and each image's derivatives (n, k) by them and right sides (n,)."""

    positions: Indices
    root: Array
    of_images: list[tuple[Array, Array]]


def _shares(run: Run, cofactor: Cofactor) -> _Shares | None:
    unknowns = run.numbering.problem.unknowns
    positions = np.flatnonzero(unknowns.sigma[: unknowns.shared_count] > 0.0)
    if len(positions) > MOST_SHARED:
        return None
    root = np.asarray(np.linalg.cholesky(cofactor.part(positions)), dtype=np.float64)
    equations = image_equations(run.end, positions)
    return _Shares(positions, root, [(by_shared @ root, right) for _, by_shared, right in equations])


def image_equations(at: Linearised, positions: Indices) -> Iterator[tuple[int, Array, Array]]:
    """Yield the equations of each frame with marks, its own unknowns eliminated.

    Number of the frame, derivatives (n, k) by the quantities at some positions, right sides (n,).
    """
    problem = at.rows.numbering.problem
    frames = problem.network.observed_frames
    order = np.argsort(frames, kind="stable")
    own = np.append(problem.unknowns.sigma > 0.0, False)  # the last entry is ABSENT
    own[: problem.unknowns.shared_count] = False
    for rows in np.split(order, np.flatnonzero(np.diff(frames[order])) + 1):
        columns, matrix, right = problem.columns[rows], at.rows.matrix[rows], at.rows.right[rows].ravel()
        groups = positions, np.unique(columns[own[columns]])
        by, by_own = (linear_derivatives(problem, matrix, each, rows).toarray() for each in groups)
        left, sizes, _ = np.linalg.svd(by_own / np.maximum(np.linalg.norm(by_own, axis=0), 1e-300), full_matrices=False)
        basis = left[:, sizes > UNDETERMINED * sizes[:1]]
        yield int(frames[rows[0]]), by - basis @ (basis.T @ by), right - basis @ (basis.T @ right)


def _move(by_shared: Array, right: Array) -> Array | None:
    """Change of the shared unknowns without the equations of some images, in units of the root; None if
    undetermined."""
    parts, axes = np.linalg.eigh(by_shared.T @ by_shared)
    if parts.max(initial=0.0) > LARGEST_SHARE:
        return None
    return np.asarray(-axes @ (axes.T @ (by_shared.T @ right) / (1.0 - parts)))
