"""The combination of a colour scan's channels in which the marks stand out most."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from measure.marks.rendering import picture
from measure.marks.shapes import Mark
from measure.matching.match import mark_window
from measure.scans.scan import Scan

Array = NDArray[np.float64]

_MARGIN_PX = 4.0  # of ground about a mark, from which its offset and slopes are told
_BLUR_PX = 0.8  # of a mark's picture: what a match begins with
_SHRINK = 0.1  # of the noise covariance towards a multiple of the unit matrix: few pixels know it badly


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

    def told(sign: int) -> float:
        """The contrast over its noise."""
        weights = np.maximum(sign * discriminant, 0.0)
        return float(sign * weights @ contrast / np.sqrt(max(weights @ covariance @ weights, 1e-300)))

    best = max(signs, key=told)
    if not told(best) > 0:
        return None
    weights = np.maximum(best * discriminant, 0.0)
    return tuple(float(weight) for weight in weights / weights.sum()), best
