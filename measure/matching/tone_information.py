"""Information of a mark's fit on the tone curve, and the derivatives of its place with respect to the curve."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from measure.array_types import Array, Mask
from measure.matching.covariance import Landscape, LinearFit
from measure.matching.models import GREY
from measure.matching.window import Coding
from measure.noise.noise_model import combined, products
from measure.tone.curve import ToneInformation
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
    coding: Coding,
    landscape: Landscape,
    by_width: Array | None = None,
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
    by_width : (height, width) derivative by the width of lines, a further unknown. Otherwise the curve would explain
        lines that are narrower or wider than drawn.
    """
    tone, full_scale_dn = coding.tone, coding.full_scale_dn
    on_place = _moved_px(fit, tone.derivatives(grey, full_scale_dn))
    information = ToneInformation.empty()
    if _has_contrast(drawn):
        within = replace(fit, used=fit.used & clear)
        uneven = np.concatenate([_uneven(fit.design[-GREY], fit.steadiness), _images(by_width, drawn.shape)])
        changes = tone.derivatives(drawn, full_scale_dn) * within.used * fit.steadiness
        score, left, covariance = _score(within, changes, priors_dn2, departures, uneven)
        covariance += landscape.covariance(left) + _least_variances(fit, changes).sum() * np.eye(len(left))
        covariance *= _disagreement(score, left, np.where(within.used, fit.residuals, 0.0), covariance, on_place)
        information = score.information(covariance, tone)
    return _mark_tone(fit, information, on_place, drawn, coding)


def tone_without_information(
    fit: LinearFit, light: Array, detail: Callable[[Array], Array], coding: Coding
) -> MarkTone:
    """Effect of the curve on a mark of which only the detail was fitted. It gives no information on the curve, since
    its background is not modelled. light (height, width): with background; detail: subtracts the background."""
    changes = np.stack([detail(each) for each in coding.tone.derivatives(light, coding.full_scale_dn)])
    return _mark_tone(fit, ToneInformation.empty(), _moved_px(fit, changes), light, coding)


def sharpening_score(
    fit: LinearFit, drawn: Array, priors_dn2: Array, departures: Array, coding: Coding, by_width: Array | None = None
) -> SharpeningScore | None:
    """Score the scan's sharpening together with the tone curve, as in `mark_tone_information`. The fit's mask includes
    halos. by_width (height, width): derivative by the width of lines, a further unknown. None where the model has no
    contrast."""
    if not _has_contrast(drawn):
        return None
    tone, full_scale_dn = coding.tone, coding.full_scale_dn
    halos = tone.sharpening.changes(tone.code(drawn, full_scale_dn))
    # Sign: light by a wrong curve lacks the departure, whereas sharpening adds halos to it.
    halos = -tone.slope(drawn, full_scale_dn) * halos
    changes = np.concatenate([tone.derivatives(drawn, full_scale_dn), halos]) * (fit.used * fit.steadiness)
    score, _, covariance = _score(fit, changes, priors_dn2, departures, _images(by_width, drawn.shape))
    covariance += np.diag(_least_variances(fit, changes))
    return SharpeningScore(score.value, score.normal, covariance, _moved_px(fit, halos))


def _images(image: Array | None, shape: tuple[int, ...]) -> Array:
    """(n, height, width) the image, if there is one."""
    return np.zeros((0, *shape)) if image is None else image[None]


def _has_contrast(drawn: Array) -> bool:
    return bool(np.ptp(drawn) > _LEAST_CONTRAST * np.abs(drawn).max())


def _score(
    fit: LinearFit, changes: Array, priors_dn2: Array, departures: Array, uneven: Array | None = None
) -> tuple[ToneScore, Array, Array]:
    """Score of changes (k, height, width) of the used light, what the unknowns leave of these, its covariance (k, k).
    uneven (m, height, width): derivatives by further unknowns."""
    count = 0 if uneven is None else len(uneven)
    design = (fit.design if uneven is None else np.concatenate([fit.design, uneven])) * fit.used
    priors, departures = (np.append(each, np.zeros(count)) for each in (priors_dn2, departures))
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


def _mark_tone(fit: LinearFit, information: ToneInformation, on_place: Array, light: Array, coding: Coding) -> MarkTone:
    codes = coding.tone.code(np.quantile(light[fit.used], (0.0, 1.0)), coding.full_scale_dn) / coding.full_scale_dn
    return MarkTone(information, on_place, float(codes[0]), float(codes[1]))


def _uneven(shown: Array, about: Array) -> Array:
    """(8, height, width) derivatives by gradients and curvatures of the light on a mark, and by curvatures of that
    around it. shown, about (height, width): the rendered mark and 1, times the steadiness."""
    height, width = shown.shape
    col = np.broadcast_to(np.linspace(-1.0, 1.0, width), shown.shape)
    row = np.broadcast_to(np.linspace(-1.0, 1.0, height)[:, None], shown.shape)
    bends = [col * col, col * row, row * row]
    return np.stack([*(shown * each for each in (col, row, *bends)), *(about * each for each in bends)])
