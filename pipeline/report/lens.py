"""Distortion of a camera over the radius, as a certificate, and over the frame, with standard deviations from the full
covariance."""

from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from adjust.display import BAND
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Lens
from adjust.problem.parameter import Parameter
from adjust.quality.lens_uncertainty import (
    Curves,
    balanced_distance,
    directions,
    displacement_cofactor,
    distortion_curves,
    function_sigmas,
    is_defined_over_frame,
    radial_part,
)
from pipeline.drawing import svg
from pipeline.report.vectors import Plane, grid_mm, longest_vector, strokes_and_dots
from pipeline.results.adjustment_file import ParameterCovariance
from pipeline.results.adjustment_record import CameraRecord
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.types import Array

FRAME_GRID = 17

# Field angles of the U.S. Geological Survey's calibration reports; those beyond the frame are left out.
ANGLES_DEG = (7.5, 15.0, 22.7, 30.0, 35.0, 40.0)
_FEWEST_ANGLES = 5  # determine the principal distance and three powers, with one redundant value
_CERTIFICATE_RADII = 240
_NEAR_AXIS = 1e-3  # fraction of the largest radius within which the distortion is linear in the radius

MAP_GRID = 15  # vectors along the longer side
LONGEST = 1.5  # longest vector, in grid spacings
MOST_EXTRAPOLATED = 3.0  # of the distortion up to the outermost target, above and below it, that the curves show
ARCS = 180  # line segments of the circle around the observed area


@dataclass(frozen=True)
class CertificateRow:
    """Distortion at an angle from the axis, positive outwards; values in µm with their sigmas."""

    angle_deg: float
    radius_mm: float
    radial: tuple[float, float]
    asymmetric: tuple[float, float]


@dataclass(frozen=True)
class CertificateTable:
    """Distortion in the form of a calibration certificate.

    Attributes
    ----------
    calibrated : principal distance that balances the largest and smallest radial distortion, and its sigma, mm; the
        rows refer to it.
    equivalent : principal distance near the axis, and its sigma, mm.
    reach_mm : radius up to which the distortion is balanced.
    """

    calibrated: tuple[float, float]
    equivalent: tuple[float, float]
    reach_mm: float
    rows: list[CertificateRow]


@dataclass(frozen=True)
class LensMap:
    """Plot of distortion vectors. extrapolated: whether some lie beyond the outermost target; largest_um: longest
    vector with its sigma."""

    plot: Markup
    extrapolated: bool
    largest_um: tuple[float, float]


def lens(name: str, camera: CameraRecord, covariance: ParameterCovariance) -> Lens:
    """Lens of a camera in adjustment.json, with its covariance."""
    known = camera.lens()
    keys = [Parameter.interior(name, each) for each in known.quantities]
    return replace(known, covariance=covariance.select_larger(keys))


def largest_effects_um(lens: Lens, radius_mm: float) -> dict[str, float]:
    """Largest displacement at a radius caused by a unit change of each distortion parameter.

    For a family defined over the frame the maximum is over the frame, since its polynomials are invalid outside.
    """
    along = np.linspace(-1.0, 1.0, FRAME_GRID)
    in_frame = grid_mm(half * along for half in lens.distortion.half_mm)
    moved = lens.displacement(in_frame if is_defined_over_frame(lens) else radius_mm * directions())
    sizes = np.hypot(moved.by_unknowns_um[:, 0, 1:], moved.by_unknowns_um[:, 1, 1:]).max(axis=0)
    return dict(zip(parameter_names(lens.distortion.family), sizes.tolist(), strict=True))


def certificate(lens: Lens, largest_radius_mm: float) -> CertificateTable:
    """Convert a lens to the form of a calibration certificate, out to a radius.

    Notes
    -----
    A ray at the angle a is imaged at the radius r with tan a = t(r) = (r - d(r)) / c, where d is the radial distortion.
    With another principal distance C the distortion is r - C t. The calibrated C balances its extremes, at radii h and
    l: C = (h + l) / (t(h) + t(l)). As these are extremes, the derivatives of C neglect changes of h and l.
    """
    radius = np.linspace(0.0, largest_radius_mm, _CERTIFICATE_RADII)[1:]
    radius = np.concatenate([[_NEAR_AXIS * largest_radius_mm], radius])
    radial_um, radial_by, *_ = radial_part(lens, radius, of_pinhole=True)
    c = float(lens.interior[0])
    tangent = (radius - radial_um / 1e3) / c
    by = -radial_by / (1e3 * c)
    by[:, 0] -= tangent / c
    calibrated, high, low = balanced_distance(radius, tangent)
    calibrated_by = -calibrated * (by[high] + by[low]) / (tangent[high] + tangent[low])
    near = float(radius[0] / tangent[0])
    largest_deg = float(np.degrees(np.arctan(tangent[-1])))
    angles = [angle for angle in ANGLES_DEG if angle <= largest_deg]
    if len(angles) < _FEWEST_ANGLES:  # a narrow camera: equal steps, rounded down to tenths
        angles = (np.floor(10.0 * np.linspace(0.0, largest_deg, len(ANGLES_DEG) + 1)[1:]) / 10.0).tolist()
    at = np.tan(np.radians(angles))
    radii = np.interp(at, tangent, radius)
    by_at = np.stack([np.interp(at, tangent, column) for column in by.T], axis=1)
    slope = np.interp(at, tangent, np.gradient(tangent, radius))
    distortion_by = -by_at / slope[:, None] - at[:, None] * calibrated_by
    sigmas = function_sigmas(lens, np.vstack([calibrated_by, -near * by[0] / tangent[0], distortion_by])).tolist()
    drawn = distortion_curves(lens, largest_radius_mm)
    asymmetric = zip(
        np.interp(radii, drawn.radius_mm, drawn.asymmetric_um).tolist(),
        np.interp(radii, drawn.radius_mm, drawn.asymmetric_sigma_um).tolist(),
        strict=True,
    )
    values = zip((1e3 * (radii - calibrated * at)).tolist(), (1e3 * np.array(sigmas[2:])).tolist(), strict=True)
    rows = [CertificateRow(*each) for each in zip(angles, radii.tolist(), values, asymmetric, strict=True)]
    return CertificateTable((calibrated, sigmas[0]), (near, sigmas[1]), largest_radius_mm, rows)


def lens_map(lens: Lens, on: Plane, observed_radius_mm: float = np.inf) -> LensMap:
    """Plot distortion vectors from the ideal to the observed place on a grid over the plane; grey beyond the outermost
    target, where they are extrapolated."""
    low, high = on.corners_mm
    mesh_mm = float((high - low).max()) / MAP_GRID
    counts = np.maximum(np.rint((high - low) / mesh_mm), 1.0).astype(int)
    sides = zip(low, high, counts, strict=True)
    xy = grid_mm(first + (last - first) * (np.arange(count) + 0.5) / count for first, last, count in sides)
    point = lens.interior[1:]
    xy = xy[lens.displacement(xy - point).imaged]  # a fisheye's image does not fill the corners
    moved = lens.displacement(xy - point)
    covariance = np.einsum("nik,kl,njl->nij", moved.by_unknowns_um, displacement_cofactor(lens), moved.by_unknowns_um)
    largest = longest_vector(moved.value_um, covariance)
    beyond = np.hypot(*(xy - point).T) > observed_radius_mm
    px_per_um = svg.round_step(LONGEST * mesh_mm * on.px_per_mm / largest[0]) if largest[0] > 0.0 else 1.0
    ends = on.page(xy)
    starts = ends - px_per_um * moved.value_um * (1.0, -1.0)
    drawn = [
        strokes_and_dots(starts[rows], ends[rows], kind, ends[rows])
        for rows, kind in ((~beyond, "target"), (beyond, "extrapolated"))
        if rows.any()
    ]
    edge = [_circle(point, observed_radius_mm, on)] if beyond.any() else []
    plot = on.picture("Distortion vectors over the camera frame", px_per_um, *edge, *drawn)
    return LensMap(plot, bool(beyond.any()), largest)


def _circle(center_mm: Array, radius_mm: float, on: Plane) -> Markup:
    """Draw the part of a circle that lies on the plane."""
    angles = np.linspace(0.0, 2.0 * np.pi, ARCS + 1)
    points = center_mm + radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    low, high = on.corners_mm
    inside = ((points >= low) & (points <= high)).all(axis=1)
    shown = inside[:-1] & inside[1:]
    return svg.strokes(on.page(points[:-1][shown]), on.page(points[1:][shown]), "reach")


def curves_plot(drawn: Curves, observed_radius_mm: float, unit: ImageUnit = FILM_UNIT) -> Markup:
    """Plot radial and asymmetric distortion with their 95 % bands; grey beyond the outermost target."""
    pairs = {"first": (drawn.radial_um, drawn.radial_sigma_um)}
    if np.any(drawn.asymmetric_um > 1e-6):
        pairs = {"second": (drawn.asymmetric_um, drawn.asymmetric_sigma_um), **pairs}
    curve_of = {kind: (unit.per_um * value, unit.per_um * sigma) for kind, (value, sigma) in pairs.items()}
    radius = unit.per_mm * drawn.radius_mm
    shown = drawn.radius_mm <= max(observed_radius_mm, drawn.radius_mm[0])
    shown = shown if observed_radius_mm else np.full(len(radius), True)
    edges = np.array([value + side * BAND * sigma for value, sigma in curve_of.values() for side in (-1.0, 1.0)])
    low, high = min(0.0, edges[:, shown].min()), max(0.0, edges[:, shown].max())
    more = MOST_EXTRAPOLATED * (high - low)  # of what grows beyond the targets
    low, high = max(low - more, min(low, edges.min())), min(high + more, max(high, edges.max()))
    room = 0.06 * max(high - low, 1e-3)
    axes = svg.Axes((0.0, float(radius[-1])), (low - room, high + room), width=400.0, height=300.0)
    x = axes.x(radius)
    labels = axes.grid(f"radius from the principal point ({unit.long_name})", f"displacement ({unit.short_name})")
    content = []
    start, end = float(axes.x(min(unit.per_mm * observed_radius_mm, axes.x_range[1]))), axes.width - axes.right
    if end - start >= 1.0:
        height = axes.height - axes.bottom - axes.top
        content.append(svg.tag("rect", x=start, y=axes.top, width=end - start, height=height, class_="beyond"))
        if end - start > 90.0:
            content.append(svg.words(end - 6.0, axes.top + 14.0, "no targets here", "tick", "end"))
    content.append(labels)
    for kind, (value, sigma) in curve_of.items():
        for half in (BAND * sigma, sigma) if kind == "first" else (BAND * sigma,):
            edge = axes.y(np.clip(np.concatenate([value + half, (value - half)[::-1]]), *axes.y_range))
            content.append(svg.line(np.concatenate([x, x[::-1]]), edge, f"band {kind}", closed=True))
        inside = np.logical_and.accumulate((value >= axes.y_range[0]) & (value <= axes.y_range[1]))
        content.append(svg.line(x[inside], axes.y(value[inside]), f"curve {kind}"))
    return svg.picture(axes.width, axes.height, "Distortion over the radius with its 95 % band", *content)
