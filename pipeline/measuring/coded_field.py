"""A field in space of dots, some of them ring-coded: the codes orient the image, which names the other dots."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.flags import NO_REASON, Code, Reason, Status
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.block_search import Candidate
from measure.targets.measure_targets import TargetOptions, TargetPrediction, measure_disks
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.camera_model import camera_model
from pipeline.measuring.coded_points import (
    CodedPoints,
    coded_candidates,
    named_by_code,
    none_coded,
    points_read,
    read_numbers,
)
from pipeline.measuring.target_field import Field
from pipeline.measuring.target_places import checked_places
from pipeline.measuring.unoriented import NamedField, name_field
from pipeline.results.measured_scan import MeasuredScan
from pipeline.text.wording import listed


def measure_coded_field(
    scan: Scan, points: CodedPoints, field: Field, camera: CameraFile, measured: MeasuredScan
) -> tuple[tuple[MarkMeasurement, ...], tuple[str, ...]]:
    """A mark for every point of the field, and what is to be said of the whole."""
    scan = scan.green_channel()
    found = coded_candidates(scan, points)
    numbers = read_numbers(scan, found, points, _is_mirrored(measured))
    read = points_read(numbers, points)
    coded, notes = named_by_code(read, points)
    model = camera_model(camera, measured)
    if isinstance(model, str):
        named: NamedField | str = model
    elif not coded:
        named = none_coded(found, numbers, points)
    else:
        named = name_field(field, model, camera, measured, found, coded)
    if isinstance(named, str):
        unnamed = Reason(named, Code.UNNAMED)
        marks = tuple(MarkMeasurement(id, "target", None, None, Status.ABSENT, unnamed) for id in points.ids)
        return marks, (*notes, f"No target has a name: {named}.")
    ids = {dot: points.ids[point] for dot, point in read.items()}
    misread = [(id, found[dot]) for dot, id in ids.items() if named.candidates.get(id) is not found[dot]]
    if misread:
        others = listed(sorted({id for id, _ in misread}))
        notes = (*notes, f"Rings that read as {others} lie where the field has another point, or none.")
    predictions = named.predictions(_of_size(field, named, measured), measured)
    contradicted = {
        one.point: MarkMeasurement(one.point, "target", one.center_px, None, Status.REJECTED, reason)
        for one in predictions
        if (reason := _contradiction(one, misread))
    }
    sought = [one for one in predictions if one.point not in contradicted]
    seen = {mark.point: mark for mark in measure_disks(scan, sought, TargetOptions(points.settings.polarity))}
    unseen = Reason("it lies behind the camera", Code.OUTSIDE)
    absent = {id: MarkMeasurement(id, "target", None, None, Status.ABSENT, unseen) for id in points.ids}
    marks = tuple((absent | seen | contradicted).values())
    return checked_places(marks, field, named.model, measured), notes


def _contradiction(prediction: TargetPrediction, misread: Sequence[tuple[str, Candidate]]) -> Reason:
    """Why a point is not what lies at its place, if a ring there says so."""
    reach = float(prediction.half_axes_px[0]) + prediction.search_px
    for id, dot in misread:
        if id != prediction.point and np.hypot(*(dot.center_px - prediction.center_px)) < reach:
            return Reason(f"the ring at its place reads as {id}", Code.UNNAMED)
    return NO_REASON


def _is_mirrored(measured: MeasuredScan) -> bool:
    """Whether the scan shows the film from its other side. The camera frame's y goes up, the scan's rows go down."""
    place = measured.frame.pixel_from_camera
    return place is not None and bool(np.linalg.det(place[:, :2]) > 0.0)


def _of_size(field: Field, named: NamedField, measured: MeasuredScan) -> Field:
    """The field with the size that its dots have in the picture, where the project does not say it."""
    if field.radius > 0.0:
        return field
    unit = replace(field, radius=1e-4 * float(np.ptp(field.xyz, axis=0).max()))
    expected = {one.point: one for one in unit.predictions(named.model, measured, named.gate_px)}
    ratios = [
        candidate.radius_px / float(np.sqrt(abs(np.linalg.det(expected[id].pixel_from_disk))))
        for id, candidate in named.candidates.items()
    ]
    return replace(unit, radius=unit.radius * float(np.median(ratios)))
