"""Fiducial marks of one scan: found by their constellation, named by the frame's pose, measured at full resolution."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.fiducial_options import FiducialOptions
from measure.film import AFFINITY_SIGMA
from measure.frames.chance import doubt, expected_as_good, expected_where_seen
from measure.frames.fiducial_rows import absent_frame, lost_frame, present_frame
from measure.frames.frame import Frame
from measure.frames.frame_measurement import measure_frame
from measure.marks.frame_border import at_border
from measure.marks.poses import POSES, up_from_camera
from measure.marks.shapes import FiducialLayout
from measure.pose.pose_decision import decide_pose
from measure.probabilities import FRAMES_BY_CHANCE, PLACEMENTS_BY_CHANCE
from measure.reason import NO_REASON, Code, Reason
from measure.results import FrameMeasurement, Pose
from measure.scans.scan import Scan
from measure.search.centred_frame import is_worth_a_look, outermost
from measure.search.constellation import Placement
from measure.search.correlation import CLOSE
from measure.search.frame_search import FrameSearch
from measure.search.pitches import PitchHypothesis, pitch_hypotheses, slightly_longer
from measure.writing.line import KnownLine, Line
from measure.writing.networks import networks
from measure.writing.reading import read_writing

Array = NDArray[np.float64]

_SET = ("set in the project.",)
_UNSURE = Reason("none of the marks is measured without blemish: the frame may lie elsewhere.", Code.CHANCE)
_TRIALS = 4  # placements tried at full resolution after the best one has failed
_STRETCH = 3 * AFFINITY_SIGMA  # by which a given pitch may be wrong where marks are too faint to correct it
_LOOKS = 2  # in the whole scan, and where the frame's edges put the marks
_BESIDE = 0.95  # of the frame's size: a rival farther off is another photograph
_AMBIGUOUS = 0.9  # a placement that scores this share of the best one is a rival


def measure_fiducials(
    scan: Scan,
    layout: FiducialLayout,
    pitch_um: tuple[float, float] | None,
    options: FiducialOptions | None = None,
) -> FrameMeasurement:
    """Measure every mark of the layout in the scan: one row a mark, whatever became of it.

    pitch_um: of the scan in x and y; None where it is not known: then the frame's size says about what it is.
    The centres are in the scan's pixels, the centre of the top-left one being (0, 0). Never raises for what the
    picture shows: statuses, reasons and problems say it.
    """
    options = options or FiducialOptions()
    layout = at_border(layout)
    if scan.is_lost:
        return lost_frame(scan, layout)
    search = FrameSearch(scan, layout, options)
    hypotheses = pitch_hypotheses(scan, layout, pitch_um, options)
    found, frame, unsure = _at_first_look(search, hypotheses, pitch_um is not None)
    if frame is None or not frame.accepted:
        reason = frame.misfit() if frame else "nothing in the scan looks like two or more of the camera's marks"
        search = FrameSearch(scan, layout, options, CLOSE)
        closer = hypotheses[0] if pitch_um is None else slightly_longer(hypotheses[0][0], _STRETCH)
        found, frame, faint = _at_a_closer_look(search, closer)
        reason += _pitch_to_try([*unsure, *faint])
    if frame is None:
        absent = absent_frame(scan, layout, reason, options.rotation_deg)
        return replace(absent, writing=_read(scan, layout, None)) if options.writing == "all" else absent
    found = [placement for placement in found if placement.pitch_mm == frame.placement.pitch_mm]
    lines = _read(scan, layout, frame) if options.writing == "all" else None
    pose, against = Pose(options.pose, True, _SET), NO_REASON
    if options.pose == "auto":
        frame = _in_every_pose(search, found, frame)
        pose, placement = _named(search, found, frame, lines or ())
        if options.writing == "pose" and not pose.decided and frame.accepted:
            lines = _read(scan, layout, frame, options.known_lines)
            pose, placement = _named(search, found, frame, lines or ())
        if pose.name != frame.placement.pose:
            frame = measure_frame(scan, layout, placement, options)
        frame = _as_if_set(search, hypotheses, frame)
    else:
        against = _against_the_set_pose(search, found, frame, lines or ())
    chance = doubt(search, frame)
    problems = [each.told(f"{each}.") for each in (*_rivals(search, found, frame), chance, against) if each]
    doubts = problems if frame.measured else [_UNSURE, *problems]
    if doubts and options.pose == "auto":
        pose = replace(pose, decided=False, evidence=(*pose.evidence, *doubts))
    return replace(present_frame(scan, layout, frame, pose, pitch_um, problems, chance), writing=lines)


def _in_every_pose(search: FrameSearch, found: Sequence[Placement], frame: Frame) -> Frame:
    """The frame, or that in another pose at its place in which more of its marks are seen: marks that lean to one side
    look like their mirror images, moved and turned a little."""
    if frame.is_whole:
        return frame
    others = [pose for pose in search.unlike_poses(frame.placement) if pose != frame.placement.pose]
    placements = [_posed(found, frame.placement, pose) for pose in others]
    frames = [measure_frame(search.scan, search.layout, placement, search.options) for placement in placements]
    return max([frame, *frames], key=_worth)


def _as_if_set(search: FrameSearch, hypotheses: Sequence[Sequence[PitchHypothesis]], frame: Frame) -> Frame:
    """The frame, or the one that is found if its pose is set, if more of its marks are seen then: what a search for all
    poses finds in one of them is not all that a search for that one does."""
    if frame.is_whole:
        return frame
    of_pose = FrameSearch(search.scan, search.layout, replace(search.options, pose=frame.placement.pose))
    _, again = _anywhere(of_pose, [one for group in hypotheses for one in group if one.mm == frame.placement.pitch_mm])
    return frame if again is None else max(frame, again, key=_worth)


def _worth(frame: Frame) -> tuple[bool, int, int]:
    return frame.accepted and frame.placement.surroundings != CLOSE, frame.measured, int(frame.belongs.sum())


def _read(
    scan: Scan, layout: FiducialLayout, frame: Frame | None, known_lines: Sequence[KnownLine] = ()
) -> tuple[Line, ...] | None:
    """What is written about the frame, or along the scan's edges; None where nothing is there that reads. Where a known
    line is read at its place, only what stands about it."""
    nets = networks()
    if nets is None:
        return None
    if frame is None:
        return read_writing(scan, nets)
    half = np.asarray(layout.frame_mm) / 2
    corners_mm = half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    matrix = frame.pixel_from_camera
    frame_px = corners_mm @ matrix[:, :2].T + matrix[:, 2]
    pixel_from_up = matrix[:, :2] @ up_from_camera(frame.placement.pose).T
    for known in known_lines:
        outline_px = np.array(known.outline_mm) @ pixel_from_up.T + matrix[:, 2]
        lines = read_writing(scan, nets, frame_px, (known.side, outline_px))
        if any(known.is_seen_in(line) for line in lines):
            return lines
    return read_writing(scan, nets, frame_px)


def _at_first_look(
    search: FrameSearch, hypotheses: Sequence[Sequence[PitchHypothesis]], is_given: bool
) -> tuple[list[Placement], Frame | None, list[Frame]]:
    """The placements, best first, and the frame in one of them, None where there is none; and those under other pitches
    that chance may have made.

    It is looked for in the middle of the scan where the pitch is given, then anywhere. Where what is found may be
    chance, other pitches are tried."""
    found, frame = _in_the_middle(search, hypotheses[0][0]) if is_given else ([], None)
    if frame is None or not frame.is_complete:
        found, frame = _anywhere(search, hypotheses[0])
    tried, unsure = len(hypotheses[0]), list[Frame]()
    for others in hypotheses[1:]:
        if frame is not None and frame.accepted and not doubt(search, frame):
            break
        tried += len(others)
        placements, frames = _in_spite_of_pitch(search, others)
        if frames and tried * expected_as_good(search, frames[0]) <= FRAMES_BY_CHANCE:
            found, frame = placements, frames[0]
        else:
            unsure += frames
    return found, frame, unsure


def _in_the_middle(search: FrameSearch, given: PitchHypothesis) -> tuple[list[Placement], Frame | None]:
    """The placements, best first, of a frame in the middle of a large scan, and the frame in the best of them; none
    where they are not worth a look or there is none."""
    if not is_worth_a_look(search.scan, search.layout, given.mm):
        return [], None
    few = replace(search.layout, marks=outermost(search.layout.marks))
    found = FrameSearch(search.scan, few, search.options).in_the_middle(given)
    return found, measure_frame(search.scan, search.layout, found[0], search.options) if found else None


def _anywhere(search: FrameSearch, hypotheses: Sequence[PitchHypothesis]) -> tuple[list[Placement], Frame | None]:
    """The placements, best first, in the whole scan, and the frame in the first of the best ones that is sure and not
    outdone, or else the sure one of most measured marks, or else the first accepted, or else that of most marks; None
    where nothing looks like the marks. A frame is no other one where all its marks are among those of an accepted one
    that was tried before it."""
    found = search.anywhere(hypotheses)
    if not found:
        return [], None
    placements, frames = [found[0], *_others(found)], list[Frame]()
    for placement in placements:
        frame = _as_its_pictures_say(search, found, placement)
        if any(before.accepted and before.has_all_of(frame) for before in frames):
            continue
        if frame.is_sure and not _is_outdone(search, frame, placements):
            return found, frame
        frames.append(frame)
    sure = [frame for frame in frames if frame.is_sure]
    if sure:
        return found, max(sure, key=lambda frame: frame.measured)
    accepted = [frame for frame in frames if frame.accepted]
    return found, accepted[0] if accepted else max(frames, key=lambda frame: int(frame.belongs.sum()))


def _is_outdone(search: FrameSearch, frame: Frame, placements: Sequence[Placement]) -> bool:
    """Whether more marks speak for another placement than the frame has measured ones, and chance may have made it."""
    return any(placement.supported > frame.measured for placement in placements) and bool(doubt(search, frame))


def _as_its_pictures_say(search: FrameSearch, found: Sequence[Placement], placement: Placement) -> Frame:
    """The frame in a placement. At the right place in a wrong pose unlike marks are not found under one another's
    names: where that is so, the pictures there decide the pose, and the frame is measured in it."""
    frame = measure_frame(search.scan, search.layout, placement, search.options)
    if frame.accepted or not frame.belongs.any() or search.options.pose != "auto":
        return frame
    pose, renamed = _named(search, found, frame)
    if not pose.decided or pose.name == placement.pose:
        return frame
    return measure_frame(search.scan, search.layout, renamed, search.options)


def _in_spite_of_pitch(
    search: FrameSearch, hypotheses: Sequence[PitchHypothesis]
) -> tuple[list[Placement], list[Frame]]:
    """The placements and the accepted frames under other pitches than the given one, those first that chance makes
    least. So much freedom finds false frames too: only one counts that it would hardly make in all hypotheses tried."""
    found = search.anywhere(hypotheses)
    frames = [_as_its_pictures_say(search, found, place) for place in _hopeful(search, found, len(hypotheses))]
    accepted = [frame for frame in frames if frame.accepted]
    return found, sorted(accepted, key=lambda frame: expected_as_good(search, frame))


def _pitch_to_try(unsure: Sequence[Frame]) -> str:
    """A clause about the frame of most marks among those that chance may have made."""
    if not unsure:
        return ""
    best = max(unsure, key=lambda frame: (frame.measured, int(frame.belongs.sum())))
    pair = ", ".join(f"{um:.2f}" for um in 1000 / np.hypot(*best.pixel_from_camera[:, :2].T))
    seen = f"under another pitch {int(best.belongs.sum())} of them lie as they should, which may be chance"
    return f"; {seen}: try pitch_um = [{pair}]"


def _at_a_closer_look(
    search: FrameSearch, hypotheses: Sequence[PitchHypothesis]
) -> tuple[list[Placement], Frame | None, list[Frame]]:
    """The placements, best first, and the frame in one of them, None where there is none; and those that chance may
    have made. Less of what lies beside a mark counts here: the frame's edge may drown it else.

    The whole scan is searched, then only about where the edges of the exposed frame put the marks. The second search
    counts the hypotheses of the first as tried too."""
    found, tried = search.anywhere(hypotheses), len(hypotheses)
    frame, unsure = _hardly_chance(search, found, tried, search.expected_alike)
    if frame is None:
        found = search.within_its_edges(hypotheses)
        frame, others = _hardly_chance(search, found, _LOOKS * tried)
        unsure += others
    return found, frame, unsure


def _hardly_chance(
    search: FrameSearch, found: Sequence[Placement], tried: int, *others: Callable[[Placement], float]
) -> tuple[Frame | None, list[Frame]]:
    """The frame that chance is least expected to make, None where it may be chance; and those that it may have made.
    others: further estimates of how many such placements chance makes; the least of all estimates counts, times their
    number.

    The marks' pictures need not be clear: whether a frame is there is one question, which pose it has another."""
    best, least, unsure = None, FRAMES_BY_CHANCE, list[Frame]()
    for place in _hopeful(search, found, tried):
        frames = [frame for frame in _in_its_likeliest_poses(search, found, place) if frame.agrees]
        if not frames:
            continue
        unsure += frames
        as_measured = min(expected_where_seen(search, frame, _seen_px(frame)) for frame in frames)
        counts = [as_measured, *(count(place) for count in others)]
        expected = len(counts) * tried * min(counts)
        if expected <= least:
            best, least = max(frames, key=lambda frame: frame.belongs.sum()), expected
    return best, unsure


def _in_its_likeliest_poses(search: FrameSearch, found: Sequence[Placement], placement: Placement) -> list[Frame]:
    """The frame in a placement, and in the pose that its pictures like best, for faint marks are not seen under one
    another's names, though they say not surely which these are."""
    frame = measure_frame(search.scan, search.layout, placement, search.options)
    if search.options.pose != "auto" or not frame.belongs.any():
        return [frame]
    pose, renamed = _named(search, found, frame)
    if pose.name == placement.pose:
        return [frame]
    return [frame, measure_frame(search.scan, search.layout, renamed, search.options)]


def _seen_px(frame: Frame) -> dict[int, Array]:
    """Where the marks that belong were seen, by index."""
    return {index: fit.center_px for index, fit in enumerate(frame.fits) if fit}


def _hopeful(search: FrameSearch, found: Sequence[Placement], tried: int) -> list[Placement]:
    """The best placement and its rivals elsewhere, without those of which chance makes many that answer as well."""
    places = (*found[:1], *_others(found))
    return [place for place in places if tried * search.expected_alike(place) <= PLACEMENTS_BY_CHANCE]


def _others(found: Sequence[Placement]) -> list[Placement]:
    """The placements that put the frame elsewhere, those first that many marks speak for: a few strong answers are
    often false ones."""
    others: list[Placement] = []
    for placement in sorted(found[1:], key=lambda placement: -placement.score * placement.supported):
        if not any(placement.same_place(other) for other in (found[0], *others)):
            others.append(placement)
        if len(others) == _TRIALS:
            break
    return others


def _named(
    search: FrameSearch, found: Sequence[Placement], frame: Frame, lines: Sequence[Line] = ()
) -> tuple[Pose, Placement]:
    """The pose that what is seen of the frame speaks for, and the frame's placement in it. lines: of writing."""
    posed = [_posed(found, frame.placement, pose) for pose in POSES]
    pose = decide_pose(search.scan, search.layout, posed, frame, search.options, lines)
    return pose, posed[POSES.index(pose.name)]


def _against_the_set_pose(
    search: FrameSearch, found: Sequence[Placement], frame: Frame, lines: Sequence[Line]
) -> Reason:
    """A sentence where what is seen decides for another pose than the one that the project sets."""
    likeliest, placement = _named(search, found, frame, lines)
    if likeliest.name == frame.placement.pose or not frame.measured:
        return NO_REASON
    pose = decide_pose(search.scan, search.layout, [frame.placement, placement], frame, search.options, lines)
    if not pose.decided or pose.name == frame.placement.pose:
        return NO_REASON
    evidence = " ".join(pose.evidence).rstrip(".")
    return Reason(
        f"pose {frame.placement.pose} is set in the project, but what is seen of this frame decides for {pose.name}, "
        f'and then the marks have other names (pose = "auto" takes each scan as it lies): {evidence}',
        Code.POSE,
    )


def _posed(found: Sequence[Placement], best: Placement, pose: str) -> Placement:
    """The placement of a pose at the place of the best one: as it was found, or else the best one's, renamed."""
    return next(
        (placement for placement in found if placement.pose == pose and placement.same_place(best)), best.posed(pose)
    )


def _rivals(search: FrameSearch, found: Sequence[Placement], frame: Frame) -> list[Reason]:
    """Sentences about other placements in the same pose that nearly as many marks speak for, or that show a frame."""
    problems, best = [], frame.placement
    for other in found:
        if other.pose != best.pose or other.same_place(best):
            continue
        as_good = other.score >= _AMBIGUOUS * best.score and other.supported >= best.supported - 1
        if as_good or _is_another_frame(search, other, frame):
            shift = np.linalg.solve(
                best.pixel_from_camera[:, :2], other.pixel_from_camera[:, 2] - best.pixel_from_camera[:, 2]
            )
            told = f"({shift[0]:.1f}, {shift[1]:.1f}) mm"
            beside = Reason(
                f"the scan shows another frame {told} beside this one, with {other.supported} marks where this one has "
                f"{best.supported}: give a scan of one frame",
                Code.OTHER_FRAME,
            )
            shifted = Reason(
                f"the constellation fits nearly as well shifted by {told}, on {other.supported} marks against "
                f"{best.supported}: the marks' names are not certain",
                Code.AMBIGUOUS,
            )
            is_beside = (np.abs(shift) > _BESIDE * np.array(search.layout.frame_mm)).any()
            problems.append(beside if is_beside else shifted)
    return problems[:3]


def _is_another_frame(search: FrameSearch, other: Placement, frame: Frame) -> bool:
    """Whether a placement shows another frame, of as many marks: of two photographs in a scan one may answer better."""
    if other.supported < frame.placement.supported or not search.was_everywhere(other):
        return False
    if search.expected_alike(other) > FRAMES_BY_CHANCE:
        return False
    seen = measure_frame(search.scan, search.layout, other, search.options)
    return seen.is_sure and not frame.has_all_of(seen)
