"""What the edges of the exposed frame beside its marks say of the tone curve.

Tips of wedges, wings and notches are short, and their own edges tell the curve badly. The frame's edge beside them is
a long one, between the same dark and the same light.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from measure.geometry import linear_scale
from measure.marks.rendering import extent_px
from measure.marks.shapes import FiducialLayout, FrameCorner, LayoutMark
from measure.matching.frame_edge import Course, edge_along, pool_edge_tones
from measure.scans.scan import Scan
from measure.tone.curve import ToneInformation

Array = NDArray[np.float64]

_NEAR_MM = 3.0  # from the frame's edge: a mark nearer has it beside itself, in what is read of the scan anyway
_BESIDE_MM, _LONGEST_MM = 0.5, 6.0  # from a mark, to where an edge begins and ends
_PIECES = 8  # of edges that are asked, at most
_SEARCH_MM = 0.3  # about where the frame's size puts its edge
_SHARE_PX, _FEWEST = 8.0, 5  # of an edge that a profile is of, and how many an edge has at least


def edge_tone_information(
    scan: Scan, layout: FiducialLayout, pixel_from_camera: Array, weights: Sequence[float] | None
) -> list[ToneInformation]:
    """None or one, of all pieces of edge that are seen as straight lines; pixel_from_camera (2, 3): of the frame."""
    linear = pixel_from_camera[:, :2]
    px_per_mm = linear_scale(linear)
    tones = []
    pieces = list(_pieces(layout))
    for start_mm, along_mm, inwards_mm, length_mm in pieces[:: max(len(pieces) // _PIECES, 1)]:
        count = int(length_mm * px_per_mm / _SHARE_PX)
        if count < _FEWEST:
            continue
        along, across = linear @ along_mm, linear @ inwards_mm
        across = across - along * (across @ along) / (along @ along)
        course = Course(
            scan,
            linear @ start_mm + pixel_from_camera[:, 2],
            along / np.hypot(*along),
            across / np.hypot(*across),
            weights,
        )
        edge = edge_along(course, (0.0, length_mm * px_per_mm), _SEARCH_MM * px_per_mm, 0, count)
        if edge is not None and edge.tone is not None:
            tones.append(edge.tone)
    return [pool_edge_tones(tones, scan.tone)] if tones else []


def _pieces(layout: FiducialLayout) -> Iterator[tuple[Array, Array, Array, float]]:
    """Of the frame's edge on both sides of each mark near it, in mm: where it begins, which way it runs, which way the
    frame's inside lies, and its length."""
    half = np.array(layout.frame_mm) / 2
    for mark in layout.marks:
        at = np.array(mark.xy_mm)
        side = int(np.argmin(half - np.abs(at)))
        if half[side] - abs(at[side]) > _NEAR_MM or isinstance(mark.mark, FrameCorner):
            continue
        inwards, run = np.zeros(2), np.zeros(2)
        inwards[side], run[1 - side] = -np.sign(at[side]), 1.0
        on_edge = np.where(np.arange(2) == side, np.sign(at) * half, at)
        reach = _reach_mm(mark, 1 - side) + _BESIDE_MM
        for way in (1.0, -1.0):
            room = half[1 - side] - way * at[1 - side]  # to the corner
            neighbours = [
                way * (np.array(other.xy_mm) - at)[1 - side] for other in _same_side_marks(layout, mark, side)
            ]
            room = min([room, *(gap - reach for gap in neighbours if gap > 0)]) - _BESIDE_MM
            yield on_edge + way * reach * run, way * run, inwards, min(room, _LONGEST_MM) - reach


def _same_side_marks(layout: FiducialLayout, mark: LayoutMark, side: int) -> list[LayoutMark]:
    """The other marks near the same edge."""
    half, sign = layout.frame_mm[side] / 2, np.sign(mark.xy_mm[side])
    return [one for one in layout.marks if one is not mark and half - sign * one.xy_mm[side] < 2 * _NEAR_MM]


def _reach_mm(mark: LayoutMark, axis: int) -> float:
    """How far a mark reaches from its place along an axis."""
    least, greatest = extent_px(mark.mark, np.eye(2, 3))
    return float(max(-least[axis], greatest[axis]))
