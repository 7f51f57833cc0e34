"""Search for a frame as a list of attempts, which differ in region, pitch, tone curve and treatment of the background.

A single loop makes the attempts in order and skips those that an earlier result makes unnecessary. One criterion
accepts a frame: the expected number of false frames in all attempts so far, or in those under the given pitch alone,
which is likelier than all others together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from measure.annotations.fields import Line
from measure.detection.correlation import CLOSE, GRAINY
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import measure_frame, rename_frame
from measure.fiducials.options import AFFINITY_SIGMA, FiducialOptions
from measure.fiducials.scan_orientation import decide_pose
from measure.fiducials.search import FrameSearch, Hypotheses, is_searched_by_windows, slightly_longer
from measure.fiducials.significance import doubt_frame, false_frames
from measure.flags import FRAMES_BY_CHANCE, PLACEMENTS_BY_CHANCE, Code, Reason
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout
from measure.results import Pose
from measure.scans.scan import Scan

# Placements, best first; frames in order of preference, each with the expected number of false frames as good.
Result = tuple[list[Placement], list[tuple[float, Frame]]]

_TRIALS = 4  # placements tried at full resolution after the best one
_NOTHING = Reason("no two of the camera's marks were found in the scan", Code.NO_FRAME)
_GAINED = 3  # marks: one more than the two additional parameters of a perspective may fit by chance
_LACKED = 0.3  # fraction of the marks that an affine transformation misses if a perspective makes it miss any
_OBLIQUE = 6  # marks needed to prove a perspective: any four fit one, and two more check it
_STRETCH = 3 * AFFINITY_SIGMA  # relative error of a given pitch, where marks are too faint to correct it


@dataclass(frozen=True, eq=False)
class Found:
    """Result of the attempts so far.

    Attributes
    ----------
    search : of the attempt that found the frame.
    placements : of that attempt, best first.
    frame : best frame so far, None without one.
    is_taken : whether the frame is accepted as significant.
    unsure : frames found only under another pixel pitch; possible false alarms, accepted if the user gives that pitch.
    faint : expected number of false alarms and the best rejected frame.
    misfit : why no frame was found.
    """

    search: FrameSearch
    placements: Sequence[Placement] = ()
    frame: Frame | None = None
    is_taken: bool = False
    unsure: tuple[Frame, ...] = ()
    faint: tuple[float, Frame] | None = None
    misfit: Reason = _NOTHING

    @property
    def is_complete(self) -> bool:
        return self.frame is not None and self.frame.is_complete

    @property
    def lacks_few_marks(self) -> bool:
        """Whether the frame is taken and misses fewer marks than one on film that was photographed obliquely.

        Weak marks do not count as missing: a perspective displaces marks, but leaves their quality unchanged.
        """
        if self.frame is None or not self.is_taken:
            return False
        return self.frame.inside - int(self.frame.inliers.sum()) < max(_GAINED, _LACKED * self.frame.inside)

    @property
    def is_undoubted(self) -> bool:
        return self.is_taken and self.frame is not None and not doubt_frame(self.search, self.frame)


@dataclass(frozen=True, eq=False)
class Attempt:
    """One way to search for a frame.

    Attributes
    ----------
    search : search in the scan.
    hypotheses : about the pitch.
    find : function of the search, the hypotheses and the total number of hypotheses tried; returns a Result.
    is_settled : whether the earlier results make the attempt unnecessary.
    is_given : under the prior belief about the scan; its result replaces an earlier one, taken or not.
    at_given : under the given pitch.
    first : attempt that this one repeats from another initial tone curve; its placements are no further hypotheses.
    """

    search: FrameSearch
    hypotheses: Hypotheses
    find: Callable[[FrameSearch, Hypotheses, int], Result]
    is_settled: Callable[[Found], bool]
    is_given: bool = False
    at_given: bool = False
    first: "Attempt | None" = None


def find_frame(
    scan: Scan, layout: FiducialLayout, hypotheses: Sequence[Hypotheses], is_given: bool, options: FiducialOptions
) -> Found:
    """Find the frame of a scan.

    Parameters
    ----------
    hypotheses : about the pitch, likelier groups first.
    is_given : whether the user or the file gives the pitch of the first group.
    """
    found, every, at_given = Found(FrameSearch(scan, layout, options)), 0, 0
    ids = [mark.id for mark in layout.marks]
    for attempt in _attempts(found.search, hypotheses, is_given):
        if attempt.is_settled(found):
            continue
        if attempt.first is None:
            every += len(attempt.hypotheses)
            at_given += len(attempt.hypotheses) if attempt.is_given or attempt.at_given else 0
        tried = at_given if attempt.at_given else every
        placements, frames = attempt.find(attempt.search, attempt.hypotheses, tried)
        expected, frame = frames[0] if frames else (np.inf, None)
        if expected <= FRAMES_BY_CHANCE:
            found = replace(found, search=attempt.search, placements=placements, frame=frame, is_taken=True)
        elif attempt.is_given:
            if attempt.first is None or (frame is not None and frame.is_nearer_than(found.frame)):
                misfit = frame.misfit(ids) if frame else _NOTHING
                found = replace(found, placements=placements, frame=frame, is_taken=False, misfit=misfit)
        else:
            likely = [each for each in frames if _is_taken_if_given(each, attempt, at_given / tried)]
            rejected = [each for each in (found.faint, *frames) if each and each not in likely]
            unsure = (*found.unsure, *(frame for _, frame in likely))
            found = replace(found, unsure=unsure, faint=min(rejected, key=itemgetter(0), default=None))
    if found.is_taken:
        return found
    what_to_do = _pitch_to_try(found.unsure) or _too_faint(found.faint)
    return replace(found, frame=None, misfit=found.misfit.reword(found.misfit + what_to_do))


def _is_taken_if_given(result: tuple[float, Frame], attempt: Attempt, at_given: float) -> bool:
    """Whether a frame under another pitch would be taken if that pitch were given.

    at_given: share of the hypotheses that are under the given pitch.
    """
    return not attempt.at_given and (result[1].accepted or result[0] * at_given <= FRAMES_BY_CHANCE)


def _attempts(wide: FrameSearch, hypotheses: Sequence[Hypotheses], is_given: bool) -> list[Attempt]:
    """List the attempts in order.

    1. The middle of a large scan, if the pitch is given; then the whole scan.
    2. If marks are missing: with a perspective, for film that was photographed obliquely.
    3. If the frame may be a false alarm: under other pitches.
    4. If there is no frame: with narrower surroundings of the marks, since the frame's edge may mask a mark in wider
       ones; then with surroundings for marks in strong grain.
    """
    given, *others = hypotheses
    closer = [wide.with_surroundings(surroundings) for surroundings in (CLOSE, GRAINY)]
    oblique = wide.replace_film_model("projective")
    near, nearly = slightly_longer(given[0], _STRETCH) if is_given else ([], given)
    in_windows = is_given and not wide.options.part and is_searched_by_windows(wide.scan, wide.layout, given[0].mm)
    return [
        *([Attempt(wide, given, _search_middle, lambda _: False, True)] if in_windows else []),
        *_through_tone_curves(Attempt(wide, given, _search_scan, lambda found: found.is_complete, True)),
        *(
            [Attempt(oblique, given, _search_oblique, lambda found: found.lacks_few_marks, at_given=True)]
            if wide.options.film_model == "affine" and len(wide.layout.marks) >= _OBLIQUE
            else []
        ),
        *(
            each
            for group in others
            for each in _through_tone_curves(
                Attempt(wide, group, _search_other_pitch, lambda found: found.is_undoubted)
            )
        ),
        *(  # no other tone curves here: a mark need not correlate clearly with its drawing
            Attempt(close, group, _search_closer, lambda found: found.is_taken, at_given=group is near)
            for close in closer
            for group in (near, nearly)
            if group
        ),
    ]


def _through_tone_curves(first: Attempt) -> list[Attempt]:
    """Repeat an attempt from other initial tone curves, unless a frame is taken before."""
    search = first.search
    return [
        first,
        *(
            replace(first, search=search.replace_tone(tone), is_settled=lambda found: found.is_taken, first=first)
            for tone in search.scan.tone.starting_curves
        ),
    ]


def _search_middle(search: FrameSearch, hypotheses: Hypotheses, _: int) -> Result:
    """Measure the frame in the best placement in the middle of a large scan."""
    found = search.search_middle(hypotheses[0])
    return found, _result(measure_frame(search.scan, search.layout, found[0], search.options) if found else None)


def _search_scan(search: FrameSearch, hypotheses: Hypotheses, _: int) -> Result:
    """Search the whole scan and measure the best frame; no frame without placements."""
    found = search.search_scan(hypotheses)
    return found, _result(best_frame(search, found))


def _result(frame: Frame | None) -> list[tuple[float, Frame]]:
    """Result of a search under the prior belief about the scan: an accepted frame needs no test of false alarms."""
    return [] if frame is None else [(0.0 if frame.accepted else np.inf, frame)]


def best_frame(search: FrameSearch, found: Sequence[Placement]) -> Frame | None:
    """Measure the frame in the best placements and select one.

    Selected is the first frame that is sure and not outdone by another placement; else the sure frame with most
    measured marks; else the first accepted one; else the one with most inliers. Frames whose marks are all among those
    of an accepted frame tried before are skipped.
    """
    placements, frames = _places_to_try(search, found), list[Frame]()
    for placement in placements:
        frame = _measure_in_its_pose(search, placement)
        if any(before.accepted and before.contains(frame) for before in frames):
            continue
        if frame.is_sure and not _is_outdone(search, frame, placements):
            return frame
        frames.append(frame)
    sure = [frame for frame in frames if frame.is_sure]
    if sure:
        return max(sure, key=lambda frame: frame.measured_count)
    accepted = [frame for frame in frames if frame.accepted]
    return accepted[0] if accepted else max(frames, key=lambda frame: int(frame.inliers.sum()), default=None)


def _is_outdone(search: FrameSearch, frame: Frame, placements: Sequence[Placement]) -> bool:
    """Whether another placement is supported by more marks than the frame has measured, and it may be a false alarm."""
    more = any(placement.supported > frame.measured_count for placement in placements)
    return more and bool(doubt_frame(search, frame))


def _measure_in_its_pose(search: FrameSearch, placement: Placement) -> Frame:
    """Measure the frame in a placement, and correct its pose if it is not accepted.

    At the right place in a wrong pose, marks with different drawings are not found under one another's names. The
    images of the marks then decide the pose, and the frame is measured again in it.
    """
    frame = measure_frame(search.scan, search.layout, placement, search.options)
    if frame.accepted and frame.scan.tone.sharpening:  # sharpening belongs to the scan, wherever its frame lies
        search.scan = search.scan.replace_tone(search.scan.tone.sharpened(frame.scan.tone.sharpening))
    if frame.may_settle and not frame.accepted and search.among is None:
        search.unsettled.append(placement)
    if frame.accepted or not frame.inliers.any() or search.options.pose != "auto":
        return frame
    pose = likeliest_pose(search, frame)
    if not pose.decided or pose.name == placement.pose:
        return frame
    return rename_frame(search.scan, frame, pose.name)


def _search_oblique(search: FrameSearch, hypotheses: Hypotheses, tried: int) -> Result:
    """Search for the frame on film that was photographed obliquely, in the best placement only.

    Nearly all marks in the scan have to be measured: a perspective has enough freedom to fit some marks of any frame.
    """
    found = search.search_scan(hypotheses)
    if not found or found[0].supported < max(_OBLIQUE, len(search.layout.marks) - _GAINED + 1):
        return found, []
    frame = _measure_in_its_pose(search, found[0])
    if not frame.accepted or frame.measured_count < max(_OBLIQUE, frame.inside - _GAINED + 1):
        return found, []
    return found, [(tried * false_frames(search, frame, frame.centers_px(frame.unblemished)), frame)]


def _search_other_pitch(search: FrameSearch, hypotheses: Hypotheses, tried: int) -> Result:
    """Search under other pitches than the given one; accepted frames by increasing number of false alarms.

    Only unblemished marks count, since the additional freedom yields false frames too.
    """
    found = search.search_scan(hypotheses)
    frames = [_measure_in_its_pose(search, place) for place in _likely_placements(search, found, len(hypotheses))]
    expected = [
        (tried * false_frames(search, frame, frame.centers_px(frame.unblemished)), frame)
        for frame in frames
        if frame.accepted
    ]
    return found, sorted(expected, key=itemgetter(0))


def _search_closer(search: FrameSearch, hypotheses: Hypotheses, tried: int) -> Result:
    """Search the whole scan for frames with enough inliers; by increasing number of false alarms.

    That number is estimated from the measured marks and from the responses at reduced resolution. The smaller one
    counts, times two for the two criteria. The marks need not be clear: this search decides whether there is a frame,
    not which pose it has.
    """
    found, results = search.search_scan(hypotheses), list[tuple[float, Frame]]()
    for place in _likely_placements(search, found, tried):
        frames = [frame for frame in _measure_in_likeliest_pose(search, place) if frame.agrees]
        if frames:
            as_measured = min(
                false_frames(search, frame, frame.centers_px(np.flatnonzero(frame.inliers))) for frame in frames
            )
            most = max(frames, key=lambda frame: frame.inliers.sum())
            results.append((2 * tried * min(as_measured, search.false_placements(place)), most))
    return found, sorted(results, key=itemgetter(0))


def _measure_in_likeliest_pose(search: FrameSearch, placement: Placement) -> list[Frame]:
    """Measure the frame in a placement and also in its likeliest pose.

    Faint marks are not found under one another's names, although their images do not decide the pose reliably.
    """
    frame = measure_frame(search.scan, search.layout, placement, search.options)
    if search.options.pose != "auto" or not frame.inliers.any():
        return [frame]
    pose = likeliest_pose(search, frame)
    return [frame] if pose.name == placement.pose else [frame, rename_frame(search.scan, frame, pose.name)]


def _likely_placements(search: FrameSearch, found: Sequence[Placement], tried: int) -> list[Placement]:
    """Best placement and its rivals, without those with too many expected false placements."""
    places = _places_to_try(search, found)
    return [place for place in places if tried * search.false_placements(place) <= PLACEMENTS_BY_CHANCE]


def _places_to_try(search: FrameSearch, found: Sequence[Placement]) -> list[Placement]:
    """Best placement and its rivals, restricted to those in which the search fits marks."""
    places = [*found[:1], *(_rivals(found) if found else ())]
    return places if search.among is None else [place for place in places if place in search.among]


def _rivals(found: Sequence[Placement]) -> list[Placement]:
    """Placements of the frame elsewhere, by score times supporting marks: a few high peaks alone are often false."""
    others: list[Placement] = []
    for placement in sorted(found[1:], key=lambda placement: -placement.score * placement.supported):
        if not any(placement.same_place(other) for other in (found[0], *others)):
            others.append(placement)
        if len(others) == _TRIALS:
            break
    return others


def _pitch_to_try(unsure: Sequence[Frame]) -> str:
    """Clause on the best of the possible false alarms, with the pitch to try; empty without one."""
    if not unsure:
        return ""
    best = max(unsure, key=lambda frame: (frame.measured_count, int(frame.inliers.sum())))
    pair = ", ".join(f"{um:.2f}" for um in 1000 / np.hypot(*best.pixel_from_camera[:, :2].T))
    agreeing = f"under another pitch {int(best.inliers.sum())} of them fit, which may be a false alarm"
    return f"; {agreeing}: try pitch_um = [{pair}]"


def _too_faint(likeliest: tuple[float, Frame] | None) -> str:
    """Clause on a rejected frame with less than one expected false alarm; empty otherwise."""
    if likeliest is None or likeliest[0] >= 1:
        return ""
    expected, frame = likeliest
    agreeing = f"{int(frame.inliers.sum())} faint marks fit"
    by_chance = f"where {expected:.1g} such false alarms are expected"
    return (
        f"; {agreeing}, {by_chance}: another pitch does not separate them; click the visible marks in `reseau review`"
    )


def likeliest_pose(search: FrameSearch, frame: Frame, lines: Sequence[Line] = ()) -> Pose:
    """Decide the pose of a frame from the images of its marks. lines: of writing, as further evidence."""
    placements = [frame.fitted_placement.posed(pose, frame.camera_mm) for pose in POSES]
    return decide_pose(search.scan, search.layout, placements, frame, search.options, lines)
