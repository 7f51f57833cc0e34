"""Corners of the exposed frame: the edge of the frame along both sides, each a straight line, and where they meet.

What is rounded at the corner is left out.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from measure.covariance import Covariance
from measure.detection.prediction import MarkPrediction
from measure.marks.shapes import FrameCorner
from measure.matching.match import Match
from measure.reason import NO_REASON, Code, Reason
from measure.scans.scan import Scan
from measure.special_marks.frame_edge import Course, Edge, edge_along, said_by_edges
from measure.tone.curve import Tone
from measure.tone.estimate import MarkTone

Array = NDArray[np.float64]

_UNSEEN = Reason("an edge of the frame is not to be seen there as one line", Code.NOT_FOUND)
_ROUNDED = 0.1  # of the reach: left out at every corner, for few are sharp


def corner_of_edges(scan: Scan, mark: FrameCorner, expected: MarkPrediction) -> Match:
    """The mark, within the search radius of its predicted place, its frame being lighter than its border or darker as
    the polarity says. Not converged, with a reason, where either edge is not to be seen."""
    inward = expected.linear * np.array(mark.toward)  # columns: along x', y' into the frame, px per mm
    per_mm = np.hypot(*inward)
    unit = inward / per_mm
    edges = []
    for side in (0, 1):
        along, across = unit[:, side], unit[:, 1 - side]
        reach = mark.reach_mm * per_mm[side]
        first = max(mark.radius_mm * per_mm[side], _ROUNDED * reach)
        course = Course(scan, expected.center_px, along, across, expected.weights)
        edge = edge_along(course, (first, reach), expected.search_px, expected.polarity)
        if edge is None:
            return _missed(expected.pixel_from_mark, _UNSEEN)
        edges.append(edge)
    return _met(edges, unit, expected.pixel_from_mark, scan.tone)


def _met(edges: Sequence[Edge], unit: Array, pixel_from_mark: Array, tone: Tone) -> Match:
    """The corner: along the first edge x, y = a + b x, and along the second x = c + d y."""
    first, second = edges
    a, b, c, d = first.offset, first.slope, second.offset, second.slope
    x, y = (c + d * a) / (1 - b * d), (a + b * c) / (1 - b * d)
    scale = 1 / (1 - b * d)
    by_first = scale * np.array([[d, d * x], [1.0, x]])  # of (x, y) by a, b
    by_second = scale * np.array([[1.0, y], [b, b * y]])
    covariance = by_first @ first.covariance @ by_first.T + by_second @ second.covariance @ by_second.T
    center = pixel_from_mark[:, 2] + unit @ (x, y)
    noise = max(edge.noise_dn for edge in edges)
    contrast = min((edge.contrast_dn for edge in edges), key=abs)
    return Match(
        converged=True,
        reason=NO_REASON,
        center_px=center,
        place_covariance=Covariance.of_noise(unit @ covariance @ unit.T),
        pixel_from_mark=np.column_stack([pixel_from_mark[:, :2], center]),
        contrast_dn=contrast,
        stored_contrast_dn=contrast,
        noise_dn=noise,
        blur_px=max(edge.blur_px for edge in edges),
        damaged_fraction=1.0 - min(edge.share for edge in edges),
        lost_fraction=0.0,
        redundancy=sum(edge.count for edge in edges) - 4,
        neighbour_correlation=0.0,
        covariance_is_white=False,
        likeness=min(edge.likeness for edge in edges),
        significance=abs(contrast) / max(noise, 1e-12) * float(np.sqrt(min(edge.count for edge in edges))),
        tone=_told(first, second, unit @ by_first, unit @ by_second, tone),
    )


def _told(first: Edge, second: Edge, by_first: Array, by_second: Array, tone: Tone) -> MarkTone | None:
    """by_first, by_second (2, 2): derivatives of the corner's column and row by an edge's offset and slope."""
    if first.tone is None or second.tone is None:
        return None
    return MarkTone(
        said_by_edges([first.tone, second.tone], tone),
        by_first @ first.tone.on_line + by_second @ second.tone.on_line,
        min(first.tone.least, second.tone.least),
        max(first.tone.greatest, second.tone.greatest),
    )


def _missed(pixel_from_mark: Array, reason: Reason) -> Match:
    return Match(
        converged=False,
        reason=reason,
        center_px=pixel_from_mark[:, 2],
        place_covariance=Covariance.of_noise(np.full((2, 2), np.inf)),
        pixel_from_mark=pixel_from_mark,
        contrast_dn=0.0,
        stored_contrast_dn=0.0,
        noise_dn=0.0,
        blur_px=0.0,
        damaged_fraction=1.0,
        lost_fraction=1.0,
        redundancy=0,
        neighbour_correlation=0.0,
        covariance_is_white=True,
        likeness=0.0,
        significance=0.0,
    )
