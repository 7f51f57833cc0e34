"""Measure a project's scans into its results database: what is missing or changed; and check all of them together."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

from measure.errors import MeasurementError
from measure.flags import Code, Reason, Status
from measure.results import MEASURE_REVISION
from measure.scans.remote import fetch_location, scan_path
from pipeline.archive.checked_statuses import CheckedResult, Lot, judge_lots, latest
from pipeline.archive.results_database import Store
from pipeline.archive.review_decisions import tell_inapplicable
from pipeline.archive.thumbnails import ThumbnailStore
from pipeline.archive.work import Work
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.files.scan_files import as_named
from pipeline.measuring.camera_identification import add_plates
from pipeline.measuring.learn_stage import collect_tones, learn_marks
from pipeline.measuring.roll import CheckedScan, add_known_lines, build_roll, check_scans, note_same_frames
from pipeline.measuring.scan_task import ScanTask, scan_tasks
from pipeline.measuring.tie_stage import check_tie_names, tie_scans
from pipeline.progress import Reporter
from pipeline.provenance import FileStates, Identity, content_hash, fingerprint, parts_hash, shard_number
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.wording import counted, gathered
from pipeline.workers import WorkOptions, cluster_executor, worker_pool

_TOGETHER = 2000  # most frames of a camera that are checked together, to limit memory
OfCamera = tuple[CameraFile, Sequence[ScanTask]]
Remarks = Mapping[str, tuple[tuple[Reason, ...], tuple[str, ...]]]  # problems and notes by image


def check_lots(
    project: Project,
    tasks: Sequence[ScanTask],
    work: Work,
    copies: Mapping[str, str],
    share: Callable[[Sequence[MeasuredScan]], Iterable[MeasuredScan]],
    input_hash: str,
) -> Iterator[Lot]:
    """Check all scans together, in lots: a lot whose scans are unchanged need not be checked again.

    Parameters
    ----------
    project : with its learned marks.
    tasks : of all scans.
    work : access to the results.
    copies : {image: image whose file its own is a copy of}.
    share : third step of the measurement: targets and natural points shared between scans.
    input_hash : `hash_inputs` of all scans.

    Yields
    ------
    Lots; one is held in memory at a time.
    """
    own = [task for task in tasks if task.name not in copies]
    keys, remarks = work.keys(), _writing_remarks(project, own, work)

    def lot(some: Sequence[ScanTask], depends_on: object, scans: Callable[[], Iterable[MeasuredScan]]) -> Lot:
        results = [
            [task.name, keys[task.name], work.counting(task.name), *filter(None, [work.decisions_hash(task.name)])]
            for task in some
        ]
        made_by = [version("reseau"), MEASURE_REVISION]
        return Lot(
            fingerprint([results, depends_on, made_by]), lambda: (_checked_result(scan, work) for scan in scans())
        )

    def checked_lot(of_cameras: Sequence[OfCamera]) -> Iterable[MeasuredScan]:
        scans = [scan for each in of_cameras for scan in _check_camera(project, *each, work)]
        return share([_add_remarks(scan, remarks) for scan in scans])

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
    groups = defaultdict[tuple[int, str], list[ScanTask]](list)
    identities = store.identities()
    for task in tasks:
        known = identities.get(work.state(task).uri)
        if known is not None and known.state.bytes > 0 and known.parts_hash:
            groups[known.state.bytes, known.parts_hash].append(task)
    hashes = store.content_hashes()
    originals, copies = dict[str, str](), dict[str, str]()
    for group in groups.values():
        originals.clear()
        for task in sorted(group, key=lambda task: task.name) if len(group) > 1 else ():
            content = hashes.get(work.state(task).uri) or content_hash(scan_path(task.scan))
            hashes[work.state(task).uri] = content
            if content and originals.setdefault(content, task.name) != task.name:
                copies[task.name] = originals[content]
    store.set_content_hashes(hashes)
    store.set_copies({work.state(task).uri: copies[task.name] for task in tasks if task.name in copies})
    return copies


def hash_inputs(tasks: Sequence[ScanTask], work: Work, copies: Mapping[str, str], made_from: Mapping[str, str]) -> str:
    """SHA-256 of all inputs of the cross-scan checks: the results and the project's own inputs."""
    keys = work.keys()
    results = [[task.name, keys[task.name]] for task in tasks]
    made_by = [version("reseau"), MEASURE_REVISION]
    content = json.dumps([results, sorted(copies.items()), dict(made_from), made_by], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def _lots(project: Project, tasks: Sequence[ScanTask]) -> Sequence[Sequence[OfCamera]]:
    """Scans that are checked together, by camera. Natural points may link any scans, so they need one lot; targets on a
    sheet and parts of frames are checked in one lot only in small projects."""
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
    """Split the scans of each camera into lots.

    All scans of a camera form one lot up to `_TOGETHER`; more are split by a hash of the frame's name, so that a new
    scan changes a single lot. Parts of one frame are in one lot.
    """
    found = list[OfCamera]()
    for camera in project.cameras.values():
        own = [task for task in tasks if project.image_camera(task.name) is camera]
        lots = 1
        while len(own) > lots * _TOGETHER:
            lots *= 2
        some = defaultdict[int, list[ScanTask]](list)
        for task in own:
            some[shard_number(project.scanned_frame(task.name) or task.name, lots)].append(task)
        found += [(camera, some[lot]) for lot in sorted(some)]
    return found


def _check_camera(
    project: Project, camera: CameraFile, tasks: Sequence[ScanTask], work: Work
) -> tuple[CheckedScan, ...]:
    """Second step of the measurement. Scans whose marks are renamed by the comparison with others are measured
    again."""
    scans = [work.read(task.name) for task in tasks]
    roll = build_roll(tasks, scans, camera.writing)
    again = list(work.measure(roll.tasks)) if roll.tasks else []
    return check_scans(camera, scans, roll, again, project.film)


def _writing_remarks(project: Project, tasks: Sequence[ScanTask], work: Work) -> Remarks:
    """Remarks from the writing on scans about other scans: plates of other cameras, frames scanned twice. Only the
    writing of the scans is held in memory."""
    names = work.written([task.name for task in tasks])
    bare = dict[str, MeasuredScan]()
    for camera in project.cameras.values():
        own = [work.read_writing(name) for name in names if project.image_camera(name) is camera]
        bare |= {scan.frame.image: scan for scan in add_plates(camera, own, project.cameras)}
    noted = note_same_frames([bare[name] for name in names], project.scanned_frame)
    return {scan.frame.image: (scan.frame.problems, scan.notes) for scan in noted if scan.frame.problems or scan.notes}


def _add_remarks(scan: MeasuredScan, remarks: Remarks) -> MeasuredScan:
    problems, notes = remarks.get(scan.frame.image, ((), ()))
    frame = replace(scan.frame, problems=(*scan.frame.problems, *problems))
    return replace(scan, frame=frame, notes=(*scan.notes, *notes))


def _checked_result(scan: MeasuredScan, work: Work) -> CheckedResult:
    name = scan.frame.image
    return CheckedResult(work.results[name], work.apply_decisions(scan), work.decisions_hash(name))


def _copy(scan: MeasuredScan, original: str) -> MeasuredScan:
    """Scan with all observations rejected, since they count in the scan of which its file is a copy."""
    reason = Reason(f"its file is a copy of that of {original}, which counts", Code.COPY)
    marks = [
        replace(mark, status=Status.REJECTED, reason=reason) if mark.status.is_observation else mark
        for mark in scan.frame.marks
    ]
    sentence = f"its file is byte for byte that of {original}: its marks count once. Name one of both in `exclude`."
    problem = Reason(sentence, Code.COPY)
    return replace(scan, frame=replace(scan.frame, marks=tuple(marks), problems=(*scan.frame.problems, problem)))


def check_measurable(project: Project) -> tuple[str, ...]:
    """Return the names of the images to be measured. Raises InputError for errors in the user's files."""
    if not project.scans:
        raise InputError(f'{project.path}: scans is missing: which pictures to measure, such as ["scans/*.tif"].')
    _check_anything_to_measure(project)
    check_tie_names(project)
    _check_marks(project)
    listed = project.given_images.exterior if project.given_images else {}
    names = (*project.scans, *(name for name in listed if name not in project.scans and name not in project.left_out))
    scan_tasks(project, names)  # raises for undefined targets and for fiducials that have no drawing
    return names


def _check_anything_to_measure(project: Project) -> None:
    """Raise InputError where neither fiducials nor targets nor natural points are sought: comparator.csv would be
    empty."""
    sought = [one for camera in project.cameras.values() for one in camera.fiducials if not one.passed_over]
    if not sought and project.targets is None and project.ties is None:
        raise InputError(
            f"{project.path}: there is nothing to measure: {project.default_camera.path} has no fiducial that is not "
            "passed over, and the project neither [targets] nor [ties]. Add what the scans show."
        )


def _check_marks(project: Project) -> None:
    """Raise InputError for a camera with a single mark, which determines neither rotation nor scale of a frame."""
    for camera in project.cameras.values():
        if len(camera.layout_marks) + len(camera.learned) == 1:
            raise InputError(
                f"{camera.path} has one fiducial mark, and a frame is found by two or more. Add the others, or pass it "
                'over with mark = "none".'
            )


def find_moved(store: Store, project: Project, reporter: Reporter) -> dict[str, str]:
    """Re-key the results of moved files by content hash and return {old fingerprint: new}.

    Only results whose content was hashed by an earlier call with `--moved` are found.
    """
    known, files = store.identities(), FileStates(project.path.resolve().parent)
    by_size = defaultdict[int, dict[str, str]](dict)
    for uri, content in store.content_hashes().items():
        by_size[known[uri].state.bytes][content] = uri
    states = {name: files.get(file) for name, file in as_named(project.scans).items()}
    unknown = {name: state for name, state in states.items() if state != getattr(known.get(state.uri), "state", None)}
    taken = {state.uri for name, state in states.items() if name not in unknown}
    found, keys = 0, dict[str, str]()
    with reporter.stage("searched in the results database") as count:
        for done, (name, state) in enumerate(unknown.items(), 1):
            count(name, done, len(unknown))
            if not by_size.get(state.bytes):
                continue
            path = project.scans[name]
            content = content_hash(path)
            uri = by_size[state.bytes].get(content, "")
            if content and uri and uri not in taken:
                keys |= store.move(uri, Identity(state, parts_hash(path, project.max_pixels)))
                taken.add(state.uri)
                del by_size[state.bytes][content]
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
    made_from: Callable[[], Mapping[str, str]],
    learned_folder: Path,
    reporter: Reporter,
    options: WorkOptions | None = None,
) -> str:
    """Measure the missing scans of a project and check all of them together, unless nothing has changed.

    Parameters
    ----------
    project, store : project and its results database.
    made_from : function that returns {name: fingerprint} of the inputs of the checks, called after the measurement.
    learned_folder : folder for the learned marks.
    reporter, options : progress, and how the work is done.

    Returns
    -------
    Digest of the judging; "" for a shard, which has no cross-scan checks.

    Raises
    ------
    InputError
        Errors in the user's files, before anything is measured.
    MeasurementError
        No scan could be measured; single failures are results.
    """
    options = options or WorkOptions()
    names = check_measurable(project)
    with open_executor(project, options) as executor, ThumbnailStore.open(store.path) as thumbnails:
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
            return ""
        work.complete(tasks, reporter)
        if options.moved:
            hash_contents(store, tasks, work, reporter)
        _check_any(store)
        copies = find_copies(store, tasks, work)
        made = made_from()
        input_hash = hash_inputs(tasks, work, copies, made)
        before = latest(store)
        if before is not None and before.input == input_hash:
            tell_inapplicable(learned, store, before.digest, work)
            return before.digest
        share = partial(tie_scans, learned, reporter=reporter, executor=executor)
        lots = check_lots(learned, tasks, work, copies, share, input_hash)
        digest = judge_lots(store, made, input_hash, lots)
        tell_inapplicable(learned, store, digest, work)
        return digest


def open_executor(project: Project, options: WorkOptions) -> AbstractContextManager[Executor]:
    """Executor for the project's scans: local processes or the workers of a cluster."""
    if options.cluster is not None:
        return cluster_executor(
            options.cluster, [fetch_location(path) for path in project.scans.values()], options.workers
        )
    return worker_pool(len(project.scans), options.workers)


def _check_any(store: Store) -> None:
    """Raise MeasurementError with the reasons of all failures where no scan could be measured."""
    failures = store.failures()
    if failures is not None:
        raise MeasurementError("\n".join(gathered(failures)))
