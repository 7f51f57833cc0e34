"""Targets that look unlike the others of their frame: dust on a small disk may leave no residual that shows it, and be
taken for another size, form, contrast or blur of the disk.

How the targets of a frame differ by themselves, in their paint, their light and what is known of their form, is told by
all of them; the rest is noise, whose covariance each fit gives. Some are odd, how many, the frame tells too: a mixture
of two normal distributions, fitted by expectation and maximisation (Dempster, Laird and Rubin, 1977).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from measure.disks import FittedDisk

Array = NDArray[np.float64]

DOUBT = 0.05  # the probability of being odd from which on a target is weak
ODD = 9.0  # times the variance of the others, where one is odd: its differences are three times theirs
ODD_BEFORE = (1.0, 4.0)  # odd ones and others, as if so many had been seen before: a beta distribution
FEWEST = 8  # that tell how much targets differ
DUST_PX = 4.0  # the shorter half axis up to which dust may pass for a disk or hide its edge: it is seldom larger
LARGE_PX, LARGE_CHANCE = 0.3, 0.001  # the error that a small target must not have, and the chance of it that is borne
_LARGE_SIGMAS = float(stats.chi2.isf(LARGE_CHANCE, 2) ** 0.5)
_FORM = slice(1, 3)  # stretch and shear among a look's figures
_ROUNDS = 60
_LEAST_SPREAD = 1e-4  # no frame's targets are alike to better than 1 %, nor is the linearisation of their noise


def doubts(disks: Sequence[FittedDisk], predicted: Sequence[Array]) -> list[str]:
    """Why each disk may be more or less than its target, or as far off as only dust is, empty where it is too large for
    dust and not soft, or well determined and like the others; predicted: pixel_from_disk (2, 2) of each, right but for
    a factor common to all. Fewer than FEWEST tell nothing: then every one that dust may look like is doubted."""
    if len(disks) < FEWEST:
        return [disk.lone_doubt for disk in disks]
    looks = np.array([_look(disk, shape) for disk, shape in zip(disks, predicted, strict=True)])
    common = _common(looks, np.array([disk.look_covariance for disk in disks]))
    return [
        _doubt(disk, look - common.look, odd) if disk.is_soft or disk.half_axes_px[1] < DUST_PX else ""
        for disk, look, odd in zip(disks, looks, common.odd.tolist(), strict=True)
    ]


def _doubt(disk: FittedDisk, off: Array, odd: float) -> str:
    """Of one that dust may look like; off (5,): how far its look is from that of the others."""
    if odd > DOUBT:
        size, *form, contrast, variance = off
        return (
            f"unlike the other targets: {np.exp(size):.2f} times their size, {np.exp(contrast):.2f} times their "
            f"contrast, its form {100 * np.hypot(*form):.0f} % off, its blur by {variance:.1f} px²; dust may hide in it"
        )
    sigma = float(np.sqrt(np.linalg.eigvalsh(disk.covariance_px2)[-1]))
    return f"faint: good to {sigma:.2f} px only" if sigma * _LARGE_SIGMAS > LARGE_PX else ""


def _look(disk: FittedDisk, predicted: Array) -> Array:
    """(5,) logarithm of size, stretch and shear against the predicted ellipse, those of the symmetric change that makes
    the one ellipse the other, and of contrast; the blur's variance, px²."""
    root = _power(predicted @ predicted.T, 0.5)
    fitted = disk.pixel_from_disk @ disk.pixel_from_disk.T
    inverse = np.linalg.inv(root)
    change = inverse @ _power(root @ fitted @ root, 0.5) @ inverse
    values, vectors = np.linalg.eigh(change)
    log = (vectors * np.log(values)) @ vectors.T
    size, stretch, shear = (log[0, 0] + log[1, 1]) / 2, (log[0, 0] - log[1, 1]) / 2, log[0, 1]
    return np.array([size, stretch, shear, np.log(abs(disk.contrast_dn)), disk.blur_px**2])


def _power(matrix: Array, exponent: float) -> Array:
    """Of a symmetric, positive matrix (2, 2)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * values**exponent) @ vectors.T)


class _Common(NamedTuple):
    """look (figures,): what targets look like that are not odd; odd (n,): the probability that each is."""

    look: Array
    odd: Array


def _common(looks: Array, noise: Array) -> _Common:
    """Of looks (n, figures) and the covariances of their noise (n, figures, figures).

    Those that are not odd are normal about one look, with a spread of their own beside their noise. Form has no
    direction: stretch and shear spread alike.
    """
    look = np.median(looks, axis=0)
    spread = np.maximum((1.4826 * np.median(np.abs(looks - look), axis=0)) ** 2, _LEAST_SPREAD)
    share = ODD_BEFORE[0] / sum(ODD_BEFORE)
    for _ in range(_ROUNDS):
        weights = np.linalg.inv(noise + np.diag(spread))
        off = looks - look
        squares = np.einsum("ni,nij,nj->n", off, weights, off)
        log_odds = np.log(share / (1 - share)) - looks.shape[1] / 2 * np.log(ODD) + squares / 2 * (1 - 1 / ODD)
        odd = 1 / (1 + np.exp(-np.clip(log_odds, -500, 500)))
        share = (odd.sum() + ODD_BEFORE[0]) / (len(looks) + sum(ODD_BEFORE))
        weighed = (1 - odd)[:, None, None] * weights
        look = np.linalg.solve(weighed.sum(axis=0), np.einsum("nij,nj->i", weighed, looks))
        # What of each difference is the target's own, and the variance with which noise leaves that open.
        own = spread * np.einsum("nij,nj->ni", weights, looks - look)
        unknown = spread - spread**2 * np.einsum("nii->ni", weights)
        spread = np.average(own**2 + unknown, axis=0, weights=1 - odd)
        spread[_FORM] = spread[_FORM].mean()
        spread = np.maximum(spread, _LEAST_SPREAD)
    return _Common(look, odd)
