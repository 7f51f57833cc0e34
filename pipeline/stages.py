"""Stages of the processing chain, each from files to files, so that any one can be run and inspected separately.

Imports that a single stage needs are local to it: adjusting needs no image processing, measuring no other program's
adjustment.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from adjust.solution.result import Adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.adjusting.network import anything_to_adjust, check_transformation
from pipeline.adjusting.picture_turn import picture_turn
from pipeline.archive.checked_results import CheckRun, measured_scans, read_measurement, stored_check_run
from pipeline.archive.made_from import adjusted_from, differing
from pipeline.archive.results_database import Merged, ResultsDatabase, check_mergeable, merge
from pipeline.archive.schema import DamagedError, single_writer
from pipeline.archive.status import ArchiveStatus, archive_status
from pipeline.archive.thumbnails import ThumbnailDatabase, Thumbnails
from pipeline.archive.verdicts import Verdict
from pipeline.errors import InputError, WriteError
from pipeline.files.object_files import WRITTEN, fill_images
from pipeline.files.project_file import Project
from pipeline.provenance import hash_file
from pipeline.publishing import Unpublished, unpublished
from pipeline.report.data import ReportData
from pipeline.report.load import adjusted_data, frame_data, measured_data, note_stored_adjustment, report_data
from pipeline.report.page import write_frame_page, write_report
from pipeline.results import comparator_file
from pipeline.results.adjustment_file import covariance_path, read_adjustment, write_adjustment
from pipeline.results.measured_record import MeasuredScan, for_images, write_frames
from pipeline.results.record_json import write_record
from pipeline.summary import Summary, archive_summary, summarise
from pipeline.terminal import Reporter
from pipeline.workers import NotMeasured, WorkOptions

_ONE_BY_ONE = 2000  # scans; for more, the summary is read from the database: totals and what needs a look


def run_all(project: Project, reporter: Reporter, work: WorkOptions | None = None) -> Summary:
    """Measure (if there are scans), adjust, run the second pass, check, report.

    All results replace earlier ones together, at the end. Where no adjustment is possible, the marks are still
    published. A shard is only measured.
    """
    if work is not None and work.shard is not None:
        return run_measure(project, reporter, work)
    check_transformation(project)
    with _running(project, reporter, work, bool(project.scans)) as run:
        scans = read_measurement(project.measurement_path, run.measure()) if project.scans else ()
        try:
            adjustment = run.adjust_twice(scans)
            if adjustment is None:
                for path in (project.adjustment_path, covariance_path(project.adjustment_path), project.check_path):
                    run.new.remove(path)  # of an earlier run
            else:
                run.write_adjustment(adjustment, run.marks())
                run.write_check(adjustment)
            summary = run.report()
        except WriteError:
            raise
        except Exception:
            run.publish()  # keep hours of measuring in spite of, for example, a wrong point number
            raise
        run.publish()
        run.fill_images(scans)
        return summary


def run_measure(project: Project, reporter: Reporter, work: WorkOptions | None = None) -> Summary:
    """Measure scans into comparator.csv; a shard only into its own database, for `reseau merge`."""
    with _running(project, reporter, work, True) as run:
        if work is not None and work.shard is not None:
            part, parts = work.shard
            path = project.shard_path(part, parts)
            with ResultsDatabase(path) as database:
                run.measure_into(database)
            scans = archive_status(project, path).scans
            own = tuple(scan for scan in scans if scan.verdict not in (Verdict.WAITING, Verdict.OLD))
            return replace(archive_summary(ArchiveStatus(own), {f"part {part} of {parts}": path}), parts=parts)
        digest = run.measure()
        data = None
        if len(project.scans) <= _ONE_BY_ONE:
            data = note_stored_adjustment(measured_data(project, run.new.current_path), project)
        run.publish()
    if project.images_path is not None:
        run.fill_images(measured_scans(project.measurement_path, digest))
    files = {"comparator coordinates": project.comparator, "measurement": project.measurement_path}
    return summarise(data, files) if data is not None else archive_summary(archive_status(project), files)


def run_merge(project: Project, databases: Sequence[Path], reporter: Reporter) -> tuple[list[Merged], Summary]:
    """Merge the databases of shards into that of the project; if they hold all its scans, run the cross-scan checks and
    write comparator.csv."""
    check_mergeable(project.measurement_path, databases)
    path = project.measurement_path
    path.parent.mkdir(parents=True, exist_ok=True)
    with single_writer(path), ResultsDatabase(path) as database, ThumbnailDatabase(database.path) as thumbnails:
        taken = merge(database, databases)
        thumbnails.take(databases)
    try:
        return taken, run_measure(project, reporter, WorkOptions(only_kept=True))
    except NotMeasured:
        return taken, archive_summary(archive_status(project), {"measurement": project.measurement_path})


def run_adjust(project: Project, reporter: Reporter) -> Summary:
    """Adjust comparator.csv; write adjustment.json."""
    with _running(project, reporter) as run:
        with run.stage("adjusting", project.comparator.name):
            marks = run.marks()
            adjustment = adjust_marks(project, marks)
            run.write_adjustment(adjustment, marks)
            del adjustment  # it takes as much memory as the file that the summary reads
        earlier = project.adjustment_path
        if earlier.exists() and hash_file(earlier) != hash_file(run.new.current_path(earlier)):
            run.new.remove(project.check_path)  # it belongs to the earlier adjustment
        data = adjusted_data(project, run.new.current_path)
        run.new.publish()
    covariance = covariance_path(project.adjustment_path)
    return summarise(data, {"adjustment": project.adjustment_path, "covariance": covariance})


def run_check(project: Project, reporter: Reporter) -> Summary:
    """Repeat the adjustment of comparator.csv and compare it with OpenCV's calibration.

    Raises InputError where adjustment.json has other inputs; it is never written here.
    """
    path = project.adjustment_path
    with _running(project, reporter) as run:
        with run.stage("checking", project.comparator.name):
            marks = run.marks()
            if others := differing(read_adjustment(path).made_from, adjusted_from(project, marks)):
                what = f"is of other {' and '.join(others)} than there are now"
                raise InputError(f"{path}: {what}. Run `reseau adjust` first.")
            run.write_check(adjust_marks(project, marks))
        data = adjusted_data(project, run.new.current_path)
        run.new.publish()
    return summarise(data, {"check": project.check_path})


def run_report(project: Project, reporter: Reporter) -> Summary:
    """Write report.html from the results of the earlier stages."""
    with _running(project, reporter) as run:
        run.comparator()
        with run.stage("reporting", project.report_path.name):
            summary = run.report()
        run.new.publish()
        return summary


def run_plots(project: Project, folder: Path, reporter: Reporter) -> list[Path]:
    """Write the plots of all calibrated cameras to a folder. Raises InputError where there is none."""
    from pipeline.report.plots import write_plots

    with reporter.stage("plotting") as count:
        count(str(folder), 0, 1)
        return write_plots(report_data(project, lambda path: path), folder)


def run_frame_pages(project: Project, images: Sequence[str], reporter: Reporter) -> dict[str, Path]:
    """Write a page on each of some images; return {image: page}. Raises InputError for an unknown image."""
    with _running(project, reporter) as run, reporter.stage("reporting frame") as count:
        run.comparator()
        data = frame_data(project, run.new.current_path, frozenset(images))
        pages = {image: project.frame_page_path(image) for image in images}
        with run.thumbnails(data) as pictures:
            for done, (image, path) in enumerate(pages.items(), 1):
                count(image, done, len(pages))
                write_frame_page(replace(data, thumbnail=pictures.get), image, run.new.place(path))
        run.new.publish()
        return pages


@contextmanager
def _running(
    project: Project, reporter: Reporter, work: WorkOptions | None = None, measures: bool = False
) -> Iterator["_Run"]:
    shard = work.shard if work is not None else None
    database = project.measurement_path if shard is None else project.shard_path(*shard)
    with unpublished(project) as new, single_writer(database) if measures else nullcontext():
        yield _Run(project, new, reporter, work or WorkOptions())


@dataclass(frozen=True)
class _Run:
    """Stages of one command. new: their files, which replace earlier ones when they are published."""

    project: Project
    new: Unpublished
    reporter: Reporter
    work: WorkOptions

    @contextmanager
    def stage(self, title: str, file: str) -> Iterator[None]:
        with self.reporter.stage(title) as count:
            count(file, 0, 1)
            yield

    def measure(self) -> str:
        """Measure the missing scans, write the marks of all scans, and return the digest of their check run."""
        with ResultsDatabase(self.project.measurement_path) as database:
            try:
                return self._measure_and_write(database)
            except DamagedError as error:  # of a mark: detected only when it is read
                if self.work.only_kept:
                    raise
                self.reporter.say(str(error))
                database.forget_damaged()
                return self._measure_and_write(database)

    def _measure_and_write(self, database: ResultsDatabase) -> str:
        check_run = self.measure_into(database)
        assert check_run is not None  # it is no shard
        if not check_run.is_written(self.project.comparator):
            self._write_marks(check_run)
        return check_run.digest

    def measure_into(self, database: ResultsDatabase) -> CheckRun | None:
        """Measure the missing scans of the project or of a shard."""
        from pipeline.archive.measure_archive import measure_archive

        learned = self.new.place(self.project.output / "learned")
        return measure_archive(self.project, database, learned, self.reporter, self.work)

    def adjust_twice(self, scans: Sequence[MeasuredScan]) -> Adjustment | None:
        """Adjustment, repeated after a second pass that found more targets; None where there is nothing to adjust."""
        project, marks = self.project, self.marks()
        if scans and not anything_to_adjust(project, marks):
            return None
        adjustment = adjust_marks(project, marks)
        if not scans:
            return adjustment
        from pipeline.adjusting.second_pass import measure_again
        from pipeline.archive.measure_archive import open_executor

        again = measure_again(project, scans, adjustment, self.reporter, lambda: open_executor(project, self.work))
        if again is None:
            return adjustment
        with self._check_run() as before:
            assert before is not None
            self._write_marks(before.store_second_pass(again, project.adjust))
        return adjust_marks(project, self.marks())

    def marks(self) -> tuple[comparator_file.ComparatorPoint, ...]:
        """Marks of comparator.csv, from this command, an earlier one or the user."""
        return comparator_file.read_comparator(self.comparator(), self.project.list_pitch_um)

    def comparator(self) -> Path:
        """Path of comparator.csv. Raises InputError where it does not exist."""
        given = self.project.comparator
        path = self.new.current_path(given)
        if not path.exists():
            raise InputError(
                f"{given}: there is no such file. Run `reseau measure` first, or put the coordinates there."
            )
        return path

    def _check_run(self) -> AbstractContextManager[CheckRun | None]:
        """Check run that comparator.csv names; None where it is not from the results database."""
        project = self.project
        return stored_check_run(
            project.measurement_path, comparator_file.read_measurement_hash(self.new.current_path(project.comparator))
        )

    def _write_marks(self, check_run: CheckRun) -> None:
        project, new, decisions = self.project, self.new, check_run.decisions()
        for camera in project.cameras.values():
            if camera.clicks is not None and camera.clicks.who:  # the clicks count as one more decision
                who = camera.path.name, camera.clicks.who
                decisions[who] = decisions.get(who, 0) + 1
        place = new.place(project.comparator)
        comparator_file.write_comparator(place, check_run.points(), check_run.pitches_um(), check_run.digest, decisions)
        if not write_frames(new.place(project.frames_path), check_run.written_scans()):
            new.remove(project.frames_path)

    def publish(self) -> None:
        """Publish all results, then delete earlier check runs, which no file names any more."""
        self.new.publish()
        if not (self.project.scans and self.project.comparator.exists()):
            return
        with self._check_run() as check_run:
            if check_run is not None:
                check_run.drop_others()
                check_run.remember_written(self.project.comparator)

    def fill_images(self, scans: Iterable[MeasuredScan]) -> None:
        """Fill empty columns of the user's images.csv with the writing read on the film."""
        if self.project.images_path is not None:
            fill_images(self.project.images_path, for_images(scans, WRITTEN))

    def write_adjustment(self, adjustment: Adjustment, marks: Sequence[comparator_file.ComparatorPoint]) -> None:
        project = self.project
        with self._check_run() as check_run:
            sizes = check_run.sizes_mm() if check_run is not None else {}
        frames_mm: dict[str, tuple[float, float]] = {}  # by camera; without fiducials and frame size, its largest image
        for image, size in sizes.items():
            camera = project.image_camera(image)
            if not camera.fiducials:
                frames_mm[camera.name] = max(frames_mm.get(camera.name, size), size)
        frames_mm |= {each.name: each.frame_mm for each in project.cameras.values() if each.frame_mm is not None}
        path = self.new.place(project.adjustment_path)
        write_adjustment(adjustment, path, adjusted_from(project, marks), frames_mm)

    def write_check(self, adjustment: Adjustment) -> None:
        from pipeline.opencv_check.check import BoardPictures, check_against_opencv, detector_name

        project, path, pictures = self.project, self.project.adjustment_path, None
        board = project.targets.board if project.targets else None
        if board is not None and project.scans and detector_name(board):
            pitch_um = comparator_file.read_pitches(self.new.current_path(project.comparator))
            if project.pitch_um:
                pitch_um = dict.fromkeys(project.scans, project.pitch_um) | pitch_um
            images = project.given_images.turned_deg if project.given_images else {}
            turned = {image: picture_turn(project, image) for image in images}
            pictures = BoardPictures(board, project.open_scan, pitch_um, turned)
        found = check_against_opencv(adjustment, pictures)
        made_from = {path.name: hash_file(self.new.current_path(path))}
        content = replace(found, reseau=version("reseau"), made_from=made_from)
        write_record(content, self.new.place(project.check_path))

    def report(self) -> Summary:
        """Write the report of what has been measured and adjusted."""
        project, data = self.project, report_data(self.project, self.new.current_path)
        with self.thumbnails(data) as pictures:
            write_report(replace(data, thumbnail=pictures.get), self.new.place(project.report_path))
        adjustment = {"adjustment": project.adjustment_path} if data.adjustment else {}
        return summarise(
            data, {"comparator coordinates": project.comparator, **adjustment, "report": project.report_path}
        )

    def thumbnails(self, data: ReportData) -> Thumbnails:
        """Thumbnails of the marks in the data."""
        scans, path = data.measurement or {}, self.project.measurement_path
        with stored_check_run(path, data.made_from.get(path.name, "")) as check_run:
            keys = check_run.fingerprints(scans) if check_run is not None else {}
        return Thumbnails(scans.values(), self.project.max_pixels, path, keys)
