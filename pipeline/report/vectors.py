"""Plots over the camera frame: vectors (residuals, partial scans, distortion, scanner), coverage, and contours."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from skimage.measure import find_contours

from adjust.display import CELLS
from pipeline.drawing import svg
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.types import Array, Mask

MARGIN_PX = 26.0
FOOT_PX = 30.0
LEAST_UM = 0.01  # µm, smallest residual that sets the scale: without redundancy residuals are rounding errors

LEVELS = 7  # approximate number of contours
LABEL_ROOM_PX = 46.0  # px, smallest distance between contour labels
EDGE = 0.05  # of the frame: a label nearer to its edge would be cut


@dataclass(frozen=True)
class Plane:
    """Camera frame on the page. corners_mm: (2, 2) lower left and upper right, y up; unit: of the scale bars."""

    corners_mm: Array
    width_px: float
    unit: ImageUnit = FILM_UNIT

    @property
    def px_per_mm(self) -> float:
        return (self.width_px - 2.0 * MARGIN_PX) / float(self.corners_mm[1, 0] - self.corners_mm[0, 0])

    @property
    def height_px(self) -> float:
        return float(self.corners_mm[1, 1] - self.corners_mm[0, 1]) * self.px_per_mm + 2.0 * MARGIN_PX

    def page(self, xy_mm: Array) -> Array:
        """Convert (n, 2) camera coordinates, mm, to page pixels, y down."""
        low_x, high_y = self.corners_mm[0, 0], self.corners_mm[1, 1]
        return MARGIN_PX + self.px_per_mm * np.stack([xy_mm[:, 0] - low_x, high_y - xy_mm[:, 1]], axis=1)

    def picture(self, title: str, px_per_um: float | None, *content: Markup) -> Markup:
        """Draw the frame's outline and content, with scale bars below for the vectors, if any, and for the frame."""
        (x0, y0), (x1, y1) = self.page(self.corners_mm)
        outline = svg.tag("rect", x=x0, y=y1, width=x1 - x0, height=y0 - y1, class_="frame")
        bars = [(self.px_per_mm / self.unit.per_mm, f"{self.unit.long_name} (frame)")]
        if px_per_um is not None:
            bars.insert(0, (px_per_um / self.unit.per_um, f"{self.unit.short_name} (vectors)"))
        drawn = []
        for row, (px_per_unit, words) in enumerate(bars):
            length, y = svg.round_step(60.0 / px_per_unit), self.height_px + 4.0 + 15.0 * row
            drawn.append(svg.scale_bar(MARGIN_PX, y, length * px_per_unit, f"{length:g} {words}"))
        return svg.picture(self.width_px, self.height_px + FOOT_PX, title, outline, *content, *drawn)


@dataclass(frozen=True)
class VectorField:
    """Vectors (n, 2), µm, at places (n, 2), mm, in the camera frame; is_fiducial: (n,) mask of fiducial marks."""

    places_mm: Array
    vectors_um: Array
    is_fiducial: Mask

    @classmethod
    def from_residuals(cls, rows: Sequence[ResidualRecord]) -> "VectorField":
        """Residuals in camera coordinates."""
        numbers = [(row.camera_x_mm, row.camera_y_mm, row.camera_vx_um, row.camera_vy_um) for row in rows]
        places, vectors = np.hsplit(np.array(numbers, dtype=float).reshape(-1, 4), 2)
        return cls(places, vectors, np.array([row.kind == "fiducial" for row in rows], dtype=bool))

    def scale(self, longest_px: float) -> float:
        """Page pixels per µm, a round number: the 99th percentile of the lengths is drawn `longest_px` long at most."""
        length = float(np.percentile(np.hypot(*self.vectors_um.T), 99.0))
        return svg.round_step(longest_px / max(length, LEAST_UM))

    def ends(self, on: Plane, px_per_um: float) -> tuple[Array, Array]:
        """Starts and ends (n, 2) of the vectors on the page."""
        starts = on.page(self.places_mm)
        return starts, starts + px_per_um * self.vectors_um * (1.0, -1.0)


def plane(
    places_mm: Array, frame_mm: tuple[float, float] | None, width_px: float, unit: ImageUnit = FILM_UNIT
) -> Plane:
    """Plane of the camera's frame; of the observations if its size is unknown or it does not enclose them (digital
    cameras, whose origin is not the centre)."""
    low, high = places_mm.min(axis=0), places_mm.max(axis=0)
    half = 0.5 * np.array(frame_mm) if frame_mm is not None else np.zeros(2)
    if np.all(np.abs([low, high]) <= half):
        low, high = -half, half
    return padded_plane(np.stack([low, high]), width_px, unit=unit)


def padded_plane(corners_mm: Array, width_px: float, share: float = 0.02, unit: ImageUnit = FILM_UNIT) -> Plane:
    """Plane between two corners (2, 2) with a margin: a share of its longer side."""
    # The margin has a minimum, so that a single point or collinear points have a plane.
    room = share * max(float(np.ptp(corners_mm, axis=0).max()), 1.0)
    return Plane(corners_mm + np.array([[-room], [room]]), width_px, unit)


def grid_mm(axes: Iterable[Array]) -> Array:
    """(n, 2) nodes of a grid from its x and y values."""
    return np.stack([each.ravel() for each in np.meshgrid(*axes)], axis=1)


def longest_vector(vectors_um: Array, covariances_um2: Array) -> tuple[float, float]:
    """Length of the longest of vectors (n, 2), and its standard deviation; covariances_um2: (n, 2, 2)."""
    size = np.hypot(*vectors_um.T)
    at = int(size.argmax())
    along = vectors_um[at] / max(float(size[at]), 1e-12)
    return float(size[at]), float(np.sqrt(max(along @ covariances_um2[at] @ along, 0.0)))


def all_images_plot(residuals: VectorField, on: Plane, px_per_um: float) -> Markup:
    """Plot the residuals of all images in one frame: a common pattern is due to the camera, not to the film."""
    starts, ends = residuals.ends(on, px_per_um)
    kinds = (("target", ~residuals.is_fiducial), ("fiducial", residuals.is_fiducial))
    drawn = [strokes_and_dots(starts[rows], ends[rows], kind) for kind, rows in kinds]
    return on.picture("Residual vectors of all images over the camera frame", px_per_um, *drawn)


def strokes_and_dots(starts: Array, ends: Array, kind: str, dots: Array | None = None) -> Markup:
    """Draw vectors with a dot at each start, or at the places `dots`."""
    at = starts if dots is None else dots
    return svg.strokes(starts, ends, f"vector {kind}") + svg.strokes(at, at, f"dot {kind}")


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

    Levels are round: equally spaced, or 1, 2, 5 times powers of ten if the range exceeds a factor of five.

    Parameters
    ----------
    x_mm, y_mm : (m,), (n,) the grid, ascending
    sigma_um : (n, m) at its nodes, NaN where the camera forms no image
    """
    sigma = on.unit.per_um * sigma_um
    low, high = float(np.nanmin(sigma, initial=np.inf)), float(np.nanmax(sigma, initial=0.0))
    if not high > 0.0:
        return None
    if high > 5.0 * low:
        powers = 10.0 ** np.arange(np.floor(np.log10(max(low, 1e-3 * high))), np.ceil(np.log10(high)) + 1.0)
        levels = [float(f"{m * power:.3g}") for power in powers for m in (1.0, 2.0, 5.0) if low < m * power < high]
    else:
        levels = [float(f"{each:.6g}") for each in svg.ticks(low, high, LEVELS)]
    drawn, labels = [], list[tuple[float, float, str]]()
    (left, bottom), (right, top) = on.page(on.corners_mm + EDGE * np.ptp(on.corners_mm, axis=0) * [[1.0], [-1.0]])
    for level in levels:
        for line in find_contours(sigma, level):
            nodes = zip(line.T[::-1], (x_mm, y_mm), strict=True)
            page = on.page(np.stack([np.interp(at, np.arange(len(axis)), axis) for at, axis in nodes], axis=1))
            drawn.append(svg.line(page[:, 0], page[:, 1], "contour"))
            inside = [(x, y) for x, y in page.tolist() if left < x < right and top < y < bottom]
            free = [at for at in inside if all(math.dist(at, label[:2]) > LABEL_ROOM_PX for label in labels)]
            if len(line) > 3 and free:
                labels.append((*free[len(free) // 2], f"{level:g}"))
    names = [svg.words(px, py + 4.0, text, "contour-label", "middle") for px, py, text in labels]
    return on.picture(title, None, *drawn, *names)
