"""Functional model of a window with a mark: `gain * picture(mark) + offset + slopes`, its state and derivatives."""

from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.geometry import linear_scale
from measure.marks.rendering import Rendering, chip_steadiness, reach_px, render
from measure.marks.shapes import Mark, MarkTemplate
from measure.matching.window import ScanWindow, deviance_residuals
from measure.noise.noise_model import combine, least_squares_factors

Freedom = Literal["shift", "similarity", "affine", "ellipse"]
FREEDOMS: tuple[Freedom, ...] = get_args(Freedom)

# Changes of the mark's linear part L: (I + e G) L. Each generator G has two entries of absolute value 1.
_GENERATORS = {
    "scale": ((1.0, 0.0), (0.0, 1.0)),
    "turn": ((0.0, -1.0), (1.0, 0.0)),
    "stretch": ((1.0, 0.0), (0.0, -1.0)),
    "shear": ((0.0, 1.0), (1.0, 0.0)),
}
_FREEDOMS: dict[Freedom, tuple[str, ...]] = {
    "shift": (),
    "similarity": ("scale", "turn"),
    "affine": ("scale", "turn", "stretch", "shear"),
    "ellipse": ("scale", "stretch", "shear"),
}
GREY = 4  # grey-value unknowns, the last ones: gain, offset and two slopes
QUANTISATION_DN = 0.3  # standard deviation of rounding to whole grey values
BENT, ROUGHLY_BENT = 0.075, 0.4  # in blurs: outline displacement up to which a Taylor series replaces rendering
PIXEL_VARIANCE_PX2 = 1 / 12  # px², averaging over the pixel, treated as additional blur
_AS_NOISY = 0.02  # relative change of the noise below which clipped grey values are not re-evaluated
_INFORMATIVE_SLOPE = 0.5  # slope of a clipped grey value above which its residual counts as an ordinary one
_LEAST = 1e-300  # lower bound of the squared slope of a clipped grey value, to divide by
_BLUR_RANGE_PX = (0.3, 6.0)  # px: smaller blur is hidden by the pixel, with larger blur marks are hardly visible
_LONGEST_SHIFT_PX, _LONGEST_CHANGE = 1.5, 0.1  # px and linear part: longest step for which the linearisation holds
_MOST_BLURRED = 2.0  # largest factor of the blur in one step
_LINEAR = 0.015  # in blurs: displacement up to which the design matrix is kept, exact to 1e-4 of the blur
_CHIP_SMOOTHED_PX = 0.7  # px, smoothing of chip and window: edges as sharp as a pixel are undersampled in both


@dataclass(frozen=True)
class MatchOptions:
    """Options of least-squares matching.

    Attributes
    ----------
    freedom : parameters estimated in addition to the shift; "ellipse" is an affinity without rotation, for disks.
    blur_px : standard deviation of the scan's blur; its initial value if estimate_blur is set.
    blur_sigma : prior standard deviation of the logarithm of the blur, pixel included, as known from other marks.
    estimate_blur : whether the blur is an unknown.
    linear_sigma : prior standard deviation of rotation (rad) and scale, as known from other marks. The default only
        regularises what the image does not determine.
    strain_sigma : prior standard deviation of stretch and shear, likewise.
    margin_px : grey values are used up to this distance around the mark.
    margin_blurs : the margin in standard deviations of the blur, used where it is larger.
    plain_px : distance from the mark up to which damage counts.
    damage_rounds : rounds of detecting and masking damage and readjusting; 0: damage stays in.
    max_shift_px : largest distance from the initial place.
    estimate_sharpening : whether to estimate sharpening even if the scan is not known to be sharpened.

    Raises
    ------
    ValueError
        Names the option whose value is invalid.
    """

    freedom: Freedom = "similarity"
    blur_px: float = 0.8
    blur_sigma: float = inf
    estimate_blur: bool = True
    linear_sigma: float = 0.3
    strain_sigma: float = 0.3
    margin_px: float = 6.0
    margin_blurs: float = 4.0
    plain_px: float = inf
    damage_rounds: int = 3
    max_shift_px: float = 8.0
    estimate_sharpening: bool = False

    def __post_init__(self) -> None:
        if self.freedom not in FREEDOMS:
            raise ValueError(f"freedom is {self.freedom!r}; one of {', '.join(FREEDOMS)} is right")
        for name in ("blur_px", "blur_sigma", "linear_sigma", "strain_sigma", "margin_px", "plain_px", "max_shift_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a positive number is right")
        for name in ("margin_blurs", "damage_rounds"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 or more is right")


def smoothed_px2(mark: Mark) -> float:
    """Variance (px²) of the Gaussian by which the window of a mark is smoothed: that of a chip, 0 for a drawing."""
    return _CHIP_SMOOTHED_PX**2 if isinstance(mark, MarkTemplate) else 0.0


def background_px(mark: Mark, pixel_from_mark: Array) -> float:
    """Standard deviation (px) of a blur that removes the mark's lines, for background subtraction."""
    return max(1.5 * linear_scale(pixel_from_mark) * mark.thinnest_mm, 1.0) + 1.0


@dataclass(frozen=True, eq=False)
class FitState:
    """State of the model. pixel_from_mark (2, 3); variance_px2: of the blur; greys (4,): gain, offset and slopes, 0
    until fitted."""

    pixel_from_mark: Array
    variance_px2: float
    greys: Array

    def shifted(self, shift_px: Array) -> "FitState":
        """Translate the state by shift_px (2,); the greys are reset and must be fitted again."""
        place = self.pixel_from_mark.copy()
        place[:, 2] += shift_px
        return FitState(place, self.variance_px2, np.zeros(GREY))


class PictureModel:
    """Linearised model of a window at its current state.

    The unknowns are column and row, the parameters of the generators, the variance of the blur if it is estimated, and
    the greys.

    Attributes
    ----------
    design : (unknowns, height, width) design matrix.
    residuals : (height, width) residuals.
    bent : in blurs, outline displacement by which a Taylor series may deform the rendered mark before it is rendered
        again.
    start : (2, 3) expected place of the mark, also the initial state.
    light : (height, width) grey values including the background.
    grey : (height, width) grey values to be fitted.
    background_px : blur whose result is subtracted as background; None: the background is modelled.
    ground : (3, height, width) offset and slopes of the background.
    clipped : (height, width) from `clipped_ends`.
    noise_dn : standard deviation of the noise, needed for clipped grey values.
    informative : (height, width) False where a clipped grey value carries no information on the noise.
    slopes, information : (height, width) from `deviance_residuals`; 1 for ordinary grey values.
    uncensored : (height, width) residuals as if no grey value were clipped; set only where some are.
    steadiness : (height, width) noise of an ordinary pixel over that of each pixel, for a chip from `chip_steadiness`.
        Residuals and design are multiplied by it, so that their noise is uniform.
    half_tones : (height, width) of a chip, for `covariance_of_changed_tone`.
    """

    def __init__(
        self, window: ScanWindow, mark: Mark, start: Array, options: MatchOptions, background_px: float | None = None
    ) -> None:
        self.mark, self.start, self.options, self.background_px = mark, start, options, background_px
        grey, self.clipped, self.noise_dn = np.asarray(window.grey, float), window.ends, QUANTISATION_DN
        self.is_clipped = bool(self.clipped.any())
        self.informative = np.ones(grey.shape, dtype=bool)
        ones, zeros = np.ones((3, *grey.shape)), np.zeros((3, *grey.shape))
        self.slopes: Array = ones[0]
        self.information: Array = ones[1]
        self.steadiness: Array = ones[2]
        self.uncensored: Array = zeros[0]
        self.half_tones: Array = zeros[1]
        self.residuals: Array = zeros[2]
        self.is_chip = isinstance(mark, MarkTemplate)
        self.smoothed_px2 = smoothed_px2(mark)
        self.light = np.asarray(cv2.GaussianBlur(grey, (0, 0), _CHIP_SMOOTHED_PX), float) if self.is_chip else grey
        self.grey = self.detail(self.light)
        names = [name for name in _FREEDOMS[options.freedom] if name != "turn" or not mark.is_round]
        self.generators = np.array([_GENERATORS[name] for name in names]).reshape(-1, 2, 2)
        sigmas = [options.strain_sigma if name in ("stretch", "shear") else options.linear_sigma for name in names]
        moving = 2 + len(names) + options.estimate_blur
        self.linear = slice(2, 2 + len(names))
        self.blur = moving - 1 if options.estimate_blur else None
        self.prior_weights = np.zeros(moving + GREY)  # 1 / variance; 0 without a prior
        self.prior_weights[self.linear] = np.array(sigmas) ** -2.0
        if self.blur is not None:
            total_px2 = options.blur_px**2 + PIXEL_VARIANCE_PX2
            self.prior_weights[self.blur] = 1 / (2 * total_px2 * options.blur_sigma) ** 2
        # A chip contains the blur of its scan already: add none unless it is estimated.
        added_px2 = 0.0 if self.is_chip and not options.estimate_blur else options.blur_px**2
        self.state = FitState(start.copy(), added_px2 + self.smoothed_px2, np.zeros(GREY))
        self.bent = BENT
        self._drawn, self._mark_from_drawn = start[:, :2].copy(), np.linalg.inv(start[:, :2])
        self._mark_from_start = np.linalg.inv(start[:, :2])
        self._linearised: tuple[FitState, Array] | None = None  # state of the design matrix, and its residuals
        self.reach_px = reach_px(mark, start[:, :2])
        self.ground = background_planes(*grey.shape)
        self.design = np.zeros((moving + GREY, *grey.shape))

    def linearise(self, used: Mask) -> None:
        """Compute design matrix and residuals at the current state. Initial greys come from a linear fit to the used
        pixels. Near the state of the last design matrix it is kept and the residuals are extrapolated."""
        if self._linearised is not None:
            before, residuals = self._linearised
            if not self.has_moved(before, _LINEAR * self.total_blur_px) and not self._is_bent():
                self.residuals = residuals - combine(self._change(before), self.design)
                return
        height, width = self.grey.shape
        place = self.state.pixel_from_mark
        shown = self._render_mark(width, height)
        greys, columns = self.design[-GREY:], self.design[:-GREY]
        greys[0], greys[1:] = self.detail(shown.value), self.ground
        if not self.state.greys.any():
            self.state = FitState(place, self.state.variance_px2, least_squares_factors(greys * used, self.grey))
        # In single precision, like the rendering.
        col, row = np.arange(width) - place[0, 2], (np.arange(height) - place[1, 2])[:, None]
        slopes = shown.by_col, shown.by_row
        moves = np.stack([slope * along.astype(np.float32) for slope in slopes for along in (col, row)])
        # The blur is not deformed with the mark; otherwise size, blur and contrast of a soft disk diverge together.
        moves += self.total_blur_px**2 * np.stack([shown.by_col_col, *[shown.by_col_row] * 2, shown.by_row_row])
        moving = [*slopes, *combine(self.generators.reshape(-1, 4).astype(np.float32), moves)]
        if self.blur is not None:
            moving.append(-0.5 * shown.laplacian)
        for column, image in zip(columns, moving, strict=True):
            np.multiply(self.detail(image), -self.state.greys[0], out=column)
        self.residuals = self.grey - combine(self.state.greys, greys)
        if isinstance(self.mark, MarkTemplate):
            self.steadiness = chip_steadiness(self.mark, place, width, height)
            self.half_tones = self.steadiness * self.state.greys[0] * self.detail(4 * shown.value * (1 - shown.value))
        for each in (self.residuals, self.design) if (self.steadiness != 1).any() else ():
            each *= self.steadiness
        if self.is_clipped:
            self._censor()
        self._linearised = self.state, self.residuals

    def _censor(self) -> None:
        """Replace the residuals of clipped grey values by deviance residuals (see `deviance_residuals`)."""
        clipped = self.clipped != 0
        self.uncensored = self.residuals.copy()
        deviances, slopes, information = deviance_residuals(
            self.residuals[clipped], self.clipped[clipped], self.noise_dn
        )
        self.residuals[clipped], self.slopes[clipped], self.information[clipped] = deviances, slopes, information
        self.design[:, clipped] *= slopes
        self.informative[clipped] = slopes > _INFORMATIVE_SLOPE

    def take_noise(self, noise_dn: float) -> None:
        """Set the standard deviation of the noise for clipped grey values; ignored if the change is negligible."""
        if abs(noise_dn / self.noise_dn - 1) > _AS_NOISY:
            self.noise_dn, self._linearised = noise_dn, None

    def take_steadiness(self, steadiness: Array) -> None:
        """Set the steadiness (height, width), the noise of an ordinary pixel over that of each pixel."""
        if self._linearised is not None:
            before, residuals = self._linearised
            ratio = steadiness / self.steadiness
            self.design *= ratio
            self._linearised = None if self.is_clipped else (before, residuals * ratio)
        self.steadiness = steadiness

    def step(self, step: Array) -> float:
        """Apply a step, shortened to the range of the linearisation. Returns its length in px."""
        shift, linear = step[:2], step[self.linear]
        largest = np.abs(linear).max(initial=0.0)
        longest = max(np.hypot(*shift) / _LONGEST_SHIFT_PX, largest / _LONGEST_CHANGE, 1.0)
        place = self.state.pixel_from_mark.copy()
        place[:, 2] += shift / longest
        place[:, :2] += combine(linear / longest, self.generators) @ place[:, :2]
        variance = self.state.variance_px2
        if self.blur is not None:
            # As a relative change of the total standard deviation, so that a distant blur is reached in one step.
            total_px = self.total_blur_px
            ratio = np.clip(1 + step[self.blur] / longest / (2 * total_px**2), 1 / _MOST_BLURRED, _MOST_BLURRED)
            variance = float(np.clip((total_px * ratio) ** 2 - PIXEL_VARIANCE_PX2, *self._variance_range))
        self.state = FitState(place, variance, self.state.greys + step[-GREY:] / longest)
        return float(np.hypot(*shift) + max(self.grey.shape) / 4 * _LONGEST_CHANGE * largest)

    @property
    def departures(self) -> Array:
        """(unknowns,) deviations of the parameters from their priors."""
        departures = np.zeros(len(self.design))
        departures[self.linear] = self._parameters(self.distortion)
        if self.blur is not None:
            departures[self.blur] = self.state.variance_px2 - self.options.blur_px**2
        return departures

    def blur_is_held(self, step: Array) -> bool:
        """Whether the blur is at a limit of its range and the step leads beyond it."""
        if self.blur is None:
            return False
        low, high = self._variance_range
        variance, change = self.state.variance_px2, step[self.blur]
        return bool((variance <= low and change < 0) or (variance >= high and change > 0))

    @property
    def blur_is_at_limit(self) -> bool:
        low, high = self._variance_range
        return not low < self.state.variance_px2 < high

    @property
    def _variance_range(self) -> tuple[float, float]:
        low, high = _BLUR_RANGE_PX
        return (0.0 if self.is_chip else low**2), high**2

    def has_moved(self, before: FitState, by_px: float) -> bool:
        """Whether the mark's outline has moved by more than by_px since an earlier state. A change of the blur counts
        twice, because the standard deviations depend on it."""
        change = self._change(before)
        length = float(np.hypot(*change[:2])) + self.reach_px * float(np.abs(change[self.linear]).max(initial=0.0))
        blurred = abs(float(np.sqrt(self.state.variance_px2) - np.sqrt(before.variance_px2)))
        return length + 2 * blurred > by_px

    def _change(self, before: FitState) -> Array:
        """(unknowns,) change of the parameters from an earlier, nearby state to the current one."""
        change = np.zeros(len(self.design))
        place, linear = self.state.pixel_from_mark, before.pixel_from_mark[:, :2]
        change[:2] = place[:, 2] - before.pixel_from_mark[:, 2]
        change[self.linear] = self._parameters(place[:, :2] @ np.linalg.inv(linear) - np.eye(2))
        if self.blur is not None:
            change[self.blur] = self.state.variance_px2 - before.variance_px2
        change[-GREY:] = self.state.greys - before.greys
        return change

    def _parameters(self, change: Array) -> Array:
        """Parameters of the generators for a change (2, 2) of the linear part."""
        return np.asarray(self.generators.reshape(-1, 4) @ change.ravel() / 2)  # 2: squared norm of a generator

    @property
    def distortion(self) -> Array:
        """(2, 2) change of the linear part from the start, relative."""
        return np.asarray(self.state.pixel_from_mark[:, :2] @ self._mark_from_start - np.eye(2), float)

    @property
    def drawn_light(self) -> Array:
        """(height, width) modelled light at the current state, background included."""
        return self.light - (self.uncensored if self.is_clipped else self.residuals) / self.steadiness

    @property
    def misfit(self) -> Array:
        """(height, width) residuals; those of clipped grey values are 0 where the model lies beyond the range, too."""
        if not self.is_clipped:
            return self.residuals
        return np.where(self.clipped * self.uncensored < 0, 0.0, self.uncensored)

    @property
    def scores(self) -> Array:
        """(height, width) scores, residuals times slopes: each pixel's contribution to the normal equations. Their mean
        is 0, their variance proportional to the information."""
        return self.residuals * self.slopes

    @property
    def curvature(self) -> Array:
        """(height, width) information over squared slopes, 1 to 2: the effect of the residual's second derivative."""
        return np.maximum(self.information / np.maximum(self.slopes**2, _LEAST), 1.0)

    @property
    def contrast_dn(self) -> float:
        """Grey value of the mark minus that of its background."""
        return float(self.state.greys[0])

    @property
    def blur_px(self) -> float:
        return float(np.sqrt(self.state.variance_px2))

    @property
    def total_blur_px(self) -> float:
        """Standard deviation of blur and pixel combined."""
        return float(np.sqrt(self.state.variance_px2 + PIXEL_VARIANCE_PX2))

    def detail(self, image: NDArray[np.floating]) -> Array:
        """(height, width) detail of an image: the background, coarser than the mark's lines, is subtracted."""
        if self.background_px is None:
            return np.asarray(image, float)
        return np.asarray(image - cv2.GaussianBlur(image, (0, 0), self.background_px))

    def place_drawn(self) -> Array:
        """(2, 3) current place with the linear part of the last rendering, which is close to the current one."""
        place = self.state.pixel_from_mark
        if self._is_bent():
            self._drawn, self._mark_from_drawn = place[:, :2].copy(), np.linalg.inv(place[:, :2])
        return np.column_stack([self._drawn, place[:, 2]])

    def _is_bent(self) -> bool:
        """Whether the mark is deformed beyond the range of the Taylor series; column by column of the linear part."""
        most = float(np.hypot(*self._bend()).max()) * self.reach_px
        return most > self.bent * self.total_blur_px

    def _bend(self) -> Array:
        """(2, 2) deformation of the current mark relative to the rendered one."""
        return np.asarray(self.state.pixel_from_mark[:, :2] @ self._mark_from_drawn - np.eye(2))

    def _render_mark(self, width: int, height: int) -> Rendering:
        place = self.place_drawn()
        shown = render(self.mark, place, width, height, self.blur_px)
        change = self._bend()
        return (
            shown.deform(change, place[:, 2], self.state.variance_px2 + PIXEL_VARIANCE_PX2) if change.any() else shown
        )


def background_planes(height: int, width: int) -> Array:
    """(3, height, width) design matrix of the background's offset and slopes."""
    scale = max(height, width) / 2
    planes = np.ones((3, height, width))
    planes[1] = (np.arange(width) - (width - 1) / 2) / scale
    planes[2] = (np.arange(height)[:, None] - (height - 1) / 2) / scale
    return planes
