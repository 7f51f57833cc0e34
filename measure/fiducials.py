"""Fiducial marks of one scan: found by their constellation, named by the frame's pose, measured at full resolution."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.candidates import Look, respond, respond_about
from measure.centred_frame import centred_places_px, is_complete, is_worth_a_look, reach_mm
from measure.chance import doubt
from measure.constellation import Bounds, Placement, PlacementSearch, same_picture, signs_of
from measure.edge_place import EdgePlace
from measure.fiducial_options import FiducialOptions
from measure.frame import Frame, measure_frame
from measure.frame_fit import AFFINITY_SIGMA
from measure.learned import honest_covariance
from measure.pose_decision import decide_pose
from measure.poses import POSES, up_from_camera
from measure.results import FrameMeasurement, MarkMeasurement, Pose
from measure.scan import Scan
from measure.shapes import FiducialLayout, LayoutMark, MarkTemplate
from measure.status import Status

Array = NDArray[np.float64]

_SCALE_STEPS = (1.1, 1.0, 0.91, 0.83, 0.75)  # of the largest scale at which the frame fits into the scan
_STEP_TOLERANCE = 0.06
_STRETCHES = (-0.015, 0.015, -0.03, 0.03)  # each is within what a placement allows the frame of the next
_FLAWLESS = Status.MEASURED
_LEAST_FLAWLESS = 3
_SET = ("set in the project.",)
_TRIALS = 4  # placements tried at full resolution after the best one has failed
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
    found, frame = _in_the_middle(scan, layout, pitch_um, options)
    if frame is None or not is_complete(frame):
        found, frame = _anywhere(scan, layout, pitch_um, options)
    if frame is not None and not frame.accepted and pitch_um is not None:
        found, frame = _stretched(scan, layout, pitch_um, options, (found, frame))
    if frame is None:
        return _nothing(scan, layout, "nothing in the scan looks like two or more of the camera's marks")
    if not frame.accepted:
        return _nothing(scan, layout, frame.misfit())
    found = [placement for placement in found if placement.pitch_mm == frame.placement.pitch_mm]
    pose = Pose(options.pose, True, _SET)
    if options.pose == "auto":
        posed = [_posed(found, frame.placement, pose) for pose in POSES]
        pose = decide_pose(scan, layout, posed, frame, options)
        if pose.name != frame.placement.pose:
            frame = measure_frame(scan, layout, posed[POSES.index(pose.name)], options)
    return _measurement(scan, layout, frame, pose, _rivals(found, frame.placement), doubt(scan, layout, frame, options))


def _in_the_middle(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> tuple[list[Placement], Frame | None]:
    """The placements, best first, of a frame in the middle of a large scan, and the frame in the best of them; none
    where they are not worth a look or there is none."""
    if pitch_um is None or not is_worth_a_look(scan, layout, pitch_mm := (pitch_um[0] / 1000, pitch_um[1] / 1000)):
        return [], None
    found = _placements(scan, layout, pitch_mm, options.scale_tolerance, options, reach_mm(layout))
    found.sort(key=lambda placement: -round(placement.score, 2))
    return found, measure_frame(scan, layout, found[0], options) if found else None


def _anywhere(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> tuple[list[Placement], Frame | None]:
    """The placements, best first, in the whole scan, and the frame in the first of the best ones that is accepted, or
    else that of most marks; None where nothing looks like the marks."""
    found = _found(scan, layout, pitch_um, options)
    if not found:
        return [], None
    frames = [_as_its_pictures_say(scan, layout, found, found[0], options)]
    for placement in _others(found):
        if frames[-1].accepted:
            break
        frames.append(_as_its_pictures_say(scan, layout, found, placement, options))
    return found, max(frames, key=lambda frame: (frame.accepted, frame.belongs.sum()))


def _as_its_pictures_say(
    scan: Scan, layout: FiducialLayout, found: Sequence[Placement], placement: Placement, options: FiducialOptions
) -> Frame:
    """The frame in a placement. At the right place in a wrong pose unlike marks are not found under one another's
    names: where that is so, the pictures there decide the pose, and the frame is measured in it."""
    frame = measure_frame(scan, layout, placement, options)
    if frame.accepted or not frame.belongs.any() or options.pose != "auto":
        return frame
    pose = decide_pose(scan, layout, [_posed(found, placement, pose) for pose in POSES], frame, options)
    if not pose.decided or pose.name == placement.pose:
        return frame
    return measure_frame(scan, layout, _posed(found, placement, pose.name), options)


def _stretched(
    scan: Scan,
    layout: FiducialLayout,
    pitch_um: tuple[float, float],
    options: FiducialOptions,
    before: tuple[list[Placement], Frame],
) -> tuple[list[Placement], Frame]:
    """The same with pixels longer one way than the other, where two marks are clear and no third is found: an office
    scanner's carriage may run by per cents too fast. So much freedom finds false marks too: here only marks without
    any blemish count, and the best frame has most of them and the likest ones."""

    def likeness(frame: Frame) -> list[float]:
        verdicts = [frame.verdict(index)[0] if fit else None for index, fit in enumerate(frame.fits)]
        return [fit.likeness for fit, status in zip(frame.fits, verdicts, strict=True) if fit and status is _FLAWLESS]

    if len(likeness(before[1])) < 2:
        return before
    best, highest = before, 0.0
    for stretch in _STRETCHES:
        found, frame = _anywhere(
            scan, layout, (pitch_um[0] * (1 + stretch / 2), pitch_um[1] * (1 - stretch / 2)), options
        )
        if frame is None or not frame.accepted or len(likeness(frame)) < _LEAST_FLAWLESS:
            continue
        if sum(likeness(frame)) > highest:
            best, highest = (found, frame), sum(likeness(frame))
    return best


def _found(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Placement]:
    """The placements of all poses asked for and all pitches possible, best first."""
    found = []
    for pitch_mm, tolerance in _pitches(scan, layout, pitch_um, options):
        found += _placements(scan, layout, pitch_mm, tolerance, options)
    # Poses that score alike keep their order: of a symmetric camera's eight, "0" comes first.
    return sorted(found, key=lambda placement: -round(placement.score, 2))


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


def _pitches(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[tuple[tuple[float, float], float]]:
    """Pitches (mm) to try, each with the relative tolerance of scale that goes with it."""
    if pitch_um is not None:
        return [((pitch_um[0] / 1000, pitch_um[1] / 1000), options.scale_tolerance)]
    long_mm, short_mm = max(layout.frame_mm), min(layout.frame_mm)
    long_px, short_px = max(scan.width_px, scan.height_px), min(scan.width_px, scan.height_px)
    largest = min(long_px / long_mm, short_px / short_mm)
    return [((1 / (step * largest),) * 2, _STEP_TOLERANCE) for step in _SCALE_STEPS]


def _placements(
    scan: Scan,
    layout: FiducialLayout,
    pitch_mm: tuple[float, float],
    tolerance: float,
    options: FiducialOptions,
    centred_mm: float | None = None,
) -> list[Placement]:
    """Of all poses asked for. centred_mm: how far about their places in a centred frame marks are looked for; None:
    everywhere."""
    poses = POSES if options.pose == "auto" else (options.pose,)
    flip = np.diag([1 / pitch_mm[0], -1 / pitch_mm[1]])
    looks = [Look(mark.mark, flip @ up_from_camera(pose)) for pose in poses for mark in layout.marks]
    signs = signs_of(layout.marks)
    if centred_mm is None:
        responses, index = respond(scan, looks, signs)
    else:
        places = [centred_places_px(scan, layout, flip @ up_from_camera(pose)) for pose in poses]
        responses, index = respond_about(scan, looks, np.concatenate(places), centred_mm / max(pitch_mm), signs)
    bounds = Bounds(tolerance, float(np.deg2rad(options.rotation_deg)), options.search_mm(layout))
    search = PlacementSearch(layout.marks, responses, pitch_mm, bounds)
    count = len(layout.marks)
    searched: list[tuple[str, tuple[int, ...], list[Placement]]] = []
    for number, pose in enumerate(poses):
        own = index[number * count : (number + 1) * count]
        twin = next((s for s in searched if same_picture(layout.marks, (s[0], s[1]), (pose, own), bounds)), None)
        found = [placement.posed(pose) for placement in twin[2]] if twin else search.of_pose(pose, own)
        searched.append((pose, own, found))
    return [placement for _, _, found in searched for placement in found]


def _posed(found: Sequence[Placement], best: Placement, pose: str) -> Placement:
    """The placement of a pose at the place of the best one: as it was found, or else the best one's, renamed."""
    return next(
        (placement for placement in found if placement.pose == pose and placement.same_place(best)), best.posed(pose)
    )


def _rivals(found: Sequence[Placement], best: Placement) -> list[str]:
    """Sentences about other placements in the same pose that nearly as many marks speak for."""
    problems = []
    for other in found:
        if other.pose != best.pose or other.same_place(best):
            continue
        if other.score >= _AMBIGUOUS * best.score and other.supported >= best.supported - 1:
            shift = np.linalg.solve(
                best.pixel_from_camera[:, :2], other.pixel_from_camera[:, 2] - best.pixel_from_camera[:, 2]
            )
            problems.append(
                f"the constellation fits nearly as well shifted by ({shift[0]:.1f}, {shift[1]:.1f}) mm, on "
                f"{other.supported} marks against {best.supported}: the marks' names are not certain"
            )
    return problems[:3]


def _nothing(scan: Scan, layout: FiducialLayout, reason: str) -> FrameMeasurement:
    marks = tuple(
        MarkMeasurement(mark.id, "fiducial", None, None, Status.ABSENT, f"not found: {reason}") for mark in layout.marks
    )
    problem = f"no fiducial was measured: {reason}; look whether the scan and the camera belong together."
    return FrameMeasurement(scan.name, marks, None, None, (problem,))


def _measurement(
    scan: Scan, layout: FiducialLayout, frame: Frame, pose: Pose, rivals: Sequence[str], chance: str
) -> FrameMeasurement:
    """rivals, chance: why the frame may lie elsewhere, sentences; if it may be chance none of its marks is certain."""
    marks = tuple(_row(mark, index, frame, scan.name) for index, mark in enumerate(layout.marks))
    if chance:
        marks = tuple(
            replace(mark, status=Status.WEAK, reason=chance) if mark.status is Status.MEASURED else mark
            for mark in marks
        )
    problems = [f"{sentence}." for sentence in (*rivals, *([chance] if chance else []))]
    if problems and pose.evidence != _SET:
        pose = Pose(pose.name, False, (*pose.evidence, *problems))
    per_mm = np.hypot(*frame.pixel_from_camera[:, :2].T)
    if abs(per_mm[0] / per_mm[1] - 1) > 2 * AFFINITY_SIGMA:
        problems.append(
            f"by the marks a pixel is {1000 / per_mm[0]:.1f} um wide and {1000 / per_mm[1]:.1f} um tall: film is never "
            "stretched so much. Look whether the scanner, or the camera file, is to blame."
        )
    used = int(frame.belongs.sum())
    if used <= 3:
        problems.append(f"an affine transformation on {used} fiducials has no redundancy: no check.")
    return FrameMeasurement(scan.name, marks, pose, frame.pixel_from_camera, tuple(problems))


def _row(mark: LayoutMark, index: int, frame: Frame, scan: str) -> MarkMeasurement:
    sighting = frame.sightings[index]
    fit = sighting.fit
    if not sighting.inside:
        return MarkMeasurement(mark.id, "fiducial", None, None, Status.ABSENT, sighting.reason)
    if fit is None:
        return MarkMeasurement(mark.id, "fiducial", sighting.predicted_px, None, Status.PREDICTED, sighting.reason)
    quality = {
        "snr": fit.snr,
        "contrast_dn": fit.contrast_dn,
        "noise_dn": fit.noise_dn,
        "blur_px": fit.blur_px,
        "damaged_fraction": fit.damaged_fraction,
        "likeness": fit.likeness,
        "significance": fit.significance,
        "redundancy": float(fit.redundancy),
        "neighbour_correlation": fit.neighbour_correlation,
        **_by_edges(fit.edges),
    }
    status, reason = frame.verdict(index)
    covariance = fit.covariance_px2
    if isinstance(mark.mark, MarkTemplate):
        covariance = honest_covariance(mark.mark, scan, fit)
        if status is Status.MEASURED and scan in mark.mark.shares and len(mark.mark.shares) == 1:
            status, reason = Status.WEAK, "its template is its own picture: nothing checks its place"
    return MarkMeasurement(mark.id, "fiducial", fit.center_px, covariance, status, reason, quality)


def _by_edges(edges: EdgePlace | None) -> dict[str, float]:
    """How far from the matched place the second method puts the mark, and in standard deviations of that."""
    if edges is None:
        return {}
    col, row = edges.offset_px
    return {
        "second_method_col_px": float(col),
        "second_method_row_px": float(row),
        "second_method_sigmas": edges.sigmas,
    }
