"""Drawing in SVG: elements, and the axes of a chart."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def tag(name: str, *content: str, **attributes: object) -> Markup:
    """One element; an underscore in an attribute's name stands for a hyphen, one at its end (class_) for nothing."""
    pairs = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(_text(value))}"' for key, value in attributes.items()
    )
    inside = "".join(str(escape(item)) for item in content)
    return Markup(f"<{name}{pairs}>{inside}</{name}>")


def picture(width: float, height: float, title: str, *content: Markup, class_: str = "plot") -> Markup:
    """A whole drawing; `title` is what a reader who cannot see it is told."""
    return tag(
        "svg",
        *content,
        class_=class_,
        role="img",
        aria_label=title,
        viewBox=f"0 0 {width:g} {height:g}",
        width=f"{width:g}",
        height=f"{height:g}",
    )


def line(x: ArrayLike, y: ArrayLike, class_: str, closed: bool = False) -> Markup:
    """A polyline, or a filled shape where it is closed."""
    points = [f"{px:.1f} {py:.1f}" for px, py in zip(np.ravel(x), np.ravel(y), strict=True)]
    return tag("path", d="M" + "L".join(points) + ("Z" if closed else ""), class_=class_)


def strokes(starts: Array, ends: Array, class_: str) -> Markup:
    """Many straight strokes in one element: starts and ends (n, 2)."""
    d = "".join(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" for (x0, y0), (x1, y1) in zip(starts, ends, strict=True))
    return tag("path", d=d, class_=class_)


def words(x: float, y: float, content: str, class_: str = "label", anchor: str = "start") -> Markup:
    return tag("text", content, x=x, y=y, class_=class_, text_anchor=anchor)


@dataclass(frozen=True)
class Axes:
    """A chart's plane: data ranges drawn into width x height px, with room for labels at the left and below."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    width: float = 620.0
    height: float = 300.0
    left: float = 62.0
    right: float = 14.0
    top: float = 12.0
    bottom: float = 44.0

    def x(self, value: ArrayLike) -> Array:
        low, high = self.x_range
        span = self.width - self.left - self.right
        return self.left + (np.asarray(value, dtype=float) - low) / (high - low) * span

    def y(self, value: ArrayLike) -> Array:
        low, high = self.y_range
        span = self.height - self.top - self.bottom
        return self.height - self.bottom - (np.asarray(value, dtype=float) - low) / (high - low) * span

    def drawn(self, x_label: str, y_label: str) -> Markup:
        """Grid, ticks and labels."""
        x_ticks, y_ticks = ticks(*self.x_range, self.width / 50.0), ticks(*self.y_range, self.height / 28.0)
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
                *(line((x, x), (y_bottom, y_bottom + 4.0), "axis") for x in self.x(x_ticks)),
                line((x_left, x_right), (y_bottom, y_bottom), "axis"),
                *(
                    words(x, y_bottom + 17.0, _tick_text(t), "tick", "middle")
                    for t, x in zip(x_ticks, self.x(x_ticks), strict=True)
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


def ticks(low: float, high: float, most: float) -> list[float]:
    """Round values inside of a range, `most` of them or fewer."""
    step = 1.0 / round_step(most / (high - low))  # the smallest round step that is not too fine
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [i * step for i in range(first, last + 1)]


def round_step(size: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `size`."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(power * max((m for m in (1.0, 2.0, 5.0) if m <= size / power * (1.0 + 1e-9)), default=1.0))


def _tick_text(value: float) -> str:
    return f"{value:.6g}".replace("-", "−")


def _text(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
