"""Score of a tone curve by the residuals of a fit, its estimate from a scan's marks, and its effect on their places."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from measure.array_types import Array
from measure.tone.curve import Tone, ToneInformation

_POWERS = 0.4, 3.0  # range of gamma; an estimate outside has a different cause
_LINEAR = 0.3  # in standard deviations, shift of a mark for which its linearised fit serves
_INFORMATIVE = 0.25  # trace of a mark's information, whose unit is that of the prior on one departure
_LONGEST = 1.0  # in standard deviations, largest change of a departure per iteration
_SINGULAR = 1e-12  # relative eigenvalue of the normalised normal matrix below which it is numerical rounding


@dataclass(frozen=True, eq=False)
class MarkTone:
    """Relation of a mark to the tone curve.

    information: on the departures of the curve; on_place: (2, k) derivatives of the place (px) with respect to the
    departures; least, greatest: range of codes of the mark's image, fractions of full scale.
    """

    information: ToneInformation
    on_place: Array
    least: float
    greatest: float

    @property
    def sensitivity_px(self) -> float:
        """Sensitivity of the place: shift in px by one prior standard deviation of the first departure."""
        return float(np.hypot(*self.on_place[:, 0]))


@dataclass(frozen=True, eq=False)
class FrameTone:
    """Tone curve estimated from all marks of a frame.

    Attributes
    ----------
    tone : the curve.
    information : of the marks alone; None if they give none.
    least, greatest : range of codes of the marks, fractions of full scale.
    scatter : variance of each departure of the marks' own curves around it.
    apart : squared distance of the curve from the one used for matching.
    is_determined : whether half of the marks tell more of the curve than its prior. If not, one step from the prior is
        taken: under the next curve they only tell how their drawings are wrong.
    """

    tone: Tone
    information: ToneInformation | None = None
    least: float = 0.0
    greatest: float = 1.0
    scatter: float = 0.0
    apart: float = 0.0
    is_determined: bool = False

    @classmethod
    def from_marks(cls, prior: Tone, marks: Mapping[int, MarkTone], matched_by: Tone) -> "FrameTone":
        """Estimate the curve from marks that were matched with the curve matched_by."""
        if not marks:
            return cls(prior)
        each = [mark.information for mark in marks.values()]
        tone, scatter = prior.estimate(each)
        ends = min(mark.least for mark in marks.values()), max(mark.greatest for mark in marks.values())
        step, sharpening = tone.mean - matched_by.mean, matched_by.sharpening
        if prior.is_known:
            return cls(prior, None, *ends, scatter, float(step @ step))
        is_determined = float(np.median([np.trace(information.matrix) for information in each])) > _INFORMATIVE
        value = tone.equivalent_power(*ends)[0]
        if not _POWERS[0] <= value <= _POWERS[1]:
            off = tone.mean - prior.mean
            source = f"{prior.source}; the marks say {value:.2f}, as no scanner does, which was not taken"
            covariance = prior.covariance + np.outer(off, off)
            doubted = replace(prior, covariance=covariance, source=source, before=prior).replace_sharpening(sharpening)
            return cls(doubted, None, *ends, 0.0, float(off @ off), is_determined)
        information = replace(ToneInformation.pool(each, scatter), sharpening=sharpening)
        tone = replace(tone, before=prior).replace_sharpening(sharpening)
        return cls(tone, information, *ends, scatter, float(step @ step), is_determined)

    @property
    def is_doubted(self) -> bool:
        """Whether the marks' own curve is one that no scanner has, and was not taken."""
        return self.information is None and self.apart > 0 and not self.tone.is_known

    @property
    def disagreement(self) -> float:
        """Variance of departures: disagreement of the marks with one another and with the curve used for matching."""
        return self.scatter + self.apart

    @property
    def note(self) -> str:
        """Sentence that states the curve and its source."""
        value, sigma = self.tone.equivalent_power(self.least, self.greatest)
        exact = f"{value:.2f}" if self.tone.is_known else f"{value:.2f} (σ {sigma:.2f})"
        return f"Scanner gamma: {exact}: {self.tone.source}. {self.tone.sharpening.note}".rstrip()

    def moves(self, mark: MarkTone, before: Tone, covariance_px2: Array) -> bool:
        """Whether it moves a mark, from its place under another curve, by so much that its fit has to be repeated.

        covariance_px2: (2, 2) of the place, without the uncertainty of the curve.
        """
        variance_px2 = float(np.trace(covariance_px2 + self.covariance_px2(mark))) / 2
        return bool(np.hypot(*(mark.on_place @ (self.tone.mean - before.mean))) > _LINEAR * np.sqrt(variance_px2))

    def covariance_px2(self, mark: MarkTone) -> Array:
        """(2, 2) covariance of a mark's place due to the uncertainty of the curve and the scatter of the marks' own
        curves. The scatter may have a different cause, so it is limited to the variance of the prior."""
        covariance = self.tone.covariance + self.scatter / (1 + self.scatter) * np.eye(len(self.tone.covariance))
        return np.asarray(mark.on_place @ covariance @ mark.on_place.T)

    def next_curve(self, before: Tone) -> Tone:
        """Curve for the next matching, limited to the range of the linearisation around the previous one."""
        step = self.tone.mean - before.mean
        return replace(self.tone, mean=before.mean + step / max(float(np.abs(step).max()) / _LONGEST, 1.0))


# Score of a tone curve from the residuals of fits of marks and edges, with their other unknowns eliminated.
#
# In linear light both sides of a blurred edge are symmetric; under a wrong curve one side is softer. The asymmetry
# remains after place, blur and contrast are fitted, and gives a linear estimate of the curve from the residuals. With
# the departures d of the curve, the residuals of a fit are r + H d - D x. Let L be the part of H orthogonal to D. The
# score L'r grows with d by N = L'H and has the covariance S of the noise. N' S^-1 N is the information, also for
# correlated noise.


@dataclass(frozen=True, eq=False)
class ToneScore:
    """Score of one image, or of several along the first axes.

    Attributes
    ----------
    left : (..., k, pixels) derivatives by the departures, after elimination of the unknowns.
    value : (..., k) score.
    normal : (..., k, k) derivatives of the score with respect to the departures.
    by_unknown : (..., unknowns, k) derivatives of the unknowns with respect to the departures.
    """

    left: Array
    value: Array
    normal: Array
    by_unknown: Array

    def information(self, covariance: Array, tone: Tone) -> ToneInformation:
        """Pool the information of all images, fitted with a tone curve. covariance (k, k): of the sum of the scores."""
        count = self.value.shape[-1]
        normal, value = self.normal.reshape(-1, count, count).sum(axis=0), self.value.reshape(-1, count).sum(axis=0)
        value = value + normal @ tone.mean
        weighted = np.linalg.solve(covariance, np.column_stack([normal, value])).T
        matrix = weighted[:-1] @ normal
        sum_of_squares = float(weighted[-1] @ value)
        return ToneInformation((matrix + matrix.T) / 2, weighted[-1] @ normal, sum_of_squares, count)


def tone_score(
    design: Array, changes: Array, residuals: Array, priors: Array | None = None, departures: Array | None = None
) -> ToneScore:
    """Score the departures of a tone curve, with the unknowns of the fits eliminated.

    Parameters
    ----------
    design : (..., unknowns, pixels) derivatives of the model with respect to its unknowns; 0 in unused pixels.
    changes : (..., k, pixels) derivatives of the light with respect to the departures; 0 in unused pixels.
    residuals : (..., pixels) residuals of the fits.
    priors, departures : (unknowns,) weights of the priors of the unknowns, and deviations of the fit from them, treated
        as residuals of pseudo-observations.

    Returns
    -------
    ToneScore
    """
    normal, wanted = design @ design.swapaxes(-1, -2), design @ changes.swapaxes(-1, -2)
    if priors is not None:
        normal = normal + np.diag(priors)
    # Normalise the unknowns; otherwise a strong prior would make all others numerically zero.
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 1e-300))[..., None]
    inverse = np.linalg.pinv(normal / size / size.swapaxes(-1, -2), rcond=_SINGULAR, hermitian=True)
    by_unknown = inverse @ (wanted / size) / size
    left = changes - by_unknown.swapaxes(-1, -2) @ design
    value = -(left @ residuals[..., None])[..., 0]
    if priors is not None and departures is not None:
        value = value - by_unknown.T @ (priors * departures)
    return ToneScore(left, value, left @ changes.swapaxes(-1, -2), by_unknown)
