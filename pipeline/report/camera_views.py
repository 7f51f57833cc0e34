"""What the report shows of each camera: its parameters, distortion, fiducial marks, residuals and check."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.functional_model.families import parameter_names
from adjust.problem.parameter import parameter_from_text
from pipeline.report import fiducials, lens, vectors
from pipeline.report.certificate import CertificateView, certificate_view
from pipeline.report.data import ReportData
from pipeline.report.frame_views import residuals_by_image
from pipeline.report.lens_map import LensMap, lens_map
from pipeline.report.numbers import fixed, value_and_sigma
from pipeline.report.parameters import ParameterRow, axes_sentence, group_sentences, high_correlations, parameter_rows
from pipeline.results.adjustment_record import AdjustmentRecord, CameraRecord, FiducialRecord, Quantity, ResidualRecord
from pipeline.results.check_file import CameraCheck, Row
from pipeline.results.covariance_file import Covariance

PLOT_PX = 560.0
LONGEST_VECTOR_PX = 60.0
MOST_VECTORS = 10_000  # in the picture of all frames
CURVE_TABLE_ROWS = 6
FINE_UM = 0.05  # standard deviation of a form below which tenths of a micrometre do not show it


@dataclass(frozen=True)
class CurveRow:
    """The distortion at a radius, each value with its sigma, ready to print."""

    radius_mm: str
    radial: tuple[str, str]
    asymmetric: tuple[str, str]


@dataclass(frozen=True)
class FiducialRow:
    """A fiducial: estimated coordinates with sigmas, less the given ones in um, and the change of form in um."""

    id: str
    x: tuple[str, str]
    y: tuple[str, str]
    moved_um: tuple[str, str]
    form_um: tuple[str, str]
    form_sigma_um: tuple[str, str]


@dataclass(frozen=True)
class CheckRow:
    """A parameter in both calibrations."""

    name: str
    unit: str
    reseau: tuple[str, str]
    opencv: tuple[str, str]
    difference_sigmas: str


@dataclass(frozen=True)
class CameraView:
    """A camera, ready to print; None or empty where the files do not hold what is needed."""

    name: str
    calibrated: bool
    images: int
    radius_mm: float
    parameters: list[ParameterRow]
    groups: list[str]
    axes: str
    in_given_figure: list[tuple[str, str, str]]
    distances: tuple[fiducials.Distance, ...]
    correlations: list[tuple[str, str, float]]
    trade_offs: list[str]
    curves: Markup | None
    effect_where: str
    lens_map: LensMap | None
    curve_rows: list[CurveRow]
    certificate: CertificateView | None
    fiducials: list[FiducialRow]
    figure: Markup | None
    vectors: Markup | None
    check: CameraCheck | None
    check_rows: list[CheckRow]


def camera_views(data: ReportData) -> list[CameraView]:
    """All cameras of the adjustment; none where there is no adjustment."""
    stored = data.adjustment
    return [_view(data, stored, name, camera) for name, camera in stored.cameras.items()] if stored else []


def _view(data: ReportData, stored: AdjustmentRecord, name: str, camera: CameraRecord) -> CameraView:
    images = stored.images_of(name)
    by_image = residuals_by_image(data)
    rows = [row for image in images for row in by_image.get(image, [])]
    known = data.covariance if stored.converged else None
    # Where there is no solution, none of what is missing was left out.
    calibrated = camera.is_calibrated or not stored.converged
    covariance = known if calibrated else None
    radius_mm, frame_mm = _observed_radius_mm(camera, rows), data.frame_mm.get(name)
    form = fiducial_form(name, stored, known) if known else None
    curve = _curves(name, camera, covariance, radius_mm, frame_mm) if covariance else None
    check = data.check.cameras.get(name) if data.check else None
    return CameraView(
        name=name,
        calibrated=calibrated,
        images=len(images),
        radius_mm=radius_mm,
        parameters=parameter_rows(name, camera, _prior_scale(name, stored), radius_mm) if calibrated else [],
        groups=group_sentences(camera.significance),
        axes=axes_sentence(camera),
        in_given_figure=_interior_in_given_datum(form) if form and calibrated else [],
        distances=form.distances if form else (),
        correlations=high_correlations(name, camera, covariance) if covariance else [],
        trade_offs=_trade_offs(name, stored),
        curves=lens.curves_plot(curve, radius_mm) if curve else None,
        effect_where="in the frame" if lens.is_of_frame(lens.lens(name, camera)) else f"at {fixed(radius_mm, 0)} mm",
        lens_map=_lens_map(name, camera, covariance, rows, radius_mm, frame_mm) if covariance else None,
        curve_rows=_curve_rows(curve) if curve else [],
        certificate=certificate_view(lens.lens(name, camera, covariance), _reach_mm(curve, radius_mm))
        if curve and covariance
        else None,
        fiducials=[_fiducial_row(id, fiducial, form) for id, fiducial in camera.fiducials.items()],
        figure=fiducials.figure_plot(form) if form else None,
        vectors=_vectors(rows, frame_mm),
        check=check,
        check_rows=[_check_row(row) for row in check.rows] if check else [],
    )


def _observed_radius_mm(camera: CameraRecord, rows: list[ResidualRecord]) -> float:
    """From the principal point to the outermost target."""
    point = camera.principal_point_mm
    targets = ((row.camera_x_mm, row.camera_y_mm) for row in rows if row.kind not in ("fiducial", "join"))
    return max((float(np.hypot(x - point.x.value, y - point.y.value)) for x, y in targets), default=0.0)


def _prior_scale(name: str, stored: AdjustmentRecord) -> float:
    """What sigma0 multiplies the given standard deviations of an interior orientation by."""
    is_left_out = ("interior", name) in stored.variance_factor.left_out
    return stored.sigma0 if stored.sigma0 > 0.0 and not is_left_out else 1.0


def _trade_offs(name: str, stored: AdjustmentRecord) -> list[str]:
    """What of a camera trades off, in words."""
    firsts = (parameter_from_text(each.parameters[0]) for each in stored.correlations)
    return [
        f"{each.cause} {each.remedy}"
        for each, first in zip(stored.correlations, firsts, strict=True)
        if first.kind == "interior" and first.owner == name
    ]


def fiducial_form(name: str, stored: AdjustmentRecord, covariance: Covariance) -> fiducials.Figure | None:
    """The figure of a camera's fiducials, free of its datum: with its interior orientation, or by its films alone."""
    camera = stored.cameras[name]
    if camera.is_calibrated:
        return fiducials.figure(name, camera, covariance)
    return fiducials.figure_of_films(name, camera.fiducials, covariance, stored.films(stored.images_of(name)))


def _interior_in_given_datum(form: fiducials.Figure) -> list[tuple[str, str, str]]:
    """c, x0' and y0' with their sigmas when the fiducials stand where they were given."""
    rows = zip(("c", "x₀′", "y₀′"), form.interior_mm.tolist(), form.interior_sigma_mm.tolist(), strict=True)
    return [(symbol, *value_and_sigma(value, sigma)) for symbol, value, sigma in rows]


def _curves(
    name: str, camera: CameraRecord, covariance: Covariance, radius_mm: float, frame_mm: tuple[float, float] | None
) -> lens.Curves | None:
    """Out to the frame's corner where its size is known, else to the outermost target.

    Of a family that is defined over the frame: on circles that lie in it.
    """
    corner_mm = 0.5 * float(np.hypot(*frame_mm)) if frame_mm else 0.0
    if camera.lens_known is not None and camera.lens_known.corner_mm > 0.0:
        corner_mm = camera.lens_known.corner_mm
    largest = max(radius_mm, corner_mm)
    if not parameter_names(camera.distortion.family) or largest == 0.0:
        return None
    of = lens.lens(name, camera, covariance)
    return lens.curves(of, min(largest, *of.distortion.half_mm) if lens.is_of_frame(of) else largest)


def _reach_mm(curve: lens.Curves, observed_mm: float) -> float:
    """How far a certificate goes: to the outermost target, or as far as the curve."""
    return min(observed_mm or np.inf, float(curve.radius_mm[-1]))


def _lens_map(
    name: str,
    camera: CameraRecord,
    covariance: Covariance,
    rows: list[ResidualRecord],
    radius_mm: float,
    frame_mm: tuple[float, float] | None,
) -> LensMap | None:
    if not parameter_names(camera.distortion.family) or not rows:
        return None
    if camera.lens_known is not None and camera.lens_known.frame_mm is not None:
        on = vectors.plane_about(np.array(camera.lens_known.frame_mm), PLOT_PX)
    else:
        on = vectors.plane(vectors.VectorField.of_residuals(rows).places_mm, frame_mm, PLOT_PX)
    return lens_map(lens.lens(name, camera, covariance), on, radius_mm)


def _curve_rows(curve: lens.Curves) -> list[CurveRow]:
    at = np.linspace(0, len(curve.radius_mm) - 1, CURVE_TABLE_ROWS + 1).round().astype(int)[1:]
    return [
        CurveRow(
            radius_mm=fixed(curve.radius_mm[i], 1),
            radial=value_and_sigma(float(curve.radial_um[i]), float(curve.radial_sigma_um[i])),
            asymmetric=value_and_sigma(float(curve.asymmetric_um[i]), float(curve.asymmetric_sigma_um[i])),
        )
        for i in at
    ]


def _fiducial_row(id: str, fiducial: FiducialRecord, form: fiducials.Figure | None) -> FiducialRow:
    x, y = fiducial.x_mm, fiducial.y_mm
    changed = changed_sigma = (fixed(None), fixed(None))
    if form and id in form.ids:
        at = form.ids.index(id)
        change, sigma = form.change_um[at], np.sqrt(np.maximum(np.diag(form.of_marks_um2[at]), 0.0))
        digits = 1 if sigma.min() >= FINE_UM else 3
        changed = (fixed(change[0], digits, sign=True), fixed(change[1], digits, sign=True))
        changed_sigma = (fixed(sigma[0], digits), fixed(sigma[1], digits))
    return FiducialRow(
        id=id,
        x=value_and_sigma(x.value, x.sigma),
        y=value_and_sigma(y.value, y.sigma),
        moved_um=(_moved_um(x), _moved_um(y)),
        form_um=changed,
        form_sigma_um=changed_sigma,
    )


def _moved_um(quantity: Quantity) -> str:
    return fixed(1e3 * (quantity.value - quantity.given.value) if quantity.given else None, 1, sign=True)


def _vectors(rows: list[ResidualRecord], frame_mm: tuple[float, float] | None) -> Markup | None:
    if not rows:
        return None
    scale = vectors.VectorField.of_residuals(rows).scale(LONGEST_VECTOR_PX)
    residuals = vectors.VectorField.of_residuals(rows[:: -(-len(rows) // MOST_VECTORS)])  # evenly over the frames
    return vectors.all_images_plot(residuals, vectors.plane(residuals.places_mm, frame_mm, PLOT_PX), scale)


def _check_row(row: Row) -> CheckRow:
    return CheckRow(
        name=row.name,
        unit=row.unit or "–",
        reseau=value_and_sigma(row.reseau.value, row.reseau.sigma),
        opencv=value_and_sigma(row.opencv.value, row.opencv.sigma),
        difference_sigmas=fixed(row.difference_sigmas, 2, sign=True),
    )
