"""A covariance of the cameras that does not trust residuals of one image to be independent: images are its clusters."""

import numpy as np

from adjust.array_types import Array, Indices, Mask
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
    problem = numbering.problem
    images = problem.network.frame_numbers[problem.image_numbers]
    clusters = np.unique(images)
    if len(clusters) < FEWEST_IMAGES:
        return None
    root = np.asarray(np.linalg.cholesky(cofactor), dtype=np.float64)
    moves = [_move(problem.columns, end, images == each, numbering, root) for each in clusters]
    if any(move is None for move in moves):
        return None
    spread = np.array(moves) @ root.T
    spread -= spread.mean(axis=0)
    return np.asarray((len(clusters) - 1) / len(clusters) * spread.T @ spread)


def _move(columns: Indices, end: Linearised, rows: Mask, numbering: Numbering, root: Array) -> Array | None:
    """By how much the shared unknowns move without the observations of one image, in units of `root`.

    root: the triangle L of their cofactor matrix L L', by which N becomes the unit matrix.
    """
    shared = shared_positions(numbering)
    columns, matrix, right = columns[rows], end.rows.matrix[rows], end.rows.right[rows].ravel()
    free = np.append(numbering.problem.unknowns.sigma > 0.0, False)  # the last stands for ABSENT
    own = np.setdiff1d(np.unique(columns[free[columns]]), shared)
    by_shared, by_own = (_by_unknowns(columns, matrix, each, len(free)) for each in (shared, own))
    basis = np.linalg.qr(by_own)[0]
    by_shared, right = by_shared - basis @ (basis.T @ by_shared), right - basis @ (basis.T @ right)
    by_shared = by_shared @ root
    shares, axes = np.linalg.eigh(by_shared.T @ by_shared)
    if shares.max(initial=0.0) > LARGEST_SHARE:
        return None
    return np.asarray(-axes @ (axes.T @ (by_shared.T @ right) / (1.0 - shares)))


def _by_unknowns(columns: Indices, matrix: Array, positions: Indices, count: int) -> Array:
    """The derivatives (2 n, k) by the quantities at some positions, from those (n, 2, j) at columns (n, j)."""
    place = np.full(count, len(positions), dtype=np.intp)
    place[positions] = np.arange(len(positions))
    dense = np.zeros((len(columns), len(positions) + 1, 2))
    np.add.at(dense, (np.arange(len(columns))[:, None], place[columns]), matrix.transpose(0, 2, 1))
    return np.asarray(dense[:, :-1].transpose(0, 2, 1).reshape(2 * len(columns), -1))
