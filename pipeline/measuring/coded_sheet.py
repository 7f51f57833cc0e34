"""A flat sheet of dots, some of them ring-coded: found in the whole picture, named without any camera."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.ring_codes import read_code
from measure.codes_and_boards.sheet_naming import Dots, Naming, name_dots
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.single_targets.disk_patches import Candidate, DiskSearch
from measure.single_targets.disk_search import disk_candidates
from measure.single_targets.targets import TargetOptions, TargetPrediction, measure_disks
from measure.status import Status
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.spelling import did_you_mean
from pipeline.wording import listed

Array = NDArray[np.float64]

_LEAST_DIAMETER_PX, _GREATEST_SHARE = 8.0, 0.04  # of a dot; the greatest of the picture's diagonal
_LEAST_CONTRAST = 0.06  # of the full scale: coded targets are printed to be seen
_FLAT = 0.01  # of the field's size: a sheet may be as uneven as this
_FOUND_WITHIN_PX = 2.0  # how far the fit may move from where the search has a dot


@dataclass(frozen=True, eq=False)
class CodedSheet:
    """ids and coordinates xyz (n, 3) of its points; places (n, 2): on the plane that holds them best; is_flat: whether
    it does; settings: the kind of the targets."""

    ids: tuple[str, ...]
    xyz: Array
    places: Array
    is_flat: bool
    settings: TargetSettings

    @classmethod
    def of(cls, project: Project, settings: TargetSettings) -> "CodedSheet":
        """The sheet that points.csv describes. Raises InputError where it holds none, or lacks a coded point."""
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
        places = np.array(list(xyz.values())).reshape(-1, 3)
        if len(places) < 4:
            raise InputError(
                f"{project.path}: [object] points: {len(places)} points with X, Y and Z name no coded targets; give 4."
            )
        spread = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
        height = np.ptp((places - places.mean(axis=0)) @ spread.Vh[2])
        is_flat = bool(height <= _FLAT * np.ptp((places - places.mean(axis=0)) @ spread.Vh[0]))
        return cls(tuple(xyz), places, (places - places.mean(axis=0)) @ spread.Vh[:2].T, is_flat, settings)


def measure_sheet(scan: Scan, sheet: CodedSheet) -> tuple[tuple[MarkMeasurement, ...], tuple[str, ...]]:
    """A mark for every point of the sheet, and what is to be said of the whole."""
    scan = scan.green()
    found = coded_candidates(scan, sheet)
    numbers = read_numbers(scan, found, sheet)
    coded, notes = coded_points(numbers, sheet)
    naming: Naming | str = none_coded(found, numbers, sheet)
    if coded:
        alike = [i for i, dot in enumerate(found) if dot.contrast_dn * _sign(found, coded) > 0.0]
        found, coded = [found[i] for i in alike], {new: coded[i] for new, i in enumerate(alike) if i in coded}
        naming = name_dots(sheet.places, _dots(found, coded), (scan.width_px, scan.height_px))
    if isinstance(naming, str):
        marks = tuple(MarkMeasurement(id, "target", None, None, Status.ABSENT, naming) for id in sheet.ids)
        return marks, (*notes, f"No target has a name: {naming}.")
    strangers = [sheet.ids[coded[dot]] for dot in naming.strangers]
    if strangers:
        notes = (*notes, f"Rings that read as {listed(strangers)} lie where the sheet has another point, or none.")
    options = TargetOptions("light" if _sign(found, coded) > 0.0 else "dark")
    predictions = _predictions(sheet, found, naming)
    measured = {mark.point: mark for mark in measure_disks(scan, predictions, options)}
    unseen = "the sheet's place in the picture does not show it"
    absent = {id: MarkMeasurement(id, "target", None, None, Status.ABSENT, unseen) for id in sheet.ids}
    return tuple((absent | measured).values()), notes


def coded_candidates(scan: Scan, sheet: CodedSheet) -> list[Candidate]:
    greatest = max(_GREATEST_SHARE * float(np.hypot(scan.width_px, scan.height_px)), _LEAST_DIAMETER_PX)
    search = DiskSearch((_LEAST_DIAMETER_PX, greatest), sheet.settings.polarity, _LEAST_CONTRAST)
    return disk_candidates(scan, search)


def read_numbers(scan: Scan, found: Sequence[Candidate], sheet: CodedSheet, mirrored: bool = False) -> dict[int, int]:
    """The number about each dot that has one; mirrored: as the other side of the film shows it."""
    code = sheet.settings.code
    read = {index: read_code(scan, dot, code) for index, dot in enumerate(found)} if code else {}
    return {
        index: code.mirrored(number) if mirrored else number
        for index, number in read.items()
        if number is not None and code is not None
    }


def coded_points(numbers: dict[int, int], sheet: CodedSheet) -> tuple[dict[int, int], tuple[str, ...]]:
    """The point (by index) of each coded dot; a code that is read twice says nothing."""
    row = {id: i for i, id in enumerate(sheet.ids)}
    points = {dot: sheet.settings.numbers.get(number, str(number)) for dot, number in numbers.items()}
    count = Counter(points.values())
    twice = sorted(point for point in count if count[point] > 1 and point in row)
    notes = (f"The codes of {listed(twice)} were read at more than one place and are not used.",) if twice else ()
    return {dot: row[point] for dot, point in points.items() if point in row and count[point] == 1}, notes


def none_coded(found: Sequence[Candidate], numbers: dict[int, int], sheet: CodedSheet) -> str:
    bits = sheet.settings.code.bits if sheet.settings.code else 0
    if not found:
        return "no dot was found"
    if not numbers:
        return f"none of the {len(found)} dots found has a ring of {bits} segments about it that can be read"
    strangers = ", ".join(str(number) for number in sorted(set(numbers.values()))[:8])
    return f"the codes read ({strangers}) are those of no point of the sheet, or were read at more than one place"


def _sign(found: Sequence[Candidate], coded: dict[int, int]) -> float:
    """Whether coded dots are light (1) or dark (-1)."""
    return float(np.sign(np.sum([np.sign(found[dot].contrast_dn) for dot in coded]))) or 1.0


def _dots(found: Sequence[Candidate], coded: dict[int, int]) -> Dots:
    return Dots(
        np.array([dot.center_px for dot in found]).reshape(-1, 2),
        np.array([dot.pixel_from_disk for dot in found]).reshape(-1, 2, 2),
        coded,
    )


def _predictions(sheet: CodedSheet, found: Sequence[Candidate], naming: Naming) -> list[TargetPrediction]:
    """Each named point where its dot was found; each other point where the sheet's place in the picture puts it."""
    predictions = []
    for index, id in enumerate(sheet.ids):
        place, shape = naming.places_px[index], naming.pixel_from_disk[index]
        if index in naming.named:
            dot = found[naming.named[index]]
            predictions.append(TargetPrediction(id, dot.center_px, dot.pixel_from_disk, _FOUND_WITHIN_PX))
        elif np.all(np.isfinite(place)) and np.all(np.isfinite(shape)):
            predictions.append(TargetPrediction(id, place, shape, naming.gate_px))
    return predictions
