"""Search for a frame as a list of stages, which differ in region, pitch, film model, tone curve and surroundings.

One loop makes the stages in order and skips those that an earlier result makes unnecessary. One criterion accepts a
frame: the expected number of false frames in all stages so far, or in those under the given pitch alone, whose prior
probability is above that of all others together.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Literal

import numpy as np

from measure.detection.correlation import CLOSE, GRAINY, WIDE, Surroundings
from measure.fiducials.constellation import Placement, distinct_places
from measure.fiducials.frame import Frame
from measure.fiducials.interior_orientation import AFFINITY_SIGMA
from measure.fiducials.measure_frame import measure_frame, rename_frame, shows_marks
from measure.fiducials.options import FiducialOptions
from measure.fiducials.scan_orientation import decide_pose
from measure.fiducials.search import (
    FrameSearch,
    Hypotheses,
    SearchResult,
    is_searched_by_windows,
    pitch_hypotheses,
    slightly_longer,
)
from measure.fiducials.significance import doubt_frame, false_frames, false_placements
from measure.flags import MAX_FALSE_FRAMES, MAX_FALSE_PLACEMENTS, Code, Reason
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan
from measure.tone.curve import Tone

# middle, given: under the prior belief about the scan, in windows about its middle or in all of it; oblique: with a
# perspective, for film that was photographed obliquely; pitch: under other pitches; faint: with narrower surroundings
# of the marks, since the frame's edge may mask a mark in wider ones, and then with those for marks in strong grain.
Kind = Literal["middle", "given", "oblique", "pitch", "faint"]
Evaluated = tuple[float, Frame]  # expected number of false frames as good

_TRIALS = 4  # placements tried at full resolution after the best one
_NOTHING = Reason("no two of the camera's marks were found in the scan", Code.NO_FRAME)
_GAINED = 3  # marks: one more than the two additional parameters of a perspective may fit by chance
_LACKED = 0.3  # fraction of the marks that an affine transformation misses if a perspective makes it miss any
_OBLIQUE = 6  # marks needed to prove a perspective: any four fit one, and two more check it
_STRETCH = 3 * AFFINITY_SIGMA  # relative error of a given pitch, where marks are too faint to correct it


@dataclass(frozen=True, eq=False)
class Stage:
    """One way to search for a frame.

    Attributes
    ----------
    kind : what is searched, and how a frame is tested.
    hypotheses : about the pitch.
    options : with the film deformation model.
    surroundings : of the marks in the search.
    at_given : whether the hypotheses are under the given pitch.
    tone : initial tone curve, None for the scan's own. The hypotheses are counted already if there is one.
    """

    kind: Kind
    hypotheses: Hypotheses
    options: FiducialOptions
    surroundings: Surroundings = WIDE
    at_given: bool = False
    tone: Tone | None = None

    @property
    def is_given(self) -> bool:
        """Whether its result replaces an earlier one, taken or not."""
        return self.kind in ("middle", "given")

    def is_unnecessary(self, found: "Found") -> bool:
        """Whether the earlier results make it unnecessary."""
        frame = found.frame if found.is_taken else None
        if self.tone is not None:
            # Another curve may cure fits that failed, and marks in their places that are unlike their drawings.
            return found.is_taken or found.frame is None or not (found.frame.failed_fits or found.frame.agrees)
        if self.kind == "faint":
            return found.is_taken
        if self.kind == "given":
            return found.frame is not None and found.frame.is_complete
        if self.kind == "oblique":
            # Weak marks do not count as missing: a perspective displaces marks, but leaves their quality unchanged.
            return frame is not None and frame.inside - len(frame.inlier_fits) < max(_GAINED, _LACKED * frame.inside)
        is_found = frame is not None and (frame.is_faint or not doubt_frame(found.result, frame))
        return self.kind == "pitch" and is_found


@dataclass(frozen=True, eq=False)
class Found:
    """Result of the stages so far.

    Attributes
    ----------
    result : placements of the stage that found the frame.
    frame : best frame so far, None without one.
    is_taken : whether the frame is accepted as significant.
    unsure : frames found only under another pixel pitch; possible false alarms, accepted if the user gives that pitch.
    faint : expected number of false alarms and the best rejected frame.
    misfit : why no frame was found.
    """

    result: SearchResult = field(default_factory=SearchResult)
    frame: Frame | None = None
    is_taken: bool = False
    unsure: tuple[Frame, ...] = ()
    faint: Evaluated | None = None
    misfit: Reason = _NOTHING


def list_stages(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Stage]:
    """List the stages in order. pitch_um: given by the user or the file, None if unknown."""
    given, *others = pitch_hypotheses(scan, layout, pitch_um, options)
    near, nearly = ([], given) if pitch_um is None else slightly_longer(given[0], _STRETCH)
    is_given = pitch_um is not None and not options.part
    in_windows = is_given and is_searched_by_windows(scan, layout, given[0].mm)
    may_be_oblique = options.film_model == "affine" and len(layout.marks) >= _OBLIQUE
    oblique = replace(options, film_model="projective")
    return [
        *([Stage("middle", given, options)] if in_windows else []),
        Stage("given", given, options),
        *(Stage("given", given, options, tone=tone) for tone in scan.tone.starting_curves),
        *([Stage("oblique", given, oblique, at_given=True)] if may_be_oblique else []),
        *(Stage("pitch", group, options) for group in others),
        *(
            Stage("faint", group, options, surroundings, group is near)
            for surroundings in (CLOSE, GRAINY)
            for group in (near, nearly)
            if group
        ),
    ]


def find_frame(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> Found:
    """Find the frame of a scan. pitch_um: given by the user or the file, None if unknown."""
    stages = list_stages(scan, layout, pitch_um, options)
    search, result = FrameSearch(scan, layout, options), SearchResult()
    found, hypotheses_so_far, hypotheses_at_given_pitch = Found(), 0, 0
    for stage in stages:
        if stage.is_unnecessary(found):
            continue
        if stage.tone is None:
            hypotheses_so_far += len(stage.hypotheses)
            hypotheses_at_given_pitch += len(stage.hypotheses) if stage.is_given or stage.at_given else 0
            result = search_stage(search, stage)
        tried = hypotheses_at_given_pitch if stage.at_given else hypotheses_so_far
        start = scan if stage.tone is None else scan.replace_tone(stage.tone)
        frames = measure_stage(start, layout, stage, result, tried)
        expected, frame = frames[0] if frames else (np.inf, None)
        if expected <= MAX_FALSE_FRAMES:
            found = replace(found, result=result, frame=frame, is_taken=True)
        elif stage.is_given:
            if stage.tone is None or (frame is not None and frame.is_nearer_than(found.frame)):
                misfit = explain_misfit(frame) if frame else _NOTHING
                found = replace(found, result=result, frame=frame, is_taken=False, misfit=misfit)
        else:
            share = hypotheses_at_given_pitch / tried
            likely = [] if stage.at_given else [each for each in frames if _is_accepted_at_given_pitch(each, share)]
            rejected = [each for each in (found.faint, *frames) if each and each not in likely]
            unsure = (*found.unsure, *(frame for _, frame in likely))
            found = replace(found, unsure=unsure, faint=min(rejected, key=itemgetter(0), default=None))
    if found.is_taken:
        return found
    what_to_do = _pitch_to_try(found.unsure) or _too_faint(found.faint)
    return replace(found, frame=None, misfit=found.misfit.reword(found.misfit + what_to_do))


def search_stage(search: FrameSearch, stage: Stage) -> SearchResult:
    """Find the placements of a stage."""
    if stage.kind == "middle":
        return search.search_middle(stage.options, stage.hypotheses)
    return search.search_scan(stage.options, stage.hypotheses, stage.surroundings)


def measure_stage(
    scan: Scan, layout: FiducialLayout, stage: Stage, result: SearchResult, tried: int
) -> list[Evaluated]:
    """Measure the frame in the likely placements, and estimate the expected number of false frames as good.

    An accepted frame of the prior belief needs no such test. A perspective has to fit nearly all marks, and only
    unblemished ones count. Under another pitch, and of faint marks, the significance of the frame decides: its marks
    need not be clear, only agree. `tried`, the number of hypotheses so far, limits which placements are measured.
    Placements under another tone curve or pitch are measured only if some marks are clear there.
    """
    kind, options, found = stage.kind, stage.options, result.placements
    places = _places_to_try(found[:1] if kind in ("middle", "oblique") else found)
    if kind in ("pitch", "faint"):
        number = tried if kind == "faint" else len(stage.hypotheses)
        places = [each for each in places if number * false_placements(result, each) <= MAX_FALSE_PLACEMENTS]
    if kind == "pitch" or stage.tone is not None:
        places = [each for each in places if shows_marks(scan, layout, each, options)]
    least = _OBLIQUE, _GAINED - 1  # marks in all, and missing ones, for a perspective
    if kind == "oblique":
        places = [each for each in places if each.supported >= max(least[0], len(layout.marks) - least[1])]
    measured = (measure_frame(scan, layout, each, options) for each in places)
    if stage.is_given:
        frame = best_frame(measured, max((each.supported for each in places), default=0), result)
        return [] if frame is None else [(0.0 if frame.accepted else np.inf, frame)]
    if kind == "oblique":
        frames = (frame for frame in measured if frame.accepted)
        frames = (frame for frame in frames if frame.measured_count >= max(least[0], frame.inside - least[1]))
        evaluated = [(tried * false_frames(result, frame, frame.unblemished), frame) for frame in frames]
    else:
        evaluated = [each for frame in measured if (each := _evaluate(frame, result, tried))]
    return sorted(evaluated, key=itemgetter(0))


def best_frame(measured: Iterable[Frame], most_supported: int, result: SearchResult) -> Frame | None:
    """Select one of the frames that are measured in some placements; no more are measured than needed.

    Selected is the first frame that is sure and not outdone by a placement with more supporting marks; else the sure
    frame with most measured marks; else the first accepted one; else one whose fits failed; else by inliers. Frames
    whose marks are all among those of an accepted frame tried before are skipped.
    """
    frames = list[Frame]()
    for frame in measured:
        if any(before.accepted and before.contains(frame) for before in frames):
            continue
        if frame.is_sure and not (most_supported > frame.measured_count and doubt_frame(result, frame)):
            return frame
        frames.append(frame)
    return max(frames, key=_preference, default=None)


def _preference(frame: Frame) -> tuple[int, ...]:
    """Order of frames that may be doubted: sure ones, accepted ones, those that another tone curve may cure."""
    if frame.is_sure:
        return 2, frame.measured_count
    return (1, 0) if frame.accepted else (0, bool(frame.failed_fits), int(frame.inliers.sum()))


def _evaluate(frame: Frame, result: SearchResult, tried: int) -> Evaluated | None:
    """Evaluate a frame, also in its likeliest pose: names of other poses would hide its marks."""
    placement, frames = frame.placement, [frame]
    if frame.options.pose == "auto" and frame.inliers.any():
        pose = decide_pose(frame).name
        frames += [] if pose == placement.pose else [rename_frame(frame.scan, frame, pose)]
    frames = [each for each in frames if each.agrees]
    if not frames:
        return None
    # By the measured marks, or by the responses at reduced resolution: the smaller counts, times two for two criteria.
    as_measured = min(false_frames(result, each, each.inlier_fits) for each in frames)
    most = max(frames, key=lambda each: each.inliers.sum())
    return 2 * tried * min(as_measured, false_placements(result, placement)), most


def _is_accepted_at_given_pitch(evaluated: Evaluated, share: float) -> bool:
    """Whether a frame would be accepted if its pitch were given. share: of the hypotheses under the given pitch."""
    return evaluated[1].accepted or evaluated[0] * share <= MAX_FALSE_FRAMES


def _places_to_try(found: Sequence[Placement]) -> list[Placement]:
    """Best placement, then others elsewhere by score times supporting marks: a few high peaks alone are often false."""
    others = sorted(found[1:], key=lambda placement: -placement.score * placement.supported)
    return distinct_places((*found[:1], *others), _TRIALS + 1)


def explain_misfit(frame: Frame) -> Reason:
    """Explain why a frame is not accepted."""
    found = f"{len(frame.inlier_fits)} of {len(frame.detections)} marks were found where the others put them"
    if frame.agrees:
        return Reason(
            f"{found}, but only {len(frame.clear_fits)} of them match their drawings, where {frame.least} have "
            "to: compare the drawings with the scan, or set its tone curve (tone under [measure])",
            Code.NO_FRAME,
        )
    if frame.failed_fits:
        names = ", ".join(frame.layout.marks[index].id for index in frame.failed_fits)
        return Reason(
            f"only {found}, and the fit of {names} did not converge, with whatever tone curve it began", Code.NO_FIT
        )
    return Reason(f"the constellation does not fit: only {found}{_marks_outside(frame)}", Code.NO_FRAME)


def _marks_outside(frame: Frame) -> str:
    """Clause on marks predicted outside the scan; empty if there are none."""
    outside = [
        mark.id
        for mark, detection in zip(frame.layout.marks, frame.detections, strict=True)
        if Code.OUTSIDE in detection.reason.codes
    ]
    if not outside or frame.inliers.sum() < 2:
        return ""
    return (
        f", and these put {', '.join(outside)} outside of the scan: scan the whole frame, or say by part_of in "
        "images.csv that this scan is a part of it"
    )


def _pitch_to_try(unsure: Sequence[Frame]) -> str:
    """Clause on the best of the possible false alarms, with the pitch to try; empty without one."""
    if not unsure:
        return ""
    best = max(unsure, key=lambda frame: (frame.measured_count, int(frame.inliers.sum())))
    pair = ", ".join(f"{um:.2f}" for um in 1000 / np.hypot(*best.pixel_from_camera[:, :2].T))
    agreeing = f"under another pitch {int(best.inliers.sum())} of them fit, which may be a false alarm"
    return f"; {agreeing}: try pitch_um = [{pair}]"


def _too_faint(likeliest: Evaluated | None) -> str:
    """Clause on a rejected frame with less than one expected false alarm; empty otherwise."""
    if likeliest is None or likeliest[0] >= 1:
        return ""
    expected, frame = likeliest
    return (
        f"; {int(frame.inliers.sum())} faint marks fit, where {expected:.1g} such false alarms are expected: another "
        "pitch does not separate them; click the visible marks in `reseau review`"
    )
