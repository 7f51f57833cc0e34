"""Ring-coded targets on a flat sheet or in space, identified by their codes; points of sheets and boards checked across
all images."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from measure.flags import NO_REASON, SHEET_POINT_ELSEWHERE, SHEET_POINT_OFF_PLACE, Code, Reason, Status
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.block_search import TargetCandidate
from measure.targets.consistency import (
    FLAT,
    ImagePoints,
    SheetImage,
    compare_images,
    is_flat,
    plane_coordinates,
    predict_sheet_points,
)
from measure.targets.detection import DiskSearch, disk_candidates
from measure.targets.identification import TargetOptions, TargetPrediction, measure_disks
from measure.targets.ring_codes import read_code
from measure.targets.sheets import Dots, Naming, name_dots
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring.target_field import (
    NamedField,
    TargetField,
    absent_targets,
    camera_model,
    checked_places,
    name_field,
)
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.wording import did_you_mean, listed
from pipeline.types import Array

_LEAST_DIAMETER_PX, _GREATEST_SHARE = 8.0, 0.04  # diameters of dots: px; fraction of the diagonal
_LEAST_CONTRAST = 0.06  # fraction of full scale: coded targets are printed with high contrast
_FOUND_WITHIN_PX = 2.0  # px, largest shift of the fit from the candidate
_WITNESSES = 3  # other images: two only determine the place of a point that lies off its sheet, and check nothing


@dataclass(frozen=True, eq=False)
class CodedPoints:
    """Points of a sheet or of a field in space.

    Attributes
    ----------
    xyz : (n, 3) coordinates.
    places : (n, 2) coordinates in the best-fitting plane.
    is_flat : whether the points lie in that plane.
    """

    ids: tuple[str, ...]
    xyz: Array
    places: Array
    is_flat: bool
    settings: TargetSettings

    @classmethod
    def from_project(cls, project: Project, settings: TargetSettings) -> "CodedPoints":
        """The points of points.csv. Raises InputError where there are too few, or a coded one is missing."""
        if project.given_points is None:
            raise InputError(
                f'{project.path}: [targets] kind "coded-ring" names the dots by the sheet, and there is no [object] '
                'points = "...". Give the file of the sheet\'s points.'
            )
        known = {id: [p.value for p in (q.X, q.Y, q.Z) if p] for id, q in project.object_points.items()}
        xyz = {id: values for id, values in known.items() if len(values) == 3}
        for point in settings.numbers.values():
            if point not in xyz:
                raise InputError(
                    f"{project.path}: [targets.codes] {point}: points.csv has no coordinates of such a point."
                    f"{did_you_mean(point, list(xyz))} Name points of the sheet."
                )
        coordinates = np.array(list(xyz.values())).reshape(-1, 3)
        if len(coordinates) < 4:
            raise InputError(
                f"{project.path}: [object] points: {len(coordinates)} points with X, Y and Z name no coded targets; "
                "give 4."
            )
        along = plane_coordinates(coordinates)
        return cls(tuple(xyz), coordinates, along[:, :2], is_flat(along), settings)


@dataclass(frozen=True, eq=False)
class _CodedDots:
    """Dots found in a scan.

    Attributes
    ----------
    found : candidates, the strongest first.
    read : point, by index, that the ring around each dot names, right or wrong.
    named : without points that were read at several places: these do not identify anything, until the others tell which
        is right.
    none_named : reason why no dot is identified by its code, if none is.
    """

    found: Sequence[TargetCandidate]
    read: Mapping[int, int]
    named: dict[int, int]
    notes: tuple[str, ...]
    none_named: str


def _coded_dots(scan: Scan, coded: CodedPoints, mirrored: bool = False) -> _CodedDots:
    """Find the dots in the whole scan, and read their codes. mirrored: the film is seen from its other side."""
    greatest = max(_GREATEST_SHARE * float(np.hypot(scan.width_px, scan.height_px)), _LEAST_DIAMETER_PX)
    search = DiskSearch((_LEAST_DIAMETER_PX, greatest), coded.settings.polarity, _LEAST_CONTRAST)
    found, code = disk_candidates(scan, search), coded.settings.code
    assert code is not None
    read = {dot: number for dot, one in enumerate(found) if (number := read_code(scan, one, code)) is not None}
    numbers = {dot: code.mirror(number) if mirrored else number for dot, number in read.items()}
    row = {id: i for i, id in enumerate(coded.ids)}
    names = {dot: coded.settings.numbers.get(number, str(number)) for dot, number in numbers.items()}
    points = {dot: row[name] for dot, name in names.items() if name in row}
    count = Counter(points.values())
    twice = sorted(coded.ids[point] for point in count if count[point] > 1)
    notes = (f"The codes of {listed(twice)} were read at more than one place and name nothing.",) if twice else ()
    if not found:
        why = "no dot was found"
    elif not numbers:
        why = f"none of the {len(found)} dots found has a ring of {code.bits} segments about it that can be read"
    else:
        shown = ", ".join(str(number) for number in sorted(set(numbers.values()))[:8])
        why = f"the codes read ({shown}) are those of no point of the sheet, or were read at more than one place"
    named = {dot: point for dot, point in points.items() if count[point] == 1}
    return _CodedDots(found, points, named, notes, why)


def measure_sheet(scan: Scan, sheet: CodedPoints) -> tuple[tuple[MarkMeasurement, ...], tuple[str, ...]]:
    """Measure every point of a flat sheet. Returns a mark for each, and notes."""
    scan = scan.green_channel()
    dots = _coded_dots(scan, sheet)
    found, coded, notes = dots.found, dots.named, dots.notes
    naming: Naming | str = dots.none_named
    if coded:
        alike = [i for i, dot in enumerate(found) if dot.contrast_dn * _sign(found, coded) > 0.0]
        found, coded = [found[i] for i in alike], {new: coded[i] for new, i in enumerate(alike) if i in coded}
        centers_px = np.array([dot.center_px for dot in found]).reshape(-1, 2)
        dots_found = Dots(centers_px, np.array([dot.pixel_from_disk for dot in found]).reshape(-1, 2, 2), coded)
        naming = name_dots(sheet.places, dots_found, (scan.width_px, scan.height_px))
    if isinstance(naming, str):
        return absent_targets(sheet.ids, naming), (*notes, f"No target has a name: {naming}.")
    misread = [sheet.ids[coded[dot]] for dot in naming.misread]
    if misread:
        notes = (*notes, f"Rings that read as {listed(misread)} lie where the sheet has another point, or none.")
    options = TargetOptions("light" if _sign(found, coded) > 0.0 else "dark")
    predictions = []  # of an identified point at its dot, of another one at its place by the fit of the sheet
    for index, id in enumerate(sheet.ids):
        place, shape = naming.places_px[index], naming.pixel_from_disk[index]
        if index in naming.named:
            dot = found[naming.named[index]]
            predictions.append(TargetPrediction(id, dot.center_px, dot.pixel_from_disk, _FOUND_WITHIN_PX))
        elif np.all(np.isfinite(place)) and np.all(np.isfinite(shape)):
            predictions.append(TargetPrediction(id, place, shape, naming.gate_px))
    unseen = absent_targets(sheet.ids, "the sheet's place in the picture does not show it", Code.OUTSIDE)
    marks = {mark.point: mark for mark in (*unseen, *measure_disks(scan, predictions, options))}
    return tuple(marks.values()), notes


def _sign(found: Sequence[TargetCandidate], coded: dict[int, int]) -> float:
    """1 for light coded dots, -1 for dark ones."""
    return float(np.sign(np.sum([np.sign(found[dot].contrast_dn) for dot in coded]))) or 1.0


def measure_coded_field(
    scan: Scan, points: CodedPoints, field: TargetField, camera: CameraFile, measured: MeasuredScan
) -> tuple[tuple[MarkMeasurement, ...], tuple[str, ...]]:
    """Measure every point of a field in space. Returns a mark for each, and notes."""
    scan = scan.green_channel()
    place = measured.frame.pixel_from_camera  # the camera frame's y points up, the scan's rows down
    dots = _coded_dots(scan, points, place is not None and bool(np.linalg.det(place[:, :2]) > 0.0))
    found, notes, model = dots.found, dots.notes, camera_model(camera, measured)
    if isinstance(model, str):
        named: NamedField | str = model
    elif not dots.named:
        named = dots.none_named
    else:
        named = name_field(field, model, camera, measured, found, dots.named)
    if isinstance(named, str):
        return absent_targets(points.ids, named), (*notes, f"No target has a name: {named}.")
    ids = {dot: points.ids[point] for dot, point in dots.read.items()}
    misread = [(id, found[dot]) for dot, id in ids.items() if named.candidates.get(id) is not found[dot]]
    if misread:
        others = listed(sorted({id for id, _ in misread}))
        notes = (*notes, f"Rings that read as {others} lie where the field has another point, or none.")
    predictions = named.predictions(_set_dot_size(field, named, measured), measured)
    contradicted = {
        one.point: MarkMeasurement(one.point, "target", one.center_px, None, Status.REJECTED, reason)
        for one in predictions
        if (reason := _contradiction(one, misread))
    }
    sought = [one for one in predictions if one.point not in contradicted]
    fitted = measure_disks(scan, sought, TargetOptions(points.settings.polarity))
    unseen = absent_targets(points.ids, "it lies behind the camera", Code.OUTSIDE)
    marks = tuple(({mark.point: mark for mark in (*unseen, *fitted)} | contradicted).values())
    return checked_places(marks, field, named.model, measured), notes


def _contradiction(prediction: TargetPrediction, misread: Sequence[tuple[str, TargetCandidate]]) -> Reason:
    """Reason to reject a point if a ring at its place has another code."""
    reach = float(prediction.half_axes_px[0]) + prediction.search_px
    for id, dot in misread:
        if id != prediction.point and np.hypot(*(dot.center_px - prediction.center_px)) < reach:
            return Reason(f"the ring at its place reads as {id}", Code.UNNAMED)
    return NO_REASON


def _set_dot_size(field: TargetField, named: NamedField, measured: MeasuredScan) -> TargetField:
    """Estimate the radius of the dots from the candidates, where the project does not give it."""
    if field.radius > 0.0:
        return field
    unit = replace(field, radius=1e-4 * float(np.ptp(field.xyz, axis=0).max()))
    expected = {one.point: one for one in unit.predictions(named.model, measured, named.gate_px)}
    ratios = [
        candidate.radius_px / float(np.sqrt(abs(np.linalg.det(expected[id].pixel_from_disk))))
        for id, candidate in named.candidates.items()
    ]
    return replace(unit, radius=unit.radius * float(np.median(ratios)))


def check_sheet(project: Project, scans: Sequence[MeasuredScan]) -> tuple[MeasuredScan, ...]:
    """Doubt or reject sheet points that contradict the other points of their image and the other images of the
    sheet."""
    sheet = _sheet(project)
    if not sheet:
        return tuple(scans)
    places, row = plane_coordinates(np.array(list(sheet.values()))), {id: i for i, id in enumerate(sheet)}
    images: dict[str, ImagePoints] = {}
    for camera in project.cameras.values():  # the images of one camera share a lens
        own = [scan for scan in scans if project.image_camera(scan.frame.image) is camera]
        points = predict_sheet_points([_sheet_image(scan, row) for scan in own], places)
        images |= {scan.frame.image: one for scan, one in zip(own, points, strict=True) if one is not None}
    if not images:
        return tuple(scans)
    shown = Counter(int(point) for image in images.values() for point in image.index)
    named_by_place = project.targets is not None and project.targets.board is not None
    names, checked = list(sheet), {scan.frame.image: scan for scan in scans}
    for (name, image), one in zip(images.items(), compare_images(list(images.values()), places), strict=True):
        most_px = FLAT * float(np.hypot(*np.ptp(image.targets.places_px, axis=0)))
        far_px, p_values = np.hypot(*one.off_px.T).tolist(), (shown.total() * one.p_values).tolist()
        # Codes name their points whatever the coordinates are; a board's points are named by their places.
        printed_px = np.hypot(*one.printed_off_px.T) if named_by_place else np.zeros(len(far_px))
        verdicts = {
            names[point]: (off_px, p, shown[point] - 1, off_px > most_px, on_sheet_px if on_sheet_px > most_px else 0.0)
            for point, off_px, p, on_sheet_px in zip(
                image.index.tolist(), far_px, p_values, printed_px.tolist(), strict=True
            )
        }
        scan = checked[name]
        checked[name] = scan.changed(
            [
                _tested_mark(mark, *verdict)
                if mark.kind == "target" and (verdict := verdicts.get(mark.point))
                else mark
                for mark in scan.frame.marks
            ]
        )
    return tuple(checked[scan.frame.image] for scan in scans)


def _sheet(project: Project) -> Mapping[str, ArrayLike]:
    """Points of the project's board, as printed, or of its flat coded sheet; empty without either."""
    settings = project.targets
    if settings is not None and settings.board is not None:
        return settings.board.object_points()
    if settings is None or settings.code is None:
        return {}
    coded = CodedPoints.from_project(project, settings)
    return dict(zip(coded.ids, coded.xyz, strict=True)) if coded.is_flat else {}


def _sheet_image(scan: MeasuredScan, row: Mapping[str, int]) -> SheetImage:
    targets = [mark for mark in scan.frame.marks if mark.kind == "target" and mark.point in row]
    marks = [mark for mark in targets if mark.status.is_observation]
    return SheetImage(
        np.array([row[mark.point] for mark in marks], dtype=np.intp),
        np.array([mark.center_px for mark in marks]).reshape(-1, 2),
        np.array([mark.covariance_px2 for mark in marks]).reshape(-1, 2, 2),
        (scan.width_px, scan.height_px),
    )


def _tested_mark(
    mark: MarkMeasurement, off_px: float, p_value: float, others: int, is_beyond: bool, misplaced_px: float
) -> MarkMeasurement:
    """Set the status of a mark by its distance from its place and p-value, of all images; others: that show the point;
    is_beyond: farther off than the point can lie off its sheet; misplaced_px: as far off in all images, or 0."""
    # Without another image, the mark and the point on the sheet may be at fault; with few others, any of them.
    if p_value > SHEET_POINT_OFF_PLACE:
        where = (
            f"another mark, or the board is damaged: {misplaced_px:.2f} px from the point's place on it in all pictures"
        )
        rejected = replace(mark, status=Status.REJECTED, reason=Reason(where, Code.OFF_PLACE))
        return rejected if misplaced_px else mark
    witnesses = "the sheet's other points" + (" and other pictures" if others else "")
    how = f"it lies {off_px:.2f} px from where {witnesses} put it"
    if (others >= _WITNESSES or is_beyond) and p_value < SHEET_POINT_ELSEWHERE:
        return replace(
            mark, status=Status.REJECTED, reason=Reason(f"another mark, or one disturbed: {how}", Code.OFF_PLACE)
        )
    alone = "" if others else ", and no other picture tells whether it does so on the sheet"
    reason = Reason(f"{how}{alone}; p = {p_value:.1g}", Code.OFF_PLACE)
    return replace(mark, status=Status.WEAK, reason=Reason.combine((mark.reason, reason)))
