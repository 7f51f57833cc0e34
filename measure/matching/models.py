"""The model of a window that shows a mark: `gain * picture(mark) + offset + slopes`, its state and its derivatives."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.flags import NO_REASON, Code, Reason
from measure.geometry import linear_scale
from measure.marks.rendering import Rendering, chip_steadiness, reach_px, render
from measure.marks.shapes import Disk, Mark, MarkTemplate, Ring, thinnest_mm
from measure.matching.options import Freedom, MatchOptions
from measure.matching.saturation import Sides, censored, tells
from measure.noise.noise_model import combined, factors

# Changes of the mark's linear part: (I + e G) times it, G a generator.
_TURN, _SCALE = ((0.0, -1.0), (1.0, 0.0)), ((1.0, 0.0), (0.0, 1.0))
_STRETCH, _SHEAR = ((1.0, 0.0), (0.0, -1.0)), ((0.0, 1.0), (1.0, 0.0))
_OF_FREEDOM: dict[Freedom, tuple[tuple[tuple[float, float], tuple[float, float]], ...]] = {
    "shift": (),
    "similarity": (_SCALE, _TURN),
    "affine": (_SCALE, _TURN, _STRETCH, _SHEAR),
    "ellipse": (_SCALE, _STRETCH, _SHEAR),
}
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GREY = 4  # unknowns: gain, offset and two slopes, the last ones
ROUNDING_DN = 0.3  # standard deviation of what rounding to whole grey values adds
_AS_NOISY = 0.02  # a change of the noise by a smaller share leaves what clipped grey values tell as it is
_LEAST = 1e-300  # squared slope of a clipped grey value that tells nothing
_BLUR_RANGE_PX = (0.3, 6.0)  # from where pixels hide it to where marks can hardly be seen
BENT, ROUGHLY_BENT = 0.075, 0.4  # of the mark's outline, times the blur: so far a series replaces a new drawing
_MOST_DISTORTION = 0.3  # of scale, rotation (rad) and shear: more is another mark
PIXEL_VARIANCE_PX2 = 1 / 12  # the mean over a pixel's square, taken as a little more blur
_LONGEST_SHIFT_PX, _LONGEST_CHANGE = 1.5, 0.1  # of a step: beyond it the linearisation tells nothing
_MOST_BLURRED = 2.0  # times the blur, likewise
_LINEAR = 0.015  # times the blur: within it a linearisation is as good as a new one, to 1e-4 of the blur
_CHIP_SMOOTHED_PX = 0.7  # and of what it is compared with: as sharp as pixels, edges are sampled falsely in both


def generators(freedom: Freedom, mark: Mark) -> NDArray[np.float64]:
    """(n, 2, 2) of the changes that a fit estimates, scale and rotation first; a round mark has no rotation."""
    shown = [each for each in _OF_FREEDOM[freedom] if not (each is _TURN and is_round(mark))]
    return np.array(shown).reshape(-1, 2, 2)


def are_strains(generators: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) which of the changes (n, 2, 2) are of stretch or shear: symmetric, and the area stays."""
    symmetric = np.all(generators == generators.swapaxes(1, 2), axis=(1, 2))
    return np.asarray(symmetric & (np.trace(generators, axis1=1, axis2=2) == 0))


def is_round(mark: Mark) -> bool:
    """Whether every rotation leaves the mark as it is."""
    if isinstance(mark, MarkTemplate):
        return False
    centred = all(isinstance(part, Disk | Ring) and part.center_mm == (0.0, 0.0) for part in mark.parts)
    return centred and not any(mark.perspective)


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
    light (height, width): grey values with their surroundings, grey: what is fitted of them.
    ground (3, height, width): offset and slopes of the background.
    clipped (height, width): as `clipped_sides` gives it. noise_dn: standard deviation of the noise, which clipped grey
    values need; tells (height, width): False where a clipped one says nothing of it. slopes and information (height,
    width), 1 where a grey value is ordinary: as `censored` gives them. uncensored (height, width): residuals as if
    none were clipped, where some are.
    steadiness (height, width): the noise of an ordinary pixel over that of each, a chip's as `chip_steadiness` gives
    it. Residuals and design are multiplied by it: so their noise is alike everywhere. half_tones (height, width): of a
    chip, as `covariance_of_changed_tone` needs it."""

    def __init__(
        self,
        grey: Array,
        clipped: Sides,
        mark: Mark,
        start: Array,
        options: MatchOptions,
        background_px: float | None = None,
    ) -> None:
        self.mark, self.start, self.options = mark, start, options
        self.background_px = background_px
        self.clipped, self.noise_dn = clipped, ROUNDING_DN
        self.is_clipped = bool(clipped.any())
        self.tells = np.ones(grey.shape, dtype=bool)
        self.slopes, self.information = np.ones(grey.shape), np.ones(grey.shape)
        self.uncensored = np.zeros(grey.shape)
        is_chip = isinstance(mark, MarkTemplate)
        self.smoothed_px2 = _CHIP_SMOOTHED_PX**2 if is_chip else 0.0
        smoothed = np.asarray(cv2.GaussianBlur(grey, (0, 0), _CHIP_SMOOTHED_PX), dtype=float) if is_chip else grey
        self.light, self.grey = smoothed, self.detail(smoothed)
        self.generators = generators(options.freedom, mark)
        self.linear = slice(2, 2 + len(self.generators))
        strains = are_strains(self.generators)
        self._linear_weights = np.where(strains, options.strain_sigma, options.linear_sigma) ** -2.0
        self.blur = 2 + len(self.generators) if options.estimate_blur else None
        # A chip already has its scan's blur: where none is estimated, none is added.
        added_px2 = 0.0 if is_chip and not options.estimate_blur else options.blur_px**2
        self.state = State(start.copy(), added_px2 + self.smoothed_px2, np.zeros(GREY))
        # The state that the design is of, and its residuals.
        self._linearised: tuple[State, Array] | None = None
        self.bent = BENT
        self._draw(start[:, :2])
        self.reach_px = reach_px(mark, start[:, :2])
        self.mark_from_start: Array = np.linalg.inv(start[:, :2]).astype(float)
        self.ground = _planes(*grey.shape)
        self.steadiness, self.half_tones = np.ones(grey.shape), np.zeros(grey.shape)
        self.residuals = np.zeros_like(grey)
        moving = 2 + len(self.generators) + options.estimate_blur
        self.design = np.zeros((moving + GREY, *grey.shape))

    def linearise(self, used: Mask) -> None:
        """Design and residuals of the present state; the greys from a linear fit to what is used, at first. Close to
        where the design was last computed it stays, and the residuals follow from it."""
        if self._linearised is not None:
            at, residuals = self._linearised
            if not self.has_moved(at, _LINEAR * self.total_blur_px) and not self._is_bent():
                self.residuals = residuals - combined(self._change(at), self.design)
                return
        height, width = self.grey.shape
        place = self.state.pixel_from_mark
        shown = self._render_mark(width, height)
        greys = self.design[-GREY:]
        greys[0], greys[1:] = self.detail(shown.value), self.ground
        if not self.state.greys.any():
            self.state = State(place, self.state.variance_px2, factors(greys * used, self.grey))
        columns = self.design[:-GREY]
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

    def take_noise(self, noise_dn: float) -> None:
        """Judge clipped grey values by noise of that standard deviation, unless it changes nothing of their part."""
        if abs(noise_dn / self.noise_dn - 1) > _AS_NOISY:
            self.noise_dn, self._linearised = noise_dn, None

    def take_steadiness(self, steadiness: Array) -> None:
        """Another noise of each pixel (height, width) over that of an ordinary one."""
        self.steadiness, self._linearised = steadiness, None

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

    def has_moved(self, before: State, by_px: float) -> bool:
        """Whether the mark's outline lies farther from that of a state before."""
        return self._length_px(self._change(before)) > by_px

    def _length_px(self, change: Array) -> float:
        """How far a change moves the mark's outline; blurring counts double, for the standard deviations' sake."""
        length = float(np.hypot(*change[:2])) + self.reach_px * float(np.abs(change[self.linear]).max(initial=0.0))
        if self.blur is None:
            return length
        variance = self.state.variance_px2
        return length + 2 * abs(float(np.sqrt(variance) - np.sqrt(variance - change[self.blur])))

    def _parameters(self, change: Array) -> Array:
        """The generators' parameters of a change (2, 2) of the linear part."""
        return np.asarray(self.generators.reshape(-1, 4) @ change.ravel() / 2)  # of two ones each

    def _censor(self) -> None:
        """Clipped grey values hold the model on their side of the limit only."""
        at = self.clipped != 0
        if at.any():
            self.uncensored = self.residuals.copy()
            censoring = censored(self.residuals[at], self.clipped[at], self.noise_dn)
            self.residuals[at], self.slopes[at], self.information[at] = censoring
            self.design[:, at] *= censoring.slopes
            self.tells[at] = tells(censoring.slopes)

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
    def tells_size(self) -> bool:
        """Whether the size is an unknown: then it is the first of the generators' parameters."""
        return len(self.generators) > 0

    @property
    def contrast_dn(self) -> float:
        """The mark's grey value less that of its ground."""
        return float(self.state.greys[0])

    @property
    def ground_dn(self) -> float:
        """The ground's, in the middle of the window."""
        return float(self.state.greys[1])

    @property
    def blur_px(self) -> float:
        return float(np.sqrt(self.state.variance_px2))

    @property
    def scan_blur_px(self) -> float:
        """The scan's own blur; beside a chip only what it has more than that."""
        return float(np.sqrt(max(self.state.variance_px2 - self.smoothed_px2, 0.0)))

    @property
    def total_blur_px(self) -> float:
        """The standard deviation of blur and pixel."""
        return float(np.sqrt(self.state.variance_px2 + PIXEL_VARIANCE_PX2))

    def place_drawn(self) -> Array:
        """(2, 3) the present place of the mark as it was last drawn: its linear part is close to the present one."""
        place = self.state.pixel_from_mark
        if self._is_bent():
            self._draw(place[:, :2])
        return np.column_stack([self._drawn, place[:, 2]])

    def _is_bent(self) -> bool:
        """Whether the present mark is bent farther than a series reaches; column by column of the linear part."""
        most = float(np.hypot(*self._bent()).max()) * self.reach_px
        return most > self.bent * self.total_blur_px

    def _draw(self, linear: Array) -> None:
        self._drawn, self._mark_from_drawn = linear.copy(), np.linalg.inv(linear)

    def _bent(self) -> Array:
        """(2, 2) how far the present mark is bent from the one drawn."""
        return np.asarray(self.state.pixel_from_mark[:, :2] @ self._mark_from_drawn - np.eye(2))

    def _render_mark(self, width: int, height: int) -> Rendering:
        place = self.place_drawn()
        shown = render(self.mark, place, width, height, self.blur_px)
        change = self._bent()
        return shown.bent(change, place[:, 2], self.state.variance_px2 + PIXEL_VARIANCE_PX2) if change.any() else shown

    def step(self, step: Array) -> float:
        """Take a step, shortened where it leaves the range of a linearisation; its length in px."""
        shift, linear = step[:2], step[self.linear]
        longest = max(np.hypot(*shift) / _LONGEST_SHIFT_PX, np.abs(linear).max(initial=0.0) / _LONGEST_CHANGE, 1.0)
        place = self.state.pixel_from_mark.copy()
        place[:, 2] += shift / longest
        place[:, :2] += combined(linear / longest, self.generators) @ place[:, :2]
        variance = self.state.variance_px2
        if self.blur is not None:
            # As a change of the standard deviation, the pixel's share included: so a blur far off is near in a step.
            total_px = self.total_blur_px
            ratio = np.clip(1 + step[self.blur] / longest / (2 * total_px**2), 1 / _MOST_BLURRED, _MOST_BLURRED)
            variance = float(np.clip((total_px * ratio) ** 2 - PIXEL_VARIANCE_PX2, *self._variance_range()))
        self.state = State(place, variance, self.state.greys + step[-GREY:] / longest)
        reach = max(self.grey.shape) / 4
        return float(np.hypot(*shift) + reach * _LONGEST_CHANGE * np.abs(linear).max(initial=0.0))

    def blur_is_held(self, step: Array) -> bool:
        """Whether a step would take the blur out of its range, at whose limit it is already."""
        if self.blur is None:
            return False
        low, high = self._variance_range()
        variance, change = self.state.variance_px2, step[self.blur]
        return bool((variance <= low and change < 0) or (variance >= high and change > 0))

    @property
    def blur_is_at_limit(self) -> bool:
        low, high = self._variance_range()
        return not low < self.state.variance_px2 < high

    def prior_weights(self) -> Array:
        """1 / variance of the priors of rotation, scale, stretch and shear, and of the blur's variance; 0 for all
        else."""
        weights = np.zeros(len(self.design))
        weights[self.linear] = self._linear_weights
        if self.blur is not None:
            total_px2 = self.options.blur_px**2 + PIXEL_VARIANCE_PX2
            weights[self.blur] = 1 / (2 * total_px2 * self.options.blur_sigma) ** 2
        return weights

    def departures(self) -> Array:
        """How far the parameters under a prior are from where it has them."""
        departures = np.zeros(len(self.design))
        departures[self.linear] = self._parameters(self._distortion())
        if self.blur is not None:
            departures[self.blur] = self.state.variance_px2 - self.options.blur_px**2
        return departures

    def ran_away(self) -> Reason:
        """Why the present state is no mark where one was expected; empty where it may be."""
        moved = float(np.hypot(*(self.state.pixel_from_mark[:, 2] - self.start[:, 2])))
        if moved > self.options.max_shift_px:
            return Reason(f"the fit ran {moved:.1f} px away from where the mark was expected", Code.NO_FIT)
        if np.abs(self._distortion()).max() > _MOST_DISTORTION:
            return Reason("the fit wants a mark of another size or direction than the one drawn", Code.SIZE)
        return NO_REASON

    def detail(self, image: NDArray[np.floating]) -> Array:
        """(height, width) grey values, or their model, without what is coarser than the mark's lines."""
        if self.background_px is None:
            return np.asarray(image, float)
        return np.asarray(image - cv2.GaussianBlur(image, (0, 0), self.background_px))

    def _variance_range(self) -> tuple[float, float]:
        low, high = _BLUR_RANGE_PX
        return (0.0 if isinstance(self.mark, MarkTemplate) else low**2), high**2

    def _distortion(self) -> Array:
        return np.asarray(self.state.pixel_from_mark[:, :2] @ self.mark_from_start - np.eye(2))


def _planes(height: int, width: int) -> Array:
    """(3, height, width) offset and slopes of the background."""
    scale = max(height, width) / 2
    planes = np.ones((3, height, width))
    planes[1] = (np.arange(width) - (width - 1) / 2) / scale
    planes[2] = (np.arange(height)[:, None] - (height - 1) / 2) / scale
    return planes


def background_px(mark: Mark, pixel_from_mark: Array) -> float:
    """The standard deviation of a blur that leaves nothing of the mark's lines."""
    scale = linear_scale(pixel_from_mark)
    return max(1.5 * scale * thinnest_mm(mark), 1.0) + 1.0
