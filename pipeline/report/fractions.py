"""Test for pixel locking: histograms of the fractional parts of measured pixel positions."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtrik, chdtrc

from pipeline.drawing import svg
from pipeline.report.data import Frame
from pipeline.types import Array

BINS = 10
LEAST_MARKS = 50  # five per bin; with fewer the chi-square test is invalid
LEAST_PROBABILITY = 1e-4  # significance level; low, as target grids nearly parallel to the pixels are uneven
LEAST_BIAS_PX = 0.01  # px; with very many marks even a negligible bias is significant
SAME_PLACE_PX = 0.5  # px; randomly placed marks rarely share a column or row this closely


@dataclass(frozen=True)
class FractionTest:
    """Chi-square test for uniform fractional parts.

    Attributes
    ----------
    counts : (BINS,) of the fractional parts over [-0.5, 0.5) px around the pixel centre.
    probability : p-value; None if there are too few marks.
    bias_px : amplitude of a sinusoidal bias that would cause the counts. Positions f shifted to f + b sin(2 pi f) have,
        to first order, the density 1 - 2 pi b cos(2 pi f), so that b follows from the first harmonic.
    """

    counts: NDArray[np.int64]
    probability: float | None
    bias_px: float

    @property
    def is_locked(self) -> bool:
        """Whether pixel locking is significant and not negligible."""
        return self.probability is not None and self.probability < LEAST_PROBABILITY and self.bias_px > LEAST_BIAS_PX


def places_px(shots: Iterable[Frame]) -> dict[str, Array]:
    """Distinct columns and rows (n,) of the observed marks.

    Equal positions count once: a mark that recurs in every frame, or a grid line parallel to the pixels, has only one
    independent fractional part.
    """
    return places_apart([center for frame in shots for center in centers_px(frame)])


def centers_px(frame: Frame) -> Iterator[Array]:
    """Yield the centres (2,) of the observed marks of a frame."""
    for mark in frame.marks:
        if mark.status.is_observation and mark.center_px is not None:
            yield mark.center_px


def places_apart(centers: ArrayLike) -> dict[str, Array]:
    """Distinct columns and rows of centres (n, 2); see `places_px`."""
    columns, rows = np.asarray(centers, dtype=np.float64).reshape(-1, 2).T
    return {"column": _apart(columns), "row": _apart(rows)}


def _apart(positions_px: Array) -> Array:
    """Positions, sorted, without those within SAME_PLACE_PX of the last one kept."""
    kept: list[float] = []
    for position in np.sort(positions_px).tolist():
        if not kept or position - kept[-1] > SAME_PLACE_PX:
            kept.append(position)
    return np.array(kept)


def fraction_test(position_px: Array) -> FractionTest:
    """Test one coordinate (n,) of measured positions for uniform fractional parts."""
    fractions = position_px - np.floor(position_px + 0.5)
    counts, _ = np.histogram(fractions, bins=BINS, range=(-0.5, 0.5))
    if len(position_px) < LEAST_MARKS:
        return FractionTest(counts, None, 0.0)
    harmonic = 2.0 * np.abs(np.mean(np.exp(2j * np.pi * fractions)))
    chi_square = np.sum((counts - counts.mean()) ** 2) / counts.mean()
    return FractionTest(counts, float(chdtrc(BINS - 1, chi_square)), float(harmonic / (2.0 * np.pi)))


def expected_range(total: int) -> tuple[float, float]:
    """99 % interval of the count of a bin without pixel locking (binomial distribution)."""
    if total == 0:
        return 0.0, 0.0
    low, high = np.ceil(bdtrik((0.005, 0.995), total, 1.0 / BINS))
    return float(low), float(high)


def fraction_plot(axis: str, test: FractionTest) -> Markup:
    """Plot the histogram over the pixel with the 99 % interval of the counts."""
    total = int(test.counts.sum())
    low, high = expected_range(total)
    axes = svg.Axes((-0.5, 0.5), (0.0, 1.15 * max(float(test.counts.max()), high, 1.0)), width=330.0, height=220.0)
    edges = np.linspace(-0.5, 0.5, BINS + 1)
    band = svg.tag(
        "rect",
        x=axes.left,
        y=float(axes.y(high)),
        width=axes.width - axes.left - axes.right,
        height=float(axes.y(low) - axes.y(high)),
        class_="expected",
    )
    bars = _columns(axes, edges, test.counts)
    label = f"{axis} position less the pixel's centre (px)"
    title = f"Histogram of the fractional parts of the {axis} positions"
    return svg.picture(axes.width, axes.height, title, *bars, band, axes.grid(label, "marks"))


def _columns(axes: svg.Axes, edges: Array, counts: NDArray[np.int64]) -> Iterator[Markup]:
    total = int(counts.sum())
    for left, right, count in zip(edges[:-1], edges[1:], counts.tolist(), strict=True):
        yield svg.tag(
            "rect",
            svg.tag("title", f"{count} of {total}"),
            x=float(axes.x(left)) + 1.0,
            y=float(axes.y(count)),
            width=float(axes.x(right) - axes.x(left)) - 2.0,
            height=float(axes.y(0.0) - axes.y(count)),
            class_="column",
        )
