"""Consistency of measured targets, within one image and across the images of a sheet.

Targets deviate together from the places that an approximate orientation predicts: by the error of the orientation, and
by lens distortion and film deformation, a smooth function of the image coordinates. A linear regression with priors
estimates both from the targets themselves; Student's t distribution makes it robust against wrong identifications
(Lange, Little and Taylor 1989). Each target is then tested against the prediction from the others (cross-validation).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc

from measure.array_types import Array, Mask
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY, STUDENT_FREEDOM, student_weights
from measure.targets.sheets import SheetView, fit_view_robustly, focal_length

# Prior standard deviations, in image diagonals: shift, scale and shear; radial distortion of degree 3, 5 and 7 in the
# corners; decentring of the third degree; candidates for the polynomials of degree 2 to 5, chosen by the targets.
_PLAIN, _RADIAL, _OFF_MIDDLE, _BENDING = 0.1, (0.03, 0.01, 0.003), 0.0015, (1e-5, 1e-4, 1e-3, 1e-2)
_DEGREES = 5  # highest degree of the polynomials
_ROUNDS, _SETTLED = 60, 1e-3  # largest number of reweightings; change of the weights at convergence
_MEDIAN = 2.0 * float(np.log(2.0))  # of the chi-square distribution with 2 degrees of freedom
_NEIGHBOURS = 8  # used for the local scatter, where the image deforms more than the regression
_LEAST_PX2 = 0.01**2  # lower bound of variances
_POINT_ROUNDS = 3  # of alternating between images and points
_SPREADS, _STEPS = 10, 8  # iterations of the points' spread, and of the weights in each
_SPREAD = 0.01  # initial spread, in extents of the points
_LEAST = 1e-6  # lower bound of the spread, in extents
_LEAST_POINTS = 8  # a homography alone has eight parameters
_PERSPECTIVE, _DECENTRED = 0.1, 0.003  # prior standard deviations of a view, in image diagonals
_STEP = 1e-3  # of numerical derivatives, in sizes of the sheet
FLAT = 0.01  # unevenness of a sheet, in extents of the points


@dataclass(frozen=True, eq=False)
class TargetPlaces:
    """Predicted places of n targets.

    Attributes
    ----------
    places_px : (n, 2).
    by_orientation : (n, 2, k) shift by one standard deviation of each unknown of the orientation.
    covariance_px2 : (n, 2, 2) from all other sources, such as the object coordinates.
    is_free : (n,) targets whose object coordinates have no stated standard deviation.
    is_claim : whether covariance_px2 was stated by the user, and may be too large, instead of computed.
    """

    places_px: Array
    by_orientation: Array
    covariance_px2: Array
    is_free: Mask
    is_claim: bool = True


@dataclass(frozen=True, eq=False)
class TargetComparison:
    """Each of n targets against the prediction from the others.

    Attributes
    ----------
    off_px : (n, 2) observed minus predicted.
    p_values : (n,) of that deviation.
    covariance_px2 : (n, 2, 2) of off_px for exact object coordinates.
    printed_off_px : (n, 2) observed minus the place of the given coordinates, moved off the sheet only.
    """

    off_px: Array
    p_values: Array
    covariance_px2: Array
    printed_off_px: Array


def compare_targets(
    targets: TargetPlaces, observed_px: Array, covariance_px2: Array, size_px: tuple[int, int]
) -> TargetComparison:
    """Test each target of an image against the others.

    Parameters
    ----------
    observed_px, covariance_px2 : (n, 2) and (n, 2, 2), as measured.
    size_px : width and height of the image.

    Notes
    -----
    Cross-validated linear regression with priors and Student's t errors (Lange, Little and Taylor 1989).
    """
    offsets = observed_px - targets.places_px
    fits = [_regression(_design(targets, size_px, bending), offsets, targets, covariance_px2) for bending in _BENDING]
    best = min(fits, key=lambda fit: float(np.median(np.linalg.norm(fit.off_px, axis=1))))
    own = covariance_px2 + best.more_px2[:, None, None] * np.eye(2)
    return TargetComparison(best.off_px, _p_values(best, targets), own + best.predicted_px2, best.off_px)


def _design(targets: TargetPlaces, size_px: tuple[int, int], bending: float) -> Array:
    """(n, 2, m) shift by one standard deviation of each unknown, px: orientation, lens, polynomials."""
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
class _Regression:
    """Cross-validated regression of n targets. off_px (n, 2): observed minus predicted; squares (n,): squared
    Mahalanobis distances; unknowns: effective number; predicted_px2 (n, 2, 2): covariance of the prediction; more_px2
    (n,): unexplained variance per coordinate."""

    off_px: Array
    squares: Array
    unknowns: float
    predicted_px2: Array
    more_px2: Array


def _regression(design: Array, offsets: Array, targets: TargetPlaces, observed_px2: Array) -> _Regression:
    """Regression with Student's t errors by expectation-maximisation; the scatter is re-estimated in each round."""
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
        without = np.linalg.inv(spread - hat)  # leaves the target itself out of its prediction
        residuals = offsets - design @ (cofactor @ (weighted.T @ offsets.ravel()))
        off = (spread @ without @ residuals[..., None])[..., 0]
        predicted = hat + hat @ without @ hat
        squares = _squares(off, variances + predicted)
        before, weights = weights, student_weights(squares, 2.0)
        fit = _Regression(off, squares, float(np.einsum("nij,nji->", hat, by_weight)), predicted, more_px2)
        variances, more_px2 = _scatter(off, predicted, targets, observed_px2)
        if np.abs(weights - before).max() < _SETTLED:
            break
    assert fit is not None
    return fit


def _squares(off: Array, covariances: Array) -> Array:
    """(n,) squared Mahalanobis distances."""
    return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off))


def _scatter(off: Array, predicted: Array, targets: TargetPlaces, observed_px2: Array) -> tuple[Array, Array]:
    """Covariances of the targets about their places (n, 2, 2) px², and the unexplained part (n,) px².

    Where the targets scatter less than stated, the stated covariances are reduced: those of the object coordinates
    first, then those of the measurement. Points with free coordinates have a scatter of their own.
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


def _p_values(fit: _Regression, targets: TargetPlaces) -> Array:
    """(n,) p-values of the deviations: F-distributed, since the scatter is estimated; scaled by the local scatter."""
    count = min(_NEIGHBOURS + 1, len(fit.squares))
    if count < 2:  # a target without others
        return np.ones(len(fit.squares))
    near = np.asarray(cKDTree(targets.places_px).query(targets.places_px, k=np.arange(2, count + 1))[1])
    local = np.median(fit.squares[near], axis=1) / _MEDIAN
    p_values = np.ones(len(fit.squares))
    for group in (targets.is_free, ~targets.is_free):
        share = group.sum() / len(group)
        freedom = MEDIAN_EFFICIENCY * share * (2.0 * len(group) - fit.unknowns)
        if freedom > 1.0:
            p_values[group] = fdtrc(2, freedom, fit.squares[group] / np.maximum(local[group], 1.0) / 2.0)
    return p_values


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """Observations of points in one image.

    Attributes
    ----------
    index : (n,) of the points.
    targets : places predicted from the given coordinates.
    by_point : (n, 2, 3) derivatives of the places by the point's coordinates, px per unit.
    observed_px, covariance_px2 : (n, 2) and (n, 2, 2), as measured.
    size_px : width and height of the image.
    """

    index: NDArray[np.intp]
    targets: TargetPlaces
    by_point: Array
    observed_px: Array
    covariance_px2: Array
    size_px: tuple[int, int]

    def compare(self, off: Array, covariance: Array) -> TargetComparison:
        """Test the image with corrections off (n, 3) to its points, of covariance (n, 3, 3)."""
        moved = np.einsum("nij,nj->ni", self.by_point, off)
        known = self.by_point @ covariance @ self.by_point.swapaxes(1, 2)
        places = self.targets.places_px + moved
        targets = replace(self.targets, places_px=places, covariance_px2=known, is_claim=False)
        compared = compare_targets(targets, self.observed_px, self.covariance_px2, self.size_px)
        along_sheet = np.einsum("nij,nj->ni", self.by_point[..., :2], off[:, :2])
        return replace(compared, printed_off_px=compared.off_px + along_sheet)


def compare_images(images: Sequence[ImagePoints], xyz: Array) -> list[TargetComparison]:
    """Test the targets of each image against its other targets and against the other images.

    Parameters
    ----------
    xyz : (m, 3) the points, in a plane and normal to it if they lie on one: each coordinate has its own spread.

    Notes
    -----
    A misprinted dot, or one on a buckle of the sheet, deviates in all images; a wrong identification, dirt or glare in
    one only. Each image is therefore compared with the points as estimated from all other images: a correction per
    point by robust least squares, with a prior whose spread is a variance component of all points (by
    expectation-maximisation).
    """
    extent = float(np.ptp(xyz, axis=0).max())
    spread = np.full(3, _SPREAD * extent)  # standard deviations of the corrections to the points
    offs = np.zeros((len(images), *xyz.shape))  # corrections from all images but one
    covariances = np.zeros((*offs.shape, 3))
    for round_number in range(_POINT_ROUNDS):
        comparisons = [
            image.compare(off[image.index], covariance[image.index])
            for image, off, covariance in zip(images, offs, covariances, strict=True)
        ]
        if round_number == _POINT_ROUNDS - 1:
            break
        readings = _Readings.read(images, comparisons, offs)
        is_shared = (readings.squares > 0.0).sum(axis=0) > 1
        if not is_shared.any():
            break
        for _ in range(_SPREADS):
            weights, of_prior = readings.weights(spread)
            off, covariance = readings.solve(weights, of_prior, spread)
            moments = of_prior[:, None] * (off**2 + np.einsum("nii->ni", covariance))
            spread = np.maximum(np.sqrt(moments[is_shared].mean(axis=0)), _LEAST * extent)
        for i in range(len(images)):
            parts = readings.normal, readings.right, readings.squares
            others = _Readings(*(np.delete(part, i, axis=0) for part in parts))
            offs[i], covariances[i] = others.solve(np.delete(weights, i, axis=0), of_prior, spread)
    return comparisons


@dataclass(frozen=True, eq=False)
class _Readings:
    """Normal equations of the corrections to m points, from each of i images: normal (i, m, 3, 3), right (i, m, 3),
    squares (i, m); 0 where an image does not show a point."""

    normal: Array
    right: Array
    squares: Array

    @classmethod
    def read(cls, images: Sequence[ImagePoints], comparisons: Sequence[TargetComparison], offs: Array) -> "_Readings":
        """Form the normal equations of each image about corrections (i, m, 3) from the others.

        An image's covariances are enlarged to the median of all images: the points may have been fitted to it, and it
        would then seem free of noise.
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

    def solve(self, weights: Array, of_prior: Array, spread: Array) -> tuple[Array, Array]:
        """Corrections (m, 3) and their covariance (m, 3, 3), for weights of the images (i, m) and of the prior (m,)."""
        prior = of_prior[:, None, None] * np.diag(1.0 / spread**2)
        covariance = np.linalg.inv(np.einsum("im,imab->mab", weights, self.normal) + prior)
        return np.einsum("mab,im,imb->ma", covariance, weights, self.right), covariance

    def weights(self, spread: Array) -> tuple[Array, Array]:
        """Student's t weights of the images (i, m) and of the prior (m,). Iterated from two starts, the given
        coordinates and the unweighted estimate; the likelier end is taken."""
        ones = np.ones_like(self.squares)
        starts = [(ones * 1e-6, ones[0]), (ones, ones[0] * 1e-6)]
        ends = [self._reweight(*start, spread) for start in starts]
        likely = []  # log-likelihoods (m,) up to a constant
        for far, of_off in ends:
            by_image = -(STUDENT_FREEDOM + 2.0) / 2.0 * np.log1p(far / STUDENT_FREEDOM)
            of_prior = (STUDENT_FREEDOM + 3.0) / 2.0 * np.log1p(of_off / STUDENT_FREEDOM)
            likely.append(np.where(self.squares > 0.0, by_image, 0.0).sum(axis=0) - of_prior)
        best = np.array(likely).argmax(axis=0)
        readings, priors = (np.stack([student_weights(end[k], 2.0 + k) for end in ends]) for k in (0, 1))
        which = np.arange(len(best))
        return readings[best, :, which].T, priors[best, which]

    def _reweight(self, weights: Array, of_prior: Array, spread: Array) -> tuple[Array, Array]:
        """Squared Mahalanobis distances of the images (i, m) and of the prior (m,) after some reweightings."""
        for _ in range(_STEPS):
            off, _ = self.solve(weights, of_prior, spread)
            far = self.squares - 2.0 * np.einsum("ma,ima->im", off, self.right)
            far = np.maximum(far + np.einsum("ma,imab,mb->im", off, self.normal, off), 0.0)
            of_off = ((off / spread) ** 2).sum(axis=1)
            weights, of_prior = student_weights(far, 2.0), student_weights(of_off, 3.0)
        return far, of_off


@dataclass(frozen=True, eq=False)
class SheetImage:
    """Observations of a sheet in one image. index (n,): of the points; observed_px (n, 2), covariance_px2 (n, 2, 2);
    size_px: of the image."""

    index: NDArray[np.intp]
    observed_px: Array
    covariance_px2: Array
    size_px: tuple[int, int]


def plane_coordinates(xyz: Array) -> Array:
    """(n, 3) coordinates of points (n, 3) in their best-fitting plane, and normal to it."""
    about = xyz - xyz.mean(axis=0)
    return np.asarray(about @ np.linalg.svd(about, full_matrices=False).Vh.T)


def is_flat(along: Array) -> bool:
    """Whether points (n, 3), in a plane and normal to it, form a flat sheet."""
    extent = np.ptp(along, axis=0)
    return bool(extent[2] <= FLAT * extent[0])


def predict_sheet_points(pictures: Sequence[SheetImage], sheet: Array) -> list[ImagePoints | None]:
    """Predict the points of a sheet, (m, 3) in its plane and normal to it, in the images of one camera. None for an
    image with too few points or without a valid view."""
    views = [
        fit_view_robustly(sheet[picture.index, :2], picture.observed_px, picture.size_px)
        if len(picture.index) >= _LEAST_POINTS
        else None
        for picture in pictures
    ]
    focal = focal_length([view for view in views if view is not None])
    return [
        None if view is None else _predict_points(picture, view, focal, sheet)
        for picture, view in zip(pictures, views, strict=True)
    ]


def _predict_points(picture: SheetImage, view: SheetView, focal: float, sheet: Array) -> ImagePoints | None:
    """Predicted places and derivatives of an image's points; points that the view cannot project are left out."""
    by_point = view.pixel_from_space(sheet[picture.index, :2], focal, _STEP * float(np.ptp(sheet[:, :2])))
    # Beside the last point that the view can project its derivatives may not exist.
    known = np.isfinite(view.places_px(sheet[picture.index, :2])).all(axis=1) & np.isfinite(by_point).all(axis=(1, 2))
    if known.sum() < _LEAST_POINTS:
        return None
    points, by_point, count = sheet[picture.index[known]], by_point[known], int(known.sum())
    places = view.places_px(points[:, :2]) + by_point[..., 2] * points[:, 2:]
    # Shifts by one standard deviation of perspective and of decentring distortion.
    size = float(np.hypot(*picture.size_px))
    about = (2.0 * places - (np.array(picture.size_px) - 1.0)) / size
    products = about[:, :, None] * about[:, None, :]
    decentred = np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 2.0 * products
    derivatives = size * np.concatenate([_PERSPECTIVE * products, _DECENTRED * decentred], axis=2)
    targets = TargetPlaces(places, derivatives, np.zeros((count, 2, 2)), np.zeros(count, bool))
    observed = picture.observed_px[known], picture.covariance_px2[known]
    return ImagePoints(picture.index[known], targets, by_point, *observed, picture.size_px)
