"""Fiducials of one scan: found by their constellation, named by the scan orientation, measured at full resolution.

The result has a row for each mark, found or not, and the problems of the frame: of its pitch against the marks, of
other frames beside it, and of damage of the file.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from measure.annotations.lines import KnownLine, Line
from measure.annotations.text import networks, read_writing
from measure.array_types import Array
from measure.fiducials.clicked_frame import clicked_frame
from measure.fiducials.constellation import FREE_MARKS, Placement
from measure.fiducials.interior_orientation import AFFINITY_SIGMA
from measure.fiducials.mark_fit import Detection
from measure.fiducials.measure_frame import SAME_MARK_PX, Frame, detect_some, measure_frame, orient_frame, rename_frame
from measure.fiducials.options import CLICK_SIGMA_PX, Click, FiducialOptions
from measure.fiducials.scan_orientation import decide_scan_orientation
from measure.fiducials.search import SearchResult, false_placements
from measure.fiducials.stages import doubt_frame, find_frame, find_in_negative
from measure.flags import MAX_FALSE_FRAMES, NO_REASON, RIGHT_PITCH_REFUSED, Cause, Code, Reason, Status
from measure.geometry import UP_FROM_CAMERA
from measure.marks.shapes import (
    FiducialLayout,
    LayoutMark,
    MarkTemplate,
    finest_detail_mm,
    limit_to_crossings,
    limit_to_frame,
    places_mm,
)
from measure.matching.covariance import honest_covariance
from measure.noise.scan_alterations import find_alterations
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from measure.scans.opening import crop_scan
from measure.scans.remote import Window
from measure.scans.scan import Scan

_SET = ("set in the project.",)
_FAINT = Reason("the frame was found only by its faint marks together", Code.FAINT_FRAME)
_UNSURE = Reason("No mark passed all checks: the frame may lie elsewhere.", Code.CHANCE)
_NEGATIVE = "The scan is a negative of what the camera file draws: its marks were found with light and dark exchanged."
_OBLIQUE = Reason(
    "only a perspective fits its marks: the film was photographed obliquely. Set transformation = "
    '"projective" under [adjust].',
    Code.PERSPECTIVE,
)
_FRAME_SHIFT = 0.95  # fraction of the frame's size: a rival shifted by more is another photograph
_AMBIGUOUS = 0.9  # fraction of the best score from which another placement is a rival
_FEWER_FOUND = 0.5  # times the fraction of all marks found
_PLAIN_PX = 3.0  # px across the finest line of a mark: both edges and the inside are resolved
_ASSUMED = Reason(
    "the scan orientation is only assumed, and another of the learned marks would have its origin elsewhere", Code.POSE
)
_OWN = Reason("its template is its own picture: nothing checks its place", Code.OWN_PICTURE)
_LEAST_MARKS = 3  # with two, a false one yields a wrong pitch
_ROOM = 0.9  # fraction of the frame's sides: a free margin narrower than this holds no second frame
_MOST_MARKS = 0.75  # fraction of the layout's marks that must be measured in a second frame
_FEWEST_MARKS = 3
_REACH_PX = 20.0  # around a mark of unknown size: that of a disk or crossing of a test field, with its background


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
        damage = Reason(f"not found: {scan.damage}", Code.DAMAGED_FILE)
        return FrameMeasurement(scan.name, _absent_marks(layout, damage))
    beyond = [click for click in options.clicks if not scan.contains(click.col_px, click.row_px)]
    if beyond:
        inside = tuple(click for click in options.clicks if click not in beyond)
        measured = measure_fiducials(scan, layout, pitch_um, replace(options, clicks=inside))
        return replace(measured, problems=(*map(_outside_problem, beyond), *measured.problems))
    clicked = clicked_frame(scan, layout, pitch_um, options) if options.clicks else None
    if clicked is None:
        return _place_clicked_marks(_search_frame(scan, layout, pitch_um, options), options.clicks)
    frame, pose, contradiction = clicked
    lines = _read(scan, layout, frame) if options.writing == "all" else None
    shown = replace(present_frame(frame, pose, pitch_um, (), NO_REASON), writing=lines)
    shown = _place_clicked_marks(shown, options.clicks)
    if not contradiction:
        return shown
    marks = tuple(mark.reject(contradiction) for mark in shown.marks)
    return replace(shown, marks=marks, problems=(contradiction.reword(f"{contradiction}."), *shown.problems))


def _outside_problem(click: Click) -> Reason:
    return Reason(
        f"The place to which a person pointed for mark {click.point} is outside of the scan, and not used. Point to "
        "the mark again.",
        Code.OUTSIDE,
    )


def _search_frame(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> FrameMeasurement:
    """Search for the frame without clicks that give its place, and measure its marks."""
    found, notes = find_frame(scan, layout, pitch_um, options), tuple[str, ...]()
    # Beside the lines of a sharpened negative lie fainter ones, light and dark exchanged.
    is_doubtful = found.frame is None or found.frame.is_faint
    if is_doubtful and (in_negative := find_in_negative(scan, layout, pitch_um, options)):
        found, notes = in_negative, (_NEGATIVE,)
    frame, result = found.frame, found.result
    lines = _read(scan, layout, frame) if options.writing == "all" else None
    if frame is None:
        absent = absent_frame(scan, layout, found.misfit, options.rotation_deg, pitch_um)
        other = _fitting_pose(scan, layout, pitch_um, options)
        return replace(absent, writing=lines, problems=(*other, *absent.problems))
    is_faint, own, against = frame.is_faint, frame.placement.pose, NO_REASON
    pose = decide_scan_orientation(frame, lines or ())
    if options.pose == "auto":
        if options.writing == "pose" and not pose.decided and frame.accepted:
            lines = _read(scan, layout, frame, options.known_lines)
            pose = decide_scan_orientation(frame, lines or ())
        if pose.name != own:
            renamed = rename_frame(frame, pose.name)
            if renamed is frame:  # fewer marks agree under the new names: its own orientation is kept, only assumed
                fewer = f"fewer marks agree in orientation {pose.name} than in {own}, which is assumed."
                pose = replace(pose, name=own, decided=False, evidence=(*pose.evidence, fewer), rivals=())
            frame = renamed
    else:
        if pose.name != own and frame.unblemished:
            contrary = decide_scan_orientation(frame, lines or (), (own, pose.name))
            if rename_frame(frame, contrary.name) is not frame:  # as many marks agree under the other names
                against = _against_the_set_pose(own, contrary)
        pose = ScanOrientation(options.pose, True, _SET)
    doubt = found.doubt if is_faint or frame is found.frame else doubt_frame(result, frame)
    problems = [each.reword(f"{each}.") for each in (*_rivals(result, frame), doubt, against) if each]
    doubts = problems if frame.unblemished else [_UNSURE, *problems]
    if doubts and options.pose == "auto":
        pose = replace(pose, decided=False, evidence=(*pose.evidence, *doubts))
    if frame.options.film_model != options.film_model:
        problems.append(_OBLIQUE)
    shown = present_frame(frame, pose, pitch_um, problems, _FAINT if is_faint else doubt)
    return replace(shown, writing=lines, notes=(*notes, *shown.notes))


def _fitting_pose(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> tuple[Reason, ...]:
    """Name the scan orientation in which the marks fit where they do not in the set one."""
    frame = None if options.pose == "auto" else find_frame(scan, layout, pitch_um, replace(options, pose="auto")).frame
    if frame is None or not frame.unblemished:
        return ()
    fitting = decide_scan_orientation(frame, ()).name
    if fitting == options.pose:  # and what differs is something else
        return ()
    sentence = (
        f"the marks fit in the scan orientation {fitting}, not in {options.pose}: this, or the sign or order of the "
        "given coordinates, is wrong."
    )
    return (Reason(sentence, Code.POSE),)


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
    frame_px = frame_corners_px(matrix, layout)
    pixel_from_up = matrix[:, :2] @ UP_FROM_CAMERA[frame.placement.pose].T
    for known in known_lines:
        outline_px = np.array(known.outline_mm) @ pixel_from_up.T + matrix[:, 2]
        lines = read_writing(scan, nets, frame_px, (known.side, outline_px))
        if any(known.matches(line) for line in lines):
            return lines
    return read_writing(scan, nets, frame_px)


def frame_corners_px(pixel_from_camera: Array, layout: FiducialLayout) -> Array:
    """(4, 2) corners of a frame, in order around it."""
    corners_mm = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(layout.frame_mm) / 2
    return np.asarray(corners_mm @ pixel_from_camera[:, :2].T + pixel_from_camera[:, 2])


def _against_the_set_pose(own: str, pose: ScanOrientation) -> Reason:
    """Warn if the image decides for another pose than the one set in the project; empty otherwise."""
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
    problems, best, fits = [], frame.placement, frame.inlier_fits
    found_mm, found_px = frame.camera_mm[list(fits)], np.array([fit.center_px for fit in fits.values()]).reshape(-1, 2)
    for other in result.placements:
        is_rival = other.pose == best.pose and other.pitch_mm == best.pitch_mm and not other.same_place(best)
        if not is_rival:
            continue
        # It leads to this very frame if the marks found lie where they would be searched from it, or, without the
        # perspective of a film photographed obliquely, if they are nearest to it under the names they have.
        if fits and np.hypot(*(other.places_px(found_mm) - found_px).T).max() <= frame.first_search_px:
            continue
        has_same_names = bool(fits) and other.names(found_px, frame.camera_mm).tolist() == list(fits)
        if has_same_names and frame.options.is_oblique:
            continue
        as_good = other.score >= _AMBIGUOUS * best.score and (
            other.supported >= best.supported - 1 or _lacks_its_own(frame, other)
        )
        if not ((as_good and not _outdoes(frame, other)) or _is_another_frame(result, other, frame)):
            continue
        if has_same_names and _finds_same_marks(frame, other):
            continue
        linear, shifts = best.pixel_from_camera[:, :2], (each.pixel_from_camera[:, 2] for each in (other, best))
        shift = np.linalg.solve(linear, np.subtract(*shifts))
        shift_mm = f"({shift[0]:.1f}, {shift[1]:.1f}) mm"
        if (np.abs(shift) > _FRAME_SHIFT * np.array(frame.layout.frame_mm)).any():
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


def _lacks_its_own(frame: Frame, rival: Placement) -> bool:
    """Whether the marks that a frame has and a rival placement lacks are hardly found: in a lattice that is named one
    step off, the outermost line."""
    found = np.array([index in frame.inlier_fits for index in range(len(frame.detections))])
    apart_px, _ = cKDTree(rival.places_px(frame.camera_mm)).query(frame.predicted_px)
    own = frame.inside & (apart_px > frame.first_search_px)
    return bool(own.any() and found[own].mean() < _FEWER_FOUND * found[frame.inside].mean())


def _finds_same_marks(frame: Frame, rival: Placement) -> bool:
    """Whether measuring from a rival placement finds marks of a frame alone, under the names that they have there."""
    there = measure_frame(frame.scan, frame.layout, rival, frame.options).inlier_fits
    own = frame.inlier_fits
    return bool(there) and all(
        name in own and np.hypot(*(fit.center_px - own[name].center_px)) < SAME_MARK_PX for name, fit in there.items()
    )


def _outdoes(frame: Frame, rival: Placement) -> bool:
    """Whether a frame has all marks that are found from a rival placement, and two or more besides."""
    if rival.supported > len(frame.unblemished) - FREE_MARKS:
        return False
    frame_there = measure_frame(frame.scan, frame.layout, rival, frame.options)
    return frame.contains(frame_there) and len(frame_there.unblemished) <= len(frame.unblemished) - FREE_MARKS


def _is_another_frame(result: SearchResult, other: Placement, frame: Frame) -> bool:
    """Whether a placement with as many supporting marks is another frame, as in a scan of two photographs.

    If it names all marks of this frame, these are not measured again. Else it has to show a clear mark where this frame
    has none.
    """
    if not frame.inlier_fits or other.supported < frame.placement.supported or not result.is_exhaustive(other):
        return False
    if false_placements(result, other) > MAX_FALSE_FRAMES:
        return False
    as_given = frame.scan, frame.layout, other, frame.options
    own = [detection for detection, is_own in zip(frame.detections, frame.inliers, strict=True) if is_own]
    own_px = np.array([each.fit.center_px for each in own if each.fit])
    names = other.names(own_px, frame.camera_mm).tolist()
    if names == list(frame.inlier_fits):  # the names that they have
        return False
    if min(names) >= 0:
        renamed = Frame.from_placement(*as_given).replace_detections(dict(zip(names, own, strict=True)))
        renamed = orient_frame(renamed)
        return renamed.is_sure and bool(renamed.inliers.sum() == len(own))
    apart_px, _ = cKDTree(own_px).query(other.places_px(frame.camera_mm))
    begun = detect_some(*as_given, np.flatnonzero(apart_px > frame.first_search_px).tolist())
    if begun is None:
        return False
    frame_there = measure_frame(*as_given, begun)
    return frame_there.is_sure and not frame.contains(frame_there)


def _place_clicked_marks(frame: FrameMeasurement, clicks: Sequence[Click]) -> FrameMeasurement:
    """Place clicked marks that could not be matched where the user clicked, with the standard deviation of a click."""
    by_point, marks = {click.point: click for click in clicks}, []
    for mark in frame.marks:
        if mark.point in by_point and not mark.status.is_observation:
            click = by_point[mark.point]
            place = np.array([click.col_px, click.row_px])
            covariance = Covariance({Cause.CLICK: CLICK_SIGMA_PX**2 * np.eye(2)})
            sentence = f"it is where a person pointed, since nothing could be matched there: {mark.reason}"
            reason = Reason(sentence, Code.CLICKED, *mark.reason.codes)
            mark = replace(mark, center_px=place, covariance=covariance, status=Status.WEAK, reason=reason)
        marks.append(mark)
    return replace(frame, marks=tuple(marks))


def absent_frame(
    scan: Scan, layout: FiducialLayout, reason: Reason, rotation_deg: float, pitch_um: tuple[float, float] | None
) -> FrameMeasurement:
    """Return the result for a scan in which no frame was found.

    Parameters
    ----------
    reason : why, as a clause.
    rotation_deg : largest rotation of the search.
    pitch_um : given pixel pitch in x and y, None if unknown.
    """
    also = "; parts of the scan's file are damaged" if scan.damage else ""
    codes = dict.fromkeys((Code.NO_FRAME, *reason.codes, *([Code.DAMAGED_FILE] if scan.damage else [])))
    marks = _absent_marks(layout, Reason(f"not found: {reason}{also}", *codes))
    remedy = (
        "check whether the camera is that of the scan, the pitch right, and the film laid within "
        f"{rotation_deg:g} degrees of upright or of a quarter turn"
    )
    if Code.NO_FIT in reason.codes:
        remedy = "compare the drawings of these marks with the scan, or set tone under [measure] in the project"
    coarse, own = NO_REASON, coarseness(layout, (scan.width_px, scan.height_px), pitch_um)
    if own.is_too_coarse:
        source = "" if pitch_um else ", as if the frame filled the scan,"
        coarse = Reason(
            f"The scan may be too coarse: at {own.pixel_um:.0f} µm a pixel{source} the finest detail of the marks, "
            f"{own.finest_um:.0f} µm, is {own.finest_um / own.pixel_um:.1f} px wide. "
            f"Scan at {own.needed_um:.0f} µm or finer.",
            Code.SMALL,
        )
    remedy += f". {coarse}" if coarse else "."
    problem = Reason(f"no fiducial was measured: {reason}; {remedy}", Code.NO_FRAME, *coarse.codes)
    return FrameMeasurement(scan.name, marks, None, None, (problem,))


class Coarseness(NamedTuple):
    """Finest detail of the marks of a camera beside a pixel of a scan, µm."""

    finest_um: float
    pixel_um: float

    @property
    def needed_um(self) -> float:
        """Largest pixel pitch at which the marks are plain."""
        return self.finest_um / _PLAIN_PX

    @property
    def is_too_coarse(self) -> bool:
        return self.pixel_um > self.needed_um


def coarseness(layout: FiducialLayout, size_px: tuple[int, int], pitch_um: tuple[float, float] | None) -> Coarseness:
    """Compare the finest detail of the marks with the pixels of a scan, at its pitch or as if the frame filled it."""
    finest_um = 1000 * min(finest_detail_mm(mark.mark) for mark in layout.marks)
    return Coarseness(finest_um, max(pitch_um) if pitch_um else 1000 * max(layout.frame_mm) / max(size_px))


def _absent_marks(layout: FiducialLayout, reason: Reason) -> tuple[MarkMeasurement, ...]:
    return tuple(MarkMeasurement(mark.id, "fiducial", None, None, Status.ABSENT, reason) for mark in layout.marks)


def present_frame(
    frame: Frame,
    pose: ScanOrientation,
    pitch_um: tuple[float, float] | None,
    problems: Sequence[Reason],
    doubt: Reason,
) -> FrameMeasurement:
    """Return the result for a frame that was found.

    Parameters
    ----------
    pitch_um : given pixel pitch in x and y; None: pixels are taken as square.
    problems : sentences on why the frame may lie elsewhere, in addition to the problems that its marks show.
    doubt : why the frame may be a false alarm, or that its marks are faint; empty otherwise.

    Notes
    -----
    Measured marks become weak if the frame may be a false alarm or is faint, or its scan allows no more. If its names
    are ambiguous, or it is more likely a false alarm than not, no mark is an observation.
    """
    if Code.NO_FRAME in doubt.codes:
        places = zip(frame.layout.marks, frame.detections, frame.predicted_px, strict=True)
        marks = tuple(_unmeasured(mark.id, each, place, doubt) for mark, each, place in places)
        return FrameMeasurement(frame.scan.name, marks, pose, problems=tuple(problems), weights=frame.weights)
    for altered in find_alterations(frame.scan, frame.weights if frame.channel_note else None):
        own_px2 = (np.zeros((2, 2)) if each.fit is None else each.fit.covariance_px2 for each in frame.detections)
        parts = ({altered.cause: altered.covariance(px2)} for px2 in own_px2)
        detections = (each.amend(parts=part) for each, part in zip(frame.detections, parts, strict=True))
        frame, problems = replace(frame, detections=tuple(detections)), (*problems, altered.reason)
        doubt = doubt or altered.doubt
    unnamed = next((problem for problem in problems if Code.AMBIGUOUS in problem.codes), NO_REASON)
    marks = tuple(_row(mark, index, frame, pose, doubt, unnamed) for index, mark in enumerate(frame.layout.marks))
    problems = (*problems, *_orientation_problems(frame, pitch_um))
    tone = replace(frame.tone, tone=frame.tone.tone.without_priors)
    notes = (frame.channel_note,) if frame.channel_note else ()
    orientation = frame.pixel_from_camera
    return FrameMeasurement(frame.scan.name, marks, pose, orientation, problems, frame.weights, tone, notes=notes)


def _unmeasured(point: str, detection: Detection, place_px: Array, why: Reason) -> MarkMeasurement:
    """Row of a mark without a measurement: predicted, or absent outside of the scan."""
    if detection.inside:
        return MarkMeasurement(point, "fiducial", place_px, None, Status.PREDICTED, why)
    return MarkMeasurement(point, "fiducial", None, None, Status.ABSENT, detection.reason)


def _orientation_problems(frame: Frame, pitch_um: tuple[float, float] | None) -> list[Reason]:
    """Problems of the interior orientation: an implausible stretch, with the likely cause, or no redundancy."""
    problems = []
    per_mm = np.hypot(*frame.pixel_from_camera[:, :2].T)
    expected = pitch_um or (1.0, 1.0)
    unequal = abs(per_mm[0] * expected[0] / (per_mm[1] * expected[1]) - 1)
    if unequal > 2 * AFFINITY_SIGMA and not frame.options.is_oblique:  # a tilt foreshortens the film
        wide_um, tall_um = 1000 / per_mm[0], 1000 / per_mm[1]
        if pitch_um is None:
            given, cause = "no pitch is given, so that pixels are taken as square", "pixels that are not square"
        elif pitch_um == frame.scan.pitch_um:
            given = f"the file's resolution tags say {pitch_um[0]:.1f} x {pitch_um[1]:.1f} µm"
            cause = "wrong resolution tags"
        else:
            given, cause = f"{pitch_um[0]:.1f} x {pitch_um[1]:.1f} µm is given", "a wrong pitch"
        problem = (
            f"by the marks a pixel is {wide_um:.1f} µm wide and {tall_um:.1f} µm tall, but {given}: more than "
            f"film deforms. The likely cause is {cause}: set pitch_um = [{wide_um:.2f}, {tall_um:.2f}] in the "
            "project, or check scanner and camera file."
        )
        problems.append(Reason(problem, Code.PITCH))
    used = int(frame.inliers.sum())
    if used <= 3:
        kind = "an affine transformation" if used == 3 else "a similarity"
        problem = f"{kind} on {used} fiducials has no redundancy: no check. More marks give one: `reseau review`."
        problems.append(Reason(problem, Code.NO_CHECK))
    return problems


def _row(
    mark: LayoutMark, index: int, frame: Frame, pose: ScanOrientation, weak_reason: Reason, ambiguity: Reason
) -> MarkMeasurement:
    """Row of a mark. weak_reason: why no mark of the frame is measured; ambiguity: why none is an observation."""
    detection = frame.detections[index]
    fit = detection.fit
    if fit is None:
        return _unmeasured(mark.id, detection, detection.predicted_px, detection.reason)
    names = "snr", "contrast_dn", "noise_dn", "blur_px", "damaged_fraction", "likeness", "significance"
    quality = {name: float(getattr(fit, name)) for name in (*names, "redundancy", "neighbour_correlation")}
    status, reason = frame.verdict(index)
    covariance, name = fit.place_covariance, frame.scan.name
    if isinstance(mark.mark, MarkTemplate):
        covariance = honest_covariance(mark.mark, name, fit)
        if set(mark.mark.shares) == {name}:
            weak_reason = _OWN
        elif mark.mark.learned_mm and not pose.is_unambiguous_up_to(mark.mark.alike):
            weak_reason = _ASSUMED  # under another name its origin lies elsewhere
    if status is Status.MEASURED and weak_reason:
        status, reason = Status.WEAK, weak_reason
    if status.is_observation and ambiguity:
        status, reason = Status.REJECTED, ambiguity
    return MarkMeasurement(mark.id, "fiducial", fit.center_px, covariance, status, reason, {**quality, **fit.figures})


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
