"""Measurement of predicted targets, disks or crosses: search by NCC, fit, identification, tests."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from measure.array_types import Array, Integers
from measure.detection.correlation import local_maxima
from measure.flags import NO_REASON, Code, Reason, Status
from measure.geometry import scan_px
from measure.marks.rendering import extent_px, picture
from measure.marks.shapes import MarkShape, Polarity, cross
from measure.noise.robust_estimation import robust_scale
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.disks import SMALLEST_RADIUS_PX, UNIT_DISK, FittedDisk, dust_reasons, fit_disk

_SEARCHED_RADIUS_PX = 4.0  # shorter half axis in the reduced window, provided that...
_THINNEST_PX = 1.5  # ...the thinnest line keeps this width
_LEAST_CORRELATION = 0.55  # NCC below which a peak is not fitted; the fit decides what is a target
_MOST_SPOTS = 6  # peaks fitted near one prediction
_EXPECTED_BLUR_PX = 1.0  # in the reduced window
_GROUND, _GROUND_PX = 0.3, 1.5  # background in the template: in radii, plus px for the blur
_SAME_DISK = 0.5  # in shorter half axes: a peak this near to a fitted disk is that disk
_AFFINE_FROM = 8  # consistent targets needed for an affine shift model
_VOTE_SHARE = 0.2  # of the longest link: shifts within it count as equal
_ROUNDS = 5  # of alternating between the common shift and the gate
_FORBIDDEN = 1e9  # px: cost of a pair that is not a link


@dataclass(frozen=True, eq=False)
class TargetPrediction:
    """Predicted place and form of a target.

    center_px (2,): column and row; pixel_from_disk (2, 2): unit circle of the target to px, its columns the images of
    two orthogonal radius vectors; search_px: search radius; perspective (2,), per px: a point at d px from the centre
    in the affine image lies at d / (1 + perspective d).
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
        """(2,) longer and shorter half axis of the ellipse."""
        return np.asarray(np.linalg.svd(self.pixel_from_disk, compute_uv=False))


@dataclass(frozen=True)
class TargetOptions:
    """Options of the measurement.

    polarity: lighter or darker than the background; "auto": as most of them are. size_tolerance: largest ratio of
    fitted and predicted radius, either way. gate_sigmas: largest distance from the predicted place after the common
    shift, in robust standard deviations of all targets; least_gate_px: its lower bound.
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


def measure_disks(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions | None = None
) -> tuple[MarkMeasurement, ...]:
    """Search, fit and identify predicted disks.

    A disk is identified if it is the only one of the right size near the predicted place, after the shift that all
    targets have in common.

    Parameters
    ----------
    predictions : predicted places and forms.
    options : None: the defaults of `TargetOptions`.

    Returns
    -------
    One mark per prediction, with its status.

    Raises
    ------
    ValueError
        If a point is predicted twice.
    """
    return _measure_predicted(scan, predictions, options or TargetOptions(), UNIT_DISK)


def measure_crosses(
    scan: Scan, predictions: Sequence[TargetPrediction], line: float, options: TargetOptions | None = None
) -> tuple[MarkMeasurement, ...]:
    """Search, fit and identify predicted upright crosses; see `measure_disks`.

    Parameters
    ----------
    predictions : radius 1 of pixel_from_disk is half the length of a bar.
    line : bar width in that unit.
    """
    return _measure_predicted(scan, predictions, options or TargetOptions(), MarkShape(cross(1.0, line)))


def _measure_predicted(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions, shape: MarkShape
) -> tuple[MarkMeasurement, ...]:
    names = [prediction.point for prediction in predictions]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"{scan.name}: predicted twice: {', '.join(twice)}; each point is right once")
    marks, sought = dict[str, MarkMeasurement](), list[TargetPrediction]()
    # A disk near several predictions is fitted from the first: sort, so that the given order does not matter.
    for prediction in sorted(predictions, key=lambda prediction: prediction.point):
        point, (col, row), shorter = prediction.point, prediction.center_px, prediction.half_axes_px[1]
        if not (-0.5 <= col < scan.width_px - 0.5 and -0.5 <= row < scan.height_px - 0.5):
            reason = Reason("outside of the scan", Code.OUTSIDE)
            marks[point] = MarkMeasurement(point, "target", None, None, Status.ABSENT, reason)
        elif shorter < SMALLEST_RADIUS_PX:
            reason = Reason(f"too small to be measured: half axis {shorter:.1f} px", Code.SMALL)
            marks[point] = _predicted_mark(prediction, reason)
        else:
            sought.append(prediction)
    marks |= {mark.point: mark for mark in _identified_marks(scan, sought, options, shape)}
    return tuple(marks[name] for name in names)


def _predicted_mark(prediction: TargetPrediction, reason: Reason) -> MarkMeasurement:
    center_px = np.asarray(prediction.center_px, float)
    return MarkMeasurement(prediction.point, "target", center_px, None, Status.PREDICTED, reason)


def _identified_marks(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions, shape: MarkShape
) -> list[MarkMeasurement]:
    """Search, assign and test: the disk of each prediction. Disks that differ from the others of the frame are weak."""
    search = _DiskSearch(scan, options, shape)
    near = [search.find_near(prediction) for prediction in predictions]
    if options.polarity == "auto":
        near = search.keep_common_polarity(near)
    places = np.array([prediction.center_px for prediction in predictions]).reshape(-1, 2)
    centers = np.array([disk.center_px for disk in search.disks]).reshape(-1, 2)
    assigned = _assign(places, centers, [indices for indices, _ in near], options)
    targets = [
        (search.disks[index], prediction.pixel_from_disk)
        for (index, reason), prediction in zip(assigned, predictions, strict=True)
        if index is not None and not reason
    ]
    unlike = iter(dust_reasons([disk for disk, _ in targets], [shape for _, shape in targets]))
    marks = []
    for prediction, (index, refusal), (_, missing) in zip(predictions, assigned, near, strict=True):
        if index is None:
            marks.append(_predicted_mark(prediction, missing or refusal))
            continue
        disk, status, reason = search.disks[index], Status.REJECTED, refusal
        if not refusal:
            reason = Reason.combine([one for one in (disk.weakness, next(unlike)) if one])
            status = Status.WEAK if reason else Status.MEASURED
        marks.append(
            MarkMeasurement(
                prediction.point, "target", disk.center_px, disk.place_covariance, status, reason, disk.quality
            )
        )
    return marks


class _DiskSearch:
    """Disks fitted in a scan so far, each once."""

    def __init__(self, scan: Scan, options: TargetOptions, shape: MarkShape) -> None:
        self.scan, self.options, self.shape = scan, options, shape
        self.disks: list[FittedDisk] = []

    def find_near(self, prediction: TargetPrediction) -> tuple[list[int], Reason]:
        """Indices of the disks that may be a prediction's target, or the reason why there is none."""
        found, why = list[int](), NO_REASON
        for spot in _correlation_peaks(self.scan, prediction, self.options.polarity, self.shape):
            index = self._fit_spot(spot, prediction)
            if isinstance(index, Reason):
                why = why or index
            elif index not in found:
                found.append(index)
        none = f"no target of the predicted size within {prediction.search_px:.0f} px of the predicted position"
        best = why.reword(f"the best candidate: {why}") if why else why
        return found, NO_REASON if found else Reason.combine((Reason(none, Code.NOT_FOUND), best))

    def _fit_spot(self, spot: Array, prediction: TargetPrediction) -> int | Reason:
        """Index of the disk at a correlation peak, fitted now or before; the reason if none has the right size."""
        near = (np.hypot(*(disk.center_px - spot)) < _SAME_DISK * disk.half_axes_px[1] for disk in self.disks)
        index = next((index for index, is_near in enumerate(near) if is_near), len(self.disks))
        if index == len(self.disks):
            shape = self.shape
            if shape is not UNIT_DISK:  # a disk is an ellipse also in perspective
                x, y = (prediction.perspective @ prediction.pixel_from_disk).tolist()
                shape = replace(shape, perspective=(x, y))
            disk = fit_disk(self.scan, spot, prediction.pixel_from_disk, shape=shape)
            if disk.reason:
                return disk.reason
            if np.hypot(*(disk.center_px - prediction.center_px)) > prediction.search_px + 1:
                return Reason("its fit is farther off", Code.OFF_PLACE)
            self.disks.append(disk)
        areas = np.linalg.det([self.disks[index].pixel_from_disk, prediction.pixel_from_disk])
        ratio = float(np.sqrt(abs(areas[0] / areas[1])))
        if not 1 / self.options.size_tolerance < ratio < self.options.size_tolerance:
            return Reason(f"{ratio:.2f} times the predicted radius", Code.SIZE)
        return index

    def keep_common_polarity(self, near: Sequence[tuple[list[int], Reason]]) -> list[tuple[list[int], Reason]]:
        """Drop the disks of the rarer polarity; only predictions with a single disk vote."""
        lone = [found[0] for found, _ in near if len(found) == 1] or [index for found, _ in near for index in found]
        signs = [np.sign(disk.contrast_dn) for disk in self.disks]
        common = np.sign(sum(signs[index] for index in lone)) or 1.0
        name = "light" if common > 0 else "dark"
        other = Reason(f"what was found there is not {name} as the other targets are", Code.POLARITY)
        kept = [[index for index in found if signs[index] == common] for found, _ in near]
        return [(own, other if found and not own else why) for own, (found, why) in zip(kept, near, strict=True)]


def _correlation_peaks(scan: Scan, prediction: TargetPrediction, polarity: str, shape: MarkShape) -> list[Array]:
    """(2,) places of the NCC peaks within the search radius, the highest first."""
    shorter = prediction.half_axes_px[1]
    factor = max(1, int(shorter * min(1.0 / _SEARCHED_RADIUS_PX, shape.thinnest_mm / _THINNEST_PX)))
    template, compared = _template(prediction.pixel_from_disk / factor, shape)
    half = np.array(template.shape[::-1]) // 2
    reach = int(np.ceil(prediction.search_px / factor)) + 1
    corner = np.round(prediction.center_px).astype(int) - (reach + half) * factor - factor // 2
    size = 2 * (reach + half) + 1
    window = scan.window(*corner.tolist(), *(size * factor).tolist())
    small = cv2.resize(window, size.tolist(), interpolation=cv2.INTER_AREA)
    if float(small.max() - small.min()) <= 0.0:
        return []
    small = small - small.mean()  # matchTemplate sums in single precision
    score = cv2.matchTemplate(small, template, cv2.TM_CCOEFF_NORMED, mask=compared)
    score = np.asarray(np.nan_to_num(score, posinf=0.0, neginf=0.0), np.float32)
    signed = np.asarray({"light": score, "dark": -score}.get(polarity, np.abs(score)), np.float32)
    peaks, _ = local_maxima(signed, signed.size, _LEAST_CORRELATION, 1)
    places = scan_px(peaks + half, factor) + corner
    within = np.hypot(*(places - prediction.center_px).T) <= prediction.search_px + factor
    return list(places[within][:_MOST_SPOTS])


def _template(pixel_from_disk: Array, shape: MarkShape) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Template of the target, centred on the middle pixel, with some background; and its mask. The mask of a disk
    leaves out the corners, where a ring may begin."""
    _, greatest = extent_px(shape, np.column_stack([pixel_from_disk, (0.0, 0.0)]))
    half = np.ceil(greatest * (1 + _GROUND) + _GROUND_PX).astype(int)
    width, height = (2 * half + 1).tolist()
    drawn = picture(shape, np.column_stack([pixel_from_disk, half]), width, height, _EXPECTED_BLUR_PX)
    compared = np.ones((height, width), np.float32)
    if shape is UNIT_DISK:
        left, size, right = np.linalg.svd(pixel_from_disk)
        grown = left @ np.diag(size * (1 + _GROUND) + _GROUND_PX) @ right
        places = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) - half
        compared = np.asarray(np.linalg.norm(places @ np.linalg.inv(grown).T, axis=-1) <= 1, np.float32)
    return drawn.astype(np.float32), compared


def _assign(
    places: Array, centers: Array, near: list[list[int]], options: TargetOptions
) -> list[tuple[int | None, Reason]]:
    """Assign disks with centers (m, 2) to predicted places (n, 2), one to one, by least total distance.

    Returns the disk's index for each place, with a reason where it is refused: outside the gate, the target of another
    place, or not alone in the gate.
    """
    links = np.array([(place, disk) for place, disks in enumerate(near) for disk in disks], int).reshape(-1, 2)
    if not len(links):
        return [(None, NO_REASON)] * len(places)
    place, disk = links.T
    off_px, gate_px = _residuals_and_gate(places[place], centers[disk] - places[place], place, options)
    cost = np.full((len(places), len(centers)), _FORBIDDEN)
    cost[place, disk] = off_px
    is_in_gate = cost <= gate_px
    best = zip(*linear_sum_assignment(np.where(is_in_gate, cost, _FORBIDDEN)), strict=True)
    chosen = {int(row): int(column) for row, column in best if is_in_gate[row, column]}
    taken = set(chosen.values())
    assigned = list[tuple[int | None, Reason]]()
    for row, own_near in enumerate(near):
        own, reason = chosen.get(row), NO_REASON
        rivals = [index for index in np.flatnonzero(is_in_gate[row]) if index not in taken]
        if own is not None and rivals:
            reason = Reason(f"{len(rivals) + 1} disks lie within {gate_px:.1f} px of its place", Code.AMBIGUOUS)
        elif own is None and own_near:
            own = min(own_near, key=lambda index: cost[row, index])
            reason = (
                Reason("the disk at its place is another target", Code.AMBIGUOUS)
                if own in taken and is_in_gate[row, own]
                else Reason(
                    f"what was found lies {cost[row, own]:.1f} px from where the other targets put it", Code.OFF_PLACE
                )
            )
        assigned.append((own, reason))
    return assigned


def _residuals_and_gate(places: Array, shifts: Array, place: Integers, options: TargetOptions) -> tuple[Array, float]:
    """(n,) residuals of the links' shifts (n, 2) from the common shift, px, and the gate: some robust standard
    deviations of the consistent links. places (n, 2), place (n,): predicted place of each link and its number."""
    tolerance = max(options.least_gate_px, _VOTE_SHARE * float(np.hypot(*shifts.T).max()))
    residuals, gate = np.hypot(*(shifts - _most_voted(shifts, place, tolerance)).T), tolerance
    for _ in range(_ROUNDS):
        order = np.lexsort((residuals, place))
        agreeing = np.zeros(len(place), bool)
        agreeing[order[np.unique(place[order], return_index=True)[1]]] = True  # the shortest link of each place
        agreeing &= residuals <= gate
        if agreeing.sum() < 3:
            break
        left = shifts - _shift_model(places, shifts, agreeing)
        residuals = np.hypot(*left.T)
        gate = float(
            np.clip(options.gate_sigmas * robust_scale(left[agreeing].ravel()), options.least_gate_px, tolerance)
        )
    return residuals, gate


def _most_voted(shifts: Array, place: Integers, tolerance: float) -> Array:
    """(2,) shift with which the links of most places agree, each place counted once; the shortest one of equals."""
    best, best_votes = shifts[0], (-1, 0.0)
    for shift in shifts:
        agree = np.hypot(*(shifts - shift).T) <= tolerance
        votes = (len(np.unique(place[agree])), -float(np.hypot(*shift)))
        if votes > best_votes:
            best, best_votes = shifts[agree].mean(axis=0), votes
    return np.asarray(best)


def _shift_model(places: Array, shifts: Array, agreeing: NDArray[np.bool_]) -> Array:
    """(n, 2) common shift at all places: the median of the consistent ones, or an affine fit if there are enough."""
    if agreeing.sum() < _AFFINE_FROM:
        return np.broadcast_to(np.median(shifts[agreeing], axis=0), shifts.shape)
    middle, spread = places[agreeing].mean(axis=0), np.maximum(places[agreeing].std(axis=0), 1.0)
    design = np.column_stack([np.ones(len(places)), (places - middle) / spread])
    coefficients = np.linalg.lstsq(design[agreeing], shifts[agreeing], rcond=None)[0]
    return np.asarray(design @ coefficients)
