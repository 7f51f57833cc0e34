"""The histograms of fractional parts of pixel positions."""

import numpy as np
from markupsafe import Markup

from pipeline.report import svg
from pipeline.report.fractions import BINS, FractionTest, expected_range


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
    bars = [
        svg.tag(
            "rect",
            svg.tag("title", f"{count} of {total}"),
            x=float(axes.x(left)) + 1.0,
            y=float(axes.y(count)),
            width=float(axes.x(right) - axes.x(left)) - 2.0,
            height=float(axes.y(0.0) - axes.y(count)),
            class_="column",
        )
        for left, right, count in zip(edges[:-1], edges[1:], test.counts.tolist(), strict=True)
    ]
    label = f"{axis} position less the pixel's centre (px)"
    title = f"Histogram of the fractional parts of the {axis} positions"
    return svg.picture(axes.width, axes.height, title, *bars, band, axes.drawn(label, "marks"))
