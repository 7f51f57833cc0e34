"""A picture of calibrations compared: the difference from the first one over the frame, with its confidence."""

from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from adjust.choices.comparison import Comparison
from pipeline.drawing import svg

Array = NDArray[np.float64]

_RADII = 2.447747  # sigmas: the radius of an ellipse that holds 95 % of a plane's normal distribution
_ARROW = 0.11  # of the frame's width: the longest arrow, or half the longest axis of an ellipse
_PANEL_PX = 520.0
_MARGIN_PX = 74.0


def draw_comparison(comparison: Comparison, path: Path) -> None:
    """Write an SVG: an arrow a place, from where the first calibration sees it, and an ellipse of 95 % about its tip.

    Raises InputError where the file cannot be written.
    """
    width_mm, height_mm = np.ptp(comparison.places_mm, axis=0)
    px_per_mm = (_PANEL_PX - 2.0 * _MARGIN_PX) / float(width_mm)
    height = float(height_mm) * px_per_mm + 2.0 * _MARGIN_PX + 24.0
    longest_um = max(_longest(comparison.field_um), _RADII * float(comparison.field_sigma_um.max()), 1e-6)
    px_per_um = _ARROW * float(width_mm) * px_per_mm / longest_um
    low_mm = comparison.places_mm.min(axis=0)
    starts = (comparison.places_mm - low_mm) * px_per_mm * (1.0, -1.0) + (_MARGIN_PX, height - _MARGIN_PX)
    panels = [_panel(comparison, k, starts, px_per_um) for k in range(len(comparison.field_um))]
    title = "Calibrations compared: how far apart they see a place of the frame, with ellipses of 95 %"
    svg.write_picture(path, _PANEL_PX * len(panels), height, title, *panels)


def _panel(comparison: Comparison, k: int, starts: Array, px_per_um: float) -> Markup:
    """One calibration less the first; starts (m, 2) in px of the panel."""
    field_um, sigma_um = comparison.field_um[k], comparison.field_sigma_um[k]
    ends = starts + px_per_um * field_um * (1.0, -1.0)
    first, other = comparison.calibrations[0].name, comparison.calibrations[k + 1].name
    (left, top), (right, bottom) = starts.min(axis=0) - 24.0, starts.max(axis=0) + 24.0
    um = svg.round_step(_ARROW * (right - left) / px_per_um)
    content = (
        svg.words(left, 24.0, f"{other} less {first}: longest arrow {_longest(field_um):.2f} µm", "label"),
        svg.tag("rect", x=left, y=top, width=right - left, height=bottom - top, class_="frame"),
        *(_ellipse(end, _RADII * px_per_um * sigma) for end, sigma in zip(ends, sigma_um, strict=True)),
        svg.strokes(starts, ends, "vector target"),
        svg.strokes(starts, starts, "dot target"),
        svg.line((left, left + um * px_per_um), (bottom + 16.0, bottom + 16.0), "bar"),
        svg.words(left + um * px_per_um + 8.0, bottom + 20.0, f"{um:g} µm, ellipses of 95 %", "tick"),
    )
    return svg.tag("g", *content, transform=f"translate({k * _PANEL_PX:.0f} 0)")


def _ellipse(center: Array, radii_px: Array) -> Markup:
    return svg.tag(
        "ellipse",
        cx=float(center[0]),
        cy=float(center[1]),
        rx=float(radii_px[0]),
        ry=float(radii_px[1]),
        class_="ellipse",
    )


def _longest(field_um: Array) -> float:
    return float(np.sqrt((field_um**2).sum(axis=-1)).max())
