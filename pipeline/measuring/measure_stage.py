"""Scans to marks, in three steps: each scan by itself, the scans of each camera, those of the project."""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from measure.errors import MeasurementError
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.measuring.checked import CheckedScan, checked
from pipeline.measuring.learn_stage import learn_marks
from pipeline.measuring.measured import measure_scans
from pipeline.measuring.natural_points import check_tie_names
from pipeline.measuring.roll import roll_of, with_known_lines
from pipeline.measuring.scan_task import Measure, ScanTask, scan_tasks
from pipeline.measuring.tied import TiedScan, tied
from pipeline.measuring.tone_stage import said_of_tones
from pipeline.progress import Reporter
from pipeline.results.measured_scan import MeasuredScan
from pipeline.workers import processes


def measure_project(
    project: Project,
    reporter: Reporter,
    learned_folder: Path,
    executor: Executor | None = None,
    measure: Measure | None = None,
) -> tuple[TiedScan, ...]:
    """Measure every scan of the project, in the order of their names, also those that images.csv names and nobody has.

    A scan that fails is a result with a reason, and a mark that cannot be measured one with a status. Raises InputError
    for what is wrong in the user's own files, before anything is measured, and MeasurementError where no scan at all
    could be measured. learned_folder: where what is learned of marks is written. executor: what shares the work; None:
    nothing does. measure: how scans are measured, if not by `measure_scans`: by results that were kept, say.
    """
    measure = measure or partial(measure_scans, executor=executor)
    names = check_measurable(project)
    learned = learn_marks(project, reporter, measure, executor, learned_folder)
    tasks = scan_tasks(learned, names, said_of_tones(learned, reporter, measure))
    tasks, read = with_known_lines(tasks, measure, reporter)
    measured = _measured(tasks, read, measure, reporter)
    if all(scan.failure for scan in measured.values()):
        raise MeasurementError("\n".join(dict.fromkeys(s.failure.sentence for s in measured.values() if s.failure)))
    return tied(learned, _checked(learned, tasks, measured, measure), reporter, executor)


def check_measurable(project: Project) -> tuple[str, ...]:
    """The names of the images that are to be measured. Raises InputError for what is wrong in the user's own files."""
    if not project.scans:
        raise InputError(f'{project.path}: scans is missing: which pictures to measure, such as ["scans/*.tif"].')
    _check_anything_to_measure(project)
    check_tie_names(project)
    _check_marks(project)
    listed = project.given_images.exterior if project.given_images else {}
    names = (*project.scans, *(name for name in listed if name not in project.scans and name not in project.left_out))
    scan_tasks(project, names)  # raises for targets that nothing names and for marks that nobody has drawn
    return names


def _measured(
    tasks: Sequence[ScanTask], read: Mapping[str, MeasuredScan], measure: Measure, reporter: Reporter
) -> Mapping[str, MeasuredScan]:
    """The first step, by image in the order of the tasks. read: what was measured before."""
    measured, left = dict(read), [task for task in tasks if task.name not in read]
    with reporter.stage("measured") as count:
        for done, scan in enumerate(measure(left), 1):
            measured[scan.frame.image] = scan
            count(scan.frame.image, done, len(left))
            if done == 1 < len(left):
                reporter.say(expected_time(scan.seconds, len(left)))
    return {task.name: measured[task.name] for task in tasks}


def _checked(
    project: Project, tasks: Sequence[ScanTask], measured: Mapping[str, MeasuredScan], measure: Measure
) -> list[CheckedScan]:
    """The second step, camera by camera. Scans whose marks change names beside the others are measured again."""
    told = dict[str, CheckedScan]()
    for camera in project.cameras.values():
        own = [task for task in tasks if project.camera_of(task.name) is camera]
        scans = [measured[task.name] for task in own]
        roll = roll_of(own, scans, camera.writing)
        again = measure(roll.tasks) if roll.tasks else ()
        results = checked(camera, scans, roll, again, project.film_sigma_mm)
        told |= {scan.frame.image: scan for scan in results}
    return [told[task.name] for task in tasks]


def expected_time(first_s: float, scans: int) -> str:
    """What measuring all scans takes if each takes as long as the first, of which `processes` run at a time."""
    at_a_time = processes(scans)
    total_s = first_s * math.ceil(scans / at_a_time)
    told = f"{total_s / 60:.0f} minutes" if total_s >= 100 else f"{total_s:.0f} s"
    return f"about {told} for {scans} scans, if all take as long as the first: {first_s:.0f} s, {at_a_time} at a time"


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
