"""Gauss-Newton driver of all fits to images, and the adjustment of one mark in stages: plain, robust, damage masked,
weighted by grain."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Indices, Mask
from measure.flags import NO_REASON, Code, Reason
from measure.marks.rendering import chip_mask, picture, true_mask
from measure.marks.shapes import MarkTemplate
from measure.matching.models import BENT, GREY, QUANTISATION_DN, ROUGHLY_BENT, FitState, PictureModel
from measure.matching.window import ScanWindow, noise_scale
from measure.noise.noise_model import (
    NoiseModel,
    combine,
    correlate,
    gls_weights,
    inner_products,
    may_be_noise,
    steadiness,
)
from measure.noise.robust_estimation import (
    damage,
    dilate_mask,
    gauss_newton_step,
    robust_scale,
    solution,
    tukey_loss,
    tukey_weights,
)

UNSETTLED = Reason("the adjustment did not converge", Code.NO_FIT)
UNDETERMINED = Reason("the picture does not determine the mark's place", Code.NO_FIT)
EDGE_BLURS = 3.0  # in blurs from the frame's border: a thousandth of its step is left beyond

_SCALE_FLOOR = 0.015  # fraction of the contrast, floor of Tukey's scale: clean data would drive it to zero
_DRAWN = 0.001  # fraction of the contrast, accuracy of rendering and linearisation: lower bound of the noise for priors
_FLOOR = 0.005  # fraction of the contrast: smaller residuals may be errors of the drawing
_MOST_DISTORTION = 0.3  # limit of scale, rotation (rad) and shear against the start
_ITERATIONS, _HALVINGS = 15, 4  # fits that need more steps or more halvings do not converge at all
_AREA_PX = 0.5  # px: a larger movement of the mark requires a new area
_LEAST_AREA_PX = 40  # pixels required around a mark
_DAMAGE_SIGMAS = 3.2  # of smoothed residuals: exceeded by one pixel in 700 without damage
_LEAST_VARIANCE_DN2 = 1e-12  # lower bound for images without noise, to divide by
_WEIGHTED_STEPS = 4  # steps with the grain's weights; the place is nearly final before
_CLOSE_PX, _SETTLED_PX = 0.002, 0.02  # px: step that ends the iteration; longest last step accepted as converged
_OUTLINE_BLUR_PX, _SHOWN = 0.3, 0.02  # blur (px) and fraction of the contrast that delimit the mark itself
_GROUND = 0.1  # fraction of the mark's contrast: pixels that show less are background
_OWN = 0.3  # fraction of the mark's contrast: pixels that show more are the mark


class FitModel(ABC):
    """Fits of one model to n images, side by side. It owns their residuals, derivatives, weights and priors.

    Attributes
    ----------
    reasons : why fits failed or did not converge; empty for the others.
    design, residuals : (n, unknowns, pixels) and (n, pixels) at the current states.
    damping : of the steps (`gauss_newton_step`).
    """

    design: NDArray[Any]
    residuals: NDArray[Any]
    damping = 0.0

    def __init__(self, count: int) -> None:
        self.reasons, self.every = [NO_REASON] * count, np.arange(count)

    @abstractmethod
    def step(self, fits: Indices, steps: Array) -> Array:
        """Apply the steps of m fits, linearise there, and give reasons. Returns the movements (m,) of the marks, px."""

    def pixel_weights(self, fits: Indices) -> NDArray[Any]:
        """Weights (m, pixels) of m fits at their states; equal ones by default."""
        return np.ones_like(self.residuals[fits])

    def solve(self, fits: Indices) -> Array:
        """Solve the normal equations of m fits. Returns the steps (m, unknowns), nan if singular."""
        return gauss_newton_step(self.design[fits], self.residuals[fits], self.pixel_weights(fits), self.damping)

    def refuse(self, fits: Indices, reason: Reason) -> None:
        """Give this reason to the fits that have none yet."""
        for number in fits:
            self.reasons[number] = self.reasons[number] or reason


def gauss_newton(model: FitModel, fits: Indices, tolerance_px: float, iterations: int) -> Array:
    """Iterate some fits of a model, each until it moves less than a tolerance or fails.

    Parameters
    ----------
    model : left at its last state, with reasons for the fits that are singular or do not converge.
    fits : (m,) their numbers.
    iterations : maximum number of steps.

    Returns
    -------
    (m,) last movements, px; infinite without a step.
    """
    moved_px, moving = np.full(len(fits), np.inf), np.arange(len(fits))
    for _ in range(iterations):
        steps = model.solve(fits[moving])
        is_regular = np.isfinite(steps).all(axis=1)
        model.refuse(fits[moving[~is_regular]], UNDETERMINED)
        moving, steps = moving[is_regular], steps[is_regular]
        if len(moving):
            moved_px[moving] = model.step(fits[moving], steps)
        goes_on = [not model.reasons[number] for number in fits[moving]]
        moving = moving[(moved_px[moving] >= tolerance_px) & np.array(goes_on, dtype=bool)]
        if not len(moving):
            break
    model.refuse(fits[moving], UNSETTLED)
    return moved_px


class PictureFit(FitModel):
    """Fit of a model to a window in progress.

    Attributes
    ----------
    area : (height, width) usable pixels around the mark.
    used : (height, width) undamaged pixels of the area.
    far : (height, width) pixels farther than plain_px from the mark.
    reason : why the fit failed.
    variance_dn2 : variance of unit weight.
    scale_dn : scale of Tukey's weights; infinite for plain least squares.
    weighted : (unknowns, height, width) derivatives times the grain's weights; None before these are used.
    tolerance_px : movement below which the fit has converged.
    """

    def __init__(self, model: PictureModel, window: ScanWindow) -> None:
        super().__init__(1)
        self.model, self.window, self.options = model, window, model.options
        self.area = self.used = window.usable
        self.far = np.zeros_like(self.area)
        self.variance_dn2, self.scale_dn, self.tolerance_px = 1.0, np.inf, 0.0
        self.weighted: Array | None = None

    @property
    def reason(self) -> Reason:
        return self.reasons[0]

    @reason.setter
    def reason(self, reason: Reason) -> None:
        self.reasons[0] = reason

    @property
    def state(self) -> FitState:
        return self.model.state

    @state.setter
    def state(self, state: FitState) -> None:
        self.model.state = state

    def approach(self) -> None:
        """Adjust by plain least squares, then robustly with a loose tolerance. Sets the reason on failure."""
        model, begun = self.model, self.state
        self.choose_area()
        if not self.reason and np.ptp(model.grey[self.area]) == 0.0:
            self.reason = Reason("the image is uniform there: nothing stands out", Code.CONTRAST)
        model.bent = ROUGHLY_BENT
        self._adjust(0.1)
        if self.reason not in (NO_REASON, UNSETTLED):
            return
        self.reason = NO_REASON  # dust may prevent plain least squares from converging, but not the robust adjustment
        if model.has_moved(begun, _AREA_PX):
            self.choose_area()
        self._adjust(0.05, robust=True)

    def refine(self) -> None:
        """Adjust robustly from there, then mask damage and readjust in rounds."""
        self.model.bent = BENT
        self._adjust(0.005, robust=True)
        for round_ in range(self.options.damage_rounds):
            if self.reason:
                return
            shown, lossy = self.area & self.model.informative, self.window.is_lossy
            undamaged = self.area & ~damage(self.model.residuals, shown, _DAMAGE_SIGMAS, self.floor_dn, lossy)
            if round_ > 0 and np.array_equal(undamaged, self.used):
                return
            self.used = undamaged
            if self.informative.sum() < 3 * len(self.model.design):
                self.reason = Reason("too little of the mark is undamaged", Code.COVERED)
            self._adjust(0.002)

    def choose_area(self) -> None:
        """Select the pixels within margin_px of the mark; farther background only disturbs."""
        height, width = self.model.grey.shape
        mark, place = self.model.mark, self.model.place_drawn()
        if isinstance(mark, MarkTemplate):
            # Where the steadiness of each pixel is known, unsteady ones are weighted instead of masked.
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
        """Iterate until the mark moves less than tolerance_px, unless the fit has failed."""
        if self.reason:
            return
        model, coding = self.model, self.window.coding
        if robust and not (coding.tone.is_identity or model.is_chip):
            # How the noise grows with light, from the current residuals.
            model.linearise(self.used)  # a refit has none of its drawings yet
            drawn, shown = model.drawn_light, np.abs(model.design[-GREY] / model.steadiness)
            ground = shown < _GROUND * shown.max()
            model.take_steadiness(
                steadiness(model.light - drawn, drawn / coding.full_scale_dn, ground, self.informative)
            )
        if model.is_clipped:
            noise_dn = max(robust_scale(model.residuals[self.informative]), QUANTISATION_DN)
            if self.used is not self.area:  # damage is masked: the rest is noise
                least_dn = max(self.floor_dn, QUANTISATION_DN)
                noise_dn = noise_scale(model.uncensored[self.used], model.clipped[self.used], noise_dn, least_dn)
            model.take_noise(noise_dn)
        model.linearise(self.used)
        noise_dn = max(robust_scale(model.residuals[self.informative]), _DRAWN * self.contrast_dn, 1e-9)
        clipping_dn = model.noise_dn if model.is_clipped else 0.0  # noise assumed for clipped grey values
        self.variance_dn2 = max(noise_dn**2, clipping_dn**2)
        self.scale_dn = np.inf
        if robust:
            # Lines thinner than a pixel, or sharpened, deviate from their drawing by far more than the background's
            # noise: by that scale most of the mark would be taken for damage.
            shown = np.abs(model.design[-GREY])
            own = self.informative & (shown > _OWN * shown[self.area].max(initial=0.0))
            misfit_dn = robust_scale(model.residuals[own]) if own.sum() >= _LEAST_AREA_PX else 0.0
            self.scale_dn = max(noise_dn, misfit_dn, _SCALE_FLOOR * self.contrast_dn)
        self.tolerance_px = tolerance_px
        gauss_newton(self, self.every, tolerance_px, _ITERATIONS)

    def solve(self, fits: Indices) -> Array:
        """Solve the normal equations with Tukey's or the grain's weights. A blur at its limit is held fixed there."""
        model, weights = self.model, self.weighted
        if weights is None:
            weights = model.design * (self.used * tukey_weights(model.residuals, self.scale_dn))
        priors = model.prior_weights * self.variance_dn2
        normal = inner_products(weights, model.design) + np.diag(priors)
        right = inner_products(weights, model.residuals[None])[:, 0] - priors * model.departures
        free = np.ones(len(right), dtype=bool)
        step = solution(normal, right, free)
        if model.blur_is_held(step):
            free[model.blur] = False
            step = solution(normal, right, free)
        return step[None]

    def step(self, fits: Indices, steps: Array) -> Array:
        """Apply a step, halved where it does not reduce the cost, whole with the grain's weights, and linearise there.
        Sets the reason if the state is not acceptable."""
        moved_px = self._descend(steps[0]) if self.weighted is None else self._move(steps[0])
        self.reason = self.failure()
        return np.array([moved_px])

    def _move(self, step: Array) -> float:
        moved_px = self.model.step(step)
        self.model.linearise(self.used)
        return moved_px

    def _descend(self, step: Array) -> float:
        """Move by a step, halved until it reduces the cost; by none if no part does and the last one was short."""
        before, cost_before = self.state, self.cost()
        moved_px = self._move(step)
        if moved_px < self.tolerance_px:
            return moved_px
        for _ in range(_HALVINGS):
            if self.cost() <= cost_before:
                return moved_px
            step, self.state = step / 2, before
            moved_px = self._move(step)
        if self.cost() > cost_before and float(np.hypot(*step[:2])) < self.tolerance_px:
            # Size, blur and contrast are correlated here: the cost is flat at the minimum.
            self.state = before
            return self._move(np.zeros_like(step))
        return moved_px

    def failure(self) -> Reason:
        """Reason why the state is not acceptable: too far from the start or too distorted."""
        moved = float(np.hypot(*(self.state.pixel_from_mark[:, 2] - self.model.start[:, 2])))
        if moved > self.options.max_shift_px:
            return Reason(f"the fit ran {moved:.1f} px away from where the mark was expected", Code.NO_FIT)
        if np.abs(self.model.distortion).max() > _MOST_DISTORTION:
            return Reason("the fitted size or rotation differs too much from the drawing", Code.SIZE)
        return NO_REASON

    def cost(self) -> float:
        """Tukey's loss plus that of the priors."""
        priors = np.sum(self.model.prior_weights * self.model.departures**2)
        return float(tukey_loss(self.model.residuals * self.used, self.scale_dn) + self.variance_dn2 * priors)

    def weigh(self, noise: NoiseModel) -> tuple[Array, Array]:
        """Adjust once more by generalised least squares if the noise is grain.

        Returns
        -------
        The covariance of the unknowns (unknowns, unknowns), and their derivatives with respect to the grey values
        (unknowns, height, width).
        """
        if not noise.is_grain:
            return self._plain_covariance(noise)
        model, before = self.model, self.state
        start = before.pixel_from_mark[:, 2]
        self.weighted, smeared = gls_weights(model.design, self.used, noise, self.contrast_dn)
        self.variance_dn2, held = 1.0, self.variance_dn2
        moved_px = float(gauss_newton(self, self.every, _CLOSE_PX, _WEIGHTED_STEPS)[0])
        settled, self.reason = moved_px < _SETTLED_PX and not self.failure(), NO_REASON
        self.variance_dn2, moved = held, np.asarray(self.state.pixel_from_mark[:, 2] - start)
        if settled:
            by_grain = self._covariance(self.weighted, smeared)
            # Accept the weighted place only if it agrees with the unweighted one; otherwise the noise model is wrong.
            # The plain covariance decides, but is slow to compute and nearly always larger: try the weighted one first.
            if may_be_noise(moved, by_grain[0][:2, :2]) or may_be_noise(
                moved, self._plain_covariance(noise)[0][:2, :2]
            ):
                return by_grain
        self.state = before
        model.linearise(self.used)
        covariance, by_grey = self._plain_covariance(noise)
        if settled:  # e.g. a hair along a line: the difference bounds the accuracy of both places
            covariance[:2, :2] += np.sum(moved**2) / 2 * np.eye(2)
        return covariance, by_grey

    def _plain_covariance(self, noise: NoiseModel) -> tuple[Array, Array]:
        """Covariance and derivatives, as of `weigh`, of the adjustment with weights for white noise."""
        variance = max(noise.variance_dn2, _LEAST_VARIANCE_DN2)
        design, bent = self.model.design * self.used, np.sqrt(self.model.curvature)
        plain = design * bent / variance  # residuals scaled to their information
        smeared = plain * variance if noise.is_white else correlate(plain, noise) * self.used
        return self._covariance(plain * bent, smeared / bent, self.variance_dn2 / variance)

    def _covariance(self, weights: Array, smeared: Array, held: float = 1.0) -> tuple[Array, Array]:
        """Covariance and derivatives, as of `weigh`, from weighted derivatives and the product of the noise covariance
        with them. held: factor of the priors' weights in the adjustment relative to their variances."""
        priors = np.diag(self.model.prior_weights)
        inverse: Array = np.asarray(np.linalg.inv(inner_products(weights, self.model.design) + held * priors))
        covariance = np.asarray(inverse @ (inner_products(weights, smeared) + held**2 * priors) @ inverse.T)
        if not np.all(np.linalg.eigvalsh(covariance[:2, :2] + covariance[:2, :2].T) > 0):
            covariance = inverse  # the estimated lags are noisy: fall back to white noise
        return np.asarray((covariance + covariance.T) / 2), combine(inverse, weights)

    @property
    def contrast_dn(self) -> float:
        """Absolute contrast of the mark."""
        return abs(self.model.contrast_dn)

    @property
    def floor_dn(self) -> float:
        """Grey value below which residuals may be errors of the drawing."""
        return _FLOOR * self.contrast_dn

    @property
    def informative(self) -> Mask:
        """Mask of the used pixels whose residuals carry information on the noise."""
        return self.used & self.model.informative

    @property
    def damaged_fraction(self) -> float:
        """Fraction of the pixels within plain_px of the mark that are damaged or adjacent to damage."""
        near, damaged = self.area & ~self.far, self.area & ~self.used
        near_damage = damaged if self.window.is_lossy else dilate_mask(damaged)
        return float((near & near_damage).sum() / max(near.sum(), 1))

    @property
    def lost_fraction(self) -> float:
        """Fraction of the place's information lost to damage, in the direction with the largest loss."""
        if not np.any(self.area & ~self.used):
            return 0.0
        priors = np.diag(self.model.prior_weights) * self.variance_dn2
        by_all, by_used = (
            np.linalg.inv(design @ design.T + priors)[:2, :2]
            for design in (self.model.design[:, pixels] for pixels in (self.area, self.used))
        )
        return 1.0 - float(1 / np.linalg.eigvals(by_used @ np.linalg.inv(by_all)).real.max())
