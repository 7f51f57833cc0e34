"""The exposed frame in a scan: film that light fell on within four straight edges, and none beyond them.

The camera's gate made it, and the marks lie about its middle. So it tells where they are, however faint they are
themselves: not so well as to measure anything, but few places are left in which chance could feign them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import robust_scale
from measure.scans.scan import Scan
from measure.search.candidates import FAINT
from measure.search.correlation import Map

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_Edges = tuple[Mask, Mask, Mask, Mask]  # left, right, top, bottom ones of a frame, by the pixel

_SIDE_PX = 240  # of the reduced frame: a pixel is a millimetre of an aerial camera's
_STEEP = 5.0  # times what the scan's grey values change by from pixel to pixel, a standard deviation
_LEAST_SHARE = 0.5  # of every side that is an edge: with less it may be another line
_AS_GOOD = 0.95  # of the best share: places about it that tell as much


@dataclass(frozen=True, eq=False)
class ExposedFrame:
    """center_px, size_px: (2,) in the scan, along the frame's sides. turn_rad: from the scan's columns toward its rows.
    share: of its least visible side that is an edge."""

    center_px: Array
    size_px: Array
    turn_rad: float
    share: float

    @property
    def rotation(self) -> Array:
        """(2, 2) from along the frame's sides to columns and rows."""
        return _rotation(self.turn_rad)

    def free_of_edges(self, places_px: Array, least_px: Array, greatest_px: Array) -> Mask:
        """(...) whether what reaches from least_px to greatest_px (2,), along the sides, about places (..., 2) of the
        scan lies beside the edges."""
        along = (places_px - self.center_px) @ self.rotation
        first, last, half = along + least_px, along + greatest_px, self.size_px / 2
        within = ((first > -half) & (last < half)).all(axis=-1)
        beyond = ((last < -half) | (first > half)).any(axis=-1)
        return np.asarray(within | beyond)


def exposed_frame(
    scan: Scan, size_px: tuple[float, float], tolerance: float, rotation_rad: float
) -> ExposedFrame | None:
    """The frame of a width and height that are right by a tolerance (a share of them), turned by no more than
    rotation_rad; None where no four edges make one inside of the scan. It may be lighter than what is about it or
    darker."""
    reduction = max(1, int(min(size_px) / _SIDE_PX))
    grey = scan.reduced(reduction)
    width, height = (round(side / reduction) for side in size_px)
    reach = max(1, round(tolerance / 2 * max(width, height)))
    if width + 2 * reach >= grey.shape[1] or height + 2 * reach >= grey.shape[0]:
        return None
    least_dn, step = FAINT * scan.full_scale_dn, 1 / max(width, height)
    found: list[tuple[float, float, tuple[int, int], _Edges]] = []
    for turn in np.arange(-rotation_rad, rotation_rad + step, step).tolist():
        for edges in _edges(_turned(grey, turn), least_dn):
            shares = _shares(edges, (width, height), reach)
            best = float(shares.max())
            if best >= _LEAST_SHARE:
                row, col = (round(float(each.mean())) for each in np.nonzero(shares >= _AS_GOOD * best))
                found.append((best, turn, (col, row), edges))
    if not found:
        return None
    best = max(share for share, *_ in found)
    as_good = [each for each in found if each[0] >= _AS_GOOD * best]
    share, turn, first, edges = as_good[len(as_good) // 2]
    least, greatest = _sides(edges, first, (width, height), reach)
    middle = _middle(grey)
    center = middle + _rotation(turn) @ ((least + greatest) / 2 - middle)
    return ExposedFrame(center * reduction + (reduction - 1) / 2, (greatest - least) * reduction, turn, share)


def _rotation(turn_rad: float) -> Array:
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _middle(image: Map) -> Array:
    return (np.array(image.shape[::-1]) - 1) / 2


def _turned(grey: Map, turn_rad: float) -> Map:
    """The picture such that a frame turned by so much is upright in it."""
    linear, middle = _rotation(turn_rad), _middle(grey)
    back = np.column_stack([linear, middle - linear @ middle])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpAffine(grey, back, grey.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(turned, np.float32)


def _edges(upright: Map, least_dn: float) -> Iterator[_Edges]:
    """Of a frame lighter than what is about it, and of a darker one."""
    across, down = (np.asarray(cv2.Sobel(upright, cv2.CV_32F, *order, ksize=3)) / 8 for order in ((1, 0), (0, 1)))
    steep = _STEEP * max(robust_scale(np.concatenate([across.ravel(), down.ravel()])), least_dn)
    for sign in (1, -1):
        yield sign * across > steep, -sign * across > steep, sign * down > steep, -sign * down > steep


def _shares(edges: _Edges, size: tuple[int, int], reach: int) -> Array:
    """(rows, columns) by a frame's first pixel: the share of its least visible side that has an edge within reach."""
    (width, height), (rows, cols) = size, edges[0].shape
    left, right, top, bottom = (
        _along(edge, reach, *((1, height) if number < 2 else (width, 1))) for number, edge in enumerate(edges)
    )
    own = np.s_[: rows - height, : cols - width]
    sides = np.stack([left[own], right[own[0], width:], top[own], bottom[height:, own[1]]])
    return np.asarray(sides.min(axis=0))


def _along(edge: Mask, reach: int, width: int, height: int) -> Array:
    """By the first pixel of a side, one pixel wide or high: the share of it that has an edge within reach across."""
    wide = (1, 2 * reach + 1) if width == 1 else (2 * reach + 1, 1)
    near = cv2.dilate(edge.astype(np.uint8), np.ones(wide, np.uint8)).astype(np.float32)
    sums = cv2.boxFilter(near, cv2.CV_32F, (width, height), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(sums, dtype=float)


def _sides(edges: _Edges, first: tuple[int, int], size: tuple[int, int], reach: int) -> tuple[Array, Array]:
    """Column and row (2,) of the left and upper side and of the others, each where most of it is an edge."""
    (col, row), (width, height) = first, size
    rows, cols = slice(row, row + height), slice(col, col + width)

    def place(edge: Mask, expected: int) -> float:
        """edge: (across, along)."""
        begin = max(expected - reach, 0)
        share = edge[begin : expected + reach + 1].mean(axis=1)
        return begin + float(np.flatnonzero(share >= _AS_GOOD * share.max()).mean())

    left, right, top, bottom = edges
    least = place(left[rows].T, col), place(top[:, cols], row)
    greatest = place(right[rows].T, col + width), place(bottom[:, cols], row + height)
    return np.array(least), np.array(greatest)
