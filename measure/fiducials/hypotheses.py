"""Hypotheses of the search: pixel pitches, and a frame that fills the middle of its scan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan

_STRETCHES = (-0.015, 0.015, -0.03, 0.03)  # an office scanner's carriage may run by per cents too fast
_SLIGHT = (-0.005, 0.005, -0.01, 0.01)  # where marks are so faint that they are looked for near by only
_SCALE_STEPS = (1.1, 1.0, 0.91, 0.83, 0.75)  # of the largest scale at which the frame fits into the scan
_STEP_TOLERANCE = 0.06  # so that each step reaches the next
Array = NDArray[np.float64]

_LARGE_PX = 1 << 24  # a smaller scan is read whole in no time
_REACH = 0.025  # of the frame's side: laid by hand it is off by some millimetres and a degree
_LARGEST_SHARE = 0.25  # of the scan: where windows hold more, the whole of it tells more
_BEYOND_MM = 3.0  # the scan's edge: a frame may be cut off there by less than its rim
_FINE = 0.05  # of how near steps are alike
_ALIKE = 0.5  # of the marks: a lattice of which more fall on others one step aside could be one step off


@dataclass(frozen=True)
class PitchHypothesis:
    """mm: of a pixel, across and down. tolerance: by what share both together may be wrong. drawn_mm: what the marks
    are drawn with where they are looked for; for pixels longer one way that of pixels alike, which hardly differ."""

    mm: tuple[float, float]
    tolerance: float
    drawn_mm: tuple[float, float]


Hypotheses = Sequence[PitchHypothesis]


def pitch_hypotheses(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Hypotheses]:
    """The hypotheses, the likelier ones first: those of a later group are for a scan in which the earlier ones fail.

    pitch_um: as given; None where it is not known: then the frame's size is all there is, as it is where the frame
    would be far from filling the scan at that pitch.
    """
    long_mm, short_mm = max(layout.frame_mm), min(layout.frame_mm)
    long_px, short_px = max(scan.width_px, scan.height_px), min(scan.width_px, scan.height_px)
    largest = min(long_px / long_mm, short_px / short_mm)
    filling = [
        PitchHypothesis(pair, _STEP_TOLERANCE, pair) for s in _SCALE_STEPS for pair in [(1 / (s * largest),) * 2]
    ]
    filling_longer = [longer(each, stretch) for each in filling for stretch in _STRETCHES]
    if pitch_um is None:
        return [filling, filling_longer]
    pair = (pitch_um[0] / 1000, pitch_um[1] / 1000)
    given = PitchHypothesis(pair, options.scale_tolerance, pair)
    as_given: list[Hypotheses] = [[given], [longer(given, stretch) for stretch in _STRETCHES]]
    if options.pitch_is_right or options.part:
        return as_given
    fills = any(abs(pair[0] / each.mm[0] - 1) < _STEP_TOLERANCE for each in filling)
    return [*as_given, filling] if fills else [*as_given, filling, filling_longer]


def slightly_longer(given: PitchHypothesis, tolerance: float) -> tuple[Hypotheses, Hypotheses]:
    """A given pitch as it is, and with pixels slightly longer one way, each right by a tolerance."""
    near = replace(given, tolerance=tolerance)
    return [near], [longer(near, stretch) for stretch in _SLIGHT]


def longer(given: PitchHypothesis, stretch: float) -> PitchHypothesis:
    """The same with pixels that are longer across than down by a share, or less long."""
    x, y = given.mm
    return replace(given, mm=(x * (1 + stretch / 2), y * (1 - stretch / 2)))


# Where the marks are of a frame that lies in the middle of its scan, about so or as far as it has room: its marks are
# looked for there only. In a large scan only the file about them is read; where any of them is not plainly there, the
# whole scan is searched.


def reach_mm(layout: FiducialLayout) -> float:
    """How far from its place in a centred frame a mark is looked for."""
    return _REACH * max(layout.frame_mm)


def room_mm(scan: Scan, layout: FiducialLayout, pitch_mm: tuple[float, float]) -> float:
    """How far from the middle of the scan that of a frame may lie which is whole in it."""
    scan_mm = scan.width_px * pitch_mm[0], scan.height_px * pitch_mm[1]
    return max((max(scan_mm) - min(layout.frame_mm)) / 2, 0.0) + _BEYOND_MM


def is_searched_by_windows(scan: Scan, layout: FiducialLayout, pitch_mm: tuple[float, float]) -> bool:
    """Whether windows about the marks are a small part of a large scan, and would not mistake one mark for the next."""
    side_px = 2 * reach_mm(layout) / np.asarray(pitch_mm)
    size_px = scan.width_px * scan.height_px
    share = len(layout.marks) * float(np.prod(side_px)) / size_px
    return size_px >= _LARGE_PX and share < _LARGEST_SHARE and not is_lattice(layout)


def is_lattice(layout: FiducialLayout) -> bool:
    """Whether one step takes more than half of the marks to others."""
    xy, near = np.array([mark.xy_mm for mark in layout.marks]), reach_mm(layout) / 2
    steps = (xy[:, None] - xy[None]).reshape(-1, 2)
    # Of a large lattice there are a million steps, and few that differ.
    rounded = np.round(steps[np.hypot(*steps.T) > near] / (_FINE * near))
    fine, times = np.unique(rounded @ [1, 1j], return_counts=True)
    places = _FINE * near * np.stack([fine.real, fine.imag], axis=1)
    alike = [times[others].sum() for others in cKDTree(places).query_ball_point(places, near)] if len(places) else []
    return max(alike, default=0) > _ALIKE * len(xy)


def centred_places_px(scan: Scan, layout: FiducialLayout, pixel_from_camera: Array) -> Array:
    """(n, 2) where the marks are in the scan if the middle of their constellation is that of the scan;
    pixel_from_camera: (2, 2), of a pose."""
    xy = np.array([mark.xy_mm for mark in layout.marks])
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    return np.asarray((xy - middle) @ pixel_from_camera.T + np.array([scan.width_px - 1, scan.height_px - 1]) / 2)
