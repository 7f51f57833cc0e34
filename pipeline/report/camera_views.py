"""What the report shows of each camera: its parameters, distortion, fiducial marks, residuals and check."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.functional_model.families import parameter_names
from adjust.problem.parameter import parameter_from_text
from adjust.quality.distortion_curves import Curves, distortion_curves, is_defined_over_frame
from pipeline.report import fiducials, lens, vectors
from pipeline.report.data import ReportData
from pipeline.report.frame_views import residuals_by_image
from pipeline.report.numbers import fixed
from pipeline.report.parameters import ParameterRow, high_correlations, parameter_rows
from pipeline.results.adjustment_record import AdjustmentRecord, CameraRecord
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.check_file import CameraCheck
from pipeline.results.covariance_file import Covariance

PLOT_PX = 560.0
LONGEST_VECTOR_PX = 60.0
MOST_VECTORS = 10_000  # in the picture of all frames
CURVE_TABLE_ROWS = 6


@dataclass(frozen=True)
class LensView:
    """The distortion of a camera. rows: of the curves' table, by their positions."""

    curves: Curves
    plot: Markup
    rows: list[int]
    certificate: lens.Certificate
    map: lens.LensMap | None


@dataclass(frozen=True)
class CameraView:
    """A camera; None or empty where the files do not hold what is needed."""

    name: str
    record: CameraRecord
    is_calibrated: bool
    images: int
    effect_where: str
    parameters: list[ParameterRow]
    correlations: list[tuple[str, str, float]]
    trade_offs: list[str]
    lens: LensView | None
    figure: fiducials.Figure | None
    figure_plot: Markup | None
    vectors: Markup | None
    check: CameraCheck | None


def camera_views(data: ReportData) -> list[CameraView]:
    """All cameras of the adjustment; none where there is no adjustment."""
    stored = data.adjustment
    return [_view(data, stored, name, camera) for name, camera in stored.cameras.items()] if stored else []


def _view(data: ReportData, stored: AdjustmentRecord, name: str, camera: CameraRecord) -> CameraView:
    images, by_image = stored.images_of(name), residuals_by_image(data)
    rows = [row for image in images for row in by_image.get(image, [])]
    known = data.covariance if stored.converged else None
    # Where there is no solution, none of what is missing was left out.
    is_calibrated = camera.is_calibrated or not stored.converged
    covariance = known if is_calibrated else None
    radius_mm, frame_mm = _observed_radius_mm(camera, rows), data.frame_mm.get(name)
    figure = fiducials.figure(name, stored, known) if known else None
    over_frame = is_defined_over_frame(camera.lens())
    return CameraView(
        name=name,
        record=camera,
        is_calibrated=is_calibrated,
        images=len(images),
        effect_where="in the frame" if over_frame else f"at {fixed(radius_mm, 0)} mm",
        parameters=list(parameter_rows(name, camera, _prior_scale(name, stored), radius_mm)) if is_calibrated else [],
        correlations=high_correlations(name, camera, covariance) if covariance else [],
        trade_offs=_trade_offs(name, stored),
        lens=_lens_view(name, camera, covariance, rows, radius_mm, frame_mm) if covariance else None,
        figure=figure,
        figure_plot=fiducials.figure_plot(figure) if figure else None,
        vectors=_vectors(rows, frame_mm) if rows else None,
        check=data.check.cameras.get(name) if data.check else None,
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


def _lens_view(
    name: str,
    camera: CameraRecord,
    covariance: Covariance,
    rows: list[ResidualRecord],
    radius_mm: float,
    frame_mm: tuple[float, float] | None,
) -> LensView | None:
    """Out to the frame's corner where its size is known, else to the outermost target. Of a family that is defined over
    the frame: on circles that lie in it."""
    reach = camera.lens_known
    corner_mm = 0.5 * float(np.hypot(*frame_mm)) if frame_mm else 0.0
    largest = max(radius_mm, reach.corner_mm if reach is not None and reach.corner_mm > 0.0 else corner_mm)
    if not parameter_names(camera.distortion.family) or largest == 0.0:
        return None
    known = lens.lens(name, camera, covariance)
    if is_defined_over_frame(known):
        largest = min(largest, *known.distortion.half_mm)
    curves = distortion_curves(known, largest)
    lens_map = None
    if rows:
        on = vectors.plane(vectors.VectorField.from_residuals(rows).places_mm, frame_mm, PLOT_PX)
        if reach is not None and reach.frame_mm is not None:
            on = vectors.padded_plane(np.array(reach.frame_mm), PLOT_PX)
        lens_map = lens.lens_map(known, on, radius_mm)
    return LensView(
        curves,
        lens.curves_plot(curves, radius_mm),
        np.linspace(0, len(curves.radius_mm) - 1, CURVE_TABLE_ROWS + 1).round().astype(int)[1:].tolist(),
        lens.certificate(known, min(radius_mm or np.inf, float(curves.radius_mm[-1]))),
        lens_map,
    )


def _vectors(rows: list[ResidualRecord], frame_mm: tuple[float, float] | None) -> Markup:
    scale = vectors.VectorField.from_residuals(rows).scale(LONGEST_VECTOR_PX)
    residuals = vectors.VectorField.from_residuals(rows[:: -(-len(rows) // MOST_VECTORS)])  # evenly over the frames
    return vectors.all_images_plot(residuals, vectors.plane(residuals.places_mm, frame_mm, PLOT_PX), scale)
