"""First templates of the marks to be learned: their places in one scan, and the image patches there.

The places come from clicks, or from what recurs in all scans near the given coordinates.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace

import numpy as np

from measure.detection.localisation import Recurrence, Window, recurrence, resample_square
from measure.errors import MeasurementError
from measure.fiducials.clicked_frame import LEAST_CLICKS, are_collinear
from measure.fiducials.interior_orientation import fit_frame
from measure.fiducials.measurement import measure_fiducials
from measure.geometry import POSES, UP_FROM_CAMERA, Affine, linear_scale
from measure.marks import shapes
from measure.marks.templates import cut, learn_template
from measure.scans.parallel import map_items
from measure.scans.scan import Scan
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.mark_table import Clicks, LearnedFrom
from pipeline.measuring.scan_task import ScanOptions, ScanTask
from pipeline.provenance import content_hash
from pipeline.types import Array

Places = Mapping[str, Array]  # (2,) px by fiducial

_CLICK_MM = 0.3  # mm, standard deviation of a click
_REACH = 1.0  # search distance from the coordinates, in sizes of the mark
_COMPARED = 8  # scans: more do not improve the comparison
_LEAST_EXCESS = 0.15  # of the best correlation over the second best: landscape alone reaches half of it
_NOT_COMMON = (
    "the marks cannot be learned from what the scans have in common. Click them in one scan in `reseau review`, or "
    'show them here by a table [clicks] with scan = "..." and a table [clicks.px] of column and row by fiducial;'
)


def first_pictures(camera: CameraFile, tasks: Sequence[ScanTask], workers: Executor | None) -> CameraFile:
    """Learn first templates of the marks from one scan.

    Returns the camera with the templates, and with the scan they come from. Raises InputError or MeasurementError where
    the places of the marks cannot be determined.
    """
    return (
        _learn_clicked_marks(camera, camera.clicks, tasks)
        if camera.clicks
        else _learn_recurring_marks(camera, tasks, workers)
    )


def _learn_clicked_marks(camera: CameraFile, clicks: Clicks, tasks: Sequence[ScanTask]) -> CameraFile:
    task = next((task for task in tasks if task.name == clicks.scan), None)
    if task is None:
        names = [task.name for task in tasks]
        raise InputError(
            f"{camera.path}: [clicks] scan names {clicks.scan!r}, which is none of this camera's scans. "
            f"They are {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}."
        )
    with task.open() as scan:
        if clicks.sha256 and clicks.sha256 != content_hash(scan.path):
            raise InputError(
                f"{camera.path}: its marks were shown in {clicks.scan}, whose file is another one since. Click them "
                "again in `reseau review`."
            )
        for id, place in clicks.px.items():
            if not (0 <= place[0] < scan.width_px and 0 <= place[1] < scan.height_px):
                raise InputError(
                    f"{camera.path}: the click of fiducial {id!r}, {list(place)}, lies outside of {scan.path.name}, "
                    f"which has {scan.width_px} x {scan.height_px} px. Give column and row."
                )
        px = {id: np.array(place) for id, place in clicks.px.items()}
        _check_orientation(camera, task, scan, px)
        placement = _drawn_placement(task.options, scan)
        if placement is None:
            placement = _through_clicks(task.options, scan, px)
        return _start(camera, task, scan, placement, px, alike=(task.name,))


def _check_orientation(camera: CameraFile, task: ScanTask, scan: Scan, px: Places) -> None:
    """Raise InputError where the clicks contradict the scan orientation of the project."""
    # A viewer that obeys the file's orientation tag counts other columns and rows than the file.
    if len(px) < LEAST_CLICKS or camera.clicks is None or are_collinear(np.array(list(px.values()))):
        return
    clicked = _pose(_through_clicks(task.options, scan, px))
    setting = task.options.fiducials.pose
    if setting == clicked or (setting == "auto" and (scan.orientation == 1 or camera.clicks.who)):
        return
    tag = (
        f"The file's orientation tag ({scan.orientation}) asks viewers to turn the picture, and columns and rows count "
        "in the picture as it is stored. "
        if scan.orientation != 1
        else ""
    )
    does = f"sets {setting}" if setting != "auto" else "sets none"
    raise InputError(
        f"{camera.path}: the clicks in {task.name} show the frame in the scan orientation {clicked}, and the project "
        f"{does}. {tag}Click the marks in `reseau review`, which shows it as stored, or set the right orientation "
        "(scan_orientation, in [measure])."
    )


def _learn_recurring_marks(camera: CameraFile, tasks: Sequence[ScanTask], workers: Executor | None) -> CameraFile:
    """Learn the marks as what recurs in all scans near their coordinates."""
    if len(tasks) < 2:
        raise InputError(
            f"{camera.path}: the marks are to be learned, and with one scan nothing says what is a mark. Click them in "
            "`reseau review`, or show them here by a table [clicks] with scan = "
            '"..." and a table [clicks.px] of column and row by fiducial.'
        )
    compared = [tasks[round(k)] for k in np.linspace(0, len(tasks) - 1, min(len(tasks), _COMPARED))]
    views = list(map_items(workers, _view, compared))
    usable = [(task, view) for task, view in zip(compared, views, strict=True) if view is not None]
    if len(usable) < 2:
        raise MeasurementError(
            f"{camera.path}: {_NOT_COMMON} the drawn marks were found in {len(usable)} of its scans."
        )
    (task, (matrix, windows)), *others = usable
    jobs = [(windows[one.id], [other[one.id] for _, (_, other) in others], one.learned_mm) for one in camera.learned]
    found = list(map_items(workers, _recurrence, jobs))
    lost = [one.id for one, each in zip(camera.learned, found, strict=True) if each.excess < _LEAST_EXCESS]
    if lost:
        raise MeasurementError(
            f"{camera.path}: {_NOT_COMMON} nothing near the coordinates of fiducial {', '.join(lost)} recurs in all of "
            f"{len(usable)} scans in one place."
        )
    px = {
        one.id: Affine(matrix).apply(np.array(one.xy_mm) + each.offset_mm)
        for one, each in zip(camera.learned, found, strict=True)
    }
    with task.open() as scan:
        return _start(camera, task, scan, matrix, px, alike=tuple(task.name for task in tasks))


def _recurrence(job: tuple[Window, list[Window], float]) -> Recurrence:
    return recurrence(*job)


def _view(task: ScanTask) -> tuple[Array, Mapping[str, Window]] | None:
    """Approximate placement of the frame, and a window around every learned mark; None without drawn marks or scan."""
    camera = task.options.camera
    with suppress(MeasurementError), task.open() as scan:
        placement = _drawn_placement(task.options, scan)
        if placement is None and len(camera.layout_marks) >= 2:
            return None
        if placement is None:
            placement = _central_frame(task.options, scan)
        return placement, {
            one.id: resample_square(scan, placement, np.array(one.xy_mm), one.learned_mm, _REACH * one.learned_mm)
            for one in camera.learned
        }
    return None


def _drawn_placement(options: ScanOptions, scan: Scan) -> Array | None:
    """Placement of the frame from the drawn marks."""
    if len(options.camera.layout_marks) < 2:
        return None
    pitch = options.pitch_um or scan.pitch_um
    return measure_fiducials(scan, options.camera.layout(), pitch, options.fiducials).pixel_from_camera


def _central_frame(options: ScanOptions, scan: Scan) -> Array:
    """Placement of a frame in the centre of its scan, in the project's scan orientation."""
    pose = "0" if options.fiducials.pose == "auto" else options.fiducials.pose
    pitch = np.array(_pitch_mm(options, scan))
    linear = np.diag([1.0, -1.0]) @ UP_FROM_CAMERA[pose] / pitch[:, None]
    return np.column_stack([linear, [(scan.width_px - 1) / 2, (scan.height_px - 1) / 2]])


def _pitch_mm(options: ScanOptions, scan: Scan) -> tuple[float, float]:
    """Pixel pitch from the project or the file, or as if the frame filled the scan."""
    pitch_um = options.pitch_um or scan.pitch_um
    if pitch_um is not None:
        return (pitch_um[0] / 1000, pitch_um[1] / 1000)
    frame_mm = options.camera.layout().frame_mm
    return (max(frame_mm) / max(scan.width_px, scan.height_px),) * 2


def _through_clicks(options: ScanOptions, scan: Scan, px: Places) -> Array:
    """Placement of the frame from the clicks; mirrored where that fits better."""
    camera = options.camera
    if len(px) == 1:
        matrix = _central_frame(options, scan)
        xy = next(np.array(one.xy_mm) for one in camera.learned)
        matrix[:, 2] = next(iter(px.values())) - matrix[:, :2] @ xy
        return matrix
    pitch = np.array(_pitch_mm(options, scan))
    xy = np.array([one.xy_mm for one in camera.learned])
    up = np.array([px[one.id] for one in camera.learned]) * pitch * (1.0, -1.0)
    return np.asarray(np.diag([1.0, -1.0]) @ fit_clicks(xy, up, ("0", "0m")) / pitch[:, None])


def fit_clicks(xy_mm: Array, up_mm: Array, poses: Sequence[str]) -> Array:
    """(2, 3) transformation from camera coordinates to clicks (right, up); of the scan orientations the best-fitting
    one."""
    fits = [fit_frame(xy_mm, up_mm, np.full(len(xy_mm), _CLICK_MM), UP_FROM_CAMERA[pose]) for pose in poses]
    return min(fits, key=lambda fit: round(fit.chi_square, 6)).up_from_camera


def _start(
    camera: CameraFile, task: ScanTask, scan: Scan, placement: Array, px: Places, alike: tuple[str, ...]
) -> CameraFile:
    """Cut templates from one scan; the layout takes their places. alike: scans with the same scan orientation."""
    fiducials = []
    for one in camera.fiducials:
        if isinstance(one.mark, shapes.LearnedMark):
            chip = cut(scan, np.column_stack([placement[:, :2], px[one.id]]), one.mark.size_mm)
            x, y = Affine(placement).inverse.apply(px[one.id]).tolist()
            one = replace(one, template_origin_mm=(x, y), mark=learn_template([chip], one.mark.size_mm))
        fiducials.append(one)
    is_clicked = camera.clicks is not None
    sha256, pose = content_hash(scan.path), _pose(placement)
    learned_from = LearnedFrom(scan=task.name, sha256=sha256, pose=pose, clicked=is_clicked, alike=alike)
    return replace(camera, fiducials=tuple(fiducials), learned_from=learned_from)


def _pose(placement: Array) -> str:
    """Scan orientation nearest to a placement."""
    up = np.diag([1.0, -1.0]) @ placement[:, :2] / linear_scale(placement)  # from the camera's axes to (right, up)
    return min(POSES, key=lambda name: float(np.abs(UP_FROM_CAMERA[name] - up).sum()))
