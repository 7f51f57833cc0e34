"""What marks say of the tone curve of their scan, and what is not known of it in their places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.scans.tone import SaidOfTone, Tone

Array = NDArray[np.float64]

_LONGEST = 1.0  # departure that is changed at a time, in its standard deviations
_CHANCE = 4.0  # square of the standard deviations by which a mark's own picture puts it elsewhere by chance


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
    greatest: the codes between which they do, shares of full scale; contradiction: of the curve that they were matched
    by, as `Tone` has it, and how far that is from what they say of it."""

    tone: Tone
    said: SaidOfTone | None = None
    least: float = 0.0
    greatest: float = 1.0
    contradiction: float = 0.0

    @classmethod
    def of(
        cls,
        prior: Tone,
        told: Mapping[int, ToldTone],
        matched_by: Tone,
        doubting: bool = True,
        edges: Sequence[SaidOfTone] = (),
    ) -> "FrameTone":
        """By what each mark says, and edges that are no marks; doubting: as `Tone.told` takes it."""
        if not told:
            return cls(prior)
        each = [*(one.said for one in told.values()), *edges]
        tone, said = prior.told(each, doubting)
        least, greatest = min(one.least for one in told.values()), max(one.greatest for one in told.values())
        apart = tone.mean - matched_by.mean
        return cls(tone, said, least, greatest, matched_by.contradiction(each) + float(apart @ apart))

    @property
    def note(self) -> str:
        """A sentence: which curve, and whence."""
        value, sigma = self.tone.power_between(self.least, self.greatest)
        exact = f"{value:.2f}" if self.tone.is_known else f"{value:.2f} (σ {sigma:.2f})"
        return f"Light was taken to grow as the grey value to the power of {exact}: {self.tone.source}."

    def moves_px(self, told: ToldTone, before: Tone) -> float:
        """How far a mark lies elsewhere by this curve than by the one before."""
        return float(np.hypot(*(told.on_place @ (self.tone.mean - before.mean))))

    def covariance_px2(self, told: ToldTone, prior: Tone) -> Array:
        """(2, 2) of a mark's place, for what is not known of the curve, whose variance of unit weight is by how much
        the marks contradict one another on it: as much then moves them that is no curve. Where they agree on none, it
        is as unknown as it was before."""
        agreed = 1 / (1 + self.contradiction**2)
        off = self.tone.mean - prior.mean
        covariance = agreed * (1 + self.contradiction) * self.tone.covariance
        covariance = covariance + (1 - agreed) * (prior.covariance + np.outer(off, off))
        return np.asarray(told.on_place @ covariance @ told.on_place.T)

    def covariance_of_own_px2(self, told: ToldTone, prior: Tone) -> Array:
        """(2, 2) of a mark's place, for how far the curve that its own picture wants would move it from here, beyond
        what chance makes of that: a scan has one curve, so something else is in its edges."""
        if not told.said.count:
            return np.zeros((2, 2))
        own, _ = prior.told([told.said], doubting=False)
        off = told.on_place @ (own.mean - self.tone.mean)
        by_chance = _CHANCE * float(np.trace(told.on_place @ own.covariance @ told.on_place.T))
        return np.asarray(max(1 - by_chance / max(float(off @ off), 1e-12), 0.0) * np.outer(off, off))

    def step_from(self, before: Tone) -> Tone:
        """The curve to match with next: no farther from the one before than what was linearised there holds."""
        step = self.tone.mean - before.mean
        return self.tone.at(before.mean + step / max(float(np.abs(step).max()) / _LONGEST, 1.0))
