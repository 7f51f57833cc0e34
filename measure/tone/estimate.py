"""What marks say of the tone curve of their scan, and what is not known of it in their places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.tone.curve import SaidOfTone, Tone

Array = NDArray[np.float64]

_LONGEST = 1.0  # departure that is changed at a time, in its standard deviations


@dataclass(frozen=True, eq=False)
class ToldTone:
    """said: of the departures of the curve. on_place (2, k): px by which the mark moves for each departure of 1. least,
    greatest: the codes that the mark's picture has, shares of full scale."""

    said: SaidOfTone
    on_place: Array
    least: float
    greatest: float

    @property
    def leans_px(self) -> float:
        """How far what is not known of any curve moves the mark."""
        return float(np.hypot(*self.on_place[:, 0]))


@dataclass(frozen=True, eq=False)
class FrameTone:
    """tone: what is believed of the curve after all marks. said: what these say of it alone, None where nothing; least,
    greatest: the codes between which they do, shares of full scale; scatter: the variance by which each departure of
    their own curves differs from it; apart: the square of how far they were matched by another one."""

    tone: Tone
    said: SaidOfTone | None = None
    least: float = 0.0
    greatest: float = 1.0
    scatter: float = 0.0
    apart: float = 0.0

    @classmethod
    def of(
        cls,
        prior: Tone,
        told: Mapping[int, ToldTone],
        matched_by: Tone,
        edges: Sequence[SaidOfTone] = (),
    ) -> "FrameTone":
        """By what each mark says, and edges that are no marks."""
        if not told:
            return cls(prior)
        each = [*(one.said for one in told.values()), *edges]
        found = prior.told(each)
        least, greatest = min(one.least for one in told.values()), max(one.greatest for one in told.values())
        apart = found.tone.mean - matched_by.mean
        said = None if prior.is_known else SaidOfTone.together(each, found.scatter)
        return cls(found.tone, said, least, greatest, found.scatter, float(apart @ apart))

    @property
    def unsettled(self) -> float:
        """How little the marks agree on the curve that they were matched by."""
        return self.scatter + self.apart

    @property
    def note(self) -> str:
        """A sentence: which curve, and whence."""
        value, sigma = self.tone.power_between(self.least, self.greatest)
        exact = f"{value:.2f}" if self.tone.is_known else f"{value:.2f} (σ {sigma:.2f})"
        return f"Light was taken to grow as the grey value to the power of {exact}: {self.tone.source}."

    def moves_px(self, told: ToldTone, before: Tone) -> float:
        """How far a mark lies elsewhere by this curve than by the one before."""
        return float(np.hypot(*(told.on_place @ (self.tone.mean - before.mean))))

    def covariance_px2(self, told: ToldTone) -> Array:
        """(2, 2) of a mark's place, for what is not known of the curve, and for how far the marks' own curves differ
        from it: as much moves them that is no curve, up to what nobody knows of any."""
        covariance = self.tone.covariance + self.scatter / (1 + self.scatter) * np.eye(len(self.tone.covariance))
        return np.asarray(told.on_place @ covariance @ told.on_place.T)

    def step_from(self, before: Tone) -> Tone:
        """The curve to match with next: no farther from the one before than what was linearised there holds."""
        step = self.tone.mean - before.mean
        return self.tone.at(before.mean + step / max(float(np.abs(step).max()) / _LONGEST, 1.0))
