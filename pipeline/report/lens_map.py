"""What the distortion does over the frame, as a grid of vectors: the only picture of a family that is not radial."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.functional_model.lens import Lens
from pipeline.drawing import svg
from pipeline.report.lens import displacement_covariance
from pipeline.report.numbers import value_and_sigma
from pipeline.report.vectors import Plane, strokes_and_dots
from pipeline.types import Array, Mask

GRID = 15  # vectors along the longer side
LONGEST = 1.5  # of the grid's mesh
ARCS = 180  # of the circle about what was observed


@dataclass(frozen=True)
class LensMap:
    """The drawing, and the largest displacement in it with its sigma, ready to print; extrapolated: whether some of it
    lies beyond the outermost target."""

    plot: Markup
    extrapolated: bool
    largest_um: tuple[str, str]


def lens_map(of: Lens, on: Plane, observed_radius_mm: float = np.inf) -> LensMap:
    """The displacement at a grid of observed points over a plane, from the ideal to the observed place; grey beyond the
    outermost target, where it is extrapolated."""
    xy = _grid(on)
    xy = xy[of.displacement(xy - of.interior[1:]).imaged]  # a fisheye's image does not fill the corners
    moved = of.displacement(xy - of.interior[1:])
    size = np.hypot(*moved.value_um.T)
    at = int(size.argmax())
    by = (moved.value_um[at] / max(float(size[at]), 1e-12)) @ moved.by_unknowns_um[at]
    sigma = float(np.sqrt(max(by @ displacement_covariance(of) @ by, 0.0)))
    beyond = np.hypot(*(xy - of.interior[1:]).T) > observed_radius_mm
    edge = _circle(of.interior[1:], observed_radius_mm, on) if beyond.any() else Markup("")
    drawn = _map_picture(xy, moved.value_um, beyond, edge, on)
    return LensMap(drawn, bool(beyond.any()), value_and_sigma(float(size[at]), sigma))


def _circle(center_mm: Array, radius_mm: float, on: Plane) -> Markup:
    """What of a circle lies on the plane."""
    angles = np.linspace(0.0, 2.0 * np.pi, ARCS + 1)
    points = center_mm + radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    low, high = on.corners_mm
    inside = ((points >= low) & (points <= high)).all(axis=1)
    shown = inside[:-1] & inside[1:]
    return svg.strokes(on.page(points[:-1][shown]), on.page(points[1:][shown]), "reach")


def _grid(on: Plane) -> Array:
    """(n, 2) the middles of a mesh of squares over the plane, mm."""
    low, high = on.corners_mm
    mesh = float((high - low).max()) / GRID
    counts = np.maximum(np.rint((high - low) / mesh), 1.0).astype(int)
    x, y = (
        first + (last - first) * (np.arange(count) + 0.5) / count
        for first, last, count in zip(low, high, counts, strict=True)
    )
    return np.stack([each.ravel() for each in np.meshgrid(x, y)], axis=1)


def _map_picture(xy_mm: Array, value_um: Array, beyond: Mask, edge: Markup, on: Plane) -> Markup:
    longest_um = float(np.hypot(*value_um.T).max())
    mesh_px = on.px_per_mm * float((on.corners_mm[1] - on.corners_mm[0]).max()) / GRID
    px_per_um = svg.round_step(LONGEST * mesh_px / longest_um) if longest_um > 0.0 else 1.0
    ends = on.page(xy_mm)
    starts = ends - px_per_um * value_um * (1.0, -1.0)
    return on.picture(
        "Distortion vectors over the camera frame",
        px_per_um,
        edge,
        *(
            strokes_and_dots(starts[rows], ends[rows], kind, ends[rows])
            for rows, kind in ((~beyond, "target"), (beyond, "extrapolated"))
            if rows.any()
        ),
    )
