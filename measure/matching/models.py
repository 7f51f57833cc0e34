"""The model of a window that shows a mark: `gain * picture(mark) + offset + slopes`, its state and its derivatives."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.flags import NO_REASON, Code, Reason
from measure.geometry import linear_scale
from measure.marks.rendering import Rendering, chip_steadiness, reach_px, render
from measure.marks.shapes import Disk, Mark, MarkTemplate, Ring, thinnest_mm
from measure.matching.options import Freedom, MatchOptions
from measure.matching.saturation import censored, tells
from measure.matching.window import ScanWindow
from measure.noise.noise_model import combined, factors

# Changes of the mark's linear part: (I + e G) times it, G a generator of two ones.
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
GREY = 4  # unknowns: gain, offset and two slopes, the last ones
ROUNDING_DN = 0.3  # standard deviation of what rounding to whole grey values adds
BENT, ROUGHLY_BENT = 0.075, 0.4  # of the mark's outline, times the blur: so far a series replaces a new drawing
PIXEL_VARIANCE_PX2 = 1 / 12  # the mean over a pixel's square, taken as a little more blur
_AS_NOISY = 0.02  # a change of the noise by a smaller share leaves what clipped grey values tell as it is
_LEAST = 1e-300  # squared slope of a clipped grey value that tells nothing
_BLUR_RANGE_PX = (0.3, 6.0)  # from where pixels hide it to where marks can hardly be seen
_MOST_DISTORTION = 0.3  # of scale, rotation (rad) and shear: more is another mark
_LONGEST_SHIFT_PX, _LONGEST_CHANGE = 1.5, 0.1  # of a step: beyond it the linearisation tells nothing
_MOST_BLURRED = 2.0  # times the blur, likewise
_LINEAR = 0.015  # times the blur: within it a linearisation is as good as a new one, to 1e-4 of the blur
_CHIP_SMOOTHED_PX = 0.7  # and of what it is compared with: as sharp as pixels, edges are sampled falsely in both


def is_round(mark: Mark) -> bool:
    """Whether every rotation leaves the mark as it is."""
    if isinstance(mark, MarkTemplate):
        return False
    centred = all(isinstance(part, Disk | Ring) and part.center_mm == (0.0, 0.0) for part in mark.parts)
    return centred and not any(mark.perspective)


def background_px(mark: Mark, pixel_from_mark: Array) -> float:
    """The standard deviation of a blur that leaves nothing of the mark's lines."""
    return max(1.5 * linear_scale(pixel_from_mark) * thinnest_mm(mark), 1.0) + 1.0


@dataclass(frozen=True, eq=False)
class State:
    """pixel_from_mark (2, 3); variance_px2 of the blur; greys (4,): gain, offset, slopes, 0 until fitted."""

    pixel_from_mark: Array
    variance_px2: float
    greys: Array

    def shifted(self, shift_px: Array) -> "State":
        """The same state where all places are (2,) px farther on; the greys are still to be fitted there."""
        place = self.pixel_from_mark.copy()
        place[:, 2] += shift_px
        return State(place, self.variance_px2, np.zeros(GREY))


class PictureModel:
    """The model at its present state: design (unknowns, height, width) and residuals (height, width). The unknowns are
    column and row, the generators' parameters, the blur's variance if it is estimated, and the greys.

    bent: how far, in units of the blur, a series may bend the drawing before it is drawn anew.
    start: where the mark is expected, where the state begins too.
    light (height, width): grey values with their surroundings, grey: what is fitted of them; background_px: the blur
    that takes the surroundings away, None where they are fitted too.
    ground (3, height, width): offset and slopes of the background.
    clipped (height, width): as `clipped_sides` gives it. noise_dn: standard deviation of the noise, which clipped grey
    values need; tells (height, width): False where a clipped one says nothing of it. slopes and information (height,
    width), 1 where a grey value is ordinary: as `censored` gives them. uncensored (height, width): residuals as if
    none were clipped, where some are.
    steadiness (height, width): the noise of an ordinary pixel over that of each, a chip's as `chip_steadiness` gives
    it. Residuals and design are multiplied by it: so their noise is alike everywhere. half_tones (height, width): of a
    chip, as `covariance_of_changed_tone` needs it."""

    def __init__(
        self, window: ScanWindow, mark: Mark, start: Array, options: MatchOptions, background_px: float | None = None
    ) -> None:
        self.mark, self.start, self.options, self.background_px = mark, start, options, background_px
        grey, self.clipped, self.noise_dn = np.asarray(window.grey, float), window.sides, ROUNDING_DN
        self.is_clipped = bool(self.clipped.any())
        self.tells = np.ones(grey.shape, dtype=bool)
        ones, zeros = np.ones((3, *grey.shape)), np.zeros((3, *grey.shape))
        self.slopes: Array = ones[0]
        self.information: Array = ones[1]
        self.steadiness: Array = ones[2]
        self.uncensored: Array = zeros[0]
        self.half_tones: Array = zeros[1]
        self.residuals: Array = zeros[2]
        self.is_chip = isinstance(mark, MarkTemplate)
        self.smoothed_px2 = _CHIP_SMOOTHED_PX**2 if self.is_chip else 0.0
        self.light = np.asarray(cv2.GaussianBlur(grey, (0, 0), _CHIP_SMOOTHED_PX), float) if self.is_chip else grey
        self.grey = self.detail(self.light)
        names = [name for name in _FREEDOMS[options.freedom] if name != "turn" or not is_round(mark)]
        self.generators = np.array([_GENERATORS[name] for name in names]).reshape(-1, 2, 2)
        sigmas = [options.strain_sigma if name in ("stretch", "shear") else options.linear_sigma for name in names]
        moving = 2 + len(names) + options.estimate_blur
        self.linear = slice(2, 2 + len(names))
        self.blur = moving - 1 if options.estimate_blur else None
        self.prior_weights = np.zeros(moving + GREY)  # 1 / variance; 0 for what is not known before
        self.prior_weights[self.linear] = np.array(sigmas) ** -2.0
        if self.blur is not None:
            total_px2 = options.blur_px**2 + PIXEL_VARIANCE_PX2
            self.prior_weights[self.blur] = 1 / (2 * total_px2 * options.blur_sigma) ** 2
        # A chip already has its scan's blur: where none is estimated, none is added.
        added_px2 = 0.0 if self.is_chip and not options.estimate_blur else options.blur_px**2
        self.state = State(start.copy(), added_px2 + self.smoothed_px2, np.zeros(GREY))
        self.bent = BENT
        self._drawn, self._mark_from_drawn = start[:, :2].copy(), np.linalg.inv(start[:, :2])
        self._mark_from_start = np.linalg.inv(start[:, :2])
        self._linearised: tuple[State, Array] | None = None  # the state that the design is of, and its residuals
        self.reach_px = reach_px(mark, start[:, :2])
        self.ground = background_planes(*grey.shape)
        self.design = np.zeros((moving + GREY, *grey.shape))

    def linearise(self, used: Mask) -> None:
        """Design and residuals of the present state; the greys from a linear fit to what is used, at first. Close to
        where the design was last computed it stays, and the residuals follow from it."""
        if self._linearised is not None:
            before, residuals = self._linearised
            if not self.has_moved(before, _LINEAR * self.total_blur_px) and not self._is_bent():
                self.residuals = residuals - combined(self._change(before), self.design)
                return
        height, width = self.grey.shape
        place = self.state.pixel_from_mark
        shown = self._render_mark(width, height)
        greys, columns = self.design[-GREY:], self.design[:-GREY]
        greys[0], greys[1:] = self.detail(shown.value), self.ground
        if not self.state.greys.any():
            self.state = State(place, self.state.variance_px2, factors(greys * used, self.grey))
        columns[0], columns[1] = shown.by_col, shown.by_row
        col, row = np.arange(width) - place[0, 2], (np.arange(height) - place[1, 2])[:, None]
        moves = np.stack([slope * along for slope in columns[:2] for along in (col, row)])
        # The blur does not bend with the mark: else a soft disk's size, blur and contrast run away together.
        moves += self.total_blur_px**2 * np.stack([shown.by_col_col, *[shown.by_col_row] * 2, shown.by_row_row])
        columns[self.linear] = combined(self.generators.reshape(-1, 4), moves)
        if self.blur is not None:
            columns[self.blur] = -0.5 * shown.laplacian
        if self.background_px is not None:
            columns[:] = [self.detail(column) for column in columns]
        columns *= -self.state.greys[0]
        self.residuals = self.grey - combined(self.state.greys, greys)
        if isinstance(self.mark, MarkTemplate):
            self.steadiness = chip_steadiness(self.mark, place, width, height)
            self.half_tones = self.steadiness * self.state.greys[0] * self.detail(4 * shown.value * (1 - shown.value))
        for each in (self.residuals, self.design):
            each *= self.steadiness
        self._censor()
        self._linearised = self.state, self.residuals

    def _censor(self) -> None:
        """Clipped grey values hold the model on their side of the limit only."""
        if not self.is_clipped:
            return
        clipped = self.clipped != 0
        self.uncensored = self.residuals.copy()
        censoring = censored(self.residuals[clipped], self.clipped[clipped], self.noise_dn)
        self.residuals[clipped], self.slopes[clipped], self.information[clipped] = censoring
        self.design[:, clipped] *= censoring.slopes
        self.tells[clipped] = tells(censoring.slopes)

    def take_noise(self, noise_dn: float) -> None:
        """Judge clipped grey values by noise of that standard deviation, unless it changes nothing of their part."""
        if abs(noise_dn / self.noise_dn - 1) > _AS_NOISY:
            self.noise_dn, self._linearised = noise_dn, None

    def take_steadiness(self, steadiness: Array) -> None:
        """Another noise of each pixel (height, width) over that of an ordinary one."""
        self.steadiness, self._linearised = steadiness, None

    def step(self, step: Array) -> float:
        """Take a step, shortened where it leaves the range of a linearisation; its length in px."""
        shift, linear = step[:2], step[self.linear]
        largest = np.abs(linear).max(initial=0.0)
        longest = max(np.hypot(*shift) / _LONGEST_SHIFT_PX, largest / _LONGEST_CHANGE, 1.0)
        place = self.state.pixel_from_mark.copy()
        place[:, 2] += shift / longest
        place[:, :2] += combined(linear / longest, self.generators) @ place[:, :2]
        variance = self.state.variance_px2
        if self.blur is not None:
            # As a change of the standard deviation, the pixel's share included: so a blur far off is near in a step.
            total_px = self.total_blur_px
            ratio = np.clip(1 + step[self.blur] / longest / (2 * total_px**2), 1 / _MOST_BLURRED, _MOST_BLURRED)
            variance = float(np.clip((total_px * ratio) ** 2 - PIXEL_VARIANCE_PX2, *self._variance_range))
        self.state = State(place, variance, self.state.greys + step[-GREY:] / longest)
        return float(np.hypot(*shift) + max(self.grey.shape) / 4 * _LONGEST_CHANGE * largest)

    @property
    def departures(self) -> Array:
        """(unknowns,) how far the parameters under a prior are from where it has them."""
        departures = np.zeros(len(self.design))
        departures[self.linear] = self._parameters(self._distortion)
        if self.blur is not None:
            departures[self.blur] = self.state.variance_px2 - self.options.blur_px**2
        return departures

    def ran_away(self) -> Reason:
        """Why the present state is no mark where one was expected; empty where it may be."""
        moved = float(np.hypot(*(self.state.pixel_from_mark[:, 2] - self.start[:, 2])))
        if moved > self.options.max_shift_px:
            return Reason(f"the fit ran {moved:.1f} px away from where the mark was expected", Code.NO_FIT)
        if np.abs(self._distortion).max() > _MOST_DISTORTION:
            return Reason("the fit wants a mark of another size or direction than the one drawn", Code.SIZE)
        return NO_REASON

    def blur_is_held(self, step: Array) -> bool:
        """Whether a step would take the blur out of its range, at whose limit it is already."""
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

    def has_moved(self, before: State, by_px: float) -> bool:
        """Whether the mark's outline lies farther from that of a state before; blurring counts double, for the standard
        deviations' sake."""
        change = self._change(before)
        length = float(np.hypot(*change[:2])) + self.reach_px * float(np.abs(change[self.linear]).max(initial=0.0))
        blurred = abs(float(np.sqrt(self.state.variance_px2) - np.sqrt(before.variance_px2)))
        return length + 2 * blurred > by_px

    def _change(self, before: State) -> Array:
        """(unknowns,) from a state before to the present one, both alike."""
        change = np.zeros(len(self.design))
        place, linear = self.state.pixel_from_mark, before.pixel_from_mark[:, :2]
        change[:2] = place[:, 2] - before.pixel_from_mark[:, 2]
        change[self.linear] = self._parameters(place[:, :2] @ np.linalg.inv(linear) - np.eye(2))
        if self.blur is not None:
            change[self.blur] = self.state.variance_px2 - before.variance_px2
        change[-GREY:] = self.state.greys - before.greys
        return change

    def _parameters(self, change: Array) -> Array:
        """The generators' parameters of a change (2, 2) of the linear part."""
        return np.asarray(self.generators.reshape(-1, 4) @ change.ravel() / 2)  # of two ones each

    @property
    def _distortion(self) -> Array:
        return np.asarray(self.state.pixel_from_mark[:, :2] @ self._mark_from_start - np.eye(2), float)

    @property
    def drawn_light(self) -> Array:
        """(height, width) the light that the present state draws, with the surroundings if these do not count."""
        return self.light - (self.uncensored if self.is_clipped else self.residuals) / self.steadiness

    @property
    def scores(self) -> Array:
        """(height, width) the residuals times their slopes: what each pixel adds to the normal equations. They are 0 on
        average and vary with the information."""
        return self.residuals * self.slopes

    @property
    def curvature(self) -> Array:
        """(height, width) the information over the square of the slopes, one to two: what a residual's bend adds."""
        return np.maximum(self.information / np.maximum(self.slopes**2, _LEAST), 1.0)

    @property
    def contrast_dn(self) -> float:
        """The mark's grey value less that of its ground."""
        return float(self.state.greys[0])

    @property
    def blur_px(self) -> float:
        return float(np.sqrt(self.state.variance_px2))

    @property
    def total_blur_px(self) -> float:
        """The standard deviation of blur and pixel."""
        return float(np.sqrt(self.state.variance_px2 + PIXEL_VARIANCE_PX2))

    def detail(self, image: NDArray[np.floating]) -> Array:
        """(height, width) grey values, or their model, without what is coarser than the mark's lines."""
        if self.background_px is None:
            return np.asarray(image, float)
        return np.asarray(image - cv2.GaussianBlur(image, (0, 0), self.background_px))

    def place_drawn(self) -> Array:
        """(2, 3) the present place of the mark as it was last drawn: its linear part is close to the present one."""
        place = self.state.pixel_from_mark
        if self._is_bent():
            self._drawn, self._mark_from_drawn = place[:, :2].copy(), np.linalg.inv(place[:, :2])
        return np.column_stack([self._drawn, place[:, 2]])

    def _is_bent(self) -> bool:
        """Whether the present mark is bent farther than a series reaches; column by column of the linear part."""
        most = float(np.hypot(*self._bend()).max()) * self.reach_px
        return most > self.bent * self.total_blur_px

    def _bend(self) -> Array:
        """(2, 2) how far the present mark is bent from the one drawn."""
        return np.asarray(self.state.pixel_from_mark[:, :2] @ self._mark_from_drawn - np.eye(2))

    def _render_mark(self, width: int, height: int) -> Rendering:
        place = self.place_drawn()
        shown = render(self.mark, place, width, height, self.blur_px)
        change = self._bend()
        return shown.bent(change, place[:, 2], self.state.variance_px2 + PIXEL_VARIANCE_PX2) if change.any() else shown


def background_planes(height: int, width: int) -> Array:
    """(3, height, width) offset and slopes of the background."""
    scale = max(height, width) / 2
    planes = np.ones((3, height, width))
    planes[1] = (np.arange(width) - (width - 1) / 2) / scale
    planes[2] = (np.arange(height)[:, None] - (height - 1) / 2) / scale
    return planes
