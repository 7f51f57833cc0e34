"""Whether a scan shows a second frame beside the one that was measured: two frames of a roll, scanned in one piece."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import NO_REASON, Code, Reason, Status
from measure.marks.shapes import FiducialLayout
from measure.results import FrameMeasurement
from measure.scans.opening import crop_scan
from measure.scans.remote import Window
from measure.scans.scan import Scan

Array = NDArray[np.float64]

_ROOM = 0.9  # of the frame's sides that are free beside it: less shows no whole frame
_MOST_MARKS = 0.75  # of the layout's, measured: then it is a frame as this one is
_FEWEST_MARKS = 3


def second_frame(scan: Scan, layout: FiducialLayout, frame: FrameMeasurement, options: FiducialOptions) -> Reason:
    """Where a second frame lies in the scan, with what names both; empty where there is no room for a whole one, or
    where none is found."""
    named = any(Code.OTHER_FRAME in problem.codes for problem in frame.problems)
    if frame.pixel_from_camera is None or frame.px_per_mm is None or options.part or named:
        return NO_REASON
    first = _outline(frame, layout)
    pitch_um = 1000.0 / frame.px_per_mm
    alone = replace(options, clicks=(), writing="none", known_lines=())
    for rest in _rests(scan, first):
        found = measure_fiducials(crop_scan(scan, rest), layout, (pitch_um, pitch_um), alone)
        measured = sum(mark.status is Status.MEASURED for mark in found.marks)
        if measured >= max(_FEWEST_MARKS, _MOST_MARKS * len(layout.marks)) and found.pixel_from_camera is not None:
            second = _outline(found, layout) + np.array(rest[:2] * 2)
            windows = f"{_words(scan, first)} and {_words(scan, second)}"
            return Reason(
                f"The scan shows a second frame, {measured} marks of it clear, and only one was measured. Name both in "
                f"images.csv, each called as the scan with something behind, by the column window: {windows}.",
                Code.SECOND_PICTURE,
            )
    return NO_REASON


def _outline(frame: FrameMeasurement, layout: FiducialLayout) -> Array:
    """(4,) first and last column and row of the rectangle about a frame: col, row, col, row."""
    assert frame.pixel_from_camera is not None
    matrix = frame.pixel_from_camera
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(layout.frame_mm) / 2
    places = corners @ matrix[:, :2].T + matrix[:, 2]
    return np.concatenate([places.min(axis=0), places.max(axis=0)])


def _rests(scan: Scan, outline: Array) -> list[Window]:
    """What of the scan lies beside, above and below a frame, where it has room for another one."""
    col0, row0, col1, row1 = (int(value) for value in outline)
    width, height = outline[2:] - outline[:2]
    rests = [
        (0, 0, col0, scan.height_px),
        (col1, 0, scan.width_px - col1, scan.height_px),
        (0, 0, scan.width_px, row0),
        (0, row1, scan.width_px, scan.height_px - row1),
    ]
    return [rest for rest in rests if rest[2] >= _ROOM * width and rest[3] >= _ROOM * height]


def _words(scan: Scan, outline: Array) -> str:
    """A window about a frame, as images.csv has it."""
    low = np.maximum(np.floor(outline[:2]), 0).astype(int)
    high = np.minimum(np.ceil(outline[2:]), (scan.width_px, scan.height_px)).astype(int)
    return f'"{low[0]} {low[1]} {high[0] - low[0]} {high[1] - low[1]}"'
