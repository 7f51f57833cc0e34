"""Stages of the processing chain, each from files to files, so that any one can be run and inspected separately.

Imports that a single stage needs are local to it: adjusting needs no image processing, measuring no other program's
adjustment.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from adjust.solution.result import Adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.adjusting.network import anything_to_adjust, check_transformation
from pipeline.adjusting.turned_pictures import sensor_size_mm
from pipeline.archive.checked_statuses import (
    checked_marks,
    drop_all_but,
    find_judging,
    marks_as_written,
    rejudge,
    remember_written,
)
from pipeline.archive.measurement import (
    count_decisions,
    measured_scans,
    picture_sizes_mm,
    pitches,
    read_fingerprints,
    read_measurement,
    remember_place,
    written_scans,
)
from pipeline.archive.results_database import Merged, Store, merge
from pipeline.archive.results_integrity import DamagedError
from pipeline.archive.thumbnails import ThumbnailStore
from pipeline.errors import InputError, WriteError
from pipeline.files.images_file import WRITTEN, fill_images
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.provenance import hash_file
from pipeline.publishing.made_from import adjusted_from, differing, measured_from
from pipeline.publishing.publishing import Unpublished, unpublished
from pipeline.report.data import ReportData
from pipeline.report.load import adjusted_data, frame_data, measured_data, report_data
from pipeline.report.page import write_frame_page, write_report
from pipeline.results.adjustment_file import read_adjustment, write_adjustment
from pipeline.results.comparator_file import (
    ComparatorPoint,
    read_comparator,
    read_measurement_hash,
    read_pitches,
    write_comparator,
)
from pipeline.results.covariance_file import covariance_path
from pipeline.results.frames_file import for_images, write_frames
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.record_json import write_record
from pipeline.summary import Summary, archive_summary, shard_summary, summarise
from pipeline.workers import NotMeasured, WorkOptions

if TYPE_CHECKING:
    from pipeline.archive.thumbnails import Thumbnails
    from pipeline.opencv_check.opencv_corners import BoardPictures

_ONE_BY_ONE = 2000  # scans; for more, the summary is read from the store: totals and what needs a look


def run_all(project: Project, reporter: Reporter, work: WorkOptions | None = None) -> Summary:
    """Measure (if there are scans), adjust, run the second pass, check, report.

    All results replace earlier ones together, at the end. Where no adjustment is possible, the marks are still
    published. A shard is only measured.
    """
    if work is not None and work.shard is not None:
        return run_measure(project, reporter, work)
    check_transformation(project)
    with unpublished(project) as new:
        scans = _measured_marks(project, new, reporter, work) if project.scans else ()
        try:
            adjustment = _adjusted_marks(project, scans, new, reporter, work)
            if adjustment is None:
                for path in (project.adjustment_path, covariance_path(project.adjustment_path), project.check_path):
                    new.remove(path)  # of an earlier run
            else:
                _write_adjustment(project, adjustment, new)
                _write_check(project, adjustment, new)
            summary = _reported(project, new)
        except WriteError:
            raise
        except Exception:
            _publish(project, new)  # keep hours of measuring in spite of, for example, a wrong point number
            raise
        _publish(project, new)
        _fill_images(project, scans)
        return summary


def run_measure(project: Project, reporter: Reporter, work: WorkOptions | None = None) -> Summary:
    """Measure scans into comparator.csv; a shard only into its own store, for `reseau merge`."""
    if work is not None and work.shard is not None:
        return _measured_shard(project, reporter, work, work.shard)
    with unpublished(project) as new:
        digest = _measure(project, new, reporter, work)
        data = measured_data(project, new.current_path) if len(project.scans) <= _ONE_BY_ONE else None
        _publish(project, new)
    if project.images_path is not None:
        _fill_images(project, measured_scans(project.measurement_path, digest))
    files = {"comparator coordinates": project.comparator, "measurement": project.measurement_path}
    return summarise(data, files) if data is not None else archive_summary(project, files)


def run_merge(project: Project, stores: Sequence[Path], reporter: Reporter) -> tuple[list[Merged], Summary]:
    """Merge the stores of shards into that of the project; if they hold all its scans, run the cross-scan checks and
    write comparator.csv."""
    with Store(project.measurement_path) as store, ThumbnailStore.open(store.path) as thumbnails:
        taken = merge(store, stores)
        thumbnails.take(stores)
    try:
        return taken, run_measure(project, reporter, WorkOptions(only_kept=True))
    except NotMeasured:
        return taken, archive_summary(project, {"measurement": project.measurement_path})


def run_adjust(project: Project, reporter: Reporter) -> Summary:
    """Adjust comparator.csv; write adjustment.json."""
    with unpublished(project) as new:
        with reporter.stage("adjusting") as count:
            count(project.comparator.name, 0, 1)
            # The result is not kept: it takes as much memory as the file that the summary reads.
            _write_adjustment(project, adjust_marks(project, _given_marks(project, new)), new)
        earlier = project.adjustment_path
        if earlier.exists() and hash_file(earlier) != hash_file(new.current_path(earlier)):
            new.remove(project.check_path)  # it belongs to the earlier adjustment
        data = adjusted_data(project, new.current_path)
        new.publish()
    covariance = covariance_path(project.adjustment_path)
    return summarise(data, {"adjustment": project.adjustment_path, "covariance": covariance})


def run_check(project: Project, reporter: Reporter) -> Summary:
    """Repeat the adjustment of comparator.csv and compare it with OpenCV's calibration.

    Raises InputError where adjustment.json has other inputs; it is never written here.
    """
    with unpublished(project) as new:
        with reporter.stage("checking") as count:
            count(project.comparator.name, 0, 1)
            marks = _given_marks(project, new)
            _check_adjusted(project, marks)
            _write_check(project, adjust_marks(project, marks), new)
        data = adjusted_data(project, new.current_path)
        new.publish()
    return summarise(data, {"check": project.check_path})


def run_report(project: Project, reporter: Reporter) -> Summary:
    """Write report.html from the results of the earlier stages."""
    with unpublished(project) as new:
        _comparator(project, new)
        with reporter.stage("reporting") as count:
            count(project.report_path.name, 0, 1)
            summary = _reported(project, new)
        new.publish()
        return summary


def run_plots(project: Project, folder: Path, reporter: Reporter) -> list[Path]:
    """Write the plots of all calibrated cameras to a folder. Raises InputError where there is none."""
    from pipeline.report.plots import write_plots

    with reporter.stage("plotting") as count:
        count(str(folder), 0, 1)
        return write_plots(report_data(project, lambda path: path), folder)


def run_frame_pages(project: Project, images: Sequence[str], reporter: Reporter) -> dict[str, Path]:
    """Write a page on each of some images; return {image: page}. Raises InputError for an unknown image."""
    with unpublished(project) as new, reporter.stage("reporting") as count:
        _comparator(project, new)
        data = frame_data(project, new.current_path, frozenset(images))
        pages = {image: project.frame_page_path(image) for image in images}
        with _thumbnails(project, data) as pictures:
            for done, (image, path) in enumerate(pages.items()):
                count(image, done, len(pages))
                write_frame_page(replace(data, thumbnail=pictures.get), image, new.place(path))
        new.publish()
        return pages


def _measured_shard(project: Project, reporter: Reporter, work: WorkOptions, shard: tuple[int, int]) -> Summary:
    from pipeline.archive.measure_archive import measure_archive

    path = project.shard_path(*shard)
    with unpublished(project) as new, Store(path) as store:
        measure_archive(project, store, dict, new.place(project.output / "learned"), reporter, work)
    return shard_summary(project, path, shard)


def _measured_marks(
    project: Project, new: Unpublished, reporter: Reporter, work: WorkOptions | None
) -> tuple[MeasuredScan, ...]:
    return read_measurement(project.measurement_path, _measure(project, new, reporter, work))


def _measure(project: Project, new: Unpublished, reporter: Reporter, work: WorkOptions | None) -> str:
    """Measure the missing scans, write the marks of all scans, and return the digest of their judging."""
    from pipeline.archive.measure_archive import measure_archive

    with Store(project.measurement_path) as store:

        def measured_and_written(options: WorkOptions | None) -> str:
            remember_place(store, project.path.parent)
            learned = new.place(project.output / "learned")
            digest = measure_archive(project, store, lambda: measured_from(project), learned, reporter, options)
            if not marks_as_written(store, digest, project.comparator):
                _write_marks(project, store, digest, new)
            return digest

        try:
            return measured_and_written(work)
        except DamagedError as error:  # of a mark: detected only when it is read
            if work is not None and work.only_kept:
                raise
            reporter.say(str(error))
            store.forget_damaged()
            return measured_and_written(work)


def _adjusted_marks(
    project: Project, scans: Sequence[MeasuredScan], new: Unpublished, reporter: Reporter, work: WorkOptions | None
) -> Adjustment | None:
    """Adjustment, repeated after a second pass that found more targets; None where there is nothing to adjust."""
    marks = _given_marks(project, new)
    if scans and not anything_to_adjust(project, marks):
        return None
    adjustment = adjust_marks(project, marks)
    if not scans:
        return adjustment
    from pipeline.adjusting.second_visit import measure_again
    from pipeline.archive.measure_archive import open_executor

    again = measure_again(project, scans, adjustment, reporter, lambda: open_executor(project, work or WorkOptions()))
    if again is None:
        return adjustment
    _write_again(project, again, new)
    return adjust_marks(project, _given_marks(project, new))


def _given_marks(project: Project, new: Unpublished) -> tuple[ComparatorPoint, ...]:
    """Marks of comparator.csv, from this command, an earlier one or the user. Raises InputError where there are
    none."""
    return read_comparator(_comparator(project, new), project.list_pitch_um)


def _comparator(project: Project, new: Unpublished) -> Path:
    """Path of comparator.csv. Raises InputError where it does not exist."""
    path = new.current_path(project.comparator)
    if not path.exists():
        raise InputError(
            f"{project.comparator}: there is no such file. Run `reseau measure` first, or put the coordinates there."
        )
    return path


def _write_again(project: Project, scans: Sequence[MeasuredScan], new: Unpublished) -> None:
    """Store and write the marks after a second pass, in place of those before it."""
    with Store(project.measurement_path) as store:
        before = find_judging(store, read_measurement_hash(new.current_path(project.comparator)))
        assert before is not None
        digest = rejudge(store, before, scans)
        _write_marks(project, store, digest, new)


def _write_marks(project: Project, store: Store, digest: str, new: Unpublished) -> None:
    judging = find_judging(store, digest)
    assert judging is not None
    decisions = count_decisions(store, digest)
    for camera in project.cameras.values():
        if camera.clicks is not None and camera.clicks.who:  # the clicks count as one more decision
            who = camera.path.name, camera.clicks.who
            decisions[who] = decisions.get(who, 0) + 1
    marks = checked_marks(store, judging)
    write_comparator(new.place(project.comparator), marks, pitches(store, digest), digest, decisions)
    if not write_frames(new.place(project.frames_path), written_scans(store, digest)):
        new.remove(project.frames_path)


def _publish(project: Project, new: Unpublished) -> None:
    """Publish all results, then delete earlier judgings, which no file names any more."""
    new.publish()
    if not (project.scans and project.measurement_path.exists() and project.comparator.exists()):
        return
    digest = read_measurement_hash(project.comparator)
    with Store(project.measurement_path) as store:
        if find_judging(store, digest) is not None:
            drop_all_but(store, digest)
            remember_written(store, digest, project.comparator)


def _fill_images(project: Project, scans: Iterable[MeasuredScan]) -> None:
    """Fill empty columns of the user's images.csv with the writing read on the film."""
    if project.images_path is not None:
        fill_images(project.images_path, for_images(scans, WRITTEN))


def _write_adjustment(project: Project, adjustment: Adjustment, new: Unpublished) -> None:
    made_from = adjusted_from(project, _given_marks(project, new))
    write_adjustment(adjustment, new.place(project.adjustment_path), made_from, _frames_mm(project, new))


def _frames_mm(project: Project, new: Unpublished) -> dict[str, tuple[float, float]]:
    """{camera: size of its frame, mm}; for a camera without fiducials and frame size, that of its largest image."""
    sizes = picture_sizes_mm(project.measurement_path, read_measurement_hash(new.current_path(project.comparator)))
    largest: dict[str, tuple[float, float]] = {}
    for image, size in sizes.items():
        camera = project.image_camera(image)
        if not camera.fiducials:
            largest[camera.name] = max(largest.get(camera.name, size), size)
    return largest | {each.name: each.frame_mm for each in project.cameras.values() if each.frame_mm is not None}


def _check_adjusted(project: Project, marks: Sequence[ComparatorPoint]) -> None:
    """Raise InputError where adjustment.json was made from other inputs."""
    path = project.adjustment_path
    made_from = read_adjustment(path).made_from
    if others := differing(made_from, adjusted_from(project, marks)):
        raise InputError(f"{path}: is of other {' and '.join(others)} than there are now. Run `reseau adjust` first.")


def _write_check(project: Project, adjustment: Adjustment, new: Unpublished) -> None:
    from pipeline.opencv_check.check import check_against_opencv

    made_from = {project.adjustment_path.name: hash_file(new.current_path(project.adjustment_path))}
    found = check_against_opencv(adjustment, _board_pictures(project, new))
    write_record(replace(found, reseau=version("reseau"), made_from=made_from), new.place(project.check_path))


def _board_pictures(project: Project, new: Unpublished) -> "BoardPictures | None":
    """Images of the board for OpenCV; None where there is no scan, or OpenCV has no detector for it."""
    from pipeline.opencv_check.opencv_corners import BoardPictures, detector_name

    board = project.targets.board if project.targets else None
    if board is None or not project.scans or not detector_name(board):
        return None
    pitch_um = read_pitches(new.current_path(project.comparator))
    if project.pitch_um:
        pitch_um = dict.fromkeys(project.scans, project.pitch_um) | pitch_um
    images = project.given_images.turned_deg if project.given_images else {}
    turned = {image: (turned_deg, sensor_size_mm(project, image)) for image, turned_deg in images.items()}
    return BoardPictures(board, project.open_scan, pitch_um, turned)


def _reported(project: Project, new: Unpublished) -> Summary:
    data = report_data(project, new.current_path)
    with _thumbnails(project, data) as pictures:
        write_report(replace(data, thumbnail=pictures.get), new.place(project.report_path))
    files = {"comparator coordinates": project.comparator, "adjustment": project.adjustment_path}
    written = {word: path for word, path in files.items() if word != "adjustment" or data.adjustment}
    return summarise(data, {**written, "report": project.report_path})


def _thumbnails(project: Project, data: ReportData) -> "Thumbnails":
    """Thumbnails of the marks in the data."""
    from pipeline.archive.thumbnails import Thumbnails

    scans, path = data.measurement or {}, project.measurement_path
    keys = read_fingerprints(path, data.made_from.get(path.name, ""), scans)
    return Thumbnails(scans.values(), project.max_pixels, path, keys)
