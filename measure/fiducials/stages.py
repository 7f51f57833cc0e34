"""Search for a frame as a list of stages, which differ in region, pitch, film model, tone curve and surroundings.

One loop makes the stages in order and skips those that an earlier result makes unnecessary. One criterion accepts a
frame: the expected number of false frames in all stages so far, or in those under the given pitch alone, whose prior
probability is above that of all others together.

A dot on a rough background resembles many specks, a cross in a ring nothing else: no single threshold fits both. The
false-alarm rate of one mark is therefore the share of other places that correlate at least as strongly as the weakest
mark found: all places of the reduced scan, or places beside the marks at full resolution.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Literal

import numpy as np

from measure.array_types import Array
from measure.detection.correlation import CLOSE, GRAINY, WIDE, Surroundings, chance_of_marks, share_of_places
from measure.fiducials.camera_recognition import find_pitch_mm
from measure.fiducials.constellation import AS_GOOD, FREE_MARKS, Placement, distinct_places, same_picture
from measure.fiducials.interior_orientation import AFFINITY_SIGMA
from measure.fiducials.measure_frame import (
    CHECKED,
    RANDOM_PLACES,
    REDUCED_PX,
    Frame,
    detect_some,
    measure_frame,
    random_matches,
    rename_frame,
)
from measure.fiducials.options import FiducialOptions
from measure.fiducials.scan_orientation import decide_scan_orientation, picture_kinds
from measure.fiducials.search import (
    FrameSearch,
    Hypotheses,
    Pair,
    SearchResult,
    at_pitch,
    false_alarms,
    false_placements,
    is_searched_by_windows,
    longer,
    pitch_hypotheses,
)
from measure.flags import (
    FRAME_DOUBT_P,
    FRAME_REJECTED_P,
    MAX_FALSE_FRAMES,
    MAX_FALSE_PLACEMENTS,
    NO_REASON,
    Code,
    Reason,
)
from measure.geometry import reduced_px, scan_px
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan
from measure.tone.curve import Tone

# middle, given: under the prior belief about the scan, in windows about its middle or in all of it; turned: in other
# orientations that score as well at the same place, since reduced responses hardly tell them; oblique: with a
# perspective, for film that was photographed obliquely; pitch: under other pitches; faint: with narrower surroundings
# of the marks, since the frame's edge may mask a mark in wider ones, and then with those for marks in strong grain.
Kind = Literal["middle", "given", "turned", "oblique", "pitch", "faint"]
Evaluated = tuple[float, Frame]  # expected number of false frames as good

_MOST = 0.6  # fraction of a lattice's marks: at half its spacing up to 0.56 of them lie on others
_TRIALS = 4  # placements tried at full resolution after the best one
_NOTHING = Reason("no two of the camera's marks were found in the scan", Code.NO_FRAME)
_LEAST_GAINED = 2  # marks: the two additional parameters of a perspective may fit one wherever it lies
_MISSED_SHARE = 0.25  # fraction of the marks that an affine transformation misses if a perspective makes it miss any
_MISSED = 2  # marks at most that may be missed under a perspective, and as many more at reduced resolution
_OBLIQUE = 6  # marks needed to prove a perspective: any four fit one, and two more check it
_SLIGHT = (-0.005, 0.005, -0.01, 0.01)  # relative stretches for faint marks, searched within narrow bounds only
_STRETCH = 3 * AFFINITY_SIGMA  # relative error of a given pitch, where marks are too faint to correct it
_CRITERIA = 3  # by which a false frame may be as good: response heights, misfit, and misfit under a stretch
_STRETCHES = np.linspace(-0.03, 0.03, 13)  # relative, of non-square pixels; a step moves marks within narrow bounds
# Expected numbers of false frames between which full resolution may change the decision.
_RARE_FRAMES, _FREQUENT_FRAMES = 1e-3, 1e6
_MOST_COUNTED = 3  # marks at most to whose false-alarm rates the share at full resolution applies
_APART = 2.0  # in search radii: beyond the response of a mark itself
_BLUR_PX = 1.0  # px, of the drawings in which orientations are compared
_LEAST_UNLIKE = 1e-6  # share of a mark's variance that its drawing leaves; has a logarithm
_SURE = 12  # inliers from which the frame is no false alarm: specks do not agree so often


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

    @property
    def asks_pitch(self) -> bool:
        """Whether its hypotheses are to tell the pitch."""
        return len({each.drawn_mm for each in self.hypotheses}) > 1

    def allows_pitch(self, pitch_mm: Pair) -> bool:
        """Whether a pitch lies within the tolerance of one of its hypotheses."""
        return any(np.abs(np.divide(pitch_mm, each.mm) - 1).max() <= each.tolerance for each in self.hypotheses)

    def is_unnecessary(self, found: "StageResult") -> bool:
        """Whether the earlier results make it unnecessary."""
        frame = found.frame if found.is_taken else None
        if frame and (self.is_given or self.at_given) and not self.allows_pitch(frame.placement.pitch_mm):
            return True
        if self.tone is not None:
            # Another curve may cure fits that failed, and marks in their places that are unlike their drawings.
            return found.is_taken or found.frame is None or not (found.frame.failed_fits or found.frame.agrees)
        if self.kind == "faint":
            return found.is_taken
        if self.kind == "given":
            best = found.frame  # taken or not: every mark is a clear inlier
            return best is not None and best.accepted and len(best.clear_fits) == len(best.inliers) >= CHECKED
        if self.kind == "oblique":
            # Weak marks do not count as missing: a perspective displaces marks, but leaves their quality unchanged.
            if frame is None:
                return False
            shown = frame.inside_count if self.options.part else len(frame.detections)
            return shown - len(frame.inlier_fits) < max(_LEAST_GAINED, _MISSED_SHARE * shown)
        return self.kind == "pitch" and found.is_taken and not found.doubt


@dataclass(frozen=True, eq=False)
class StageResult:
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

    @cached_property
    def doubt(self) -> Reason:
        """Why the frame may be a false alarm. A faint one is not tested again: it was accepted only if significant."""
        return NO_REASON if self.frame is None or self.frame.is_faint else doubt_frame(self.result, self.frame)


def list_stages(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Stage]:
    """List the stages in order. pitch_um: given by the user or the file, None if unknown."""
    given, *others = pitch_hypotheses(scan, layout, pitch_um, options)
    near, nearly = [], given
    if pitch_um is not None:
        near = [replace(given[0], tolerance=_STRETCH)]
        nearly = [longer(near[0], stretch) for stretch in _SLIGHT]
    is_given = pitch_um is not None and not options.part
    in_windows = is_given and is_searched_by_windows(scan, layout, given[0].mm)
    may_be_oblique = options.film_model == "affine" and len(layout.marks) >= _OBLIQUE
    oblique = replace(options, film_model="projective")
    return [
        *([Stage("middle", given, options)] if in_windows else []),
        Stage("given", given, options),
        *(Stage("given", given, options, tone=tone) for tone in scan.tone.starting_curves),
        Stage("turned", given, options),
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
) -> StageResult:
    """Find the frame of a scan. pitch_um: given by the user or the file, None if unknown."""
    return _find_in_stages(scan, layout, list_stages(scan, layout, pitch_um, options), options)


def find_in_negative(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> StageResult | None:
    """Find the frame of a scan that is a negative of what the layout draws; None without a significant one.

    The prior belief about the scan and other pitches without the least likely must do: scans without a frame would
    take twice as long.
    """
    shown = layout.negative
    likely = [each for each in list_stages(scan, shown, pitch_um, options) if each.tone is None]
    others = [each for each in likely if each.kind == "pitch"]
    stages = [each for each in likely if each.is_given] + others[: max(1, len(others) - 1)]
    found = _find_in_stages(scan, shown, stages, options)
    return found if found.is_taken and not found.doubt else None


class _StageSearch:
    """Search of the stages in one scan."""

    def __init__(self, scan: Scan, layout: FiducialLayout, options: FiducialOptions) -> None:
        self._scan, self._layout, self._search = scan, layout, FrameSearch(scan, layout, options)

    @cached_property
    def _shown_mm(self) -> float | None:
        """Pitch that a thumbnail of the scan shows."""
        return find_pitch_mm(self._scan, self._layout)

    def placements(self, stage: Stage) -> SearchResult:
        """Find placements under the stage's hypotheses; if they are to tell the pitch, at the one that a thumbnail
        shows."""
        if stage.kind == "middle":
            return self._search.search_middle(stage.options, stage.hypotheses)
        hypotheses = at_pitch(stage.hypotheses, self._shown_mm) if stage.asks_pitch and self._shown_mm else None
        return self._search.search_scan(stage.options, hypotheses or stage.hypotheses, stage.surroundings)

    def contradicts(self, stage: Stage, result: SearchResult) -> bool:
        """Whether a given pitch has no significant placement of most marks, and a thumbnail shows another pitch.

        At a multiple of its pitch some marks of a lattice still lie on others.
        """
        most = [each for each in result.placements[:1] if each.supported >= _MOST * len(self._layout.marks)]
        if any(false_placements(result, each) <= MAX_FALSE_FRAMES for each in most):
            return False
        return self._shown_mm is not None and not stage.allows_pitch((self._shown_mm, self._shown_mm))


def _find_in_stages(
    scan: Scan, layout: FiducialLayout, stages: Sequence[Stage], options: FiducialOptions
) -> StageResult:
    search, result, at_given = _StageSearch(scan, layout, options), SearchResult(), SearchResult()
    found, hypotheses_so_far, hypotheses_at_given_pitch = StageResult(), 0, 0
    pending = list(stages)
    while pending:
        stage = pending.pop(0)
        if stage.kind == "turned":
            found = _try_other_orientations(scan, layout, options, found)
            continue
        if stage.is_unnecessary(found):
            continue
        result = at_given if stage.tone else search.placements(stage)
        if stage.kind == "given" and stage.tone is None:
            others = [each for each in pending if each.kind == "pitch" and each.asks_pitch]
            if others and search.contradicts(stage, result):
                pending = [*others, stage, *(each for each in pending if each not in others)]
                continue
        if stage.tone is None:
            at_given = result if stage.is_given else at_given
            hypotheses_so_far += len(stage.hypotheses)
            hypotheses_at_given_pitch += len(stage.hypotheses) if stage.is_given or stage.at_given else 0
        tried = hypotheses_at_given_pitch if stage.at_given else hypotheses_so_far
        start = scan if stage.tone is None else scan.replace_tone(stage.tone)
        frames = measure_stage(start, layout, stage, result, tried)
        if stage.kind == "oblique" and found.is_taken and found.frame:
            least = len(found.frame.inlier_fits) + _LEAST_GAINED
            frames = [each for each in frames if len(each[1].unblemished) >= least]
        expected, frame = frames[0] if frames else (np.inf, None)
        if expected <= MAX_FALSE_FRAMES:
            found = replace(found, result=result, frame=frame, is_taken=True)
        elif stage.is_given:
            # Under another tone curve it has to be nearer to acceptance: more inliers, then more clear ones.
            own, before = (
                (len(each.inlier_fits), len(each.clear_fits)) if each else (-1, -1) for each in (frame, found.frame)
            )
            if stage.tone is None or own > before:
                misfit = explain_misfit(frame) if frame else _NOTHING
                found = replace(found, result=result, frame=frame, is_taken=False, misfit=misfit)
        else:
            share = max(hypotheses_at_given_pitch, 1) / tried
            # Those that would be accepted if their pitch were given.
            likely = [each for each in frames if each[1].accepted or each[0] * share <= MAX_FALSE_FRAMES]
            likely = [] if stage.at_given else likely
            rejected = [each for each in (found.faint, *frames) if each and each not in likely]
            unsure = (*found.unsure, *(frame for _, frame in likely))
            found = replace(found, unsure=unsure, faint=min(rejected, key=itemgetter(0), default=None))
    if found.is_taken:
        return found
    # Its placements and frames would take up memory while a negative is searched for.
    return StageResult(misfit=found.misfit.reword(found.misfit + _what_to_do(found)))


def _try_other_orientations(
    scan: Scan, layout: FiducialLayout, options: FiducialOptions, found: StageResult
) -> StageResult:
    """Measure a frame that is not sure, but has a clear mark, in other orientations that score as well at its place."""
    frame = found.frame
    if frame is None or frame.is_sure or not frame.clear_fits:
        return found
    best = frame.placement if found.is_taken else found.result.placements[0]
    start = frame.scan if found.is_taken else scan
    turned = (measure_frame(start, layout, each, options) for each in _rival_orientations(found.result, best, frame))
    most = max((frame, *turned), key=_match)
    return replace(found, frame=most, is_taken=True) if most.accepted and most is not frame else found


def _rival_orientations(result: SearchResult, best: Placement, frame: Frame) -> list[Placement]:
    """Placements at the place of the best one in orientations with other pictures that score as well."""
    marks, search = frame.layout.marks, result.searches[best.pitch_mm]
    scan_from_up = np.diag((1.0, -1.0) / np.asarray(best.pitch_mm))
    shown = {best.pose: best}
    for other in result.placements:
        if other.same_place(best) and other.score >= AS_GOOD * best.score:
            shown.setdefault(other.pose, other)
    kinds = picture_kinds([each.mark for each in marks], list(shown), scan_from_up, _BLUR_PX)
    distinct = list[str]()
    for own in kinds.items():
        known = ((pose, kinds[pose]) for pose in distinct)
        if not any(same_picture(marks, each, own, search.same_mm) for each in known):
            distinct.append(own[0])
    return [shown[pose] for pose in distinct[1:]]


def _match(frame: Frame) -> tuple[bool, int, float]:
    """Order of frames at one place: accepted ones, with more marks, that match their drawings better."""
    unlike = [1 - fit.likeness**2 for fit in frame.inlier_fits.values()]
    return frame.accepted, len(frame.inlier_fits), -float(np.log(np.maximum(unlike, _LEAST_UNLIKE)).sum())


def measure_stage(
    scan: Scan, layout: FiducialLayout, stage: Stage, result: SearchResult, tried: int
) -> list[Evaluated]:
    """Measure the frame in the likely placements, and estimate the expected number of false frames as good.

    An accepted frame of the prior belief needs no such test. A perspective has to fit nearly all marks, and only
    unblemished ones count. Under another pitch, and of faint marks, the significance of the frame decides: its marks
    need not be clear, only agree. `tried`, the number of hypotheses so far, limits which placements are measured.
    Placements under another tone curve or pitch that are not significant themselves are measured only if some marks
    are clear there.
    """
    kind, options, found = stage.kind, stage.options, result.placements
    begun = dict[Placement, Frame]()
    # The best placement, then others elsewhere by score times supporting marks: a few high peaks alone are often false.
    others = [] if kind == "middle" else sorted(found[1:], key=lambda each: -each.score * each.supported)
    places = distinct_places((*found[:1], *others), _TRIALS + 1)
    significant = list[Placement]()
    if kind in ("pitch", "faint"):
        number = tried if kind == "faint" else len(stage.hypotheses)
        expected = {each: number * false_placements(result, each) for each in places}
        places = [each for each in places if expected[each] <= MAX_FALSE_PLACEMENTS]
        significant = [each for each in places if expected[each] <= MAX_FALSE_FRAMES]
    if kind == "pitch" or stage.tone is not None:
        every, unsure = range(len(layout.marks)), [each for each in places if each not in significant]
        begun = {each: frame for each in unsure if (frame := detect_some(scan, layout, each, options, every))}
        places = [each for each in places if each in significant or each in begun]
    if kind == "oblique":
        needed = max(_OBLIQUE, len(layout.marks) - _MISSED)
        places = [each for each in places if each.supported >= needed - _MISSED]
    measured = (measure_frame(scan, layout, each, options, begun.get(each)) for each in places)
    if stage.is_given:
        frame = best_frame(measured, max((each.supported for each in places), default=0), result)
        return [] if frame is None else [(0.0 if frame.accepted else np.inf, frame)]
    if kind == "oblique":
        frames = (frame for frame in measured if frame.accepted)
        frames = (frame for frame in frames if len(frame.unblemished) >= max(_OBLIQUE, frame.inside_count - _MISSED))
        evaluated = [(tried * false_frames(result, frame, frame.unblemished), frame) for frame in frames]
    else:
        evaluated = [each for frame in measured if (each := _evaluate(frame, result, tried))]
    return sorted(evaluated, key=_rank)


def _rank(evaluated: Evaluated) -> tuple[float, float]:
    """Order of frames: of significant ones, most marks first; they may be a lattice named one step off, of whose fewer
    marks in the scan a larger share is found."""
    expected, frame = evaluated
    return (-len(frame.inlier_fits), expected) if expected <= MAX_FALSE_FRAMES else (expected, 0.0)


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
        if frame.is_sure and not (most_supported > len(frame.unblemished) and doubt_frame(result, frame)):
            return frame
        frames.append(frame)
    return max(frames, key=_preference, default=None)


def _preference(frame: Frame) -> tuple[int, ...]:
    """Order of frames that may be doubted: sure ones, accepted ones, those that another tone curve may cure."""
    if frame.is_sure:
        return 2, len(frame.unblemished)
    return (1, 0) if frame.accepted else (0, bool(frame.failed_fits), int(frame.inliers.sum()))


def _evaluate(frame: Frame, result: SearchResult, tried: int) -> Evaluated | None:
    """Evaluate a frame, also in its likeliest pose: names of other poses would hide its marks."""
    placement, frames = frame.placement, [frame]
    if frame.options.pose == "auto" and frame.inliers.any():
        pose = decide_scan_orientation(frame).name
        frames += [] if pose == placement.pose else [rename_frame(frame, pose)]
    frames = [each for each in frames if each.agrees]
    if not frames:
        return None
    # By the measured marks, or by the responses at reduced resolution: the smaller counts, times two for two criteria.
    as_measured = min(false_frames(result, each, each.inlier_fits) for each in frames)
    most = max(frames, key=lambda each: each.inliers.sum())
    return 2 * tried * min(as_measured, false_placements(result, placement)), most


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
        return Reason(f"only {found}, and the fit of {names} did not converge from any initial tone curve", Code.NO_FIT)
    pairs = zip(frame.layout.marks, frame.detections, strict=True)
    outside = [mark.id for mark, detection in pairs if Code.OUTSIDE in detection.reason.codes]
    if outside and frame.inliers.sum() >= 2:
        found += (
            f", and these put {', '.join(outside)} outside of the scan: scan the whole frame, or say by part_of in "
            "images.csv that this scan is a part of it"
        )
    return Reason(f"the constellation does not fit: only {found}", Code.NO_FRAME)


def _what_to_do(found: StageResult) -> str:
    """Clause on the best of the possible false alarms, with the pitch to try, or on a rejected frame with less than one
    expected false alarm; empty without either."""
    if found.unsure:
        best = max(found.unsure, key=lambda frame: (len(frame.unblemished), int(frame.inliers.sum())))
        pair = ", ".join(f"{um:.2f}" for um in 1000 / np.hypot(*best.pixel_from_camera[:, :2].T))
        agreeing = f"under another pitch {int(best.inliers.sum())} of them fit, which may be a false alarm"
        return f"; {agreeing}: try pitch_um = [{pair}]"
    expected, frame = found.faint or (np.inf, None)
    if frame is None or expected >= 1:
        return ""
    return (
        f"; {int(frame.inliers.sum())} faint marks fit, where {expected:.1g} such false alarms are expected: another "
        "pitch does not separate them; click the visible marks in `reseau review`"
    )


def false_frames(result: SearchResult, frame: Frame, indices: Iterable[int]) -> float:
    """Expected number of false frames as good in the scan as one with marks, by index, found where they were fitted.

    Null hypothesis: detections are uniform within the search tolerance. Many places respond as strongly at reduced
    resolution, but few of them at full resolution: the number is multiplied by their share to the power of at most
    `_MOST_COUNTED` marks.
    """
    placement, found_px = frame.placement, {index: frame.inlier_fits[index].center_px for index in indices}
    widest_px = result.searches[placement.pitch_mm].tolerance_px
    at_reduced = false_alarms(result, placement, found_px, frame.inside_count, widest_px)
    if placement.reduction == 1 or not _RARE_FRAMES < at_reduced < _FREQUENT_FRAMES:
        return at_reduced
    return at_reduced * _share_at_full_resolution(result, frame, found_px) ** min(_MOST_COUNTED, len(found_px))


def _share_at_full_resolution(result: SearchResult, frame: Frame, found_px: Mapping[int, Array]) -> float:
    """Share of the places with responses as strong at reduced resolution that also have them at full resolution."""
    marks_px, apart_px = np.array([*found_px.values()]), _APART * frame.first_search_px
    search = result.searches[frame.placement.pitch_mm]
    others = list[tuple[int, Array]]()
    for index, own in found_px.items():
        responses, key = search.responses, search.key(frame.placement, index)
        height = responses.dilated(key, search.tolerance_px).height(reduced_px(own, responses.reduction))
        candidates = responses.candidates(key)
        as_high = candidates[responses.highest_about(key, candidates, 0.0)[1] >= height]
        as_good = scan_px(as_high, responses.reduction)
        compared = as_good[: RANDOM_PLACES // len(found_px)]
        others += [(index, place) for place in compared if np.hypot(*(marks_px - place).T).min() > apart_px]
    heights, blur_px = frame.fitted_peaks(found_px)
    weakest, radius_px = min(heights.values()), REDUCED_PX * frame.placement.reduction
    hits = sum(frame.peak(index, place, radius_px, blur_px).height >= weakest for index, place in others)
    return share_of_places(hits, len(others))


def doubt_frame(result: SearchResult, frame: Frame) -> Reason:
    """Test whether a frame may be a false alarm.

    If some marks were not found, by the correlation beside the marks: two marks fit any similarity, and a frame in
    doubt needs more that no random place matches. Otherwise by the expected number of false frames.

    Returns
    -------
    Reason
        Empty if the frame is significant. Contains the code no-frame if it is likely a false alarm.
    """
    if len(frame.inlier_fits) >= _SURE:
        return NO_REASON
    inside = frame.inside_count
    # A mark searched only where the others predict it is no independent evidence.
    clear = [index for index in frame.clear_fits if not frame.detections[index].closer]
    if len(clear) < inside:
        matches, places = random_matches(frame, clear)
        hits = max(matches.values(), default=places)
        p_value = float(chance_of_marks(len(clear) - FREE_MARKS, inside - FREE_MARKS, share_of_places(hits, places)))
        if p_value <= FRAME_DOUBT_P:
            return NO_REASON
        unmatched = sum(each == 0 for each in matches.values())
        return Reason(
            f"only {len(clear)} of {inside} marks were found, and {hits} of {places} random places match "
            f"as well (p = {p_value:.2f}): the frame may lie elsewhere",
            *(
                (Code.CHANCE, Code.NO_FRAME)
                if p_value > FRAME_REJECTED_P or unmatched < frame.least
                else (Code.CHANCE,)
            ),
        )
    if len(clear) <= FREE_MARKS or not result.is_exhaustive(frame.placement):
        return NO_REASON
    expected = false_frames(result, frame, clear)
    if expected <= FRAME_DOUBT_P:
        return NO_REASON
    return Reason(
        f"so many places of the scan match the {len(clear)} marks found that {expected:.2g} such false alarms are "
        "expected in it; the frame may lie elsewhere",
        Code.CHANCE,
    )
