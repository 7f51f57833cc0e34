"""Scans to marks: the fiducials of every frame first, then the targets that they make predictable."""

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from measure.checks.judgement import judged
from measure.checks.lost_pixels import with_damage
from measure.checks.pitch_check import pitch_problem
from measure.codes_and_boards.coma import one_definition
from measure.errors import MeasurementError
from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.marks.rendering import extent_px
from measure.results import FrameMeasurement, MarkMeasurement, Pose
from measure.scans.scan import Scan
from measure.scans.tone import Tone
from measure.writing.networks import MISSING, networks
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.learned_table import LearnedFrom
from pipeline.files.project_file import Project
from pipeline.measuring.camera_model import misplaced_principal_point
from pipeline.measuring.camera_plate import with_plates
from pipeline.measuring.learn_stage import learn_marks, pose_of
from pipeline.measuring.roll import poses_of_roll
from pipeline.measuring.sheet_check import with_checked_sheet
from pipeline.measuring.target_stage import check_targets, measure_targets
from pipeline.measuring.tie_stage import check_tie_names, with_ties
from pipeline.measuring.tone_stage import ScannerTones, scanner_tones
from pipeline.progress import Reporter
from pipeline.results.frames_file import with_same_frames
from pipeline.results.measured_scan import MeasuredScan
from pipeline.workers import processes, worker_pool


def measure_scans(project: Project, reporter: Reporter, learned_folder: Path) -> tuple[MeasuredScan, ...]:
    """Measure every scan of the project, in the order of their names.

    All are opened before the first is measured, so that a broken file is known at once. Raises InputError or
    MeasurementError for scans that cannot be read; a mark that cannot be measured is no error. learned_folder: where
    what is learned of marks is written.
    """
    if not project.scans:
        raise InputError(f'{project.path}: scans is missing: which pictures to measure, such as ["scans/*.tif"].')
    _check_anything_to_measure(project)
    check_targets(project)
    check_tie_names(project)
    _check_marks(project)
    _check_readable(project)
    with worker_pool(len(project.scans)) as workers:
        learned = learn_marks(project, reporter, workers, learned_folder)
        tones = scanner_tones(learned, reporter, workers)
        measured = _measured_scans(learned, tones, reporter, workers)
        scans = with_same_frames(_as_rolls(learned, tones, measured, workers))
        scans = _with_plates(project, scans)
        scans = _of_each_camera(project, scans, _at_one_definition)
        checked = with_checked_sheet(project, _of_each_camera(learned, scans, partial(_judged, learned)))
        if project.ties is None:
            return checked
        with reporter.stage("natural points sought in") as count:
            return with_ties(project, project.ties, checked, count, workers)


def _measured_scans(project: Project, tones: ScannerTones, reporter: Reporter, workers: Executor) -> list[MeasuredScan]:
    with reporter.stage("measured") as count:
        futures = {workers.submit(_timed, project, name, tones): name for name in project.scans}
        for done, future in enumerate(as_completed(futures), 1):
            _, seconds = future.result()
            count(futures[future], done, len(futures))
            if done == 1 < len(futures):
                reporter.say(expected_time(seconds, len(futures)))
    return [future.result()[0] for future in futures]


def _as_rolls(
    project: Project, tones: ScannerTones, measured: Sequence[MeasuredScan], workers: Executor
) -> list[MeasuredScan]:
    """The scans with the poses that all frames of a camera tell together; measured again where marks change names."""
    poses: dict[str, Pose] = {}
    for camera in project.cameras.values():
        own = [scan for scan in measured if project.camera_of(scan.frame.image) is camera]
        free = [scan for scan in own if pose_of(project, camera, scan.frame.image) == "auto"]
        poses |= poses_of_roll(free, camera.writing)
    renamed = {
        scan.frame.image: replace(project, pose=poses[scan.frame.image].name, writing="none")
        for scan in measured
        if scan.frame.image in poses and scan.frame.pose and scan.frame.pose.name != poses[scan.frame.image].name
    }
    again = {image: workers.submit(measure_scan, posed, image, tones) for image, posed in renamed.items()}
    scans = []
    for scan in measured:
        image = scan.frame.image
        new = again[image].result() if image in again else scan
        frame = replace(new.frame, pose=poses.get(image, scan.frame.pose), writing=scan.frame.writing)
        scans.append(replace(new, frame=frame))
    return scans


def _with_plates(project: Project, measured: Sequence[MeasuredScan]) -> list[MeasuredScan]:
    """The scans with what their cameras' plates say, in their order."""
    told: dict[str, MeasuredScan] = {}
    for camera in project.cameras.values():
        own = [scan for scan in measured if project.camera_of(scan.frame.image) is camera]
        told |= {scan.frame.image: scan for scan in with_plates(camera, own, project.cameras)}
    return [told[scan.frame.image] for scan in measured]


def _timed(project: Project, name: str, tones: ScannerTones) -> tuple[MeasuredScan, float]:
    """A scan measured, and the seconds that it took."""
    start = time.monotonic()
    return measure_scan(project, name, tones), time.monotonic() - start


def expected_time(first_s: float, scans: int) -> str:
    """What measuring all scans takes if each takes as long as the first, of which `processes` run at a time."""
    at_a_time = processes(scans)
    total_s = first_s * math.ceil(scans / at_a_time)
    told = f"{total_s / 60:.0f} minutes" if total_s >= 100 else f"{total_s:.0f} s"
    return f"about {told} for {scans} scans, if all take as long as the first: {first_s:.0f} s, {at_a_time} at a time"


def _of_each_camera(
    project: Project,
    measured: Sequence[MeasuredScan],
    change: Callable[[CameraFile, Sequence[MeasuredScan]], Sequence[FrameMeasurement]],
) -> list[MeasuredScan]:
    """The scans with the frames of each camera changed, all of a camera together."""
    frames = {scan.scan: scan.frame for scan in measured}
    for camera in project.cameras.values():
        own = [scan for scan in measured if project.camera_of(scan.frame.image) is camera]
        changed = change(camera, own)
        frames |= {scan.scan: frame for scan, frame in zip(own, changed, strict=True)}
    return [replace(scan, frame=frames[scan.scan]) for scan in measured]


def _at_one_definition(_: CameraFile, scans: Sequence[MeasuredScan]) -> list[FrameMeasurement]:
    """The crossings of boards in one definition of their place."""
    frames = [scan.frame for scan in scans]
    marks = one_definition([frame.marks for frame in frames])
    return [replace(frame, marks=own) for frame, own in zip(frames, marks, strict=True)]


def _judged(project: Project, camera: CameraFile, scans: Sequence[MeasuredScan]) -> Sequence[FrameMeasurement]:
    """The fiducials judged together, if the camera has any."""
    frames = [scan.frame for scan in scans]
    if not camera.drawn:
        return frames
    return judged(frames, camera.layout(), [scan.pitch_um for scan in scans], project.film_sigma_mm).frames


def _check_anything_to_measure(project: Project) -> None:
    """Without fiducials, targets and natural points comparator.csv would hold nothing."""
    sought = [one for camera in project.cameras.values() for one in camera.fiducials if not one.passed_over]
    if not sought and project.targets is None and project.ties is None:
        raise InputError(
            f"{project.path}: there is nothing to measure: {project.default_camera.path} has no fiducial that is not "
            "passed over, and the project neither [targets] nor [ties]. Add what the scans show."
        )


def _check_marks(project: Project) -> None:
    """One mark by itself tells neither the turn nor the scale of a frame."""
    for camera in project.cameras.values():
        if len(camera.drawn) + len(camera.learned) == 1:
            raise InputError(
                f"{camera.path} has one fiducial mark, and a frame is found by two or more. Add the others, or pass it "
                'over with mark = "none".'
            )


def _check_readable(project: Project) -> None:
    """Name every file that cannot be opened, not just the first."""
    messages = []
    for name in project.scans:
        try:
            with project.open_scan(name):
                pass
        except MeasurementError as error:
            messages.append(str(error))
    if messages:
        raise MeasurementError("\n".join(messages))


def measure_scan(project: Project, name: str, tones: ScannerTones | None = None) -> MeasuredScan:
    """Measure one scan of the project: its fiducials, then its targets. tones: what other scans said of their
    scanners' curves."""
    with project.open_scan(name) as scan:
        return _measured(project, name, scan, (tones or ScannerTones()).tone_of(project, name))


def _measured(project: Project, name: str, scan: Scan, tone: Tone) -> MeasuredScan:
    """tone: the curve that fiducials are seen through; targets have edges all round, and are measured as they are."""
    camera = project.camera_of(name)
    frame = _fiducials(project, name, scan.seen_through(tone), camera)
    pitch, problems, notes = _pitch(project, scan, camera, frame)
    frame = replace(frame, problems=(*frame.problems, *problems))
    curve = (frame.tone.note,) if frame.tone else ()
    file_notes = (f"{note[0].upper()}{note[1:]}." for note in scan.notes)
    notes = (*file_notes, *notes, *curve, *_missed_reading(project, frame))
    measured = MeasuredScan(scan.path, scan.width_px, scan.height_px, pitch, frame, notes)
    if misplaced := misplaced_principal_point(camera, measured):
        measured = replace(measured, frame=replace(frame, problems=(*frame.problems, misplaced)))
    measured = measure_targets(project, scan, measured)
    return replace(measured, frame=with_damage(scan, measured.frame))


def _fiducials(project: Project, name: str, scan: Scan, camera: CameraFile) -> FrameMeasurement:
    if all(fiducial.passed_over for fiducial in camera.fiducials):
        return FrameMeasurement(name, ())
    pitch = project.pitch_um or scan.pitch_um
    pose = pose_of(project, camera, scan.name)
    layout, options = camera.layout(), _options(project, pose)
    measured = measure_fiducials(scan, layout, pitch, options)
    if pitch is not None:
        source = "the project" if project.pitch_um is not None else "the scan's file"
        wrong = pitch_problem(measured, layout, pitch, source)
        measured = replace(measured, problems=(*measured.problems, wrong) if wrong else measured.problems)
    learned = camera.learned_from
    if learned is not None and project.pose == "auto" and scan.name in learned.alike and measured.pose is not None:
        measured = replace(measured, pose=_as_learned(learned, scan))
    return replace(measured, image=name, marks=_with_sizes(measured, camera, scan, pitch))


def _options(project: Project, pose: str) -> FiducialOptions:
    return FiducialOptions(pose, film_sigma_mm=project.film_sigma_mm, writing=project.writing)


def _missed_reading(project: Project, frame: FrameMeasurement) -> tuple[str, ...]:
    """A note where something would have been read, but nothing is there that reads."""
    undecided = project.writing == "pose" and frame.pose is not None and not frame.pose.decided
    asked = project.writing == "all" or undecided
    return (f"{MISSING[0].upper()}{MISSING[1:]}.",) if asked and networks() is None else ()


def _as_learned(learned: LearnedFrom, scan: Scan) -> Pose:
    if learned.clicked:
        return Pose(learned.pose, True, ("the clicks in it say so.",))
    like = f"it is taken to lie as {learned.scan}, from which its marks were learned: {learned.pose} is assumed."
    return Pose(learned.pose, False, (like,))


def _with_sizes(
    measured: FrameMeasurement, camera: CameraFile, scan: Scan, pitch_um: tuple[float, float] | None
) -> tuple[MarkMeasurement, ...]:
    """The marks with how large each is drawn in the scan, px, for whoever shows a picture of it."""
    if measured.px_per_mm is not None:
        px_per_mm = measured.px_per_mm
    elif pitch_um is not None:
        px_per_mm = 1000.0 / pitch_um[0]
    else:
        px_per_mm = scan.width_px / camera.layout().frame_mm[0]
    drawn = np.array([[px_per_mm, 0.0, 0.0], [0.0, -px_per_mm, 0.0]])
    extents = {mark.id: np.ptp(np.stack(extent_px(mark.mark, drawn)), axis=0).max() for mark in camera.layout().marks}
    return tuple(
        replace(mark, quality={**mark.quality, "size_px": float(extents[mark.point])}) for mark in measured.marks
    )


def _pitch(
    project: Project, scan: Scan, camera: CameraFile, frame: FrameMeasurement
) -> tuple[tuple[float, float], tuple[str, ...], tuple[str, ...]]:
    """The pitch of a scan in um, as the project, the file or the marks say it; what needs a look in it, and what is
    only worth knowing."""
    if project.pitch_um is not None:
        return project.pitch_um, (), ()
    if scan.pitch_um is not None:
        return scan.pitch_um, (), ()
    if frame.px_per_mm is not None:
        pitch = 1000.0 / frame.px_per_mm
        note = f"The pitch of {pitch:.2f} um is from the marks' separations, for {scan.pitch_note}."
        return (pitch, pitch), (), (note,)
    if camera.frame_mm is not None:
        pitch = 1000.0 * max(camera.frame_mm) / max(scan.width_px, scan.height_px)
        note = f"The pitch is not known ({scan.pitch_note}); {pitch:.1f} um is taken, as if the frame filled the scan."
        return (pitch, pitch), (note,), ()
    raise InputError(
        f"{project.path}: pitch_um is missing, and {scan.path.name} does not say it ({scan.pitch_note}). Give the size "
        "of a pixel in um; for a digital camera that of the sensor's, or any, with the principal distance to match."
    )
