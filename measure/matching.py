"""Least-squares matching: a mark measured to the noise of the film, by fitting its own picture to the scan.

The model of a window is `gain * picture(mark) + offset + slopes`; unknown are the mark's place, if wished its rotation,
scale and shear, the blur, and four grey-value parameters, all in one Gauss-Newton adjustment. Dust and scratches
are first weighted down (Tukey's biweight), then cut out where smoothed residuals stand out; the rest decides.
The covariance comes from the residuals' own autocovariance where grain correlates them.
"""

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.grain import grain_model
from measure.noise import correlated, is_textured, noise_model, robust_scale
from measure.rendering import chip_mask, extent_px, render
from measure.robust import damage, solution, tukey_loss, tukey_weights
from measure.shapes import Disk, Mark, MarkTemplate, Ring, thinnest_mm

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Freedom = Literal["shift", "similarity", "affine", "ellipse"]

# Changes of the mark's linear part: (I + e G) times it, G a generator.
_TURN, _SCALE = ((0.0, -1.0), (1.0, 0.0)), ((1.0, 0.0), (0.0, 1.0))
_STRETCH, _SHEAR = ((1.0, 0.0), (0.0, -1.0)), ((0.0, 1.0), (1.0, 0.0))
_GENERATORS: dict[Freedom, tuple[tuple[tuple[float, float], tuple[float, float]], ...]] = {
    "shift": (),
    "similarity": (_SCALE, _TURN),
    "affine": (_SCALE, _STRETCH, _SHEAR, _TURN),
    "ellipse": (_SCALE, _STRETCH, _SHEAR),
}
_GREY = 4  # gain, offset and two slopes
_DAMAGE_FLOOR = 0.005  # of the contrast, under the scale of smoothed residuals, for the same reason
_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale: without it clean data drive it to nothing
_SPARE_PX = 2.0  # beyond the margin: room for the mark to move
_BLUR_RANGE_PX = (0.3, 6.0)
_HALVINGS = 4


@dataclass(frozen=True)
class MatchOptions:
    """How a mark is matched.

    freedom: what is estimated beside the shift; "ellipse" is an affinity without rotation, for disks.
    blur_px: standard deviation of the scan's blur; the start of its estimation, if it is estimated.
    linear_sigma: prior standard deviation of rotation (rad), scale and shear, as known from the other marks; the
    default holds only what the picture does not show at all.
    margin_px: how far about the mark grey values are used.
    """

    freedom: Freedom = "similarity"
    blur_px: float = 0.8
    estimate_blur: bool = True
    linear_sigma: float = 0.3
    margin_px: float = 6.0
    damage_sigmas: float = 3.2
    damage_rounds: int = 3
    max_iterations: int = 15
    max_shift_px: float = 8.0
    max_distortion: float = 0.3

    def __post_init__(self) -> None:
        if self.freedom not in _GENERATORS:
            raise ValueError(f"freedom is {self.freedom!r}; one of {', '.join(_GENERATORS)} is right")
        for name in (
            "blur_px",
            "linear_sigma",
            "margin_px",
            "damage_sigmas",
            "max_iterations",
            "max_shift_px",
            "max_distortion",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a positive number is right")
        if self.damage_rounds < 0:
            raise ValueError(f"damage_rounds is {self.damage_rounds}; 0 or more is right")


@dataclass(frozen=True, eq=False)
class Match:
    """A mark as fitted. Where converged is false, reason says why and the numbers are the last approximations.

    center_px (2,), covariance_px2 (2, 2), pixel_from_mark (2, 3): of the scan, not of the window.
    contrast_dn: the mark's grey value less the background's, negative for a dark mark. noise_dn: standard deviation of
    one pixel. damaged_fraction: share of the pixels about the mark that were cut out. redundancy: pixels used less
    unknowns. neighbour_correlation: of the residuals; they were taken as white where covariance_is_white. likeness:
    correlation of the fitted picture with the window, less its plane background: 1 for a perfect mark, 0 for none.
    significance: the contrast over its own standard deviation.
    """

    converged: bool
    reason: str
    center_px: Array
    covariance_px2: Array
    pixel_from_mark: Array
    contrast_dn: float
    noise_dn: float
    blur_px: float
    damaged_fraction: float
    redundancy: int
    neighbour_correlation: float
    covariance_is_white: bool
    likeness: float
    significance: float
    residuals_dn: Array

    @property
    def snr(self) -> float:
        return abs(self.contrast_dn) / max(self.noise_dn, 1e-12)


def match(
    window: NDArray[np.floating],
    origin_px: tuple[float, float],
    mark: Mark,
    pixel_from_mark: Array,
    options: MatchOptions | None = None,
    valid: Mask | None = None,
) -> Match:
    """Fit the mark to a window of the scan.

    window: (height, width) grey values whose top-left pixel's centre is at origin_px (col, row) of the scan; valid:
    which of its pixels are true ones. pixel_from_mark: (2, 3) affine matrix from (x_mm, y_mm, 1) to the scan's (col,
    row): its last column is the approximate centre, right to a pixel or two. Never raises for what the picture holds.
    """
    options = options or MatchOptions()
    start = np.array(pixel_from_mark, dtype=float)
    grey, usable, origin = _cropped(np.asarray(window, dtype=float), valid, origin_px, mark, start, options)
    start[:, 2] -= origin
    fit = _Fit(grey, usable, mark, start, options)
    fit.run()
    result = fit.result()
    if fit.reason or is_textured(fit.residuals, fit.used):
        detail = _Fit(grey, usable, mark, start, options, background_px=_background_px(mark, start))
        detail.run()
        if not detail.reason:
            result = detail.result()
    moved = np.array(result.pixel_from_mark)
    moved[:, 2] += origin
    return replace(result, center_px=moved[:, 2], pixel_from_mark=moved)


def _cropped(
    window: Array, valid: Mask | None, origin_px: tuple[float, float], mark: Mark, start: Array, options: MatchOptions
) -> tuple[Array, Mask, Array]:
    """The part of the window that the fit can use, which of it is usable, and its own origin."""
    height, width = window.shape
    usable = np.isfinite(window) if valid is None else np.isfinite(window) & valid
    col0, row0, wide, tall = window_about(mark, start, options.margin_px + _SPARE_PX)
    first_col, first_row = max(round(col0 - origin_px[0]), 0), max(round(row0 - origin_px[1]), 0)
    rows = slice(min(first_row, height - 1), max(first_row + tall, 1))
    cols = slice(min(first_col, width - 1), max(first_col + wide, 1))
    origin = np.array([origin_px[0] + cols.start, origin_px[1] + rows.start])
    return np.where(usable, window, 0.0)[rows, cols], usable[rows, cols], origin


def window_about(mark: Mark, pixel_from_mark: Array, margin_px: float) -> tuple[int, int, int, int]:
    """col0, row0, width, height of the window that holds the mark and margin_px about it."""
    least, greatest = extent_px(mark, np.asarray(pixel_from_mark, dtype=float))
    col0, row0 = np.floor(least - margin_px).astype(int)
    col1, row1 = np.ceil(greatest + margin_px).astype(int)
    return int(col0), int(row0), int(col1 - col0 + 1), int(row1 - row0 + 1)


class _Fit:
    """One mark's adjustment in progress: its state, and the steps that improve it."""

    def __init__(
        self,
        grey: Array,
        usable: Mask,
        mark: Mark,
        start: Array,
        options: MatchOptions,
        background_px: float | None = None,
    ) -> None:
        self.background_px = background_px
        self.usable, self.mark, self.start, self.options = usable, mark, start, options
        self.grey = self._detail(grey)
        self.pixel_from_mark = start.copy()
        self.variance_px2 = options.blur_px**2 if self._blurs_freely() else _sharpest(mark, options)
        self.grey_parameters: Array = np.zeros(_GREY)
        generators = [g for g in _GENERATORS[options.freedom] if not (g is _TURN and is_round(mark))]
        self.generators = np.array(generators).reshape(-1, 2, 2)
        self.used = usable
        self.area = usable
        self.residuals = np.zeros_like(grey)
        self.design = np.zeros((0, *grey.shape))
        self.scale_dn2 = 1.0
        self.reason = ""

    def run(self) -> None:
        """Plain, then robust, then on what is undamaged; stops with a reason where something gives way."""
        self._choose_area()
        if not self.reason and np.ptp(self.grey[self.area]) == 0.0:
            self.reason = "the picture is even there: nothing stands out"
        if not self.reason:
            self._adjust(robust=False, tolerance_px=0.05)
        if not self.reason:
            self._choose_area()
        if not self.reason:
            self._adjust(robust=True, tolerance_px=0.005)
        for round_ in range(self.options.damage_rounds):
            if self.reason:
                return
            floor_dn = _DAMAGE_FLOOR * abs(float(self.grey_parameters[0]))
            undamaged = self.area & ~damage(self.residuals, self.area, self.options.damage_sigmas, floor_dn)
            if round_ > 0 and np.array_equal(undamaged, self.used):
                return
            self.used = undamaged
            if self.used.sum() < 3 * len(self.design):
                self.reason = "too little of the mark is undamaged"
                return
            self._adjust(robust=False, tolerance_px=0.002)

    def result(self) -> Match:
        """The match in the window's own pixels."""
        noise = noise_model(self.residuals, self.used, len(self.design))
        covariance, gain_sigma = np.full((2, 2), np.inf), np.inf
        if not self.reason:
            masked = self.design * self.used
            if not noise.is_white:
                noise = grain_model(self.residuals, self.used, masked, noise.neighbour_correlation)
            normal = _normal(masked, masked) + np.diag(self._prior_weights() * max(noise.variance_dn2, 1e-12))
            middle = normal * noise.variance_dn2
            if not noise.is_white:
                middle = _normal(masked, correlated(masked, noise) * self.used)
            inverse = np.linalg.inv(normal)
            full = inverse @ middle @ inverse
            covariance = (full[:2, :2] + full[:2, :2].T) / 2
            gain_sigma = float(np.sqrt(max(full[-_GREY, -_GREY], 1e-12)))
            if not np.all(np.linalg.eigvalsh(covariance) > 0):
                covariance = (inverse * noise.variance_dn2)[:2, :2]
        return Match(
            converged=not self.reason,
            reason=self.reason,
            center_px=self.pixel_from_mark[:, 2],
            covariance_px2=covariance,
            pixel_from_mark=self.pixel_from_mark,
            contrast_dn=float(self.grey_parameters[0]),
            noise_dn=float(np.sqrt(noise.variance_dn2)),
            blur_px=float(np.sqrt(self.variance_px2)),
            damaged_fraction=1.0 - float(self.used.sum() / max(self.area.sum(), 1)),
            redundancy=int(self.used.sum()) - len(self.design),
            neighbour_correlation=noise.neighbour_correlation,
            covariance_is_white=noise.is_white,
            likeness=self._likeness(),
            significance=abs(float(self.grey_parameters[0])) / gain_sigma,
            residuals_dn=np.where(self.area, self.residuals, np.nan),
        )

    def _likeness(self) -> float:
        background = np.stack([np.ones_like(self.grey), *self._slopes()])[:, self.used]
        grey = self.grey[self.used]
        if len(grey) <= len(background):
            return 0.0
        without = grey - background.T @ np.linalg.lstsq(background.T, grey, rcond=None)[0]
        return float(np.sqrt(max(1 - np.sum(self.residuals[self.used] ** 2) / max(np.sum(without**2), 1e-12), 0.0)))

    def _blurs_freely(self) -> bool:
        return self.options.estimate_blur or not isinstance(self.mark, MarkTemplate)

    def _choose_area(self) -> None:
        """The pixels within margin_px of the mark: beyond it the background only disturbs."""
        height, width = self.grey.shape
        if isinstance(self.mark, MarkTemplate):
            near = chip_mask(self.mark, self.pixel_from_mark, width, height)
        else:
            rendering = render(self.mark, self.pixel_from_mark, width, height, 0.3)
            outside = (rendering.pixels(rendering.value) < 0.02).astype(np.uint8)
            near = cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= self.options.margin_px
            if outside.all():
                self.reason = "the mark lies outside of its window"
        self.area = self.used = self.usable & near
        if self.area.sum() < 0.5 * near.sum() or self.area.sum() < 40:
            self.reason = self.reason or "most of the mark lies outside of the scan"

    def _adjust(self, robust: bool, tolerance_px: float) -> None:
        """Gauss-Newton until the mark moves less than tolerance_px; a step that does not improve the fit is halved."""
        self._linearise()
        self.scale_dn2 = self._tukey_scale() ** 2
        scale_dn = self._tukey_scale() if robust else np.inf
        for _ in range(self.options.max_iterations):
            step = self._solve(self.used * tukey_weights(self.residuals, scale_dn))
            if step is None:
                self.reason = "the picture does not determine the mark's place"
                return
            before, cost = self._state(), self._cost(scale_dn)
            moved = self._apply(step)
            if moved < tolerance_px:
                self.residuals = self.residuals - np.tensordot(step, self.design, axes=1)
                return
            self._linearise()
            for _ in range(_HALVINGS):
                if self._cost(scale_dn) <= cost:
                    break
                step = step / 2
                self._restore(before)
                moved = self._apply(step)
                self._linearise()
            if self._ran_away():
                return
            if moved < tolerance_px:
                return
        self.reason = "the adjustment did not converge"

    def _state(self) -> tuple[Array, float, Array]:
        return self.pixel_from_mark.copy(), self.variance_px2, self.grey_parameters

    def _restore(self, state: tuple[Array, float, Array]) -> None:
        self.pixel_from_mark, self.variance_px2, self.grey_parameters = state[0].copy(), state[1], state[2]

    def _cost(self, scale_dn: float) -> float:
        """What the adjustment makes small: Tukey's loss, squares where the scale is infinite, and the priors'."""
        residuals = self.residuals[self.used]
        return float(
            tukey_loss(residuals, scale_dn) + self.scale_dn2 * np.sum(self._prior_weights() * self._departures() ** 2)
        )

    def _linearise(self) -> None:
        """The design (unknowns, height, width) and residuals of the present state, the gain from a linear fit at
        first."""
        height, width = self.grey.shape
        rendering = render(self.mark, self.pixel_from_mark, width, height, float(np.sqrt(self.variance_px2)))
        value = self._detail(rendering.pixels(rendering.value))
        slopes = self._slopes()
        grey_design = np.stack([value, np.ones_like(value), *slopes])
        if not self.grey_parameters.any():
            rows = grey_design[:, self.used]
            self.grey_parameters = np.asarray(np.linalg.lstsq(rows.T, self.grey[self.used], rcond=None)[0], dtype=float)
        gain = self.grey_parameters[0]
        col, row = self._cell_offsets(rendering.cells)
        columns = [rendering.by_col, rendering.by_row]
        for generator in self.generators:
            along_col = generator[0, 0] * col + generator[0, 1] * row
            along_row = generator[1, 0] * col + generator[1, 1] * row
            columns.append(rendering.by_col * along_col + rendering.by_row * along_row)
        design = [-gain * self._detail(rendering.pixels(column)) for column in columns]
        if self.options.estimate_blur:
            design.append(0.5 * gain * self._detail(rendering.pixels(rendering.laplacian)))
        self.design = np.stack([*design, *grey_design])
        self.residuals = self.grey - np.tensordot(self.grey_parameters, grey_design, axes=1)

    def _detail(self, image: Array) -> Array:
        """Grey values, or their model, without what is coarser than the mark's lines."""
        if self.background_px is None:
            return image
        return np.asarray(image - cv2.GaussianBlur(image, (0, 0), self.background_px))

    def _slopes(self) -> tuple[Array, Array]:
        height, width = self.grey.shape
        scale = max(height, width) / 2
        row, col = np.mgrid[:height, :width].astype(float)
        return (col - (width - 1) / 2) / scale, (row - (height - 1) / 2) / scale

    def _cell_offsets(self, cells: int) -> tuple[Array, Array]:
        height, width = self.grey.shape
        col = (np.arange(width * cells) + 0.5) / cells - 0.5 - self.pixel_from_mark[0, 2]
        row = (np.arange(height * cells) + 0.5) / cells - 0.5 - self.pixel_from_mark[1, 2]
        return col[None, :], row[:, None]

    def _tukey_scale(self) -> float:
        return max(robust_scale(self.residuals[self.used]), _SCALE_FLOOR * abs(float(self.grey_parameters[0])), 1e-9)

    def _solve(self, weights: Array) -> Array | None:
        """The step, None where it is not determined. A blur at its limit stays there instead of pulling the others."""
        weighted = self.design * weights
        priors = self._prior_weights() * self.scale_dn2
        normal = _normal(self.design, weighted) + np.diag(priors)
        right = np.tensordot(weighted, self.residuals, axes=2) - priors * self._departures()
        free = np.ones(len(right), dtype=bool)
        step = solution(normal, right, free)
        blur = 2 + len(self.generators)
        if step is not None and self.options.estimate_blur:
            low, high = self._variance_range()
            if (self.variance_px2 <= low and step[blur] < 0) or (self.variance_px2 >= high and step[blur] > 0):
                free[blur] = False
                step = solution(normal, right, free)
        return step

    def _variance_range(self) -> tuple[float, float]:
        low, high = _BLUR_RANGE_PX
        return (0.0 if isinstance(self.mark, MarkTemplate) else low**2), high**2

    def _prior_weights(self) -> Array:
        """1 / variance of the loose priors that hold what the picture does not show, a disk's rotation say."""
        weights = np.zeros(len(self.design))
        weights[2 : 2 + len(self.generators)] = 1 / self.options.linear_sigma**2
        return weights

    def _departures(self) -> Array:
        """How far the parameters under a prior are from where they started."""
        departures = np.zeros(len(self.design))
        distortion = self._distortion()
        for index, generator in enumerate(self.generators):
            departures[2 + index] = np.sum(distortion * generator) / np.sum(generator**2)
        return departures

    def _distortion(self) -> Array:
        return np.asarray(self.pixel_from_mark[:, :2] @ np.linalg.inv(self.start[:, :2]) - np.eye(2))

    def _apply(self, step: Array) -> float:
        """Take a step, shortened where it leaves the range of a linearisation; its length in px."""
        shift, linear = step[:2], step[2 : 2 + len(self.generators)]
        longest = max(np.hypot(*shift) / 1.5, float(np.abs(linear).max(initial=0.0)) / 0.1, 1.0)
        self.pixel_from_mark[:, 2] += shift / longest
        change = np.tensordot(linear / longest, self.generators, axes=1) if len(linear) else np.zeros((2, 2))
        self.pixel_from_mark[:, :2] = (np.eye(2) + change) @ self.pixel_from_mark[:, :2]
        if self.options.estimate_blur:
            near = self.variance_px2 / 2 - 0.05, self.variance_px2 * 2 + 0.3
            wished = self.variance_px2 + step[2 + len(self.generators)] / longest
            self.variance_px2 = float(np.clip(np.clip(wished, *near), *self._variance_range()))
        self.grey_parameters = self.grey_parameters + step[-_GREY:] / longest
        reach = max(self.grey.shape) / 4
        return float(np.hypot(*shift) + reach * 0.1 * np.abs(linear).max(initial=0.0))

    def _ran_away(self) -> bool:
        moved = float(np.hypot(*(self.pixel_from_mark[:, 2] - self.start[:, 2])))
        if moved > self.options.max_shift_px:
            self.reason = f"the fit ran {moved:.1f} px away from where the mark was expected"
        elif np.abs(self._distortion()).max() > self.options.max_distortion:
            self.reason = "the fit wants a mark of another size or direction than the one drawn"
        return bool(self.reason)


def _background_px(mark: Mark, pixel_from_mark: Array) -> float:
    scale = float(np.sqrt(abs(np.linalg.det(pixel_from_mark[:, :2]))))
    return max(1.5 * scale * thinnest_mm(mark), 1.0) + 1.0


def is_round(mark: Mark) -> bool:
    """Whether every rotation leaves the mark as it is."""
    if isinstance(mark, MarkTemplate):
        return False
    return all(isinstance(part, Disk | Ring) and part.center_mm == (0.0, 0.0) for part in mark.parts)


def _sharpest(mark: Mark, options: MatchOptions) -> float:
    """A chip already has its scan's blur: where none is estimated, none is added."""
    return 0.0 if isinstance(mark, MarkTemplate) else options.blur_px**2


def _normal(first: Array, second: Array) -> Array:
    return np.asarray(np.tensordot(first, second, axes=((1, 2), (1, 2))))
