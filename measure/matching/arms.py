"""Measured lengths of the arms of a cross relative to the drawn ones."""

from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.marks.rendering import picture
from measure.marks.shapes import Bar, MarkShape
from measure.matching.models import background_planes
from measure.matching.window import ScanWindow
from measure.results import MarkFit

_CHANGE = 0.3  # fraction of the arm's length, step of the central differences in the design matrix
_LEAST = 0.1  # fraction of the fitted contrast: a smaller gain is replaced by it


def is_cross(mark: MarkShape) -> bool:
    """Whether a mark consists of bars only, with the ends of all arms known."""
    return mark.known_mm is None and all(isinstance(part, Bar) for part in mark.parts)


def measure_arms(window: ScanWindow, mark: MarkShape, pixel_from_mark: Array, fit: MarkFit) -> tuple[Array, Array]:
    """Estimate the lengths of the arms of a cross, relative to the drawn ones, by linear least squares.

    Gain, offset and slopes are further unknowns. The derivative with respect to a length is the difference of images
    with a longer and a shorter arm, which is uniform along the end of the arm: the estimate is proportional to the
    missing part, regardless of the blur. Pixels masked as damage are used, since a missing arm is masked, too.

    Parameters
    ----------
    window : window with the cross.
    pixel_from_mark : (2, 3) in pixels of the scan. The place is the matched one. The linear part is that of the frame,
        since the mark's own depends on the ends of its arms.

    Returns
    -------
    (arms,) relative lengths, in the order of the bars' ends, and their standard deviations.
    """
    place = pixel_from_mark - np.column_stack([np.zeros((2, 2)), window.origin_px])
    height, width = window.grey.shape
    drawn = picture(mark, place, width, height, fit.blur_px)
    changes = [
        (picture(more, place, width, height, fit.blur_px) - picture(less, place, width, height, fit.blur_px))
        / (2 * _CHANGE)
        for more, less in _arm_variants(mark)
    ]
    used = window.usable & (window.sides == 0)
    design = np.stack([*changes, drawn, *background_planes(height, width)])[:, used]
    grey = window.grey[used]
    inverse: Array = np.asarray(np.linalg.pinv(design @ design.T), float)
    solution = inverse @ (design @ grey)
    left = grey - solution @ design
    # Noise correlated by rho along columns and rows reduces the effective number of pixels.
    rho = float(np.clip(fit.neighbour_correlation, 0.0, 0.9))
    variance = float(left @ left) / max(len(grey) - len(design), 1) * ((1 + rho) / (1 - rho)) ** 2
    gain = solution[len(changes)]
    gain = gain if abs(gain) > _LEAST * abs(fit.contrast_dn) else fit.contrast_dn
    sigmas = np.sqrt(variance * np.diag(inverse)[: len(changes)]) / abs(gain)
    return 1 + solution[: len(changes)] / gain, sigmas


def _arm_variants(mark: MarkShape) -> list[tuple[MarkShape, MarkShape]]:
    """For each arm: the mark with that arm longer, and with it shorter."""
    pairs = list[tuple[MarkShape, MarkShape]]()
    for index, bar in enumerate(mark.parts):
        assert isinstance(bar, Bar)
        for tip, other in ((bar.from_mm, bar.to_mm), (bar.to_mm, bar.from_mm)):
            if np.dot(tip, np.subtract(tip, other)) > 0:  # the start of an arm near the centre is no tip
                ends = ((tip[0] * share, tip[1] * share) for share in (1 + _CHANGE, 1 - _CHANGE))
                longer, shorter = (_with_part(mark, index, Bar(other, end, bar.line_mm)) for end in ends)
                pairs.append((longer, shorter))
    return pairs


def _with_part(mark: MarkShape, index: int, part: Bar) -> MarkShape:
    return replace(mark, parts=(*mark.parts[:index], part, *mark.parts[index + 1 :]))
