"""Search for a frame as a list of attempts, which differ in region, pitch, film model, tone curve and
surroundings.

One loop makes the attempts in order and skips those that an earlier result makes unnecessary. One criterion accepts a
frame: the expected number of false frames in all attempts so far, or in those under the given pitch alone, which is
likelier than all others together.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Literal

import numpy as np
from scipy.special import bdtrc

from measure.annotations.lines import Line
from measure.array_types import Array
from measure.detection.correlation import CLOSE, GRAINY
from measure.detection.localisation import highest_peak
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import measure_frame, rename_frame, shows_marks
from measure.fiducials.options import AFFINITY_SIGMA, FiducialOptions
from measure.fiducials.scan_orientation import decide_pose
from measure.fiducials.search import FrameSearch, Hypotheses, is_searched_by_windows, slightly_longer
from measure.flags import FRAME_BY_CHANCE, FRAMES_BY_CHANCE, NO_FRAME, NO_REASON, PLACEMENTS_BY_CHANCE, Code, Reason
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout
from measure.results import Pose
from measure.scans.scan import Scan

# middle, given: under the prior belief about the scan, in windows about its middle or in all of it; oblique: with a
# perspective, for film that was photographed obliquely; pitch: under other pitches; faint: with narrower surroundings
# of the marks, since the frame's edge may mask a mark in wider ones, and then with those for marks in strong grain.
Kind = Literal["middle", "given", "oblique", "pitch", "faint"]
Result = tuple[Sequence[Placement], list[tuple[float, Frame]]]  # best first; frames with expected false alarms

_TRIALS = 4  # placements tried at full resolution after the best one
_NOTHING = Reason("no two of the camera's marks were found in the scan", Code.NO_FRAME)
_GAINED = 3  # marks: one more than the two additional parameters of a perspective may fit by chance
_LACKED = 0.3  # fraction of the marks that an affine transformation misses if a perspective makes it miss any
_OBLIQUE = 6  # marks needed to prove a perspective: any four fit one, and two more check it
_STRETCH = 3 * AFFINITY_SIGMA  # relative error of a given pitch, where marks are too faint to correct it
_SELDOM, _HOPELESS = 1e-3, 1e6  # expected false frames between which full resolution may change the decision
_COUNTED = 3  # marks at most to whose false-alarm rates the share at full resolution applies
_PLACES = 64  # compared beside the marks: enough to test three marks found of four
_OFFSETS = (2.5, 4.5)  # in search radii: beyond the response of the mark itself
_FREE = 2  # marks that a similarity fits wherever they lie
_SURE = 12  # inliers from which the frame is no false alarm: specks do not agree so often
_FITTED_PX = 3.0  # px, largest distance between the fitted place and the correlation peak
_REDUCED_PX = 1.5  # px of the reduced scan: largest distance between the peaks at reduced and full resolution
_APART = 2.0  # in search radii: beyond the response of a mark itself


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


@dataclass(frozen=True, eq=False)
class Attempt:
    """One way to search for a frame.

    Attributes
    ----------
    kind : what is searched, and how a frame is tested.
    search : in the scan, with tone curve, film model and surroundings of the marks.
    hypotheses : about the pitch.
    at_given : whether they are under the given pitch.
    is_repeated : from another initial tone curve; the hypotheses are counted already.
    """

    kind: Kind
    search: FrameSearch
    hypotheses: Hypotheses
    at_given: bool = False
    is_repeated: bool = False

    @property
    def is_given(self) -> bool:
        """Whether its result replaces an earlier one, taken or not."""
        return self.kind in ("middle", "given")

    def is_unnecessary(self, found: Found) -> bool:
        """Whether the earlier results make it unnecessary."""
        frame = found.frame if found.is_taken else None
        if self.is_repeated:
            # Another curve may cure fits that failed, and marks in their places that are unlike their drawings.
            return found.is_taken or found.frame is None or not (found.frame.failed_fits or found.frame.agrees)
        if self.kind == "faint":
            return found.is_taken
        if self.kind == "given":
            return found.frame is not None and found.frame.is_complete
        if self.kind == "oblique":
            # Weak marks do not count as missing: a perspective displaces marks, but leaves their quality unchanged.
            return frame is not None and frame.inside - len(frame.inlier_fits) < max(_GAINED, _LACKED * frame.inside)
        return self.kind == "pitch" and frame is not None and not doubt_frame(found.search, frame)


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
    for attempt in list_attempts(found.search, hypotheses, is_given):
        if attempt.is_unnecessary(found):
            continue
        if not attempt.is_repeated:
            every += len(attempt.hypotheses)
            at_given += len(attempt.hypotheses) if attempt.is_given or attempt.at_given else 0
        tried = at_given if attempt.at_given else every
        placements, frames = make_attempt(attempt, tried)
        expected, frame = frames[0] if frames else (np.inf, None)
        if expected <= FRAMES_BY_CHANCE:
            found = replace(found, search=attempt.search, placements=placements, frame=frame, is_taken=True)
        elif attempt.is_given:
            if not attempt.is_repeated or (frame is not None and frame.is_nearer_than(found.frame)):
                misfit = frame.misfit(ids) if frame else _NOTHING
                found = replace(found, placements=placements, frame=frame, is_taken=False, misfit=misfit)
        else:
            likely = [] if attempt.at_given else [each for each in frames if _is_taken_if_given(each, at_given / tried)]
            rejected = [each for each in (found.faint, *frames) if each and each not in likely]
            unsure = (*found.unsure, *(frame for _, frame in likely))
            found = replace(found, unsure=unsure, faint=min(rejected, key=itemgetter(0), default=None))
    if found.is_taken:
        return found
    what_to_do = _pitch_to_try(found.unsure) or _too_faint(found.faint)
    return replace(found, frame=None, misfit=found.misfit.reword(found.misfit + what_to_do))


def list_attempts(wide: FrameSearch, hypotheses: Sequence[Hypotheses], is_given: bool) -> list[Attempt]:
    """List the attempts in order. That of the whole scan may be repeated from other tone curves."""
    given, *others = hypotheses
    near, nearly = slightly_longer(given[0], _STRETCH) if is_given else ([], given)
    in_windows = is_given and not wide.options.part and is_searched_by_windows(wide.scan, wide.layout, given[0].mm)
    may_be_oblique = wide.options.film_model == "affine" and len(wide.layout.marks) >= _OBLIQUE
    return [
        *([Attempt("middle", wide, given)] if in_windows else []),
        Attempt("given", wide, given),
        *(
            Attempt("given", wide.replace_tone(tone), given, is_repeated=True)
            for tone in wide.scan.tone.starting_curves
        ),
        *([Attempt("oblique", wide.replace_film_model("projective"), given, True)] if may_be_oblique else []),
        *(Attempt("pitch", wide, group) for group in others),
        *(
            Attempt("faint", wide.with_surroundings(surroundings), group, group is near)
            for surroundings in (CLOSE, GRAINY)
            for group in (near, nearly)
            if group
        ),
    ]


def make_attempt(attempt: Attempt, tried: int) -> Result:
    """Search, measure the frame in the likely placements, and estimate the expected number of false frames as good.

    An accepted frame of the prior belief needs no such test. Under another pitch or film model only unblemished marks
    count, since the additional freedom yields false frames too; a perspective has to fit nearly all marks. Faint marks
    need not be clear, only agree: `tried`, the number of hypotheses so far, limits which placements are measured.
    Placements under another tone curve or pitch are measured only if some marks are clear there.
    """
    search, hypotheses, kind = attempt.search, attempt.hypotheses, attempt.kind
    found = search.search_middle(hypotheses[0]) if kind == "middle" else search.search_scan(hypotheses)
    if attempt.is_given:
        places = _places_to_try(found[:1] if kind == "middle" else found)
        if attempt.is_repeated:
            places = _showing_marks(search, places)
        frame = best_frame(search, places)
        return found, [] if frame is None else [(0.0 if frame.accepted else np.inf, frame)]
    if kind == "faint":
        results = [_faint_frame(search, place, tried) for place in _likely_placements(search, found, tried)]
        return found, sorted((each for each in results if each is not None), key=itemgetter(0))
    if kind == "oblique":
        most = max(_OBLIQUE, len(search.layout.marks) - _GAINED + 1)
        places = [place for place in found[:1] if place.supported >= most]
    else:
        places = _showing_marks(search, _likely_placements(search, found, len(hypotheses)))
    frames = [frame for frame in (_measure(search, place) for place in places) if frame.accepted]
    if kind == "oblique":
        frames = [frame for frame in frames if frame.measured_count >= max(_OBLIQUE, frame.inside - _GAINED + 1)]
    expected = [(tried * false_frames(search, frame, frame.unblemished), frame) for frame in frames]
    return found, sorted(expected, key=itemgetter(0))


def _is_taken_if_given(result: tuple[float, Frame], at_given: float) -> bool:
    """Whether a frame would be taken if its pitch were given. at_given: share of the hypotheses under the given one."""
    return result[1].accepted or result[0] * at_given <= FRAMES_BY_CHANCE


def best_frame(search: FrameSearch, places: Sequence[Placement]) -> Frame | None:
    """Measure the frame in some placements and select one.

    Selected is the first frame that is sure and not outdone by a placement with more supporting marks; else the sure
    frame with most measured marks; else the first accepted one; else one whose fits failed; else by inliers. Frames
    whose marks are all among those of an accepted frame tried before are skipped.
    """
    frames = list[Frame]()
    for placement in places:
        frame = _measure(search, placement)
        if any(before.accepted and before.contains(frame) for before in frames):
            continue
        is_outdone = any(place.supported > frame.measured_count for place in places)
        if frame.is_sure and not (is_outdone and doubt_frame(search, frame)):
            return frame
        frames.append(frame)
    return max(frames, key=_preference, default=None)


def _preference(frame: Frame) -> tuple[int, ...]:
    """Order of frames that may be doubted: sure ones, accepted ones, those that another tone curve may cure."""
    if frame.is_sure:
        return 2, frame.measured_count
    return (1, 0) if frame.accepted else (0, bool(frame.failed_fits), int(frame.inliers.sum()))


def _measure(search: FrameSearch, placement: Placement) -> Frame:
    """Measure the frame in a placement. Sharpening belongs to the scan, wherever its frame lies."""
    frame = measure_frame(search.scan, search.layout, placement, search.options)
    if frame.accepted and frame.scan.tone.sharpening:
        search.scan = search.scan.replace_tone(search.scan.tone.sharpened(frame.scan.tone.sharpening))
    return frame


def _faint_frame(search: FrameSearch, placement: Placement, tried: int) -> tuple[float, Frame] | None:
    """Measure the faint frame in a placement and in its likeliest pose: names of other poses would hide its marks."""
    frames = [measure_frame(search.scan, search.layout, placement, search.options)]
    if search.options.pose == "auto" and frames[0].inliers.any():
        pose = likeliest_pose(search, frames[0]).name
        frames += [] if pose == placement.pose else [rename_frame(search.scan, frames[0], pose)]
    frames = [frame for frame in frames if frame.agrees]
    if not frames:
        return None
    # By the measured marks, or by the responses at reduced resolution: the smaller counts, times two for two criteria.
    as_measured = min(false_frames(search, frame, frame.inlier_fits) for frame in frames)
    most = max(frames, key=lambda frame: frame.inliers.sum())
    return 2 * tried * min(as_measured, search.false_placements(placement)), most


def _likely_placements(search: FrameSearch, found: Sequence[Placement], tried: int) -> list[Placement]:
    """Best placement and its rivals, without those with too many expected false placements."""
    return [place for place in _places_to_try(found) if tried * search.false_placements(place) <= PLACEMENTS_BY_CHANCE]


def _showing_marks(search: FrameSearch, places: Sequence[Placement]) -> list[Placement]:
    return [place for place in places if shows_marks(search.scan, search.layout, place, search.options)]


def _places_to_try(found: Sequence[Placement]) -> list[Placement]:
    """Best placement, then others elsewhere by score times supporting marks: a few high peaks alone are often false."""
    places = list(found[:1])
    for placement in sorted(found[1:], key=lambda placement: -placement.score * placement.supported):
        if len(places) <= _TRIALS and not any(placement.same_place(other) for other in places):
            places.append(placement)
    return places


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
    return decide_pose(search.scan, placements, frame, lines)


# Significance of a frame. A dot on a rough background resembles many specks, a cross in a ring nothing else: no single
# threshold fits both. The marks are therefore searched in the same way at places beside them: the share that correlates
# at least as strongly as the weakest mark found is the false-alarm rate of one mark.


def doubt_frame(search: FrameSearch, frame: Frame) -> Reason:
    """Test whether a frame may be a false alarm.

    Returns
    -------
    Reason
        Empty if the frame is significant. Contains the code no-frame if it is more likely a false alarm than not.

    Notes
    -----
    Frames found by the search for faint marks are not tested again: they were accepted only if significant, although
    none of their marks may be clear.
    """
    if frame.placement.surroundings.robust:
        return NO_REASON
    inside = [index for index, detection in enumerate(frame.detections) if detection.inside]
    # A mark searched only where the others predict it is no independent evidence.
    clear = [index for index in frame.clear_fits if not frame.detections[index].closer]
    if len(frame.inlier_fits) >= _SURE:
        return NO_REASON
    if len(clear) == len(inside):
        return _doubt_by_scan(search, frame, clear)
    return _doubt_by_neighbourhood(search, frame, inside, clear)


def false_frames(search: FrameSearch, frame: Frame, found: Iterable[int]) -> float:
    """Expected number of false frames as good in the scan.

    found: indices of the marks that count. Many places respond as strongly at reduced resolution, but
    few of them at full resolution: the number is multiplied by their share to the power of at most `_COUNTED` marks.
    """
    found_px = {index: frame.inlier_fits[index].center_px for index in found}
    expected = search.false_frames(frame.placement, frame.inside, found_px)
    if frame.placement.reduction == 1 or not _SELDOM < expected < _HOPELESS:
        return expected
    return expected * _share_at_full_resolution(search, frame, found_px) ** min(_COUNTED, len(found_px))


def _doubt_by_scan(search: FrameSearch, frame: Frame, clear: Sequence[int]) -> Reason:
    """Test a frame of which every mark was found, by the false frames expected in a scan that was searched whole."""
    if len(clear) <= _FREE or not search.is_exhaustive(frame.placement):
        return NO_REASON
    expected = false_frames(search, frame, clear)
    if expected <= FRAME_BY_CHANCE:
        return NO_REASON
    return Reason(
        f"so many places of the scan match the {len(clear)} marks found that {expected:.2g} such false alarms are "
        "expected in it; the frame may lie elsewhere",
        Code.CHANCE,
    )


def _share_at_full_resolution(search: FrameSearch, frame: Frame, found_px: dict[int, Array]) -> float:
    """Share of the places with responses as strong at reduced resolution that also have them at full resolution."""
    marks_px, apart_px = np.array([*found_px.values()]), _APART * frame.first_search_px()
    others = [
        (index, place)
        for index, own in found_px.items()
        for place in search.places_as_good(frame.placement, index, own)[: _PLACES // len(found_px)]
        if np.hypot(*(marks_px - place).T).min() > apart_px
    ]
    weakest = min(_response(search, frame, index, place, _FITTED_PX) for index, place in found_px.items())
    radius = _REDUCED_PX * frame.placement.reduction
    hits = sum(_response(search, frame, index, place, radius) >= weakest for index, place in others)
    return _share(hits, len(others))


def _doubt_by_neighbourhood(search: FrameSearch, frame: Frame, inside: Sequence[int], clear: Sequence[int]) -> Reason:
    """Test a frame of which some marks were not found, by the correlation beside the marks (binomial)."""
    found, radius = len(clear), frame.first_search_px()
    places = _neighbouring_places(search.scan, frame, inside, radius)
    fitted = ((index, frame.inlier_fits[index].center_px) for index in clear)
    weakest = min((_response(search, frame, *each, _FITTED_PX) for each in fitted), default=0.0)
    hits = sum(_response(search, frame, index, place, radius) >= weakest for index, place in places)
    chance = float(bdtrc(found - _FREE - 1, len(inside) - _FREE, _share(hits, len(places))))
    if chance <= FRAME_BY_CHANCE:
        return NO_REASON
    return Reason(
        f"only {found} of {len(inside)} marks were found, and {hits} of {len(places)} random places match "
        f"as well (p = {chance:.2f}): the frame may lie elsewhere",
        *((Code.CHANCE, Code.NO_FRAME) if chance > NO_FRAME else (Code.CHANCE,)),
    )


def _response(search: FrameSearch, frame: Frame, index: int, place: Array, radius_px: float) -> float:
    """Highest correlation of a mark, by index, within a radius of a place in the scan."""
    return highest_peak(search.scan, frame.prediction(index, radius_px).shift_to(place))[1]


def _share(hits: int, places: int) -> float:
    """Share by Laplace's rule of succession: no hit among sixty places does not mean a rate of zero."""
    return (hits + 1) / (places + 2)


def _neighbouring_places(scan: Scan, frame: Frame, inside: Sequence[int], radius_px: float) -> list[tuple[int, Array]]:
    """Places around the marks, in eight directions, each with the index of the mark that is searched there."""
    angles = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    size = np.array([scan.width_px, scan.height_px])
    every = [
        (index, np.asarray(frame.predicted_px[index] + off * radius_px * direction))
        for off in _OFFSETS
        for direction in directions
        for index in inside
    ]
    within = [(index, place) for index, place in every if np.all(place >= 0) and np.all(place < size)]
    step = max(1, len(within) // _PLACES)
    return within[::step][:_PLACES]
