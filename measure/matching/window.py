"""Window of a scan as input of a fit: linear light, position, and the state of its pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, log_ndtr
from skimage.filters import threshold_otsu

from measure.array_types import Array, Mask
from measure.flags import CLIPPED_END
from measure.marks.rendering import picture
from measure.marks.shapes import Mark
from measure.noise.robust_estimation import robust_scale
from measure.scans.metadata import Samples
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR, Tone

ClippedEnds = NDArray[np.int8]  # 1: at the upper end of the scanner's range, -1: at the lower one, 0 elsewhere

FAINT = 1 / 500  # fraction of full scale: a smaller contrast may be rounding
_BESIDE_PX = 6.0  # px around the drawing: the mark's own background
_FAR = 5.0  # standard deviations of the mark's side, mark included: a larger step is not the mark's background
_EDGE_PX = 4.0  # px reached by an edge's blur: at 1.4 px blur, 1/500 of the step is left at this distance
_DRAWN, _SHOWN = 0.05, 0.5  # fractions of the mark's contrast: the whole mark, and its certain pixels
_BITS = (8, 10, 12, 14, 16)  # bit depths of scanners' converters; values are stored unchanged or shifted up
_LOG_DENSITY = -0.5 * np.log(2 * np.pi)  # log density of the standard normal distribution at 0
_TAIL = 2.0  # noise standard deviations below the maximum: the tail of the histogram
_LEAST_STEPS = 1.5  # grey-value steps per noise standard deviation; with less noise a uniform area piles up as well
_FEWEST = 20  # pixels; fewer clipped ones do not affect a fit
_GROSS = 3.5  # standard deviations beyond which a residual is damage
_SCALE_ROUNDS = 8  # iterations; each leaves at most two fifths of the error


@dataclass(frozen=True, eq=False)
class Coding:
    """Relation of light to stored grey values. tone: tone curve of the scan; full_scale_dn: its largest grey value."""

    tone: Tone = LINEAR
    full_scale_dn: float = 65535.0

    def light_of_step_dn(self, light: NDArray[np.floating], step_dn: float) -> Array:
        """Change of the light for a change of step_dn in the stored grey value."""
        if self.tone.is_identity:
            return np.full(light.shape, step_dn)
        code = self.tone.code(light, self.full_scale_dn)
        above, here = (self.tone.light(code + more, self.full_scale_dn) for more in (step_dn, 0.0))
        return np.asarray(above - here, float)

    def stored_contrast_dn(self, ground: float, contrast: float) -> float:
        """Convert a contrast in light over a background to a difference of stored grey values. For lines thinner than a
        pixel it may exceed the scanner's range, since no pixel shows the full contrast."""
        if self.tone.is_identity:
            return contrast
        ends = np.clip([ground, ground + contrast], 0.0, self.full_scale_dn)
        codes, within = self.tone.code(ends, self.full_scale_dn), ends[1] - ends[0]
        return float((codes[1] - codes[0]) * contrast / within) if within else contrast


@dataclass(frozen=True, eq=False)
class ScanWindow:
    """Window of a scan in light.

    Attributes
    ----------
    grey : (height, width) light.
    origin_px : (col, row) of the centre of its top-left pixel in the scan.
    valid : (height, width) mask of the valid pixels; None: all.
    clipped : (height, width) pixels at an end of the scanner's range, from `clipped_ends`; None: none.
    is_lossy : whether the scan was compressed with loss.
    coding : relation of light to stored grey values.
    """

    grey: NDArray[np.floating]
    origin_px: tuple[float, float] = (0.0, 0.0)
    valid: Mask | None = None
    clipped: ClippedEnds | None = None
    is_lossy: bool = False
    coding: Coding = Coding()

    @property
    def usable(self) -> Mask:
        """(height, width) mask of the valid, finite pixels."""
        known = np.asarray(np.isfinite(self.grey))
        return known if self.valid is None else known & self.valid

    @property
    def ends(self) -> ClippedEnds:
        return np.zeros(self.grey.shape, np.int8) if self.clipped is None else self.clipped

    def exclude(self, lost: Mask) -> "ScanWindow":
        """Copy of the window with the pixels of a mask (height, width) marked as invalid."""
        return replace(self, valid=self.usable & ~lost)

    def part(self, rows: slice, cols: slice) -> "ScanWindow":
        """Crop to the given rows and columns."""
        col0, row0 = self.origin_px
        return ScanWindow(
            self.grey[rows, cols],
            (col0 + cols.start, row0 + rows.start),
            self.usable[rows, cols],
            self.ends[rows, cols],
            self.is_lossy,
            self.coding,
        )


def read_window(scan: Scan, place_px: tuple[int, int, int, int], weights: Sequence[float] | None = None) -> ScanWindow:
    """Read the window at col0, row0, width, height of the scan, in light. weights: of the channels, as in
    `Scan.window`."""
    col0, row0, _, _ = place_px
    samples, grey = scan.samples(*place_px), scan.light(*place_px, weights).astype(float)
    inside = scan.inside(*place_px, is_read=True)
    ends = clipped_ends(samples, scan.full_scale_dn, weights)
    return ScanWindow(grey, (col0, row0), inside, ends, scan.is_lossy, Coding(scan.tone, scan.full_scale_dn))


def pixels_beyond_edge(window: NDArray[np.floating], mark: Mark, pixel_from_mark: Array) -> Mask:
    """Mask the pixels of a window beyond an edge that is far stronger than the mark, or within the edge's blur.

    Such an edge is that of the frame, or of the pad on which the mark stands.

    Parameters
    ----------
    window : (height, width)
    pixel_from_mark : (2, 3) approximate place of the mark in the window.

    Returns
    -------
    (height, width) mask, all False where there is no such edge or the mark itself lies beyond it.
    """
    drawn = picture(mark, pixel_from_mark, window.shape[1], window.shape[0], 1.0)
    away_px = cv2.distanceTransform((drawn <= _DRAWN).astype(np.uint8), cv2.DIST_L2, 5)
    near, shown = away_px <= _BESIDE_PX, drawn > _SHOWN * drawn.max()
    lighter = window > threshold_otsu(window[near])
    here = lighter if lighter[near & (away_px > 0)].mean() > 0.5 else ~lighter
    own, beyond = window[near & here], window[near & ~here]
    if not len(beyond) or here[shown].mean() <= 0.5 or abs(own.mean() - beyond.mean()) < _FAR * own.std():
        return np.zeros(window.shape, dtype=bool)
    return np.asarray(cv2.distanceTransform(here.astype(np.uint8), cv2.DIST_L2, 5) <= _EDGE_PX)


# Saturation and clipping: grey values at the end of a scanner's range bound the light from one side only.
#
# Such an observation is censored (Tobin, 1958, Estimation of relationships for limited dependent variables). Its
# likelihood is the probability that noise takes it beyond the limit. It enters least squares as a residual whose square
# is -2 log of that probability (a deviance residual): the ordinary residual where the model lies well within the range,
# zero where it lies well beyond. No observation is excluded by a threshold, which would bias the rest.
# Its information is the curvature of that likelihood.


def clipped_ends(samples: Samples, full_scale_dn: float, weights: Sequence[float] | None = None) -> ClippedEnds:
    """Find the clipped ones among stored values.

    Parameters
    ----------
    samples : (height, width, channels)
    weights : of the channels of a colour scan. None is negative, so a clipped channel of positive weight bounds the
        weighted sum.

    Returns
    -------
    (height, width) int8: 1 at the upper end of the scanner's range or where whites are clipped below it, -1 at the
    lower end, 0 elsewhere.
    """
    full_bits, limits = int(full_scale_dn).bit_length(), {full_scale_dn}
    for bits in _BITS:
        if bits < full_bits:
            limits |= {float(2**bits - 1), float((2**bits - 1) << (full_bits - bits))}
    ends = np.zeros(samples.shape[:2], np.int8)
    for channel in range(samples.shape[2]):
        if weights is None or weights[channel] > 0:
            grey = samples[..., channel]
            if grey.max() in limits or _is_cut(grey):
                ends[grey == grey.max()] = 1
            ends[grey == 0] = -1
    return ends


def deviance_residuals(residuals: Array, ends: ClippedEnds, sigma_dn: float) -> tuple[Array, Array, Array]:
    """Compute the deviance residuals of clipped grey values. residuals (n,): grey value minus model; ends (n,):
    clipped end; sigma_dn: standard deviation of the noise.

    Returns
    -------
    Deviance residuals (n,), their derivatives with respect to the ordinary residuals, 0 to 1, and their information
    relative to an ordinary grey value, one to two times the squared derivative.
    """
    within = ends * residuals / sigma_dn
    log_probability = np.asarray(log_ndtr(-within), dtype=float)
    hazard = _hazard(within, log_probability)
    size = np.sqrt(np.maximum(-2 * log_probability, 1e-300))
    slopes = np.minimum(hazard / size, 1.0)
    return ends * sigma_dn * size, slopes, np.clip(hazard * (hazard - within), slopes**2, 2 * slopes**2)


def noise_scale(residuals: Array, ends: ClippedEnds, start_dn: float, least_dn: float) -> float:
    """Estimate the standard deviation of the noise by maximum likelihood from residuals (n,), some clipped
    at ends (n,).

    Returns at least least_dn; start_dn: rough initial value. The mean square of an observation's score (its residual
    if ordinary) equals its information in units of the variance. Residuals more than _GROSS standard deviations within
    the range are damage.
    """
    clipped = ends != 0
    ordinary, within = residuals[~clipped], (ends * residuals)[clipped]
    ordinary, within = ordinary[np.abs(ordinary) < _GROSS * start_dn], within[within < _GROSS * start_dn]
    squares, sigma = float(np.sum(ordinary**2)), max(start_dn, least_dn)
    for _ in range(_SCALE_ROUNDS):
        hazard = _hazard(within / sigma, log_ndtr(-within / sigma))
        information = np.sum(hazard * (hazard - within / sigma))
        variance = (squares + sigma**2 * np.sum(hazard**2)) / max(len(ordinary) + information, 1.0)
        sigma = max(float(np.sqrt(variance)), least_dn)
    return sigma


def _hazard(within: Array, log_probability: Array) -> Array:
    """Hazard function of the normal distribution: density over tail probability."""
    return np.asarray(np.exp(_LOG_DENSITY - within**2 / 2 - log_probability))


def _is_cut(grey: Samples) -> bool:
    """Whether whites were clipped at the maximum. In the unclipped tail of a histogram, of the values within _TAIL
    noise standard deviations of the maximum, the maximum itself has at most a uniform share."""
    greatest = grey.max()
    pile = int((grey == greatest).sum())
    if pile < _FEWEST:
        return False
    both_below = (grey[:, 1:] < greatest) & (grey[:, :-1] < greatest)
    sigma = robust_scale(np.diff(grey.astype(float), axis=1)[both_below]) / np.sqrt(2)
    step = float(np.diff(np.unique(grey).astype(float)).min(initial=np.inf))
    if both_below.sum() < _FEWEST or not sigma > _LEAST_STEPS * step:
        return False
    tail = int((grey >= float(greatest) - _TAIL * sigma).sum())
    return bool(bdtrc(pile - 1, tail, step / (_TAIL * sigma)) < CLIPPED_END)
