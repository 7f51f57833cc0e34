"""Drawing in SVG: elements, chart axes, and SVG files."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike
from scipy.special import chdtri

from pipeline.text.files import write_atomically
from pipeline.types import Array


def style() -> str:
    """CSS of all drawings."""
    return (files("pipeline.drawing") / "drawing.css").read_text(encoding="utf-8")


def write_picture(path: Path, width: float, height: float, title: str, *content: Markup) -> None:
    """Write a drawing on white to a file; `title` as in `picture`. Raises InputError if it cannot be written."""
    ground = tag("rect", width=width, height=height, fill="white")
    css = tag("style", Markup(style() + "svg { font-family: sans-serif; }"))
    drawn = picture(width, height, title, css, ground, *content, xmlns="http://www.w3.org/2000/svg")
    write_atomically(path, str(drawn) + "\n")


def tag(name: str, *content: str, **attributes: object) -> Markup:
    """SVG element; underscores in attribute names become hyphens, a trailing one (class_) is removed."""
    pairs = ""
    for key, value in attributes.items():
        text = f"{value:.2f}" if isinstance(value, float) else str(value)
        pairs += f' {key.rstrip("_").replace("_", "-")}="{escape(text)}"'
    inside = "".join(str(escape(item)) for item in content)
    return Markup(f"<{name}{pairs}>{inside}</{name}>")


def picture(
    width: float, height: float, title: str, *content: Markup, class_: str = "plot", **attributes: str
) -> Markup:
    """Complete drawing. title: text for screen readers; attributes: as in `tag`."""
    return tag(
        "svg",
        *content,
        class_=class_,
        role="img",
        aria_label=title,
        viewBox=f"0 0 {width:g} {height:g}",
        width=f"{width:g}",
        height=f"{height:g}",
        **attributes,
    )


def line(x: ArrayLike, y: ArrayLike, class_: str, closed: bool = False) -> Markup:
    """Polyline, or a filled shape if closed."""
    points = [f"{px:.1f} {py:.1f}" for px, py in zip(np.ravel(x), np.ravel(y), strict=True)]
    return tag("path", d="M" + "L".join(points) + ("Z" if closed else ""), class_=class_)


def strokes(starts: Array, ends: Array, class_: str) -> Markup:
    """Straight strokes in one element: starts and ends (n, 2)."""
    d = "".join(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" for (x0, y0), (x1, y1) in zip(starts, ends, strict=True))
    return tag("path", d=d, class_=class_)


def words(x: float, y: float, content: str, class_: str = "label", anchor: str = "start") -> Markup:
    return tag("text", content, x=x, y=y, class_=class_, text_anchor=anchor)


def scale_bar(x: float, y: float, length: float, text: str) -> Markup:
    """Scale bar with a label."""
    ends = (x, x, x, x + length, x + length, x + length)
    return line(ends, (y - 3, y + 3, y, y, y - 3, y + 3), "bar") + words(x + length + 6.0, y + 4.0, text, "tick")


def ellipse_axes(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (n, 2) of 95 % ellipses, the larger one last, and its direction (n,), degrees counter-clockwise from x;
    covariance: (n, 2, 2)."""
    variances, directions = np.linalg.eigh(covariance)
    angles = np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1]))
    return np.sqrt(chdtri(2, 0.05) * np.maximum(variances, 0.0)), angles


def ellipses(centers: Array, radii_px: Array, angles_deg: Array) -> Iterator[Markup]:
    """Yield ellipses around centers (n, 2); radii and angles as from `ellipse_axes`."""
    for (x, y), (minor, major), angle in zip(centers, radii_px, angles_deg, strict=True):
        yield tag(
            "ellipse",
            rx=float(major),
            ry=float(minor),
            transform=f"translate({x:.2f} {y:.2f}) rotate({-angle:.2f})",
            class_="ellipse",
        )


@dataclass(frozen=True)
class Axes:
    """Axes of a chart of width x height px, with margins for the labels.

    x_is_log, y_is_log: whether an axis is logarithmic; x_ticks: labels of the x ticks by value, None for round values.
    """

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    width: float = 620.0
    height: float = 300.0
    left: float = 62.0
    right: float = 14.0
    top: float = 12.0
    bottom: float = 44.0
    x_is_log: bool = False
    y_is_log: bool = False
    x_ticks: Mapping[float, str] | None = None

    def x(self, value: ArrayLike) -> Array:
        return self.left + _share(value, self.x_range, self.x_is_log) * (self.width - self.left - self.right)

    def y(self, value: ArrayLike) -> Array:
        span = self.height - self.top - self.bottom
        return self.height - self.bottom - _share(value, self.y_range, self.y_is_log) * span

    def grid(self, x_label: str, y_label: str) -> Markup:
        """Draw grid, ticks and labels."""
        x_ticks = self.x_ticks
        if x_ticks is None:
            x_ticks = {t: _tick_text(t) for t in _ticks(self.x_range, self.x_is_log, self.width / 50.0)}
        at_x = self.x(list(x_ticks))
        y_ticks = _ticks(self.y_range, self.y_is_log, self.height / 28.0)
        x_left, x_right = self.left, self.width - self.right
        y_top, y_bottom = self.top, self.height - self.bottom
        middle = 0.5 * (y_top + y_bottom)
        grid = [
            line((x_left, x_right), (y, y), "zero" if t == 0.0 else "grid")
            for t, y in zip(y_ticks, self.y(y_ticks), strict=True)
        ]
        return Markup("").join(
            [
                *grid,
                *(line((x, x), (y_bottom, y_bottom + 4.0), "axis") for x in at_x),
                line((x_left, x_right), (y_bottom, y_bottom), "axis"),
                *(
                    words(x, y_bottom + 17.0, text, "tick", "middle")
                    for text, x in zip(x_ticks.values(), at_x, strict=True)
                ),
                *(
                    words(x_left - 7.0, y + 4.0, _tick_text(t), "tick", "end")
                    for t, y in zip(y_ticks, self.y(y_ticks), strict=True)
                ),
                words(0.5 * (x_left + x_right), self.height - 6.0, x_label, "label", "middle"),
                tag(
                    "text",
                    y_label,
                    class_="label",
                    text_anchor="middle",
                    transform=f"translate(14 {middle:.1f}) rotate(-90)",
                ),
            ]
        )


def _share(value: ArrayLike, limits: tuple[float, float], is_log: bool) -> Array:
    """Relative position of values between the limits, 0 to 1."""
    values, (low, high) = np.asarray(value, dtype=float), limits
    if is_log:
        values, low, high = np.log(values), np.log(low), np.log(high)
    return (values - low) / (high - low)


def _ticks(limits: tuple[float, float], is_log: bool, most: float) -> list[float]:
    """Round values within the limits; for a wide logarithmic axis 1, 2 and 5 times powers of ten."""
    low, high = limits
    if not is_log or high < 5.0 * low:
        return ticks(low, high, most)
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    every = (1.0, 2.0, 5.0) if 3 * len(powers) <= most else (1.0,)
    return [float(m * power) for power in powers for m in every if low <= m * power <= high]


def ticks(low: float, high: float, most: float) -> list[float]:
    """Round values within a range, `most` at most."""
    step = 1.0 / round_step(most / (high - low))  # smallest round step that gives at most that many
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [i * step for i in range(first, last + 1)]


def round_step(size: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that does not exceed `size`."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(power * max((m for m in (1.0, 2.0, 5.0) if m <= size / power * (1.0 + 1e-9)), default=1.0))


def _tick_text(value: float) -> str:
    return f"{value:.6g}".replace("-", "−")
