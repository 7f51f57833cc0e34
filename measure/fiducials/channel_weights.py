"""Weights of the channels of a colour scan, by Fisher's linear discriminant between marks and their background."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from measure.array_types import Array
from measure.detection.localisation import MarkPrediction, highest_peak
from measure.marks.rendering import mark_window, picture
from measure.marks.shapes import Mark
from measure.scans.scan import LUMINANCE, SINGLE_CHANNELS, Scan

_MARGIN_PX = 4.0  # width of the background around a mark, used to estimate its offset and slopes
_BLUR_PX = 0.8  # blur of a mark's image
_CLEAR_PEAK = 0.25  # NCC before the fit that corresponds to the likeness of a clear mark after it
_CHANNELS = "red", "green", "blue"
_COINCIDING_PX, _FEWEST_SHIFTS = 0.5, 3  # px between two channels below which they coincide, by this many marks
_SHRINK = 0.1  # shrinkage of the noise covariance towards a multiple of the unit matrix: few pixels determine it poorly


def estimate_weights(
    scan: Scan, predictions: Sequence[MarkPrediction], signs: Sequence[int]
) -> tuple[tuple[float, ...], int, str] | None:
    """Estimate the channel weights of a colour scan from some of its marks, predicted within their search radius.

    Each mark is located in the channel (or the luminance) with the highest correlation peak. Where channels do not
    coincide, only those count that do with one another.

    Returns
    -------
    Weights, the best of signs (see `best_weights`), and a note if channels do not coincide; None if no mark is found.
    """
    peaks = [
        [highest_peak(scan, replace(expected, weights=weights)) for weights in (*SINGLE_CHANNELS, LUMINANCE)]
        for expected in predictions
    ]
    among, note = registered_channels([each[:-1] for each in peaks])
    places = []
    for expected, own in zip(predictions, peaks, strict=True):
        place, height = max((own[each] for each in (among if note else range(len(own)))), key=lambda peak: peak[1])
        if height > _CLEAR_PEAK:
            places.append((expected.mark, expected.shift_to(place).pixel_from_mark, expected.polarity))
    best = best_weights(scan, places, signs, among)
    return None if best is None else (*best, note)


def registered_channels(peaks: Sequence[Sequence[tuple[Array, float]]]) -> tuple[list[int], str]:
    """Find the largest group of channels that coincide.

    Parameters
    ----------
    peaks : place (px) and height of the correlation peak of each mark in red, green and blue.

    Returns
    -------
    Indices of these channels, and a note if others do not coincide with them.
    """
    places, heights = (np.array([[peak[part] for peak in each] for each in peaks]) for part in (0, 1))
    count, clear = len(SINGLE_CHANNELS), heights > _CLEAR_PEAK
    shifts = np.zeros((count, count, 2))
    for one, other in permutations(range(count), 2):
        between = (places[:, other] - places[:, one])[clear[:, one] & clear[:, other]]
        shift = np.median(between, axis=0) if len(between) >= _FEWEST_SHIFTS else np.zeros(2)
        if len(between) and np.median(np.hypot(*(between - shift).T)) < _COINCIDING_PX:  # else peaks of something else
            shifts[one, other] = shift
    coincide = np.hypot(*np.moveaxis(shifts, -1, 0)) <= _COINCIDING_PX
    best = max(range(count), key=lambda each: (coincide[each].sum(), heights[:, coincide[each]].sum()))
    among, apart = (np.flatnonzero(coincide[best] == one).tolist() for one in (True, False))
    if not apart:
        return among, ""
    own = " and ".join(_CHANNELS[each] for each in among)
    shifted = " and ".join(
        f"{_CHANNELS[each]} lies ({shifts[best, each, 0]:+.1f}, {shifts[best, each, 1]:+.1f}) px" for each in apart
    )
    note = f"The colour channels do not coincide: {shifted} from {own}. Marks are measured in {own} alone."
    return among, note


def best_weights(
    scan: Scan, marks: Sequence[tuple[Mark, Array, int]], signs: Sequence[int] = (1,), among: Sequence[int] = (0, 1, 2)
) -> tuple[tuple[float, ...], int] | None:
    """Estimate channel weights by Fisher's linear discriminant.

    Parameters
    ----------
    scan : colour scan.
    marks : marks with pixel_from_mark (2, 3) and sign: +1 lighter than the background, -1 darker.
    signs : common factors of all signs to try, since a mark may be lighter in one channel and darker in another.
    among : channels that may have a weight.

    Returns
    -------
    Weights with sum 1, and the best of signs. None for a grey scan, or if no mark has any contrast.

    Notes
    -----
    Negative weights are set to 0: a difference of channels would show their misregistration.
    """
    if scan.channels == 1 or not marks:
        return None
    units = np.eye(scan.channels)[list(among)]
    contrast, covariance = np.zeros(len(units)), np.zeros((len(units), len(units)))
    for mark, pixel_from_mark, sign in marks:
        col0, row0, width, height = mark_window(mark, pixel_from_mark, _MARGIN_PX)
        channels = np.stack([scan.window(col0, row0, width, height, unit).ravel() for unit in units.tolist()])
        shifted = np.array(pixel_from_mark)
        shifted[:, 2] -= (col0, row0)
        value = picture(mark, shifted, width, height, _BLUR_PX).ravel()
        row, col = np.mgrid[:height, :width].reshape(2, -1).astype(float)
        design = np.stack([value, np.ones_like(value), col, row], axis=1)
        solution, *_ = np.linalg.lstsq(design, channels.T, rcond=None)
        contrast += sign * solution[0]
        covariance += np.atleast_2d(np.cov(channels - (design @ solution).T))
    covariance += _SHRINK * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    if not np.linalg.det(covariance) > 0:
        return None
    discriminant = np.linalg.solve(covariance, contrast)

    def contrast_over_noise(sign: int) -> float:
        """Contrast over noise of the non-negative weights for a sign."""
        weights = np.maximum(sign * discriminant, 0.0)
        return float(sign * weights @ contrast / np.sqrt(max(weights @ covariance @ weights, 1e-300)))

    best = max(signs, key=contrast_over_noise)
    if not contrast_over_noise(best) > 0:
        return None
    weights = np.maximum(best * discriminant, 0.0) @ units
    return tuple(float(weight) for weight in weights / weights.sum()), best
