"""What a mark's picture says of the tone curve, and how far another curve moves the mark."""

from collections.abc import Callable

import numpy as np

from measure.array_types import Array, Mask
from measure.matching.covariance import Landscape, LinearFit
from measure.matching.models import GREY
from measure.matching.window import Coding
from measure.noise.noise_model import combined, products
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import MarkTone
from measure.tone.score import ToneScore, tone_score
from measure.tone.sharpening import SharpeningScore

_PIECE_PX = 8  # of a mark's edges that tell the curve by themselves, and of what JPEG rounds by itself
_LEAST_CONTRAST = 1e-6  # of the light that is drawn: rounding is about that large
_LEAST_VARIANCE = 1e-9  # of what is left of departures, over that of the departures themselves


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
    """What a linearised fit says of the curve beside its unknowns.

    The changes by the curve are taken at the drawn light: at the observed one, they would go along with the noise.
    Light that is not even on the mark or about it says nothing of the curve, but might seem to: bends of both are
    unknowns, too. What another curve moves the mark by follows from the observed light, with all that the drawing
    leaves unexplained.

    Parameters
    ----------
    drawn, grey : (height, width)
        The light that the fit draws, and that it was fitted to.
    clear : (height, width)
        Where that is not near an end of the scanner's range, where noise is cut off, which bends an edge as a curve
        does.
    priors_dn2, departures : (unknowns,)
        As of `tone_score`.
    landscape : Landscape
        In the mark.
    """
    on_place = _moved_px(fit, tone.derivatives(grey, full_scale_dn))
    information = ToneInformation.empty()
    if np.ptp(drawn) > _LEAST_CONTRAST * np.abs(drawn).max():  # else nothing is drawn: there are no edges
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
        # Of departures that the picture's own unknowns take up whole, only rounding is left: it must not tell of the
        # curve.
        whole = fit.noise.variance_dn2 * float(np.sum(changes**2))
        covariance += _LEAST_VARIANCE * max(whole, 1e-30) * np.eye(len(covariance))
        covariance *= _disagreement(score, left, residuals, covariance, on_place)
        information = score.information(covariance, tone)
    return _mark_tone(fit, information, on_place, drawn, tone, full_scale_dn)


def tone_without_information(
    fit: LinearFit, light: Array, detail: Callable[[Array], Array], tone: Tone, full_scale_dn: float
) -> MarkTone:
    """Of a mark whose detail alone was fitted: the curve moves it all the same, but its picture says nothing of the
    curve, for its surroundings are not drawn. light (height, width): with these; detail: takes them away."""
    changes = np.stack([detail(each) for each in tone.derivatives(light, full_scale_dn)])
    return _mark_tone(fit, ToneInformation.empty(), _moved_px(fit, changes), light, tone, full_scale_dn)


def sharpening_score(
    fit: LinearFit, drawn: Array, priors_dn2: Array, departures: Array, coding: Coding
) -> SharpeningScore | None:
    """What a linearised fit says of the scan's sharpening, beside its unknowns and the tone curve.

    Parameters
    ----------
    fit : LinearFit
        used: of pixels where halos count, too.
    drawn : (height, width)
        The light that the fit draws.
    priors_dn2, departures : (unknowns,)
        As of `tone_score`.
    coding : Coding
        How light was stored.
    """
    if not np.ptp(drawn) > _LEAST_CONTRAST * np.abs(drawn).max():
        return None
    tone, full_scale_dn, used = coding.tone, coding.full_scale_dn, fit.used
    codes, slope = tone.code(drawn, full_scale_dn), tone.slope(drawn, full_scale_dn)
    halos = tone.sharpening.changes(codes)
    # The light through a wrong curve lacks what the right one would add; of halos it has too much.
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
    """How many times larger the covariance of the score is than the noise makes it. Each piece of a mark's edges tells
    the curve: where they differ by more than the noise makes them, in what moves the mark, they are not as drawn."""
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
    """(2, k) how far the departures move the place; changes (k, height, width): of what was fitted, by these."""
    return products(fit.by_grey[:2], changes * fit.used * fit.steadiness)


def _mark_tone(
    fit: LinearFit, information: ToneInformation, on_place: Array, light: Array, tone: Tone, full_scale_dn: float
) -> MarkTone:
    """light (height, width): of the picture."""
    codes = tone.code(np.quantile(light[fit.used], (0.0, 1.0)), full_scale_dn) / full_scale_dn
    return MarkTone(information, on_place, float(codes[0]), float(codes[1]))


def _uneven(shown: Array, about: Array) -> Array:
    """(8, height, width) slopes and bends of the light of a mark's picture, and bends of that about it. shown, about
    (height, width): the picture and 1, times the steadiness."""
    height, width = shown.shape
    col = np.broadcast_to(np.linspace(-1.0, 1.0, width), shown.shape)
    row = np.broadcast_to(np.linspace(-1.0, 1.0, height)[:, None], shown.shape)
    bends = [col * col, col * row, row * row]
    return np.stack([*(shown * each for each in (col, row, *bends)), *(about * each for each in bends)])
