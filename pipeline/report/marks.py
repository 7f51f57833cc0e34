"""Marks of all frames: measurement, comparator file and adjustment, joined by name."""

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from measure.flags import Code, Reason, Status
from measure.results import Covariance, MarkMeasurement
from pipeline.report.data import ReportData
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array


@dataclass(frozen=True)
class Mark:
    """Mark of a frame.

    Attributes
    ----------
    center_px, covariance : (2,) column and row, and covariance in the scan; None if nothing was fitted.
    sigma_um : (2,) standard deviations in x and y; None if unknown.
    residual : row of adjustment.json; None if the mark was not an observation of the adjustment.
    quality : quality measures of the fit by name.
    """

    image: str
    point: str
    kind: str
    status: Status
    reason: Reason
    center_px: Array | None
    covariance: Covariance | None
    sigma_um: Array | None
    residual: ResidualRecord | None
    quality: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_fiducial(self) -> bool:
        return self.kind == "fiducial"

    @property
    def codes(self) -> tuple[Code, ...]:
        """Codes of its reason."""
        return self.reason.codes

    @property
    def is_open(self) -> bool:
        """Whether it is not an observation, without a review decision and not measured in another part of the frame."""
        return not self.status.is_observation and not {Code.DECIDED, Code.OTHER_PART} & set(self.codes)

    @property
    def sigma_px(self) -> Array | None:
        """(2,) standard deviations in column and row."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance.px2))

    @property
    def w(self) -> float | None:
        """Standardised residual; None if the mark is unchecked."""
        return self.residual.w if self.residual and np.isfinite(self.residual.w) else None


@dataclass(frozen=True)
class Frame:
    """Image with its marks, fiducials first. scan: its measurement, None if not measured."""

    image: str
    marks: tuple[Mark, ...]
    scan: MeasuredScan | None = None

    def count(self, *statuses: Status) -> int:
        return sum(mark.status in statuses for mark in self.marks)


def frames(data: ReportData) -> list[Frame]:
    """Frames of all images named in any of the files, sorted by name."""
    scans = current_scans(data)
    marks: dict[str, dict[tuple[bool, str], Mark]] = defaultdict(dict)
    for mark in _marks(data, scans):
        marks[mark.image][mark.is_fiducial, mark.point] = mark
    names = {*scans, *marks, *(data.adjustment.images if data.adjustment and not data.totals else {})}
    return [
        Frame(name, tuple(sorted(marks[name].values(), key=_order)), scans.get(name))
        for name in sorted(names, key=natural)
    ]


def current_scans(data: ReportData) -> dict[str, MeasuredScan]:
    """Measured scans by image, without those whose marks were removed from comparator.csv."""
    images, scans = {row.image for row in data.comparator}, data.measurement or {}
    return {name: scan for name, scan in scans.items() if name in images or not images or not scan.frame.marks}


def natural(name: str) -> list[tuple[int, str]]:
    """Natural sort key: "f2" before "f10"."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _marks(data: ReportData, scans: Mapping[str, MeasuredScan]) -> list[Mark]:
    measured = {
        (image, mark.kind == "fiducial", mark.point): mark for image, scan in scans.items() for mark in scan.frame.marks
    }
    residuals = {
        (row.image, row.kind == "fiducial", row.point): row
        for row in (data.adjustment.residuals if data.adjustment else ())
    }
    given = {(row.image, row.kind == "fiducial", row.point): row for row in data.comparator}
    return [_mark(key, measured.get(key), given.get(key), residuals.get(key)) for key in {**measured, **given}]


def _mark(
    key: tuple[str, bool, str],
    pixel: MarkMeasurement | None,
    row: ComparatorPoint | None,
    residual: ResidualRecord | None,
) -> Mark:
    """Join the sources of a mark. The comparator file takes precedence, since the user may have edited it."""
    image, _, point = key
    known = row or pixel
    assert known is not None  # the keys come from these two sources
    return Mark(
        image=image,
        point=point,
        kind=known.kind,
        status=known.status,
        reason=pixel.reason if pixel and pixel.reason == known.reason else Reason.read(known.reason, ""),
        center_px=pixel.center_px if pixel else None,
        covariance=pixel.covariance if pixel else None,
        sigma_um=_sigma_um(residual, row),
        residual=residual,
        quality=pixel.quality if pixel else {},
    )


def _sigma_um(residual: ResidualRecord | None, row: ComparatorPoint | None) -> Array | None:
    """Standard deviation used in the adjustment, film included; without an adjustment as measured."""
    if residual:
        return np.array([residual.sx_um, residual.sy_um])
    return 1e3 * row.sigma_mm if row and row.sigma_mm is not None else None


def _order(mark: Mark) -> tuple[bool, list[tuple[int, str]]]:
    return (not mark.is_fiducial, natural(mark.point))
