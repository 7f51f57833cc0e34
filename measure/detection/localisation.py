"""A mark localised near its predicted place: where it looks most like itself, at full or half resolution, and how many
places noise would make that look as much so."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy import fft
from scipy.special import ndtr

from measure.array_types import Array, Single
from measure.detection.correlation import WIDE, Surroundings, correlation
from measure.detection.mark_views import detail_px
from measure.detection.peaks import highest_about
from measure.flags import NOISE_LIKE_A_MARK
from measure.marks.rendering import extent_px, known_picture
from measure.marks.shapes import Mark
from measure.matching.match import mark_window
from measure.matching.window import FAINT
from measure.scans.scan import Scan

Map = Single

_SURE = 1e-6  # what is less likely is the mark, however soft: there are many marks
_HALVED_PX = 6.0  # of the finest line: from there on half the resolution shows it as well
_SHARP_PX, _SOFT_PX = 1.0, 2.5  # blur of the picture that is looked for: a fine line seen softly is another picture


@dataclass(frozen=True, eq=False)
class MarkPrediction:
    """pixel_from_mark: (2, 3), its last column the predicted place. search_px: the radius about it within which the
    mark is looked for. polarity: +1 for a mark lighter than its surroundings, -1 for a darker one. weights: of the
    scan's channels, None for its own. surroundings: what about the mark counts where it is looked for."""

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
        """(2,) predicted."""
        return self.pixel_from_mark[:, 2]

    def moved(self, center_px: Array) -> Self:
        """The same at another place."""
        return replace(self, pixel_from_mark=np.column_stack([self.linear, center_px]))


def localise(scan: Scan, expected: MarkPrediction) -> tuple[Array, float] | None:
    """Find the highest correlation peak within the search radius.

    The mark is drawn sharp or soft, whichever noise is less likely to feign: a soft faint mark, drawn sharp, is no more
    than its noise.

    Returns
    -------
    The peak's column and row in the scan, to a part of a pixel, and the expected number of false alarms; None where
    noise would make as high a peak.
    """
    searches = [_PeakSearch(scan, expected, _SHARP_PX)]
    if searches[0].false_alarms > _SURE:
        searches.append(_PeakSearch(scan, expected, _SOFT_PX))
    best = min(searches, key=lambda search: search.false_alarms)
    return (best.center_px, best.false_alarms) if best.false_alarms <= NOISE_LIKE_A_MARK else None


def highest_peak(scan: Scan, expected: MarkPrediction) -> tuple[Array, float]:
    """Column and row of the highest correlation peak within the search radius, and its height."""
    search = _PeakSearch(scan, expected, _SHARP_PX)
    return search.center_px, search.height


class _PeakSearch:
    """center_px (2,): where the mark, drawn with that blur, correlates best; height: how well."""

    def __init__(self, scan: Scan, expected: MarkPrediction, blur_px: float) -> None:
        mark, surroundings = expected.mark, expected.surroundings
        reduction = 2 if detail_px(mark, expected.linear) >= _HALVED_PX else 1
        reduced = np.column_stack([expected.linear, expected.center_px - (reduction - 1) / 2]) / reduction
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
        # A median at the window's end would see half of what lies about it: beside the frame's edge only the border.
        rim = surroundings.ground_reach_px(finest_px)
        wide = mark_window(mark, reduced, search_px + spare + 2 + rim)
        window = scan.reduced_window(reduction, *wide, expected.weights)
        flattened = surroundings.flattened(window, finest_px, scan.full_scale_dn * FAINT)
        self._flat = expected.polarity * flattened[rim:-rim, rim:-rim]
        self._pattern, self._counts = surroundings.pattern(template, finest_px, self._flat)
        response = correlation(self._flat, self._pattern, self._counts)
        first = np.array(wide[:2]) + rim - low  # the place of the first response
        rows, cols = np.indices(response.shape)
        near = np.hypot(cols + first[0] - reduced[0, 2], rows + first[1] - reduced[1, 2]) <= search_px
        self._best = divmod(int(np.where(near, response, -2.0).argmax()), response.shape[1])
        self._places = int(near.sum())
        # A fit that begins within a part of a pixel takes a step less.
        top = highest_about(response, np.array([self._best[::-1]]), 0.0)[0][0]
        self.center_px: Array = (top + first) * reduction + (reduction - 1) / 2
        self.height = float(response[self._best])

    @cached_property
    def false_alarms(self) -> float:
        """The expected number of peaks as high that noise makes. The correlation of two rows of numbers, each
        with its own autocorrelation, varies by the sum of the products of these over how many they are (Bartlett,
        1935); that sum is what one answers to the other at all offsets."""
        if self.height <= 0:
            return float(self._places)
        chip = self._pattern
        noise = self._flat - self._flat.mean()
        here = noise[self._best[0] :, self._best[1] :][: chip.shape[0], : chip.shape[1]]
        here -= chip * np.float32((here * chip).sum() / (chip**2).sum())
        shape = [fft.next_fast_len(sum(sides), real=True) for sides in zip(noise.shape, chip.shape, strict=True)]
        power = np.abs(fft.rfft2(noise, s=shape) * fft.rfft2(chip, s=shape)) ** 2
        answers = float(fft.irfft(power.sum(axis=0), n=shape[1])[0]) / shape[0]  # their squares (Parseval)
        energy = max(float((noise**2).sum() * (chip**2).sum()), 1e-12)
        variance = max(answers / energy, 1e-12) / float(self._counts.sum())
        unlike = max(1 - self.height**2, 1e-12)
        return float(self._places * ndtr(-self.height / np.sqrt(unlike * variance)))
