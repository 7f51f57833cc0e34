"""Combination of a colour scan's channels with the highest contrast of the marks over the noise."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.detection.localisation import highest_peak
from measure.fiducials.frame import Frame
from measure.marks.rendering import picture
from measure.marks.shapes import Mark
from measure.matching.match import mark_window
from measure.scans.scan import LUMINANCE, SINGLE_CHANNELS, Scan

_MARGIN_PX = 4.0  # width of the background around a mark, used to estimate its offset and slopes
_BLUR_PX = 0.8  # blur of a mark's image, the initial value of a match
_CLEAR_PEAK = 0.25  # NCC before the fit that corresponds to the likeness of a clear mark after it
_TRIALS = 6  # about this many marks are used to choose the channels
_SHRINK = 0.1  # shrinkage of the noise covariance towards a multiple of the unit matrix: few pixels determine it poorly


def choose_channels(frame: Frame) -> Frame:
    """Choose the channel weights of a colour scan.

    Some marks are located, each in the channel (or the luminance) with the highest correlation peak. The weights are
    then estimated from these marks.
    If no mark is drawn as light or dark, the weights also determine the polarity.
    """
    if frame.scan.channels == 1:
        return frame
    marks = frame.layout.marks
    places = []
    for index in range(0, len(marks), max(1, len(marks) // _TRIALS)):
        expected = frame.prediction(index, frame.first_search_px)
        peaks = [
            highest_peak(frame.scan, replace(expected, weights=weights)) for weights in (LUMINANCE, *SINGLE_CHANNELS)
        ]
        place, height = max(peaks, key=lambda peak: peak[1])
        if height > _CLEAR_PEAK:
            places.append((expected.mark, expected.moved(place).pixel_from_mark, expected.polarity))
    unsaid = all(mark.mark.polarity == "auto" for mark in marks)
    best = best_weights(frame.scan, places, (1, -1) if unsaid else (1,))
    if best is None:
        return frame
    weights, sign = best
    return replace(frame, weights=weights, placement=replace(frame.placement, polarity=sign * frame.placement.polarity))


def best_weights(
    scan: Scan, marks: Sequence[tuple[Mark, Array, int]], signs: Sequence[int] = (1,)
) -> tuple[tuple[float, ...], int] | None:
    """Estimate channel weights by Fisher's linear discriminant.

    Parameters
    ----------
    scan : colour scan.
    marks : marks with pixel_from_mark (2, 3) and sign: +1 lighter than the background, -1 darker.
    signs : common factors of all signs to try, since a mark may be lighter in one channel and darker in another.

    Returns
    -------
    Weights with sum 1, and the best of signs. None for a grey scan, or if no mark has any contrast.

    Notes
    -----
    Negative weights are set to 0: a difference of channels would show their misregistration.
    """
    if scan.channels == 1 or not marks:
        return None
    contrast, covariance = np.zeros(scan.channels), np.zeros((scan.channels, scan.channels))
    for mark, pixel_from_mark, sign in marks:
        col0, row0, width, height = mark_window(mark, pixel_from_mark, _MARGIN_PX)
        channels = np.stack(
            [scan.window(col0, row0, width, height, unit).ravel() for unit in np.eye(scan.channels).tolist()]
        )
        shifted = np.array(pixel_from_mark)
        shifted[:, 2] -= (col0, row0)
        value = picture(mark, shifted, width, height, _BLUR_PX).ravel()
        row, col = np.mgrid[:height, :width].reshape(2, -1).astype(float)
        design = np.stack([value, np.ones_like(value), col, row], axis=1)
        solution, *_ = np.linalg.lstsq(design, channels.T, rcond=None)
        contrast += sign * solution[0]
        covariance += np.cov(channels - (design @ solution).T)
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
    weights = np.maximum(best * discriminant, 0.0)
    return tuple(float(weight) for weight in weights / weights.sum()), best
