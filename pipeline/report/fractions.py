"""Fractional parts of measured pixel positions: marks prefer no place within a pixel, biased methods do."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import cKDTree

from pipeline.report.marks import Frame

Array = NDArray[np.float64]

BINS = 10
LEAST_MARKS = 50  # five a bin, below which the chi-square test means nothing
LEAST_PROBABILITY = 1e-4  # grids of targets that lie along the pixels are a little uneven by themselves
LEAST_BIAS_PX = 0.01  # with very many marks even a bias that harms nobody is beyond chance
SAME_PLACE_PX = 0.5  # scans that lie at random do not put a mark so near to where another one has it


@dataclass(frozen=True)
class FractionTest:
    """Counts (BINS,) of the fractional parts over [-0.5, 0.5) of a pixel, about its centre.

    probability: how often chance alone gives counts as uneven as these; None where there are too few marks to say.
    bias_px: the amplitude of the bias that would make them so. Positions f moved to f + b sin(2 pi f) have, to first
    order, the density 1 - 2 pi b cos(2 pi f), so that b follows from the counts' first harmonic.
    """

    counts: NDArray[np.int64]
    probability: float | None
    bias_px: float

    @property
    def is_locked(self) -> bool:
        """Whether the positions prefer parts of a pixel, beyond chance and by an amount that matters."""
        return self.probability is not None and self.probability < LEAST_PROBABILITY and self.bias_px > LEAST_BIAS_PX


def places_px(shots: list[Frame]) -> Array:
    """(n, 2) px, column and row of all marks observed, each place of a mark once: one that recurs there in frame after
    frame has one fractional part, however often it was measured."""
    by_mark: dict[tuple[bool, str], list[Array]] = {}
    for mark in (mark for frame in shots for mark in frame.marks):
        if mark.status.is_observation and mark.center_px is not None:
            by_mark.setdefault((mark.is_fiducial, mark.point), []).append(np.asarray(mark.center_px, dtype=np.float64))
    return np.array([place for places in by_mark.values() for place in _apart(np.array(places))]).reshape(-1, 2)


def _apart(places: Array) -> Array:
    """Of places (n, 2) px those that lie apart from all that were kept before."""
    kept: set[int] = set()
    for index, near in enumerate(cKDTree(places).query_ball_point(places, np.full(len(places), SAME_PLACE_PX))):
        if kept.isdisjoint(near):
            kept.add(index)
    return places[sorted(kept)]


def fraction_test(position_px: Array) -> FractionTest:
    """Test one coordinate (n,) of measured positions: chi-square against equal counts."""
    fractions = position_px - np.floor(position_px + 0.5)
    counts, _ = np.histogram(fractions, bins=BINS, range=(-0.5, 0.5))
    if len(position_px) < LEAST_MARKS:
        return FractionTest(counts, None, 0.0)
    harmonic = 2.0 * np.abs(np.mean(np.exp(2j * np.pi * fractions)))
    return FractionTest(counts, float(stats.chisquare(counts).pvalue), float(harmonic / (2.0 * np.pi)))


def expected_range(total: int) -> tuple[float, float]:
    """Where 99 % of all counts of a bin lie when the marks prefer no place."""
    binomial = stats.binom(total, 1.0 / BINS)
    return float(binomial.ppf(0.005)), float(binomial.ppf(0.995))
