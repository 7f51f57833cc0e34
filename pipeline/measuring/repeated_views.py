"""Cross-scan check of repeated views: a board shown where another picture shows it, and one scan stored twice."""

from collections.abc import Callable, Sequence
from functools import cache

import cv2
import numpy as np

from measure.flags import Code, Reason, Status
from measure.geometry import UP_FROM_CAMERA
from measure.results import Kind
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array

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
        scan = scan.with_status(kind, Status.REJECTED, Reason(f"{what}, which counts", Code.COPY))
    return scan.changed(problems=[Reason(sentence, Code.COPY)])
