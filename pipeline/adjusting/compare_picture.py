"""A picture of calibrations compared: the difference from the first one over the frame, with its confidence."""

from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from adjust.quality.lens_comparison import Comparison
from pipeline.drawing import svg

Array = NDArray[np.float64]

_LONGEST = 0.11  # of the frame's width: an arrow, or half the longest axis of an ellipse
_PANEL_PX = 520.0
_MARGIN_PX = 74.0


def draw_comparison(comparison: Comparison, path: Path) -> None:
    """Write an SVG: an arrow a place, from where the first calibration sees it, and an ellipse of 95 % about its tip;
    of a series the steady change besides.

    Raises InputError where the file cannot be written.
    """
    width_mm, height_mm = np.ptp(comparison.places_mm, axis=0)
    px_per_mm = (_PANEL_PX - 2.0 * _MARGIN_PX) / float(width_mm)
    height = float(height_mm) * px_per_mm + 2.0 * _MARGIN_PX + 24.0
    low_mm = comparison.places_mm.min(axis=0)
    starts = (comparison.places_mm - low_mm) * px_per_mm * (1.0, -1.0) + (_MARGIN_PX, height - _MARGIN_PX)
    first, *others = (each.name for each in comparison.calibrations)
    titles = [f"{other} less {first}" for other in others]
    fields = list(zip(comparison.field_um, comparison.field_covariance_um2, strict=True))
    if comparison.trend is not None:
        titles.append(f"steady change from {first} to {others[-1]}")
        fields.append((comparison.trend_um, comparison.trend_covariance_um2))
    longest_um = max(1e-6, *(max(_longest(um), float(svg.ellipse_axes(each)[0].max())) for um, each in fields))
    px_per_um = _LONGEST * float(width_mm) * px_per_mm / longest_um
    panels = [_panel(title, *field, starts, px_per_um) for title, field in zip(titles, fields, strict=True)]
    placed = [svg.tag("g", *each, transform=f"translate({k * _PANEL_PX:.0f} 0)") for k, each in enumerate(panels)]
    title = "Calibrations compared: how far apart they see a place of the frame, with ellipses of 95 %"
    svg.write_picture(path, _PANEL_PX * len(panels), height, title, *placed)


def _panel(title: str, field_um: Array, covariance_um2: Array, starts: Array, px_per_um: float) -> tuple[Markup, ...]:
    """A field as arrows; starts (m, 2) in px of the panel."""
    ends = starts + px_per_um * field_um * (1.0, -1.0)
    radii_um, angles = svg.ellipse_axes(covariance_um2)
    (left, top), (right, bottom) = starts.min(axis=0) - 24.0, starts.max(axis=0) + 24.0
    um = svg.round_step(_LONGEST * (right - left) / px_per_um)
    return (
        svg.words(left, 24.0, title, "label"),
        svg.words(left, 42.0, f"longest arrow {_longest(field_um):.2f} µm", "tick"),
        svg.tag("rect", x=left, y=top, width=right - left, height=bottom - top, class_="frame"),
        *svg.ellipses(ends, px_per_um * radii_um, angles),
        svg.strokes(starts, ends, "vector target"),
        svg.strokes(starts, starts, "dot target"),
        svg.line((left, left + um * px_per_um), (bottom + 16.0, bottom + 16.0), "bar"),
        svg.words(left + um * px_per_um + 8.0, bottom + 20.0, f"{um:g} µm, ellipses of 95 %", "tick"),
    )


def _longest(field_um: Array) -> float:
    return float(np.hypot(*field_um.T).max())
