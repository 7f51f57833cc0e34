"""Localisation of a mark near its predicted place: highest NCC at full or half resolution, with its false alarms.

An unknown mark is located as the structure common to all frames of a camera. A mark or the frame's edge recurs in every
frame, the landscape does not. An edge recurs along its whole length, a mark at one place only. The mark is therefore
the square whose best match in other frames exceeds the second best most.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import cv2
import numpy as np
from scipy import fft

from measure.array_types import Array, Single
from measure.detection.correlation import WIDE, Surroundings, correlation, expected_peaks, highest_about
from measure.flags import NOISE_LIKE_A_MARK
from measure.geometry import linear_scale, reduced_px, scan_px
from measure.marks.rendering import detail_px, extent_px, known_picture, mark_window
from measure.marks.shapes import Mark
from measure.marks.templates import cut, resample_chip
from measure.matching.window import FAINT
from measure.scans.scan import Scan

_SURE = 1e-6  # false alarms below which no softer template is tried; small, since there are many marks
_HALVED_PX = 6.0  # px, width of the finest line from which on half the resolution suffices
# Blurs of the two templates, sharp and soft: a blurred thin line, or one that exposure or sharpening widened, differs
# much from a sharp one.
TEMPLATE_BLURS_PX = (1.0, 2.5)
Window = Single

_SIDE = 24  # samples along the square
_STEP = 3  # samples between the squares tried
_APART = _SIDE // 3  # samples within which two matches are the same place
_DETAIL = 2.0  # samples, width of the finest detail
_LEAST_VARIANCE = 0.01  # added to the variance of images of unit variance, since few frames may agree by chance


@dataclass(frozen=True, eq=False)
class MarkPrediction:
    """Predicted mark.

    Attributes
    ----------
    mark : drawing or template.
    pixel_from_mark : (2, 3); its last column is the predicted place.
    search_px : search radius around it.
    polarity : +1 for a mark lighter than its background, -1 for a darker one.
    weights : of the scan's channels; None: the scan's own.
    surroundings : treatment of the background in the search.
    """

    mark: Mark
    pixel_from_mark: Array
    search_px: float
    polarity: int
    weights: Sequence[float] | None = None
    surroundings: Surroundings = WIDE

    @property
    def linear(self) -> Array:
        """(2, 2) px per mm."""
        return self.pixel_from_mark[:, :2]

    @property
    def center_px(self) -> Array:
        """(2,) predicted place."""
        return self.pixel_from_mark[:, 2]

    def shift_to(self, center_px: Array) -> Self:
        """Copy of the prediction at another place."""
        return replace(self, pixel_from_mark=np.column_stack([self.linear, center_px]))


def localise(scan: Scan, expected: MarkPrediction) -> tuple[Array, float] | None:
    """Find the highest correlation peak within the search radius.

    A sharp and a soft template are tried, and the one with fewer false alarms is used: a soft faint mark is not
    significant with a sharp template.

    Returns
    -------
    Column and row of the peak in the scan, with sub-pixel accuracy, and the expected number of false alarms; None if
    the peak is not significant.
    """
    sharp_px, soft_px = TEMPLATE_BLURS_PX
    searches = [PeakSearch(scan, expected, sharp_px)]
    if searches[0].false_alarms > _SURE:
        searches.append(PeakSearch(scan, expected, soft_px))
    best = min(searches, key=lambda search: search.false_alarms)
    false_alarms = len(searches) * best.false_alarms
    return (best.center_px, false_alarms) if false_alarms <= NOISE_LIKE_A_MARK else None


def highest_peak(scan: Scan, expected: MarkPrediction) -> tuple[Array, float]:
    """Column and row of the highest correlation peak within the search radius, and its height."""
    search = PeakSearch(scan, expected, TEMPLATE_BLURS_PX[0])
    return search.center_px, search.height


class PeakSearch:
    """Highest correlation peak of a mark rendered with a blur. center_px (2,); height: NCC."""

    def __init__(self, scan: Scan, expected: MarkPrediction, blur_px: float) -> None:
        mark, surroundings = expected.mark, expected.surroundings
        reduction = 2 if detail_px(mark, expected.linear) >= _HALVED_PX else 1
        reduced = np.column_stack([expected.linear / reduction, reduced_px(expected.center_px, reduction)])
        search_px, blur_px = expected.search_px / reduction, blur_px / reduction
        spare = int(np.ceil(2 * blur_px))
        centred = np.column_stack([reduced[:, :2], np.zeros(2)])
        low, high = (
            way(each).astype(int) for way, each in zip((np.floor, np.ceil), extent_px(mark, centred), strict=True)
        )
        low, high = low - spare, high + spare
        centred[:, 2] = -low
        finest_px = max(detail_px(mark, reduced[:, :2]), blur_px)
        template_cols, template_rows = (high - low + 1).tolist()
        template = known_picture(mark, centred, template_cols, template_rows, blur_px)
        # At the window's end a median would cover only half of its surroundings, near the frame's edge only the border.
        rim = surroundings.ground_reach_px(finest_px)
        wide = mark_window(mark, reduced, search_px + spare + 2 + rim)
        window = scan.reduced_window(reduction, *wide, expected.weights)
        flattened = surroundings.flatten(window, finest_px, scan.full_scale_dn * FAINT)
        self._flat = expected.polarity * flattened[rim:-rim, rim:-rim]
        self._counts = surroundings.mask(template, finest_px)
        self._pattern = surroundings.pattern(template, finest_px, self._counts, self._flat)
        response = correlation(self._flat, self._pattern, self._counts)
        first = np.array(wide[:2]) + rim - low  # place of the first response
        rows, cols = np.indices(response.shape)
        near = np.hypot(cols + first[0] - reduced[0, 2], rows + first[1] - reduced[1, 2]) <= search_px
        self._best = divmod(int(np.where(near, response, -2.0).argmax()), response.shape[1])
        self._radius_px = search_px
        # A sub-pixel start saves the fit one step.
        top = highest_about(response, np.array([self._best[::-1]]), 0.0)[0][0]
        self.center_px: Array = scan_px(top + first, reduction)
        self.height = float(response[self._best])

    @cached_property
    def false_alarms(self) -> float:
        """Expected number of peaks as high under noise, which correlates with the template like a Gaussian field. The
        variance of the correlation of two autocorrelated series is the sum of the products of their autocorrelations
        over their number (Bartlett, 1935). That sum equals the sum of squares of their cross-correlation over all
        offsets, whose spectrum gives the covariance of the field's slopes, too."""
        chip = self._pattern
        noise = self._flat - self._flat.mean()
        here = noise[self._best[0] :, self._best[1] :][: chip.shape[0], : chip.shape[1]]
        here -= chip * np.float32((here * chip).sum() / (chip**2).sum())
        shape = [fft.next_fast_len(sum(sides), real=True) for sides in zip(noise.shape, chip.shape, strict=True)]
        power = np.abs(fft.rfft2(noise, s=shape) * fft.rfft2(chip, s=shape)) ** 2
        down, across = 2 * np.pi * fft.fftfreq(shape[0])[:, None], 2 * np.pi * fft.rfftfreq(shape[1])
        sums, by_down = power.sum(axis=0), (power * down).sum(axis=0)
        moments = np.stack([sums, sums * across**2, by_down * across, (power * down**2).sum(axis=0)])
        # Sums of squares (Parseval): of the field, and of its slopes.
        answers, *slopes = fft.irfft(moments, n=shape[1])[:, 0].astype(float) / shape[0]
        energy = max(float((noise**2).sum() * (chip**2).sum()), 1e-12)
        variance = max(answers / energy, 1e-12) / float(self._counts.sum())
        strength = self.height / np.sqrt(max(1 - self.height**2, 1e-12) * variance)
        covariance = np.array(slopes)[[[0, 1], [1, 2]]] / max(answers, 1e-12)
        return expected_peaks(strength, covariance, self._radius_px)


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
