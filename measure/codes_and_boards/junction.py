"""Where the edges about a crossing point: the place that the lines along the grey values' gradients miss least.

Förstner and Gülch (1987), A fast operator for detection and precise location of distinct points, corners and centres
of circular features. A lens with coma blurs edges to one side, and then a crossing has no one place: match and junction
differ by tenths of a pixel, growing towards the picture's corners. There the junction is the place that
`cv2.cornerSubPix`, and with it most published calibrations, measure."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRADIENT_PX = 1.0  # the Gaussian under the derivatives: pixel noise has gone, the edges are still apart
REACH_SIGMAS = 4.0
MAX_ITERATIONS = 30
TOLERANCE_PX = 1e-4


def junction(grey: Array, start_px: Array, window_px: float, area: Array) -> tuple[Array, Array]:
    """The junction (2,) as col, row near start_px in grey values (height, width), and how it follows from these:
    its derivatives (2, height, width).

    window_px: the standard deviation of the Gaussian window about the junction; area (height, width): 0 where a
    gradient has no part. Not a number where the gradients have one direction only.
    """
    along_x, along_y = _derivative(grey, 0), _derivative(grey, 1)
    row, col = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(float)
    center = np.array(start_px, float)
    for _ in range(MAX_ITERATIONS):
        dx, dy = col - center[0], row - center[1]
        weights = area * np.exp(-(dx**2 + dy**2) / (2 * window_px**2))
        normal = _normal(along_x, along_y, weights)
        if np.linalg.cond(normal) > 1e6:
            return np.full(2, np.nan), np.zeros((2, *grey.shape))
        distance = along_x * dx + along_y * dy
        step = np.linalg.solve(normal, [(weights * along * distance).sum() for along in (along_x, along_y)])
        center += step
        if np.hypot(*step) < TOLERANCE_PX:
            break
    # The window moves with the junction: what noise alone adds to the normal matrix is lost again by that.
    windowed = np.array(
        [[(weights * along * distance * place).sum() for place in (dx, dy)] for along in (along_x, along_y)]
    )
    by_sums = np.linalg.inv(normal - windowed / window_px**2)
    return center, np.tensordot(by_sums, _by_grey(along_x, along_y, dx, dy, weights), axes=1)


def _normal(along_x: Array, along_y: Array, weights: Array) -> Array:
    mixed = (weights * along_x * along_y).sum()
    return np.array([[(weights * along_x**2).sum(), mixed], [mixed, (weights * along_y**2).sum()]])


def _by_grey(along_x: Array, along_y: Array, dx: Array, dy: Array, weights: Array) -> Array:
    """(2, height, width) derivatives of the sums of weights * gradient * distance by the grey values."""
    distance = along_x * dx + along_y * dy
    by_gradients = (
        (weights * (distance + along_x * dx), weights * along_x * dy),
        (weights * along_y * dx, weights * (distance + along_y * dy)),
    )
    # A derivative's filter is odd: its transpose is its negative.
    return np.stack([-_derivative(by_x, 0) - _derivative(by_y, 1) for by_x, by_y in by_gradients])


def _derivative(image: Array, axis: int) -> Array:
    """The derivative of the image smoothed by a Gaussian, along columns (0) or rows (1)."""
    reach = int(np.ceil(REACH_SIGMAS * GRADIENT_PX))
    place = np.arange(-reach, reach + 1.0)
    smooth = np.exp(-(place**2) / (2 * GRADIENT_PX**2))
    smooth /= smooth.sum()
    slope = place * smooth / (place**2 * smooth).sum()
    along, down = (slope, smooth) if axis == 0 else (smooth, slope)
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, along, down, borderType=cv2.BORDER_REPLICATE))
