"""Where the edges about a crossing point: the place that the lines along the grey values' gradients miss least.

Förstner and Gülch (1987), A fast operator for detection and precise location of distinct points, corners and centres
of circular features. A lens with coma blurs edges to one side, and then a crossing has no one place: match and junction
differ by tenths of a pixel, growing towards the picture's corners. There the junction is the place that
`cv2.cornerSubPix`, and with it most published calibrations, measure."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GRADIENT_PX = 1.0  # the Gaussian under the derivatives: pixel noise has gone, the edges are still apart
_REACH_SIGMAS = 4.0  # of that Gaussian's filter
_MAX_ITERATIONS = 30
_TOLERANCE_PX = 1e-4  # of the last step
_WORST_CONDITION = 1e6  # of the normal matrix: beyond it the gradients have one direction only


def junction(grey: Array, start_px: Array, window_px: float, area: Array) -> Array:
    """The junction (2,) as col, row near start_px in grey values (height, width).

    window_px: the standard deviation of the Gaussian window about the junction; area (height, width): 0 where a
    gradient has no part. Not a number where the gradients have one direction only.
    """
    along_x, along_y = _derivative(grey, 0), _derivative(grey, 1)
    row, col = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(float)
    center = np.array(start_px, float)
    for _ in range(_MAX_ITERATIONS):
        dx, dy = col - center[0], row - center[1]
        weights = area * np.exp(-(dx**2 + dy**2) / (2 * window_px**2))
        normal = _normal(along_x, along_y, weights)
        if np.linalg.cond(normal) > _WORST_CONDITION:
            return np.full(2, np.nan)
        distance = along_x * dx + along_y * dy
        step = np.linalg.solve(normal, [(weights * along * distance).sum() for along in (along_x, along_y)])
        center += step
        if np.hypot(*step) < _TOLERANCE_PX:
            break
    return center


def _normal(along_x: Array, along_y: Array, weights: Array) -> Array:
    mixed = (weights * along_x * along_y).sum()
    return np.array([[(weights * along_x**2).sum(), mixed], [mixed, (weights * along_y**2).sum()]])


def _derivative(image: Array, axis: int) -> Array:
    """The derivative of the image smoothed by a Gaussian, along columns (0) or rows (1)."""
    reach = int(np.ceil(_REACH_SIGMAS * _GRADIENT_PX))
    place = np.arange(-reach, reach + 1.0)
    smooth = np.exp(-(place**2) / (2 * _GRADIENT_PX**2))
    smooth /= smooth.sum()
    slope = place * smooth / (place**2 * smooth).sum()
    along, down = (slope, smooth) if axis == 0 else (smooth, slope)
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, along, down, borderType=cv2.BORDER_REPLICATE))
