"""What a mark's picture says of the tone curve, and how far another curve moves the mark.

In light the two sides of a blurred edge are alike; under a wrong curve one of them is softer. That is left over when
place, blur and contrast are fitted, and by how much tells the curve: one more linear estimate from the residuals.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.matching.covariance import Landscape, LinearFit
from measure.matching.models import GREY
from measure.noise.noise_model import combined, products
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import MarkTone

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PIECE_PX = 8  # of a mark's edges that are witnesses of their own, and of what JPEG rounds by itself
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
    """Beside the unknowns of a linearised fit. drawn, grey (height, width): the light that it draws, and that it was
    fitted to; clear, alike: where that is not near an end of the scanner's range, where noise is cut off, which bends
    an edge as a curve does; priors_dn2 (unknowns,): weights of what was known of the unknowns before, and departures
    (unknowns,) of the fit from that, which are residuals like those of pixels. landscape: in the mark.

    With the departures d the residuals are r + H d - D x. The score H'r of what D leaves of H grows with d by N and has
    the covariance S that the noise gives it: N' S^-1 N is the information, also where the noise is not white. H is
    taken at the drawn light: at the observed one, it would go along with the noise. Light that is not even on the mark
    or about it says nothing of the curve, but might seem to: D has bends of both, too.

    Each piece of its edges is a witness. Where they differ by more than the noise makes them, in what moves the mark,
    they are not as drawn, and S is so many times larger.

    What another curve moves the mark by follows from the observed light, with all that the drawing leaves unexplained.
    """
    mark_tone = _mark_tone(
        fit, ToneInformation.empty(), tone.derivatives(grey, full_scale_dn), tone, drawn, full_scale_dn
    )
    if np.ptp(drawn) <= _LEAST_CONTRAST * np.abs(drawn).max():  # nothing is drawn: there are no edges
        return mark_tone
    counts = fit.used & clear
    changes = tone.derivatives(drawn, full_scale_dn) * counts * fit.steadiness
    uneven = _uneven(fit.design[-GREY], fit.steadiness)
    known, priors = np.concatenate([fit.design, uneven]) * counts, np.diag(np.append(priors_dn2, np.zeros(len(uneven))))
    inverse = _inverse(products(known, known) + priors)
    shares = inverse @ products(known, changes)
    left = changes - combined(shares.T, known)
    normal = products(left, changes)
    residuals = np.where(counts, fit.residuals, 0.0)
    score = -products(left, residuals[None])[:, 0] - shares[: len(departures)].T @ (priors_dn2 * departures)
    covariance = fit.covariance(left) + landscape.covariance(left) + fit.noise.variance_dn2 * shares.T @ priors @ shares
    # Of departures that the picture's own unknowns take up whole, only rounding is left: it must not tell of the curve.
    whole = float(np.trace(fit.covariance(changes)))
    covariance += _LEAST_VARIANCE * max(whole, 1e-30) * np.eye(len(covariance))
    weighted = np.linalg.solve(covariance, normal).T
    estimate: Array = np.asarray(np.linalg.inv(np.eye(len(normal)) + weighted @ normal) @ weighted, float)
    by_piece = mark_tone.on_place @ estimate @ _piece_sums(left * (residuals + combined(estimate @ score, left)))
    by_noise = np.trace(mark_tone.on_place @ estimate @ covariance @ estimate.T @ mark_tone.on_place.T)
    worse = max(float(np.sum(by_piece**2) / max(by_noise, 1e-30)), 1.0)
    return replace(
        mark_tone, information=ToneInformation.from_score(normal, score + normal @ tone.mean, worse * covariance)
    )


def _inverse(normal: Array) -> Array:
    """(n, n) with all unknowns brought to one size: beside a strong prior the others would pass for nothing."""
    size = np.sqrt(np.where(np.diag(normal) > 0, np.diag(normal), 1.0))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(normal / scale, hermitian=True) / scale, float)


def _piece_sums(images: Array) -> Array:
    """(k, pieces) sums of images (k, height, width) over squares."""
    count, height, width = images.shape
    whole = np.pad(images, ((0, 0), (0, -height % _PIECE_PX), (0, -width % _PIECE_PX)))
    squares = whole.reshape(count, whole.shape[1] // _PIECE_PX, _PIECE_PX, -1, _PIECE_PX)
    return np.asarray(squares.sum(axis=(2, 4)).reshape(count, -1))


def tone_without_information(
    fit: LinearFit, light: Array, detail: Callable[[Array], Array], tone: Tone, full_scale_dn: float
) -> MarkTone:
    """Of a mark whose detail alone was fitted: the curve moves it all the same, but its picture says nothing of the
    curve, for its surroundings are not drawn. light (height, width): with these; detail: takes them away."""
    changes = np.stack([detail(each) for each in tone.derivatives(light, full_scale_dn)])
    return _mark_tone(fit, ToneInformation.empty(), changes, tone, light, full_scale_dn)


def _mark_tone(
    fit: LinearFit, said: ToneInformation, changes: Array, tone: Tone, light: Array, full_scale_dn: float
) -> MarkTone:
    """changes (k, height, width): of what was fitted, by the departures; light (height, width): of the picture."""
    codes = tone.code(np.quantile(light[fit.used], (0.0, 1.0)), full_scale_dn) / full_scale_dn
    return MarkTone(
        said, products(fit.by_grey[:2], changes * fit.used * fit.steadiness), float(codes[0]), float(codes[1])
    )


def _uneven(shown: Array, about: Array) -> Array:
    """(8, height, width) slopes and bends of the light of a mark's picture, and bends of that about it. shown, about
    (height, width): the picture and 1, times the steadiness."""
    height, width = shown.shape
    col = np.broadcast_to(np.linspace(-1.0, 1.0, width), shown.shape)
    row = np.broadcast_to(np.linspace(-1.0, 1.0, height)[:, None], shown.shape)
    bends = [col * col, col * row, row * row]
    return np.stack([*(shown * each for each in (col, row, *bends)), *(about * each for each in bends)])
