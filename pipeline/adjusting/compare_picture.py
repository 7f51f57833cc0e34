"""A picture of calibrations compared: the difference from the first one over the frame, with its confidence."""

from pathlib import Path

import numpy as np

from adjust.choices.comparison import Comparison
from pipeline.text.atomic import atomic_path

_RADII = 2.447747  # sigmas: the radius of an ellipse that holds 95 % of a plane's normal distribution
_ARROW = 0.11  # of the frame's width: the longest arrow, or half the longest axis of an ellipse


def draw_comparison(comparison: Comparison, path: Path) -> None:
    """Write a PNG: an arrow a place, from where the first calibration sees it, and an ellipse of 95 % about its tip.

    Raises InputError where the file cannot be written.
    """
    # Slow to import, and nothing but pictures needs it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Ellipse

    count = len(comparison.field_um)
    figure = Figure(figsize=(5.6 * count, 6.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    places = comparison.places_mm
    width = float(np.ptp(places[:, 0]))
    longest = max(float(np.hypot(*comparison.field_um.T).max()), _RADII * float(comparison.field_sigma_um.max()), 1e-6)
    scale = _ARROW * width / longest  # mm of the picture to a um
    for k, axes in enumerate(figure.subplots(1, count, squeeze=False)[0]):
        field, sigma = comparison.field_um[k], comparison.field_sigma_um[k]
        axes.quiver(*places.T, *(scale * field).T, angles="xy", scale_units="xy", scale=1.0, width=0.004, color="C0")
        for tip, axis in zip(places + scale * field, 2 * _RADII * scale * sigma, strict=True):
            axes.add_patch(Ellipse((tip[0], tip[1]), axis[0], axis[1], fill=False, color="0.45", linewidth=0.8))
        first, other = comparison.calibrations[0].name, comparison.calibrations[k + 1].name
        axes.set_title(f"{other} less {first}: longest arrow {np.hypot(*field.T).max():.2f} um", fontsize=10)
        axes.set_aspect("equal")
        axes.margins(0.16)
        axes.set_xlabel("x' (mm), ellipses of 95 %")
        axes.set_ylabel("y' (mm)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
