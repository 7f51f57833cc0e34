"""First step of measuring: each scan by itself, its fiducials and then the targets predicted from them."""

import sys
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from measure.annotations.text import MISSING, networks
from measure.errors import MeasurementError, MissingError, TooLargeError, UnreachableError
from measure.fiducials.measurement import measure_fiducials, other_frames, pitch_problem, report_damage
from measure.flags import Code, Reason, Status
from measure.marks.rendering import extent_px
from measure.results import FrameMeasurement, MarkMeasurement, shift_frame
from measure.scans.opening import crop_scan
from measure.scans.remote import TRAFFIC, ScanPart, public_text, scan_path
from measure.scans.scan import Scan
from pipeline.errors import InputError, what_to_do
from pipeline.files.camera_file import CameraFile
from pipeline.files.opencv_file import CalibratedLens
from pipeline.measuring.learn_stage import prior_tone
from pipeline.measuring.scan_task import ScanOptions, ScanTask
from pipeline.measuring.target_stage import measure_targets
from pipeline.provenance import parts_hash
from pipeline.results.comparator_file import comparator_from_pixel
from pipeline.results.measured_record import Failure, FailureCode, MeasuredScan
from pipeline.results.thumbnail import ThumbnailRow, thumbnail_rows
from pipeline.text.wording import capitalised

Inspection = Callable[[Scan, MeasuredScan], None]


_FAILURES: Mapping[type[Exception], FailureCode] = {  # the first that fits
    TooLargeError: FailureCode.TOO_LARGE,
    MissingError: FailureCode.MISSING,
    UnreachableError: FailureCode.UNREACHABLE,
    MeasurementError: FailureCode.UNREADABLE,
    InputError: FailureCode.PITCH,
}
_COUNTED = Path("/proc/self/io")
_IN_THE_PICTURE = 0.4  # of the scan's size: largest offset of the principal point from its centre, if not cropped


def ended_scan(task: ScanTask, error: Exception) -> MeasuredScan:
    """Result of a scan whose process the executor has lost."""
    detail = "" if isinstance(error, BrokenExecutor) else f" ({' '.join(str(error).split())})"
    return failed_scan(
        task,
        FailureCode.ENDED,
        f"{task.shown_scan}: the process that measured it was ended, most likely because the memory was full{detail}. "
        "Close other programs, and measure it again.",
    )


def measured_scan(task: ScanTask, inspect: Inspection | None = None) -> MeasuredScan:
    """Measure one scan: its fiducials, then its targets.

    A scan that cannot be measured gives a result with the reason. Raises nothing but interrupts.

    inspect: called with the open scan and its measurements.
    """
    start = time.monotonic()
    try:
        measured = _open_and_measure(task, inspect)
    except Exception as error:
        measured = failed_scan(task, *_failure(task, error))
    return replace(measured, seconds=time.monotonic() - start)


def failed_scan(task: ScanTask, code: FailureCode, sentence: str) -> MeasuredScan:
    """Result of a scan that could not be measured: all its fiducials and targets have the status absent."""
    sentence = public_text(sentence)
    reason = Reason(f"the scan could not be measured: {sentence}", Code.FAILED_SCAN)
    fiducials, targets = [mark.id for mark in task.options.camera.layout_marks], task.options.targets
    marks = (
        *(MarkMeasurement(id, "fiducial", None, None, Status.ABSENT, reason) for id in fiducials),
        *(MarkMeasurement(id, "target", None, None, Status.ABSENT, reason) for id in (targets.ids if targets else ())),
    )
    frame = FrameMeasurement(task.name, marks, problems=(Reason(sentence, Code.FAILED_SCAN),))
    return MeasuredScan.failed(task.shown_scan, frame, Failure(code, sentence))


def _failure(task: ScanTask, error: Exception) -> tuple[FailureCode, str]:
    sentence = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        what = f"{task.shown_scan}: the memory was full. Close other programs, and measure it again."
        return FailureCode.MEMORY, what
    if isinstance(error, OSError):
        return FailureCode.UNREADABLE, f"{task.shown_scan}: {error.strerror or sentence}. {what_to_do(error)}"
    for kind, code in _FAILURES.items():
        if isinstance(error, kind):
            return code, sentence
    where = traceback.extract_tb(error.__traceback__)[-1]
    return (
        FailureCode.FAULT,
        f"{task.shown_scan}: a fault of reseau itself; please report it: {type(error).__name__}: {sentence}, in "
        f"{Path(where.filename).name}, line {where.lineno}.",
    )


def _open_and_measure(task: ScanTask, inspect: Inspection | None) -> MeasuredScan:
    with task.open() as scan:
        options, fiducials = task.options, task.options.fiducials
        if isinstance(fiducials.lens, CalibratedLens) and (misfit := fiducials.lens.misfit(scan)):
            raise MeasurementError(misfit)
        if scan.is_two_valued:
            raise MeasurementError(
                f"{task.shown_scan} has black and white pixels only, and marks are measured by the grey values along "
                "their edges: scan it again as grey or RGB with 8 or 16 bits a sample"
            )
        if isinstance(scan.path, ScanPart) and (window := scan.path.window):
            try:
                cropped = crop_scan(scan, window)
            except ValueError as error:
                raise MeasurementError(f"{scan.path}: {error}: correct images.csv") from None
            col_px, row_px = first = np.array(window[:2], float)
            clicks = (replace(one, col_px=one.col_px - col_px, row_px=one.row_px - row_px) for one in fiducials.clicks)
            lens = None if fiducials.lens is None else fiducials.lens.crop(*window[:2])
            options = replace(options, fiducials=replace(fiducials, clicks=tuple(clicks), lens=lens))
            measured = _measure(task, cropped, options)
            frame = shift_frame(measured.frame, first)  # in pixels of the whole scan
            measured = replace(measured, width_px=scan.width_px, height_px=scan.height_px, frame=frame)
        else:
            measured = _measure(task, scan, options)
        if inspect is not None:
            inspect(scan, measured)
        return measured


def _measure(task: ScanTask, scan: Scan, options: ScanOptions) -> MeasuredScan:
    """Measure a scan, whole or cropped to a window."""
    # Fiducials are measured in grey values corrected by the tone curve. Targets have edges on all sides and are
    # measured in the grey values as they are.
    tone = prior_tone(options.tone, scan.path).include_information(options.tone_information)
    frame = replace(_fiducials(options, scan.replace_tone(tone)), image=task.name)
    pitch, problems, pitch_notes = _pitch(options, scan, frame)
    of_file = (Reason(f"{capitalised(problem)}.", Code.SECOND_PICTURE) for problem in scan.problems)
    frame = replace(frame, problems=(*of_file, *frame.problems, *problems))
    notes = [*(f"{capitalised(note)}." for note in scan.notes), *frame.notes, *pitch_notes]
    if frame.tone:
        notes.append(frame.tone.note)
    writing, lens = options.fiducials.writing, options.fiducials.lens
    is_open = writing == "pose" and frame.pose is not None and not frame.pose.decided
    if (writing == "all" or is_open) and networks() is None:
        notes.append(f"{capitalised(MISSING)}.")
    if isinstance(lens, CalibratedLens) and not lens.is_covariance_known:
        notes.append(
            "The calibration of the taking lens gives no covariance: the lens is taken as exact. `reseau calibrate` "
            "writes one into camera.yaml."
        )
    measured = MeasuredScan(task.shown_scan, scan.width_px, scan.height_px, pitch, frame, tuple(notes))
    if misplaced := misplaced_principal_point(options.camera, measured):
        measured = measured.changed(problems=[Reason(misplaced, Code.OFF_GIVEN)])
    registered = scan.replace_weights(frame.weights) if frame.weights and frame.notes else scan
    if options.targets is not None:
        measured = measure_targets(options.targets, options.camera, options.exterior, registered, measured)
    return replace(measured, frame=report_damage(scan, measured.frame))


def misplaced_principal_point(camera: CameraFile, measured: MeasuredScan) -> str:
    """A sentence if the principal point of a camera without fiducials is hardly within the scan, as if counted from its
    centre."""
    if camera.fiducials or camera.principal_point_mm is None:
        return ""
    size = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]), measured.pitch_um)
    frame_mm = camera.frame_mm
    if frame_mm is not None and (frame_mm[0] > frame_mm[1]) != (size[0] > -size[1]):  # a turned picture
        size = -size[::-1]
    if (np.abs(np.array(camera.principal_point_mm) - size / 2.0) < _IN_THE_PICTURE * np.abs(size)).all():
        return ""
    given, middle = (f"[{x:.4g}, {y:.4g}]" for x, y in (camera.principal_point_mm, (size / 2.0).tolist()))
    return (
        f"principal_point_mm = {given} is at the edge of the scan or beyond it. A camera without fiducials has it in "
        f"comparator coordinates, from the scan's top-left pixel, x to the right and y up: the middle of this scan is "
        f"{middle}. Give it so, or leave it out."
    )


def _fiducials(options: ScanOptions, scan: Scan) -> FrameMeasurement:
    if all(fiducial.passed_over for fiducial in options.camera.fiducials):
        return FrameMeasurement(scan.name, ())
    pitch, layout = options.pitch_um or scan.pitch_um, options.camera.layout()
    if pitch is None and options.fiducials.part:
        raise InputError(
            f"{scan.path}: pitch_um is missing in the project, and {scan.pitch_note}. A scan of a part of a frame "
            "needs it, for its size says nothing of the pitch."
        )
    measured = measure_fiducials(scan, layout, pitch, options.fiducials)
    problems: list[Reason | None] = [other_frames(scan, layout, measured, options.fiducials)]
    if pitch is not None:
        source = "the project" if options.pitch_um is not None else "the scan's file"
        problems.append(pitch_problem(measured, layout, pitch, source))
    pose = options.known_pose if options.known_pose is not None and measured.pose is not None else measured.pose
    # The size at which each mark is drawn in the scan serves the display of image patches.
    if measured.px_per_mm is not None:
        px_per_mm = measured.px_per_mm
    elif pitch is not None:
        px_per_mm = 1000.0 / pitch[0]
    else:
        px_per_mm = scan.width_px / layout.frame_mm[0]
    drawn = np.array([[px_per_mm, 0.0, 0.0], [0.0, -px_per_mm, 0.0]])
    extents = {mark.id: np.ptp(np.stack(extent_px(mark.mark, drawn)), axis=0).max() for mark in layout.marks}
    marks = [replace(one, quality={**one.quality, "size_px": float(extents[one.point])}) for one in measured.marks]
    found = (*measured.problems, *(problem for problem in problems if problem))
    return replace(measured, marks=tuple(marks), problems=found, pose=pose)


def reads_writing(options: ScanOptions) -> bool:
    """Whether text would be read. The results depend on this in addition to scan and options: the text networks are an
    optional extra."""
    return options.fiducials.writing != "none" and networks() is not None


def _pitch(
    options: ScanOptions, scan: Scan, frame: FrameMeasurement
) -> tuple[tuple[float, float], tuple[Reason, ...], tuple[str, ...]]:
    """Pixel pitch, µm, from the project, the file, the marks or the frame's size; problems; notes."""
    if options.pitch_um is not None:
        return options.pitch_um, (), ()
    if scan.pitch_um is not None:
        return scan.pitch_um, (), ()
    if frame.px_per_mm is not None:
        pitch = 1000.0 / frame.px_per_mm
        note = f"The pitch of {pitch:.2f} µm is from the marks' separations, for {scan.pitch_note}."
        return (pitch, pitch), (), (note,)
    if options.camera.frame_mm is not None:
        pitch = 1000.0 * max(options.camera.frame_mm) / max(scan.width_px, scan.height_px)
        note = f"The pitch is not known ({scan.pitch_note}); {pitch:.1f} µm is taken, as if the frame filled the scan."
        return (pitch, pitch), (Reason(note, Code.PITCH),), ()
    raise InputError(
        f"{scan.path}: pitch_um is missing in the project, and {scan.pitch_note}. Give the size of a "
        "pixel in µm; for a digital camera that of the sensor's, or any, with the principal distance to match."
    )


@dataclass(frozen=True)
class MeasuredFile:
    """Result of one scan file.

    Attributes
    ----------
    bytes_read : from the file; -1 where the system does not count them.
    thumbnails : cut from the decoded samples.
    """

    scan: MeasuredScan
    parts_hash: str
    bytes_read: int
    thumbnails: tuple[ThumbnailRow, ...] = ()


def measure_file(task: ScanTask) -> MeasuredFile:
    """Measure the scan of a task. Raises nothing but interrupts, like `measured_scan`."""
    before = _bytes_read()
    thumbnails = list[ThumbnailRow]()
    scan = measured_scan(task, lambda opened, measured: thumbnails.extend(thumbnail_rows(opened, measured)))
    bytes_read = _bytes_read() - before if before >= 0 else -1
    parts = parts_hash(scan_path(task.scan)) if task.scan else ""
    return MeasuredFile(scan, parts, bytes_read, tuple(thumbnails))


def _bytes_read() -> int:
    """Bytes read by this process from any file or address; mapped pages are not counted."""
    if not sys.platform.startswith("linux"):
        return -1
    try:
        return int(_COUNTED.read_text(encoding="ascii").split("rchar:")[1].split()[0]) + TRAFFIC.bytes
    except (OSError, IndexError, ValueError):
        return -1
