"""Checks of a measured scan: its pitch against the marks, other frames beside the first, damage of its file."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from measure.array_types import Array
from measure.fiducials.interior_orientation import AFFINITY_SIGMA
from measure.fiducials.measurement import frame_corners_px, measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import NO_REASON, RIGHT_PITCH_REFUSED, Code, Reason, Status
from measure.marks.shapes import FiducialLayout, places_mm
from measure.results import FrameMeasurement, MarkMeasurement
from measure.scans.opening import crop_scan
from measure.scans.remote import Window
from measure.scans.scan import Scan

_LEAST_MARKS = 3  # with two, a false one yields a wrong pitch
_ROOM = 0.9  # fraction of the frame's sides: a free margin narrower than this holds no second frame
_MOST_MARKS = 0.75  # fraction of the layout's marks that must be measured in a second frame
_FEWEST_MARKS = 3
_REACH_PX = 20.0  # around a mark of unknown size: that of a disk or crossing of a test field, with its background


def pitch_problem(
    frame: FrameMeasurement, layout: FiducialLayout, pitch_um: tuple[float, float], source: str
) -> Reason | None:
    """Test the given pixel pitch against the separations of the marks.

    Film and scanner stretch by some thousandths, and the given separations have their own standard deviations. The
    pitch is rejected beyond both, at a significance level of 1 % for the two axes together.

    Parameters
    ----------
    pitch_um, source : given pitch and where it comes from.

    Returns
    -------
    Problem with the pitch that the marks suggest; None if the given one is not rejected.
    """
    found = {mark.point for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation}
    marks = [mark for mark in layout.marks if mark.id in found]
    is_named = any(Code.PITCH in problem.codes for problem in frame.problems)  # unequal pixel sizes
    if frame.pixel_from_camera is None or len(marks) < _LEAST_MARKS or is_named:
        return None
    film_um = 1000 / np.hypot(*frame.pixel_from_camera[:, :2].T)  # film per pixel, µm, across and down
    places = places_mm(marks)
    lever_mm = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=0)).min())  # root sum of squares, one axis
    given = float(np.median([max(mark.sigma_mm) for mark in marks]))
    if not lever_mm > given:
        return None
    sigma = float(np.hypot(AFFINITY_SIGMA, given / lever_mm))
    limit = -float(ndtri(RIGHT_PITCH_REFUSED / 2 / 2)) * sigma
    excess = film_um / np.asarray(pitch_um) - 1
    if np.abs(excess).max() <= limit:
        return None
    return Reason(
        f"{source} gives a pitch of {pitch_um[0]:.2f} x {pitch_um[1]:.2f} µm, but the marks' separations suggest "
        f"{film_um[0]:.2f} x {film_um[1]:.2f} µm ({100 * excess[0]:+.1f} and {100 * excess[1]:+.1f} %, where they and "
        f"the film allow {100 * limit:.1f} %). If the camera is the right one, set pitch_um = [{film_um[0]:.2f}, "
        f"{film_um[1]:.2f}] in the project.",
        Code.PITCH,
    )


def other_frames(scan: Scan, layout: FiducialLayout, frame: FrameMeasurement, options: FiducialOptions) -> Reason:
    """Search the rest of the scan for other frames.

    Returns
    -------
    Reason
        States the windows that name all frames in images.csv; empty if there is no room for a whole second frame, or
        none is found.
    """
    named = any(Code.OTHER_FRAME in problem.codes for problem in frame.problems)
    if frame.pixel_from_camera is None or frame.px_per_mm is None or options.part or named:
        return NO_REASON
    outlines, empty, measured = [_outline(frame, layout)], list[Window](), 0
    width, height = outlines[0][2:] - outlines[0][:2]
    rests = _rests([(0, 0, scan.width_px, scan.height_px)], outlines[0])
    pitch_um = 1000.0 / frame.px_per_mm
    alone = replace(options, clicks=(), writing="none", known_lines=())
    while rests:
        rest = rests.pop(0)
        is_known = any(_contains(each, rest) for each in empty)
        if is_known or rest[2] < _ROOM * width or rest[3] < _ROOM * height:
            continue
        lens = None if options.lens is None else options.lens.crop(*rest[:2])
        found = measure_fiducials(crop_scan(scan, rest), layout, (pitch_um, pitch_um), replace(alone, lens=lens))
        count = sum(mark.status is Status.MEASURED for mark in found.marks)
        if count >= max(_FEWEST_MARKS, _MOST_MARKS * len(layout.marks)) and found.pixel_from_camera is not None:
            measured += count
            outlines.append(_outline(found, layout) + np.array(rest[:2] * 2))
            rests = _rests([rest, *rests], outlines[-1])
        else:
            empty.append(rest)
    if not measured:
        return NO_REASON
    *windows, last = (_words(scan, each) for each in outlines)
    shows, all_of_them = ("a second frame", "both") if len(outlines) == 2 else (f"{len(outlines)} frames", "all")
    return Reason(
        f"The scan shows {shows}, {measured} marks of others than the first found, and only one was "
        f"measured. List {all_of_them} in images.csv, with the scan's name and a suffix, and give the column window: "
        f"{', '.join(windows)} and {last}.",
        Code.SECOND_PICTURE,
    )


def _rests(areas: Sequence[Window], outline: Array) -> list[Window]:
    """What an outline leaves of areas: the largest rectangles beside it."""
    col0, row0, col1, row1 = (int(value) for value in outline)
    rests = list[Window]()
    for area in areas:
        col, row, width, height = area
        left, upper, right, lower = max(col0, col), max(row0, row), min(col1, col + width), min(row1, row + height)
        if left >= right or upper >= lower:
            rests.append(area)
            continue
        sides = (
            (col, row, left - col, height),
            (right, row, col + width - right, height),
            (col, row, width, upper - row),
            (col, lower, width, row + height - lower),
        )
        rests += [side for side in sides if side[2] > 0 and side[3] > 0]
    return list(dict.fromkeys(rests))


def _contains(outer: Window, inner: Window) -> bool:
    (col0, row0, outer_width, outer_height), (col, row, width, height) = outer, inner
    across = col0 <= col and col + width <= col0 + outer_width
    return across and row0 <= row and row + height <= row0 + outer_height


def _outline(frame: FrameMeasurement, layout: FiducialLayout) -> Array:
    """(4,) bounding rectangle of a frame, px: first column, first row, last column, last row."""
    assert frame.pixel_from_camera is not None
    places = frame_corners_px(frame.pixel_from_camera, layout)
    return np.concatenate([places.min(axis=0), places.max(axis=0)])


def _words(scan: Scan, outline: Array) -> str:
    """Window around a frame in the picture of the file, in the notation of images.csv."""
    low = np.maximum(np.floor(outline[:2]), 0).astype(int)
    high = np.minimum(np.ceil(outline[2:]), (scan.width_px, scan.height_px)).astype(int)
    first = low + scan.origin_px
    return f'"{first[0]} {first[1]} {high[0] - low[0]} {high[1] - low[1]}"'


def report_damage(scan: Scan, frame: FrameMeasurement) -> FrameMeasurement:
    """Remove the observations on damaged parts of the scan's file, and put the damage first among the problems."""
    if not scan.damage:
        return frame
    sentence = f"{scan.damage[0].upper()}{scan.damage[1:]}. No mark is measured there: copy the file again, or rescan."
    problem = Reason(sentence, Code.DAMAGED_FILE)
    problems = (problem, *(each for each in frame.problems if each != problem))
    return replace(frame, marks=drop_lost_marks(scan, frame.marks), problems=problems)


def drop_lost_marks(scan: Scan, marks: Sequence[MarkMeasurement]) -> tuple[MarkMeasurement, ...]:
    """Set marks on damaged parts of the scan's file to `predicted`, with this reason."""
    kept = []
    for mark in marks:
        why = ""
        if mark.center_px is not None and mark.status.is_observation:
            half = int(np.ceil(mark.quality.get("size_px", 2 * _REACH_PX) / 2))
            col, row = np.rint(mark.center_px).astype(int)
            why = scan.loss_reason(int(col) - half, int(row) - half, 2 * half + 1, 2 * half + 1)
        reason = Reason(f"the scan's file is damaged at its place: {why}", Code.DAMAGED_FILE)
        kept.append(replace(mark, covariance=None, status=Status.PREDICTED, reason=reason) if why else mark)
    return tuple(kept)
