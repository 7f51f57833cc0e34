"""Peaks of a correlation map: highest local maxima, and maxima around given places."""

import cv2
import numpy as np

from measure.array_types import Array
from measure.detection.correlation import Map


def local_maxima(response: Map, count: int, least: float, apart_px: int = 3) -> tuple[Array, Array]:
    """Find the highest local maxima.

    Parameters
    ----------
    response : (rows, columns).
    count, least : largest number, and threshold of the height.
    apart_px : smallest distance between peaks.

    Returns
    -------
    (n, 2) column and row, and (n,) heights, the highest first.
    """
    square = np.ones((2 * apart_px + 1, 2 * apart_px + 1), np.uint8)
    highest = cv2.dilate(response, square, borderType=cv2.BORDER_REPLICATE)
    is_top = (response == highest) & (response > least)
    rows, cols = np.nonzero(is_top)
    plateaus = cv2.connectedComponents(is_top.astype(np.uint8))[1][rows, cols]
    first = np.unique(plateaus, return_index=True)[1]  # one of equal neighbours
    rows, cols = rows[first], cols[first]
    heights = response[rows, cols].astype(float)
    order = np.argsort(-heights, kind="stable")[:count]
    return np.column_stack([cols, rows]).astype(float)[order], heights[order]


def highest_about(response: Map, places: Array, radius_px: float) -> tuple[Array, Array]:
    """Find the maximum within a square around each of places (n, 2), refined by parabolas.

    Returns
    -------
    (n, 2) column and row, and (n,) heights; 0 for a place outside the map.
    """
    size = np.array(response.shape[::-1])
    low = np.clip(np.floor(places - radius_px).astype(int), 0, None)
    high = np.clip(np.ceil(places + radius_px).astype(int) + 1, None, size)
    within = (low < high).all(axis=1)
    tops, heights = places.astype(float), np.zeros(len(places))
    if not within.any():
        return tops, heights
    low, high = low[within], high[within]
    col, row = (low[:, axis, None] + np.arange((high - low)[:, axis].max()) for axis in (0, 1))
    part = response[np.minimum(row, size[1] - 1)[:, :, None], np.minimum(col, size[0] - 1)[:, None, :]]
    part = np.where((row < high[:, 1, None])[:, :, None] & (col < high[:, 0, None])[:, None, :], part, -np.inf)
    best_row, best_col = np.divmod(part.reshape(len(part), -1).argmax(axis=1), part.shape[2])
    top = low + np.column_stack([best_col, best_row])
    heights[within] = response[top[:, 1], top[:, 0]]
    inner = ((top > 0) & (top < size - 1)).all(axis=1)
    col, row = top[inner].T
    offset = np.zeros(top.shape)
    offset[inner, 0] = _vertex(response[row, col - 1], response[row, col], response[row, col + 1])
    offset[inner, 1] = _vertex(response[row - 1, col], response[row, col], response[row + 1, col])
    tops[within] = top + offset
    return tops, heights


def _vertex(before: Map, middle: Map, after: Map) -> Array:
    """Vertices, -0.5 to 0.5, of parabolas through three values each, the middle one being the highest."""
    bend = before - 2 * middle + after
    top = np.divide(before - after, 2 * bend, out=np.zeros(len(bend)), where=bend < 0)
    return np.asarray(np.clip(top, -0.5, 0.5))
