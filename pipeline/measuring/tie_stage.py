"""Third step of measuring: all scans of a project together, with joins between partial scans and natural tie points."""

import re
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from measure.flags import Code, Reason, Status
from measure.geometry import Affine
from measure.results import MarkMeasurement
from measure.scans.remote import scan_path
from measure.tie_points.find_points import measure_ties
from measure.tie_points.joins import measure_joins
from measure.tie_points.tracks import TieFrame
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.files.target_table import TieSettings
from pipeline.measuring.coded_targets import check_sheet
from pipeline.results.measured_record import MeasuredScan
from pipeline.terminal import Count, Reporter
from pipeline.text.wording import capitalised
from pipeline.types import Array

_LEAST_MARK_PX = 20.0  # px, assumed for a mark without a recorded size
_CHECKED = 3  # fiducials that check one another: fewer fit any frame
_GATE_MM, _GATE_SHARE = 0.3, 0.003  # largest discrepancy of fiducials: film deformation, and a fraction of the span
_FEWEST = 3  # joins needed to estimate the transformation between two scans
_TIE_NAME = re.compile(r"tie\d+")

_NO_FRAME = Reason(
    "No natural points are sought here: without fiducials there is no interior orientation.", Code.NO_FRAME
)


def add_joins(
    project: Project, scans: Sequence[MeasuredScan], count: Count, workers: Executor | None
) -> tuple[MeasuredScan, ...]:
    """Add joins to the partial scans of each frame.

    Where the fiducials contradict the joins, both scans get a problem, and the fiducials of the scan with fewer of them
    are rejected.
    """
    by_frame: dict[str, list[MeasuredScan]] = {}
    for scan in scans:
        if frame := project.scanned_frame(scan.frame.image):
            by_frame.setdefault(frame, []).append(scan)
    joined: dict[str, MeasuredScan] = {}
    for done, (frame, parts) in enumerate(sorted(by_frame.items()), 1):
        if len(parts) < 2:
            alone = f"It is a part of frame {frame}, of which no other scan could be measured: nothing joins it."
            joined |= {scan.frame.image: scan.changed(problems=[Reason(alone, Code.FEW_TIES)]) for scan in parts}
        else:
            parts.sort(key=lambda scan: scan.frame.image)
            frames = []
            for scan in parts:
                name, path = scan.frame.image, scan_path(scan.scan)
                occupied = _occupied_places([mark for mark in scan.frame.marks if mark.kind == "fiducial"])
                frames.append(TieFrame(name, path, np.eye(2, 3), None, occupied, project.max_pixels))
            joins = measure_joins(frames, workers=workers)
            with_joins = [_add_marks(scan, joins.marks, joins.problems) for scan in parts]
            joined |= {scan.frame.image: scan for scan in _check_fiducials_by_joins(with_joins)}
        count(frame, done, len(by_frame))
    return tuple(joined.get(scan.frame.image, scan) for scan in scans)


def _add_marks(
    scan: MeasuredScan, marks: Mapping[str, Sequence[MarkMeasurement]], problems: Mapping[str, Sequence[Reason]]
) -> MeasuredScan:
    """Add the marks and problems of an image, by name."""
    image = scan.frame.image
    return scan.changed((*scan.frame.marks, *marks.get(image, ())), problems.get(image, ()))


def _occupied_places(marks: Sequence[MarkMeasurement]) -> Array:
    """(n, 3) column, row and size of the places where no natural point is sought."""
    places = [
        (*mark.center_px, max(mark.quality.get("size_px", 0.0), _LEAST_MARK_PX))
        for mark in marks
        if mark.center_px is not None
    ]
    return np.array(places).reshape(-1, 3)


def _check_fiducials_by_joins(scans: Sequence[MeasuredScan]) -> list[MeasuredScan]:
    """Check the fiducials of each pair of scans against one another through the joins, of other scans too."""
    result = {scan.frame.image: scan for scan in scans}
    checked = set[str]()
    for i, first in enumerate(scans):
        from_first = _pixel_maps(first, scans)
        for second in scans[i + 1 :]:
            off_mm = _discrepancy_mm(first, second, from_first.get(second.frame.image))
            if off_mm is None:
                continue
            both = [
                (np.hypot(scan.width_px, scan.height_px), scan.frame.px_per_mm or np.inf) for scan in (first, second)
            ]
            if off_mm <= _GATE_MM + _GATE_SHARE * float(sum(px / px_per_mm for px, px_per_mm in both)):
                checked |= {first.frame.image, second.frame.image}
                continue
            for scan, other in ((first, second), (second, first)):
                result[scan.frame.image] = _add_contradiction(result[scan.frame.image], other, off_mm)
    for image, scan in result.items():
        if image in checked:
            problems = tuple(problem for problem in scan.frame.problems if problem.codes != (Code.NO_CHECK,))
            result[image] = replace(scan, frame=replace(scan.frame, problems=problems))
        elif 0 < len(_fiducials(scan)) < _CHECKED:
            few = Reason("so few fiducials fit many frames, and no other part of this one checks them", Code.NO_CHECK)
            result[image] = scan.change_status("fiducial", Status.WEAK, few)
    shown = {point: image for image, scan in reversed(result.items()) for point in _fiducials(scan)}
    return [_explain_missing_fiducials(scan, shown) for scan in result.values()]


def _explain_missing_fiducials(scan: MeasuredScan, shown: Mapping[str, str]) -> MeasuredScan:
    """Scan in which fiducials are not missing that lie outside of it and in another one of its frame; nor is any where
    a joined scan shows none of them, as the middle one of three. shown: the other scan, by fiducial."""
    marks = scan.frame.marks
    is_without = scan.frame.pixel_from_camera is None and any(
        mark.kind == "join" and mark.status.is_observation for mark in marks
    )
    is_without &= shown.keys() >= {mark.point for mark in marks if mark.kind == "fiducial"}
    marks = tuple(
        replace(mark, reason=Reason(f"it lies in {shown[mark.point]}, another scan of its frame", Code.OTHER_PART))
        if mark.kind == "fiducial" and mark.point in shown and (is_without or Code.OUTSIDE in mark.reason.codes)
        else mark
        for mark in marks
    )
    problems = tuple(each for each in scan.frame.problems if not (is_without and Code.NO_FRAME in each.codes))
    return replace(scan, frame=replace(scan.frame, marks=marks, problems=problems))


def _fiducials(scan: MeasuredScan) -> dict[str, Array]:
    return {
        mark.point: np.asarray(mark.center_px)
        for mark in scan.frame.marks
        if mark.kind == "fiducial" and mark.status.is_observation
    }


def _pixel_maps(first: MeasuredScan, scans: Sequence[MeasuredScan]) -> dict[str, Affine]:
    """Similarities from the pixels of a scan to those of the scans that are joined to it, directly or by others."""
    maps, reached = {first.frame.image: Affine(np.eye(2, 3))}, [first]
    for scan in reached:  # grows on the way: the fewest joined scans in between
        for other in scans:
            if other.frame.image not in maps and (step := _similarity(scan, other)) is not None:
                maps[other.frame.image] = step.compose(maps[scan.frame.image])
                reached.append(other)
    return maps


def _similarity(first: MeasuredScan, second: MeasuredScan) -> Affine | None:
    """Similarity from pixels of the first scan to the second by their joins; None where there are too few."""
    places = [
        {mark.point: mark.center_px for mark in scan.frame.marks if mark.kind == "join" and mark.status.is_observation}
        for scan in (first, second)
    ]
    common = sorted(places[0].keys() & places[1].keys())
    if len(common) < _FEWEST:
        return None
    here, there = (np.array([of[point] for point in common]) @ (1.0, 1.0j) for of in places)  # complex numbers
    scale = np.vdot(here - here.mean(), there - there.mean()) / np.vdot(here - here.mean(), here - here.mean())
    shift = there.mean() - scale * here.mean()
    return Affine(np.array([[scale.real, -scale.imag, shift.real], [scale.imag, scale.real, shift.imag]]))


def _discrepancy_mm(first: MeasuredScan, second: MeasuredScan, second_from_first: Affine | None) -> float | None:
    """RMS distance of the second scan's fiducials from their places by the first scan's frame and the joins, in mm.

    None where they are not joined, or have no frame or no fiducials.
    """
    frame, second_frame, fiducials = first.frame.pixel_from_camera, second.frame.pixel_from_camera, _fiducials(second)
    if second_from_first is None or frame is None or second_frame is None or not fiducials:
        return None
    found_px = np.array(list(fiducials.values()))
    in_first_px = Affine(frame).apply(Affine(second_frame).inverse.apply(found_px))
    off_px = np.hypot(*(second_from_first.apply(in_first_px) - found_px).T)
    return float(np.sqrt(np.mean(off_px**2))) / (second.frame.px_per_mm or 1.0)


def _add_contradiction(scan: MeasuredScan, other: MeasuredScan, off_mm: float) -> MeasuredScan:
    """Add a problem; reject the fiducials of this scan if it has no more of them than the other."""
    what = (
        f"the fiducial marks contradict those of {other.frame.image}, another part of this frame: what joins both puts "
        f"them {off_mm:.1f} mm apart"
    )
    problem = Reason(
        f"{capitalised(what)}. One of the frames lies elsewhere than it was found, or in another scan orientation: "
        "look at both, and place the marks or set the scan orientation in a review.",
        Code.AMBIGUOUS,
    )
    if len(_fiducials(scan)) <= len(_fiducials(other)):
        scan = scan.change_status("fiducial", Status.REJECTED, Reason(what, Code.AMBIGUOUS))
    return scan.changed(problems=[problem])


def check_tie_names(project: Project) -> None:
    """Raise InputError where a given point has a name reserved for natural points."""
    reserved = sorted(id for id in project.object_points if _TIE_NAME.fullmatch(id)) if project.ties else []
    if reserved:
        raise InputError(
            f"{project.path}: the given points hold {reserved[0]!r}, a name that [ties] gives to natural points. "
            "Rename it in points.csv."
        )


def add_ties(
    project: Project, settings: TieSettings, scans: Sequence[MeasuredScan], count: Count, workers: Executor | None
) -> tuple[MeasuredScan, ...]:
    """Measure natural tie points and add them to the scans; not where a camera has fiducials and too few of them were
    measured."""
    frames, problems = list[TieFrame](), dict[str, Sequence[Reason]]()
    for scan in scans:
        image = scan.frame.image
        camera, pixel_from_camera = project.image_camera(image), scan.frame.pixel_from_camera
        frame_mm = camera.frame_mm
        if pixel_from_camera is None:
            if camera.fiducials:
                problems[image] = (_NO_FRAME,)
                continue
            middle = np.array([scan.width_px - 1, scan.height_px - 1]) / 2
            pixel_from_camera = np.column_stack([np.diag([1000.0, -1000.0] / np.array(scan.pitch_um)), middle])
            frame_mm = None
        path, occupied, part_of = scan_path(scan.scan), _occupied_places(scan.frame.marks), project.scanned_frame(image)
        frames.append(TieFrame(image, path, pixel_from_camera, frame_mm, occupied, project.max_pixels, part_of))
    ties = measure_ties(frames, settings.options, count, workers)
    return tuple(_add_marks(scan, ties.marks, {**ties.problems, **problems}) for scan in scans)


def tie_scans(
    project: Project, scans: Sequence[MeasuredScan], reporter: Reporter, executor: Executor | None = None
) -> tuple[MeasuredScan, ...]:
    """Check and complete the scans across the whole project, in their order: sheet points, joins of partial scans,
    natural tie points."""
    together = check_sheet(project, [scan for scan in scans if not scan.failure])
    if project.has_parts:
        with reporter.stage("joining parts of frame") as count:
            together = add_joins(project, together, count, executor)
    if project.ties is not None:
        with reporter.stage("natural points of scan") as count:
            together = add_ties(project, project.ties, together, count, executor)
    by_image = {scan.frame.image: scan for scan in together}
    return tuple(by_image.get(scan.frame.image, scan) for scan in scans)
