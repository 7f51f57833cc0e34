"""Normalised cross-correlation (NCC) with a mark's template under a mask, after background subtraction; its peaks.

No limit is set here: candidates in `responses`, single marks by their false alarms in `localisation` (limit in
`measure.flags`), targets in `targets.identification`, fits by their likeness in `measure_frame`.

False alarms are counted under the null hypothesis that noise alone responds. A single response is compared with a
Gaussian field, whose variance and slopes come from the noise around it. A constellation of marks is compared with the
share of other places that respond as strongly, whatever their distribution.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, ndtr

from measure.array_types import Array, Single
from measure.noise.robust_estimation import SIGMA_OF_DEVIATION

Map = Single

_CLIP = 3.0  # times the local contrast, limit of flattened values
_MEAN = 0.3  # in coarse widths, side of the squares whose median is the background
_MEDIAN = 5  # size of the median filter, in these squares
_DRAWN = 0.05  # fraction of the mark's contrast: pixels of the template that differ more from the rim are the mark
_SMOOTHED_PX = 3.0  # px, standard deviation of a Gaussian that a reduced image still resolves
_EVEN = 1e-5  # mean square in units of the local contrast below which a window is uniform; rounding is 1/300 of it
_MOST_SAMPLED_PX = 1 << 20  # largest number of pixels used to estimate the noise's correlation
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # offsets in rows and columns, each with its opposite


@dataclass(frozen=True)
class Surroundings:
    """Treatment of a mark's background in template matching.

    Attributes
    ----------
    coarse : in widths of the mark's finest detail; coarser structure is background.
    margin : in the same unit, distance around the drawing up to which pixels are used.
    robust : local contrast by a median, which is insensitive to edges far stronger than the mark, instead of a mean
        square, which takes less of the noise for contrast.
    whitened : weight the template by the inverse covariance of neighbouring pixels. Grain hides the coarse structure of
        a faint mark more than its fine lines. Not suitable for marks blurred more than their drawing.
    """

    coarse: float
    margin: float
    robust: bool
    whitened: bool

    def ground_reach_px(self, detail_px: float) -> int:
        """Distance (px) up to which the background of a pixel is estimated."""
        return _MEDIAN * _mean_px(self.coarse * detail_px) // 2 + 1

    def flatten(self, image: Map, detail_px: float, faint_dn: float) -> Map:
        """Subtract structure much coarser than detail_px and normalise by the local contrast.

        A thin cross then gives the same response on image texture as on a uniform background. Contrasts of faint_dn or
        below are damped. The background is a median, which preserves the frame's edge; a mean would spread the edge
        over adjacent marks and hide faint ones.
        """
        coarse_px = self.coarse * detail_px
        detail = _median(image, coarse_px)
        np.subtract(image, detail, out=detail)  # in place, here and below: a map of a whole scan is large
        del image
        if self.robust:
            variance = (SIGMA_OF_DEVIATION * _median(np.abs(detail), coarse_px)) ** 2
        else:
            variance = _smoothed(detail**2, 2 * coarse_px)
        variance += faint_dn**2
        detail /= np.sqrt(variance, out=variance)
        return np.clip(detail, -_CLIP, _CLIP, out=detail)

    def mask(self, template: Array, detail_px: float) -> Map:
        """Mask of a template: 1 on the drawing and around it, or on all known pixels if its rim is not known; 0
        elsewhere and for nan pixels."""
        about = ~np.isnan(template)
        rim = np.concatenate([template[0], template[-1], template[:, 0], template[:, -1]])
        if not np.isnan(rim).all():  # only the drawing and its surroundings
            drawn = np.nan_to_num(np.abs(template - np.nanmedian(rim)))
            # A line far thinner than a pixel has almost no contrast left.
            background = (drawn < min(_DRAWN, float(drawn.max()) / 2)).astype(np.uint8)
            about &= cv2.distanceTransform(background, cv2.DIST_L2, 5) <= self.margin * detail_px + 1
        return np.asarray(about, np.float32)

    def pattern(self, template: Array, detail_px: float, mask: Map, image: Map) -> Map:
        """Convert a template to the zero-mean pattern that is correlated with a flattened image under a mask."""
        template = np.nan_to_num(template)
        chip = np.asarray(template - cv2.GaussianBlur(template, (0, 0), self.coarse * detail_px), np.float32)
        if self.whitened:
            chip = np.asarray(cv2.filter2D(chip, -1, _inverse_covariance(image)), np.float32)
        return mask * (chip - np.average(chip, weights=mask))


def variation(image: Map, about: Map) -> Map:
    """Sum of squared deviations from the mean under a mask, at every place where the mask lies inside the image."""
    squares = cv2.matchTemplate(np.square(image), about, cv2.TM_CCORR)
    sums = cv2.matchTemplate(image, about, cv2.TM_CCORR)
    np.divide(np.square(sums, out=sums), about.sum(), out=sums)
    return np.asarray(np.subtract(squares, sums, out=squares), np.float32)


def correlation(image: Map, chip: Map, about: Map, varied: Map | None = None) -> Map:
    """Compute the normalised cross-correlation (NCC) of an image with a pattern under a mask.

    OpenCV's masked correlation gives the same result in three times the time.

    Parameters
    ----------
    image : (rows, columns) flattened image.
    chip, about : (rows, columns) pattern and mask of `Surroundings`. The mask excludes the frame's edge or
        writing around the drawing.
    varied : variation of the image under the mask, shared by patterns with the same mask.
    """
    varied = variation(image, about) if varied is None else varied
    products = cv2.matchTemplate(image, chip, cv2.TM_CCORR)
    power = np.sum(chip**2)
    spread = varied * power
    least = _EVEN * about.sum() * power  # a uniform background gives no response
    even = spread <= least
    np.maximum(spread, least, out=spread)
    np.divide(products, np.sqrt(spread, out=spread), out=products)
    products[even] = 0.0
    return np.asarray(products, np.float32)


WIDE = Surroundings(coarse=4.0, margin=2.0, robust=False, whitened=False)
CLOSE = Surroundings(coarse=2.0, margin=1.0, robust=True, whitened=False)  # for faint marks near the frame's edge
GRAINY = replace(CLOSE, whitened=True)  # for such marks in grain as wide as their lines


def _inverse_covariance(image: Map) -> Map:
    """(3, 3) row of the inverse covariance of an image's pixels, up to a factor: each pixel minus its least-squares
    prediction from its neighbours (conditional autoregression: Besag, 1974)."""
    rows, cols = (np.arange(1, side - 1) for side in image.shape)
    rows = rows[:: max(1, image.size // _MOST_SAMPLED_PX)]
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
    """Side (px) of the squares whose means enter the median."""
    return max(1, int(_MEAN * coarse_px))


def _smoothed(image: Map, sigma_px: float) -> Map:
    """Smooth an image by a Gaussian; a wide one is applied to a reduced image, to save time."""
    factor = max(1, int(sigma_px / _SMOOTHED_PX))
    # Averaging and linear interpolation add blur of variance f^2 / 12 and f^2 / 6.
    left = np.sqrt(sigma_px**2 - (factor**2 - 1) / 4) / factor
    return _enlarged(cv2.GaussianBlur(_reduced(image, factor), (0, 0), left), image)


def _reduced(image: Map, factor: int) -> Map:
    height, width = image.shape
    size = -(-width // factor), -(-height // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _enlarged(small: NDArray[np.integer | np.floating], image: Map) -> Map:
    """Enlarge a reduced image to the size of another."""
    return np.asarray(cv2.resize(small, image.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def local_maxima(response: Map, count: int, least: float, apart_px: int = 3) -> tuple[Array, Array]:
    """Find the highest local maxima.

    Parameters
    ----------
    response : (rows, columns).
    count, least : largest number, and threshold of the height.
    apart_px : smallest distance between peaks.

    Returns
    -------
    (n, 2) column and row, and (n,) heights, the highest first.
    """
    square = np.ones((2 * apart_px + 1, 2 * apart_px + 1), np.uint8)
    is_top = response == cv2.dilate(response, square, borderType=cv2.BORDER_REPLICATE)
    is_top &= response > least
    rows, cols = np.divmod(np.flatnonzero(is_top), is_top.shape[1])  # seven times as quick as nonzero
    plateaus = cv2.connectedComponents(is_top.astype(np.uint8))[1][rows, cols]
    first = np.unique(plateaus, return_index=True)[1]  # one of equal neighbours
    rows, cols = rows[first], cols[first]
    heights = response[rows, cols].astype(float)
    order = np.argsort(-heights, kind="stable")[:count]
    return np.column_stack([cols, rows]).astype(float)[order], heights[order]


def highest_about(response: Map, places: Array, radius_px: float) -> tuple[Array, Array]:
    """Find the maximum within a square around each of places (n, 2), refined by parabolas.

    Returns
    -------
    (n, 2) column and row, and (n,) heights; 0 for a place outside the map.
    """
    size = np.array(response.shape[::-1])
    low = np.clip(np.floor(places - radius_px).astype(int), 0, None)
    high = np.clip(np.ceil(places + radius_px).astype(int) + 1, None, size)
    within = (low < high).all(axis=1)
    tops, heights = places.astype(float), np.zeros(len(places))
    if not within.any():
        return tops, heights
    low, high = low[within], high[within]
    col, row = (low[:, axis, None] + np.arange((high - low)[:, axis].max()) for axis in (0, 1))
    part = response[np.minimum(row, size[1] - 1)[:, :, None], np.minimum(col, size[0] - 1)[:, None, :]]
    part = np.where((row < high[:, 1, None])[:, :, None] & (col < high[:, 0, None])[:, None, :], part, -np.inf)
    best_row, best_col = np.divmod(part.reshape(len(part), -1).argmax(axis=1), part.shape[2])
    top = low + np.column_stack([best_col, best_row])
    heights[within] = response[top[:, 1], top[:, 0]]
    inner = ((top > 0) & (top < size - 1)).all(axis=1)
    col, row = top[inner].T
    offset = np.zeros(top.shape)
    offset[inner, 0] = _vertex(response[row, col - 1], response[row, col], response[row, col + 1])
    offset[inner, 1] = _vertex(response[row - 1, col], response[row, col], response[row + 1, col])
    tops[within] = top + offset
    return tops, heights


def _vertex(before: Map, middle: Map, after: Map) -> Array:
    """Vertices, -0.5 to 0.5, of parabolas through three values each, the middle one being the highest."""
    bend = before - 2 * middle + after
    top = np.divide(before - after, 2 * bend, out=np.zeros(len(bend)), where=bend < 0)
    return np.asarray(np.clip(top, -0.5, 0.5))


def expected_peaks(strength: float, slopes: Array, radius_px: float) -> float:
    """Expected number of peaks of a Gaussian field of unit variance in a circle that exceed a strength.

    slopes (2, 2): covariance of the field's gradient.

    Notes
    -----
    Expected Euler characteristic of the excursion set: terms of a point, of the circle's edge and of its area (Adler
    1981, The Geometry of Random Fields; Worsley 1996).
    """
    edge = np.pi * radius_px * np.sqrt(np.trace(slopes) / 2) / (2 * np.pi)
    area = np.pi * radius_px**2 * np.sqrt(max(np.linalg.det(slopes), 0.0)) * max(strength, 1.0) / (2 * np.pi) ** 1.5
    return float(ndtr(-strength) + (edge + area) * np.exp(-(strength**2) / 2))


def chance_of_marks(found: int | NDArray[np.integer], marks: int, share: float | Array) -> Array:
    """Probability that at least so many marks respond by chance, each as a share of other places does (binomial)."""
    return np.asarray(bdtrc(np.subtract(found, 1), marks, share), np.float64)


def share_of_places(hits: int, places: int) -> float:
    """Share by Laplace's rule of succession: no hit among sixty places does not mean a rate of zero."""
    return (hits + 1) / (places + 2)
