"""Measure the missing scans of a project, and store each as soon as it is done."""

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import lru_cache, partial
from itertools import chain
from statistics import fmean

import numpy as np

from measure.errors import MeasurementError
from measure.scans.remote import scan_path, whole_file
from pipeline.archive import review_decisions
from pipeline.archive.checked_results import CheckedResult
from pipeline.archive.results_database import Kept, ResultsDatabase
from pipeline.archive.thumbnails import ThumbnailDatabase
from pipeline.files.decisions_file import About, Decision
from pipeline.files.project_file import Project
from pipeline.measuring.scan_measurement import MeasuredFile, ended_scan, measure_file, reads_writing
from pipeline.measuring.scan_task import ScanTask
from pipeline.provenance import FileIdentity, FileState, FileStates, hash_text, parts_hash, result_key
from pipeline.results.measured_record import MeasuredScan
from pipeline.terminal import Reporter
from pipeline.text.wording import count_sentence, counted, drop_file_name, listed
from pipeline.types import Array
from pipeline.workers import TASKS_A_CORE, NotMeasured, WorkOptions, iterate_results

_PICTURE_PX = 480  # px, about the largest side of a scan's reduced picture
_hash_of = lru_cache(maxsize=4096)(hash_text)


class Work:
    """Measurement of scans on request: stored results are read, missing ones measured and stored at once."""

    def __init__(
        self,
        project: Project,
        database: ResultsDatabase,
        executor: Executor,
        options: WorkOptions,
        thumbnails: ThumbnailDatabase,
    ) -> None:
        self._project, self._database, self._executor, self._thumbnails = project, database, executor, thumbnails
        self._at_a_time = options.workers or os.cpu_count() or 1
        self._only_kept = options.only_kept
        self._folder = project.path.resolve().parent
        self._identities, self._rows = database.identities(), database.fingerprints()
        self._files = FileStates(self._folder)
        self._states: dict[str, FileState] = {}
        self._asked = review_decisions.request_hasher(project)
        self.decisions = review_decisions.group_decisions(project.decisions)  # by image, the oldest first
        self.counting = defaultdict[str, Mapping[About, Decision]](dict)  # by image, of its last request
        self._now: set[int] = set()  # rows measured in this run
        self.results: dict[str, int] = {}  # by image, row of the result of its last request

    def measure(self, tasks: Iterable[ScanTask]) -> Iterator[MeasuredScan]:
        """Yield the scan of each task, measured or stored, with all decisions applied except acceptance
        (`before_checks`): a `Measure`."""
        known, missing = self._stored_rows(tasks)
        yield from map(self.read, known)
        for task, _ in self._measure(missing):
            yield self.read(task.name)

    def trial(self, tasks: Sequence[ScanTask]) -> Iterator[MeasuredScan]:
        """Yield the scans of tasks that are none of the project: measured, and not stored. None while only stored
        results are read."""
        for _, result in () if self._only_kept else iterate_results(measure_file, tasks, self._executor, TASKS_A_CORE):
            if isinstance(result, MeasuredFile):
                yield result.scan

    def complete(self, tasks: Sequence[ScanTask], reporter: Reporter) -> None:
        """Measure the missing scans of the project and report how many there are. The scans are not held in memory."""
        known, missing = self._stored_rows(tasks)
        now = sum(row in self._now for row in known.values())  # measured for other scans in the steps before
        self._database.set_current({row: self._asked(name) for name, row in known.items()})
        if known:
            rest = {"stored already": len(known) - now, "in this run": now, "to go": len(missing)}
            reporter.say(count_sentence("measured", len(known), len(tasks), rest))
        if missing:
            self._complete(missing, len(tasks), reporter)

    def read(self, name: str) -> MeasuredScan:
        """Scan of an image as last requested, with all decisions applied except acceptance (`before_checks`)."""
        scan = self._database.scan(self.results[name], name, self._folder)
        return review_decisions.before_checks(scan, self.counting[name])

    def picture(self, scan: MeasuredScan) -> Array | None:
        """Reduced grey values (rows, columns) of a whole scan, stored or read again; None where it cannot be read."""
        key = self._database.first("select fingerprint from result where id = ?", self.results[scan.frame.image])
        if (stored := self._thumbnails.get(key)) is not None:
            return np.asarray(stored.pixels)
        try:
            with self._project.open_scan(scan.frame.image) as opened:
                grey = opened.reduced(max(1, max(opened.width_px, opened.height_px) // _PICTURE_PX))
        except MeasurementError:
            return None
        return grey.astype(float)

    def names_with_writing(self, names: Sequence[str]) -> list[str]:
        """Images on whose scans writing was found."""
        written = self._database.results_with_writing()
        return [name for name in names if self.results[name] in written]

    def read_writing(self, name: str) -> MeasuredScan:
        """Scan of an image as last requested, without marks, problems and notes."""
        scan = self._database.scan(self.results[name], name, self._folder, with_marks=False)
        return replace(scan, frame=replace(scan.frame, problems=()), notes=())

    def decisions_hash(self, name: str) -> str:
        """Hash of all decisions about an image, whether they apply or not."""
        return review_decisions.decisions_hash(self.decisions.get(name, ()))

    def checked_result(self, scan: MeasuredScan) -> CheckedResult:
        """Result of a scan after the cross-scan checks, with all decisions applied."""
        name = scan.frame.image
        checked = review_decisions.after_checks(scan, self.counting[name])
        return CheckedResult(self.results[name], checked, self.decisions_hash(name))

    def keys(self) -> dict[str, str]:
        """{image: fingerprint of its last requested result}."""
        of_row = {row: key for key, row in self._rows.items()}
        return {name: of_row[row] for name, row in self.results.items()}

    def state(self, task: ScanTask) -> FileState:
        """State of the task's file when it was first requested."""
        if not task.scan:
            return FileState(f"(none) {task.name}", -1)
        if task.scan not in self._states:
            self._states[task.scan] = self._files.get(scan_path(task.scan))
        return self._states[task.scan]

    def _identity(self, task: ScanTask) -> FileIdentity | None:
        """Stored identity of the task's file; None if it is unknown or has changed."""
        state = self.state(task)
        known = self._identities.get(state.uri)
        return known if known is not None and known.state == state else None

    def _complete(self, tasks: Sequence[ScanTask], scans: int, reporter: Reporter) -> None:
        """Measure the missing scans. scans: number of all scans; those measured earlier count as done."""
        kinds = {  # camera and file format, on which the time for a scan depends
            task.name: (
                self._project.image_camera(task.name).path.stem,
                whole_file(task.shown_scan).rpartition(".")[2].lower(),
            )
            for task in tasks
        }
        left, failed = Counter(kinds.values()), defaultdict[str, list[str]](list)
        seconds = defaultdict[tuple[str, str], list[float]](list)
        with reporter.stage("scans measured:") as count:
            for measured, (task, scan) in enumerate(self._measure(tasks, as_scans=True), scans - len(tasks) + 1):
                kind = kinds[task.name]
                left[kind] -= 1
                seconds[kind].append(scan.seconds)
                if scan.failure:
                    same = drop_file_name(scan.failure.sentence, task.shown_scan)
                    if same not in failed:  # one message for all scans with the same failure
                        reporter.say(f"failed: {task.name}: {same}")
                    failed[same].append(task.name)
                usual_s = fmean(chain(*seconds.values()))  # of a kind without finished scans
                left_s = sum(number * fmean(seconds[each] or [usual_s]) for each, number in left.items())
                groups = f"{list(left.values()).count(0)} of {counted(len(left), 'group')}"
                failures = sum(map(len, failed.values()))
                what = f"{groups}{f', {failures} failed' if failures else ''}"
                count(what, measured, scans, left_s / self._at_a_time)
        for first, *others in failed.values():
            if others:
                reporter.say(f"failed as {first} did: {counted(len(others), 'scan')} more, {listed(others)}")

    def _stored_rows(self, tasks: Iterable[ScanTask]) -> tuple[dict[str, int], list[ScanTask]]:
        """Rows of the stored results for the tasks' present files and options, by image, and tasks that have none, with
        the decisions about their scans applied."""

        def result_pose(key: str) -> str | None:
            row = self._rows.get(key)
            return None if row is None else self._database.pose_name(row)

        known, missing = dict[str, int](), list[ScanTask]()
        for task in tasks:
            identity, reviewed = self._identity(task), task
            if decisions := self.decisions.get(task.name):
                reviewed_file = identity or FileIdentity(self.state(task), parts_hash(scan_path(task.scan)))
                reviewed, self.counting[task.name] = review_decisions.apply_decisions(
                    task, decisions, partial(_key, reviewed_file), result_pose, self._database.later_keys
                )
            row = None if identity is None else self._rows.get(_key(identity, reviewed))
            if row is None:
                missing.append(reviewed)
            else:
                known[task.name] = row
        self.results |= known
        return known, missing

    def _measure(self, tasks: Sequence[ScanTask], as_scans: bool = False) -> Iterator[tuple[ScanTask, MeasuredScan]]:
        """Measure tasks, and store each result at once. as_scans: as results of the project's own scans."""
        if tasks and self._only_kept:
            raise NotMeasured
        for task in tasks:
            self.state(task)  # before the measurement
        for task, result in iterate_results(measure_file, tasks, self._executor, TASKS_A_CORE * self._at_a_time):
            file = result if isinstance(result, MeasuredFile) else MeasuredFile(ended_scan(task, result), "", -1)
            identity, camera = FileIdentity(self.state(task), file.parts_hash), self._project.image_camera(task.name)
            if not file.parts_hash:  # the process was lost
                identity = self._identity(task) or identity
            kept = Kept(identity, _options_json(task), file.scan, file.bytes_read, camera.path.name)
            if file.thumbnails:
                self._thumbnails.keep(kept.fingerprint, file.thumbnails)
            row = self._database.keep(kept, *((task.name, self._asked(task.name)) if as_scans else ()))
            self._identities[identity.state.uri], self._rows[kept.fingerprint] = identity, row
            self._now.add(row)
            self.results[task.name] = row
            yield task, file.scan


def _options_json(task: ScanTask) -> str:
    """JSON of all that a result depends on in addition to the scan, including whether writing can be read."""
    json = task.options.json
    return f'{json[:-1]},"reads":true}}' if reads_writing(task.options) else json


def _key(identity: FileIdentity, task: ScanTask) -> str:
    """Fingerprint of the result of a task."""
    return result_key(identity, _hash_of(_options_json(task)))
