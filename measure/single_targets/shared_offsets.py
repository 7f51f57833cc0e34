"""Where the other targets of an image put each of them, and how likely a right one lies as far off as it was seen.

Targets lie off the places that an orientation predicts, together: by what the orientation is wrong, and by what lens
and film bend, which is a smooth function of the place in the image. Both are told by the targets themselves, in a
linear regression with priors, in which wrong names count little (Student's t: Lange, Little and Taylor 1989). Each
target is compared with what the others say (cross-validation), by the scatter that all show.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc

from measure.noise.robust_estimation import MEDIAN_EFFICIENCY, student_weights

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviations, as shares of the image's size: of shift, scale and shear; of radial distortion in the corners, of
# its third, fifth and seventh degree; of what that of the third is about another middle than the image's; of the other
# polynomials of the second to the fifth, of which the targets choose.
_PLAIN, _RADIAL, _OFF_MIDDLE, _BENDING = 0.1, (0.03, 0.01, 0.003), 0.0015, (1e-5, 1e-4, 1e-3, 1e-2)
_DEGREES = 5
_ROUNDS, _SETTLED = 60, 1e-3
_MEDIAN = 2.0 * float(np.log(2.0))  # of chi-square (2)
_NEIGHBOURS = 8  # that tell where the image bends more than the regression
_LEAST_PX2 = 0.01**2  # the variance that no prediction falls short of


@dataclass(frozen=True, eq=False)
class TargetPlaces:
    """Of n targets: places_px (n, 2) as predicted; by_orientation (n, 2, k): how far each unknown of the orientation
    moves them by its standard deviation; covariance_px2 (n, 2, 2): of what is known beside it, as of the points'
    coordinates; is_free (n,): those of whose coordinates nobody says how good they are; is_claim: that covariance is
    said by someone, and may be too large, not computed."""

    places_px: Array
    by_orientation: Array
    covariance_px2: Array
    is_free: Mask
    is_claim: bool = True


@dataclass(frozen=True, eq=False)
class Comparison:
    """Of n targets, each without itself: off_px (n, 2), how far it was seen from where the others put it; chance (n,):
    that a right one lies so far off or farther; covariance_px2 (n, 2, 2): of how far off it was seen, were its own
    coordinates exact."""

    off_px: Array
    chance: Array
    covariance_px2: Array


def compared(targets: TargetPlaces, seen_px: Array, covariance_px2: Array, size_px: tuple[int, int]) -> Comparison:
    """Targets seen at (n, 2) px with covariances (n, 2, 2), in an image of this width and height."""
    offsets = seen_px - targets.places_px
    fits = [_fitted(_design(targets, size_px, bending), offsets, targets, covariance_px2) for bending in _BENDING]
    best = min(fits, key=lambda fit: float(np.median(np.linalg.norm(fit.off_px, axis=1))))
    own = covariance_px2 + best.more_px2[:, None, None] * np.eye(2)
    return Comparison(best.off_px, _chances(best, targets), own + best.predicted_px2)


def _design(targets: TargetPlaces, size_px: tuple[int, int], bending: float) -> Array:
    """(n, 2, m) how far each unknown moves the targets by its standard deviation, px: the orientation, the lens, and
    what is smooth."""
    size = float(np.hypot(*size_px))
    places = 2.0 * (targets.places_px - (np.array(size_px) - 1.0) / 2.0) / size
    square = (places**2).sum(axis=1, keepdims=True)
    radial = [share * size * places * square ** (k + 1) for k, share in enumerate(_RADIAL)]
    off_middle = _OFF_MIDDLE * size * (square[:, :, None] * np.eye(2) + 2.0 * places[:, :, None] * places[:, None, :])
    along, across = (np.polynomial.legendre.legvander(one, _DEGREES) for one in places.T)
    smooth = [
        (_PLAIN if i + j < 2 else bending) * size * along[:, i] * across[:, j]
        for i in range(_DEGREES + 1)
        for j in range(_DEGREES + 1 - i)
    ]
    both = np.einsum("kn,ij->nikj", smooth, np.eye(2)).reshape(len(places), 2, -1)
    return np.concatenate([targets.by_orientation, np.stack(radial, axis=-1), off_middle, both], axis=2)


@dataclass(frozen=True, eq=False)
class _Fit:
    """off_px (n, 2), squares (n,): each target against the others, the latter in its variances; unknowns: how many the
    n targets tell; predicted_px2 (n, 2, 2): of what the others say; more_px2 (n,): what all scatter more than is
    known."""

    off_px: Array
    squares: Array
    unknowns: float
    predicted_px2: Array
    more_px2: Array


def _fitted(design: Array, offsets: Array, targets: TargetPlaces, seen_px2: Array) -> _Fit:
    """Student's t by expectation and maximisation, the scatter anew in each round."""
    off, predicted, unknowns = offsets - np.median(offsets, axis=0), np.zeros_like(seen_px2), design.shape[2]
    variances, more_px2 = _scatter(off, predicted, targets, seen_px2)
    weights = student_weights(_squares(off, variances), 2.0)
    fit = None
    for _ in range(_ROUNDS):
        spread = variances / weights[:, None, None]
        by_weight = np.linalg.inv(spread)
        weighted = (by_weight @ design).reshape(-1, unknowns)
        cofactor = np.linalg.inv(np.eye(unknowns) + weighted.T @ design.reshape(-1, unknowns))
        hat = design @ cofactor @ design.swapaxes(1, 2)
        without = np.linalg.inv(spread - hat)  # of what the target itself adds to the fit
        residuals = offsets - design @ (cofactor @ (weighted.T @ offsets.ravel()))
        off = (spread @ without @ residuals[..., None])[..., 0]
        predicted = hat + hat @ without @ hat
        squares = _squares(off, variances + predicted)
        before, weights = weights, student_weights(squares, 2.0)
        fit = _Fit(off, squares, float(np.einsum("nij,nji->", hat, by_weight)), predicted, more_px2)
        variances, more_px2 = _scatter(off, predicted, targets, seen_px2)
        if np.abs(weights - before).max() < _SETTLED:
            break
    assert fit is not None
    return fit


def _squares(off: Array, covariances: Array) -> Array:
    """(n,) of how far n targets lie off, in their standard deviations."""
    return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off))


def _scatter(off: Array, predicted: Array, targets: TargetPlaces, seen_px2: Array) -> tuple[Array, Array]:
    """Of the targets about their places: (n, 2, 2) px², and (n,) px² of it that all of them scatter more than is known.

    They may scatter less than is claimed of their coordinates, or even of where they were seen; then that counts less.
    Points whose coordinates are free have a scatter of their own.
    """
    variances, more_px2 = seen_px2 + targets.covariance_px2, np.zeros(len(off))
    for group in (targets.is_free, ~targets.is_free):
        if not group.any():
            continue
        points, seen, open_px2 = (
            float(np.median(np.einsum("nii->n", one[group]))) / 2.0
            for one in (targets.covariance_px2, seen_px2, predicted)
        )
        own = max(float(np.median((off[group] ** 2).sum(axis=1))) / _MEDIAN - open_px2, _LEAST_PX2)
        of_seen = min(own / max(seen, _LEAST_PX2), 1.0)
        of_points = min(max(own - seen, 0.0) / max(points, _LEAST_PX2), 1.0) if targets.is_claim else 1.0
        known = of_seen * seen_px2[group] + of_points * targets.covariance_px2[group]
        more_px2[group] = max(own - seen - points, _LEAST_PX2)
        variances[group] = known + more_px2[group][:, None, None] * np.eye(2)
    return variances, more_px2


def _chances(fit: _Fit, targets: TargetPlaces) -> Array:
    """(n,) of lying farther off: the scatter is as good as those that tell it, and as large as that nearby."""
    count = min(_NEIGHBOURS + 1, len(fit.squares))
    near = np.asarray(cKDTree(targets.places_px).query(targets.places_px, k=np.arange(2, count + 1))[1])
    local = np.median(fit.squares[near], axis=1) / _MEDIAN
    chance = np.ones(len(fit.squares))
    for group in (targets.is_free, ~targets.is_free):
        share = group.sum() / len(group)
        freedom = MEDIAN_EFFICIENCY * share * (2.0 * len(group) - fit.unknowns)
        if freedom > 1.0:
            chance[group] = fdtrc(2, freedom, fit.squares[group] / np.maximum(local[group], 1.0) / 2.0)
    return chance
