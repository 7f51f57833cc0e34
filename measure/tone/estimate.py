"""Estimation of a scan's tone curve from its marks, and the effect of its uncertainty on their places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.array_types import Array
from measure.tone.curve import Tone, ToneInformation

_POWERS = 0.4, 3.0  # range of gamma; an estimate outside has a different cause
_LONGEST = 1.0  # in standard deviations, largest change of a departure per iteration


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
    """

    tone: Tone
    information: ToneInformation | None = None
    least: float = 0.0
    greatest: float = 1.0
    scatter: float = 0.0
    apart: float = 0.0

    @classmethod
    def from_marks(
        cls, prior: Tone, marks: Mapping[int, MarkTone], matched_by: Tone, edges: Sequence[ToneInformation] = ()
    ) -> "FrameTone":
        """Estimate the curve.

        Parameters
        ----------
        prior : prior of the curve.
        marks : contribution of each mark.
        matched_by : curve used for matching them.
        edges : information of edges other than marks.
        """
        if not marks:
            return cls(prior)
        each = [*(mark.information for mark in marks.values()), *edges]
        estimate = prior.estimate(each)
        least, greatest = min(mark.least for mark in marks.values()), max(mark.greatest for mark in marks.values())
        step = estimate.tone.mean - matched_by.mean
        information = replace(ToneInformation.pooled(each, estimate.scatter), sharpening=matched_by.sharpening)
        if prior.is_known:
            return cls(prior, None, least, greatest, estimate.scatter, float(step @ step))
        value = estimate.tone.equivalent_power(least, greatest)[0]
        sharpening = matched_by.sharpening
        if not _POWERS[0] <= value <= _POWERS[1]:
            off = estimate.tone.mean - prior.mean
            doubted = prior.doubted(estimate.tone, value).sharpened(sharpening)
            return cls(doubted, None, least, greatest, 0.0, float(off @ off))
        tone = replace(estimate.tone, before=prior).sharpened(sharpening)
        return cls(tone, information, least, greatest, estimate.scatter, float(step @ step))

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

    def shift_px(self, mark: MarkTone, before: Tone) -> float:
        """Shift (px) of a mark's place from another curve to this one."""
        return float(np.hypot(*(mark.on_place @ (self.tone.mean - before.mean))))

    def covariance_px2(self, mark: MarkTone) -> Array:
        """(2, 2) covariance of a mark's place due to the uncertainty of the curve and the scatter of the marks' own
        curves. The scatter may have a different cause, so it is limited to the variance of the prior."""
        covariance = self.tone.covariance + self.scatter / (1 + self.scatter) * np.eye(len(self.tone.covariance))
        return np.asarray(mark.on_place @ covariance @ mark.on_place.T)

    def next_curve(self, before: Tone) -> Tone:
        """Curve for the next matching, limited to the range of the linearisation around the previous one."""
        step = self.tone.mean - before.mean
        return self.tone.replace_departures(before.mean + step / max(float(np.abs(step).max()) / _LONGEST, 1.0))
