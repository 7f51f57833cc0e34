"""Disks and crosses of a test field measured where they are predicted: searched by correlation, identified, fitted and
checked."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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
Integers = NDArray[np.int64]

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
    marks = {prediction.point: _unsearchable_mark(prediction, scan) for prediction in predictions}
    # A disk near several places is fitted from the first: in what order they are given must not matter.
    sought = sorted((one for one in predictions if marks[one.point] is None), key=lambda prediction: prediction.point)
    found = {mark.point: mark for mark in _identified_marks(scan, sought, options, shape)}
    return tuple(marks[name] or found[name] for name in names)


def _unsearchable_mark(prediction: TargetPrediction, scan: Scan) -> MarkMeasurement | None:
    """The row of a target that is not even looked for."""
    point, (col, row), shorter = prediction.point, prediction.center_px, prediction.half_axes_px[1]
    if not (-0.5 <= col < scan.width_px - 0.5 and -0.5 <= row < scan.height_px - 0.5):
        return MarkMeasurement(point, "target", None, None, Status.ABSENT, Reason("outside of the scan", Code.OUTSIDE))
    if shorter < SMALLEST_RADIUS_PX:
        reason = Reason(f"too small to be measured: half axis {shorter:.1f} px", Code.SMALL)
        return _predicted_mark(prediction, reason)
    return None


def _predicted_mark(prediction: TargetPrediction, reason: Reason) -> MarkMeasurement:
    center_px = np.asarray(prediction.center_px, float)
    return MarkMeasurement(prediction.point, "target", center_px, None, Status.PREDICTED, reason)


def _identified_marks(
    scan: Scan, predictions: Sequence[TargetPrediction], options: TargetOptions, shape: MarkShape
) -> list[MarkMeasurement]:
    """The disk of each prediction: fitted near it, of the right kind, and alone at its place. Those that are unlike the
    others of the frame are weak."""
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
    unlike = iter(doubts([disk for disk, _ in targets], [shape for _, shape in targets]))
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
            MarkMeasurement(prediction.point, "target", disk.center_px, disk.covariance, status, reason, disk.quality)
        )
    return marks


class _DiskSearch:
    """The disks fitted in a scan so far, each once: what looks like the target near the predictions."""

    def __init__(self, scan: Scan, options: TargetOptions, shape: MarkShape) -> None:
        self.scan, self.options, self.shape = scan, options, shape
        self.disks: list[FittedDisk] = []

    def find_near(self, prediction: TargetPrediction) -> tuple[list[int], Reason]:
        """The indices of the disks that may be a prediction's target; and why there are none."""
        found, why = list[int](), NO_REASON
        for spot in _spots(self.scan, prediction, self.options.polarity, self.shape):
            index = self._fit_spot(spot, prediction)
            if isinstance(index, Reason):
                why = why or index
            elif index not in found:
                found.append(index)
        none = Reason(f"nothing like it within {prediction.search_px:.0f} px of its place", Code.NOT_FOUND)
        return found, NO_REASON if found else Reason.combine((none, why))

    def _fit_spot(self, spot: Array, prediction: TargetPrediction) -> int | Reason:
        """The index of the disk at a spot, fitted now or before; or why there is none of the right size."""
        near = (np.hypot(*(disk.center_px - spot)) < _SAME_DISK * disk.half_axes_px[1] for disk in self.disks)
        index = next((index for index, is_near in enumerate(near) if is_near), len(self.disks))
        if index == len(self.disks):
            shape = self.shape
            if shape is not UNIT_DISK:  # a disk is an ellipse in perspective, too
                x, y = (prediction.perspective @ prediction.pixel_from_disk).tolist()
                shape = replace(shape, perspective=(x, y))
            disk = fit_disk(self.scan, spot, prediction.pixel_from_disk, shape=shape)
            if disk.reason:
                return disk.reason
            if np.hypot(*(disk.center_px - prediction.center_px)) > prediction.search_px + 1:
                return Reason("what was found lies farther off", Code.OFF_PLACE)
            self.disks.append(disk)
        areas = np.linalg.det([self.disks[index].pixel_from_disk, prediction.pixel_from_disk])
        ratio = float(np.sqrt(abs(areas[0] / areas[1])))
        if not 1 / self.options.size_tolerance < ratio < self.options.size_tolerance:
            return Reason(f"what was found there has {ratio:.2f} times its radius", Code.SIZE)
        return index

    def keep_common_polarity(self, near: Sequence[tuple[list[int], Reason]]) -> list[tuple[list[int], Reason]]:
        """Leave out the disks, light or dark, of which there are fewer among the predictions that found one only."""
        lone = [found[0] for found, _ in near if len(found) == 1] or [index for found, _ in near for index in found]
        signs = [np.sign(disk.contrast_dn) for disk in self.disks]
        common = np.sign(sum(signs[index] for index in lone)) or 1.0
        name = "light" if common > 0 else "dark"
        other = Reason(f"what was found there is not {name} as the other targets are", Code.POLARITY)
        kept = [[index for index in found if signs[index] == common] for found, _ in near]
        return [(own, other if found and not own else why) for own, (found, why) in zip(kept, near, strict=True)]


def _spots(scan: Scan, prediction: TargetPrediction, polarity: str, shape: MarkShape) -> list[Array]:
    """(2,) places within the search distance where the predicted picture correlates best, the best first."""
    shorter = prediction.half_axes_px[1]
    factor = max(1, int(shorter * min(1.0 / _SEARCHED_RADIUS_PX, thinnest_mm(shape) / _THINNEST_PX)))
    template, compared = _predicted_picture(prediction.pixel_from_disk / factor, shape)
    half = np.array(template.shape[::-1]) // 2
    reach = int(np.ceil(prediction.search_px / factor)) + 1
    corner = np.round(prediction.center_px).astype(int) - (reach + half) * factor - factor // 2
    size = 2 * (reach + half) + 1
    window = scan.window(*corner.tolist(), *(size * factor).tolist())
    small = cv2.resize(window, size.tolist(), interpolation=cv2.INTER_AREA)
    if float(small.max() - small.min()) <= 0.0:
        return []
    small = small - small.mean()  # the correlation's sums are of single precision
    score = cv2.matchTemplate(small, template, cv2.TM_CCOEFF_NORMED, mask=compared)
    score = np.asarray(np.nan_to_num(score, posinf=0.0, neginf=0.0), np.float32)
    signed = np.asarray({"light": score, "dark": -score}.get(polarity, np.abs(score)), np.float32)
    peaks, _ = local_maxima(signed, signed.size, _LEAST_CORRELATION, 1)
    places = (peaks + half) * factor + (factor - 1) / 2 + corner
    within = np.hypot(*(places - prediction.center_px).T) <= prediction.search_px + factor
    return list(places[within][:_MOST_SPOTS])


def _predicted_picture(pixel_from_disk: Array, shape: MarkShape) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The target as it should look, its centre that of the middle pixel, with some of its surroundings; and 1 where
    these count. Of a disk it is what is next to it, for a ring may begin where the picture's corners are."""
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
    """The disk, of centers (m, 2), at each of places (n, 2): one of those near it; with a reason where that is refused.

    One disk a place at most, and one place a disk; a place with two disks in its gate gets none.
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
    """(n,) px of links' shifts (n, 2) from places (n, 2) less the shift that most of them share; and the gate, a few
    robust standard deviations of those that share it. place (n,): the number of each."""
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
    """(2,) the shift that the links of most places agree with, each place counted once; of equals the shortest."""
    best, best_votes = shifts[0], (-1, 0.0)
    for shift in shifts:
        agree = np.hypot(*(shifts - shift).T) <= tolerance
        votes = (len(np.unique(place[agree])), -float(np.hypot(*shift)))
        if votes > best_votes:
            best, best_votes = shifts[agree].mean(axis=0), votes
    return np.asarray(best)


def _shift_model(places: Array, shifts: Array, agreeing: NDArray[np.bool_]) -> Array:
    """(n, 2) the shared shift at all places: their median, or an affine function where there are enough."""
    if agreeing.sum() < _AFFINE_FROM:
        return np.broadcast_to(np.median(shifts[agreeing], axis=0), shifts.shape)
    middle, spread = places[agreeing].mean(axis=0), np.maximum(places[agreeing].std(axis=0), 1.0)
    design = np.column_stack([np.ones(len(places)), (places - middle) / spread])
    coefficients = np.linalg.lstsq(design[agreeing], shifts[agreeing], rcond=None)[0]
    return np.asarray(design @ coefficients)
