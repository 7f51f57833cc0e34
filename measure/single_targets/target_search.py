"""Disks near the places where targets are predicted: by correlation with their predicted picture, then fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.marks.rendering import extent_px, picture
from measure.marks.shapes import MarkShape, thinnest_mm
from measure.reason import NO_REASON, Code, Reason
from measure.scans.scan import Scan
from measure.single_targets.disks import UNIT_DISK, FittedDisk, fit_disk

Array = NDArray[np.float64]

_SEARCHED_RADIUS_PX = 4.0  # windows are reduced until the shorter half axis has about this length...
_THINNEST_PX = 1.5  # ...or the thinnest line this width
_LEAST_CORRELATION = 0.55  # below it a spot is worth no fit, which decides what is a target
_MOST_SPOTS = 6  # fitted near one prediction
_EXPECTED_BLUR_PX = 1.0  # of the reduced window
_GROUND, _GROUND_PX = 0.3, 1.5  # about the target in its predicted picture: a share of its reach, and for the blur
_SAME_DISK = 0.5  # of the shorter half axis: spots nearer to a disk's centre are that disk


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
            index, reason = _fitted_at(scan, spot, prediction, size_tolerance, shape, result)
            if index is None:
                why = why or reason
            elif index not in near:
                near.append(index)
        result.near.append(near)
        none = Reason(f"nothing like it within {prediction.search_px:.0f} px of its place", Code.NOT_FOUND)
        result.why_none.append(NO_REASON if near else Reason.joined((none, why)))
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
    score = np.nan_to_num(score, posinf=0.0, neginf=0.0)
    signed = {"light": score, "dark": -score}.get(polarity, np.abs(score))
    peaks = np.argwhere((signed >= cv2.dilate(signed, np.ones((3, 3), np.uint8))) & (signed > _LEAST_CORRELATION))
    peaks = peaks[np.argsort(-signed[peaks[:, 0], peaks[:, 1]], kind="stable")]
    places = (peaks[:, ::-1] + half) * factor + (factor - 1) / 2 + corner
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


def _fitted_at(
    scan: Scan, spot: Array, prediction: Prediction, size_tolerance: float, shape: MarkShape, result: SearchResult
) -> tuple[int | None, Reason]:
    """The index of the disk at a spot, fitted now or before; None, and why, if there is none of the right size."""
    index = _known_disk(result.disks, spot)
    if index is not None:
        disk = result.disks[index]
    else:
        disk = fit_disk(scan, spot, prediction.pixel_from_disk, shape=_in_perspective(shape, prediction))
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


def _in_perspective(shape: MarkShape, prediction: Prediction) -> MarkShape:
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
            told = f"what was found there is not {name} as the other targets are"
            result.why_none[number] = Reason(told, Code.POLARITY)
        result.near[number] = kept
