"""What a found mark's picture says of which of the camera's marks it is, in whichever direction a pose shows it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.matching import Match
from measure.noise import robust_scale
from measure.rendering import chip_mask, extent_px, picture
from measure.robust import tukey_weights
from measure.scan import Scan
from measure.shapes import Bar, Mark, MarkShape, MarkTemplate, Polygon

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ALIKE = 0.05  # of the contrast: pictures that differ nowhere by more are one
_SAME_PX = 0.1  # poses whose parts lie no farther apart show one drawing
_CELLS = 2  # along a pixel's side: pictures right to a hundredth
_FINEST_PX = 3.0  # of the finest line, once the scan is reduced
_ABOUT_PX = 3.0  # how far about the drawings the ground tells of its grey value
_PIXELS_PER_DEGREE = 4.0  # of freedom: blur, grain and compression make neighbours alike
_OUTLIER = 4.0  # in standard deviations: beyond it a pixel's misfit counts no more
_ROUNDS = 4  # of robust weights
SPOILT = 0.01  # probability that writing, dust or a neighbour beside a mark feigns or hides what tells marks apart


@dataclass(frozen=True, eq=False)
class Shown:
    """A mark as a pose shows it at a site: linear, the (2, 2) part of pixel_from_mark. None: bare ground."""

    mark: Mark | None
    linear: Array


class Site:
    """A place where a mark was found, or where it should be and was not: then like is the fit of another mark. The scan
    is looked at reduced, as far as the finest line of the marks allows: what tells them apart is coarser."""

    def __init__(
        self, scan: Scan, like: Match, center_px: Array, weights: Sequence[float] | None, finest_px: float
    ) -> None:
        """finest_px: how wide the finest line of all marks is in the scan."""
        self.scan, self.weights = scan, weights
        self.reduction = max(1, int(finest_px / _FINEST_PX))
        self.center_px = (center_px - (self.reduction - 1) / 2) / self.reduction
        self.sign = np.sign(like.contrast_dn)
        self.blur_px = like.blur_px / self.reduction
        self.noise_dn = like.noise_dn / self.reduction

    def likelihoods(self, shown: Sequence[Shown]) -> Array:
        """The log-likelihood of the picture under what each pose shows here, up to a constant: 0 for the best, and no
        less than the probability that something else spoils the picture."""
        looks, look_of = _looks([replace(each, linear=each.linear / self.reduction) for each in shown])
        if len(looks) == 1:
            return np.zeros(len(shown))
        reach = max(_reach_px(each) for each in looks) + 2 * _ABOUT_PX
        col0, row0 = np.floor(self.center_px - reach).astype(int)
        size = int(np.ceil(2 * reach)) + 1
        window = self.scan.reduced_window(self.reduction, int(col0), int(row0), size, size, self.weights).astype(float)
        center = self.center_px - (col0, row0)
        pictures, kind_of = _distinct([self._picture(each, center, size) for each in looks])
        picture_of = [kind_of[look] for look in look_of]
        told = [_told(looks[kind_of.index(kind)], center, size) for kind in range(len(pictures))]
        area = _area(pictures) & np.any(told, axis=0)
        residuals = [self._residuals(window, each, area & own) for each, own in zip(pictures, told, strict=True)]
        # Where even the best picture leaves much, what is left is no noise, and tells the pictures apart less surely.
        scale = max(self.noise_dn, min(robust_scale(each) for each in residuals), 1e-9)
        misfits = np.array([np.sum(np.minimum(np.abs(each) / scale, _OUTLIER) ** 2) for each in residuals])
        misfits += [_OUTLIER**2 * (area.sum() - len(each)) for each in residuals]  # what a chip does not tell it misses
        relative = np.exp(-(misfits - misfits.min()) / 2 / _PIXELS_PER_DEGREE)
        return np.asarray(np.log((1 - SPOILT) * relative + SPOILT))[picture_of]

    def _picture(self, shown: Shown, center: Array, size: int) -> Array:
        if shown.mark is None:
            return np.zeros((size, size))
        place = np.column_stack([shown.linear, center])
        return picture(shown.mark, place, size, size, self.blur_px, _CELLS)

    def _residuals(self, window: Array, shown: Array, area: Mask) -> Array:
        """What the picture on a plane ground leaves, the mark being light or dark as the one that was found; its place
        may be off by a little, for it was fitted with another drawing."""
        grey = window[area]
        row, col = np.nonzero(area)
        ground = [np.ones_like(grey), col / len(window), row / len(window)]
        if shown.any():
            by_row, by_col = (np.asarray(np.gradient(shown, axis=axis)) for axis in (0, 1))
            columns = [*ground, shown[area], by_row[area], by_col[area]]
            residuals, solution = _robust(columns, grey)
            if solution[len(ground)] * self.sign > 0:
                return residuals
        return _robust(ground, grey)[0]


def _looks(shown: Sequence[Shown]) -> tuple[list[Shown], list[int]]:
    """Those that are drawn apart, and which of them each is: a symmetric mark looks the same in several poses."""
    looks: list[Shown] = []
    drawn: list[tuple[object, Array]] = []
    index = []
    for each in shown:
        own = _drawn(each)
        alike = [number for number, other in enumerate(drawn) if _same(own, other)]
        index.append(alike[0] if alike else len(looks))
        if not alike:
            looks.append(each)
            drawn.append(own)
    return looks, index


def _drawn(shown: Shown) -> tuple[object, Array]:
    """What is drawn: kinds and sizes in a fixed order, and (n, 2) px of the points by which these parts lie."""
    if not isinstance(shown.mark, MarkShape):
        return shown.mark, shown.linear
    parts = []
    for part in shown.mark.parts:
        if isinstance(part, Bar):
            middle = np.add(part.from_mm, part.to_mm) / 2
            parts += [(f"bar {part.line_mm}", point) for point in (part.from_mm, middle, part.to_mm)]
        elif isinstance(part, Polygon):
            parts += [("corner", point) for point in part.vertices_mm]
        else:
            parts.append((str(replace(part, center_mm=(0.0, 0.0))), part.center_mm))
    points = np.array([point for _, point in parts]) @ shown.linear.T
    order = sorted(range(len(parts)), key=lambda index: (parts[index][0], *np.round(points[index]).tolist()))
    return [parts[index][0] for index in order], points[order]


def _same(first: tuple[object, Array], second: tuple[object, Array]) -> bool:
    return first[0] == second[0] and float(np.abs(first[1] - second[1]).max()) < _SAME_PX


def _distinct(pictures: Sequence[Array]) -> tuple[list[Array], list[int]]:
    """The pictures that differ, and which of them each is."""
    kinds: list[Array] = []
    index = []
    for each in pictures:
        alike = [number for number, kind in enumerate(kinds) if np.abs(kind - each).max() < _ALIKE]
        index.append(alike[0] if alike else len(kinds))
        if not alike:
            kinds.append(each)
    return kinds, index


def _told(shown: Shown, center: Array, size: int) -> Mask:
    """Where a mark tells the grey values. A chip is only continued beyond its edge, and a learned one has the landscape
    of other scans beside its mark."""
    if not isinstance(shown.mark, MarkTemplate):
        return np.ones((size, size), dtype=bool)
    return chip_mask(shown.mark, np.column_stack([shown.linear, center]), size, size)


def _area(pictures: Sequence[Array]) -> Mask:
    """The pixels about all drawings: farther off lies what no mark explains."""
    outside = (np.max(pictures, axis=0) - np.min(pictures, axis=0).clip(max=0.0) < _ALIKE).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= _ABOUT_PX)


def _robust(columns: Sequence[Array], grey: Array) -> tuple[Array, Array]:
    """Residuals and coefficients of a fit that holds against writing and dust in the window."""
    design, weights = np.stack(columns), np.ones_like(grey)
    residuals, solution = grey, np.zeros(len(columns))
    for _ in range(_ROUNDS):
        weighted = design * weights
        solution = np.asarray(np.linalg.lstsq(weighted @ design.T, weighted @ grey, rcond=None)[0], dtype=float)
        residuals = grey - solution @ design
        weights = tukey_weights(residuals, max(robust_scale(residuals), 1e-9))
    return residuals, solution


def _reach_px(shown: Shown) -> float:
    """How far the mark reaches from its centre, along columns or rows."""
    if shown.mark is None:
        return 0.0
    return float(np.abs(extent_px(shown.mark, np.column_stack([shown.linear, np.zeros(2)]))).max())
