"""The stages of the chain, each from files to files, so that any of them can be run alone and looked at.

What only one stage needs is imported by it: adjusting takes no pictures, and measuring no other program's adjustment.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version

from adjust.problem.result import Adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.adjusting.network import anything_to_adjust, check_transformation
from pipeline.errors import InputError, WriteError
from pipeline.files.images_file import WRITTEN, fill_images
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.publishing.made_from import MadeFrom, adjusted_from, measured_from
from pipeline.publishing.publishing import Unpublished, unpublished
from pipeline.report.data import ReportData
from pipeline.report.page import write_report
from pipeline.report_data import adjusted, measured
from pipeline.results.adjustment_file import write_adjustment
from pipeline.results.adjustment_reader import covariance_path
from pipeline.results.comparator_file import ComparatorPoint, read_comparator, write_comparator
from pipeline.results.fingerprints import of_file
from pipeline.results.frames_file import for_images, write_frames
from pipeline.results.measured_scan import MeasuredScan
from pipeline.results.measurement_file import write_measurement
from pipeline.summary import Summary, summarise
from pipeline.text.atomic import write_atomically
from pipeline.workers import worker_pool


def run_all(project: Project, reporter: Reporter) -> Summary:
    """Measure (where there are scans), adjust, visit the scans again, check, report. The results take the places of
    earlier ones together, at the end; where no adjustment is possible, the marks do."""
    check_transformation(project)
    with unpublished(project) as new:
        made_from = measured_from(project)
        scans = _measured_marks(project, made_from, new, reporter) if project.scans else ()
        try:
            adjustment = _adjusted_marks(project, scans, made_from, new, reporter)
            if adjustment is None:
                for path in (project.adjustment_path, covariance_path(project.adjustment_path), project.check_path):
                    new.remove(path)  # of an earlier run
            else:
                _write_adjustment(project, adjustment, new)
                _write_check(project, adjustment, new)
            summary = _reported(project, adjusted(project, new.at), new)
        except WriteError:
            raise
        except Exception:
            new.publish()  # hours of measuring are not lost for a wrong point number
            raise
        new.publish()
        _fill_images(project, scans)
        return summary


def run_measure(project: Project, reporter: Reporter) -> Summary:
    """Scans to comparator.csv."""
    with unpublished(project) as new:
        scans = _measured_marks(project, measured_from(project), new, reporter)
        data = measured(project, new.at)
        new.publish()
    _fill_images(project, scans)
    return summarise(data, {"comparator coordinates": project.comparator, "measurement": project.measurement_path})


def run_adjust(project: Project, reporter: Reporter) -> Summary:
    """comparator.csv to adjustment.json."""
    with unpublished(project) as new:
        with reporter.stage("adjusting") as count:
            count(project.comparator.name, 0, 1)
            # Not kept: what is written takes as much memory, and is read again for the summary.
            _write_adjustment(project, adjust_marks(project, _given_marks(project, new)), new)
        earlier = project.adjustment_path
        if earlier.exists() and of_file(earlier) != of_file(new.at(earlier)):
            new.remove(project.check_path)  # it belongs to the earlier one
        data = adjusted(project, new.at)
        new.publish()
    covariance = covariance_path(project.adjustment_path)
    return summarise(data, {"adjustment": project.adjustment_path, "covariance": covariance})


def run_check(project: Project, reporter: Reporter) -> Summary:
    """The adjustment, made anew from comparator.csv, against OpenCV's calibration."""
    with unpublished(project) as new:
        with reporter.stage("checking") as count:
            count(project.comparator.name, 0, 1)
            adjustment = adjust_marks(project, _given_marks(project, new))
            _write_adjustment(project, adjustment, new)
            _write_check(project, adjustment, new)
        data = adjusted(project, new.at)
        new.publish()
    return summarise(data, {"check": project.check_path})


def run_report(project: Project, reporter: Reporter) -> Summary:
    """What the earlier stages left, in report.html."""
    with unpublished(project) as new:
        _given_marks(project, new)
        with reporter.stage("reporting") as count:
            count(project.report_path.name, 0, 1)
            summary = _reported(project, adjusted(project, new.at), new)
        new.publish()
        return summary


def _measured_marks(
    project: Project, made_from: MadeFrom, new: Unpublished, reporter: Reporter
) -> tuple[MeasuredScan, ...]:
    from pipeline.measuring.measure_stage import measure_project

    with worker_pool(len(project.scans)) as workers:
        scans = measure_project(project, reporter, new.place(project.output / "learned"), workers)
    _write_marks(project, scans, made_from, new)
    return scans


def _adjusted_marks(
    project: Project, scans: Sequence[MeasuredScan], made_from: MadeFrom, new: Unpublished, reporter: Reporter
) -> Adjustment | None:
    """The adjustment, after a second visit to the scans where that found more; None where nothing is to be adjusted."""
    marks = _given_marks(project, new)
    if scans and not anything_to_adjust(project, marks):
        return None
    adjustment = adjust_marks(project, marks)
    from pipeline.adjusting.second_visit import measure_again

    again = measure_again(project, scans, adjustment, reporter)
    if again is None:
        return adjustment
    _write_marks(project, again, made_from, new)
    return adjust_marks(project, _given_marks(project, new))


def _given_marks(project: Project, new: Unpublished) -> tuple[ComparatorPoint, ...]:
    """The marks that this command, an earlier one or the user has left. Raises InputError where there are none."""
    path = new.at(project.comparator)
    if not path.exists():
        raise InputError(
            f"{project.comparator}: there is no such file. Run `reseau measure` first, or put the coordinates there."
        )
    return read_comparator(path)


def _write_marks(project: Project, scans: Sequence[MeasuredScan], made_from: MadeFrom, new: Unpublished) -> None:
    measurement = new.place(project.measurement_path)
    write_measurement(measurement, scans, project.output, made_from)
    pitch_um = {scan.frame.image: scan.pitch_um for scan in scans}
    write_comparator(new.place(project.comparator), [scan.frame for scan in scans], pitch_um, of_file(measurement))
    written = write_frames(new.place(project.frames_path), scans)
    if not written:
        new.remove(project.frames_path)


def _fill_images(project: Project, scans: Sequence[MeasuredScan]) -> None:
    """What was read on the film, where the user's own list has empty columns for it."""
    if project.images_path is not None:
        fill_images(project.images_path, for_images(scans, WRITTEN))


def _write_adjustment(project: Project, adjustment: Adjustment, new: Unpublished) -> None:
    made_from = adjusted_from(project, _given_marks(project, new))
    write_adjustment(adjustment, new.place(project.adjustment_path), made_from)


def _write_check(project: Project, adjustment: Adjustment, new: Unpublished) -> None:
    from pipeline.opencv_check.check import check_against_opencv

    made_from = {project.adjustment_path.name: of_file(new.at(project.adjustment_path))}
    check = {"reseau": version("reseau"), "made_from": made_from, **check_against_opencv(adjustment).to_json()}
    text = json.dumps(check, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_atomically(new.place(project.check_path), text)


def _reported(project: Project, data: ReportData, new: Unpublished) -> Summary:
    from pipeline.thumbnails import Thumbnails

    scans = data.measurement.values() if data.measurement else ()
    with Thumbnails(scans, project.max_pixels) as pictures:
        write_report(replace(data, thumbnail=pictures.of), new.place(project.report_path))
    files = {"comparator coordinates": project.comparator, "adjustment": project.adjustment_path}
    written = {word: path for word, path in files.items() if word != "adjustment" or data.adjustment}
    return summarise(data, {**written, "report": project.report_path})
