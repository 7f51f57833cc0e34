"""Window of a scan as input of a fit: linear light, position, and the state of its pixels."""

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

FAINT = 1 / 500  # fraction of full scale: a smaller contrast may be rounding
_BESIDE_PX = 6.0  # px around the drawing: the mark's own background
_FAR = 5.0  # standard deviations of the mark's side, mark included: a larger step is not the mark's background
_EDGE_PX = 4.0  # px reached by an edge's blur: at 1.4 px blur, 1/500 of the step is left at this distance
_DRAWN, _SHOWN = 0.05, 0.5  # fractions of the mark's contrast: the whole mark, and its certain pixels


@dataclass(frozen=True, eq=False)
class Coding:
    """Relation of a window's light to the stored grey values.

    stored: (height, width) grey values, None where the light is a mixture of channels; tone: tone curve of the scan;
    full_scale_dn: its largest grey value.
    """

    stored: NDArray[np.floating] | None
    tone: Tone = LINEAR
    full_scale_dn: float = 65535.0

    def steps_dn(self, used: Mask) -> Array | None:
        """(height, width) quantisation steps in light. None where the used values are unknown or not multiples of one
        step."""
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
        """Change of the light for a change of step_dn in the stored grey value."""
        if self.tone.is_identity:
            return np.full(light.shape, step_dn)
        code = self.tone.code(light, self.full_scale_dn)
        above, here = (self.tone.light(code + more, self.full_scale_dn) for more in (step_dn, 0.0))
        return np.asarray(above - here, float)

    def stored_contrast_dn(self, ground: float, contrast: float) -> float:
        """Convert a contrast in light over a background to a difference of stored grey values. For lines thinner than a
        pixel it may exceed the scanner's range, since no pixel shows the full contrast."""
        if self.tone.is_identity:
            return contrast
        ends = np.clip([ground, ground + contrast], 0.0, self.full_scale_dn)
        codes, within = self.tone.code(ends, self.full_scale_dn), ends[1] - ends[0]
        return float((codes[1] - codes[0]) * contrast / within) if within else contrast


@dataclass(frozen=True, eq=False)
class ScanWindow:
    """Window of a scan in light.

    Attributes
    ----------
    grey : (height, width) light.
    origin_px : (col, row) of the centre of its top-left pixel in the scan.
    valid : (height, width) mask of the valid pixels; None: all.
    clipped : (height, width) pixels at an end of the scanner's range, from `clipped_sides`; None: none.
    is_lossy : whether the scan was compressed with loss.
    coded : relation of light to stored grey values; None: grey holds the stored values.
    """

    grey: NDArray[np.floating]
    origin_px: tuple[float, float] = (0.0, 0.0)
    valid: Mask | None = None
    clipped: Sides | None = None
    is_lossy: bool = False
    coded: Coding | None = None

    @property
    def usable(self) -> Mask:
        """(height, width) mask of the valid, finite pixels."""
        known = np.asarray(np.isfinite(self.grey))
        return known if self.valid is None else known & self.valid

    @property
    def coding(self) -> Coding:
        return self.coded or Coding(self.grey)

    @property
    def sides(self) -> Sides:
        return np.zeros(self.grey.shape, np.int8) if self.clipped is None else self.clipped

    def exclude(self, lost: Mask) -> "ScanWindow":
        """Copy of the window with the pixels of a mask (height, width) marked as invalid."""
        return replace(self, valid=self.usable & ~lost)

    def part(self, rows: slice, cols: slice) -> "ScanWindow":
        """Crop to the given rows and columns."""
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
    """Read the window at col0, row0, width, height of the scan, in light. weights: of the channels, as in
    `Scan.window`."""
    col0, row0, _, _ = place_px
    grey = scan.light(*place_px, weights).astype(float)
    stored = grey if scan.tone.is_identity else scan.window(*place_px, weights) if scan.channels == 1 else None
    coding = Coding(stored, scan.tone, scan.full_scale_dn)
    sides = clipped_sides(scan, *place_px, weights)
    return ScanWindow(grey, (col0, row0), scan.inside(*place_px), sides, scan.is_lossy, coding)


def pixels_beyond_edge(window: NDArray[np.floating], mark: Mark, pixel_from_mark: Array) -> Mask:
    """Mask the pixels of a window beyond an edge that is far stronger than the mark, or within the edge's blur.

    Such an edge is that of the frame, or of the pad on which the mark stands.

    Parameters
    ----------
    window : (height, width)
    pixel_from_mark : (2, 3)
        Approximate place of the mark in the window.

    Returns
    -------
    (height, width) mask, all False where there is no such edge or the mark itself lies beyond it.
    """
    drawn = picture(mark, pixel_from_mark, window.shape[1], window.shape[0], 1.0)
    away_px = cv2.distanceTransform((drawn <= _DRAWN).astype(np.uint8), cv2.DIST_L2, 5)
    near, shown = away_px <= _BESIDE_PX, drawn > _SHOWN * drawn.max()
    lighter = window > threshold_otsu(window[near])
    here = lighter if lighter[near & (away_px > 0)].mean() > 0.5 else ~lighter
    own, beyond = window[near & here], window[near & ~here]
    if not len(beyond) or here[shown].mean() <= 0.5 or abs(own.mean() - beyond.mean()) < _FAR * own.std():
        return np.zeros(window.shape, dtype=bool)
    return np.asarray(cv2.distanceTransform(here.astype(np.uint8), cv2.DIST_L2, 5) <= _EDGE_PX)
