"""Frames on the review page: results as JSON, outlines of marks, trial measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from measure.fiducials.options import Click
from measure.marks.shapes import Bar, Disk, FrameCorner, LayoutMark, Mark, MarkShape, Part, Polygon, Ring
from measure.results import MarkMeasurement
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.mark_table import Clicks
from pipeline.files.project_file import Project
from pipeline.measuring.first_pictures import first_pictures
from pipeline.measuring.scan_measurement import measured_scan
from pipeline.measuring.scan_task import ScanTask, scan_tasks
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array

_STEPS = 48  # vertices of a circle
Json = dict[str, Any]

_LEAST_PX = 40  # px, smallest half width of a window, to include the surroundings
_REACH_SIZES = 2.5  # width of a window in sizes of the mark


def outlines_px(mark: Mark, pixel_from_mark: Array) -> list[list[list[float]]]:
    """Outlines of a mark as closed lines in pixels of the scan; empty for an image template."""
    if not isinstance(mark, MarkShape):
        return []
    lines = (line for part in mark.parts for line in _lines_mm(part))
    return [(line @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2]).round(3).tolist() for line in lines]


def _lines_mm(part: Part) -> list[Array]:
    match part:
        case Disk():
            return [_circle(part.center_mm, part.radius_mm)]
        case Ring():
            half = part.line_mm / 2
            return [_circle(part.center_mm, part.radius_mm + sign * half) for sign in (1, -1)]
        case Bar():
            start, end = np.array(part.from_mm), np.array(part.to_mm)
            along = (end - start) / np.hypot(*(end - start))
            side = part.line_mm / 2 * np.array([-along[1], along[0]])
            return [np.stack([start + side, end + side, end - side, start - side])]
        case Polygon():
            return [np.array(part.vertices_mm)]


def _circle(center_mm: tuple[float, float], radius_mm: float) -> Array:
    angles = np.linspace(0.0, 2 * np.pi, _STEPS, endpoint=False)
    return np.array(center_mm) + radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)


@dataclass(frozen=True)
class ReviewFrame:
    """Frame with its result. verdict: of the cross-scan checks; fingerprint: of the result; camera: with the marks as
    used in the search."""

    scan: MeasuredScan
    verdict: str
    fingerprint: str
    camera: CameraFile

    @cached_property
    def layout_marks(self) -> Mapping[str, LayoutMark]:
        """Marks of the camera with a drawing or template, by name."""
        return {mark.id: mark for mark in self.camera.layout().marks} if self.camera.layout_marks else {}

    def mark(self, point: str, kind: str) -> MarkMeasurement:
        """Mark of that name and kind. Raises KeyError if there is none."""
        found = next((one for one in self.scan.frame.marks if (one.point, one.kind) == (point, kind)), None)
        if found is None:
            raise KeyError(point)
        return found

    def predicted_px(self, point: str, kind: str) -> Array | None:
        """Place of a fiducial predicted by the interior orientation; None if unknown or for other marks."""
        matrix, drawn = self.scan.frame.pixel_from_camera, self.layout_marks.get(point)
        if matrix is None or drawn is None or kind != "fiducial":
            return None
        return np.asarray(matrix @ (*drawn.xy_mm, 1.0))

    def place_px(self, point: str, kind: str) -> Array:
        """Centre of the window: measured place, else predicted place, else centre of the scan."""
        place = self._known_place(self.mark(point, kind))
        return place if place is not None else np.array([self.scan.width_px / 2, self.scan.height_px / 2])

    def pixel_from_mark(self, point: str, kind: str) -> Array | None:
        """(2, 3) affine matrix of a fiducial: rotation and scale of the frame, at its place; None for other marks."""
        matrix, drawn = self.scan.frame.pixel_from_camera, self.layout_marks.get(point)
        if matrix is None or drawn is None or kind != "fiducial" or isinstance(drawn.mark, FrameCorner):
            return None
        return np.column_stack([matrix[:, :2], self.place_px(point, kind)])

    def window_px(self, point: str, kind: str) -> int:
        """Half the width of the window around a mark."""
        size = self.mark(point, kind).quality.get("size_px", 0.0)
        return int(max(_LEAST_PX, np.ceil(_REACH_SIZES * size / 2)))

    def detail_json(self, point: str, kind: str) -> Json:
        """JSON of a mark with all details."""
        mark = self.mark(point, kind)
        drawn, linear = self.layout_marks.get(point), self.pixel_from_mark(point, kind)
        is_known = mark.covariance_px2 is not None and np.isfinite(mark.covariance_px2).all()
        parts = mark.covariance.parts.items() if mark.covariance and is_known else ()
        parts_px = [(c.shown, c.meaning, float(np.sqrt(max(np.trace(px2) / 2, 0.0)))) for c, px2 in parts]
        parts_px.sort(key=lambda one: -one[2])  # the largest first
        return {
            **self._head_json(),
            **mark_json(mark),
            "place": _pair(self.place_px(point, kind)),
            "predicted": _pair(self.predicted_px(point, kind)),
            "half": self.window_px(point, kind),
            "covariance": mark.covariance_px2.tolist() if mark.covariance_px2 is not None and is_known else None,
            "causes": [{"cause": cause, "meaning": meaning, "sigma_px": px} for cause, meaning, px in parts_px],
            "quality": {name: value for name, value in mark.quality.items() if np.isfinite(value)},
            "outlines": [] if drawn is None or linear is None else outlines_px(drawn.mark, linear),
            "has_residual": linear is not None and mark.quality.get("blur_px", 0.0) > 0,
            "can_accept": mark.covariance is not None and mark.center_px is not None,
        }

    def _head_json(self) -> Json:
        return {
            "image": self.scan.frame.image,
            "camera": self.camera.name,
            "verdict": self.verdict,
            "fingerprint": self.fingerprint,
            "size": [self.scan.width_px, self.scan.height_px],
        }

    def frame_json(self) -> Json:
        """JSON of a frame with all marks except tie points."""
        frame, pose = self.scan.frame, self.scan.frame.pose
        marks = [{**mark_json(m), "place": _pair(self._known_place(m))} for m in frame.marks if m.kind != "tie"]
        return {
            **self._head_json(),
            "pitch_um": [value for value in self.scan.pitch_um if np.isfinite(value)],
            "problems": [str(problem) for problem in frame.problems],
            "notes": list(self.scan.notes),
            "pose": None
            if pose is None
            else {"name": pose.name, "decided": pose.decided, "evidence": list(pose.evidence), "roll": pose.roll},
            "marks": marks,
            "fiducials": {id: mark.xy_mm for id, mark in self.layout_marks.items()},
            "writing": [{"text": line.text, "outline": line.outline_px} for line in frame.writing or ()],
        }

    def _known_place(self, mark: MarkMeasurement) -> Array | None:
        return mark.center_px if mark.center_px is not None else self.predicted_px(mark.point, mark.kind)


def mark_json(mark: MarkMeasurement) -> Json:
    """JSON common to all marks."""
    return {
        "point": mark.point,
        "kind": mark.kind,
        "status": str(mark.status),
        "reason": str(mark.reason),
        "code": mark.reason.code,
        "center": _pair(mark.center_px),
    }


def _pair(place: Array | None) -> list[float] | None:
    return None if place is None else [round(float(value), 4) for value in place]


def measured_from_clicks(project: Project, image: str, clicks: Sequence[Click]) -> MeasuredScan:
    """Measure the fiducials of a scan as `reseau measure` would with these clicks. project: with learned marks. Raises
    InputError for a mark that the camera does not have."""
    known = {mark.id for mark in project.image_camera(image).layout_marks}
    unknown = [click.point for click in clicks if click.point not in known]
    if unknown:
        raise InputError(f"{image}: its camera has no mark {', '.join(unknown)}.")
    (task,) = scan_tasks(project, [image])
    return _try_measurement(task.change_options(clicks=tuple(clicks)))


def measured_as_shown(project: Project, shown: str, px: Mapping[str, tuple[float, float]], image: str) -> MeasuredScan:
    """Measure the fiducials of a scan with templates learned at clicked places of a scan, which may be the same one.

    shown, px: scan of the clicks, and column and row by mark. Raises InputError if a mark was not clicked.
    """
    camera = project.image_camera(shown)
    check_clicks(camera, shown, px)
    start = camera_as_shown(project, camera, Clicks(shown, px))
    own = {name: start if one.path == camera.path else one for name, one in project.cameras.items()}
    return _try_measurement(scan_tasks(replace(project, cameras=own), [image])[0])


def check_clicks(camera: CameraFile, image: str, px: Mapping[str, object]) -> None:
    """Raise InputError where a mark to be learned was not clicked."""
    if missing := [one.id for one in camera.learned if one.id not in px]:
        raise InputError(f"{image}: click {', '.join(missing)}, too.")


def camera_as_shown(project: Project, camera: CameraFile, clicks: Clicks) -> CameraFile:
    """Camera with templates of its marks learned at clicked places of one scan; it need not belong to the project."""
    alone = replace(project, cameras=dict.fromkeys(project.cameras or ("",), camera))
    (task,) = scan_tasks(alone, [clicks.scan])
    return first_pictures(replace(camera, clicks=clicks), [task.fiducials_alone("linear")], None)


def _try_measurement(task: ScanTask) -> MeasuredScan:
    task = task.change_options(writing="none")
    return measured_scan(replace(task, options=replace(task.options, targets=None, exterior=None)))
