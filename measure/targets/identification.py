"""Disks and crosses of a test field measured where they are predicted: searched by correlation, identified, fitted and
checked."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from measure.detection.peaks import local_maxima
from measure.flags import NO_REASON, Code, Reason, Status
from measure.marks.rendering import extent_px, picture
from measure.marks.shapes import MarkShape, Polarity, cross, thinnest_mm
from measure.noise.robust_estimation import robust_scale
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.disks import SMALLEST_RADIUS_PX, UNIT_DISK, FittedDisk, doubts, fit_disk

Array = NDArray[np.float64]

_SEARCHED_RADIUS_PX = 4.0  # windows are reduced until the shorter half axis has about this length...
_THINNEST_PX = 1.5  # ...or the thinnest line this width
_LEAST_CORRELATION = 0.55  # below it a spot is worth no fit, which decides what is a target
_MOST_SPOTS = 6  # fitted near one prediction
_EXPECTED_BLUR_PX = 1.0  # of the reduced window
_GROUND, _GROUND_PX = 0.3, 1.5  # about the target in its predicted picture: a share of its reach, and for the blur
_SAME_DISK = 0.5  # of the shorter half axis: spots nearer to a disk's centre are that disk
_AFFINE_FROM = 8  # targets that agree: from so many on the shared shift may vary over the frame
_VOTE_SHARE = 0.2  # of the farthest link: how far shifts may differ and still count as one
_ROUNDS = 5  # of the shared shift and the gate, each by the other
_FORBIDDEN = 1e9  # px: the cost of a link that there is not


class Prediction(Protocol):
    """What of a prediction matters here."""

    @property
    def center_px(self) -> Array: ...
    @property
    def pixel_from_disk(self) -> Array: ...
    @property
    def search_px(self) -> float: ...
    @property
    def perspective(self) -> Array: ...


@dataclass
class SearchResult:
    """disks: all that were fitted, each once; near: for each prediction the indices of the disks that may be its
    target; why_none: why there are none, empty otherwise."""

    disks: list[FittedDisk] = field(default_factory=list)
    near: list[list[int]] = field(default_factory=list)
    why_none: list[Reason] = field(default_factory=list)


def search_targets(
    scan: Scan, predictions: Sequence[Prediction], polarity: str, size_tolerance: float, shape: MarkShape
) -> SearchResult:
    """Fit what looks like the target near each prediction; with polarity "auto" what most of them are, light or dark,
    is kept."""
    result = SearchResult()
    for prediction in predictions:
        near, why = [], NO_REASON
        for spot in _spots(scan, prediction, polarity, shape):
            index, reason = _fit_spot(scan, spot, prediction, size_tolerance, shape, result)
            if index is None:
                why = why or reason
            elif index not in near:
                near.append(index)
        result.near.append(near)
        none = Reason(f"nothing like it within {prediction.search_px:.0f} px of its place", Code.NOT_FOUND)
        result.why_none.append(NO_REASON if near else Reason.combine((none, why)))
    if polarity == "auto":
        _keep_common_polarity(result)
    return result


def _spots(scan: Scan, prediction: Prediction, polarity: str, shape: MarkShape) -> list[Array]:
    """(2,) places within the search distance where the predicted picture correlates best, the best first."""
    shorter = float(np.linalg.svd(prediction.pixel_from_disk, compute_uv=False)[1])
    factor = max(1, int(shorter * min(1.0 / _SEARCHED_RADIUS_PX, thinnest_mm(shape) / _THINNEST_PX)))
    template = _predicted_picture(prediction.pixel_from_disk / factor, shape)
    half = np.array(template.shape[::-1]) // 2
    reach = int(np.ceil(prediction.search_px / factor)) + 1
    corner = np.round(prediction.center_px).astype(int) - (reach + half) * factor - factor // 2
    width, height = 2 * (reach + half) + 1
    window = scan.window(int(corner[0]), int(corner[1]), int(width) * factor, int(height) * factor)
    small = cv2.resize(window, (int(width), int(height)), interpolation=cv2.INTER_AREA)
    if float(small.max() - small.min()) <= 0.0:
        return []
    small = small - small.mean()  # the correlation's sums are of single precision
    compared = _compared_part(prediction.pixel_from_disk / factor, half, shape)
    score = cv2.matchTemplate(small, template, cv2.TM_CCOEFF_NORMED, mask=compared)
    score = np.asarray(np.nan_to_num(score, posinf=0.0, neginf=0.0), np.float32)
    signed = np.asarray({"light": score, "dark": -score}.get(polarity, np.abs(score)), np.float32)
    peaks, _ = local_maxima(signed, signed.size, _LEAST_CORRELATION, 1)
    places = (peaks + half) * factor + (factor - 1) / 2 + corner
    within = np.hypot(*(places - prediction.center_px).T) <= prediction.search_px + factor
    return list(places[within][:_MOST_SPOTS])


def _predicted_picture(pixel_from_disk: Array, shape: MarkShape) -> NDArray[np.float32]:
    """The target as it should look, with some of its surroundings; its centre is that of the middle pixel."""
    _, greatest = extent_px(shape, np.column_stack([pixel_from_disk, (0.0, 0.0)]))
    half = np.ceil(greatest * (1 + _GROUND) + _GROUND_PX).astype(int)
    width, height = 2 * half + 1
    placed = np.column_stack([pixel_from_disk, half])
    return picture(shape, placed, int(width), int(height), _EXPECTED_BLUR_PX).astype(np.float32)


def _compared_part(pixel_from_disk: Array, half: NDArray[np.intp], shape: MarkShape) -> NDArray[np.float32]:
    """1 where the predicted picture, of half (2,) px about its middle, is to be found, 0 elsewhere: a disk with what is
    next to it, for a ring may begin where the picture's corners are."""
    width, height = 2 * half + 1
    if shape is not UNIT_DISK:
        return np.ones((height, width), np.float32)
    left, size, right = np.linalg.svd(pixel_from_disk)
    grown = left @ np.diag(size * (1 + _GROUND) + _GROUND_PX) @ right
    places = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) - half
    return np.asarray(np.linalg.norm(places @ np.linalg.inv(grown).T, axis=-1) <= 1, np.float32)


def _fit_spot(
    scan: Scan, spot: Array, prediction: Prediction, size_tolerance: float, shape: MarkShape, result: SearchResult
) -> tuple[int | None, Reason]:
    """The index of the disk at a spot, fitted now or before; None, and why, if there is none of the right size."""
    index = _known_disk(result.disks, spot)
    if index is not None:
        disk = result.disks[index]
    else:
        disk = fit_disk(scan, spot, prediction.pixel_from_disk, shape=_perspective_shape(shape, prediction))
        if disk.reason:
            return None, disk.reason
        if np.hypot(*(disk.center_px - prediction.center_px)) > prediction.search_px + 1:
            return None, Reason("what was found lies farther off", Code.OFF_PLACE)
        index = len(result.disks)
        result.disks.append(disk)
    ratio = float(np.sqrt(abs(np.linalg.det(disk.pixel_from_disk) / np.linalg.det(prediction.pixel_from_disk))))
    if not 1 / size_tolerance < ratio < size_tolerance:
        return None, Reason(f"what was found there has {ratio:.2f} times its radius", Code.SIZE)
    return index, NO_REASON


def _perspective_shape(shape: MarkShape, prediction: Prediction) -> MarkShape:
    """The shape as it is seen but for an affinity. A disk is an ellipse all the same."""
    if shape is UNIT_DISK:
        return shape
    x, y = (prediction.perspective @ prediction.pixel_from_disk).tolist()
    return replace(shape, perspective=(x, y))


def _known_disk(disks: list[FittedDisk], spot: Array) -> int | None:
    """The disk that was already fitted at a spot."""
    for index, disk in enumerate(disks):
        if np.hypot(*(disk.center_px - spot)) < _SAME_DISK * disk.half_axes_px[1]:
            return index
    return None


def _keep_common_polarity(result: SearchResult) -> None:
    """Leave out the disks, light or dark, of which there are fewer among the predictions that found one disk only."""
    lone = [near[0] for near in result.near if len(near) == 1] or [index for near in result.near for index in near]
    sign = np.sign(sum(np.sign(result.disks[index].contrast_dn) for index in lone)) or 1.0
    name = "light" if sign > 0 else "dark"
    for number, near in enumerate(result.near):
        kept = [index for index in near if result.disks[index].contrast_dn * sign > 0]
        if near and not kept:
            message = f"what was found there is not {name} as the other targets are"
            result.why_none[number] = Reason(message, Code.POLARITY)
        result.near[number] = kept


@dataclass(frozen=True, eq=False)
class Links:
    """places (n, 2): predicted; centers (m, 2): of the disks; near: for each place the indices of the disks that may be
    its target."""

    places: Array
    centers: Array
    near: list[list[int]]

    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices of place and disk of every link."""
        pairs = [(place, disk) for place, disks in enumerate(self.near) for disk in disks]
        place, disk = np.array(pairs, int).reshape(-1, 2).T
        return place, disk


@dataclass(frozen=True)
class Assignment:
    """For each place: chosen, the disk, or None; nearest: the disk that was refused, or None; why_not: the reason."""

    chosen: list[int | None]
    nearest: list[int | None]
    why_not: list[Reason]


def assign(links: Links, gate_sigmas: float, least_gate_px: float) -> Assignment:
    """One disk a place at most, and one place a disk; a place with two disks in its gate gets none."""
    count = len(links.places)
    chosen: list[int | None] = [None] * count
    nearest: list[int | None] = [None] * count
    why_not = [NO_REASON] * count
    place, disk = links.pairs()
    if not len(place):
        return Assignment(chosen, nearest, why_not)
    residuals, gate = _shared_shift_residuals(links, place, disk, gate_sigmas, least_gate_px)
    cost = np.full((count, len(links.centers)), _FORBIDDEN)
    cost[place, disk] = residuals
    gated = np.where(cost <= gate, cost, _FORBIDDEN)
    for one_place, one_disk in zip(*linear_sum_assignment(gated), strict=True):
        if gated[one_place, one_disk] < _FORBIDDEN:
            chosen[int(one_place)] = int(one_disk)
    taken = {index for index in chosen if index is not None}
    for row, own in enumerate(chosen.copy()):
        rivals = [index for index in np.flatnonzero(gated[row] < _FORBIDDEN) if index not in taken]
        if own is not None and rivals:
            chosen[row], nearest[row] = None, own
            why_not[row] = Reason(f"{len(rivals) + 1} disks lie within {gate:.1f} px of its place", Code.AMBIGUOUS)
        elif own is None and links.near[row]:
            best = links.near[row][int(np.argmin(cost[row, links.near[row]]))]
            off = float(cost[row, best])
            nearest[row] = best
            why_not[row] = (
                Reason("the disk at its place is another target", Code.AMBIGUOUS)
                if best in taken and off <= gate
                else Reason(f"what was found lies {off:.1f} px from where the other targets put it", Code.OFF_PLACE)
            )
    return Assignment(chosen, nearest, why_not)


def _shared_shift_residuals(
    links: Links, place: NDArray[np.int64], disk: NDArray[np.int64], gate_sigmas: float, least_gate_px: float
) -> tuple[Array, float]:
    """Lengths of all links less the shift that most of them share, and the gate: a few robust standard deviations of
    the links that share it."""
    shifts = links.centers[disk] - links.places[place]
    tolerance = max(least_gate_px, _VOTE_SHARE * float(np.hypot(*shifts.T).max()))
    common = _most_voted(shifts, place, tolerance)
    residuals = np.hypot(*(shifts - common).T)
    gate = tolerance
    for _ in range(_ROUNDS):
        agreeing = _best_of_each_place(place, residuals) & (residuals <= gate)
        if agreeing.sum() < 3:
            break
        model = _shift_model(links.places[place], shifts, agreeing)
        left = shifts - model
        residuals = np.hypot(*left.T)
        sigma = robust_scale(left[agreeing].ravel())
        gate = float(np.clip(gate_sigmas * sigma, least_gate_px, tolerance))
    return residuals, gate


def _most_voted(shifts: Array, place: NDArray[np.int64], tolerance: float) -> Array:
    """(2,) the shift that the links of most places agree with, each place counted once; of equals the shortest."""
    best, best_votes = shifts[0], (-1, 0.0)
    for shift in shifts:
        agree = np.hypot(*(shifts - shift).T) <= tolerance
        votes = (len(np.unique(place[agree])), -float(np.hypot(*shift)))
        if votes > best_votes:
            best, best_votes = shifts[agree].mean(axis=0), votes
    return np.asarray(best)


def _best_of_each_place(place: NDArray[np.int64], residuals: Array) -> NDArray[np.bool_]:
    """Which links are the shortest of their place."""
    order = np.lexsort((residuals, place))
    first = np.zeros(len(place), bool)
    first[order[np.unique(place[order], return_index=True)[1]]] = True
    return first


def _shift_model(places: Array, shifts: Array, agreeing: NDArray[np.bool_]) -> Array:
    """(n, 2) the shared shift at all places: their median, or an affine function where there are enough."""
    if agreeing.sum() < _AFFINE_FROM:
        return np.broadcast_to(np.median(shifts[agreeing], axis=0), shifts.shape)
    middle, spread = places[agreeing].mean(axis=0), np.maximum(places[agreeing].std(axis=0), 1.0)
    design = np.column_stack([np.ones(len(places)), (places - middle) / spread])
    coefficients = np.linalg.lstsq(design[agreeing], shifts[agreeing], rcond=None)[0]
    return np.asarray(design @ coefficients)


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
    """Find, fit and identify disks.

    Parameters
    ----------
    predictions : where each target should be. A disk is a prediction's target if it is the one disk of the right size
        near the place where the prediction and the shift that all targets share put it.
    options : None: the defaults of `TargetOptions`.

    Returns
    -------
    One mark for each prediction, whatever became of it.

    Raises
    ------
    ValueError
        Where a point is predicted twice.
    """
    return _measure_predicted(scan, predictions, options or TargetOptions(), UNIT_DISK)


def measure_crosses(
    scan: Scan, predictions: Sequence[TargetPrediction], line: float, options: TargetOptions | None = None
) -> tuple[MarkMeasurement, ...]:
    """Find, fit and identify upright crosses, as `measure_disks` does disks.

    Parameters
    ----------
    predictions : radius 1 of pixel_from_disk is half an arm-to-arm length.
    line : the arms' width in that unit.
    """
    return _measure_predicted(scan, predictions, options or TargetOptions(), MarkShape(cross(1.0, line)))


def _measure_predicted(
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
    observed = [(row, row.disk) for row in rows if row.disk is not None and row.status.is_observation]
    reasons = doubts([disk for _, disk in observed], [row.prediction.pixel_from_disk for row, _ in observed])
    doubt = {id(row): reason for (row, _), reason in zip(observed, reasons, strict=True) if reason}
    return [
        replace(row, status=Status.WEAK, reason=Reason.combine((row.reason, doubt[id(row)])))
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
