"""Cameras whose solid marks are drawn much like those of others: wings, notches and arrows of which a scan hardly tells
which form they have."""

from collections.abc import Mapping

import cv2
import numpy as np

from measure.marks.rendering import known_picture
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, Polygon

_PX_PER_MM = 4.0
_HALF_MM, _OFF_MM = 7.0, 2.0  # of what is compared about a mark's point, and by how much two drawings may lie apart
_BLUR_PX = 1.5
_NEAR_MM = 6.0  # marks of two cameras that are taken for each other
_ALIKE = (
    0.75  # correlation from which on it takes a look to tell them apart: forms of the K-17's wings have 0.8 to 0.93
)


def drawn_alike(layouts: Mapping[tuple[str, ...], FiducialLayout]) -> dict[str, tuple[str, ...]]:
    """By name, of cameras of solid marks alone, the others whose marks look much like theirs at about their places."""
    solid = {names: layout for names, layout in layouts.items() if all(_is_solid(mark) for mark in layout.marks)}
    pictures = {names: [_picture(mark) for mark in layout.marks] for names, layout in solid.items()}

    def alike(names: tuple[str, ...], other: tuple[str, ...]) -> bool:
        places = np.array([mark.xy_mm for mark in solid[other].marks])
        found = []
        for mark, picture in zip(solid[names].marks, pictures[names], strict=True):
            off_mm = np.hypot(*(places - mark.xy_mm).T)
            found.append(_likeness(picture, pictures[other][int(off_mm.argmin())]) if off_mm.min() < _NEAR_MM else 0.0)
        return float(np.mean(found)) >= _ALIKE

    others = {names: [other[0] for other in solid if other != names and alike(names, other)] for names in solid}
    return {name: tuple(own) for names, own in others.items() if own for name in names}


def _is_solid(mark: LayoutMark) -> bool:
    return isinstance(mark.mark, MarkShape) and all(isinstance(part, Polygon) for part in mark.mark.parts)


def _picture(mark: LayoutMark) -> cv2.typing.MatLike:
    """What is not known of a drawing is ground."""
    half_px = round(_HALF_MM * _PX_PER_MM)
    matrix = np.array([[_PX_PER_MM, 0.0, half_px], [0.0, -_PX_PER_MM, half_px]])
    size = 2 * half_px + 1
    return np.nan_to_num(known_picture(mark.mark, matrix, size, size, _BLUR_PX)).astype(np.float32)


def _likeness(first: cv2.typing.MatLike, second: cv2.typing.MatLike) -> float:
    """The largest correlation of two drawings that may lie a little apart."""
    rim = round(_OFF_MM * _PX_PER_MM)
    return float(cv2.matchTemplate(second, first[rim:-rim, rim:-rim], cv2.TM_CCOEFF_NORMED).max())
