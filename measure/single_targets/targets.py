"""Targets of a test field, measured where an approximate orientation says that they are."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from measure.marks.shapes import MarkShape, cross
from measure.reason import NO_REASON, Code, Reason
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.single_targets.assignment import Links, assign
from measure.single_targets.disks import SMALLEST_RADIUS_PX, UNIT_DISK, FittedDisk
from measure.single_targets.dusty_disks import doubts
from measure.single_targets.target_search import search_targets
from measure.status import Status

Array = NDArray[np.float64]
Polarity = Literal["light", "dark", "auto"]


@dataclass(frozen=True, eq=False)
class TargetPrediction:
    """Where a target should be, and how its shape is sheared there.

    center_px (2,): column and row; pixel_from_disk (2, 2): the target's circle of radius 1 to px, its columns the
    images of two radius vectors at right angles; search_px: how far off the prediction may be. perspective (2,), per
    px: what an affinity puts d px off the centre lies d / (1 + perspective d) off it.
    """

    point: str
    center_px: Array
    pixel_from_disk: Array
    search_px: float
    perspective: Array = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        if np.shape(self.center_px) != (2,) or np.shape(self.pixel_from_disk) != (2, 2):
            raise ValueError(f"target {self.point}: center_px is (2,) and pixel_from_disk (2, 2)")
        if not self.search_px > 0:
            raise ValueError(f"target {self.point}: search_px is {self.search_px}; a positive number is right")

    @property
    def half_axes_px(self) -> Array:
        """(2,) the longer and the shorter half axis of the ellipse."""
        return np.asarray(np.linalg.svd(self.pixel_from_disk, compute_uv=False))


@dataclass(frozen=True)
class TargetOptions:
    """How targets are measured.

    polarity: lighter or darker than their surroundings, "auto": what most of them are. size_tolerance: the fitted
    radius over the predicted one, or the reverse, at most. gate_sigmas, least_gate_px: how far from its place a target
    may lie, after the shift that all of them share was found, in robust standard deviations of all, and never less.
    """

    polarity: Polarity = "auto"
    size_tolerance: float = 1.4
    gate_sigmas: float = 5.0
    least_gate_px: float = 2.0

    def __post_init__(self) -> None:
        if self.polarity not in ("light", "dark", "auto"):
            raise ValueError(f"polarity is {self.polarity!r}; light, dark or auto is right")
        if not self.size_tolerance > 1:
            raise ValueError(f"size_tolerance is {self.size_tolerance}; a number above 1 is right")
        if not (self.gate_sigmas > 0 and self.least_gate_px > 0):
            raise ValueError("gate_sigmas and least_gate_px are positive")


@dataclass(frozen=True)
class _Row:
    """A prediction and what was made of it: the disk that is its target, or why there is none."""

    prediction: TargetPrediction
    disk: FittedDisk | None = None
    status: Status = Status.PREDICTED
    reason: Reason = NO_REASON


def measure_disks(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions | None = None
) -> tuple[MarkMeasurement, ...]:
    """Find, fit and identify disks: one mark for each prediction, whatever became of it.

    A disk is a prediction's target if it is the one disk of the right size near the place where the prediction and the
    shift that all targets share put it. Points are named once; ValueError otherwise.
    """
    return _measured(scan, predictions, options or TargetOptions(), UNIT_DISK)


def measure_crosses(
    scan: Scan, predictions: Sequence[TargetPrediction], line: float, options: TargetOptions | None = None
) -> tuple[MarkMeasurement, ...]:
    """The same for upright crosses: radius 1 is half an arm-to-arm length, line is the arms' width in that unit."""
    return _measured(scan, predictions, options or TargetOptions(), MarkShape(cross(1.0, line)))


def _measured(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions, shape: MarkShape
) -> tuple[MarkMeasurement, ...]:
    names = [prediction.point for prediction in predictions]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"{scan.name}: predicted twice: {', '.join(twice)}; each point is right once")
    refused = {prediction.point: _refusal(prediction, scan) for prediction in predictions}
    sought = [prediction for prediction in predictions if refused[prediction.point] is None]
    # A disk near several places is fitted from the first: in what order they are given must not matter.
    sought.sort(key=lambda prediction: prediction.point)
    found = {row.prediction.point: row for row in _identified(scan, sought, options, shape)}
    return tuple(_mark(refused[prediction.point] or found[prediction.point]) for prediction in predictions)


def _refusal(prediction: TargetPrediction, scan: Scan) -> _Row | None:
    """Why a target is not even looked for."""
    col, row = prediction.center_px
    if not (-0.5 <= col < scan.width_px - 0.5 and -0.5 <= row < scan.height_px - 0.5):
        return _Row(prediction, None, Status.ABSENT, Reason("outside of the scan", Code.OUTSIDE))
    shorter = prediction.half_axes_px[1]
    if shorter < SMALLEST_RADIUS_PX:
        reason = Reason(f"too small to be measured: half axis {shorter:.1f} px", Code.SMALL)
        return _Row(prediction, None, Status.PREDICTED, reason)
    return None


def _identified(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions, shape: MarkShape
) -> list[_Row]:
    """The disk of each prediction: fitted near it, of the right kind, and alone at its place."""
    search = search_targets(scan, predictions, options.polarity, options.size_tolerance, shape)
    places = np.array([prediction.center_px for prediction in predictions]).reshape(-1, 2)
    centers = np.array([disk.center_px for disk in search.disks]).reshape(-1, 2)
    links = Links(places, centers, search.near)
    assignment = assign(links, options.gate_sigmas, options.least_gate_px)
    rows = []
    for index, prediction in enumerate(predictions):
        disk_index = assignment.chosen[index]
        disk = None if disk_index is None else search.disks[disk_index]
        if disk is None:
            reason = search.why_none[index] or assignment.why_not[index]
            rejected = assignment.nearest[index]
            if rejected is None:
                rows.append(_Row(prediction, None, Status.PREDICTED, reason))
            else:
                rows.append(_Row(prediction, search.disks[rejected], Status.REJECTED, reason))
        else:
            status = Status.WEAK if disk.weakness else Status.MEASURED
            rows.append(_Row(prediction, disk, status, disk.weakness))
    return _compared(rows)


def _compared(rows: list[_Row]) -> list[_Row]:
    """Those that are unlike the others of the frame are weak."""
    seen = [(row, row.disk) for row in rows if row.disk is not None and row.status.is_observation]
    reasons = doubts([disk for _, disk in seen], [row.prediction.pixel_from_disk for row, _ in seen])
    doubt = {id(row): reason for (row, _), reason in zip(seen, reasons, strict=True) if reason}
    return [
        replace(row, status=Status.WEAK, reason=Reason.joined((row.reason, doubt[id(row)])))
        if id(row) in doubt
        else row
        for row in rows
    ]


def _mark(row: _Row) -> MarkMeasurement:
    point = row.prediction.point
    if row.disk is None:
        center = None if row.status is Status.ABSENT else np.asarray(row.prediction.center_px, float)
        return MarkMeasurement(point, "target", center, None, row.status, row.reason)
    disk = row.disk
    return MarkMeasurement(point, "target", disk.center_px, disk.covariance, row.status, row.reason, disk.quality)
