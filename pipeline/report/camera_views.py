"""Cameras, scanners and joined frames in the report: values, distortion, residuals, maps over the frame, fiducials and
check."""

import math
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
from markupsafe import Markup

from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.functional_model.families import parameter_names
from adjust.problem.parameter import Parameter
from adjust.quality.lens_uncertainty import distortion_curves, is_defined_over_frame
from pipeline.drawing import svg
from pipeline.report import fiducials, lens, vectors
from pipeline.report.data import ReportData
from pipeline.report.numbers import fixed, significant
from pipeline.report.parameters import camera_values, parameter_rows, term_rows
from pipeline.report.vectors import grid_mm, longest_vector, padded_plane, strokes_and_dots
from pipeline.results.adjustment_file import ParameterCovariance
from pipeline.results.adjustment_record import AdjustmentRecord, CameraRecord, JoinedFrameRecord, ScannerRecord
from pipeline.results.image_unit import ImageUnit
from pipeline.types import Array

PLOT_PX = 400.0
LONGEST_VECTOR_PX = 44.0
MOST_VECTORS = 10_000  # in the plot of all images
CURVE_TABLE_ROWS = 6

SCANNER_PLOT_PX = 560.0
GRID = 9  # vectors along the longer side
LONGEST = 0.8  # longest vector with its ellipse, in grid spacings
ROOM = 0.06  # margin around the extent, fraction of its longer side

JOINED_PLOT_PX = 420.0
LONGEST_JOIN_PX = 40.0


def camera_view(data: ReportData, stored: AdjustmentRecord, name: str, camera: CameraRecord) -> SimpleNamespace:
    """Camera of the adjustment for the templates."""
    images, unit = stored.camera_images(name), data.unit_of_camera(name)
    rows = [row for image in images for row in data.residuals_by_image.get(image, [])]
    known = data.covariance if stored.converged else None
    # Without a solution all sigmas are NaN: they do not mean that the camera was left out of the calibration.
    is_calibrated = camera.is_calibrated or not stored.converged
    targets = np.array([(row.camera_x_mm, row.camera_y_mm) for row in rows if row.kind not in ("fiducial", "join")])
    point, radius_mm = camera.principal_point_mm, 0.0  # from the principal point to the outermost target
    if len(targets):
        radius_mm = float(np.hypot(*(targets - (point.x.value, point.y.value)).T).max())
    field = vectors.VectorField.from_residuals(rows)
    on = _plane(data, name, camera, field, unit) if rows else None
    plotted = on if is_calibrated else None
    some = vectors.VectorField.from_residuals(rows[:: -(-len(rows) // MOST_VECTORS) or 1])  # evenly from all images
    has_scale = stored.sigma0 > 0.0 and ("interior", name) not in stored.variance_factor.left_out
    parameters = list(parameter_rows(name, camera, stored.sigma0 if has_scale else 1.0, radius_mm, unit))
    effect_at = f"at {fixed(radius_mm * unit.per_mm, 0)} {unit.long_name}"
    return SimpleNamespace(
        name=name,
        record=camera,
        is_calibrated=is_calibrated,
        images=len(images),
        unit=unit,
        values=camera_values(data, name) if is_calibrated else [],
        effect_where="in the frame" if is_defined_over_frame(camera.lens()) else effect_at,
        # For a digital camera the values above already state c, x0' and y0' in px.
        parameters=(parameters[3:] if unit.is_pixel else parameters) if is_calibrated else [],
        correlation_causes=_correlation_causes(name, stored),
        lens=_lens_view(name, camera, known, on, radius_mm, unit) if known and is_calibrated else None,
        vectors=vectors.all_images_plot(some, plotted, field.scale(LONGEST_VECTOR_PX)) if plotted else None,
        coverage=vectors.coverage_plot(plotted, targets) if plotted and len(targets) else None,
        observed=len(targets),
        maps=list(_uncertainty_maps(camera, on, data.unit)) if on else [],
        corrections=fiducials.figure(name, stored, known) if known else None,
        given_by=data.coordinates_source(name),
        check=data.check.cameras.get(name) if data.check else None,
    )


def _correlation_causes(name: str, stored: AdjustmentRecord) -> list[str]:
    """Causes and remedies of high correlations of a camera's quantities, in words."""
    return [
        f"{each.cause.replace(' -', ' −')} {each.remedy}"
        for each in stored.correlations
        if each.parameters[0].kind == "interior" and each.parameters[0].owner == name
    ]


def _plane(
    data: ReportData, name: str, camera: CameraRecord, field: vectors.VectorField, unit: ImageUnit
) -> vectors.Plane:
    """Plane of the camera's frame, or of its observations if the frame size is unknown."""
    if camera.lens_known is not None and camera.lens_known.frame_mm is not None:
        return padded_plane(np.array(camera.lens_known.frame_mm), PLOT_PX, unit=unit)
    return vectors.plane(field.places_mm, data.frame_mm.get(name), PLOT_PX, unit)


def _lens_view(
    name: str,
    camera: CameraRecord,
    covariance: ParameterCovariance,
    on: vectors.Plane | None,
    radius_mm: float,
    unit: ImageUnit,
) -> SimpleNamespace | None:
    """Distortion out to the corner of the frame or, if its size is unknown, of the observed area."""
    reach = camera.lens_known
    corner_mm = reach.corner_mm if reach is not None and reach.corner_mm > 0.0 else 0.0
    if corner_mm == 0.0 and on is not None:
        corner_mm = 0.5 * float(np.hypot(*np.ptp(on.corners_mm, axis=0)))
    largest = max(radius_mm, corner_mm)
    if not parameter_names(camera.distortion.family) or largest == 0.0:
        return None
    known = lens.lens(name, camera, covariance)
    if is_defined_over_frame(known):  # on circles within it only
        largest = min(largest, *known.distortion.half_mm)
    curves = distortion_curves(known, largest)
    reach_mm = min(radius_mm or np.inf, float(curves.radius_mm[-1]))
    return SimpleNamespace(
        curves=curves,
        plot=lens.curves_plot(curves, radius_mm, unit),
        rows=np.linspace(0, len(curves.radius_mm) - 1, CURVE_TABLE_ROWS + 1).round().astype(int)[1:].tolist(),
        certificate=None if unit.is_pixel else lens.certificate(known, reach_mm),
        map=lens.lens_map(known, on, radius_mm) if on is not None else None,
    )


def _uncertainty_maps(camera: CameraRecord, on: vectors.Plane, unit: str) -> Iterator[tuple[str, Markup]]:
    for known in camera.projection:
        where = "at infinity" if math.isnan(known.distance) else f"at {significant(known.distance, 3)} {unit}"
        title = f"Standard deviation of projected points {where} over the camera frame"
        x_mm, y_mm, sigma_um = (np.array(each, dtype=float) for each in (known.x_mm, known.y_mm, known.sigma_um))
        if (plot := vectors.contour_plot(on, x_mm, y_mm, sigma_um, title)) is not None:
            yield where, plot


def scanner_view(
    stored: AdjustmentRecord, covariance: ParameterCovariance | None, name: str, scanner: ScannerRecord
) -> SimpleNamespace:
    """Scanner of the adjustment for the template: its terms, and its bend as a field of vectors."""
    images, rows = sum(image.scanner == name for image in stored.images.values()), list(term_rows(scanner.terms))
    view = SimpleNamespace(name=name, record=scanner, images=images, rows=rows, field=None)
    if not rows or covariance is None or not stored.converged:
        return view
    center, half = np.array(scanner.center_mm), np.array(scanner.half_mm)
    counts = np.maximum(np.rint(GRID * half / half.max()), 2.0).astype(int)
    xy_mm = grid_mm(np.linspace(c - h, c + h, count) for c, h, count in zip(center, half, counts, strict=True))
    value_um, covariance_um2 = bend_field(name, scanner, covariance, xy_mm)
    on = padded_plane(np.stack([center - half, center + half]), SCANNER_PLOT_PX, ROOM)
    radii_um, angles = svg.ellipse_axes(covariance_um2)
    reach_um = float((np.hypot(*value_um.T) + radii_um.max(axis=1)).max())
    mesh_px = on.px_per_mm * float(np.ptp(xy_mm, axis=0).max()) / (GRID - 1)
    px_per_um = svg.round_step(LONGEST * mesh_px / reach_um) if reach_um > 0.0 else 1.0
    starts = on.page(xy_mm)
    ends = starts + px_per_um * value_um * (1.0, -1.0)
    ellipses = svg.ellipses(ends, px_per_um * radii_um, angles)
    title = "The scanner's bend with 95 % ellipses over its scans"
    view.field = on.picture(title, px_per_um, *ellipses, strokes_and_dots(starts, ends, "target"))
    view.largest_um = longest_vector(value_um, covariance_um2)
    return view


def joined_view(name: str, frame: JoinedFrameRecord) -> SimpleNamespace:
    """Frame scanned in parts for the template: RMS difference at tie points in x' and y', name and length of the
    largest, and a plot."""
    view = SimpleNamespace(name=name, record=frame, rms_um=(None, None), largest="–", plot=None)
    if not frame.joins:
        return view
    rows = np.array([(row.x_mm, row.y_mm, row.dx_um, row.dy_um) for row in frame.joins])
    apart = vectors.VectorField(rows[:, :2], rows[:, 2:], np.zeros(len(rows), dtype=bool))
    lengths_um = np.hypot(*apart.vectors_um.T)
    view.rms_um = np.sqrt(np.mean(apart.vectors_um**2, axis=0)).tolist()
    view.largest = f"{frame.joins[int(lengths_um.argmax())].point}: {fixed(float(lengths_um.max()), 1)} µm"
    on = vectors.plane(apart.places_mm, None, JOINED_PLOT_PX)
    view.plot = vectors.all_images_plot(apart, on, apart.scale(LONGEST_JOIN_PX))
    return view


def bend_field(name: str, scanner: ScannerRecord, covariance: ParameterCovariance, xy_mm: Array) -> tuple[Array, Array]:
    """Displacements (n, 2), µm, by the scanner at points (n, 2), mm, and their covariances (n, 2, 2)."""
    bend, values = scanner.bend()
    at = bend.displacement(values, xy_mm)
    of_terms = covariance.select(Parameter.scanner(name, term) for term in scanner.terms)
    by_terms = UM_PER_MM * at.parameter_jacobian
    return UM_PER_MM * at.value, np.einsum("nik,kl,njl->nij", by_terms, of_terms, by_terms)
