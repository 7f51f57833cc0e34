"""Plots of `reseau report --plots`: residuals, coverage, distortion and uncertainty of each camera, as PNG and PDF."""

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adjust.display import CameraPlots
from adjust.errors import AdjustmentError
from pipeline.errors import InputError, missing_extra
from pipeline.report.data import ReportData
from pipeline.report.lens import lens
from pipeline.results.adjustment_record import CameraRecord
from pipeline.text.files import FORMS, atomic_path, check_replaceable, file_word
from pipeline.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE_IN = (7.0, 5.5)
DPI = 150


def write_plots(data: ReportData, folder: Path) -> list[Path]:
    """Write the plots of all calibrated cameras; returns the files written.

    Raises
    ------
    InputError
        If Matplotlib is missing, no camera is calibrated, or a file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise missing_extra("--plots", "Matplotlib", "plots") from None
    files = []
    for camera, record in calibrated_cameras(data):
        figure = Figure(figsize=SIZE_IN, layout="constrained")
        for name in _draw(camera, record, figure):
            for ending in ("png", "pdf"):
                path = folder / f"{file_word(camera.name)}-{name}.{ending}"
                check_replaceable(path, FORMS[path.suffix], "name another folder")
                with atomic_path(path) as new:
                    metadata = {"Software" if ending == "png" else "Creator": "reseau"}
                    figure.savefig(new, format=ending, dpi=DPI, metadata=metadata)
                files.append(path)
            figure.clear()
    if not files:
        raise InputError("There is no calibrated camera to plot. Run `reseau adjust` on a project that shows targets.")
    return files


def _draw(plots: CameraPlots, record: CameraRecord, figure: "Figure") -> Iterator[str]:
    """Draw the plots one after another; yield the name of each, used in its file name."""
    plots.plot_residuals(figure.subplots())
    yield "residuals"
    plots.plot_coverage(figure.subplots())
    yield "coverage"
    if record.distortion.parameters:
        plots.plot_distortion(figure.subplots())
        yield "distortion"
    for known in record.projection:
        is_infinite = math.isnan(known.distance)
        plots.plot_uncertainty(math.inf if is_infinite else known.distance, figure.subplots())
        yield "uncertainty-infinity" if is_infinite else "uncertainty-near"


def calibrated_cameras(data: ReportData) -> Iterator[tuple[CameraPlots, CameraRecord]]:
    """Yield the plots of each calibrated camera with observed targets, from the stored results."""
    stored, covariance = data.adjustment, data.covariance
    if stored is None or covariance is None or not stored.converged:
        return
    for name, record in stored.cameras.items():
        images = stored.camera_images(name)
        rows = [row for image in images for row in data.residuals_by_image.get(image, []) if row.kind != "join"]
        is_fiducial = np.array([row.kind == "fiducial" for row in rows], dtype=bool)
        if not record.is_calibrated or is_fiducial.all():
            continue
        places = np.array([(row.camera_x_mm, row.camera_y_mm) for row in rows])
        vectors = np.array([(row.camera_vx_um, row.camera_vy_um) for row in rows]) / 1e3
        reach, pixel_um = record.lens_known, data.unit_of_camera(name).pixel_um
        frame_mm = None if reach is None else reach.frame_mm
        yield (
            CameraPlots(
                name=name,
                lens=lens(name, record, covariance),
                places_mm=places,
                vectors_mm=vectors,
                is_fiducial=is_fiducial,
                images=len(images),
                corners_mm=np.array(frame_mm or (places.min(axis=0), places.max(axis=0))),
                uncertainty=partial(_stored_map, record),
                pixel_mm=None if pixel_um is None else pixel_um / 1e3,
            ),
            record,
        )


def _stored_map(record: CameraRecord, distance: float) -> tuple[Array, Array]:
    """Places (r, c, 2) and standard deviations (r, c), mm. Raises AdjustmentError for a distance without a map."""
    for known in record.projection:
        if known.distance == distance or (math.isnan(known.distance) and math.isinf(distance)):
            places = np.stack(np.meshgrid(known.x_mm, known.y_mm), axis=-1)
            return places, np.array(known.sigma_um, dtype=float) / 1e3
    raise AdjustmentError(f"adjustment.json has no uncertainty of points at the distance {distance}.")
