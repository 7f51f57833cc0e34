"""Information of a mark's fit on the tone curve and on sharpening, and the derivatives of its place by both."""

from dataclasses import replace

import numpy as np

from measure.array_types import Array, Mask
from measure.matching.covariance import BackgroundTexture, LinearFit
from measure.matching.gauss_newton import PictureFit
from measure.matching.models import GREY, PictureModel
from measure.noise.noise_model import combine, inner_products
from measure.tone.curve import ToneInformation
from measure.tone.estimate import MarkTone, ToneScore, tone_score
from measure.tone.sharpening import SharpeningScore

_PIECE_PX = 8  # px, side of the squares compared with one another, equal to the blocks of JPEG
_LEAST_CONTRAST = 1e-6  # fraction of the modelled light: a smaller contrast is numerical rounding
_CLEAR = 3.0  # noise standard deviations between the model and a clipping limit
_LEAST_VARIANCE = 1e-9  # floor of the score's variance relative to that of the departures


def mark_tone_information(
    fit: PictureFit, linear: LinearFit, background: BackgroundTexture, by_width: Array
) -> MarkTone | None:
    """Compute the information of a fit on the tone curve, with the fit's unknowns eliminated.

    The derivatives by the curve are taken at the modelled light; at the observed one they would be correlated with the
    noise. Uneven light on the mark or around it could be mistaken for the curve, so gradients and curvatures of both
    are further unknowns. The shift of the mark by another curve is computed from the observed light, including all that
    the model does not explain.

    Parameters
    ----------
    linear : the fit, linearised at its solution.
    background : texture within the mark.
    by_width : (n, height, width) derivatives by the width of lines, further unknowns. Otherwise the curve would explain
        lines that are narrower or wider than drawn.

    Returns
    -------
    MarkTone, without information where only the detail of the mark was fitted, since its background is not modelled.
    None if the curve is known, or for a chip, which comes from scans with the same curve.
    """
    model, tone, full_scale_dn = fit.model, fit.window.coding.tone, fit.window.coding.full_scale_dn
    if tone.is_known or model.is_chip:
        return None
    is_whole, changes = model.background_px is None, tone.derivatives(model.light, full_scale_dn)
    if not is_whole:
        changes = np.stack([model.detail(each) for each in changes])
    on_place, information = _moved_px(linear, changes), ToneInformation.empty()
    drawn = model.drawn_light if is_whole else model.light
    if is_whole and _has_contrast(drawn):
        within = replace(
            linear, used=linear.used & _clear_of_ends(model), noise=linear.noise.raise_variance(fit.floor_dn**2)
        )
        uneven = np.concatenate([_uneven(linear.design[-GREY], linear.steadiness), by_width])
        changes = tone.derivatives(drawn, full_scale_dn) * within.used * linear.steadiness
        priors_dn2 = model.prior_weights * linear.noise.variance_dn2
        score, left, covariance = _score(within, changes, priors_dn2, model.departures, uneven)
        covariance += background.covariance(left) + _least_variances(within, changes).sum() * np.eye(len(left))
        covariance *= _disagreement(score, left, np.where(within.used, linear.residuals, 0.0), covariance, on_place)
        information = score.information(covariance, tone)
    codes = tone.code(np.quantile(drawn[linear.used], (0.0, 1.0)), full_scale_dn) / full_scale_dn
    return MarkTone(information, on_place, float(codes[0]), float(codes[1]))


def sharpening_score(fit: PictureFit, linear: LinearFit, by_width: Array) -> SharpeningScore | None:
    """Score the scan's sharpening together with the tone curve, as in `mark_tone_information`. None where the
    background is not modelled or the model has no contrast. Pixels masked as damage are included, since halos are taken
    for damage until they are modelled."""
    model, tone, full_scale_dn = fit.model, fit.window.coding.tone, fit.window.coding.full_scale_dn
    needs_sharpening = model.options.estimate_sharpening or tone.sharpening
    if not needs_sharpening or model.background_px is not None or model.is_chip:
        return None
    drawn = model.drawn_light
    if not _has_contrast(drawn):
        return None
    linear = replace(linear, used=fit.area & model.informative & _clear_of_ends(model))
    halos = tone.sharpening.changes(tone.code(drawn, full_scale_dn))
    # Sign: light by a wrong curve lacks the departure, whereas sharpening adds halos to it.
    halos = -tone.slope(drawn, full_scale_dn) * halos
    changes = np.concatenate([tone.derivatives(drawn, full_scale_dn), halos]) * (linear.used * linear.steadiness)
    priors_dn2 = model.prior_weights * linear.noise.variance_dn2
    score, _, covariance = _score(linear, changes, priors_dn2, model.departures, by_width)
    covariance += np.diag(_least_variances(linear, changes))
    return SharpeningScore(score.value, score.normal, covariance, _moved_px(linear, halos), tone.sharpening)


def _has_contrast(drawn: Array) -> bool:
    return bool(np.ptp(drawn) > _LEAST_CONTRAST * np.abs(drawn).max())


def _clear_of_ends(model: PictureModel) -> Mask:
    """(height, width) mask of pixels whose modelled value lies so far from the clipping limits that noise is not cut
    off, which changes an edge as a curve does."""
    drawn, ends = model.drawn_light, model.clipped
    clear = np.ones(drawn.shape, dtype=bool)
    for side in (1, -1):
        if np.any(ends == side):
            clear &= side * (model.grey[ends == side].mean() - drawn) > _CLEAR * model.noise_dn
    return clear


def _score(
    fit: LinearFit, changes: Array, priors_dn2: Array, departures: Array, uneven: Array
) -> tuple[ToneScore, Array, Array]:
    """Score of changes (k, height, width) of the used light, what the unknowns leave of these, its covariance (k, k).
    uneven (m, height, width): derivatives by further unknowns."""
    design = np.concatenate([fit.design, uneven]) * fit.used
    priors, departures = (np.append(each, np.zeros(len(uneven))) for each in (priors_dn2, departures))
    residuals = np.where(fit.used, fit.residuals, 0.0).ravel()
    flat, flat_changes = (images.reshape(len(images), -1) for images in (design, changes))
    score = tone_score(flat, flat_changes, residuals, priors, departures)
    left, by_prior = score.left.reshape(changes.shape), score.by_unknown * np.sqrt(priors)[:, None]
    return score, left, fit.covariance(left) + fit.noise.variance_dn2 * by_prior.T @ by_prior


def _least_variances(fit: LinearFit, changes: Array) -> Array:
    """(k,) floor of a score's variances: of a departure that the unknowns absorb only rounding errors are left."""
    return np.asarray(np.maximum(_LEAST_VARIANCE * fit.noise.variance_dn2 * np.sum(changes**2, axis=(1, 2)), 1e-39))


def _disagreement(score: ToneScore, left: Array, residuals: Array, covariance: Array, on_place: Array) -> float:
    """Variance factor (at least 1) of the score, from the disagreement of the pieces of the mark's edges.

    Each piece gives an estimate of the curve's effect on the place. If they scatter by more than the noise, the edges
    are not as drawn.
    """
    weighted = np.linalg.solve(covariance, score.normal).T
    estimate: Array = np.asarray(np.linalg.inv(np.eye(len(covariance)) + weighted @ score.normal) @ weighted, float)
    moved = on_place @ estimate
    images = left * (residuals + combine(estimate @ score.value, left))
    count, height, width = images.shape
    whole = np.pad(images, ((0, 0), (0, -height % _PIECE_PX), (0, -width % _PIECE_PX)))
    squares = whole.reshape(count, whole.shape[1] // _PIECE_PX, _PIECE_PX, -1, _PIECE_PX)
    by_piece = moved @ squares.sum(axis=(2, 4)).reshape(count, -1)
    return max(float(np.sum(by_piece**2) / max(np.trace(moved @ covariance @ moved.T), 1e-30)), 1.0)


def _moved_px(fit: LinearFit, changes: Array) -> Array:
    """(2, k) derivatives of the place with respect to the departures. changes (k, height, width): those of the fitted
    light."""
    return inner_products(fit.by_grey[:2], changes * fit.used * fit.steadiness)


def _uneven(shown: Array, about: Array) -> Array:
    """(8, height, width) derivatives by gradients and curvatures of the light on a mark, and by curvatures of that
    around it. shown, about (height, width): the rendered mark and 1, times the steadiness."""
    height, width = shown.shape
    col = np.broadcast_to(np.linspace(-1.0, 1.0, width), shown.shape)
    row = np.broadcast_to(np.linspace(-1.0, 1.0, height)[:, None], shown.shape)
    bends = [col * col, col * row, row * row]
    return np.stack([*(shown * each for each in (col, row, *bends)), *(about * each for each in bends)])
