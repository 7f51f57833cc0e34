"""Fiducials of one scan: found by their constellation, named by the scan orientation, measured at full resolution."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from measure.annotations.lines import KnownLine, Line
from measure.annotations.text import networks, read_writing
from measure.array_types import Array
from measure.fiducials.clicked_frame import clicked_frame, contradicted_pose, is_shown, place_clicked_marks
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import measure_frame, rename_frame
from measure.fiducials.options import FiducialOptions
from measure.fiducials.rows import absent_frame, lost_frame, present_frame
from measure.fiducials.scan_orientation import decide_pose
from measure.fiducials.search import SearchResult
from measure.fiducials.significance import doubt_frame, false_placements
from measure.fiducials.stages import find_frame
from measure.flags import MAX_FALSE_FRAMES, NO_REASON, Code, Reason, Status
from measure.geometry import UP_FROM_CAMERA
from measure.marks.shapes import FiducialLayout, limit_to_crossings, limit_to_frame
from measure.results import FrameMeasurement, ScanOrientation
from measure.scans.opening import crop_scan
from measure.scans.remote import Window
from measure.scans.scan import Scan

_SET = ("set in the project.",)
_FAINT = Reason("the frame was found only by its faint marks together", Code.FAINT_FRAME)
_UNSURE = Reason("No mark passed all checks: the frame may lie elsewhere.", Code.CHANCE)
_OBLIQUE = Reason(
    "only a perspective fits its marks: the film was photographed obliquely. Set transformation = "
    '"projective" under [adjust].',
    Code.PERSPECTIVE,
)
_BESIDE = 0.95  # fraction of the frame's size: a rival shifted by more is another photograph
_AMBIGUOUS = 0.9  # fraction of the best score from which another placement is a rival
_HARDLY = 0.5  # times the fraction of all marks found
_ROOM = 0.9  # fraction of the frame's sides: a free margin narrower than this holds no second frame
_MOST_MARKS = 0.75  # fraction of the layout's marks that must be measured in a second frame
_FEWEST_MARKS = 3


def measure_fiducials(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions | None = None
) -> FrameMeasurement:
    """Measure every mark of the layout in the scan.

    Parameters
    ----------
    pitch_um : pixel pitch of the scan in x and y; None if unknown: it is then derived roughly from the frame's size.

    Returns
    -------
    FrameMeasurement
        One row for each mark, found or not. Centres are in pixels; the centre of the top-left pixel is (0, 0).

    Notes
    -----
    Never raises because of the image content: statuses, reasons and problems describe what was not found.
    """
    options = options or FiducialOptions()
    layout = limit_to_crossings(limit_to_frame(layout))
    if scan.is_lost:
        return lost_frame(scan, layout)
    if is_shown(layout, options):
        frame, pose = clicked_frame(scan, layout, pitch_um, options)
        lines = _read(scan, layout, frame) if options.writing == "all" else None
        shown = place_clicked_marks(
            replace(present_frame(frame, pose, pitch_um, (), NO_REASON), writing=lines), options.clicks
        )
        contradiction = contradicted_pose(layout, options, pitch_um)
        return _refused(shown, contradiction) if contradiction else shown
    return place_clicked_marks(_search_frame(scan, layout, pitch_um, options), options.clicks)


def _refused(frame: FrameMeasurement, why: Reason) -> FrameMeasurement:
    """Reject all marks of the frame that are observations."""
    marks = (
        replace(mark, status=Status.REJECTED, reason=why) if mark.status.is_observation else mark
        for mark in frame.marks
    )
    return replace(frame, marks=tuple(marks), problems=(why.reword(f"{why}."), *frame.problems))


def _search_frame(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> FrameMeasurement:
    """Search for the frame without clicks that give its place, and measure its marks."""
    found = find_frame(scan, layout, pitch_um, options)
    frame, result = found.frame, found.result
    if frame is None:
        absent = absent_frame(scan, layout, found.misfit, options.rotation_deg, pitch_um)
        return replace(absent, writing=_read(scan, layout, None)) if options.writing == "all" else absent
    is_faint = frame.is_faint
    lines = _read(scan, layout, frame) if options.writing == "all" else None
    pose, against = ScanOrientation(options.pose, True, _SET), NO_REASON
    if options.pose == "auto":
        pose = decide_pose(frame, lines or ())
        if options.writing == "pose" and not pose.decided and frame.accepted:
            lines = _read(scan, layout, frame, options.known_lines)
            pose = decide_pose(frame, lines or ())
        frame, pose = _rename(frame, pose)
    else:
        against = _against_the_set_pose(frame, lines or ())
    # A faint frame is not tested again: it was accepted only if significant.
    chance = NO_REASON if is_faint else doubt_frame(result, frame)
    problems = [each.reword(f"{each}.") for each in (*_rivals(result, frame), chance, against) if each]
    doubts = problems if frame.measured_count else [_UNSURE, *problems]
    if doubts and options.pose == "auto":
        pose = replace(pose, decided=False, evidence=(*pose.evidence, *doubts))
    if frame.options.film_model != options.film_model:
        problems.append(_OBLIQUE)
    return replace(present_frame(frame, pose, pitch_um, problems, _FAINT if is_faint else chance), writing=lines)


def _rename(frame: Frame, pose: ScanOrientation) -> tuple[Frame, ScanOrientation]:
    """Rename the marks to those of a pose. If fewer of them agree then, keep the frame, its pose only assumed."""
    if pose.name == frame.placement.pose:
        return frame, pose
    renamed = rename_frame(frame.scan, frame, pose.name)
    if renamed is not frame:
        return renamed, pose
    against = f"fewer marks agree in orientation {pose.name} than in {frame.placement.pose}, which is assumed."
    return frame, replace(pose, name=frame.placement.pose, decided=False, evidence=(*pose.evidence, against), rivals=())


def _read(
    scan: Scan, layout: FiducialLayout, frame: Frame | None, known_lines: Sequence[KnownLine] = ()
) -> tuple[Line, ...] | None:
    """Read the writing around the frame, or only around a known line; along the scan's edges without a frame."""
    nets = networks()
    if nets is None:
        return None
    if frame is None:
        return read_writing(scan, nets)
    matrix = frame.pixel_from_camera
    frame_px = _corners_px(matrix, layout)
    pixel_from_up = matrix[:, :2] @ UP_FROM_CAMERA[frame.placement.pose].T
    for known in known_lines:
        outline_px = np.array(known.outline_mm) @ pixel_from_up.T + matrix[:, 2]
        lines = read_writing(scan, nets, frame_px, (known.side, outline_px))
        if any(known.matches(line) for line in lines):
            return lines
    return read_writing(scan, nets, frame_px)


def _against_the_set_pose(frame: Frame, lines: Sequence[Line]) -> Reason:
    """Warn if the image decides for another pose than the one set in the project; empty otherwise."""
    own, likeliest = frame.placement.pose, decide_pose(frame, lines)
    if likeliest.name == own or not frame.measured_count:
        return NO_REASON
    pose = decide_pose(frame, lines, (own, likeliest.name))
    if not pose.decided or pose.name == own:
        return NO_REASON
    evidence = " ".join(pose.evidence).rstrip(".")
    return Reason(
        f"scan orientation {own} is set in the project, but the marks of this frame show {pose.name}, "
        f'and then the marks have other names (scan_orientation = "auto" takes each scan as it lies): {evidence}',
        Code.POSE,
    )


def _rivals(result: SearchResult, frame: Frame) -> list[Reason]:
    """Warn of other placements in the same pose that are nearly as good, or that show another frame."""
    problems, best = [], frame.placement
    for other in result.placements:
        is_rival = other.pose == best.pose and other.pitch_mm == best.pitch_mm and not other.same_place(best)
        if not is_rival or _leads_to(other, frame):
            continue
        as_good = other.score >= _AMBIGUOUS * best.score and (
            other.supported >= best.supported - 1 or _lacks_its_own(frame, other)
        )
        if not (as_good or _is_another_frame(result, other, frame)):
            continue
        linear, shifts = best.pixel_from_camera[:, :2], (each.pixel_from_camera[:, 2] for each in (other, best))
        shift = np.linalg.solve(linear, np.subtract(*shifts))
        shift_mm = f"({shift[0]:.1f}, {shift[1]:.1f}) mm"
        if (np.abs(shift) > _BESIDE * np.array(frame.layout.frame_mm)).any():
            sentence = (
                f"the scan shows another frame {shift_mm} from this one, with {other.supported} marks where this one "
                f"has {best.supported}: give a scan of one frame, or name both in images.csv by the column window"
            )
            problems.append(Reason(sentence, Code.OTHER_FRAME))
        else:
            sentence = (
                f"the constellation fits nearly as well shifted by {shift_mm}, on {other.supported} marks against "
                f"{best.supported}: the marks' names are ambiguous, all may be wrong: click three in `reseau review`"
            )
            problems.append(Reason(sentence, Code.AMBIGUOUS))
    return problems[:3]


def _leads_to(placement: Placement, frame: Frame) -> bool:
    """Whether all marks found in a frame lie where they would be searched from a placement."""
    fits = frame.inlier_fits
    places = np.array([fit.center_px for fit in fits.values()]).reshape(-1, 2)
    off_px = np.hypot(*(placement.places_px(frame.camera_mm[list(fits)]) - places).T)
    return bool(fits) and bool(off_px.max() <= frame.first_search_px)


def _lacks_its_own(frame: Frame, rival: Placement) -> bool:
    """Whether the marks that a frame has and a rival placement lacks are hardly found: in a lattice that is named one
    step off, the outermost line."""
    found = np.array([fit is not None for fit in frame.fits])
    inside = np.array([detection.inside for detection in frame.detections])
    apart_px, _ = cKDTree(rival.places_px(frame.camera_mm)).query(frame.predicted_px)
    own = inside & (apart_px > frame.first_search_px)
    return bool(own.any() and found[own].mean() < _HARDLY * found[inside].mean())


def _is_another_frame(result: SearchResult, other: Placement, frame: Frame) -> bool:
    """Whether a placement with as many supporting marks is another frame, as in a scan of two photographs."""
    if other.supported < frame.placement.supported or not result.is_exhaustive(other):
        return False
    if false_placements(result, other) > MAX_FALSE_FRAMES:
        return False
    frame_there = measure_frame(frame.scan, frame.layout, other, frame.options)
    return frame_there.is_sure and not frame.contains(frame_there)


def second_frame(scan: Scan, layout: FiducialLayout, frame: FrameMeasurement, options: FiducialOptions) -> Reason:
    """Search the rest of the scan for a second frame.

    Returns
    -------
    Reason
        States the windows that name both frames in images.csv; empty if there is no room for a whole second frame, or
        none is found.
    """
    named = any(Code.OTHER_FRAME in problem.codes for problem in frame.problems)
    if frame.pixel_from_camera is None or frame.px_per_mm is None or options.part or named:
        return NO_REASON
    first = _outline(frame, layout)
    pitch_um = 1000.0 / frame.px_per_mm
    alone = replace(options, clicks=(), writing="none", known_lines=())
    for rest in _rests(scan, first):
        lens = None if options.lens is None else options.lens.crop(*rest[:2])
        found = measure_fiducials(crop_scan(scan, rest), layout, (pitch_um, pitch_um), replace(alone, lens=lens))
        measured = sum(mark.status is Status.MEASURED for mark in found.marks)
        if measured >= max(_FEWEST_MARKS, _MOST_MARKS * len(layout.marks)) and found.pixel_from_camera is not None:
            second = _outline(found, layout) + np.array(rest[:2] * 2)
            windows = f"{_words(scan, first)} and {_words(scan, second)}"
            return Reason(
                f"The scan shows a second frame, {measured} marks of it found, and only one was measured. List both in "
                f"images.csv, with the scan's name and a suffix, and give the column window: {windows}.",
                Code.SECOND_PICTURE,
            )
    return NO_REASON


def _outline(frame: FrameMeasurement, layout: FiducialLayout) -> Array:
    """(4,) bounding rectangle of a frame, px: first column, first row, last column, last row."""
    assert frame.pixel_from_camera is not None
    places = _corners_px(frame.pixel_from_camera, layout)
    return np.concatenate([places.min(axis=0), places.max(axis=0)])


def _corners_px(pixel_from_camera: Array, layout: FiducialLayout) -> Array:
    """(4, 2) corners of a frame, in order around it."""
    corners_mm = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(layout.frame_mm) / 2
    return np.asarray(corners_mm @ pixel_from_camera[:, :2].T + pixel_from_camera[:, 2])


def _rests(scan: Scan, outline: Array) -> list[Window]:
    """Windows to the left and right of a frame, above and below it, that have room for another one."""
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
    """Window around a frame, in the notation of images.csv."""
    low = np.maximum(np.floor(outline[:2]), 0).astype(int)
    high = np.minimum(np.ceil(outline[2:]), (scan.width_px, scan.height_px)).astype(int)
    return f'"{low[0]} {low[1]} {high[0] - low[0]} {high[1] - low[1]}"'
