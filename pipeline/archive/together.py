"""All scans of a project beside one another, from the store and into it: what was measured stays as it is."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from measure.reason import Code, Reason
from measure.results import FrameMeasurement
from measure.scans.addresses import scan_path
from measure.status import Status
from pipeline.archive.identity import content_hash
from pipeline.archive.judging import JudgedScan
from pipeline.archive.store import Store
from pipeline.archive.work import Work
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.measuring.checked import CheckedScan, checked
from pipeline.measuring.roll import roll_of
from pipeline.measuring.same_frames import with_same_frames
from pipeline.measuring.scan_task import ScanTask
from pipeline.measuring.tied import tied
from pipeline.progress import Reporter
from pipeline.results.measured_record import record_of
from pipeline.results.measured_scan import MeasuredScan

_TOGETHER = 2000  # frames of a camera that are checked beside one another: more would only take memory


def judged_scans(
    project: Project,
    tasks: Sequence[ScanTask],
    work: Work,
    copies: Mapping[str, str],
    reporter: Reporter,
    executor: Executor | None,
) -> Iterator[JudgedScan]:
    """Every scan as all of them show it. project: with its learned marks. copies: by image the one whose file its own
    is a copy of. Frames that only the checks of their camera concern are not held longer than these take."""
    own = [task for task in tasks if task.name not in copies]
    scans = _checked_scans(project, own, work)
    if project.ties is not None or project.targets is not None:
        every: Iterator[MeasuredScan] = iter(tied(project, list(scans), reporter, executor))
    else:
        every = _with_same_frames(scans, [task.name for task in own], work)
    for scan in every:
        yield _judged(scan, work, project)
    for name, original in sorted(copies.items()):
        yield _judged(_copy(work.read(name), original), work, project)


def find_copies(store: Store, tasks: Sequence[ScanTask], work: Work) -> dict[str, str]:
    """By image the first one, by name, whose file has the same content. Whole files are read only where size and
    telling parts are the same."""
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


def input_of(tasks: Sequence[ScanTask], work: Work, copies: Mapping[str, str], made_from: Mapping[str, str]) -> str:
    """SHA-256 of all that judging starts from: the results, and what the project has."""
    keys = work.keys()
    results = [[task.name, keys[task.name]] for task in tasks]
    told = json.dumps([results, sorted(copies.items()), dict(made_from)], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def _checked_scans(project: Project, tasks: Sequence[ScanTask], work: Work) -> Iterator[CheckedScan]:
    """The second step, camera by camera. Scans whose marks change names beside the others are measured again."""
    for camera in project.cameras.values():
        own = [task for task in tasks if project.camera_of(task.name) is camera]
        for first in range(0, len(own), _TOGETHER):
            yield from _checked_beside(project, camera, own[first : first + _TOGETHER], work)


def _checked_beside(
    project: Project, camera: CameraFile, tasks: Sequence[ScanTask], work: Work
) -> tuple[CheckedScan, ...]:
    scans = [work.read(task.name) for task in tasks]
    roll = roll_of(tasks, scans, camera.writing)
    again = list(work.measure(roll.tasks)) if roll.tasks else []
    return checked(camera, scans, roll, again, project.film_sigma_mm)


def _with_same_frames(scans: Iterator[CheckedScan], names: Sequence[str], work: Work) -> Iterator[MeasuredScan]:
    """As `tied` does it, of all scans no more being held than what is written on them."""
    written = [scan for scan in map(work.read, names) if scan.frame.writing]
    bare = [replace(scan, frame=FrameMeasurement(scan.frame.image, (), writing=scan.frame.writing)) for scan in written]
    said = {scan.frame.image: scan.frame.problems for scan in with_same_frames(bare)}
    for scan in scans:
        problems = said.get(scan.frame.image, ())
        yield replace(scan, frame=replace(scan.frame, problems=(*scan.frame.problems, *problems))) if problems else scan


def _judged(scan: MeasuredScan, work: Work, project: Project) -> JudgedScan:
    name = scan.frame.image
    return JudgedScan(name, work.results[name], record_of(work.decided(scan), project.path.resolve().parent))


def _copy(scan: MeasuredScan, original: str) -> MeasuredScan:
    """A scan of which none of the marks counts, for they count in another one."""
    told = Reason(f"its file is a copy of that of {original}, which counts", Code.COPY)
    marks = [
        replace(mark, status=Status.REJECTED, reason=told) if mark.status.is_observation else mark
        for mark in scan.frame.marks
    ]
    sentence = f"its file is byte for byte that of {original}: its marks count once. Name one of both in `exclude`."
    problem = Reason(sentence, Code.COPY)
    return replace(scan, frame=replace(scan.frame, marks=tuple(marks), problems=(*scan.frame.problems, problem)))
