"""Consistency of measured targets: within one image, and of the points that several images show.

Targets lie off the places that an orientation predicts, together: by what the orientation is wrong, and by what lens
and film bend, which is a smooth function of the place in the image. Both are told by the targets themselves, in a
linear regression with priors, in which wrong names count little (Student's t: Lange, Little and Taylor 1989). Each
target is compared with what the others say (cross-validation), by the scatter that all show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc

from measure.noise.robust_estimation import MEDIAN_EFFICIENCY, STUDENT_FREEDOM, student_weights
from measure.targets.sheets import SheetView, focal_length, robust_view

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviations, as shares of the image's size: of shift, scale and shear; of radial distortion in the corners, of
# its third, fifth and seventh degree; of what that of the third is about another middle than the image's; of the other
# polynomials of the second to the fifth, of which the targets choose.
_PLAIN, _RADIAL, _OFF_MIDDLE, _BENDING = 0.1, (0.03, 0.01, 0.003), 0.0015, (1e-5, 1e-4, 1e-3, 1e-2)
_DEGREES = 5  # of the polynomials: the highest that a lens and a bent film need
_ROUNDS, _SETTLED = 60, 1e-3  # of weights at most; a change of them that ends the rounds
_MEDIAN = 2.0 * float(np.log(2.0))  # of chi-square (2)
_NEIGHBOURS = 8  # that tell where the image bends more than the regression
_LEAST_PX2 = 0.01**2  # the variance that no prediction falls short of
_POINT_ROUNDS = 3  # of comparing the images and gathering what they say of the points
_SPREADS, _STEPS = 10, 8  # of the points' spread anew, and of weights in each
_SPREAD = 0.01  # of the points' extent: what it is taken for at first
_LEAST = 1e-6  # of the extent: no spread is smaller
_LEAST_POINTS = 8  # fewer say nothing of one another: eight numbers tell where a sheet lies
# How wrong they may be where most points are right, of the picture's size: perspective, and what the lens does where
# its middle is not the picture's.
_PERSPECTIVE, _DECENTRED = 0.1, 0.003
_STEP = 1e-3  # of the sheet's size, for derivatives
FLAT = 0.01  # of the points' extent: a sheet may be as uneven as this


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


def compared(targets: TargetPlaces, observed_px: Array, covariance_px2: Array, size_px: tuple[int, int]) -> Comparison:
    """Compare each target of an image with what the others say of its place.

    Parameters
    ----------
    observed_px, covariance_px2 : (n, 2) and (n, 2, 2), as measured.
    size_px : width and height of the image.

    Notes
    -----
    A linear regression with priors in Student's t distribution (Lange, Little and Taylor 1989), cross-validated.
    """
    offsets = observed_px - targets.places_px
    fits = [_regression(_design(targets, size_px, bending), offsets, targets, covariance_px2) for bending in _BENDING]
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


def _regression(design: Array, offsets: Array, targets: TargetPlaces, observed_px2: Array) -> _Fit:
    """Student's t by expectation and maximisation, the scatter anew in each round."""
    off, predicted, unknowns = offsets - np.median(offsets, axis=0), np.zeros_like(observed_px2), design.shape[2]
    variances, more_px2 = _scatter(off, predicted, targets, observed_px2)
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
        variances, more_px2 = _scatter(off, predicted, targets, observed_px2)
        if np.abs(weights - before).max() < _SETTLED:
            break
    assert fit is not None
    return fit


def _squares(off: Array, covariances: Array) -> Array:
    """(n,) of how far n targets lie off, in their standard deviations."""
    return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off))


def _scatter(off: Array, predicted: Array, targets: TargetPlaces, observed_px2: Array) -> tuple[Array, Array]:
    """Of the targets about their places: (n, 2, 2) px², and (n,) px² of it that all of them scatter more than is known.

    They may scatter less than is claimed of their coordinates, or even of where they were seen; then that counts less.
    Points whose coordinates are free have a scatter of their own.
    """
    variances, more_px2 = observed_px2 + targets.covariance_px2, np.zeros(len(off))
    for group in (targets.is_free, ~targets.is_free):
        if not group.any():
            continue
        points, observed, open_px2 = (
            float(np.median(np.einsum("nii->n", one[group]))) / 2.0
            for one in (targets.covariance_px2, observed_px2, predicted)
        )
        own = max(float(np.median((off[group] ** 2).sum(axis=1))) / _MEDIAN - open_px2, _LEAST_PX2)
        of_observed = min(own / max(observed, _LEAST_PX2), 1.0)
        of_points = min(max(own - observed, 0.0) / max(points, _LEAST_PX2), 1.0) if targets.is_claim else 1.0
        known = of_observed * observed_px2[group] + of_points * targets.covariance_px2[group]
        more_px2[group] = max(own - observed - points, _LEAST_PX2)
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


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """What an image shows: index (n,), of the points; targets: where it should show them by their coordinates; by_point
    (n, 2, 3): how far the unit of each coordinate moves them, px; observed_px (n, 2) and
    covariance_px2 (n, 2, 2): where it does; size_px of the image."""

    index: NDArray[np.intp]
    targets: TargetPlaces
    by_point: Array
    observed_px: Array
    covariance_px2: Array
    size_px: tuple[int, int]

    def compared(self, off: Array, covariance: Array) -> Comparison:
        """With the points this far (n, 3) off their coordinates, known so well (n, 3, 3)."""
        moved = np.einsum("nij,nj->ni", self.by_point, off)
        known = self.by_point @ covariance @ self.by_point.swapaxes(1, 2)
        places = self.targets.places_px + moved
        targets = replace(self.targets, places_px=places, covariance_px2=known, is_claim=False)
        return compared(targets, self.observed_px, self.covariance_px2, self.size_px)


def compared_together(images: Sequence[ImagePoints], xyz: Array) -> list[Comparison]:
    """Compare each image's targets with its others and with the other images.

    Parameters
    ----------
    xyz : (m, 3) the points, along a plane and above it if they lie on one: each coordinate has a spread of its own.

    Notes
    -----
    A dot that was printed off its place, or lies on a buckle of its sheet, is off in all images; a false reading, dirt
    or glare in one alone. So each image is compared with the points as all other images show them: of each point, how
    far it is off in space, by least squares over its images, in which wrong readings count little, and a prior whose
    spread all points tell (variance components, expectation and maximisation).
    """
    extent = float(np.ptp(xyz, axis=0).max())
    spread = np.full(3, _SPREAD * extent)  # standard deviation of the points about their coordinates
    offs = np.zeros((len(images), *xyz.shape))  # of the points by all images but one
    covariances = np.zeros((*offs.shape, 3))
    comparisons = _compare_all(images, offs, covariances)
    for _ in range(_POINT_ROUNDS - 1):
        readings = _Readings.read(images, comparisons, offs)
        is_shared = (readings.squares > 0.0).sum(axis=0) > 1
        if not is_shared.any():
            break
        for _ in range(_SPREADS):
            weights, of_prior = readings.weights(spread)
            off, covariance = readings.solved(weights, of_prior, spread)
            moments = of_prior[:, None] * (off**2 + np.einsum("nii->ni", covariance))
            spread = np.maximum(np.sqrt(moments[is_shared].mean(axis=0)), _LEAST * extent)
        others = [
            readings.leave_out(i).solved(np.delete(weights, i, axis=0), of_prior, spread) for i in range(len(weights))
        ]
        offs, covariances = (np.stack(parts) for parts in zip(*others, strict=True))
        comparisons = _compare_all(images, offs, covariances)
    return comparisons


def _compare_all(images: Sequence[ImagePoints], offs: Array, covariances: Array) -> list[Comparison]:
    return [
        image.compared(off[image.index], covariance[image.index])
        for image, off, covariance in zip(images, offs, covariances, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _Readings:
    """Of i images of m points the normal equations for how far the points are off: normal (i, m, 3, 3), right (i, m, 3)
    and squares (i, m), 0 where an image does not show a point."""

    normal: Array
    right: Array
    squares: Array

    @classmethod
    def read(cls, images: Sequence[ImagePoints], comparisons: Sequence[Comparison], offs: Array) -> "_Readings":
        """What each image shows of the points that lie so far off (i, m, 3) by the others.

        Its readings are as uncertain as those of most images at least, for an image that the points were moved to would
        seem to be without any noise.
        """
        normal, right, squares = np.zeros((*offs.shape, 3)), np.zeros(offs.shape), np.zeros(offs.shape[:2])
        levels = np.array([np.median(np.einsum("nii->n", one.covariance_px2)) for one in comparisons])
        factors = np.maximum(np.median(levels) / levels, 1.0)
        for i, (image, one) in enumerate(zip(images, comparisons, strict=True)):
            offsets = one.off_px + np.einsum("nij,nj->ni", image.by_point, offs[i, image.index])
            weighted = np.linalg.solve(factors[i] * one.covariance_px2, np.dstack([image.by_point, offsets]))
            normal[i, image.index] = image.by_point.swapaxes(1, 2) @ weighted[..., :3]
            right[i, image.index] = np.einsum("nij,ni->nj", image.by_point, weighted[..., 3])
            squares[i, image.index] = np.einsum("ni,ni->n", offsets, weighted[..., 3])
        return cls(normal, right, squares)

    def leave_out(self, image: int) -> "_Readings":
        return _Readings(*(np.delete(part, image, axis=0) for part in (self.normal, self.right, self.squares)))

    def solved(self, weights: Array, of_prior: Array, spread: Array) -> tuple[Array, Array]:
        """off (m, 3) and its covariance (m, 3, 3), readings weighted (i, m) and the prior (m,)."""
        prior = of_prior[:, None, None] * np.diag(1.0 / spread**2)
        covariance = np.linalg.inv(np.einsum("im,imab->mab", weights, self.normal) + prior)
        return np.einsum("mab,im,imb->ma", covariance, weights, self.right), covariance

    def weights(self, spread: Array) -> tuple[Array, Array]:
        """(i, m) of the readings, (m,) of the prior, in Student's t distribution: from the points as they are given, or
        from where all readings together have them, whichever is likelier in the end."""
        ones = np.ones_like(self.squares)
        starts = [(ones * 1e-6, ones[0]), (ones, ones[0] * 1e-6)]
        ends = [self._settled(*start, spread) for start in starts]
        likely = np.array([self._log_likelihood(*end) for end in ends])
        best = likely.argmax(axis=0)
        readings, priors = (np.stack([student_weights(end[k], 2.0 + k) for end in ends]) for k in (0, 1))
        which = np.arange(len(best))
        return readings[best, :, which].T, priors[best, which]

    def _settled(self, weights: Array, of_prior: Array, spread: Array) -> tuple[Array, Array]:
        """(i, m) squares of the readings' distances, (m,) of the prior's, after some steps of weighting."""
        for _ in range(_STEPS):
            off, _ = self.solved(weights, of_prior, spread)
            far = self.squares - 2.0 * np.einsum("ma,ima->im", off, self.right)
            far = np.maximum(far + np.einsum("ma,imab,mb->im", off, self.normal, off), 0.0)
            of_off = ((off / spread) ** 2).sum(axis=1)
            weights, of_prior = student_weights(far, 2.0), student_weights(of_off, 3.0)
        return far, of_off

    def _log_likelihood(self, far: Array, of_off: Array) -> Array:
        """(m,) but for a constant."""
        readings = np.where(self.squares > 0.0, -(STUDENT_FREEDOM + 2.0) / 2.0 * np.log1p(far / STUDENT_FREEDOM), 0.0)
        return np.asarray(readings.sum(axis=0) - (STUDENT_FREEDOM + 3.0) / 2.0 * np.log1p(of_off / STUDENT_FREEDOM))


@dataclass(frozen=True, eq=False)
class SheetImage:
    """What a picture shows of a sheet: index (n,), of the points; observed_px (n, 2) and covariance_px2 (n, 2, 2):
    where it does; size_px of the picture."""

    index: NDArray[np.intp]
    observed_px: Array
    covariance_px2: Array
    size_px: tuple[int, int]


def along_plane(xyz: Array) -> Array:
    """(n, 3) points (n, 3) along the plane that holds them best, and above it."""
    about = xyz - xyz.mean(axis=0)
    return np.asarray(about @ np.linalg.svd(about, full_matrices=False).Vh.T)


def is_flat(along: Array) -> bool:
    """Whether points (n, 3) along a plane and above it are those of a sheet."""
    extent = np.ptp(along, axis=0)
    return bool(extent[2] <= FLAT * extent[0])


def sheet_points(pictures: Sequence[SheetImage], sheet: Array) -> list[ImagePoints | None]:
    """Where one camera's pictures should show the points of a sheet, (m, 3) along its plane and above it; None for
    those that show too few, or that no camera sees so."""
    views = [
        robust_view(sheet[picture.index, :2], picture.observed_px, picture.size_px)
        if len(picture.index) >= _LEAST_POINTS
        else None
        for picture in pictures
    ]
    focal = focal_length([view for view in views if view is not None])
    return [
        None if view is None else _image_points(picture, view, focal, sheet)
        for picture, view in zip(pictures, views, strict=True)
    ]


def _image_points(picture: SheetImage, view: SheetView, focal: float, sheet: Array) -> ImagePoints | None:
    """Where the view folds or the sheet lies behind the camera, nothing is said of a point."""
    known = np.isfinite(view.places_px(sheet[picture.index, :2])).all(axis=1)
    if known.sum() < _LEAST_POINTS:
        return None
    points, count = sheet[picture.index[known]], int(known.sum())
    by_point = view.pixel_from_space(points[:, :2], focal, _STEP * float(np.ptp(sheet[:, :2])))
    places = view.places_px(points[:, :2]) + by_point[..., 2] * points[:, 2:]
    derivatives = _view_derivatives(places, picture.size_px)
    targets = TargetPlaces(places, derivatives, np.zeros((count, 2, 2)), np.zeros(count, bool))
    observed = picture.observed_px[known], picture.covariance_px2[known]
    return ImagePoints(picture.index[known], targets, by_point, *observed, picture.size_px)


def _view_derivatives(places: Array, size_px: tuple[int, int]) -> Array:
    """(n, 2, 4) how far perspective and the lens's middle move places (n, 2), each by its standard deviation."""
    size = float(np.hypot(*size_px))
    about = (2.0 * places - (np.array(size_px) - 1.0)) / size
    products = about[:, :, None] * about[:, None, :]
    decentred = np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 2.0 * products
    return np.asarray(size * np.concatenate([_PERSPECTIVE * products, _DECENTRED * decentred], axis=2))
