"""Targets that look unlike the others of their frame: dust on a small disk may leave no residual that shows it, and be
taken for another size, form or contrast of the disk.

How the targets of a frame differ by themselves, in their paint, their light and what is known of their form, is told by
all of them; the rest is noise, whose covariance each fit gives.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from measure.disks import FittedDisk

Array = NDArray[np.float64]

CHANCE = 0.01  # of doubting a good target, were its look's errors normal: of small ones a few times as many
FEWEST = 8  # that tell how much targets differ
DUST_PX = 4.0  # the shorter half axis up to which dust may pass for a disk or hide its edge: it is seldom larger
_MEDIAN_CHI2 = float(stats.chi2.median(1))
_HALVINGS = 30


def doubts(disks: Sequence[FittedDisk], predicted: Sequence[Array]) -> list[str]:
    """Why each disk may be more or less than its target, empty where it is too large for dust, or like the others;
    predicted: pixel_from_disk (2, 2) of each, right but for a factor common to all. Fewer than FEWEST tell nothing:
    then every small one is doubted."""
    if len(disks) < FEWEST:
        return [disk.smallness for disk in disks]
    looks = np.array([_look(disk, shape) for disk, shape in zip(disks, predicted, strict=True)])
    noise = np.array([disk.look_covariance for disk in disks])
    off = looks - np.median(looks, axis=0)
    spread = [_spread(off[:, k], noise[:, k, k]) for k in range(looks.shape[1])]
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(noise + np.diag(spread)), off)
    chances = stats.chi2.sf(squares, looks.shape[1])
    small = [disk.half_axes_px[1] < DUST_PX for disk in disks]
    odd = np.array(small) & (chances < CHANCE)
    return [_reason(each) if is_odd else "" for each, is_odd in zip(off, odd, strict=True)]


def _look(disk: FittedDisk, predicted: Array) -> Array:
    """(4,) logarithm of size, stretch and shear against the predicted ellipse, and of contrast: those of the symmetric
    change that makes the one ellipse the other."""
    root = _power(predicted @ predicted.T, 0.5)
    fitted = disk.pixel_from_disk @ disk.pixel_from_disk.T
    inverse = np.linalg.inv(root)
    change = inverse @ _power(root @ fitted @ root, 0.5) @ inverse
    values, vectors = np.linalg.eigh(change)
    log = (vectors * np.log(values)) @ vectors.T
    size, stretch, shear = (log[0, 0] + log[1, 1]) / 2, (log[0, 0] - log[1, 1]) / 2, log[0, 1]
    return np.array([size, stretch, shear, np.log(abs(disk.contrast_dn))])


def _power(matrix: Array, exponent: float) -> Array:
    """Of a symmetric, positive matrix (2, 2)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * values**exponent) @ vectors.T)


def _spread(off: Array, noise: Array) -> float:
    """The variance that differences have beyond their noise (n,), by their median: what is odd does not widen it."""
    low, high = 0.0, float((off**2).max())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if np.median(off**2 / (noise + middle)) > _MEDIAN_CHI2:
            low = middle
        else:
            high = middle
    return high


def _reason(off: Array) -> str:
    size, *form, contrast = off
    return (
        f"unlike the other targets: {np.exp(size):.2f} times their size, {np.exp(contrast):.2f} times their contrast, "
        f"its form {100 * np.hypot(*form):.0f} % off; dust may hide in it"
    )
