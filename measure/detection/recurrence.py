"""Detection of an unknown mark near a place, as the structure common to all frames of a camera.

A mark or the frame's edge recurs in every frame, the landscape does not. An edge recurs along its whole length, a mark
at one place only. The mark is therefore the square whose best match in other frames exceeds the second best most.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from measure.array_types import Array, Single
from measure.detection.correlation import WIDE
from measure.geometry import linear_scale
from measure.marks.templates import cut, resample_chip
from measure.matching.window import FAINT
from measure.scans.scan import Scan

Window = Single

_SIDE = 24  # samples along the square
_STEP = 3  # samples between the squares tried
_APART = _SIDE // 3  # samples within which two matches are the same place
_DETAIL = 2.0  # samples, width of the finest detail
_LEAST_VARIANCE = 0.01  # added to the variance of images of unit variance, since few frames may agree by chance


@dataclass(frozen=True, eq=False)
class Recurrence:
    """Recurring structure. offset_mm: (2,) from the given place, in the camera's axes; excess: NCC of the best match in
    other frames minus that of the second best, median over the frames."""

    offset_mm: Array
    excess: float


def resample_square(scan: Scan, pixel_from_camera: Array, xy_mm: Array, size_mm: float, reach_mm: float) -> Window:
    """Resample the square around a place of the frame to the camera's axes (x right, y up), _SIDE samples per size_mm,
    with the background subtracted."""
    pitch_mm, linear = size_mm / _SIDE, pixel_from_camera[:, :2]
    half = int(np.ceil((size_mm / 2 + reach_mm) / pitch_mm))
    place = np.column_stack([linear, linear @ xy_mm + pixel_from_camera[:, 2]])
    chip = cut(scan, place, 2 * half * pitch_mm)
    fine = cv2.GaussianBlur(chip.grey, (0, 0), max(0.5 * pitch_mm * linear_scale(linear), 0.3))
    chip = replace(chip, grey=np.asarray(fine, float))
    sampled = resample_chip(chip, place, 2 * half + 1, 1000 * pitch_mm, order=1).astype(np.float32)
    return WIDE.flatten(sampled, _DETAIL, scan.full_scale_dn * FAINT)


def recurrence(reference: Window, others: Sequence[Window], size_mm: float) -> Recurrence:
    """Find the square of the reference that recurs most clearly in the other windows, then centre it where the
    recurring structure gives the most precise place."""
    span = reference.shape[0] - _SIDE
    tried = [(row, col) for row in range(0, span + 1, _STEP) for col in range(0, span + 1, _STEP)]
    excess = [_peak_excess(reference[row : row + _SIDE, col : col + _SIDE], others) for row, col in tried]
    best = int(np.argmax(excess))
    row, col = tried[best]
    square = reference[row : row + _SIDE, col : col + _SIDE]
    aligned = [reference]
    for window in others:
        response = np.asarray(cv2.matchTemplate(window, square, cv2.TM_CCOEFF_NORMED))
        own_row, own_col = np.unravel_index(response.argmax(), response.shape)
        shift = np.array([[1.0, 0.0, col - own_col], [0.0, 1.0, row - own_row]], np.float32)
        moved = cv2.warpAffine(window, shift, window.shape[::-1], flags=cv2.INTER_NEAREST)
        aligned.append(np.asarray(moved, np.float32))
    center_row, center_col = _most_informative_place(np.stack(aligned), (row, col))
    middle = (reference.shape[0] - 1) / 2
    offset = np.array([center_col - middle, middle - center_row]) * size_mm / _SIDE
    return Recurrence(offset, float(excess[best]))


def _most_informative_place(stack: Window, square: tuple[int, int]) -> tuple[int, int]:
    """Row and column within the square at (row, col) around which the mean of aligned windows has the most information
    on a place in the weaker direction: squared gradients over the variance between frames."""
    mean = stack.mean(axis=0)
    noise = cv2.GaussianBlur(stack.var(axis=0) / max(len(stack) - 1, 1), (0, 0), _DETAIL) + _LEAST_VARIANCE
    by_row, by_col = np.gradient(mean)
    sums = [
        cv2.GaussianBlur(product / noise, (0, 0), _SIDE / 4, borderType=cv2.BORDER_CONSTANT)
        for product in (by_col * by_col, by_col * by_row, by_row * by_row)
    ]
    least = (sums[0] + sums[2]) / 2 - np.hypot((sums[0] - sums[2]) / 2, sums[1])
    row, col = square
    inside = least[row : row + _SIDE, col : col + _SIDE]
    top = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top[0]) + row, int(top[1]) + col


def _peak_excess(square: Window, windows: Sequence[Window]) -> float:
    """NCC of the best match in a window minus that of the second best, median over the windows."""
    if square.std() < 1e-3:
        return 0.0
    excesses = []
    for window in windows:
        rest = np.array(cv2.matchTemplate(window, square, cv2.TM_CCOEFF_NORMED), np.float32)
        row, col = (int(each) for each in np.unravel_index(rest.argmax(), rest.shape))
        best = float(rest[row, col])
        rest[max(row - _APART, 0) : row + _APART + 1, max(col - _APART, 0) : col + _APART + 1] = -1.0
        excesses.append(best - max(float(rest.max()), 0.0))
    return float(np.median(excesses))
