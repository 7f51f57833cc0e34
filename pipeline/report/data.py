"""Input of the report: the result files of the stages, any of which may be missing, and the marks of all frames."""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from measure.flags import Code, Reason, Status
from measure.results import Covariance as MarkCovariance
from measure.results import MarkMeasurement
from pipeline.archive.verdicts import Verdict, frame_verdict, mark_verdict, scan_verdict
from pipeline.results.adjustment_file import ParameterCovariance
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.stage_files import Check
from pipeline.results.thumbnail import Thumbnail
from pipeline.types import Array

MarkKey = tuple[str, str, str]  # image, kind, point
# Sections of the report that problems refer to.
ReportSection = Literal["camera", "frames", "coverage", "fiducials", "reliability", "check", "fractions"]
_SENTENCE = re.compile(r"(?<=[.:]) (?=[A-Z])")


@dataclass(frozen=True)
class ReportedProblem:
    """Problem that needs a look. what: description; next_step: remedy, else the description after its first sentence.

    images, marks: those concerned, the report shows the first mark; section: of the report, with details.
    """

    what: str
    next_step: str = ""
    images: tuple[str, ...] = field(default=(), compare=False)
    marks: tuple[MarkKey, ...] = field(default=(), compare=False)
    section: ReportSection | None = field(default=None, compare=False)

    @property
    def cause(self) -> str:
        """First sentence of the description."""
        return _SENTENCE.split(self.what, maxsplit=1)[0]

    @property
    def detail(self) -> str:
        """Rest of the description, empty where it is the remedy."""
        return self._rest if self.next_step else ""

    @property
    def remedy(self) -> str:
        """What to do."""
        return self.next_step or self._rest

    @property
    def _rest(self) -> str:
        return "".join(_SENTENCE.split(self.what, maxsplit=1)[1:])


@dataclass(frozen=True)
class FrameTotals:
    """Totals of all frames, for a report that does not show all of them.

    Attributes
    ----------
    marks : number of marks by image and status.
    of_targets : number of marks other than fiducials, by kind and status.
    verdicts : number of frames by (camera, kind of file) and verdict.
    problems : those of most frames first.
    places_px : distinct positions of the observed marks by axis, see `frame_problems.places_px`.
    """

    marks: Mapping[str, Counter[str]]
    of_targets: Mapping[tuple[str, str], int]
    verdicts: Mapping[tuple[str, str], Counter[str]]
    problems: tuple[ReportedProblem, ...]
    places_px: Mapping[str, Array]


@dataclass(frozen=True)
class ReportData:
    """Input of a report.

    Attributes
    ----------
    adjustment, check : content of adjustment.json and check.json.
    covariance : content of adjustment.npz.
    frame_mm : width and height of the exposed frame by camera.
    pitch_um : pixel pitch across and down, by scan with known pixel positions.
    thumbnail : returns the thumbnail of a mark from image, point and kind (a fiducial and a target may share a name).
    problems, notes : further ones of the caller.
    made_from : fingerprints of the files by name.
    given_by : source of the given fiducial coordinates by camera.
    stored_adjustment : of adjustment.json, where it is not shown: whether it is of the marks and settings.
    image_cameras : camera's name by image, of the images with marks.
    part_of : frame by image, of images that show a part of it.
    totals : of all frames if these are many; comparator and measurement then hold only the frames shown.
    """

    project: str
    comparator: Sequence[ComparatorPoint] = ()
    measurement: Mapping[str, MeasuredScan] | None = None
    adjustment: AdjustmentRecord | None = None
    covariance: ParameterCovariance | None = None
    check: Check | None = None
    frame_mm: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pitch_um: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    thumbnail: Callable[[str, str, str], Thumbnail | None] | None = None
    problems: tuple[ReportedProblem, ...] = ()
    notes: tuple[str, ...] = ()
    made_from: Mapping[str, str] = field(default_factory=dict)
    unit: str = "m"
    given_by: Mapping[str, str] = field(default_factory=dict)
    stored_adjustment: Literal["none", "current", "stale"] = "none"
    image_cameras: Mapping[str, str] = field(default_factory=dict)
    part_of: Mapping[str, str] = field(default_factory=dict)
    totals: FrameTotals | None = None

    def frame_count(self, images: Iterable[str]) -> int:
        """Number of frames that images show, whole or in parts."""
        return len({self.part_of.get(image) or image for image in images})

    @property
    def is_film_alone(self) -> bool:
        """Whether only fiducial marks were adjusted and no camera is calibrated."""
        cameras = self.adjustment.cameras.values() if self.adjustment else ()
        has_marks = any(camera.fiducials for camera in cameras)
        return has_marks and not any(camera.is_calibrated for camera in cameras)

    @cached_property
    def image_units(self) -> Mapping[str, ImageUnit]:
        """Unit of image lengths by camera of the adjustment; empty if all are in mm and µm."""
        stored = self.adjustment
        if stored is None or any(camera.fiducials for camera in stored.cameras.values()):
            return {}
        sizes = defaultdict[str, set[float]](set)  # of cameras with images
        for name, image in stored.images.items():
            is_film = image.transformation.kind != "none"
            sizes[stored.image_camera(name)] |= {math.nan} if is_film else {*self.pitch_um.get(name, (math.nan,))}
        if any(len(each) != 1 or math.isnan(min(each)) for each in sizes.values()):
            return {}
        return {name: ImageUnit(min(each)) for name, each in sizes.items()}

    @property
    def common_unit(self) -> ImageUnit:
        """Unit of image lengths of all cameras together: pixels only where all have those of one size."""
        units = {*self.image_units.values()}
        return units.pop() if len(units) == 1 else FILM_UNIT

    @cached_property
    def residuals_by_image(self) -> Mapping[str, list[ResidualRecord]]:
        """Residuals of the adjustment by image."""
        rows: dict[str, list[ResidualRecord]] = defaultdict(list)
        for row in self.adjustment.residuals if self.adjustment else ():
            rows[row.image].append(row)
        return dict(rows)

    def coordinates_source(self, camera: str) -> str:
        """Source of the given fiducial coordinates of a camera."""
        return self.given_by.get(camera, "the given coordinates")

    def unit_of_camera(self, camera: str) -> ImageUnit:
        return self.image_units.get(camera, FILM_UNIT)

    def unit_of_image(self, image: str) -> ImageUnit:
        stored = self.adjustment
        return self.unit_of_camera(stored.image_camera(image)) if stored and image in stored.images else FILM_UNIT


@dataclass(frozen=True)
class Mark:
    """Mark of a frame.

    Attributes
    ----------
    center_px, covariance : (2,) column and row, and covariance in the scan; None if nothing was fitted.
    sigma_um : (2,) standard deviations in x and y; None if unknown.
    residual : row of adjustment.json; None if the mark was not an observation of the adjustment.
    """

    image: str
    point: str
    kind: str
    status: Status
    reason: Reason
    center_px: Array | None
    covariance: MarkCovariance | None
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
    def needs_review(self) -> bool:
        """Whether it is a reason to look at its frame, as in `reseau status`."""
        return mark_verdict(self.kind, self.status, self.codes).needs_review

    @property
    def sigma_px(self) -> Array | None:
        """(2,) standard deviations in column and row."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance.px2))

    @property
    def w(self) -> float | None:
        """Standardised residual; None if the mark is unchecked."""
        return self.residual.w if self.residual and np.isfinite(self.residual.w) else None


@dataclass(frozen=True)
class ReportedFrame:
    """Image with its marks, fiducials first. scan: its measurement, None if not measured."""

    image: str
    marks: tuple[Mark, ...]
    scan: MeasuredScan | None = None

    @property
    def verdict(self) -> Verdict:
        """Verdict as in `reseau status`, for the marks currently in comparator.csv."""
        marks = [(mark.kind, mark.status, mark.codes) for mark in self.marks]
        return frame_verdict(marks, True, False, False) if self.scan is None else scan_verdict(self.scan, marks)


def frames(data: ReportData) -> list[ReportedFrame]:
    """Frames of all images named in any of the files, sorted by name."""
    scans = current_scans(data)
    marks: dict[str, list[Mark]] = defaultdict(list)
    for mark in _marks(data, scans):
        marks[mark.image].append(mark)
    names = {*scans, *marks, *(data.adjustment.images if data.adjustment and not data.totals else {})}
    return [
        ReportedFrame(
            name, tuple(sorted(marks[name], key=lambda mark: (not mark.is_fiducial, natural(mark.point)))), scan
        )
        for name in sorted(names, key=natural)
        for scan in [scans.get(name)]
    ]


def current_scans(data: ReportData) -> dict[str, MeasuredScan]:
    """Measured scans by image, without those whose marks were removed from comparator.csv."""
    images, scans = {row.image for row in data.comparator}, data.measurement or {}
    return {name: scan for name, scan in scans.items() if name in images or not images or not scan.frame.marks}


def natural(name: str) -> list[tuple[int, str]]:
    """Natural sort key: "f2" before "f10"."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _marks(data: ReportData, scans: Mapping[str, MeasuredScan]) -> Iterator[Mark]:
    """Join the sources of each mark. The comparator file takes precedence, since the user may have edited it."""
    measured = {(image, m.kind == "fiducial", m.point): m for image, scan in scans.items() for m in scan.frame.marks}
    residuals = {
        (row.image, row.kind == "fiducial", row.point): row
        for row in (data.adjustment.residuals if data.adjustment else ())
    }
    given = {(row.image, row.kind == "fiducial", row.point): row for row in data.comparator}
    joined: dict[tuple[str, bool, str], MarkMeasurement | ComparatorPoint] = {**measured, **given}
    shown = {(data.part_of.get(image), *name) for (image, *name), mark in joined.items() if mark.status.is_observation}
    for key, known in joined.items():
        pixel, row, residual = measured.get(key), given.get(key), residuals.get(key)
        # Standard deviation used in the adjustment, film included; without an adjustment as measured.
        sigma_um = np.array([residual.sx_um, residual.sy_um]) if residual else None
        if residual is None and row and row.sigma_mm is not None:
            sigma_um = 1e3 * row.sigma_mm
        reason = pixel.reason if pixel and pixel.reason == known.reason else Reason.read(known.reason, "")
        frame, is_missing = data.part_of.get(key[0]), not known.status.is_observation
        if frame and is_missing and not reason.codes and (frame, *key[1:]) in shown:
            reason = Reason(reason, Code.OTHER_PART)  # a comparator file has no codes
        yield Mark(
            image=key[0],
            point=known.point,
            kind=known.kind,
            status=known.status,
            reason=reason,
            center_px=pixel.center_px if pixel else None,
            covariance=pixel.covariance if pixel else None,
            sigma_um=sigma_um,
            residual=residual,
            quality=pixel.quality if pixel else {},
        )
