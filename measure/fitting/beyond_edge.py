"""What lies beyond a strong edge beside a mark: the frame's edge on overexposed film changes grey values far more than
the mark does, and a fit that tries to explain it too is drawn to it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.marks.rendering import picture
from measure.marks.shapes import Mark

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEVELS = 256  # of grey between which the edge's two sides are told apart
_BESIDE_PX = 6.0  # about the drawing: the mark's own ground
_FAR = 5.0  # standard deviations of the mark's side, the mark being part of it: so far off is no ground of this mark
_EDGE_PX = 4.0  # an edge's blur: of 1.4 px it leaves a five hundredth of the edge so far off
_DRAWN = 0.05  # of the mark's contrast


def beyond_edge(window: NDArray[np.floating], mark: Mark, pixel_from_mark: Array, polarity: int) -> Mask:
    """Which pixels of a window (height, width), in which the mark stands about as pixel_from_mark (2, 3) says, lie
    beyond an edge that is far stronger than the mark is, or in its blur. Only what changes the ground the other way
    than the mark does can be told from it: none elsewhere."""
    grey = polarity * window
    split = _between(grey)
    drawn = picture(mark, pixel_from_mark, window.shape[1], window.shape[0], 1.0) > _DRAWN
    away_px = cv2.distanceTransform((~drawn).astype(np.uint8), cv2.DIST_L2, 5)
    here, beyond = grey > split, grey <= split
    ground = (away_px > 0) & (away_px <= _BESIDE_PX)
    stands_here = beyond.any() and here[ground].mean() > 0.5
    if not stands_here or grey[here].mean() - grey[beyond].mean() < _FAR * grey[here].std():
        return np.zeros(window.shape, dtype=bool)
    return np.asarray(cv2.distanceTransform(here.astype(np.uint8), cv2.DIST_L2, 5) <= _EDGE_PX)


def _between(grey: NDArray[np.floating]) -> float:
    """The grey value that parts the pixels into two kinds most unlike one another (Otsu, 1979)."""
    low, high = float(grey.min()), float(grey.max())
    level = np.asarray((grey - low) / max(high - low, 1e-12) * (_LEVELS - 1), np.uint8)
    return low + (cv2.threshold(level, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[0] + 1) / (_LEVELS - 1) * (high - low)
