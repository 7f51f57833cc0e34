"""Learned marks that look like one another however their frame lies: then their origins are made one place of each.

Where a learned mark's origin lies on it is a convention. In a frame that lies another way a mark may be taken for
another that looks like it there, and then the origin would lie elsewhere: unless every such pose takes the origins to
one another, as it takes the middles of crosses.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.detection.candidates import quarter_turned
from measure.marks.poses import POSES, up_from_camera
from measure.marks.shapes import MarkTemplate

Array = NDArray[np.float64]

_ALIKE = 0.8  # correlation of two pictures of one mark, with the landscape beside it
_CORE = 0.15  # of the picture's side: by so much two origins may lie apart in each coordinate
_SMOOTH_PX = 5  # of the pictures that are aligned: their noise
_STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-5)
_FLIP = np.diag([1.0, -1.0])  # from right and up to columns and rows


def with_common_origins(
    templates: Sequence[MarkTemplate], places_mm: Array, poses: Collection[str]
) -> tuple[list[MarkTemplate], Array]:
    """The templates of a camera's learned marks at places_mm (n, 2), each with those of the poses, which frames do not
    tell apart, under which all of them look alike, and their origins such that these poses take them to one another;
    and by how much these moved, mm (n, 2), in the camera's axes."""
    count, rows, shifts, alike = len(templates), list[Array](), list[Array](), list[str]()
    for pose in (pose for pose in POSES[1:] if pose in poses):
        turn = up_from_camera(pose)
        to = _partners(places_mm, turn, max(template.learned_mm for template in templates))
        pairs = [] if to is None else [_aligned(templates[k], templates[to[k]], turn) for k in range(count)]
        found = [pair for pair in pairs if pair is not None]
        if to is None or len(found) < count:
            continue
        alike.append(pose)
        for k, shift in enumerate(found):
            row = np.zeros((2, count, 2))
            row[:, to[k]] += np.eye(2)
            row[:, k] -= turn
            rows.append(row.reshape(2, -1))
            shifts.append(shift)
    if not alike:
        return list(templates), np.zeros((count, 2))
    moves = np.linalg.lstsq(np.concatenate(rows), np.concatenate(shifts), rcond=None)[0].reshape(count, 2)
    moved = [_moved(template, move, tuple(alike)) for template, move in zip(templates, moves, strict=True)]
    return moved, moves


def _partners(places_mm: Array, turn: Array, near_mm: float) -> list[int] | None:
    """Which mark lies where a turn takes each; None where one has no such partner."""
    apart = np.hypot(*np.moveaxis((places_mm @ turn.T)[:, None] - places_mm[None], -1, 0))
    to = apart.argmin(axis=1)
    return to.tolist() if apart.min(axis=1).max() < near_mm and len(set(to.tolist())) == len(to) else None


def _aligned(one: MarkTemplate, other: MarkTemplate, turn: Array) -> Array | None:
    """Where a mark's origin lies beside another's, mm (2,), once it is turned and laid where it is most like that; None
    where it is not like it."""
    seen, shown = _about_origin(other), quarter_turned(_about_origin(one), _FLIP @ turn @ _FLIP)
    side = min(len(seen), len(shown))
    margin = int(np.ceil(_CORE * side))
    within, core = _middle(seen, side), _middle(shown, side - 2 * margin)
    answers = cv2.matchTemplate(within, core, cv2.TM_CCOEFF_NORMED)
    row, col = np.unravel_index(int(answers.argmax()), answers.shape)
    warp = np.array([[1, 0, col], [0, 1, row]], np.float32)
    try:
        everywhere = np.ones_like(within, np.uint8)
        likeness, moved = cv2.findTransformECC(
            core, within, warp, cv2.MOTION_TRANSLATION, _STEPS, everywhere, _SMOOTH_PX
        )
    except cv2.error:  # it comes to no end: the two are not alike
        return None
    shift_px = np.asarray(moved, float)[:, 2] - margin
    return np.asarray(_FLIP @ shift_px * other.pitch_um / 1000) if likeness >= _ALIKE else None


def _about_origin(template: MarkTemplate) -> Array:
    """The largest square picture with the origin in its middle, to a part of a pixel."""
    size = np.array(template.image.shape[::-1])
    origin = np.array(template.origin_px)
    half = int(np.floor(min(np.min(origin), np.min(size - 1 - origin))))
    place = np.array([[1, 0, origin[0] - half], [0, 1, origin[1] - half]], np.float32)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(template.image, place, (2 * half + 1,) * 2, flags=flags), np.float64)


def _middle(picture: Array, side: int) -> NDArray[np.float32]:
    spare = (len(picture) - side) // 2
    return np.ascontiguousarray(picture[spare : spare + side, spare : spare + side], np.float32)


def _moved(template: MarkTemplate, move_mm: Array, alike: tuple[str, ...]) -> MarkTemplate:
    col, row = np.array(template.origin_px) + _FLIP @ move_mm * 1000 / template.pitch_um
    return replace(template, origin_px=(float(col), float(row)), alike=alike)
