"""A picture of a sweep: the camera's standard deviations over the quantity that was varied."""

import math
from pathlib import Path

from markupsafe import Markup

from pipeline.design.sweeps import Swept
from pipeline.drawing import svg

WIDE_RANGE = 2.0  # ratio of the largest to the smallest value from which on the axis is logarithmic
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555")  # told apart by the color-blind
DASHES = ("none", "7 3", "2 3", "7 3 2 3")
WIDTH_PX, HEIGHT_PX, KEY_PX = 760.0, 460.0, 160.0
ROW_PX = 17.0  # of a name beside the chart


def plot_sweep(swept: Swept, path: Path) -> None:
    """Write an SVG: every standard deviation as a share of that at the first value where it has one.

    Only so do quantities of different units go on one axis. Raises InputError where the file cannot be written.
    """
    values = [step.value for step in swept.steps]
    places = [float(value) for value in values] if swept.numeric else [float(i) for i in range(len(values))]
    shares = {name: _relative([step.sigmas.mean.get(name, math.nan) for step in swept.steps]) for name in swept.names}
    axes = _axes(swept, places, shares)
    curves = [_curve(axes, number, places, each) for number, each in enumerate(shares.values())]
    key = [_key(axes, number, name) for number, name in enumerate(shares)]
    chart = axes.drawn(swept.quantity, "expected standard deviation, first value = 1")
    height = max(axes.height, axes.top + ROW_PX * (len(key) + 1))
    svg.write_picture(path, axes.width, height, f"Expected precision over {swept.quantity}", chart, *curves, *key)


def _axes(swept: Swept, places: list[float], shares: dict[str, list[float]]) -> svg.Axes:
    """The chart's plane, with room for the names at its right."""
    drawn = [share for each in shares.values() for share in each if math.isfinite(share)] or [1.0]
    is_log = swept.numeric and min(places) > 0.0 and max(places) >= WIDE_RANGE * min(places)
    width = max(places) - min(places)
    if is_log:
        edge = (max(places) / min(places)) ** 0.04
        x_range = (min(places) / edge, max(places) * edge)
    else:
        x_range = (min(places) - 0.04 * width, max(places) + 0.04 * width) if width else (places[0] - 1, places[0] + 1)
    texts = [f"{step.value:g}" if not isinstance(step.value, str) else step.value for step in swept.steps]
    return svg.Axes(
        x_range,
        (min(drawn) / 1.1, max(drawn) * 1.1),
        width=WIDTH_PX,
        height=HEIGHT_PX,
        right=KEY_PX,
        x_is_log=is_log,
        y_is_log=True,
        x_ticks=dict(zip(places, texts, strict=True)),
    )


def _curve(axes: svg.Axes, number: int, places: list[float], shares: list[float]) -> Markup:
    """A line through the values that there are, interrupted where there is none, and a dot at each."""
    pixels = [(float(axes.x(place)), float(axes.y(share))) for place, share in zip(places, shares, strict=True)]
    there = [math.isfinite(share) for share in shares]
    pairs = zip(pixels, pixels[1:], there, there[1:], strict=False)
    path = "".join(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" for (x0, y0), (x1, y1), a, b in pairs if a and b)
    dots = [
        svg.tag("circle", cx=x, cy=y, r=2.5, fill=_color(number)) for (x, y), a in zip(pixels, there, strict=True) if a
    ]
    return _stroke(number, path) + Markup("").join(dots)


def _key(axes: svg.Axes, number: int, name: str) -> Markup:
    x, y = axes.width - axes.right + 10.0, axes.top + ROW_PX * (number + 0.5)
    return _stroke(number, f"M{x:.1f} {y:.1f}h26") + svg.words(x + 32.0, y + 4.0, name, "tick")


def _stroke(number: int, path: str) -> Markup:
    dash = DASHES[number // len(COLORS) % len(DASHES)]
    return svg.tag("path", d=path, fill="none", stroke=_color(number), stroke_width=1.6, stroke_dasharray=dash)


def _color(number: int) -> str:
    return COLORS[number % len(COLORS)]


def _relative(sigmas: list[float]) -> list[float]:
    """Shares of the first that is finite; nan where there is none."""
    first = next((sigma for sigma in sigmas if 0.0 < sigma < math.inf), math.nan)
    return [sigma / first if math.isfinite(sigma) else math.nan for sigma in sigmas]
