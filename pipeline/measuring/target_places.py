"""Targets that were seen elsewhere than the others of their image put them: another disk passed off as one of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_vector
from measure.flags import TARGET_ELSEWHERE, TARGET_OFF_PLACE, Code, Reason, Status
from measure.results import MarkMeasurement
from measure.targets.consistency import TargetPlaces, compared
from pipeline.measuring.target_field import Field
from pipeline.results.comparator_file import pixel_from_comparator
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]

_TURN_RAD, _SHIFT = 0.1, 0.1  # how wrong an orientation may be, the latter of the distance
_STEP = 1e-3  # of these, for derivatives


def checked_places(
    marks: Sequence[MarkMeasurement], field: Field, model: ImageModel, scan: MeasuredScan
) -> tuple[MarkMeasurement, ...]:
    """The marks, those doubted or refused that lie where a right one seldom or never does; model: the image, oriented
    to some degrees."""
    observed = {mark.point: mark for mark in marks if mark.status.is_observation}
    seen = np.array([mark.center_px for mark in observed.values()]).reshape(-1, 2)
    covariances = np.array([mark.covariance_px2 for mark in observed.values()]).reshape(-1, 2, 2)
    if len(observed) < 2:
        return tuple(marks)
    row = {id: i for i, id in enumerate(field.ids)}
    targets = target_places(field.of([row[id] for id in observed]), model, scan)
    comparison = compared(targets, seen, covariances, (scan.width_px, scan.height_px))
    far = np.linalg.norm(comparison.off_px, axis=1)
    verdicts = dict(zip(observed, zip(far.tolist(), comparison.chance.tolist(), strict=True), strict=True))
    return tuple(_judged(mark, verdicts) for mark in marks)


def _judged(mark: MarkMeasurement, verdicts: Mapping[str, tuple[float, float]]) -> MarkMeasurement:
    off_px, chance = verdicts.get(mark.point, (0.0, 1.0))
    if chance > TARGET_OFF_PLACE:
        return mark
    how = f"it lies {off_px:.2f} px from where the other targets put it"
    if chance < TARGET_ELSEWHERE:
        wrong = Reason(f"another mark, or the point's coordinates are wrong: {how}", Code.OFF_PLACE)
        return replace(mark, status=Status.REJECTED, reason=wrong)
    reason = Reason(f"{how}, as one of {1.0 / chance:.0f} right ones does", Code.OFF_PLACE)
    return replace(mark, status=Status.WEAK, reason=Reason.combine((mark.reason, reason)))


def target_places(field: Field, model: ImageModel, scan: MeasuredScan) -> TargetPlaces:
    """Where an image shows the points of a field, by its orientation and their coordinates."""

    def places(image: ImageModel, xyz: Array) -> Array:
        comparator, _ = image.comparator_from_object(xyz)
        return pixel_from_comparator(comparator, scan.pitch_um)

    distance = float(np.median(np.linalg.norm(field.xyz - model.station, axis=1)))
    ahead = places(model, field.xyz)
    by_orientation = []
    for axis in np.eye(3):
        turned = replace(model, rotation=rotation_from_vector(_STEP * _TURN_RAD * axis) @ model.rotation)
        shifted = replace(model, station=model.station + _STEP * _SHIFT * distance * axis)
        by_orientation += [(places(moved, field.xyz) - ahead) / _STEP for moved in (turned, shifted)]
    step = _STEP * distance
    by_point = np.stack([(places(model, field.xyz + step * axis) - ahead) / step for axis in np.eye(3)], axis=-1)
    is_free = np.asarray(~np.isfinite(field.sigmas).all(axis=1))
    moved = by_point * np.where(is_free[:, None], 0.0, field.sigmas)[:, None]
    return TargetPlaces(ahead, np.stack(by_orientation, axis=-1), moved @ moved.swapaxes(1, 2), is_free)
