"""A covariance of the cameras that does not trust residuals of one image to be independent: images are its clusters."""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices
from adjust.least_squares.iteration import Linearised
from adjust.least_squares.numbering import Numbering

FEWEST_IMAGES = 5  # from which on the scatter over images tells a standard deviation, to about a third of it
MOST_SHARED = 300  # quantities that images share: unknown points make them many, and the matrix is of all of them
LARGEST_SHARE = 0.999  # of one image in what is known of some combination of unknowns: more rests on that image alone


def shared_positions(numbering: Numbering) -> Indices:
    """Positions of the free quantities that are not of single images."""
    unknowns = numbering.problem.unknowns
    return np.flatnonzero(unknowns.sigma[: unknowns.shared_count] > 0.0)


def cluster_covariance(numbering: Numbering, end: Linearised, cofactor: Array) -> Array | None:
    """The covariance (k, k) of the quantities at `shared_positions` by a delete-one-image jackknife.

    Each image is left out of the normal equations in turn. With N the normal matrix of the shared unknowns, N_i the
    part of image i, its own unknowns eliminated, and g_i its share of the right side, the shared unknowns move by
    d_i = -(N - N_i)^-1 g_i. The covariance is (m - 1) / m times the sum of (d_i - d)(d_i - d)' (Efron 1982; MacKinnon
    and White 1985, with images as clusters). It holds however errors within an image are correlated, as those of a lens
    that the model lacks are.

    Parameters
    ----------
    numbering, end : the unknowns, and the rows at the solution
    cofactor : (k, k) of the shared quantities, at sigma0 = 1

    Returns
    -------
    None with fewer than FEWEST_IMAGES images, or where something rests on one image alone.
    """
    shares = _shares(numbering, end, cofactor)
    if len(shares) < FEWEST_IMAGES:
        return None
    moves = [_move(share.by_shared, share.right) for share in shares]
    if any(move is None for move in moves):
        return None
    spread = np.array(moves) @ np.linalg.cholesky(cofactor).T
    spread -= spread.mean(axis=0)
    return np.asarray((len(shares) - 1) / len(shares) * spread.T @ spread)


def prediction_errors(numbering: Numbering, end: Linearised, cofactor: Array, folds: int) -> Array | None:
    """How well images are predicted by others: the mean square (m,) of the lengths of each image's residuals.

    Every so many images are left out together, and oriented by the camera of the others. Without them the shared
    unknowns move by d, as `cluster_covariance` has it, and their residuals r become r - B d (Allen 1974, with images in
    place of observations). Lengths are over the standard deviations of coordinates.

    Parameters
    ----------
    numbering, end, cofactor : as for `cluster_covariance`
    folds : how often images are left out

    Returns
    -------
    None where something rests on images that are left out together.
    """
    shares = _shares(numbering, end, cofactor)
    errors = np.zeros(len(shares))
    for fold in (range(first, len(shares), folds) for first in range(min(folds, len(shares)))):
        equations = (shares[image].by_shared for image in fold), (shares[image].right for image in fold)
        move = _move(*map(np.concatenate, map(list, equations)))
        if move is None:
            return None
        for image in fold:
            errors[image] = 2.0 * float(np.mean((shares[image].right - shares[image].by_shared @ move) ** 2))
    return errors


@dataclass(frozen=True, eq=False)
class _Share:
    """The equations of an image after elimination of their own unknowns: derivatives (n, k) by the shared ones, in
    units of the root of their cofactor matrix, by which N becomes the unit matrix; and right sides (n,)."""

    by_shared: Array
    right: Array


def _shares(numbering: Numbering, end: Linearised, cofactor: Array) -> list[_Share]:
    """Those of each image that has marks, in the network's order."""
    problem = numbering.problem
    images, shared = problem.network.frame_numbers[problem.image_numbers], shared_positions(numbering)
    root = np.asarray(np.linalg.cholesky(cofactor), dtype=np.float64)
    free = np.append(numbering.problem.unknowns.sigma > 0.0, False)  # the last stands for ABSENT
    shares = []
    for image in np.unique(images):
        rows = images == image
        columns, matrix, right = problem.columns[rows], end.rows.matrix[rows], end.rows.right[rows].ravel()
        own = np.setdiff1d(np.unique(columns[free[columns]]), shared)
        by_shared, by_own = (_by_unknowns(columns, matrix, each, len(free)) for each in (shared, own))
        basis = np.linalg.qr(by_own)[0]
        by_shared, right = by_shared - basis @ (basis.T @ by_shared), right - basis @ (basis.T @ right)
        shares.append(_Share(by_shared @ root, right))
    return shares


def _move(by_shared: Array, right: Array) -> Array | None:
    """By how much the shared unknowns move without the equations of some images, in units of the root."""
    parts, axes = np.linalg.eigh(by_shared.T @ by_shared)
    if parts.max(initial=0.0) > LARGEST_SHARE:
        return None
    return np.asarray(-axes @ (axes.T @ (by_shared.T @ right) / (1.0 - parts)))


def _by_unknowns(columns: Indices, matrix: Array, positions: Indices, count: int) -> Array:
    """The derivatives (2 n, k) by the quantities at some positions, from those (n, 2, j) at columns (n, j)."""
    place = np.full(count, len(positions), dtype=np.intp)
    place[positions] = np.arange(len(positions))
    dense = np.zeros((len(columns), len(positions) + 1, 2))
    np.add.at(dense, (np.arange(len(columns))[:, None], place[columns]), matrix.transpose(0, 2, 1))
    return np.asarray(dense[:, :-1].transpose(0, 2, 1).reshape(2 * len(columns), -1))
