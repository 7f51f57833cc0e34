"""Results of a scan's fiducials: a row for each mark, the frame's problems, checks of its pitch and of file damage."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from measure.array_types import Array
from measure.fiducials.frame import Frame
from measure.fiducials.interior_orientation import AFFINITY_SIGMA
from measure.fiducials.mark_fit import Detection
from measure.flags import NO_REASON, RIGHT_PITCH_REFUSED, Cause, Code, Reason, Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkTemplate, finest_detail_mm
from measure.matching.covariance import honest_covariance
from measure.noise.resampling import NEAREST_PX2, is_nearest_neighbour
from measure.results import FrameMeasurement, MarkMeasurement, ScanOrientation
from measure.scans.scan import Scan

_LEAST_MARKS = 3  # with two, a false one yields a wrong pitch
_REACH_PX = 20.0  # around a mark of unknown size: that of a disk or crossing of a test field, with its background
_PLAIN_PX = 3.0  # px across the finest line of a mark: both edges and the inside are resolved
_ASSUMED = Reason(
    "the scan orientation is only assumed, and another of the learned marks would have its origin elsewhere", Code.POSE
)
_NEAREST = Reason(
    "The scan was turned or enlarged with nearest neighbours: each of its marks may lie half a pixel off. Measure the "
    "scan that it was made from, or turn that with interpolation.",
    Code.IMPRECISE,
)
_OWN = Reason("its template is its own picture: nothing checks its place", Code.OWN_PICTURE)


def lost_frame(scan: Scan, layout: FiducialLayout) -> FrameMeasurement:
    """Return the result for a scan none of whose pixels can be read."""
    return FrameMeasurement(scan.name, _absent_marks(layout, Reason(f"not found: {scan.damage}", Code.DAMAGED_FILE)))


def _absent_marks(layout: FiducialLayout, reason: Reason) -> tuple[MarkMeasurement, ...]:
    return tuple(MarkMeasurement(mark.id, "fiducial", None, None, Status.ABSENT, reason) for mark in layout.marks)


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
    if all(mark.mark.polarity != "auto" for mark in layout.marks):
        remedy += ', and the scan no negative of what the camera file draws (polarity = "auto" takes both)'
    if Code.NO_FIT in reason.codes:
        remedy = "compare the drawings of these marks with the scan, or set tone under [measure] in the project"
    coarse = _too_coarse(layout, max(pitch_um)) if pitch_um else NO_REASON
    remedy += f". {coarse}" if coarse else "."
    problem = Reason(f"no fiducial was measured: {reason}; {remedy}", Code.NO_FRAME, *coarse.codes)
    return FrameMeasurement(scan.name, marks, None, None, (problem,))


def _too_coarse(layout: FiducialLayout, pitch_um: float) -> Reason:
    """Warn if the pixels are too large for the marks' finest detail; empty otherwise."""
    finest_um = 1000 * min(finest_detail_mm(mark.mark) for mark in layout.marks)
    if finest_um >= _PLAIN_PX * pitch_um:
        return NO_REASON
    return Reason(
        f"The scan may be too coarse: at {pitch_um:.0f} µm a pixel the finest detail of the marks, {finest_um:.0f} µm, "
        f"is {finest_um / pitch_um:.1f} px wide. Scan at {finest_um / _PLAIN_PX:.0f} µm or finer.",
        Code.SMALL,
    )


def present_frame(
    frame: Frame,
    pose: ScanOrientation,
    pitch_um: tuple[float, float] | None,
    problems: Sequence[Reason],
    chance: Reason,
) -> FrameMeasurement:
    """Return the result for a frame that was found.

    Parameters
    ----------
    pitch_um : given pixel pitch in x and y; None: pixels are taken as square.
    problems : sentences on why the frame may lie elsewhere, in addition to the problems that its marks show.
    chance : why the frame may be a false alarm, or that its marks are faint; empty otherwise.

    Notes
    -----
    Measured marks become weak if the frame may be a false alarm or is faint. If its names are ambiguous, or it is more
    likely a false alarm than not, no mark is an observation.
    """
    if Code.NO_FRAME in chance.codes:
        places = zip(frame.layout.marks, frame.detections, frame.predicted_px, strict=True)
        marks = tuple(_unmeasured(mark.id, each, place, chance) for mark, each, place in places)
        return FrameMeasurement(frame.scan.name, marks, pose, problems=tuple(problems), weights=frame.weights)
    if is_nearest_neighbour(frame.scan):
        detections = (each.amend(parts={Cause.INTERPOLATION: NEAREST_PX2}) for each in frame.detections)
        frame, problems = replace(frame, detections=tuple(detections)), (*problems, _NEAREST)
    unnamed = next((problem for problem in problems if Code.AMBIGUOUS in problem.codes), NO_REASON)
    marks = tuple(_row(mark, index, frame, pose, chance, unnamed) for index, mark in enumerate(frame.layout.marks))
    problems = (*problems, *_problems(frame, pitch_um))
    tone = replace(frame.tone, tone=frame.tone.tone.without_priors)
    notes = (frame.channel_note,) if frame.channel_note else ()
    orientation = frame.pixel_from_camera
    return FrameMeasurement(frame.scan.name, marks, pose, orientation, problems, frame.weights, tone, notes=notes)


def _unmeasured(point: str, detection: Detection, place_px: Array, why: Reason) -> MarkMeasurement:
    """Row of a mark without a measurement: predicted, or absent outside of the scan."""
    if detection.inside:
        return MarkMeasurement(point, "fiducial", place_px, None, Status.PREDICTED, why)
    return MarkMeasurement(point, "fiducial", None, None, Status.ABSENT, detection.reason)


def _problems(frame: Frame, pitch_um: tuple[float, float] | None) -> list[Reason]:
    """Problems of the interior orientation: an implausible stretch, or no redundancy."""
    problems = []
    per_mm = np.hypot(*frame.pixel_from_camera[:, :2].T)
    given = pitch_um or (1.0, 1.0)
    if abs(per_mm[0] * given[0] / (per_mm[1] * given[1]) - 1) > 2 * AFFINITY_SIGMA:
        problem = _stretch(frame.scan, 1000 / per_mm[0], 1000 / per_mm[1], pitch_um)
        problems.append(Reason(problem, Code.PITCH))
    used = int(frame.inliers.sum())
    if used <= 3:
        kind = "an affine transformation" if used == 3 else "a similarity"
        problem = f"{kind} on {used} fiducials has no redundancy: no check. More marks give one: `reseau review`."
        problems.append(Reason(problem, Code.NO_CHECK))
    return problems


def _stretch(scan: Scan, wide_um: float, tall_um: float, pitch_um: tuple[float, float] | None) -> str:
    """Sentence on a pixel aspect ratio that differs from the given one, with the likely cause."""
    if pitch_um is None:
        given, cause = "no pitch is given, so that pixels are taken as square", "pixels that are not square"
    elif pitch_um == scan.pitch_um:
        given = f"the file's resolution tags say {pitch_um[0]:.1f} x {pitch_um[1]:.1f} µm"
        cause = "wrong resolution tags"
    else:
        given, cause = f"{pitch_um[0]:.1f} x {pitch_um[1]:.1f} µm is given", "a wrong pitch"
    return (
        f"by the marks a pixel is {wide_um:.1f} µm wide and {tall_um:.1f} µm tall, but {given}: more than "
        f"film deforms. The likely cause is {cause}: set pitch_um = [{wide_um:.2f}, {tall_um:.2f}] in the "
        "project, or check scanner and camera file."
    )


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
    if fit.edges is not None:  # offset of the second method's place from the matched one, and in standard deviations
        col, row = fit.edges.offset_px.tolist()
        quality |= {"second_method_col_px": col, "second_method_row_px": row, "second_method_sigmas": fit.edges.sigmas}
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
    film_um = 1000 / np.hypot(*frame.pixel_from_camera[:, :2].T)  # film per pixel, um, across and down
    places = np.array([mark.xy_mm for mark in marks])
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


def without_lost(scan: Scan, marks: Sequence[MarkMeasurement]) -> tuple[MarkMeasurement, ...]:
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


def with_damage(scan: Scan, frame: FrameMeasurement) -> FrameMeasurement:
    """Remove the observations on damaged parts of the scan's file, and put the damage first among the problems."""
    if not scan.damage:
        return frame
    sentence = f"{scan.damage[0].upper()}{scan.damage[1:]}. No mark is measured there: copy the file again, or rescan."
    problem = Reason(sentence, Code.DAMAGED_FILE)
    problems = (problem, *(each for each in frame.problems if each != problem))
    return replace(frame, marks=without_lost(scan, frame.marks), problems=problems)
