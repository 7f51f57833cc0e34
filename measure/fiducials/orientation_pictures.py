"""Likelihood of the scan orientations from the images of the marks: each orientation predicts a mark and its rotation
at each place."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from measure.array_types import Array, Mask
from measure.geometry import linear_scale, turn_by_quarters
from measure.marks.rendering import ROUGH_CELLS, chip_mask, detail_px, extent_px, picture
from measure.marks.shapes import Mark, MarkTemplate
from measure.noise.robust_estimation import TukeyFit, robust_scale, tukey_fit
from measure.results import MarkFit
from measure.scans.scan import Scan, means

_ALIKE = 0.05  # fraction of the contrast: images that differ nowhere by more count as equal
_FINEST_PX = 3.0  # smallest width of the finest line on the grid
_CUBIC_PX = 3.0  # border that cubic interpolation needs
_ABOUT_PX = 3.0  # width of the background around the drawings that is compared
_PIXELS_PER_DEGREE = 4.0  # pixels per degree of freedom: blur, grain and compression correlate neighbours
_OUTLIER = 4.0  # in standard deviations: larger residuals of a pixel are clipped
_ROUNDS, _LEAST_SCALE = 4, 1e-9  # reweightings of the robust fit; smallest standard deviation in it
_FLIP = np.diag([1.0, -1.0])  # from right and up to columns and rows
_ALIGNMENTS = 3  # Gauss-Newton steps; the chip is already placed to within a cell
_FEWEST = 40  # pixels needed to compare two chips
_CHANCE_SIGMAS = 3.0  # standard deviations by which noise may enlarge a difference
SPOILT = 0.01  # probability that writing, dust or an adjacent object imitates or hides a difference between marks


class PosedMark(NamedTuple):
    """Mark that a scan orientation predicts at a site. turn (2, 2): from its x and y to right and up. mark None: plain
    background."""

    mark: Mark | None
    turn: Array


@dataclass(frozen=True, eq=False)
class View:
    """Image of a mark on the drawings' grid, with its origin in the middle.

    Attributes
    ----------
    grey : (size, size) image.
    known : (size, size) mask of the pixels with known grey values: a learned chip also contains the background of other
        scans.
    covered : (size, size) mask of the chip's area; everything for a drawn mark.
    noise : standard deviation of the chip's pixels, fraction of the contrast; inf where unknown.
    """

    grey: Array
    known: Mask
    covered: Mask
    noise: float = 0.0

    def change(self, change: Callable[[Any], Any]) -> "View":
        """Apply the same change, for example a rotation, to the image and both masks."""
        return replace(self, grey=change(self.grey), known=change(self.known), covered=change(self.covered))

    @property
    def is_chip(self) -> bool:
        return not bool(self.covered.all())

    def fit(self, window: Array, used: Mask) -> TukeyFit:
        """Robust fit to a window in the pixels used. Factors: offset, gain, derivatives with respect to row and
        column."""
        slopes = [np.asarray(np.gradient(self.grey, axis=axis))[used] for axis in (0, 1)]
        columns = np.stack([np.ones(int(used.sum())), self.grey[used], *slopes])
        return tukey_fit(columns, window[used], _ROUNDS, _LEAST_SCALE)

    def align(self, window: Array) -> "View":
        """Shift by a fraction of a cell to match a window (size, size), on which it already lies to within a cell."""
        used, moved, shift = self.known & self.covered, self, np.zeros(2)
        for _ in range(_ALIGNMENTS):
            factors = moved.fit(window, used).factors
            if factors[1] == 0.0:
                return self
            shift = np.clip(shift - factors[2:] / factors[1], -1.0, 1.0)
            moved = replace(self, grey=np.asarray(ndimage.shift(self.grey, shift, order=3, mode="nearest")))
        return moved

    def unlike(self, other: "View", contrast: float) -> float:
        """Sum of squared differences of two chips beyond their noise, where both are known, after alignment. contrast:
        of the image in the scan, in standard deviations of its noise; differences are clipped as its outliers are."""
        used = self.known & other.known & self.covered & other.covered
        if used.sum() < _FEWEST:
            return 0.0
        moved = replace(self, known=used, covered=used).align(other.grey)
        residuals = moved.fit(other.grey, used).residuals
        noise = min(robust_scale(residuals), float(np.hypot(self.noise, other.noise)))
        alike = max(_OUTLIER * noise, _ALIKE)
        return float(((residuals**2 - alike**2) * contrast**2).clip(0.0, _OUTLIER**2).sum())


_EVERYWHERE = np.ones((1, 1), dtype=bool)
_BARE = View(np.zeros((1, 1)), _EVERYWHERE, _EVERYWHERE)


def _turn_and_pad(picture: Any, turn: Array, spare: int) -> Any:
    """Rotate by quarter turns, and pad by repeating the edge."""
    return np.pad(turn_by_quarters(picture, turn), spare, mode="edge")


class Drawings:
    """Images of a camera's marks on a grid that is upright in the frame.

    Scan orientations rotate the marks by quarter turns and mirror them, so each mark is drawn once. The grid is coarser
    than the scan, as far as the finest line of the marks allows: the differences between marks are coarser.
    """

    def __init__(self, marks: Collection[Mark], scan_from_up: Array, blur_px: float) -> None:
        """Draw the marks. scan_from_up (2, 2): from mm right and up in the frame to px of the scan; blur_px: blur of
        the scan."""
        finest_px = min(detail_px(mark, scan_from_up) for mark in marks)
        self.reduction = max(1, int(finest_px / _FINEST_PX))
        per_mm = linear_scale(scan_from_up) / self.reduction
        grid_from_up = per_mm * _FLIP
        self.scan_from_grid = scan_from_up @ np.linalg.inv(grid_from_up)
        self._views = {mark: _draw_view(mark, grid_from_up, blur_px / self.reduction) for mark in set(marks)}

    def views(self, shown: Sequence[PosedMark], spare: int) -> list[View]:
        """Image that each orientation predicts at a place, centred on grids of one size: spare cells larger on every
        side than the largest image."""
        drawn = [_BARE if each.mark is None else self._views[each.mark] for each in shown]
        half = max(len(each.grey) // 2 for each in drawn) + spare
        turns = [_FLIP @ each.turn @ _FLIP for each in shown]
        return [
            each.change(partial(_turn_and_pad, turn=turn, spare=half - len(each.grey) // 2))
            for each, turn in zip(drawn, turns, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class MarkSite:
    """Place where a mark was found, or predicted but not found.

    Attributes
    ----------
    like : fit of the mark, or of a typical one where none was found.
    weights : of the scan's channels.
    reach_px : largest shift of a chip in another orientation than the one it was found in. The origin of a drawn mark
        is its middle in every orientation; the origin of a chip is where the user clicked, and a chip that contains
        only an edge is found anywhere along it.
    """

    scan: Scan
    like: MarkFit
    center_px: Array
    weights: Sequence[float] | None
    drawings: Drawings
    reach_px: float

    def likelihoods(self, shown: Sequence[PosedMark]) -> Array:
        """Log-likelihood of the image under each orientation, up to a constant: 0 for the best, at least
        log(`SPOILT`), the probability that something else disturbs the image."""
        chips = any(isinstance(each.mark, MarkTemplate) for each in shown)
        spare = int(np.ceil(self.reach_px / self.drawings.reduction)) if chips else 0
        views, view_of = _distinct(self.drawings.views(shown, spare))
        if len(views) == 1:
            return np.zeros(len(shown))
        window = self._window(len(views[0].grey))
        views = [self._placed(window, view, spare) for view in views]
        area = _area([view.grey for view in views])
        residuals = [self._residuals(window, view.grey, area & view.known) for view in views]
        # Large residuals of even the best image are not noise, and reduce the significance of the differences.
        noise_dn = self.like.noise_dn / self.drawings.reduction
        scale = max(noise_dn, min(robust_scale(each) for each in residuals), 1e-9)
        misfits = np.full((len(views), *window.shape), _OUTLIER**2)  # unknown pixels of a chip count as outliers
        for misfit, view, residual in zip(misfits, views, residuals, strict=True):
            misfit[area & view.known] = np.minimum(np.abs(residual) / scale, _OUTLIER) ** 2
        excess = _excess(misfits, np.stack([area & view.covered for view in views]))
        best = views[int(excess.argmin())]
        if best.is_chip:
            excess = np.minimum(excess, [self._most_excess(best, view, scale) for view in views])
        relative = np.exp(-excess / 2 / _PIXELS_PER_DEGREE)
        return np.asarray(np.log((1 - SPOILT) * relative + SPOILT))[view_of]

    def _most_excess(self, best: View, view: View, scale_dn: float) -> float:
        """Largest excess misfit of a chip over the best one that their difference explains, noise included."""
        if view is best or not view.is_chip:
            return 0.0 if view is best else np.inf
        squares = view.unlike(best, abs(self.like.contrast_dn) / scale_dn)
        return squares + 2 * _CHANCE_SIGMAS * float(np.sqrt(squares))

    def _placed(self, window: Array, view: View, spare: int) -> View:
        """Shift a chip to the maximum of its correlation (NCC) with the window."""
        if not view.is_chip or not view.known.any():
            return view
        core = slice(spare, len(window) - spare)
        grey, known = (np.asarray(each[core, core], np.float32) for each in (view.grey, view.known))
        likeness = cv2.matchTemplate(np.asarray(window, np.float32), grey, cv2.TM_CCOEFF_NORMED, mask=known)
        likeness = np.where(np.isfinite(likeness), np.sign(self.like.contrast_dn) * likeness, -1.0)
        row, col = np.unravel_index(int(likeness.argmax()), likeness.shape)
        shift = int(row) - spare, int(col) - spare
        return view.change(partial(np.roll, shift=shift, axis=(0, 1))).align(window)

    def _window(self, size: int) -> Array:
        """(size, size) grey values of the scan on the drawings' grid, centred on the site."""
        reduction = self.drawings.reduction
        fine = size * reduction
        scan_from_fine = self.drawings.scan_from_grid / reduction
        reach = np.abs(scan_from_fine).sum(axis=1) * fine / 2 + _CUBIC_PX
        low, high = np.floor(self.center_px - reach).astype(int), np.ceil(self.center_px + reach).astype(int)
        width, height = (high - low + 1).tolist()
        window = self.scan.window(int(low[0]), int(low[1]), width, height, self.weights)
        first = self.center_px - low - scan_from_fine @ np.full(2, (fine - 1) / 2)
        scan_from_fine = np.column_stack([scan_from_fine, first])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        upright = cv2.warpAffine(window, scan_from_fine, (fine, fine), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(means(np.asarray(upright, np.float32)[..., None], reduction)[..., 0], np.float64)

    def _residuals(self, window: Array, shown: Array, area: Mask) -> Array:
        """Residuals of a fit of the image, slightly shifted, on a plane background, with the found polarity."""
        grey = window[area]
        row, col = np.nonzero(area)
        ground = [np.ones_like(grey), col / len(window), row / len(window)]
        if shown.any():
            by_row, by_col = (np.asarray(np.gradient(shown, axis=axis)) for axis in (0, 1))
            columns = [*ground, shown[area], by_row[area], by_col[area]]
            fit = tukey_fit(np.stack(columns), grey, _ROUNDS, _LEAST_SCALE)
            if fit.factors[len(ground)] * self.like.contrast_dn > 0:
                return fit.residuals
        return tukey_fit(np.stack(ground), grey, _ROUNDS, _LEAST_SCALE).residuals


def _draw_view(mark: Mark, grid_from_mark: Array, blur_px: float) -> View:
    """Draw a mark centred on its origin."""
    place = np.column_stack([grid_from_mark, np.zeros(2)])
    half = int(np.ceil(np.abs(extent_px(mark, place)).max() + 2 * _ABOUT_PX))
    place[:, 2] = half
    size = 2 * half + 1
    known = covered = np.ones((size, size), dtype=bool)
    if isinstance(mark, MarkTemplate):
        known = chip_mask(mark, place, size, size)
        covered = chip_mask(replace(mark, steady=None), place, size, size)
    return View(picture(mark, place, size, size, blur_px, ROUGH_CELLS), known, covered, _noise(mark))


def _noise(mark: Mark) -> float:
    """Standard deviation of a chip's pixels, fraction of its contrast; inf where unknown, 0 for a drawn mark."""
    if not isinstance(mark, MarkTemplate):
        return 0.0
    if mark.noise_dn == 0.0:
        return np.inf
    of_mean = float(np.sqrt(sum(share**2 for share in mark.shares.values())))
    return mark.noise_dn * of_mean / max(float(np.ptp(mark.image)), 1e-9)


def _distinct(views: Sequence[View]) -> tuple[list[View], list[int]]:
    """Views with different images, and the index of each view among these."""
    kinds: list[View] = []
    index = []
    for each in views:
        alike = [number for number, kind in enumerate(kinds) if np.abs(kind.grey - each.grey).max() < _ALIKE]
        index.append(alike[0] if alike else len(kinds))
        if not alike:
            kinds.append(each)
    return kinds, index


def _excess(misfits: Array, areas: Mask) -> Array:
    """(n,) excess of misfits (n, size, size) over the best one's, over the area common to both."""
    counts = areas.sum(axis=(1, 2)).clip(min=1)
    best = int(((misfits * areas).sum(axis=(1, 2)) / counts).argmin())
    excess = ((misfits - misfits[best]) * (areas & areas[best])).sum(axis=(1, 2))
    return np.asarray(excess - excess.min())


def _area(pictures: Sequence[Array]) -> Mask:
    """Mask of the pixels on and around all drawings; no mark explains the image farther off."""
    outside = (np.max(pictures, axis=0) - np.min(pictures, axis=0).clip(max=0.0) < _ALIKE).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= _ABOUT_PX)
