"""Normalised correlation with a mark's picture: in a scan freed of its ground, and of what lies beside the mark."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Single
from measure.noise.robust_estimation import SIGMA_OF_DEVIATION

Map = Single

_CLIP = 3.0  # times the local contrast
_MEAN = 0.3  # of the coarse: the side of the squares whose median is background
_MEDIAN = 5  # of these squares each way
_DRAWN = 0.05  # of the mark's own contrast: what differs by more from the ground is the mark
_SMOOTHED_PX = 3.0  # the standard deviation of a Gaussian that a reduced picture still shows
_EVEN = 1e-5  # mean square in units of the local contrast: a three hundredth of it is rounding
_TOLD_PX = 1 << 20  # pixels tell how noise is correlated
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows and columns off, each with the one opposite


@dataclass(frozen=True)
class Surroundings:
    """coarse: times the mark's finest detail: coarser structure is ground. beside: times the same: how far about the
    drawing pixels count. robust: whether the local contrast is a median, which an edge that is far stronger than the
    mark does not change, and not a mean square, which takes less of what noise there is for contrast: that is a closer
    look. whitened: whether the drawing is weighed by the inverse covariance that neighbouring pixels have: grain hides
    the coarse of a faint mark, and little of its fine lines; what is blurred more than it is drawn has none of them."""

    coarse: float
    beside: float
    robust: bool
    whitened: bool

    def ground_reach_px(self, detail_px: float) -> int:
        """How far about a pixel its ground is taken from."""
        return _MEDIAN * _mean_px(self.coarse * detail_px) // 2 + 1

    def flattened(self, image: Map, detail_px: float, faint_dn: float) -> Map:
        """The picture freed of what is much coarser than detail_px, in units of its contrast about every pixel: a thin
        cross on a landscape answers as on an even ground. Contrasts of faint_dn or below count for less.

        The ground is a median, which keeps the frame's edge: a mean would spread it over the marks beside it, and drown
        those that are faint.
        """
        coarse_px = self.coarse * detail_px
        detail = image - _median(image, coarse_px)
        if self.robust:
            variance = (SIGMA_OF_DEVIATION * _median(np.abs(detail), coarse_px)) ** 2
        else:
            variance = _smoothed(detail**2, 2 * coarse_px)
        contrast = np.sqrt(variance + faint_dn**2)
        return np.asarray(np.clip(detail / contrast, -_CLIP, _CLIP), np.float32)

    def pattern(self, template: Array, detail_px: float, image: Map) -> tuple[Map, Map]:
        """What a flattened picture is correlated with, of mean 0, and how much each of its pixels counts: one that is
        nan in the template does not."""
        about = self._template_mask(template, detail_px)
        template = np.nan_to_num(template)
        chip = np.asarray(template - cv2.GaussianBlur(template, (0, 0), self.coarse * detail_px), np.float32)
        if self.whitened:
            chip = np.asarray(cv2.filter2D(chip, -1, _inverse_covariance(image)), np.float32)
        return about * (chip - np.average(chip, weights=about)), about

    def _template_mask(self, template: Array, detail_px: float) -> Map:
        """1 on the drawing and beside it, 0 elsewhere; 1 on all that is known where no ground is known about it."""
        rim = np.concatenate([template[0], template[-1], template[:, 0], template[:, -1]])
        if np.isnan(rim).all():
            return np.asarray(~np.isnan(template), np.float32)
        drawn = np.nan_to_num(np.abs(template - np.nanmedian(rim)))
        # Of a line far thinner than a pixel hardly anything is left.
        beside = (drawn < min(_DRAWN, float(drawn.max()) / 2)).astype(np.uint8)
        far_px = self.beside * detail_px + 1
        near = cv2.distanceTransform(beside, cv2.DIST_L2, 5) <= far_px
        return np.asarray(near & ~np.isnan(template), np.float32)


def variation(image: Map, about: Map) -> Map:
    """The sum of squared deviations from their mean, wherever the pixels about a drawing lie inside of the picture."""
    sums, squares = (np.asarray(cv2.matchTemplate(each, about, cv2.TM_CCORR)) for each in (image, image**2))
    np.divide(np.square(sums, out=sums), about.sum(), out=sums)
    return np.asarray(np.subtract(squares, sums, out=squares), np.float32)


def correlation(image: Map, chip: Map, about: Map, varied: Map | None = None) -> Map:
    """Correlate a picture with a pattern, wherever that lies inside of it: the normalised cross-correlation (NCC).

    OpenCV's own correlation under a mask gives the same for three times the price.

    Parameters
    ----------
    image : (rows, columns)
        Flattened.
    chip, about : (rows, columns)
        As `Surroundings.pattern` gives them: beside the drawing may lie the frame's edge, or writing.
    varied : optional
        The picture's variation about the drawing: patterns of which the same pixels count share it.
    """
    varied = variation(image, about) if varied is None else varied
    products = cv2.matchTemplate(image, chip, cv2.TM_CCORR)
    power = np.sum(chip**2)
    spread = varied * power
    least = _EVEN * about.sum() * power  # nothing but even ground is no answer
    even = spread <= least
    np.maximum(spread, least, out=spread)
    np.divide(products, np.sqrt(spread, out=spread), out=products)
    products[even] = 0.0
    return np.asarray(products, np.float32)


WIDE = Surroundings(coarse=4.0, beside=2.0, robust=False, whitened=False)
CLOSE = Surroundings(coarse=2.0, beside=1.0, robust=True, whitened=False)  # for faint marks beside the frame's edge
GRAINY = replace(CLOSE, whitened=True)  # for such marks in grain as wide as their lines


def _inverse_covariance(image: Map) -> Map:
    """(3, 3) a row of the inverse covariance of a picture's pixels, but for a factor: each less what its neighbours say
    of it, by least squares (a conditional autoregression: Besag, 1974)."""
    rows, cols = (np.arange(1, side - 1) for side in image.shape)
    rows = rows[:: max(1, image.size // _TOLD_PX)]
    pairs = np.stack(
        [(image[np.ix_(rows + r, cols + c)] + image[np.ix_(rows - r, cols - c)]).ravel() for r, c in _NEIGHBOURS]
    )
    shares = np.linalg.lstsq(pairs @ pairs.T, pairs @ image[np.ix_(rows, cols)].ravel(), rcond=None)[0]
    row = np.zeros((3, 3), np.float32)
    row[1, 1] = 1.0
    for (r, c), share in zip(_NEIGHBOURS, shares.tolist(), strict=True):
        row[1 + r, 1 + c] = row[1 - r, 1 - c] = -share
    return row


def _median(image: Map, coarse_px: float) -> Map:
    return _enlarged(cv2.medianBlur(_reduced(image, _mean_px(coarse_px)), _MEDIAN), image)


def _mean_px(coarse_px: float) -> int:
    """The side of the squares whose means are compared."""
    return max(1, int(_MEAN * coarse_px))


def _smoothed(image: Map, sigma_px: float) -> Map:
    """The picture under a Gaussian; a wide one takes, for its price, hardly more than a reduced picture tells."""
    factor = max(1, int(sigma_px / _SMOOTHED_PX))
    # The averaging and the straight lines between its pixels blur by themselves: f^2 / 12 and f^2 / 6 of variance.
    left = np.sqrt(sigma_px**2 - (factor**2 - 1) / 4) / factor
    return _enlarged(cv2.GaussianBlur(_reduced(image, factor), (0, 0), left), image)


def _reduced(image: Map, factor: int) -> Map:
    height, width = image.shape
    size = -(-width // factor), -(-height // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _enlarged(small: NDArray[np.integer | np.floating], image: Map) -> Map:
    """A reduced picture in the size of the other."""
    return np.asarray(cv2.resize(small, image.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
