"""A flat sheet of dots, some of them ring-coded: found in the whole picture, named without any camera."""

from collections.abc import Sequence

import numpy as np

from measure.flags import Code, Reason, Status
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.block_search import Candidate
from measure.targets.measure_targets import TargetOptions, TargetPrediction, measure_disks
from measure.targets.sheets import Dots, Naming, name_dots
from pipeline.measuring.coded_points import (
    CodedPoints,
    coded_candidates,
    named_by_code,
    none_coded,
    points_read,
    read_numbers,
)
from pipeline.text.wording import listed

_FOUND_WITHIN_PX = 2.0  # how far the fit may move from where the search has a dot


def measure_sheet(scan: Scan, sheet: CodedPoints) -> tuple[tuple[MarkMeasurement, ...], tuple[str, ...]]:
    """A mark for every point of the sheet, and what is to be said of the whole."""
    scan = scan.green_channel()
    found = coded_candidates(scan, sheet)
    numbers = read_numbers(scan, found, sheet)
    coded, notes = named_by_code(points_read(numbers, sheet), sheet)
    naming: Naming | str = none_coded(found, numbers, sheet)
    if coded:
        alike = [i for i, dot in enumerate(found) if dot.contrast_dn * _sign(found, coded) > 0.0]
        found, coded = [found[i] for i in alike], {new: coded[i] for new, i in enumerate(alike) if i in coded}
        naming = name_dots(sheet.places, _dots(found, coded), (scan.width_px, scan.height_px))
    if isinstance(naming, str):
        unnamed = Reason(naming, Code.UNNAMED)
        marks = tuple(MarkMeasurement(id, "target", None, None, Status.ABSENT, unnamed) for id in sheet.ids)
        return marks, (*notes, f"No target has a name: {naming}.")
    misread = [sheet.ids[coded[dot]] for dot in naming.misread]
    if misread:
        notes = (*notes, f"Rings that read as {listed(misread)} lie where the sheet has another point, or none.")
    options = TargetOptions("light" if _sign(found, coded) > 0.0 else "dark")
    predictions = _predictions(sheet, found, naming)
    measured = {mark.point: mark for mark in measure_disks(scan, predictions, options)}
    unseen = Reason("the sheet's place in the picture does not show it", Code.OUTSIDE)
    absent = {id: MarkMeasurement(id, "target", None, None, Status.ABSENT, unseen) for id in sheet.ids}
    return tuple((absent | measured).values()), notes


def _sign(found: Sequence[Candidate], coded: dict[int, int]) -> float:
    """Whether coded dots are light (1) or dark (-1)."""
    return float(np.sign(np.sum([np.sign(found[dot].contrast_dn) for dot in coded]))) or 1.0


def _dots(found: Sequence[Candidate], coded: dict[int, int]) -> Dots:
    return Dots(
        np.array([dot.center_px for dot in found]).reshape(-1, 2),
        np.array([dot.pixel_from_disk for dot in found]).reshape(-1, 2, 2),
        coded,
    )


def _predictions(sheet: CodedPoints, found: Sequence[Candidate], naming: Naming) -> list[TargetPrediction]:
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
