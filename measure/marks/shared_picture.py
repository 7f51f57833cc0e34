"""Least-squares estimation of the shared sharp image of a mark, of which all its images are blurred versions.

Scans of one camera differ in sharpness. More blur displaces the edges of an asymmetric mark, so a mean of images of
different blur gives a biased place. Each image is therefore modelled as the shared one under its own Gaussian blur,
shift, gain and offset. The shared image is as sharp as the sharpest of them. It is adjusted simultaneously with the
shifts and blurs: in an alternating adjustment the sharpest image would be compared mostly with itself, and not move.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.fft import dctn, idctn
from scipy.sparse.linalg import LinearOperator, lsmr

from measure.array_types import Array, Mask
from measure.noise.robust_estimation import robust_scale, tukey_weights

_GAIN, _OFFSET, _COL, _ROW, _BLUR = range(5)  # unknowns of each image
_REWEIGHTINGS = 5  # iterations of Tukey's reweighting
NOISE_FLOOR = 0.002  # fraction of the image's range, floor of the noise, which is zero in clean images
_LEAST_WEIGHT = 1e-6  # floor of Tukey's weight, for pixels that are outliers in all images
_LEAST_REDUNDANCY = 0.1  # floor of 1 - share; with less redundancy residuals do not estimate an image's noise
_ALIKE_PX = 0.7  # px, smoothing of the weights that decide whether a pixel is steady
_LEAST_GAIN = 0.01  # floor of the gain, for an image that hardly shows the mark
SMOOTHED_PX2 = 0.7**2  # px², smoothing of all compared images: edges as sharp as a pixel are undersampled
_CORRELATED = 4 * np.pi * SMOOTHED_PX2  # pixels per independent observation after smoothing
_LONGEST_PX = 1.0  # px, longest shift for which the linearisation holds
_MOST_BLURRED = 2.0  # largest factor of the blur, likewise
_SEEN_PX2 = 1.0  # px², variance of a sharp scan's total blur, pixel and smoothing included
_SURELY = 3.0  # standard deviations: the shared image is only as sharp as the sharpest image certainly is
_HELD = 0.1  # in weights of one image: regularises components of the shared image that no image determines
_ITERATIONS, _TOLERANCE = 12, 1e-3  # of LSMR in one adjustment; the next round continues


@dataclass(frozen=True, eq=False)
class SharedPicture:
    """Shared image of n images.

    Attributes
    ----------
    image : (side, side) shared image.
    variances_px2 : (n,) variance of each image's additional blur.
    weights : (n, side, side) weights of the images' pixels.
    residuals : (n, side, side) residuals in units of the shared image.
    moves : (n, 2) px, shifts of the images by column and row, with zero sum.
    alike : (side, side) mask of the pixels in which most images agree.
    """

    image: Array
    variances_px2: Array
    weights: Array
    residuals: Array
    moves: Array
    alike: Mask

    @property
    def shares(self) -> Array:
        """(n,) share of each image in the shared one, averaged over the frequencies that a fit uses."""
        side = len(self.image)
        information = self.weights.mean(axis=(1, 2))[:, None, None] * _transfers(side, 2 * self.variances_px2)
        visible = _transfers(side, np.array([2 * SMOOTHED_PX2]))
        return np.asarray((visible * information / information.sum(axis=0)).sum(axis=(1, 2)) / visible.sum())

    @property
    def slope_noise(self) -> float:
        """Standard deviation of the noise in the image's gradient, per pixel, after the smoothing of a fit. Estimated
        from the residuals, corrected for each image's share."""
        shares = self.shares
        noise = np.array([robust_scale(np.diff(residuals)) for residuals in self.residuals])
        return float(np.sqrt(np.sum(shares**2 * noise**2 / np.maximum(1 - shares, _LEAST_REDUNDANCY))))


def first_picture(stack: Array) -> SharedPicture:
    """Initial shared image of images (n, side, side), under the assumption that they are alike."""
    levelled = [_line(picture, stack[0]) for picture in stack]
    return SharedPicture(
        np.median(levelled, axis=0),
        np.zeros(len(stack)),
        np.ones_like(stack),
        np.zeros_like(stack),
        np.zeros((len(stack), 2)),
        np.ones(stack[0].shape, dtype=bool),
    )


def adjust_picture(shared: SharedPicture, stack: Array, steady: Mask) -> SharedPicture:
    """Adjust the shared image once more to images (n, side, side). Shifts and blurs are estimated from the steady
    pixels."""
    smoothed = _blur_images(stack, np.full(len(stack), SMOOTHED_PX2))
    designs = _designs(shared.image, shared.variances_px2, steady)
    fits = [_fit(*each) for each in zip(smoothed, designs, shared.weights, strict=True)]
    alike, weights = np.array([fit.alike for fit in fits]), _weights(fits, shared.shares)
    variances = _excess_variances(shared.variances_px2, fits)
    together = _Together(shared.image, variances, weights, steady)
    image, more = together.solved(np.array([fit.levelled for fit in fits]))
    moves = np.clip(-more[:, [_COL, _ROW]], -_LONGEST_PX, _LONGEST_PX)
    return SharedPicture(
        image,
        np.maximum(_bounded(variances, more[:, _BLUR]), 0.0),
        weights,
        np.array([fit.residuals for fit in fits]),
        moves - moves.mean(axis=0),
        cv2.GaussianBlur(alike.mean(axis=0), (0, 0), _ALIKE_PX) > 0.5,
    )


def _squares(side: int) -> Array:
    """(side, side) squared frequencies of the cosine transform."""
    square = (np.pi * np.arange(side) / side) ** 2
    return np.asarray(square[:, None] + square)


def _transfers(side: int, variances_px2: Array) -> Array:
    """(n, side, side) transfer functions of Gaussian blurs in the cosine transform."""
    return np.asarray(np.exp(-0.5 * variances_px2[:, None, None] * _squares(side)))


def _blur_images(images: Array, variances_px2: Array) -> Array:
    """(n, side, side) one image, or n, under blurs (n,); mirrored at the borders, so that the blur is self-adjoint."""
    cosines = _transfers(images.shape[-1], variances_px2) * _cosines(images)
    return np.asarray(idctn(cosines, axes=(1, 2), norm="ortho"))


def _cosines(images: Array) -> Array:
    return np.asarray(dctn(images, axes=(-2, -1), norm="ortho"))


def _designs(image: Array, variances_px2: Array, steady: Mask) -> Array:
    """(n, 5, side, side) design matrices of the images: the blurred shared image, 1, and its derivatives by column, row
    and variance of the blur, the latter in steady pixels only."""
    views = _blur_images(image, variances_px2 + SMOOTHED_PX2)
    by_row, by_col = np.gradient(views, axis=(1, 2))
    by_variance = idctn(-0.5 * _squares(len(image)) * _cosines(views), axes=(1, 2), norm="ortho")
    return np.stack([views, np.ones_like(views), *(part * steady for part in (by_col, by_row, by_variance))], axis=1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of one image to the shared one.

    Attributes
    ----------
    levelled : (side, side) image in grey values of the shared one.
    residuals : (side, side).
    alike : (side, side) Tukey's weights.
    scale : standard deviation of the residuals.
    blur_px2 : correction of the blur's variance.
    blur_sigma_px2 : its standard deviation.
    """

    levelled: Array
    residuals: Array
    alike: Array
    scale: float
    blur_px2: float
    blur_sigma_px2: float


def _fit(picture: Array, design: Array, weights: Array) -> _Fit:
    """Fit an image to the shared one, robustly against dust and background. Residuals as large as the changes by shift
    and blur are not yet treated as damage; the next round decides."""
    columns, grey = design.reshape(len(design), -1), picture.ravel()
    floor = NOISE_FLOOR * float(np.ptp(design[_GAIN]))
    weights = weights.ravel()
    for _ in range(_REWEIGHTINGS):
        weighed = columns * weights
        inverse = np.linalg.pinv(weighed @ columns.T, hermitian=True)
        factors = inverse @ (weighed @ grey)
        gain = max(float(factors[_GAIN]), _LEAST_GAIN)
        residuals = (grey - factors @ columns) / gain
        scale = max(robust_scale(residuals), floor)
        changes = factors[_COL:] @ columns[_COL:] / gain
        alike = tukey_weights(residuals / np.hypot(scale, changes), 1.0)
        weights = (alike + _LEAST_WEIGHT) / scale**2
    return _Fit(
        (picture - factors[_OFFSET]) / gain,
        residuals.reshape(picture.shape),
        alike.reshape(picture.shape),
        scale,
        float(factors[_BLUR]) / gain,
        float(np.sqrt(_CORRELATED * inverse[_BLUR, _BLUR])),
    )


def _weights(fits: Sequence[_Fit], shares: Array) -> Array:
    """(n, side, side) weights of the pixels. shares (n,): of the images in the shared one, by which the residuals
    underestimate the noise. The noise is at least the median, so that no image dominates."""
    noise = np.array([fit.scale for fit in fits]) / np.sqrt(np.maximum(1 - shares, _LEAST_REDUNDANCY))
    noise = np.maximum(noise, np.median(noise))
    return (np.array([fit.alike for fit in fits]) + _LEAST_WEIGHT) / noise[:, None, None] ** 2


def _excess_variances(variances_px2: Array, fits: Sequence[_Fit]) -> Array:
    """(n,) variances of the fits minus that of the sharpest image, plus its uncertainty; 0 for images not
    significantly less sharp."""
    found = _bounded(variances_px2, np.array([fit.blur_px2 for fit in fits]))
    sharpest = float((found + _SURELY * np.array([fit.blur_sigma_px2 for fit in fits])).min())
    return np.maximum(found - sharpest, 0.0)


def _bounded(variances_px2: Array, change_px2: Array) -> Array:
    """Apply a change of variances, limited to the range of the linearisation."""
    total = variances_px2 + _SEEN_PX2
    return np.clip(total + change_px2, total / _MOST_BLURRED**2, total * _MOST_BLURRED**2) - _SEEN_PX2


class _Together:
    """Linearised simultaneous adjustment of the shared image and the unknowns of all images, solved by LSMR.

    Datum: the blur of the sharpest images is held fixed, and the sums of the other unknowns are zero, since a common
    shift would be one of the shared image. Components that no image determines are held by a weak prior. Unknowns and
    equations are scaled to a weight of about one.
    """

    def __init__(self, image: Array, variances_px2: Array, weights: Array, steady: Mask) -> None:
        self.image, self.roots = image, np.sqrt(weights)
        self.designs = _designs(image, variances_px2, steady)
        self.transfers = _transfers(len(image), variances_px2 + SMOOTHED_PX2)
        weighted = self.roots[:, None] * self.designs
        weighted[variances_px2 == 0, _BLUR] = 0.0
        self.lengths = np.sqrt((weighted**2).sum(axis=(2, 3)))
        self.lengths[self.lengths == 0] = np.inf
        self.columns = weighted / self.lengths[:, :, None, None]
        self.held = float(np.sqrt(_HELD * np.median(weights.mean(axis=(1, 2)))))
        self.scale = 1 / np.sqrt(weights.sum(axis=0) + self.held**2)

    def solved(self, levelled: Array) -> tuple[Array, Array]:
        """Solve for the shared image and the corrections (n, 5) of the images' unknowns. levelled: (n, side, side)."""
        wanted = (self.roots * (levelled - self.designs[:, _GAIN])).ravel()
        rest = self.image.size + _BLUR
        shape = (wanted.size + rest, self.image.size + self.lengths.size)
        operator = LinearOperator(shape, matvec=self._forward, rmatvec=self._adjoint, dtype=float)
        wanted = np.concatenate([wanted, np.zeros(rest)])
        found = lsmr(operator, wanted, atol=_TOLERANCE, btol=_TOLERANCE, maxiter=_ITERATIONS)[0]
        image, factors = self._parted(found)
        return self.image + self.scale * image, factors / self.lengths

    def _parted(self, unknowns: Array) -> tuple[Array, Array]:
        return unknowns[: self.image.size].reshape(self.image.shape), unknowns[self.image.size :].reshape(-1, _BLUR + 1)

    def _forward(self, unknowns: Array) -> Array:
        """Product of the design matrix with the unknowns: images, prior of the shared image, and sums."""
        image, factors = self._parted(unknowns)
        change = self.scale * image
        pictures = idctn(self.transfers * _cosines(change), axes=(1, 2), norm="ortho")
        pictures = self.roots * pictures + np.einsum("nk,nkij->nij", factors, self.columns)
        return np.concatenate([pictures.ravel(), self.held * change.ravel(), factors[:, :_BLUR].sum(axis=0)])

    def _adjoint(self, rows: Array) -> Array:
        """Product of the transposed design matrix with the equations."""
        pictures, change, sums = np.split(rows, [self.roots.size, self.roots.size + self.image.size])
        pictures = pictures.reshape(self.roots.shape)
        back = idctn((self.transfers * _cosines(self.roots * pictures)).sum(axis=0), norm="ortho")
        image = self.scale * (back + self.held * change.reshape(self.image.shape))
        factors = np.einsum("nkij,nij->nk", self.columns, pictures)
        factors[:, :_BLUR] += sums
        return np.concatenate([image.ravel(), factors.ravel()])


def _line(picture: Array, like: Array) -> Array:
    """Fit an image to another one by gain and offset."""
    off = picture - picture.mean()
    gain = float((off * like).sum()) / max(float((off**2).sum()), 1e-12)
    return np.asarray(like.mean() + gain * off)
