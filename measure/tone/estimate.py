"""The tone curve of a scan estimated from its marks, and what its uncertainty adds to their places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.array_types import Array
from measure.tone.curve import Tone, ToneInformation

_POWERS = 0.4, 3.0  # that curves are like: what marks say beyond has another cause
_LONGEST = 1.0  # departure that is changed at a time, in its standard deviations


@dataclass(frozen=True, eq=False)
class MarkTone:
    """A mark and the tone curve. information: on the departures of the curve. on_place (2, k): px by which the mark
    moves for each departure of 1. least, greatest: the codes of the mark's picture, shares of full scale."""

    information: ToneInformation
    on_place: Array
    least: float
    greatest: float

    @property
    def sensitivity_px(self) -> float:
        """The standard deviation of the mark's place for a curve of which only the prior is known."""
        return float(np.hypot(*self.on_place[:, 0]))


@dataclass(frozen=True, eq=False)
class FrameTone:
    """The curve estimated from all marks of a frame.

    tone: the curve; information: of the marks alone, None where they give none; least, greatest: the codes between
    which they lie, shares of full scale; scatter: the variance by which each departure of their own curves differs from
    it; apart: the squared distance of the curve from the one by which they were matched.
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
        """Estimates the curve.

        Parameters
        ----------
        prior : the curve before this frame.
        marks : what each mark gives.
        matched_by : the curve by which they were matched.
        edges : information of edges that are no marks.
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
        """Of the marks with one another and with the curve that they were matched by, a variance of departures."""
        return self.scatter + self.apart

    @property
    def note(self) -> str:
        """A sentence: which curve, and whence."""
        value, sigma = self.tone.equivalent_power(self.least, self.greatest)
        exact = f"{value:.2f}" if self.tone.is_known else f"{value:.2f} (σ {sigma:.2f})"
        return f"Scanner gamma: {exact}: {self.tone.source}. {self.tone.sharpening.note}".rstrip()

    def shift_px(self, mark: MarkTone, before: Tone) -> float:
        """The distance of a mark's place by this curve from that by another one."""
        return float(np.hypot(*(mark.on_place @ (self.tone.mean - before.mean))))

    def covariance_px2(self, mark: MarkTone) -> Array:
        """(2, 2) of a mark's place: the uncertainty of the curve, and the scatter of the marks' own curves about it.
        The scatter may have another cause than a curve: it counts at most as much as the prior of a curve."""
        covariance = self.tone.covariance + self.scatter / (1 + self.scatter) * np.eye(len(self.tone.covariance))
        return np.asarray(mark.on_place @ covariance @ mark.on_place.T)

    def next_curve(self, before: Tone) -> Tone:
        """The curve to match with next: no farther from the one before than what was linearised there holds."""
        step = self.tone.mean - before.mean
        return self.tone.replace_departures(before.mean + step / max(float(np.abs(step).max()) / _LONGEST, 1.0))
