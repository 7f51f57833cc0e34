"""Check of the points of a flat sheet or board across all its images."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from measure.flags import SHEET_POINT_ELSEWHERE, SHEET_POINT_OFF_PLACE, Code, Reason, Status
from measure.results import MarkMeasurement
from measure.targets.consistency import (
    FLAT,
    ImagePoints,
    SheetImage,
    compare_images,
    plane_coordinates,
    predict_sheet_points,
)
from pipeline.files.project_file import Project
from pipeline.measuring.coded_targets import CodedPoints
from pipeline.results.measured_record import MeasuredScan

Array = NDArray[np.float64]

_WITNESSES = 3  # other images: two only determine the place of a point that lies off its sheet, and check nothing


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Points of a sheet: their ids, and coordinates (n, 3) in its plane and perpendicular to it."""

    ids: tuple[str, ...]
    places: Array


@dataclass(frozen=True)
class _Verdict:
    """Test result of one mark.

    Attributes
    ----------
    off_px : distance from its predicted place.
    chance : p-value, corrected for the number of marks in all images.
    others : number of other images that show the point.
    is_beyond : whether it is farther off than the point can lie off its sheet.
    """

    off_px: float
    chance: float
    others: int
    is_beyond: bool


def check_sheet(project: Project, scans: Sequence[MeasuredScan]) -> tuple[MeasuredScan, ...]:
    """Doubt or reject sheet points that contradict the other points of their image and the other images of the
    sheet."""
    sheet = _sheet(project)
    if sheet is None:
        return tuple(scans)
    images = _images(project, scans, sheet)
    verdicts = dict(zip(images, _verdicts(list(images.values()), sheet), strict=True))
    return tuple(_apply_verdicts(scan, verdicts.get(scan.frame.image, {})) for scan in scans)


def _sheet(project: Project) -> _Sheet | None:
    """Points of the project's board, as printed, or of its flat coded sheet; None without either."""
    settings = project.targets
    if settings is not None and settings.board is not None:
        points = settings.board.object_points()
        return _Sheet(tuple(points), plane_coordinates(np.array(list(points.values()))))
    if settings is None or settings.code is None:
        return None
    coded = CodedPoints.from_project(project, settings)
    return _Sheet(coded.ids, plane_coordinates(coded.xyz)) if coded.is_flat else None


def _images(project: Project, scans: Sequence[MeasuredScan], sheet: _Sheet) -> dict[str, ImagePoints]:
    """Sheet points in each image, by its name; the images of one camera share a lens."""
    row = {id: i for i, id in enumerate(sheet.ids)}
    images: dict[str, ImagePoints] = {}
    for camera in project.cameras.values():
        own = [scan for scan in scans if project.image_camera(scan.frame.image) is camera]
        points = predict_sheet_points([_sheet_image(scan, row) for scan in own], sheet.places)
        images |= {scan.frame.image: one for scan, one in zip(own, points, strict=True) if one is not None}
    return images


def _sheet_image(scan: MeasuredScan, row: Mapping[str, int]) -> SheetImage:
    targets = [mark for mark in scan.frame.marks if mark.kind == "target" and mark.point in row]
    marks = [mark for mark in targets if mark.status.is_observation]
    return SheetImage(
        np.array([row[mark.point] for mark in marks], dtype=np.intp),
        np.array([mark.center_px for mark in marks]).reshape(-1, 2),
        np.array([mark.covariance_px2 for mark in marks]).reshape(-1, 2, 2),
        (scan.width_px, scan.height_px),
    )


def _verdicts(images: Sequence[ImagePoints], sheet: _Sheet) -> list[dict[str, _Verdict]]:
    """Test results by point, for each image."""
    if not images:
        return []
    shown = Counter(int(point) for image in images for point in image.index)
    tests = sum(shown.values())
    verdicts: list[dict[str, _Verdict]] = []
    for image, one in zip(images, compare_images(images, sheet.places), strict=True):
        most_px = FLAT * float(np.hypot(*np.ptp(image.targets.places_px, axis=0)))
        far = np.hypot(*one.off_px.T)
        rows = zip(image.index.tolist(), far.tolist(), one.chance.tolist(), strict=True)
        verdicts.append(
            {
                sheet.ids[point]: _Verdict(off, tests * chance, shown[point] - 1, off > most_px)
                for point, off, chance in rows
            }
        )
    return verdicts


def _apply_verdicts(scan: MeasuredScan, verdicts: Mapping[str, _Verdict]) -> MeasuredScan:
    marks = tuple(
        _apply_verdict(mark, verdicts[mark.point]) if mark.kind == "target" and mark.point in verdicts else mark
        for mark in scan.frame.marks
    )
    return replace(scan, frame=replace(scan.frame, marks=marks))


def _apply_verdict(mark: MarkMeasurement, verdict: _Verdict) -> MarkMeasurement:
    """Set the status of a mark by its test.

    Without another image, the mark and the point on the sheet may be at fault; with few others, any of them.
    """
    if verdict.chance > SHEET_POINT_OFF_PLACE:
        return mark
    witnesses = "the sheet's other points" + (" and other pictures" if verdict.others else "")
    how = f"it lies {verdict.off_px:.2f} px from where {witnesses} put it"
    if (verdict.others >= _WITNESSES or verdict.is_beyond) and verdict.chance < SHEET_POINT_ELSEWHERE:
        return replace(
            mark, status=Status.REJECTED, reason=Reason(f"another mark, or one disturbed: {how}", Code.OFF_PLACE)
        )
    alone = "" if verdict.others else ", and no other picture tells whether it does so on the sheet"
    reason = Reason(f"{how}{alone}; p = {verdict.chance:.1g}", Code.OFF_PLACE)
    return replace(mark, status=Status.WEAK, reason=Reason.combine((mark.reason, reason)))
