"""Joint check of a camera's frames: gross errors, bent film, wrong given coordinates, scanner distortion.

Wrong given coordinates cause equal residuals of an affine transformation in all frames in the camera's axes, scanner
distortion in the scan's axes. Residuals of one frame only come from its film or a gross error (`misfits`). Measured
places are not changed: film deformation adds a variance to the marks of its frame, and a single mark with a gross error
becomes weak.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import pdist

from measure.array_types import Array
from measure.fiducials.consistency import NAMED, FrameMarks, Hypothesis
from measure.fiducials.misfits import Explanation, FrameMisfit, Frames, explain, explain_by_pattern
from measure.fiducials.options import ANY_FILM, BelievedFilm
from measure.fiducials.own_figures import check_own_figures
from measure.fiducials.second_places import Doubt, add_doubts, check_second_places, observed_fiducials
from measure.flags import FALSE_DOUBT, NO_REASON, Cause, Code, Reason
from measure.geometry import up_from_camera
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.results import FrameMeasurement

_SAME_SITE = 1 / 3  # fraction of the least distance of two marks: closer marks of two frames share a site of the scan
_NAMED_MARKS = 4  # largest number of marks named in a sentence


@dataclass(frozen=True, eq=False)
class CheckedFrames:
    """Frames after the joint check.

    Attributes
    ----------
    frames : with the statuses, covariances and problems that follow from all frames.
    film_sigma_mm : of each frame, scatter of the film along an axis; the prior unless the frames contradict it.
    """

    frames: tuple[FrameMeasurement, ...]
    film_sigma_mm: tuple[float, ...]


def check_frames(
    frames: Sequence[FrameMeasurement],
    layout: FiducialLayout,
    pitches_um: Sequence[tuple[float, float]],
    film: BelievedFilm = ANY_FILM,
) -> CheckedFrames:
    """Check all measured frames of one camera together.

    Parameters
    ----------
    frames : measured frames.
    layout : marks of the camera.
    pitches_um : pixel pitch of each scan, in x and y.
    film : prior knowledge of the film.
    """
    checked, films = check_own_figures(check_second_places(frames)), [film.sigma_mm] * len(frames)
    found = {i: _misfit(*pair, layout, film) for i, pair in enumerate(zip(checked, pitches_um, strict=True))}
    misfits = {place: each for place, each in found.items() if each is not None}
    if misfits:
        shared, problem = _explain_together(misfits, layout, film.sigma_mm)
        for place, own in shared.frames.items():
            names = [layout.marks[index].id for index in own.sites]
            checked[place], films[place] = _add_findings(checked[place], own, shared, names, film)
            if problem and own.marks.redundancy:
                checked[place] = replace(checked[place], problems=(*checked[place].problems, problem))
    return CheckedFrames(tuple(checked), tuple(films))


def _misfit(
    frame: FrameMeasurement, pitch_um: tuple[float, float], layout: FiducialLayout, film: BelievedFilm
) -> FrameMisfit | None:
    """Misfit of a frame; None for fewer than three marks, or collinear ones."""
    number = {mark.id: place for place, mark in enumerate(layout.marks)}
    marks = [mark for mark in observed_fiducials(frame) if mark.point in number]
    sites = np.array([number[mark.point] for mark in marks], dtype=np.intp)
    given = np.array([layout.marks[place].xy_mm for place in sites]).reshape(-1, 2)
    if frame.pixel_from_camera is None or np.linalg.matrix_rank(given - given.mean(axis=0)) < 2:
        return None
    mm = np.diag([pitch_um[0], -pitch_um[1]]) / 1000
    places = np.array([mark.center_px for mark in marks])
    measured = (places if film.lens is None else film.lens.ideal_px(places)) @ mm
    covariances = np.array([mm @ np.asarray(mark.covariance_px2) @ mm.T for mark in marks])
    pose = frame.pose.name if frame.pose else "0"
    return FrameMisfit(FrameMarks.from_places(given, measured, covariances, film.model), sites, pose)


def _explain_together(frames: Frames, layout: FiducialLayout, film_mm: float) -> tuple[Explanation, Reason]:
    """Explain the misfits by film and marks alone, by wrong given coordinates, or by scanner distortion, whichever is
    best. Returns also the problem in the latter two cases."""
    places = np.array([mark.xy_mm for mark in layout.marks])
    given_mm = np.array([min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks])
    if len(frames) == 1:
        return explain(frames, places, given_mm, 0.0, film_mm), NO_REASON
    by_places = explain_by_pattern(frames, places, given_mm, film_mm)
    is_clear, rest = (
        by_places.pattern.p_value >= FALSE_DOUBT,
        " The scanner may do the same: all frames lie alike in it.",
    )
    lie_alike = len({each.pose for each in frames.values()}) == 1
    if not lie_alike and not (is_clear and by_places.is_quiet):
        sites = _scan_sites(frames)
        turned = {place: _in_scan_axes(each, sites, given_mm) for place, each in frames.items()}
        by_scanner = explain_by_pattern(turned, sites, np.zeros(len(sites)), film_mm)
        lead = by_scanner.log_evidence - by_places.log_evidence
        if lead > NAMED and by_scanner.pattern.p_value < FALSE_DOUBT:
            kept = {place: replace(each, sites=frames[place].sites) for place, each in by_scanner.frames.items()}
            return replace(by_scanner, frames=kept), _bent_scans(by_scanner)
        rest = "" if lead < -NAMED else " The scanner may do the same."
    if is_clear:
        return explain(frames, places, given_mm, 0.0, film_mm), NO_REASON
    return by_places, _wrong_places(by_places, layout, rest)


def _scan_sites(frames: Frames) -> Array:
    """(m, 2) sites of the marks of all frames, in the scan's axes."""
    places = [each.marks.given_mm @ up_from_camera(each.pose).T for each in frames.values()]
    near = _SAME_SITE * min(float(pdist(own).min()) for own in places)
    sites = list[Array]()
    for place in np.unique(np.round(np.concatenate(places), 6), axis=0):
        if not any(np.hypot(*(place - site)) < near for site in sites):
            sites.append(place)
    return np.array(sites)


def _in_scan_axes(frame: FrameMisfit, sites: Array, given_mm: Array) -> FrameMisfit:
    """Transform a frame to the scan's axes, right and up, and to the nearest sites (m, 2) of the scan. The
    variances of its given places, from the standard deviations given_mm, are added to its marks."""
    marks = frame.marks.widen(given_mm[frame.sites] ** 2).rotate(up_from_camera(frame.pose))
    nearest = np.hypot(*np.moveaxis(marks.given_mm[:, None] - sites[None], -1, 0)).argmin(axis=1)
    return FrameMisfit(marks, nearest, frame.pose)


def _add_findings(
    frame: FrameMeasurement, own: FrameMisfit, shared: Explanation, names: Sequence[str], film: BelievedFilm
) -> tuple[FrameMeasurement, float]:
    """Add the findings to a frame: covariances, statuses and problems. Returns also the film's standard deviation."""
    film_mm = own.film_mm or (shared.film.sigma if shared.film_is_more else film.sigma_mm)
    px_per_mm = frame.px_per_mm or 1.0
    code, cause = Code.OFF_FRAMES, Cause.OTHER_FRAMES
    has_it = "the camera's other frames have it, more than they scatter"
    if len(shared.frames) == 1:
        code, cause = Code.OFF_GIVEN, Cause.GIVEN_PLACES
        has_it = "the other marks have it, more than film and given places explain"
    for mark, off in own.off_mm.items():
        reason = Reason(f"it lies {off:.3f} mm from where {has_it}", code)
        frame = add_doubts(frame, {names[mark]: Doubt((off * px_per_mm) ** 2 / 2, cause, reason)})
    added = film_mm**2 - film.added_later_mm**2 if film_mm > film.sigma_mm else 0.0
    suspect_mm2 = own.suspect_mm2 * np.ones(len(names))
    variances = np.maximum(added, suspect_mm2)
    suspects = {name: float(np.sqrt(2 * mm2)) for name, mm2 in zip(names, suspect_mm2, strict=True) if mm2 > 0}
    bent = {
        name: Doubt(variance * px_per_mm**2, Cause.FILM, _suspicion(suspects[name]) if name in suspects else NO_REASON)
        for name, variance in zip(names, variances.tolist(), strict=True)
        if variance > 0
    }
    known_um = 1000 * float(np.sqrt(max(variances.max(), film_mm**2)))  # including what the adjustment adds later
    problem = _problem(own, shared, names, suspects, known_um)
    is_known = own.hypothesis is Hypothesis.PITCH and any(Code.PITCH in each.codes for each in frame.problems)
    other_problems = [each for each in frame.problems if not {*each.codes} & {*problem.codes} & {Code.PERSPECTIVE}]
    problems = (*other_problems, problem) if problem and not is_known else frame.problems
    return replace(add_doubts(frame, bent), problems=problems), film_mm


def _suspicion(off_mm: float) -> Reason:
    """Reason why a mark is weak: it may have the gross error of its frame."""
    return Reason(f"it may be wrong, by {off_mm:.3f} mm then: its frame is bent or one mark is off", Code.BENT_FRAME)


def _problem(
    own: FrameMisfit, shared: Explanation, names: Sequence[str], suspects: Collection[str], known_um: float
) -> Reason:
    """Problem of an outlying frame; empty for any other.

    suspects: names of its weak marks, the only ones named as possibly wrong; known_um: standard deviation to which its
    marks are set.
    """
    if own.film_mm is None:
        return NO_REASON
    alone = len(shared.frames) == 1
    most_mm = float(shared.pattern.expected_marks(own, own.film_mm).distances_mm().max())
    than = "the given coordinates" if alone else "what the camera's frames have in common"
    p_value = f"p = {own.p_value:.1g} for film deformation alone"
    widened = f"The standard deviation of its marks is set to {known_um:.0f} µm."
    listed = f"{', '.join(list(suspects)[:_NAMED_MARKS])}{' and others' * (len(suspects) > _NAMED_MARKS)}"
    if own.hypothesis is Hypothesis.PITCH:
        return Reason(
            f"the frame is stretched against {than}; {p_value}. A wrong pitch, or film that is stretched more, "
            "explains it best: check pitch_um in the project.",
            Code.BENT_FRAME,
            Code.PITCH,
        )
    if own.hypothesis is Hypothesis.PERSPECTIVE:
        return Reason(
            f"the frame shows a perspective against {than}, up to {most_mm:.3f} mm after an affine transformation; "
            f'{p_value}. The film was photographed obliquely: set transformation = "projective" under [adjust]. '
            f"{widened}",
            Code.BENT_FRAME,
            Code.PERSPECTIVE,
        )
    if not own.marks.redundancy:
        return Reason(
            f"its three marks {', '.join(names)} do not have the shape that {than} have; {p_value}, and nothing else "
            f"checks three marks. One of the marks is off, or the pitch is wrong. {widened}",
            Code.OFF_GIVEN if alone else Code.OFF_FRAMES,
        )
    cause = "Its film is bent, or was moved while it was scanned."
    if alone:
        cause = (
            "Film or scanner bent it, or the coordinates are not those of this camera; one frame does not tell which."
        )
    wrong = f" Or a mark is wrong, which {listed} may be: these are weak." if suspects else ""
    return Reason(
        f"the frame is deformed against {than} by up to {most_mm:.3f} mm after an affine transformation; {p_value}. "
        f"{cause}{wrong} {widened}",
        Code.BENT_FRAME,
    )


def _wrong_places(shared: Explanation, layout: FiducialLayout, rest: str) -> Reason:
    off = _distances([mark.id for mark in layout.marks], np.hypot(*shared.pattern.mm.T))
    return Reason(
        f"the given coordinates differ from all frames of the camera in the same way, {off}, after an affine "
        f"transformation: p = {shared.pattern.p_value:.1g} for their standard deviations. Check whether they are those "
        f"of this camera.{rest}",
        Code.OFF_GIVEN,
    )


def _bent_scans(shared: Explanation) -> Reason:
    most = float(np.hypot(*shared.pattern.mm.T).max())
    return Reason(
        f"all scans are bent in the same way in the scanner's axes, by up to {most:.3f} mm after an affine "
        f"transformation (p = {shared.pattern.p_value:.1g} without): the scanner does it.",
        Code.BENT_SCANS,
    )


def _distances(names: Sequence[str], off_mm: Array) -> str:
    """List the marks with the largest deviations."""
    worst = np.argsort(-off_mm, kind="stable")[:_NAMED_MARKS]
    rest = f", {len(names) - len(worst)} others by less" if len(names) > len(worst) else ""
    return ", ".join(f"{names[k]} by {off_mm[k]:.3f} mm" for k in worst) + rest
