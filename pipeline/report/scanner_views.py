"""Scanners in the report: terms of the geometric error, and the displacement over the scan with 95 % ellipses."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.problem.parameter import Parameter
from pipeline.drawing import svg
from pipeline.report.data import ReportData
from pipeline.report.parameters import ParameterRow, term_rows
from pipeline.report.vectors import grid_mm, longest_vector, padded_plane, strokes_and_dots
from pipeline.results.adjustment_record import AdjustmentRecord, ScannerRecord
from pipeline.results.covariance_file import Covariance
from pipeline.types import Array

PLOT_PX = 560.0
GRID = 9  # vectors along the longer side
LONGEST = 0.8  # longest vector with its ellipse, in grid spacings
ROOM = 0.06  # margin around the extent, fraction of its longer side
UM_PER_MM = 1000.0


@dataclass(frozen=True)
class ScannerView:
    """Scanner in the report. field: plot of the displacements, None without terms or without a solution; largest_um:
    largest displacement with its sigma."""

    name: str
    record: ScannerRecord
    images: int
    rows: list[ParameterRow]
    field: Markup | None = None
    largest_um: tuple[float, float] = (0.0, 0.0)


def scanner_views(data: ReportData) -> list[ScannerView]:
    """Views of all scanners of the adjustment; empty without an adjustment or without scanners."""
    stored = data.adjustment
    return [_view(stored, data.covariance, *each) for each in stored.scanners.items()] if stored else []


def _view(stored: AdjustmentRecord, covariance: Covariance | None, name: str, scanner: ScannerRecord) -> ScannerView:
    images = sum(image.scanner == name for image in stored.images.values())
    rows = list(term_rows(scanner.terms))
    if not rows or covariance is None or not stored.converged:
        return ScannerView(name, scanner, images, rows)
    center, half = np.array(scanner.center_mm), np.array(scanner.half_mm)
    counts = np.maximum(np.rint(GRID * half / half.max()), 2.0).astype(int)
    xy_mm = grid_mm(np.linspace(c - h, c + h, count) for c, h, count in zip(center, half, counts, strict=True))
    value_um, covariance_um2 = bend_field(name, scanner, covariance, xy_mm)
    on = padded_plane(np.stack([center - half, center + half]), PLOT_PX, ROOM)
    radii_um, angles = svg.ellipse_axes(covariance_um2)
    reach_um = float((np.hypot(*value_um.T) + radii_um.max(axis=1)).max())
    mesh_px = on.px_per_mm * float(np.ptp(xy_mm, axis=0).max()) / (GRID - 1)
    px_per_um = svg.round_step(LONGEST * mesh_px / reach_um) if reach_um > 0.0 else 1.0
    starts = on.page(xy_mm)
    ends = starts + px_per_um * value_um * (1.0, -1.0)
    ellipses = svg.ellipses(ends, px_per_um * radii_um, angles)
    title = "The scanner's bend with 95 % ellipses over its scans"
    field = on.picture(title, px_per_um, *ellipses, strokes_and_dots(starts, ends, "target"))
    return ScannerView(name, scanner, images, rows, field, longest_vector(value_um, covariance_um2))


def bend_field(name: str, scanner: ScannerRecord, covariance: Covariance, xy_mm: Array) -> tuple[Array, Array]:
    """Displacements (n, 2), µm, by the scanner at points (n, 2), mm, and their covariances (n, 2, 2)."""
    bend, values = scanner.bend()
    at = bend.displacement(values, xy_mm)
    of_terms = covariance.select(Parameter.scanner(name, term) for term in scanner.terms)
    by_terms = UM_PER_MM * at.parameter_jacobian
    return UM_PER_MM * at.value, np.einsum("nik,kl,njl->nij", by_terms, of_terms, by_terms)
