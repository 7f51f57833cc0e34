"""Measure a project's scans into its results database, only what is missing or changed, and check all scans together.

A scan is stored as soon as it is measured. The cross-scan checks read from the database and are stored in it.
"""

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import lru_cache, partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from statistics import fmean

import numpy as np

from measure.errors import MeasurementError
from measure.flags import Code, Reason, Status
from measure.results import MEASURE_REVISION
from measure.scans.remote import fetch_location, scan_path
from pipeline.archive.checked_results import CheckedResult, Judging, Lot, judge_lots, latest
from pipeline.archive.made_from import measured_from
from pipeline.archive.results_database import Kept, Store
from pipeline.archive.review_decisions import (
    after_checks,
    apply_decisions,
    before_checks,
    decisions_hash,
    group_decisions,
    request_hasher,
    tell_inapplicable,
)
from pipeline.archive.thumbnails import ThumbnailStore
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.decisions_file import About, Decision
from pipeline.files.project_file import Project
from pipeline.files.scan_files import as_named
from pipeline.measuring.camera_identification import add_plates
from pipeline.measuring.learn_stage import collect_tones, learn_marks
from pipeline.measuring.repeated_views import check_repeated_views
from pipeline.measuring.roll import add_known_lines, check_scans, name_roll, note_same_frames
from pipeline.measuring.scan_measurement import MeasuredFile, ended_scan, measure_file, reads_writing
from pipeline.measuring.scan_task import ScanTask, scan_tasks
from pipeline.measuring.tie_stage import check_tie_names, tie_scans
from pipeline.progress import Reporter
from pipeline.provenance import (
    FileState,
    FileStates,
    Identity,
    alike_groups,
    content_hash,
    fingerprint,
    hash_text,
    parts_hash,
    result_key,
    shard_number,
)
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.wording import count_sentence, counted, drop_file_name, gathered, listed
from pipeline.types import Array
from pipeline.workers import TASKS_A_CORE, NotMeasured, WorkOptions, cluster_executor, iterate_results, worker_pool

_hash_of = lru_cache(maxsize=4096)(hash_text)
_MADE_BY = (version("reseau"), MEASURE_REVISION)
_PICTURE_PX = 480  # px, about the largest side of a scan's reduced picture
_TOGETHER = 2000  # most frames of a camera that are checked together, to limit memory
OfCamera = tuple[CameraFile, Sequence[ScanTask]]
Remarks = Mapping[str, tuple[tuple[Reason, ...], tuple[str, ...]]]  # problems and notes by image


class Work:
    """Measurement of scans on request: stored results are read, missing ones measured and stored at once."""

    def __init__(
        self,
        project: Project,
        store: Store,
        executor: Executor | None,
        options: WorkOptions | None = None,
        thumbnails: ThumbnailStore | None = None,
    ) -> None:
        options = options or WorkOptions()
        self._project, self._store, self._executor, self._thumbnails = project, store, executor, thumbnails
        self._at_a_time = options.workers or os.cpu_count() or 1
        self._only_kept = options.only_kept
        self._folder = project.path.resolve().parent
        self._identities, self._rows = store.identities(), store.fingerprints()
        self._files = FileStates(self._folder)
        self._states: dict[str, FileState] = {}
        self._asked = request_hasher(project)
        self.decisions = group_decisions(project.decisions)  # by image, the oldest first
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

    def complete(self, tasks: Sequence[ScanTask], reporter: Reporter) -> None:
        """Measure the missing scans of the project and report how many there are. The scans are not held in memory."""
        known, missing = self._stored_rows(tasks)
        now = sum(row in self._now for row in known.values())  # measured for other scans in the steps before
        self._store.set_current({row: self._asked(name) for name, row in known.items()})
        if known or len(missing) > 1:
            rest = {"in this run": now, "to measure": len(missing)}
            reporter.say(count_sentence("measured in an earlier run", len(known) - now, len(tasks), rest))
        if missing:
            self._complete(missing, len(tasks), reporter)

    def read(self, name: str) -> MeasuredScan:
        """Scan of an image as last requested, with all decisions applied except acceptance (`before_checks`)."""
        scan = self._store.scan(self.results[name], name, self._folder)
        return before_checks(scan, self.counting[name])

    def picture(self, scan: MeasuredScan) -> Array | None:
        """Reduced grey values (rows, columns) of a whole scan, stored or read again; None where it cannot be read."""
        key = self._store.first("select fingerprint from result where id = ?", self.results[scan.frame.image])
        stored = self._thumbnails.get(key) if self._thumbnails else None
        if stored is not None:
            return np.asarray(stored.pixels)
        try:
            with self._project.open_scan(scan.frame.image) as opened:
                grey = opened.reduced(max(1, max(opened.width_px, opened.height_px) // _PICTURE_PX))
        except MeasurementError:
            return None
        return grey.astype(float)

    def written(self, names: Sequence[str]) -> list[str]:
        """Images on whose scans writing was found."""
        written = self._store.written()
        return [name for name in names if self.results[name] in written]

    def read_writing(self, name: str) -> MeasuredScan:
        """Scan of an image as last requested, without marks, problems and notes."""
        scan = self._store.scan(self.results[name], name, self._folder, with_marks=False)
        return replace(scan, frame=replace(scan.frame, problems=()), notes=())

    def decisions_hash(self, name: str) -> str:
        """Hash of all decisions about an image, whether they apply or not."""
        return decisions_hash(self.decisions.get(name, ()))

    def apply_decisions(self, scan: MeasuredScan) -> MeasuredScan:
        """Checked scan with all decisions applied."""
        return after_checks(scan, self.counting[scan.frame.image])

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

    def _identity(self, task: ScanTask) -> Identity | None:
        """Stored identity of the task's file; None if it is unknown or has changed."""
        state = self.state(task)
        known = self._identities.get(state.uri)
        return known if known is not None and known.state == state else None

    def _complete(self, tasks: Sequence[ScanTask], scans: int, reporter: Reporter) -> None:
        """Measure the missing scans. scans: number of all scans; those measured earlier count as done."""
        kinds = {task.name: self._kind(task) for task in tasks}
        left, failed = Counter(kinds.values()), defaultdict[str, list[str]](list)
        seconds = defaultdict[tuple[str, str], list[float]](list)
        with reporter.stage("measured") as count:
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
                what = f"scans, {groups}{f', {failures} failed' if failures else ''}"
                count(what, measured, scans, left_s / self._at_a_time)
        for first, *others in failed.values():
            if others:
                reporter.say(f"failed as {first} did: {counted(len(others), 'scan')} more, {listed(others)}")

    def _kind(self, task: ScanTask) -> tuple[str, str]:
        """Camera and file format, on which the time for a scan depends."""
        return self._project.image_camera(task.name).path.stem, task.shown_scan.rpartition(".")[2].lower()

    def _reviewed_task(self, task: ScanTask) -> ScanTask:
        """Task with the decisions about its scan applied."""
        decisions = self.decisions.get(task.name)
        if decisions is None:
            return task
        identity = self._identity(task) or Identity(self.state(task), parts_hash(scan_path(task.scan)))
        task, self.counting[task.name] = apply_decisions(
            task,
            decisions,
            lambda one: result_key(identity, _hash_of(_options_json(one))),
            lambda key: None if (row := self._rows.get(key)) is None else self._store.pose_name(row),
        )
        return task

    def _stored_rows(self, tasks: Iterable[ScanTask]) -> tuple[dict[str, int], list[ScanTask]]:
        """Rows of the stored results for the tasks' present files and options, by image; tasks that have none."""
        known, missing = dict[str, int](), list[ScanTask]()
        for task in map(self._reviewed_task, tasks):
            identity = self._identity(task)
            key = "" if identity is None else result_key(identity, _hash_of(_options_json(task)))
            row = self._rows.get(key)
            if row is None:
                missing.append(task)
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
            identity, camera = Identity(self.state(task), file.parts_hash), self._project.image_camera(task.name)
            if not file.parts_hash:  # the process was lost
                identity = self._identity(task) or identity
            kept = Kept(identity, _options_json(task), file.scan, file.bytes_read, camera.path.name)
            if self._thumbnails is not None and file.thumbnails:
                self._thumbnails.keep(kept.fingerprint, file.thumbnails)
            row = self._store.keep(kept, *((task.name, self._asked(task.name)) if as_scans else ()))
            self._identities[identity.state.uri], self._rows[kept.fingerprint] = identity, row
            self._now.add(row)
            self.results[task.name] = row
            yield task, file.scan


def check_measurable(project: Project) -> tuple[str, ...]:
    """Return the names of the images to be measured. Raises InputError for errors in the user's files."""
    if not project.scans:
        raise InputError(f'{project.path}: scans is missing: which pictures to measure, such as ["scans/*.tif"].')
    sought = [one for camera in project.cameras.values() for one in camera.fiducials if not one.passed_over]
    if not sought and project.targets is None and project.ties is None:
        raise InputError(
            f"{project.path}: there is nothing to measure: {project.default_camera.path} has no fiducial that is not "
            "passed over, and the project neither [targets] nor [ties]. Add what the scans show."
        )
    check_tie_names(project)
    for camera in project.cameras.values():
        if len(camera.layout_marks) + len(camera.learned) == 1:
            raise InputError(
                f"{camera.path} has one fiducial mark, and a frame is found by two or more. Add the others, or pass it "
                'over with mark = "none".'
            )
    listed = project.given_images.exterior if project.given_images else {}
    names = (*project.scans, *(name for name in listed if name not in project.scans and name not in project.left_out))
    scan_tasks(project, names)  # raises for undefined targets and for fiducials that have no drawing
    return names


def find_moved(store: Store, project: Project, reporter: Reporter) -> dict[str, str]:
    """Re-key the results of moved files by content hash and return {old fingerprint: new}.

    Only results whose content was hashed by an earlier call with `--moved` are found.
    """
    known, files = store.identities(), FileStates(project.path.resolve().parent)
    states = {name: files.get(file) for name, file in as_named(project.scans).items()}
    unknown = {name: state for name, state in states.items() if state != getattr(known.get(state.uri), "state", None)}
    taken = {state.uri for name, state in states.items() if name not in unknown}
    free = {content: uri for uri, content in store.content_hashes().items() if uri not in taken}
    sizes = {known[uri].state.bytes for uri in free.values()}
    found, keys = 0, dict[str, str]()
    with reporter.stage("searched in the results database") as count:
        for done, (name, state) in enumerate(unknown.items(), 1):
            count(name, done, len(unknown))
            path = project.scans[name]
            uri = free.pop(content_hash(path), "") if state.bytes in sizes else ""
            if uri and uri not in taken:  # nor has another file come to its place
                keys |= store.move(uri, Identity(state, parts_hash(path)))
                taken.add(state.uri)
                found += 1
    if unknown:
        reporter.say(
            f"{found} of {len(unknown)} files that are new or changed have the content of ones that are measured"
        )
    return keys


def hash_contents(store: Store, tasks: Sequence[ScanTask], work: Work, reporter: Reporter) -> None:
    """Hash the whole files of all scans without a content hash, so that they are recognised after a move."""
    hashed = store.content_hashes()
    left = {
        work.state(task).uri: scan_path(task.scan) for task in tasks if task.scan and work.state(task).uri not in hashed
    }
    with reporter.stage("content hashed of") as count:
        for done, (uri, path) in enumerate(left.items(), 1):
            count(path.name, done, len(left))
            store.set_content_hashes({uri: content_hash(path)})


def measure_archive(
    project: Project,
    store: Store,
    learned_folder: Path,
    reporter: Reporter,
    options: WorkOptions,
) -> Judging | None:
    """Measure the missing scans of a project and check all of them together, unless nothing has changed.

    Returns
    -------
    The judging; None for a shard, which has no cross-scan checks.

    Raises
    ------
    InputError
        Errors in the user's files, before anything is measured.
    MeasurementError
        No scan could be measured; single failures are results.
    """
    names = check_measurable(project)
    store.set_project_folder(project.path.parent)
    with open_executor(project, options) as executor, ThumbnailStore(store.path) as thumbnails:
        # After all checks that could prevent a new measurement.
        lost = store.forget_damaged() if options.retry or store.has_damaged_rows() else 0
        if lost:
            reporter.say(f"{store.path}: {counted(lost, 'result')} stored there not as written: measured again")
        if options.retry:
            store.forget_failed()
        if options.moved:
            thumbnails.rekey(find_moved(store, project, reporter))
        work = Work(project, store, executor, options, thumbnails)
        learned = learn_marks(project, reporter, work.measure, executor, learned_folder, store)
        tasks = scan_tasks(learned, names, collect_tones(learned, reporter, work.measure, store))
        tasks, _ = add_known_lines(tasks, work.measure, reporter)
        store.set_project({work.state(task).uri: task.name for task in tasks})
        if options.shard is not None:
            part, parts = options.shard
            work.complete([task for task in tasks if shard_number(task.name, parts) == part], reporter)
            return None
        work.complete(tasks, reporter)
        if options.moved:
            hash_contents(store, tasks, work, reporter)
        if (failures := store.failures()) is not None:
            raise MeasurementError("\n".join(gathered(failures)))
        copies = find_copies(store, tasks, work)
        made = measured_from(project)
        input_hash = hash_inputs(tasks, work, copies, made)
        before = latest(store)
        if before is not None and before.input == input_hash:
            tell_inapplicable(learned, before, work)
            return before
        share = partial(tie_scans, learned, reporter=reporter, executor=executor)
        lots = check_lots(learned, tasks, work, copies, share, input_hash)
        judging = judge_lots(store, made, input_hash, lots)
        tell_inapplicable(learned, judging, work)
        return judging


def open_executor(project: Project, options: WorkOptions) -> AbstractContextManager[Executor]:
    """Executor for the project's scans: local processes or the workers of a cluster."""
    if options.cluster is not None:
        return cluster_executor(
            options.cluster, [fetch_location(path) for path in project.scans.values()], options.workers
        )
    return worker_pool(len(project.scans), options.workers)


def check_lots(
    project: Project,
    tasks: Sequence[ScanTask],
    work: Work,
    copies: Mapping[str, str],
    share: Callable[[Sequence[MeasuredScan]], Iterable[MeasuredScan]],
    input_hash: str,
) -> Iterator[Lot]:
    """Check all scans together, in lots, one in memory at a time: a lot with unchanged scans is not checked again.

    Parameters
    ----------
    copies : {image: image whose file its own is a copy of}.
    share : third step of the measurement: targets and natural points shared between scans.
    input_hash : `hash_inputs` of all scans.
    """
    own = [task for task in tasks if task.name not in copies]
    keys, remarks = work.keys(), _writing_remarks(project, own, work)

    def lot(some: Sequence[ScanTask], depends_on: object, scans: Callable[[], Iterable[MeasuredScan]]) -> Lot:
        results = [
            [name, keys[name], [one for _, one in sorted(work.counting[name].items())], *filter(None, [of_decisions])]
            for name, of_decisions in ((task.name, work.decisions_hash(task.name)) for task in some)
        ]
        inputs = fingerprint([results, depends_on, _MADE_BY])
        return Lot(inputs, lambda: (_checked_result(scan, work) for scan in scans()))

    def checked_lot(of_cameras: Sequence[OfCamera]) -> Iterable[MeasuredScan]:
        scans = [scan for each in of_cameras for scan in _check_camera(project, *each, work)]
        return share([scan.changed(None, *remarks.get(scan.frame.image, ((), ()))) for scan in scans])

    for of_cameras in _lots(project, own):
        some = [task for _, each in of_cameras for task in each]
        of_writing = [remarks[task.name] for task in some if task.name in remarks]
        cameras = [camera for camera, _ in of_cameras]
        depends_on = [cameras, project.film, of_writing, _project_inputs(project, some, input_hash)]
        yield lot(some, depends_on, partial(checked_lot, of_cameras))
    if copies:
        again = sorted(copies.items())
        yield lot(
            [task for task in tasks if task.name in copies],
            again,
            lambda: [_copy(work.read(name), original) for name, original in again],
        )


def find_copies(store: Store, tasks: Sequence[ScanTask], work: Work) -> dict[str, str]:
    """Return {image: first image, by name, with the same file content}.

    Whole files are read only where size and the hash of parts agree.
    """
    identities, hashes = store.identities(), store.content_hashes()

    def parts(task: ScanTask) -> object:
        known = identities.get(work.state(task).uri)
        return known and known.state.bytes > 0 and known.parts_hash and (known.state.bytes, known.parts_hash)

    def content(task: ScanTask) -> str:
        uri = work.state(task).uri
        hashes[uri] = hashes.get(uri) or content_hash(scan_path(task.scan))
        return hashes[uri]

    copies = dict[str, str]()
    for original, *others in alike_groups(sorted(tasks, key=lambda task: task.name), parts, content):
        copies |= {task.name: original.name for task in others}
    store.set_content_hashes(hashes)
    store.set_copies({work.state(task).uri: copies[task.name] for task in tasks if task.name in copies})
    return copies


def hash_inputs(tasks: Sequence[ScanTask], work: Work, copies: Mapping[str, str], made_from: Mapping[str, str]) -> str:
    """SHA-256 of all inputs of the cross-scan checks: the results and the project's own inputs."""
    keys = work.keys()
    results = [[task.name, keys[task.name]] for task in tasks]
    return fingerprint([results, sorted(copies.items()), made_from, _MADE_BY])


def _lots(project: Project, tasks: Sequence[ScanTask]) -> Sequence[Sequence[OfCamera]]:
    """Scans that are checked together, by camera."""
    # Natural points may link any scans; targets and parts of frames are linked only in small projects.
    of_cameras = _camera_lots(project, tasks)
    are_few = len(tasks) <= _TOGETHER and (project.targets is not None or project.has_parts)
    return [of_cameras] if project.ties is not None or are_few else [[each] for each in of_cameras]


def _project_inputs(project: Project, tasks: Sequence[ScanTask], input_hash: str) -> object:
    """Inputs of the third step from the project, in addition to the scans."""
    if project.ties is not None:
        return input_hash
    points = None if project.targets is None else project.object_points
    return [
        project.targets,
        points,
        [project.scanned_frame(task.name) for task in tasks] if project.has_parts else None,
    ]


def _camera_lots(project: Project, tasks: Sequence[ScanTask]) -> list[OfCamera]:
    """Lots of each camera, of at most `_TOGETHER` scans."""
    # Split by a hash of the frame's name: a new scan changes a single lot, and parts of one frame are in one lot.
    found = list[OfCamera]()
    for camera in project.cameras.values():
        own = [task for task in tasks if project.image_camera(task.name) is camera]
        lots = 1
        while len(own) > lots * _TOGETHER:
            lots *= 2
        some = defaultdict[int, list[ScanTask]](list)
        for task in own:
            some[shard_number(project.image_frame(task.name), lots)].append(task)
        found += [(camera, some[lot]) for lot in sorted(some)]
    return found


def _check_camera(
    project: Project, camera: CameraFile, tasks: Sequence[ScanTask], work: Work
) -> tuple[MeasuredScan, ...]:
    """Second step of the measurement. Scans whose marks get other names by it are measured again."""
    scans = name_roll(tasks, [work.read(task.name) for task in tasks], camera.writing, work.measure)
    checked = check_scans(camera, scans, project.film)
    is_board = project.targets is not None and project.targets.board is not None
    return tuple(check_repeated_views(checked, is_board, work.picture))


def _writing_remarks(project: Project, tasks: Sequence[ScanTask], work: Work) -> Remarks:
    """Remarks from the writing about other scans: plates of other cameras, frames scanned twice."""
    names = work.written([task.name for task in tasks])
    bare = dict[str, MeasuredScan]()
    for camera in project.cameras.values():
        own = [work.read_writing(name) for name in names if project.image_camera(name) is camera]
        bare |= {scan.frame.image: scan for scan in add_plates(camera, own, project.cameras)}
    noted = note_same_frames([bare[name] for name in names], project.scanned_frame)
    return {scan.frame.image: (scan.frame.problems, scan.notes) for scan in noted if scan.frame.problems or scan.notes}


def _checked_result(scan: MeasuredScan, work: Work) -> CheckedResult:
    name = scan.frame.image
    return CheckedResult(work.results[name], work.apply_decisions(scan), work.decisions_hash(name))


def _copy(scan: MeasuredScan, original: str) -> MeasuredScan:
    """Scan with all observations rejected, since they count in the scan of which its file is a copy."""
    reason = Reason(f"its file is a copy of that of {original}, which counts", Code.COPY)
    sentence = f"its file is byte for byte that of {original}: its marks count once. Name one of both in `exclude`."
    return scan.restated(None, Status.REJECTED, reason).changed(problems=[Reason(sentence, Code.COPY)])


def _options_json(task: ScanTask) -> str:
    """JSON of all that a result depends on in addition to the scan, including whether writing can be read."""
    json = task.options.json
    return f'{json[:-1]},"reads":true}}' if reads_writing(task.options) else json
