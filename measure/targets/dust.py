"""Disks that may have dust on them, which may put them far off: on a small disk it may leave no residual that shows it,
and be taken for another size, form, contrast or blur of the disk.

How the targets of a frame differ by themselves, in their paint, their light and what is known of their form, is told by
all of them; the rest is noise, whose covariance each fit gives. Which of them have dust on them, how many, the frame
tells too: a mixture of normal distributions, of disks without dust, with some and with so much that their places are
wrong, fitted by expectation and maximisation (Dempster, Laird and Rubin, 1977).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from measure.noise.robust_estimation import SIGMA_OF_DEVIATION
from measure.probabilities import LARGE_ERROR, MUCH_DUST
from measure.reason import NO_REASON, Code, Reason
from measure.targets.disks import FittedDisk

Array = NDArray[np.float64]

_LARGE_PX = 0.3  # the error that a small target must not have
# What dust that moves a disk by more does to it, rms of 148 rendered disks: to size, stretch, shear, px of the radius
# (one edge is moved by twice as much as the disk), the contrast's logarithm, and the blur's variance, px².
# Then to the place with sloping paint against the matched one, px, which less dust does not move.
_DUST_APPEARANCE, _DUST_SLOPING_PX = (0.2, 0.2, 0.2, 0.3, 0.4), 0.5
_DUST = (0.0, 1 / 3, 1.5, 6.0)  # times that: none, some, and what moves a disk by 0.3 px, or is something else
# Each of these a coordinate. A few disks of each kind are moved by far more and make the rms 0.16, 0.5 and 0.6: with
# those the errors of all, and which are large, are far less likely (docs/precision.md).
_DUST_MOVES_PX = np.array([0.0, 0.08, 0.3, 0.6])
# The shares of these, as if of so many disks they had been seen before; most dust beside a disk is cut out.
_BEFORE, _WHOLE, _DAMAGED = 20.0, (0.9, 0.085, 0.0125, 0.0025), (0.56, 0.36, 0.07, 0.01)
_MUCH = slice(2, None)
_FEWEST = 8  # that tell how much targets differ
_DUST_PX = 4.0  # the shorter half axis up to which dust may pass for a disk or hide its edge: it is seldom larger
_FORM = slice(0, 3)  # size, stretch and shear among the figures of an appearance
_ROUNDS, _SETTLED = 60, 1e-4
_LEAST_SPREAD = 1e-4  # no frame's targets are alike to better than 1 %, nor is the linearisation of their noise


def doubts(disks: Sequence[FittedDisk], predicted: Sequence[Array]) -> list[Reason]:
    """Why each disk may be as far off as only dust is, or more or less than its target, empty where it is too large for
    dust and not soft, or well determined and like the others; predicted: pixel_from_disk (2, 2) of each, right but for
    a factor common to all. Fewer than _FEWEST tell nothing: then every one that dust may look like is doubted."""
    if len(disks) < _FEWEST:
        return [disk.lone_doubt for disk in disks]
    appearances = np.array([_appearance(disk, shape) for disk, shape in zip(disks, predicted, strict=True)])
    common = _common(appearances, disks)
    return [
        _doubt(disk, appearance - common.appearance, kinds)
        if disk.is_soft or disk.half_axes_px[1] < _DUST_PX
        else NO_REASON
        for disk, appearance, kinds in zip(disks, appearances, common.kinds, strict=True)
    ]


def _doubt(disk: FittedDisk, off: Array, kinds: Array) -> Reason:
    """Of one that dust may look like; off (5,): how far its appearance is from that of the others; kinds (kinds,): the
    probability of each kind of dust."""
    if kinds[_MUCH].sum() < MUCH_DUST:
        sigma = float(np.sqrt(np.linalg.eigvalsh(disk.covariance_px2)[-1]))
        chances = chdtrc(2, _LARGE_PX**2 / (sigma**2 + _DUST_MOVES_PX**2))
        if chances[0] > LARGE_ERROR:
            return Reason(f"faint: good to {sigma:.2f} px only", Code.IMPRECISE)
        hidden = Reason(f"dust that puts it {_LARGE_PX} px off may hide in it", Code.DUST)
        return hidden if chances @ kinds > LARGE_ERROR else NO_REASON
    size, *form, contrast, variance = off
    return Reason(
        f"unlike the other targets: {np.exp(size):.2f} times their size, {np.exp(contrast):.2f} times their "
        f"contrast, its form {100 * np.hypot(*form):.0f} % off, its blur by {variance:.1f} px²; dust may hide in it",
        Code.DUST,
    )


def _appearance(disk: FittedDisk, predicted: Array) -> Array:
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
    """appearance (figures,): targets without dust; kinds (n, kinds): the probabilities of dust on each."""

    appearance: Array
    kinds: Array


def _common(appearances: Array, disks: Sequence[FittedDisk]) -> _Common:
    """Of appearances (n, figures).

    Those without dust are normal about one appearance, with a spread of their own beside their noise. Form has no
    direction: stretch and shear spread alike. Damage that was seen makes more of it likely.
    """
    noise = np.array([disk.appearance_covariance for disk in disks])
    dust, by_slope = _dust_variances(disks), _by_slope(disks)
    damaged = np.array([disk.damaged_fraction > 0 for disk in disks])
    before = np.array([_WHOLE, _DAMAGED])
    shares = before
    appearance = np.median(appearances, axis=0)
    spread = np.maximum((SIGMA_OF_DEVIATION * np.median(np.abs(appearances - appearance), axis=0)) ** 2, _LEAST_SPREAD)
    kinds = np.zeros((len(_DUST), len(disks)))
    for _ in range(_ROUNDS):
        weights = np.linalg.inv(noise + np.diag(spread) + dust)
        last, off = kinds, appearances - appearance
        logs = np.log(shares[damaged.astype(int)].T) + by_slope + _log_density(off, weights)
        kinds = np.exp(logs - logs.max(axis=0))
        kinds /= kinds.sum(axis=0)
        seen = np.array([kinds[:, ~damaged].sum(axis=1), kinds[:, damaged].sum(axis=1)])
        shares = (seen + _BEFORE * before) / (seen.sum(axis=1, keepdims=True) + _BEFORE)
        clean, weights = kinds[0], weights[0]
        weighed = clean[:, None, None] * weights
        appearance = np.linalg.solve(weighed.sum(axis=0), np.einsum("nij,nj->i", weighed, appearances))
        # What of each difference is the target's own, and the variance with which noise leaves that open.
        own = spread * np.einsum("nij,nj->ni", weights, appearances - appearance)
        unknown = spread - spread**2 * np.einsum("nii->ni", weights)
        spread = np.average(own**2 + unknown, axis=0, weights=clean)
        spread[1:3] = spread[1:3].mean()
        spread = np.maximum(spread, _LEAST_SPREAD)
        if np.abs(kinds - last).max() < _SETTLED:
            break
    return _Common(appearance, kinds.T)


def _dust_variances(disks: Sequence[FittedDisk]) -> Array:
    """(kinds, n, figures, figures): what each kind of dust adds to the variances of the appearances."""
    radius = np.array([np.sqrt(np.prod(disk.half_axes_px)) for disk in disks])
    appearance = np.tile(_DUST_APPEARANCE, (len(disks), 1))
    appearance[:, _FORM] /= radius[:, None]
    return np.asarray(np.multiply.outer(np.square(_DUST), appearance[..., None] ** 2 * np.eye(len(_DUST_APPEARANCE))))


def _by_slope(disks: Sequence[FittedDisk]) -> Array:
    """(kinds, n) the logarithms of the probability densities of the places with sloping paint: these are independent of
    the appearances, for they are told by residuals. 0 where a disk has none."""
    logs = np.zeros((len(_DUST), len(disks)))
    for index, disk in enumerate(disks):
        if disk.sloping is not None:
            moved = np.tile(disk.sloping.covariance_px2, (len(_DUST), 1, 1, 1))
            moved[_MUCH] += _DUST_SLOPING_PX**2 * np.eye(2)
            logs[:, index] = _log_density(disk.sloping.offset_px[None], np.asarray(np.linalg.inv(moved), float))[:, 0]
    return logs


def _log_density(off: Array, weights: Array) -> Array:
    """(kinds, n) of normal distributions, but for a constant, for off (n, figures) and the inverses of the covariances
    (kinds, n, figures, figures)."""
    squares = np.einsum("ni,knij,nj->kn", off, weights, off)
    return np.asarray((np.linalg.slogdet(weights)[1] - squares) / 2)
