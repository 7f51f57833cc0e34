"""Information of a mark's fit on the tone curve, and the derivatives of its place with respect to the curve."""

from collections.abc import Callable

import numpy as np

from measure.array_types import Array, Mask
from measure.matching.covariance import Landscape, LinearFit
from measure.matching.models import GREY
from measure.matching.window import Coding
from measure.noise.noise_model import combined, products
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import MarkTone, ToneScore, tone_score
from measure.tone.sharpening import SharpeningScore

_PIECE_PX = 8  # px, side of the squares compared with one another, equal to the blocks of JPEG
_LEAST_CONTRAST = 1e-6  # fraction of the modelled light: a smaller contrast is numerical rounding
_LEAST_VARIANCE = 1e-9  # floor of the score's variance relative to that of the departures


def mark_tone_information(
    fit: LinearFit,
    drawn: Array,
    grey: Array,
    clear: Mask,
    priors_dn2: Array,
    departures: Array,
    tone: Tone,
    full_scale_dn: float,
    landscape: Landscape,
) -> MarkTone:
    """Compute the information of a linearised fit on the tone curve, with the fit's unknowns eliminated.

    The derivatives by the curve are taken at the modelled light; at the observed one they would be correlated with the
    noise. Uneven light on the mark or around it could be mistaken for the curve, so gradients and curvatures of both
    are further unknowns. The shift of the mark by another curve is computed from the observed light, including all that
    the model does not explain.

    Parameters
    ----------
    drawn, grey : (height, width) modelled and observed light.
    clear : (height, width) mask of pixels far from the ends of the scanner's range. Near an end noise is cut off, which
        changes an edge as a curve does.
    priors_dn2, departures : (unknowns,) see `tone_score`.
    landscape : background texture within the mark.
    """
    on_place = _moved_px(fit, tone.derivatives(grey, full_scale_dn))
    information = ToneInformation.empty()
    if np.ptp(drawn) > _LEAST_CONTRAST * np.abs(drawn).max():  # otherwise the model has no edges
        counts = fit.used & clear
        uneven = _uneven(fit.design[-GREY], fit.steadiness)
        design = np.concatenate([fit.design, uneven]) * counts
        changes = tone.derivatives(drawn, full_scale_dn) * counts * fit.steadiness
        residuals = np.where(counts, fit.residuals, 0.0)
        priors = np.append(priors_dn2, np.zeros(len(uneven)))
        departures = np.append(departures, np.zeros(len(uneven)))
        flat, flat_changes = (images.reshape(-1, counts.size) for images in (design, changes))
        score = tone_score(flat, flat_changes, residuals.ravel(), priors, departures)
        left, by_prior = score.left.reshape(changes.shape), score.by_unknown * np.sqrt(priors)[:, None]
        covariance = fit.covariance(left) + landscape.covariance(left) + fit.noise.variance_dn2 * by_prior.T @ by_prior
        # Where the fit's unknowns absorb a departure completely only numerical rounding is left: give it no weight.
        whole = fit.noise.variance_dn2 * float(np.sum(changes**2))
        covariance += _LEAST_VARIANCE * max(whole, 1e-30) * np.eye(len(covariance))
        covariance *= _disagreement(score, left, residuals, covariance, on_place)
        information = score.information(covariance, tone)
    return _mark_tone(fit, information, on_place, drawn, tone, full_scale_dn)


def tone_without_information(
    fit: LinearFit, light: Array, detail: Callable[[Array], Array], tone: Tone, full_scale_dn: float
) -> MarkTone:
    """Effect of the curve on a mark of which only the detail was fitted. It gives no information on the curve, since
    its background is not modelled. light (height, width): with background; detail: subtracts the background."""
    changes = np.stack([detail(each) for each in tone.derivatives(light, full_scale_dn)])
    return _mark_tone(fit, ToneInformation.empty(), _moved_px(fit, changes), light, tone, full_scale_dn)


def sharpening_score(
    fit: LinearFit, drawn: Array, priors_dn2: Array, departures: Array, coding: Coding
) -> SharpeningScore | None:
    """Score the scan's sharpening together with the tone curve, with the fit's unknowns eliminated.

    Parameters
    ----------
    fit : its mask used includes halos.
    drawn : (height, width) modelled light.
    priors_dn2, departures : (unknowns,) see `tone_score`.
    coding : relation of light to stored grey values.

    Returns
    -------
    SharpeningScore, or None where the model has no contrast.
    """
    if not np.ptp(drawn) > _LEAST_CONTRAST * np.abs(drawn).max():
        return None
    tone, full_scale_dn, used = coding.tone, coding.full_scale_dn, fit.used
    codes, slope = tone.code(drawn, full_scale_dn), tone.slope(drawn, full_scale_dn)
    halos = tone.sharpening.changes(codes)
    # Sign: light by a wrong curve lacks the departure, whereas sharpening adds halos to it.
    changes = np.concatenate([tone.derivatives(drawn, full_scale_dn), -slope * halos]) * (used * fit.steadiness)
    flat = fit.design.reshape(len(fit.design), -1) * used.ravel()
    residuals = np.where(used, fit.residuals, 0.0).ravel()
    score = tone_score(flat, changes.reshape(len(changes), -1), residuals, priors_dn2, departures)
    left, by_prior = score.left.reshape(changes.shape), score.by_unknown * np.sqrt(priors_dn2)[:, None]
    covariance = fit.covariance(left) + fit.noise.variance_dn2 * by_prior.T @ by_prior
    whole = fit.noise.variance_dn2 * np.sum(changes**2, axis=(1, 2))
    covariance += np.diag(_LEAST_VARIANCE * np.maximum(whole, 1e-30))
    on_place = products(fit.by_grey[:2], changes[-len(halos) :])
    return SharpeningScore(score.value, score.normal, covariance, on_place)


def _disagreement(score: ToneScore, left: Array, residuals: Array, covariance: Array, on_place: Array) -> float:
    """Variance factor (at least 1) of the score, from the disagreement of the pieces of the mark's edges.

    Each piece gives an estimate of the curve's effect on the place. If they scatter by more than the noise, the edges
    are not as drawn.
    """
    weighted = np.linalg.solve(covariance, score.normal).T
    estimate: Array = np.asarray(np.linalg.inv(np.eye(len(covariance)) + weighted @ score.normal) @ weighted, float)
    moved = on_place @ estimate
    by_piece = moved @ _piece_sums(left * (residuals + combined(estimate @ score.value, left)))
    return max(float(np.sum(by_piece**2) / max(np.trace(moved @ covariance @ moved.T), 1e-30)), 1.0)


def _piece_sums(images: Array) -> Array:
    """(k, pieces) sums of images (k, height, width) over squares."""
    count, height, width = images.shape
    whole = np.pad(images, ((0, 0), (0, -height % _PIECE_PX), (0, -width % _PIECE_PX)))
    squares = whole.reshape(count, whole.shape[1] // _PIECE_PX, _PIECE_PX, -1, _PIECE_PX)
    return np.asarray(squares.sum(axis=(2, 4)).reshape(count, -1))


def _moved_px(fit: LinearFit, changes: Array) -> Array:
    """(2, k) derivatives of the place with respect to the departures. changes (k, height, width): those of the fitted
    light."""
    return products(fit.by_grey[:2], changes * fit.used * fit.steadiness)


def _mark_tone(
    fit: LinearFit, information: ToneInformation, on_place: Array, light: Array, tone: Tone, full_scale_dn: float
) -> MarkTone:
    """Assemble a MarkTone. light (height, width): of the window."""
    codes = tone.code(np.quantile(light[fit.used], (0.0, 1.0)), full_scale_dn) / full_scale_dn
    return MarkTone(information, on_place, float(codes[0]), float(codes[1]))


def _uneven(shown: Array, about: Array) -> Array:
    """(8, height, width) derivatives by gradients and curvatures of the light on a mark, and by curvatures of that
    around it. shown, about (height, width): the rendered mark and 1, times the steadiness."""
    height, width = shown.shape
    col = np.broadcast_to(np.linspace(-1.0, 1.0, width), shown.shape)
    row = np.broadcast_to(np.linspace(-1.0, 1.0, height)[:, None], shown.shape)
    bends = [col * col, col * row, row * row]
    return np.stack([*(shown * each for each in (col, row, *bends)), *(about * each for each in bends)])
