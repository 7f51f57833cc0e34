"""A window of a scan as a fit takes it: its light, where it lies, and what is known of its pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.filters import threshold_otsu

from measure.array_types import Array, Mask
from measure.marks.rendering import picture
from measure.marks.shapes import Mark
from measure.matching.saturation import Sides, clipped_sides
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR, Tone

FAINT = 1 / 500  # of full scale: contrast below it is rounding, not a mark
_BESIDE_PX = 6.0  # about the drawing: the mark's own ground
_FAR = 5.0  # standard deviations of the mark's side, the mark being part of it: so far off is no ground of this mark
_EDGE_PX = 4.0  # an edge's blur: of 1.4 px it leaves a five hundredth of the edge so far off
_DRAWN, _SHOWN = 0.05, 0.5  # of the mark's contrast: all of it, and what is plainly its own


@dataclass(frozen=True, eq=False)
class Coding:
    """How the light of a window was stored: by the tone curve of a scan whose largest grey value is full_scale_dn.
    stored (height, width): the grey values themselves, None where the light is a mixture of channels."""

    stored: NDArray[np.floating] | None
    tone: Tone = LINEAR
    full_scale_dn: float = 65535.0

    def steps_dn(self, used: Mask) -> Array | None:
        """(height, width) the light between the limits from which each value was rounded; None where the values used
        are no multiples of one step, or not known."""
        if self.stored is None:
            return None
        gaps = np.diff(np.unique(np.asarray(self.stored[used], float)))
        step = float(gaps.min(initial=np.inf))
        if not np.isfinite(step) or np.any(gaps % step):
            return None
        if self.tone.is_identity:
            return np.full(self.stored.shape, step)
        above, below = (self.tone.light(self.stored + way * step / 2, self.full_scale_dn) for way in (1, -1))
        return np.asarray(above - below, float)

    def light_of_step_dn(self, light: NDArray[np.floating], step_dn: float) -> Array:
        """How much more light than this grey values are that are a step larger."""
        if self.tone.is_identity:
            return np.full(light.shape, step_dn)
        code = self.tone.code(light, self.full_scale_dn)
        above, here = (self.tone.light(code + more, self.full_scale_dn) for more in (step_dn, 0.0))
        return np.asarray(above - here, float)

    def stored_contrast_dn(self, ground: float, contrast: float) -> float:
        """The difference of grey values that a contrast in light is, on ground of such light. Of a line finer than a
        pixel it may be more than the scanner's range: no pixel shows it whole."""
        if self.tone.is_identity:
            return contrast
        ends = np.clip([ground, ground + contrast], 0.0, self.full_scale_dn)
        codes, within = self.tone.code(ends, self.full_scale_dn), ends[1] - ends[0]
        return float((codes[1] - codes[0]) * contrast / within) if within else contrast


@dataclass(frozen=True, eq=False)
class ScanWindow:
    """grey (height, width), in light; its top-left pixel's centre is at origin_px (col, row) of the scan; valid: which
    pixels are true ones, None if all; clipped: which are at an end of the scanner's range, as `clipped_sides` gives it,
    None if none. is_lossy: whether it was compressed with loss. coded: how the light was stored, None where grey is
    what is stored."""

    grey: NDArray[np.floating]
    origin_px: tuple[float, float] = (0.0, 0.0)
    valid: Mask | None = None
    clipped: Sides | None = None
    is_lossy: bool = False
    coded: Coding | None = None

    @property
    def usable(self) -> Mask:
        """(height, width): which pixels tell a grey value."""
        known = np.asarray(np.isfinite(self.grey))
        return known if self.valid is None else known & self.valid

    @property
    def coding(self) -> Coding:
        return self.coded or Coding(self.grey)

    @property
    def sides(self) -> Sides:
        return np.zeros(self.grey.shape, np.int8) if self.clipped is None else self.clipped

    def exclude(self, lost: Mask) -> "ScanWindow":
        """The same, some of its pixels (height, width) no longer being true ones."""
        return replace(self, valid=self.usable & ~lost)

    def part(self, rows: slice, cols: slice) -> "ScanWindow":
        """Some of its rows and columns."""
        coding, (col0, row0) = self.coding, self.origin_px
        stored = None if coding.stored is None else coding.stored[rows, cols]
        return ScanWindow(
            self.grey[rows, cols],
            (col0 + cols.start, row0 + rows.start),
            self.usable[rows, cols],
            self.sides[rows, cols],
            self.is_lossy,
            replace(coding, stored=stored),
        )


def read_window(scan: Scan, place_px: tuple[int, int, int, int], weights: Sequence[float] | None = None) -> ScanWindow:
    """The window at col0, row0, width, height of the scan, in light. weights: what each channel counts, as for
    `Scan.window`."""
    col0, row0, _, _ = place_px
    grey = scan.light(*place_px, weights).astype(float)
    stored = grey if scan.tone.is_identity else scan.window(*place_px, weights) if scan.channels == 1 else None
    coding = Coding(stored, scan.tone, scan.full_scale_dn)
    sides = clipped_sides(scan, *place_px, weights)
    return ScanWindow(grey, (col0, row0), scan.inside(*place_px), sides, scan.is_lossy, coding)


def pixels_beyond_edge(window: NDArray[np.floating], mark: Mark, pixel_from_mark: Array) -> Mask:
    """Which pixels of a window (height, width), in which the mark stands about as pixel_from_mark (2, 3) says, lie
    beyond an edge that is far stronger than the mark is, or in its blur: that of the frame, or of the pad on which the
    mark stands. None where there is no such edge, or the mark itself lies beyond it."""
    drawn = picture(mark, pixel_from_mark, window.shape[1], window.shape[0], 1.0)
    away_px = cv2.distanceTransform((drawn <= _DRAWN).astype(np.uint8), cv2.DIST_L2, 5)
    near, shown = away_px <= _BESIDE_PX, drawn > _SHOWN * drawn.max()
    lighter = window > threshold_otsu(window[near])
    here = lighter if lighter[near & (away_px > 0)].mean() > 0.5 else ~lighter
    own, beyond = window[near & here], window[near & ~here]
    if not len(beyond) or here[shown].mean() <= 0.5 or abs(own.mean() - beyond.mean()) < _FAR * own.std():
        return np.zeros(window.shape, dtype=bool)
    return np.asarray(cv2.distanceTransform(here.astype(np.uint8), cv2.DIST_L2, 5) <= _EDGE_PX)
