"""The stages of the chain, each from files to files, so that any of them can be run alone and looked at."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from adjust.result import Adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.adjusting.adjustment_file import write_adjustment
from pipeline.adjusting.network import anything_to_adjust, check_transformation
from pipeline.adjusting.second_visit import measure_again
from pipeline.errors import InputError
from pipeline.files.adjustment_reader import covariance_path, read_adjustment, read_covariance
from pipeline.files.atomic import check_writable, write_atomically
from pipeline.files.project_file import Project
from pipeline.measuring.comparator_file import ComparatorPoint, read_comparator, write_comparator
from pipeline.measuring.measure_stage import measure_scans
from pipeline.measuring.measurement_file import MeasuredScan, read_measurement, write_measurement
from pipeline.opencv_check.check import check_against_opencv
from pipeline.progress import Reporter
from pipeline.report.data import ReportData
from pipeline.report.page import write_report
from pipeline.summary import Summary, summarise
from pipeline.thumbnails import Thumbnails

Json = dict[str, Any]


def run_all(project: Project, reporter: Reporter) -> Summary:
    """Measure (where there are scans), adjust, visit the scans again, check, report."""
    scans: tuple[MeasuredScan, ...] = ()
    _check_writable(project)
    check_transformation(project)
    if project.scans:
        scans = measure_scans(project, reporter)
        _write_marks(project, scans)
        if not anything_to_adjust(project, read_comparator(project.comparator)):
            return _reported(project, _measured(project))
    adjustment = adjust_marks(project, read_comparator(project.comparator))
    again = measure_again(project, scans, adjustment, reporter)
    if again is not None:
        _write_marks(project, again)
        adjustment = adjust_marks(project, read_comparator(project.comparator))
    write_adjustment(adjustment, project.adjustment_path)
    _write_check(project, adjustment)
    return _reported(project, _adjusted(project))


def run_measure(project: Project, reporter: Reporter) -> Summary:
    """Scans to comparator.csv."""
    _check_writable(project)
    _write_marks(project, measure_scans(project, reporter))
    return summarise(
        _measured(project), {"comparator coordinates": project.comparator, "measurement": project.measurement_path}
    )


def run_adjust(project: Project, reporter: Reporter) -> Summary:
    """comparator.csv to adjustment.json."""
    with reporter.stage("adjusting") as count:
        count(project.comparator.name, 0, 1)
        adjustment = adjust_marks(project, _given_marks(project))
    write_adjustment(adjustment, project.adjustment_path)
    project.check_path.unlink(missing_ok=True)  # it belongs to an earlier adjustment
    covariance = covariance_path(project.adjustment_path)
    return summarise(_adjusted(project), {"adjustment": project.adjustment_path, "covariance": covariance})


def run_check(project: Project, reporter: Reporter) -> Summary:
    """The adjustment, made anew from comparator.csv, against OpenCV's calibration."""
    with reporter.stage("checking") as count:
        count(project.comparator.name, 0, 1)
        adjustment = adjust_marks(project, _given_marks(project))
        write_adjustment(adjustment, project.adjustment_path)
        _write_check(project, adjustment)
    return summarise(_adjusted(project), {"check": project.check_path})


def run_report(project: Project, reporter: Reporter) -> Summary:
    """What the earlier stages left, in report.html."""
    _given_marks(project)
    with reporter.stage("reporting") as count:
        count(project.report_path.name, 0, 1)
        return _reported(project, _adjusted(project))


def _check_writable(project: Project) -> None:
    for folder in (project.output, project.comparator.parent):
        check_writable(folder)


def _given_marks(project: Project) -> tuple[ComparatorPoint, ...]:
    """The marks that an earlier stage, or the user, has left. Raises InputError where there are none."""
    if not project.comparator.exists():
        raise InputError(
            f"{project.comparator}: there is no such file. Run `reseau measure` first, or put the coordinates there."
        )
    return read_comparator(project.comparator)


def _write_marks(project: Project, scans: Sequence[MeasuredScan]) -> None:
    write_measurement(project.measurement_path, scans)
    write_comparator(project.comparator, [s.frame for s in scans], {s.frame.image: s.pitch_um for s in scans})


def _write_check(project: Project, adjustment: Adjustment) -> None:
    check = check_against_opencv(adjustment).to_json()
    write_atomically(project.check_path, json.dumps(check, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _reported(project: Project, data: ReportData) -> Summary:
    scans = read_measurement(project.measurement_path) if data.measurement else ()
    with Thumbnails(scans, project.max_pixels) as pictures:
        write_report(replace(data, thumbnail=pictures.of), project.report_path)
    files = {"comparator coordinates": project.comparator, "adjustment": project.adjustment_path}
    return summarise(data, {**{w: p for w, p in files.items() if p.exists()}, "report": project.report_path})


def _measured(project: Project) -> ReportData:
    """What the measurement left in the project's files."""
    return ReportData(
        project=_title(project),
        comparator=read_comparator(project.comparator),
        measurement=_json(project.measurement_path),
        frame_mm=_frame_sizes(project),
        unit=project.unit,
    )


def _adjusted(project: Project) -> ReportData:
    """The same with the adjustment and its check, as far as there are any."""
    path = project.adjustment_path
    if not path.exists():
        return _measured(project)
    return replace(
        _measured(project),
        adjustment=read_adjustment(path),
        covariance=read_covariance(path),
        check=_json(project.check_path),
    )


def _title(project: Project) -> str:
    """The project's folder, unless the project file has a name of its own."""
    stem = project.path.stem
    return project.path.resolve().parent.name if stem == "project" else stem


def _json(path: Path) -> Json | None:
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise InputError(f"{path}: is not valid JSON ({error}). Delete it and run the stage again.") from None
    return content


def _frame_sizes(project: Project) -> Mapping[str, tuple[float, float]]:
    return {camera.name: camera.frame_mm for camera in project.cameras.values() if camera.frame_mm is not None}
