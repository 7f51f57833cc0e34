"""The combination of a colour scan's channels in which the marks stand out most."""

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

_MARGIN_PX = 4.0  # of ground about a mark, from which its offset and slopes are told
_BLUR_PX = 0.8  # of a mark's picture: what a match begins with
_CLEAR_PEAK = 0.25  # correlation of marks before they are fitted, where the fitted likeness is that of clear ones
_TRIALS = 6  # marks that the channels are chosen from
_SHRINK = 0.1  # of the noise covariance towards a multiple of the unit matrix: few pixels know it badly


def choose_channels(frame: Frame) -> Frame:
    """Choose the channels of a colour scan: that in which some marks correlate best, then from these marks the best
    combination. Where no mark is drawn light or dark, the polarity is that of the combination."""
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
    """Weights (sum 1) of the channels after Fisher's discriminant, from marks with their pixel_from_mark (2, 3) and
    their sign, +1 lighter than their ground and -1 darker; and which of signs it is to be multiplied by: the same mark
    may be lighter in one channel and darker in another.

    None for a grey scan, or where no mark shows any contrast. No channel counts negatively: a difference of channels
    would show where they do not lie on one another.
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
        """The contrast over its noise."""
        weights = np.maximum(sign * discriminant, 0.0)
        return float(sign * weights @ contrast / np.sqrt(max(weights @ covariance @ weights, 1e-300)))

    best = max(signs, key=contrast_over_noise)
    if not contrast_over_noise(best) > 0:
        return None
    weights = np.maximum(best * discriminant, 0.0)
    return tuple(float(weight) for weight in weights / weights.sum()), best
