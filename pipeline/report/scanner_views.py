"""What the report shows of each scanner: the terms of its bend, and what it does over the scan with a 95 % band."""

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from adjust.problem.parameter import Parameter
from pipeline.drawing import svg
from pipeline.report.data import ReportData
from pipeline.report.numbers import value_and_sigma
from pipeline.report.parameters import ParameterRow, group_sentences, term_rows
from pipeline.report.vectors import Plane, strokes_and_dots
from pipeline.results.adjustment_record import AdjustmentRecord, ScannerRecord
from pipeline.results.covariance_file import Covariance
from pipeline.types import Array

PLOT_PX = 560.0
GRID = 9  # vectors along the longer side
LONGEST = 0.8  # of the grid's mesh, the ellipse at its end included
ROOM = 0.06  # beyond the extent, of its longer side
UM_PER_MM = 1000.0


@dataclass(frozen=True)
class ScannerView:
    """A scanner, ready to print; field None where it bends nothing or there is no solution. largest_um: of the field,
    with its sigma."""

    name: str
    images: int
    rows: list[ParameterRow]
    groups: list[str]
    field: Markup | None
    largest_um: tuple[str, str]


@dataclass(frozen=True)
class BendField:
    """How far the scanner puts points (n, 2) in mm beside their places (n, 2) in um, with covariances (n, 2, 2)."""

    xy_mm: Array
    value_um: Array
    covariance_um2: Array


def scanner_views(data: ReportData) -> list[ScannerView]:
    """All scanners of the adjustment; none where there is no adjustment, or none is adjusted."""
    stored = data.adjustment
    return [_view(stored, data.covariance, *each) for each in stored.scanners.items()] if stored else []


def _view(stored: AdjustmentRecord, covariance: Covariance | None, name: str, scanner: ScannerRecord) -> ScannerView:
    images = sum(image.scanner == name for image in stored.images.values())
    rows, groups = term_rows(scanner.terms), group_sentences(scanner.significance)
    if not scanner.terms or covariance is None or not stored.converged:
        return ScannerView(name, images, rows, groups, None, ("", ""))
    on = _plane(scanner)
    field = bend_field(name, scanner, covariance, _grid(scanner))
    size = np.hypot(*field.value_um.T)
    at = int(size.argmax())
    along = field.value_um[at] / max(float(size[at]), 1e-12)
    sigma_um = float(np.sqrt(max(along @ field.covariance_um2[at] @ along, 0.0)))
    return ScannerView(name, images, rows, groups, _bend_picture(field, on), value_and_sigma(float(size[at]), sigma_um))


def bend_field(name: str, scanner: ScannerRecord, covariance: Covariance, xy_mm: Array) -> BendField:
    """The bend at places (n, 2), and its covariance from that of the terms."""
    bend, values = scanner.bend()
    at = bend.displacement(values, xy_mm)
    of_terms = covariance.of(Parameter.scanner(name, term) for term in scanner.terms)
    by_terms = UM_PER_MM * at.parameter_jacobian
    return BendField(xy_mm, UM_PER_MM * at.value, np.einsum("nik,kl,njl->nij", by_terms, of_terms, by_terms))


def _plane(scanner: ScannerRecord) -> Plane:
    center, half = np.array(scanner.center_mm), np.array(scanner.half_mm)
    room = 2.0 * ROOM * half.max()
    return Plane(np.stack([center - half - room, center + half + room]), PLOT_PX)


def _grid(scanner: ScannerRecord) -> Array:
    """(n, 2) a grid over the extent, its edges included."""
    center, half = np.array(scanner.center_mm), np.array(scanner.half_mm)
    counts = np.maximum(np.rint(GRID * half / half.max()), 2.0).astype(int)
    x, y = (np.linspace(c - h, c + h, count) for c, h, count in zip(center, half, counts, strict=True))
    return np.stack([each.ravel() for each in np.meshgrid(x, y)], axis=1)


def _bend_picture(field: BendField, on: Plane) -> Markup:
    radii_um, angles = svg.ellipse_axes(field.covariance_um2)
    reach_um = float((np.hypot(*field.value_um.T) + radii_um.max(axis=1)).max())
    mesh_px = on.px_per_mm * float(np.ptp(field.xy_mm, axis=0).max()) / (GRID - 1)
    px_per_um = svg.round_step(LONGEST * mesh_px / reach_um) if reach_um > 0.0 else 1.0
    starts = on.page(field.xy_mm)
    ends = starts + px_per_um * field.value_um * (1.0, -1.0)
    ellipses = svg.ellipses(ends, px_per_um * radii_um, angles)
    title = "The scanner's bend with 95 % ellipses over its scans"
    return on.picture(title, px_per_um, *ellipses, strokes_and_dots(starts, ends, "target"))
