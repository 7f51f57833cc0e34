"""Lengths of the arms of a cross, over those drawn."""

from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.marks.rendering import picture
from measure.marks.shapes import Bar, MarkShape
from measure.matching.models import background_planes
from measure.matching.window import ScanWindow
from measure.results import MarkFit

_CHANGE = 0.3  # of a length: a column of the design is the picture of a longer arm less that of a shorter one
_LEAST = 0.1  # of the drawn mark's contrast


def is_cross(mark: MarkShape) -> bool:
    """Whether a mark is drawn of lines alone, whose ends are those of its arms and known."""
    return mark.known_mm is None and all(isinstance(part, Bar) for part in mark.parts)


def measure_arms(window: ScanWindow, mark: MarkShape, pixel_from_mark: Array, fit: MarkFit) -> tuple[Array, Array]:
    """Lengths of the arms of a cross over those drawn, by linear least squares with gain, offset and slopes.

    A picture of a longer arm less that of a shorter one is as bright along the end as it is at its tip: of an arm that
    lacks a part of that stretch the same part lacks, however sharp the picture is. What the match cut out as damage
    counts, for an arm that is not there is cut out, too.

    Parameters
    ----------
    window : ScanWindow
        That shows the cross.
    pixel_from_mark : (2, 3)
        Of the scan: the place as matched, the linear part as the frame has it, for an arm's end moves the mark's own.

    Returns
    -------
    (arms,) in the order in which the bars name their ends, and their standard deviations.
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
    # Noise that neighbours share by rho, along columns and rows, is of fewer pixels.
    rho = float(np.clip(fit.neighbour_correlation, 0.0, 0.9))
    variance = float(left @ left) / max(len(grey) - len(design), 1) * ((1 + rho) / (1 - rho)) ** 2
    gain = solution[len(changes)]
    gain = gain if abs(gain) > _LEAST * abs(fit.contrast_dn) else fit.contrast_dn
    sigmas = np.sqrt(variance * np.diag(inverse)[: len(changes)]) / abs(gain)
    return 1 + solution[: len(changes)] / gain, sigmas


def _arm_variants(mark: MarkShape) -> list[tuple[MarkShape, MarkShape]]:
    """Of each arm the mark with a longer and with a shorter one."""
    pairs = list[tuple[MarkShape, MarkShape]]()
    for index, bar in enumerate(mark.parts):
        assert isinstance(bar, Bar)
        for tip, other in ((bar.from_mm, bar.to_mm), (bar.to_mm, bar.from_mm)):
            if np.dot(tip, np.subtract(tip, other)) > 0:  # where an arm begins beside the middle is no tip
                ends = ((tip[0] * share, tip[1] * share) for share in (1 + _CHANGE, 1 - _CHANGE))
                longer, shorter = (_with_part(mark, index, Bar(other, end, bar.line_mm)) for end in ends)
                pairs.append((longer, shorter))
    return pairs


def _with_part(mark: MarkShape, index: int, part: Bar) -> MarkShape:
    return replace(mark, parts=(*mark.parts[:index], part, *mark.parts[index + 1 :]))
