"""The one Gauss-Newton driver, and one mark's adjustment by it: plain, robust, undamaged, weighted by the grain."""

from dataclasses import replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np

from measure.array_types import Array, Mask
from measure.flags import NO_REASON, Code, Reason
from measure.marks.rendering import chip_mask, picture, true_mask
from measure.marks.shapes import MarkTemplate
from measure.matching.models import BENT, GREY, ROUGHLY_BENT, ROUNDING_DN, PictureModel, State
from measure.matching.saturation import noise_scale
from measure.matching.window import ScanWindow
from measure.noise.damage import damage, grown
from measure.noise.noise_model import NoiseModel, combined, correlated, may_be_noise, products, steadiness, weighted
from measure.noise.robust_estimation import robust_scale, solution, tukey_loss, tukey_weights

UNSETTLED = Reason("the adjustment did not converge", Code.NO_FIT)
UNDETERMINED = Reason("the picture does not determine the mark's place", Code.NO_FIT)
EDGE_BLURS = 3.0  # from the frame's border, in which a mark ends: a thousandth of its step is seen farther off

_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale: without it clean data drive it to nothing
_DRAWN = 0.001  # of the contrast: a picture is drawn and linearised no better, which no prior must give way to
_FLOOR = 0.005  # of the contrast: residuals below it may be the drawing's own
_ITERATIONS, _HALVINGS = 15, 4  # more steps, or shorter ones, settle no fit that these do not
_AREA_PX = 0.5  # of the margin: by so much an area may be another one
_LEAST_AREA_PX = 40  # pixels about a mark
_DAMAGE_SIGMAS = 3.2  # of smoothed residuals: one pixel in seven hundred of a window without damage goes beyond
_PLAIN, _PLAIN_SHARE = 2.0, 0.7  # times the variance, that grain may feign; and how much of it may be damaged
_LEAST_VARIANCE_DN2 = 1e-12  # of a picture without noise, to divide by
_ROUNDING_VARIANCE = 1 / 12  # of evenly spread light less the number it is rounded to, in steps
_WEIGHTED_STEPS = 4  # by the grain's weights: the place is nearly right before
_CLOSE_PX, _SETTLED_PX = 0.002, 0.02  # a last step that needs no further one; the longest that may be the last
_OUTLINE_BLUR_PX, _SHOWN = 0.3, 0.02  # what counts as the mark itself
_GROUND = 0.1  # of the mark: what shows less is its ground


class Model(Protocol):
    """What is fitted to a picture: residuals, derivatives, weights and priors are its own."""

    def solve(self) -> Array | None:
        """The step (unknowns,) by the normal equations of the present state, None where they are singular."""

    def step(self, step: Array) -> float:
        """Take a step and linearise there; how far the mark moved, px."""

    def failure(self) -> Reason:
        """Why the present state is no solution, empty where it may be one."""


@runtime_checkable
class ReversibleModel(Protocol):
    """A model whose steps may be halved. state: what a step replaces."""

    state: Any

    def step(self, step: Array) -> float:
        """As `Model.step`."""

    def cost(self) -> float:
        """What the steps make small."""


class Outcome(NamedTuple):
    """reason: why the model did not come to rest, empty where it did; moved_px: the length of the last step."""

    reason: Reason
    moved_px: float


def gauss_newton(model: Model, tolerance_px: float, iterations: int, halvings: int = 0) -> Outcome:
    """Step a model until it moves less than a tolerance.

    Parameters
    ----------
    model : Model
        Is left at its last state.
    tolerance_px : float
        A step shorter than it is the last.
    iterations : int
        Steps at most.
    halvings : int
        How often a step of a `ReversibleModel` is halved, at most, as long as it does not lessen the cost.

    Returns
    -------
    Outcome
    """
    outcome = Outcome(UNSETTLED, np.inf)
    for _ in range(iterations):
        step = model.solve()
        if step is None:
            return Outcome(UNDETERMINED, outcome.moved_px)
        if halvings and isinstance(model, ReversibleModel):
            outcome = Outcome(UNSETTLED, _halved_step(model, step, tolerance_px, halvings))
        else:
            outcome = Outcome(UNSETTLED, model.step(step))
        reason = model.failure()
        if reason or outcome.moved_px < tolerance_px:
            return Outcome(reason, outcome.moved_px)
    return outcome


def _halved_step(model: ReversibleModel, step: Array, tolerance_px: float, halvings: int) -> float:
    """Take a step, or the part of it that lessens the cost; none where no part does and the last was short."""
    before, cost_before = model.state, model.cost()
    moved_px = model.step(step)
    if moved_px < tolerance_px:
        return moved_px
    for _ in range(halvings):
        if model.cost() <= cost_before:
            return moved_px
        step, model.state = step / 2, before
        moved_px = model.step(step)
    if model.cost() > cost_before and float(np.hypot(*step[:2])) < tolerance_px:
        # Where size, blur and contrast hang together the cost ends flat.
        model.state = before
        return model.step(np.zeros_like(step))
    return moved_px


class PictureFit:
    """The fit of a model to a window in progress. area: the pixels about the mark that are there; used: those of them
    that are undamaged; reason: why it failed. variance_dn2: of a pixel whose weight is 1; scale_dn: of Tukey's weights,
    infinite for squares; weighted (unknowns, height, width): derivatives times the grain's weights, None before."""

    def __init__(self, model: PictureModel, window: ScanWindow) -> None:
        self.model, self.window, self.options = model, window, model.options
        self.area = self.used = window.usable
        self.far = np.zeros_like(self.area)
        self.variance_dn2, self.scale_dn = 1.0, np.inf
        self.weighted: Array | None = None
        self.reason = NO_REASON

    @property
    def state(self) -> State:
        """The model's."""
        return self.model.state

    @state.setter
    def state(self, state: State) -> None:
        self.model.state = state

    def approach(self) -> None:
        """Plain, then roughly robust; stops with a reason where something gives way."""
        model, begun = self.model, self.state
        self.choose_area()
        if not self.reason and np.ptp(model.grey[self.area]) == 0.0:
            self.reason = Reason("the picture is even there: nothing stands out", Code.CONTRAST)
        if self.reason:
            return
        model.bent = ROUGHLY_BENT
        self._adjust(0.1)
        if self.reason not in (NO_REASON, UNSETTLED):
            return
        self.reason = NO_REASON  # dust may keep squares from settling, and not what holds against it
        if model.has_moved(begun, _AREA_PX):
            self.choose_area()
        self._adjust(0.05, robust=True)

    def refine(self) -> None:
        """Robust from there, then on what is undamaged."""
        self.model.bent = BENT
        self._adjust(0.005, robust=True)
        for round_ in range(self.options.damage_rounds):
            if self.reason:
                return
            shown, lossy = self.area & self.model.tells, self.window.is_lossy
            undamaged = self.area & ~damage(self.model.residuals, shown, _DAMAGE_SIGMAS, self.floor_dn, lossy)
            if round_ > 0 and np.array_equal(undamaged, self.used):
                return
            self.used = undamaged
            if self.telling.sum() < 3 * len(self.model.design):
                self.reason = Reason("too little of the mark is undamaged", Code.COVERED)
            elif round_ == 0 and not self._is_plain():
                self.reason = Reason("the background of the mark is not uniform", Code.NO_FIT)
            self._adjust(0.002)

    def choose_area(self) -> None:
        """The pixels within margin_px of the mark: beyond it the background only disturbs."""
        height, width = self.model.grey.shape
        mark, place = self.model.mark, self.model.place_drawn()
        if isinstance(mark, MarkTemplate):
            # Where it is known how steady each pixel is, those count by it that are not.
            own = near = chip_mask(
                mark if mark.steadiness is None else replace(mark, steady=None), place, width, height
            )
        else:
            outside = (picture(mark, place, width, height, _OUTLINE_BLUR_PX) < _SHOWN).astype(np.uint8)
            distance = cv2.distanceTransform(outside, cv2.DIST_L2, 5)
            own, near = distance == 0, distance <= self.options.margin_px
            self.far = distance > self.options.plain_px
            if outside.all():
                self.reason = Reason("the mark lies outside of its window", Code.NO_FIT)
        near = near & true_mask(mark, place, width, height, EDGE_BLURS * self.model.total_blur_px)
        self.area = self.used = self.window.usable & near
        if (self.area & own).sum() < 0.5 * (near & own).sum() or self.area.sum() < _LEAST_AREA_PX:
            hardly = "most of the mark lies outside of the scan, or beyond an edge far stronger than it"
            self.reason = self.reason or Reason(hardly, Code.OUTSIDE)

    def _adjust(self, tolerance_px: float, robust: bool = False) -> None:
        """Gauss-Newton until the mark moves less than tolerance_px, unless something gave way before."""
        if self.reason:
            return
        model = self.model
        if robust:
            self._take_steadiness()
        if model.is_clipped:
            noise_dn = max(robust_scale(model.residuals[self.telling]), ROUNDING_DN)
            if self.used is not self.area:  # damage is cut out: what is left is noise
                least_dn = max(self.floor_dn, ROUNDING_DN)
                noise_dn = noise_scale(model.uncensored[self.used], model.clipped[self.used], noise_dn, least_dn)
            model.take_noise(noise_dn)
        model.linearise(self.used)
        noise_dn = max(robust_scale(model.residuals[self.telling]), _DRAWN * self.contrast_dn, 1e-9)
        clipping_dn = model.noise_dn if model.is_clipped else 0.0  # what clipped grey values were judged by
        self.variance_dn2 = max(noise_dn**2, clipping_dn**2)
        self.scale_dn = max(noise_dn, _SCALE_FLOOR * self.contrast_dn) if robust else np.inf
        self.reason = gauss_newton(self, tolerance_px, _ITERATIONS, _HALVINGS).reason

    def _take_steadiness(self) -> None:
        """Take into account by how much noise grows with light, as the residuals of the present state show it."""
        model, coding = self.model, self.window.coding
        if not (coding.tone.is_identity or model.is_chip):
            drawn, shown = model.drawn_light, np.abs(model.design[-GREY] / model.steadiness)
            ground = shown < _GROUND * shown.max()
            model.take_steadiness(steadiness(model.light - drawn, drawn / coding.full_scale_dn, ground, self.telling))

    def solve(self) -> Array | None:
        """The step by Tukey's or the grain's weights; a blur at its limit stays there instead of pulling the others."""
        model, weights = self.model, self.weighted
        if weights is None:
            weights = model.design * (self.used * tukey_weights(model.residuals, self.scale_dn))
        priors = model.prior_weights * self.variance_dn2
        normal = products(weights, model.design) + np.diag(priors)
        right = products(weights, model.residuals[None])[:, 0] - priors * model.departures
        free = np.ones(len(right), dtype=bool)
        step = solution(normal, right, free)
        if step is not None and model.blur_is_held(step):
            free[model.blur] = False
            step = solution(normal, right, free)
        return step

    def step(self, step: Array) -> float:
        """Take a step and linearise there."""
        moved_px = self.model.step(step)
        self.model.linearise(self.used)
        return moved_px

    def failure(self) -> Reason:
        """Why the mark is none where one was expected."""
        return self.model.ran_away()

    def cost(self) -> float:
        """Tukey's loss, and the priors'."""
        priors = np.sum(self.model.prior_weights * self.model.departures**2)
        return float(tukey_loss(self.model.residuals * self.used, self.scale_dn) + self.variance_dn2 * priors)

    def weigh(self, noise: NoiseModel) -> tuple[Array, Array]:
        """Adjust once more with the weights of grain, if it is grain: the unknowns' covariance (unknowns, unknowns),
        and their derivatives by the grey values (unknowns, height, width)."""
        if not noise.is_grain:
            return self._plain_covariance(noise)
        model, before = self.model, self.state
        start = before.pixel_from_mark[:, 2]
        self.weighted, smeared = weighted(model.design, self.used, noise, self.contrast_dn)
        self.variance_dn2, held = 1.0, self.variance_dn2
        settled = gauss_newton(self, _CLOSE_PX, _WEIGHTED_STEPS).moved_px < _SETTLED_PX and not model.ran_away()
        self.variance_dn2, moved = held, np.asarray(self.state.pixel_from_mark[:, 2] - start)
        if settled:
            by_grain = self._covariance(self.weighted, smeared)
            # What has more weight now measures the same place, or the noise is not what it was taken for. The plain
            # covariance, which decides, takes its time and is larger than the weighed one, but for approximations.
            if may_be_noise(moved, by_grain[0][:2, :2]) or may_be_noise(
                moved, self._plain_covariance(noise)[0][:2, :2]
            ):
                return by_grain
        self.state = before
        model.linearise(self.used)
        covariance, by_grey = self._plain_covariance(noise)
        if settled:  # a hair along a line, say: neither place is known better than they differ
            covariance[:2, :2] += np.sum(moved**2) / 2 * np.eye(2)
        return covariance, by_grey

    def _plain_covariance(self, noise: NoiseModel) -> tuple[Array, Array]:
        """As `weigh` gives them, of an adjustment that took the noise as white."""
        variance = max(noise.variance_dn2, _LEAST_VARIANCE_DN2)
        design, bent = self.model.design * self.used, np.sqrt(self.model.curvature)
        plain = design * bent / variance  # of residuals that are as large as their information says
        smeared = plain * variance if noise.is_white else correlated(plain, noise) * self.used
        return self._covariance(plain * bent, smeared / bent, self.variance_dn2 / variance)

    def _covariance(self, weights: Array, smeared: Array, held: float = 1.0) -> tuple[Array, Array]:
        """As `weigh` gives them, from weighted derivatives and the noise's covariance matrix times these. held: how
        many times as much as their variances say the priors counted."""
        priors = np.diag(self.model.prior_weights)
        inverse: Array = np.asarray(np.linalg.inv(products(weights, self.model.design) + held * priors))
        covariance = np.asarray(inverse @ (products(weights, smeared) + held**2 * priors) @ inverse.T)
        if not np.all(np.linalg.eigvalsh(covariance[:2, :2] + covariance[:2, :2].T) > 0):
            covariance = inverse  # lags that are noise themselves: as if it were white
        return np.asarray((covariance + covariance.T) / 2), combined(inverse, weights)

    @property
    def contrast_dn(self) -> float:
        """Of a mark darker than its ground, too."""
        return abs(self.model.contrast_dn)

    @property
    def floor_dn(self) -> float:
        """Residuals that tell nothing of the film."""
        return _FLOOR * self.contrast_dn

    @property
    def rounding_variance_dn2(self) -> float:
        """What rounding to whole grey values adds to the noise; 0 where they were compressed or smoothed since."""
        model = self.model
        ordinary = self.used & (model.clipped == 0)
        is_whole = not (self.window.is_lossy or model.is_chip) and model.background_px is None
        steps = self.window.coding.steps_dn(ordinary) if is_whole else None
        return 0.0 if steps is None else _ROUNDING_VARIANCE * float(np.mean((steps * model.steadiness)[ordinary] ** 2))

    @property
    def telling(self) -> Mask:
        """The pixels used whose residuals say how large the noise is."""
        return self.used & self.model.tells

    @property
    def damaged_fraction(self) -> float:
        """Of the pixels about the mark, as far as the ground has to be plain there: those on damage or next to it."""
        near = self.area & ~self.far
        return 1.0 - float((near & self._clear).sum() / max(near.sum(), 1))

    @property
    def lost_fraction(self) -> float:
        """What lies on damage of what the picture tells of the place, in the direction in which least is left."""
        if not np.any(self.area & ~self.used):
            return 0.0
        priors = np.diag(self.model.prior_weights) * self.variance_dn2
        by_all, by_used = (
            np.linalg.inv(design @ design.T + priors)[:2, :2]
            for design in (self.model.design[:, pixels] for pixels in (self.area, self.used))
        )
        return 1.0 - float(1 / np.linalg.eigvals(by_used @ np.linalg.inv(by_all)).real.max())

    @property
    def _clear(self) -> Mask:
        """The pixels used that do not touch damage."""
        return self.used if self.window.is_lossy else self.used & ~grown(self.area & ~self.used)

    def _is_plain(self) -> bool:
        """Whether undamaged pixels far from the mark vary as the nearer ones do."""
        near, far = self._clear & ~self.far, self._clear & self.far
        squares = self.model.residuals**2
        plain = far.sum() >= _PLAIN_SHARE * (self.area & self.far).sum()
        return bool(
            not far.any() or (plain and squares[far].mean() < _PLAIN * (squares[near].mean() + self.floor_dn**2))
        )
