"""Histograms: of fractional parts of pixel positions, of residuals and of standard deviations."""

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.drawing import svg
from pipeline.report.fractions import BINS, Array, FractionTest, expected_range

COLUMNS = 40
TAIL = 0.002  # of the values, on either side: the rest make the scale


def fraction_plot(axis: str, test: FractionTest) -> Markup:
    """Counts over the pixel, with the range in which chance leaves 99 of 100 of them."""
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
    return svg.picture(axes.width, axes.height, title, *bars, band, axes.drawn(label, "marks"))


def histogram(label: str, values: Array) -> Markup:
    """How values (n,) are spread; the few of each side that lie far out are counted in the last column there."""
    low, high = np.quantile(values, (TAIL, 1.0 - TAIL))
    margin = max(0.05 * (high - low), 1e-3 * max(abs(low), abs(high)), 1e-9)
    edges = np.linspace(low - margin, high + margin, COLUMNS + 1)
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    axes = svg.Axes((edges[0], edges[-1]), (0.0, 1.1 * float(counts.max())), width=330.0, height=220.0)
    title = f"Histogram of the {label}"
    return svg.picture(axes.width, axes.height, title, *_columns(axes, edges, counts), axes.drawn(label, "marks"))


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
