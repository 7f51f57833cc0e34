"""Cross-scan checks: all scans of a project checked together, read from and stored in the results database."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version

from measure.flags import Code, Reason, Status
from measure.results import MEASURE_REVISION
from measure.scans.remote import scan_path
from pipeline.archive.checked_results import Lot
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.work import Work
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.measuring.camera_identification import add_plates, fitting_cameras, tried_cameras
from pipeline.measuring.repeated_views import check_repeated_views
from pipeline.measuring.roll import check_scans, name_roll, note_same_frames
from pipeline.measuring.scan_task import ScanTask, image_options
from pipeline.provenance import alike_groups, content_hash, fingerprint, shard_number
from pipeline.results.measured_record import MeasuredScan

_MADE_BY = (version("reseau"), MEASURE_REVISION)
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
        return Lot(inputs, lambda: map(work.checked_result, scans()))

    def checked_lot(of_cameras: Sequence[OfCamera]) -> Iterable[MeasuredScan]:
        scans = [scan for each in of_cameras for scan in _check_camera(project, *each, work)]
        return share([scan.changed(None, *remarks.get(scan.frame.image, ((), ()))) for scan in scans])

    for of_cameras in _lots(project, own):
        some = [task for _, each in of_cameras for task in each]
        of_writing = [remarks[task.name] for task in some if task.name in remarks]
        depends_on = [
            list(project.cameras.values()),
            project.film,
            of_writing,
            _project_inputs(project, some, input_hash),
        ]
        yield lot(some, depends_on, partial(checked_lot, of_cameras))
    if copies:
        again = sorted(copies.items())
        yield lot(
            [task for task in tasks if task.name in copies],
            again,
            lambda: [_copy(work.read(name), original) for name, original in again],
        )


def find_copies(database: ResultsDatabase, tasks: Sequence[ScanTask], work: Work) -> dict[str, str]:
    """Return {image: first image, by name, with the same file content}.

    Whole files are read only where size and the hash of parts agree.
    """
    identities, hashes = database.identities(), database.content_hashes()

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
    database.set_content_hashes(hashes)
    database.set_copies({work.state(task).uri: copies[task.name] for task in tasks if task.name in copies})
    return copies


def hash_inputs(tasks: Sequence[ScanTask], work: Work, copies: Mapping[str, str], made_from: Mapping[str, str]) -> str:
    """SHA-256 of all inputs of the cross-scan checks: the results and the project's own inputs."""
    keys = work.keys()
    results = [[task.name, keys[task.name]] for task in tasks]
    return fingerprint([results, sorted(copies.items()), made_from, _MADE_BY])


def _lots(project: Project, tasks: Sequence[ScanTask]) -> list[list[OfCamera]]:
    """Scans that are checked together, by camera, at most `_TOGETHER` of each."""
    of_cameras = list[OfCamera]()
    for camera in project.cameras.values():
        own = [task for task in tasks if project.image_camera(task.name) is camera]
        lots = 1
        while len(own) > lots * _TOGETHER:
            lots *= 2
        # Split by a hash of the frame's name: a new scan changes a single lot, and parts of one frame are in one lot.
        some = defaultdict[int, list[ScanTask]](list)
        for task in own:
            some[shard_number(project.image_frame(task.name), lots)].append(task)
        of_cameras += [(camera, some[lot]) for lot in sorted(some)]
    # Natural points may link any scans; targets and parts of frames are linked only in small projects.
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
        [project.scanned_frame(each.name) for each in tasks] if project.has_parts else None,
    ]


def _check_camera(
    project: Project, camera: CameraFile, tasks: Sequence[ScanTask], work: Work
) -> tuple[MeasuredScan, ...]:
    """Second step of the measurement. Scans whose marks get other names by it are measured again."""
    scans = name_roll(tasks, [work.read(task.name) for task in tasks], camera.writing, work.measure)
    others = fitting_cameras(camera, scans, project.cameras, project.film.sigma_mm)
    if len(project.cameras) > 1 and any(Code.NO_FRAME in each.codes for scan in scans for each in scan.frame.problems):
        others |= tried_cameras(scans, tasks, _other_cameras(project, camera), work.trial)
    checked = [
        scan.changed(problems=[others[scan.frame.image]]) if scan.frame.image in others else scan
        for scan in check_scans(camera, scans, project.film)
    ]
    is_board = project.targets is not None and project.targets.board is not None
    return tuple(check_repeated_views(checked, is_board, work.picture))


def _other_cameras(project: Project, camera: CameraFile) -> dict[str, CameraFile]:
    """The other cameras of a project by name, with the templates of their learned marks."""
    options, images = image_options(project, {}), list(project.scans)
    shown = {
        name: [image for image in images if project.image_camera(image) is each]
        for name, each in project.cameras.items()
    }
    return {
        name: options(some[0]).camera for name, some in shown.items() if some and project.cameras[name] is not camera
    }


def _writing_remarks(project: Project, tasks: Sequence[ScanTask], work: Work) -> Remarks:
    """Remarks from the writing about other scans: plates of other cameras, frames scanned twice."""
    names = work.names_with_writing([task.name for task in tasks])
    bare = dict[str, MeasuredScan]()
    for camera in project.cameras.values():
        own = [work.read_writing(name) for name in names if project.image_camera(name) is camera]
        bare |= {scan.frame.image: scan for scan in add_plates(camera, own, project.cameras)}
    noted = note_same_frames([bare[name] for name in names], project.scanned_frame)
    return {scan.frame.image: (scan.frame.problems, scan.notes) for scan in noted if scan.frame.problems or scan.notes}


def _copy(scan: MeasuredScan, original: str) -> MeasuredScan:
    """Scan with all observations rejected, since they count in the scan of which its file is a copy."""
    reason = Reason(f"its file is a copy of that of {original}, which counts", Code.COPY)
    sentence = f"its file is byte for byte that of {original}: its marks count once. Name one of both in `exclude`."
    return scan.with_status(None, Status.REJECTED, reason).changed(problems=[Reason(sentence, Code.COPY)])
