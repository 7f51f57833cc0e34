"""Cross-scan checks: all scans of a project checked together, read from and stored in the results database; among them
that of repeated views, a board shown where another picture shows it, or one scan stored twice."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import version

import cv2
import numpy as np

from measure.flags import Code, Reason, Status
from measure.geometry import UP_FROM_CAMERA
from measure.results import MEASURE_REVISION, Kind
from measure.scans.remote import scan_path
from pipeline.archive.checked_results import Lot
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.work import Work
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.measuring.camera_identification import add_plates, fitting_cameras, tried_cameras
from pipeline.measuring.roll import check_scans, name_roll, note_same_frames
from pipeline.measuring.scan_task import ScanTask, image_options
from pipeline.provenance import alike_groups, content_hash, fingerprint, shard_number
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array

_MADE_BY = (version("reseau"), MEASURE_REVISION)
_TOGETHER = 2000  # most frames of a camera that are checked together, to limit memory
OfCamera = tuple[CameraFile, Sequence[ScanTask]]
Remarks = Mapping[str, tuple[tuple[Reason, ...], tuple[str, ...]]]  # problems and notes by image
_SAME_VIEW = 0.005  # fraction of an image's longer side; in sets of boards no two images are nearer than 0.04
_TARGET_WEIGHT = 0.1  # of distances of targets: in rectified scans of different frames they alone lie elsewhere
_SAME_SCAN_PX = 0.2  # px: film that is laid on a scanner again lies many pixels elsewhere
_FEWEST_COMMON = 4  # points in both of two images
_GRID = 128  # cells a side in which the content of two scans is compared
_EDGE = 0.125  # fraction of the box on each side that is left out: all frames show the edge of the camera's frame
_AROUND = 9  # cells whose mean is subtracted: light falls off towards the corners in all frames
_AT_MARK = 2.5  # cells around a mark that are left out: all frames show it
_SAME_CONTENT = 0.5  # correlation; contents of different frames have less than 0.1

Picture = Callable[[MeasuredScan], Array | None]  # (rows, columns) reduced grey values of the whole scan
Box = tuple[float, float, float, float]  # left, bottom, right, top, in sides of a scan from its centre


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
    return scan.change_status(None, Status.REJECTED, reason).changed(problems=[Reason(sentence, Code.COPY)])


def check_repeated_views(scans: Sequence[MeasuredScan], is_board: bool, picture: Picture) -> list[MeasuredScan]:
    """Reject a board's points in images that show it where another image does, and all marks of scans stored twice.

    The errors of lens, board and picture's processing repeat in such an image, so that it adds nothing to the other. A
    scan stored again, in another format, size or orientation, has all marks at the same places of the picture. Where
    these are fiducials alone, the pictures are compared, too: scans of different frames may be rectified to the same
    places. Such a scan is only named.
    """
    weights = {"target": 1.0} if is_board else {"fiducial": 1.0, "target": _TARGET_WEIGHT}
    marks = dict.fromkeys((mark.kind, mark.point) for scan in scans for mark in scan.frame.marks)
    points = {mark: at for at, mark in enumerate(marks)}
    weight = np.array([weights.get(kind, 0.0) for kind, _ in marks])
    is_target = np.array([kind == "target" for kind, _ in marks], dtype=bool)
    sides_px = np.array([max(scan.width_px, scan.height_px, 1) for scan in scans])
    places = np.full((len(scans), len(points), 2), np.nan)  # from the centre, in sides, along the camera's axes
    for row, scan in enumerate(scans):
        for mark in scan.frame.marks:
            if mark.center_px is not None and mark.status.is_observation and mark.kind in weights:
                centred = mark.center_px + 0.5 - np.array([scan.width_px, scan.height_px]) / 2
                places[row, points[mark.kind, mark.point]] = centred * (1, -1) @ _up(scan) / sides_px[row]
    is_known = np.isfinite(places[..., 0])
    kept, repeated = list[int](), dict[int, MeasuredScan]()

    @cache
    def content(row: int, box: Box) -> Array | None:
        return _content(scans[row], places[row], box, picture)

    def show_the_same(first: int, second: int) -> bool:
        common = places[first][is_known[first] & is_known[second]]
        left, bottom, right, top = (float(side) for edge in (common.min(0), common.max(0)) for side in edge.round(2))
        one, other = (content(row, (left, bottom, right, top)) for row in (first, second))
        # A negative and its positive show the same, too; pictures that cannot be read may do so.
        return one is None or other is None or abs(float((one * other).sum())) > _SAME_CONTENT

    for row in np.argsort(-is_known.sum(axis=1), kind="stable").tolist():
        apart = np.nan_to_num(weight * np.linalg.norm(places[kept] - places[row], axis=2)).max(axis=1, initial=0)
        apart_px = apart * np.minimum(sides_px[kept], sides_px[row])
        is_comparable = (is_known[kept] & is_known[row]).sum(axis=1) >= _FEWEST_COMMON
        apart_px[~is_comparable] = np.inf
        limit_px = _SAME_VIEW * sides_px[row] if is_board else _SAME_SCAN_PX
        for at in np.argsort(apart_px, kind="stable")[: np.count_nonzero(apart_px < limit_px)].tolist():
            nearest, least_px = kept[at], max(float(apart_px[at]), 0.1)
            has_targets = bool((is_known[nearest] & is_known[row])[is_target].any())
            if has_targets or show_the_same(nearest, row):
                repeated[row] = _repeated(scans[row], scans[nearest], least_px, is_board, has_targets)
                break
        else:
            kept.append(row)
    return [repeated.get(row, scan) for row, scan in enumerate(scans)]


def _up(scan: MeasuredScan) -> Array:
    """(2, 2) rotation from the camera's axes to the scan's (right, up)."""
    return UP_FROM_CAMERA[scan.frame.pose.name] if scan.frame.pose else np.eye(2)


def _content(scan: MeasuredScan, places: Array, box: Box, picture: Picture) -> Array | None:
    """Detail of a scan in a box, (cells, cells), 0 at the marks and of norm 1; None if it cannot be read.

    The cells lie along the camera's axes. places: (n, 2) of the marks, in sides of the scan from its centre; NaN for
    marks that are not observed.
    """
    grey = picture(scan)
    if grey is None:
        return None
    steps = _EDGE + (1.0 - 2.0 * _EDGE) * (np.arange(_GRID) + 0.5) / _GRID
    low, high = np.array(box[:2]), np.array(box[2:])
    cells = np.stack(np.meshgrid(*(low + (high - low) * steps[:, None]).T), axis=-1)  # (rows, columns, 2)
    size_px = np.array(grey.shape[::-1])
    at_px = (cells @ _up(scan).T * (1, -1) * size_px.max() + size_px / 2 - 0.5).astype(np.float32)
    width_px = max(1, round(float((high - low).max() * size_px.max() / _GRID)))
    smooth = cv2.blur(np.asarray(grey, dtype=np.float32), (width_px, width_px))
    shown = cv2.remap(smooth, at_px[..., 0], at_px[..., 1], cv2.INTER_LINEAR)
    detail = shown - cv2.blur(shown, (_AROUND, _AROUND))
    reach = _AT_MARK * (high - low) / _GRID
    for place in places[np.isfinite(places[:, 0])]:
        detail[(np.abs(cells - place) < reach).all(axis=-1)] = 0.0
    return np.asarray(detail / max(float(np.linalg.norm(detail)), 1e-9))


def _repeated(
    scan: MeasuredScan, original: MeasuredScan, apart_px: float, is_board: bool, is_sure: bool
) -> MeasuredScan:
    """Scan that repeats another one; its marks, of a board its points, are rejected if that is sure."""
    first, within = original.frame.image, f"to within {apart_px:.1f} px"
    if is_board:
        what = f"it shows the board where {first} does {within}"
        sentence = f"{what}: its points count once. Move the board or the camera from picture to picture."
    elif is_sure:
        what = f"its marks, targets too, lie where those of {first} do, {within}: both are the same scan"
        sentence = f"{what}, and its marks count once. To use this one, name {first} in `exclude`."
    else:
        what = f"its marks lie where those of {first} do, {within}, and nothing tells their pictures apart"
        sentence = f"{what}: it is one scan stored twice, and its marks count twice. Name one of both in `exclude`."
    if is_board or is_sure:
        kind: Kind | None = "target" if is_board else None
        scan = scan.change_status(kind, Status.REJECTED, Reason(f"{what}, which counts", Code.COPY))
    return scan.changed(problems=[Reason(sentence, Code.COPY)])
