"""Natural points in the scans of a project, beside the fiducials and targets that are measured already."""

import re
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.flags import Code, Reason
from measure.scans.remote import scan_path
from measure.tie_points.features import TieFrame
from measure.tie_points.find_points import measure_ties
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.files.tie_table import TieSettings
from pipeline.progress import Count
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]

_TIE_NAME = re.compile(r"tie\d+")
_LEAST_MARK_PX = 20.0  # about a mark whose size nobody has noted

_NO_FRAME = Reason(
    "No natural points are sought here: without fiducials nobody knows where the frame lies.", Code.NO_FRAME
)


def check_tie_names(project: Project) -> None:
    """Raises InputError where a given point has a name that a natural point would take."""
    reserved = sorted(id for id in project.object_points if _TIE_NAME.fullmatch(id)) if project.ties else []
    if reserved:
        raise InputError(
            f"{project.path}: the given points hold {reserved[0]!r}, a name that [ties] gives to natural points. "
            "Rename it in points.csv."
        )


def with_ties(
    project: Project, settings: TieSettings, scans: Sequence[MeasuredScan], count: Count, workers: Executor | None
) -> tuple[MeasuredScan, ...]:
    """The scans with the natural points that they share."""
    frames = {scan.frame.image: _tie_frame(project, scan) for scan in scans}
    placed = [frame for frame in frames.values() if frame is not None]
    ties = measure_ties(placed, settings.options, count, workers)
    problems = {**ties.problems, **{image: (_NO_FRAME,) for image, frame in frames.items() if frame is None}}
    return tuple(
        replace(
            scan,
            frame=replace(
                scan.frame,
                marks=(*scan.frame.marks, *ties.marks.get(scan.frame.image, ())),
                problems=(*scan.frame.problems, *problems.get(scan.frame.image, ())),
            ),
        )
        for scan in scans
    )


def _tie_frame(project: Project, scan: MeasuredScan) -> TieFrame | None:
    """None where the camera has fiducials and too few of them were measured."""
    camera = project.camera_of(scan.frame.image)
    taken = [
        (*mark.center_px, max(mark.quality.get("size_px", 0.0), _LEAST_MARK_PX))
        for mark in scan.frame.marks
        if mark.center_px is not None
    ]
    pixel_from_camera, frame_mm = scan.frame.pixel_from_camera, camera.frame_mm
    if pixel_from_camera is None:
        if camera.fiducials:
            return None
        middle = np.array([scan.width_px - 1, scan.height_px - 1]) / 2
        pixel_from_camera = np.column_stack([np.diag([1000.0, -1000.0] / np.array(scan.pitch_um)), middle])
        frame_mm = None
    path, marks = scan_path(scan.scan), np.array(taken).reshape(-1, 3)
    frame = project.part_of(scan.frame.image)
    return TieFrame(scan.frame.image, path, pixel_from_camera, frame_mm, marks, project.max_pixels, frame)
