"""Maps over a camera's frame: coverage by observations, and contours of a standard deviation."""

import numpy as np
from markupsafe import Markup
from skimage.measure import find_contours

from pipeline.drawing import svg
from pipeline.report.vectors import Plane
from pipeline.types import Array

CELLS = 12  # along the longer side of the frame
LEVELS = 7  # approximate number of contours
LABEL_ROOM_PX = 46.0  # px, smallest distance between contour labels


def coverage_counts(on: Plane, places_mm: Array) -> tuple[Array, Array, Array]:
    """Count places (n, 2) in square cells of the plane; returns counts (row from below, column) and the cell edges x
    and y."""
    low, high = on.corners_mm
    counts = np.maximum(np.rint(CELLS * (high - low) / (high - low).max()), 1.0).astype(int)
    x, y = (np.linspace(first, last, count + 1) for first, last, count in zip(low, high, counts, strict=True))
    return np.histogram2d(places_mm[:, 1], places_mm[:, 0], (y, x))[0], x, y


def coverage_plot(on: Plane, places_mm: Array) -> Markup:
    """Plot the cells of a frame, the darker the more observations they contain."""
    counts, x, y = coverage_counts(on, places_mm)
    drawn = []
    for row, column in np.argwhere(counts > 0):
        (left, right), (top, bottom) = on.page(np.array([[x[column], y[row + 1]], [x[column + 1], y[row]]])).T
        opacity = 0.15 + 0.75 * float(np.sqrt(counts[row, column] / counts.max()))
        hint = svg.tag("title", f"{counts[row, column]:.0f}")
        size = {"width": right - left, "height": bottom - top}
        drawn.append(svg.tag("rect", hint, x=left, y=top, **size, class_="covered", fill_opacity=opacity))
    return on.picture("Number of observations over the camera frame", None, *drawn)


def contour_plot(on: Plane, x_mm: Array, y_mm: Array, sigma_um: Array, title: str) -> Markup | None:
    """Plot contours of a standard deviation over a frame, labelled in the plane's unit; None if it is 0 everywhere.

    Parameters
    ----------
    x_mm, y_mm : (m,), (n,) the grid, ascending
    sigma_um : (n, m) at its nodes, NaN where the camera forms no image
    """
    sigma = on.unit.per_um * sigma_um
    high = float(np.nanmax(sigma, initial=0.0))
    if not high > 0.0:
        return None
    drawn, labels = [], list[tuple[float, float, str]]()
    for level in _levels(float(np.nanmin(sigma)), high):
        for line in find_contours(sigma, level):
            row, column = line.T
            mm = np.stack([_interpolated(column, x_mm), _interpolated(row, y_mm)], axis=1)
            page = on.page(mm)
            drawn.append(svg.line(page[:, 0], page[:, 1], "contour"))
            free = [at for at in page.tolist() if _is_apart(at, labels)]
            if len(line) > 3 and free:
                labels.append((*free[len(free) // 2], f"{level:g}"))
    names = [svg.words(px, py + 4.0, text, "contour-label", "middle") for px, py, text in labels]
    return on.picture(title, None, *drawn, *names)


def _levels(low: float, high: float) -> list[float]:
    """Round contour levels: equally spaced, or 1, 2, 5 times powers of ten if the range exceeds a factor of five."""
    if high > 5.0 * low:
        powers = 10.0 ** np.arange(np.floor(np.log10(max(low, 1e-3 * high))), np.ceil(np.log10(high)) + 1.0)
        return [float(f"{m * power:.3g}") for power in powers for m in (1.0, 2.0, 5.0) if low < m * power < high]
    return [float(f"{each:.6g}") for each in svg.ticks(low, high, LEVELS)]


def _interpolated(position: Array, axis_mm: Array) -> Array:
    return np.interp(position, np.arange(len(axis_mm)), axis_mm)


def _is_apart(at: list[float], labels: list[tuple[float, float, str]]) -> bool:
    return all(np.hypot(at[0] - x, at[1] - y) > LABEL_ROOM_PX for x, y, _ in labels)
