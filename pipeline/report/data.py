"""Input of the report: the result files of the stages, any of which may be missing."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.check_file import Check
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.covariance_file import Covariance
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.thumbnail import Thumbnail

MarkKey = tuple[str, str, str]  # image, kind, point
_SENTENCE = re.compile(r"(?<=[.:]) (?=[A-Z])")


@dataclass(frozen=True)
class Problem:
    """Problem that needs a look. what: description; next_step: remedy.

    images, marks: those concerned, the report shows the first mark; section: of the report, with details.
    """

    what: str
    next_step: str = ""
    images: tuple[str, ...] = field(default=(), compare=False)
    marks: tuple[MarkKey, ...] = field(default=(), compare=False)
    section: str = field(default="", compare=False)

    @property
    def cause(self) -> str:
        """First sentence of the description."""
        return _SENTENCE.split(self.what, maxsplit=1)[0]

    @property
    def detail(self) -> str:
        """Rest of the description."""
        return "".join(_SENTENCE.split(self.what, maxsplit=1)[1:])


@dataclass(frozen=True)
class FrameTotals:
    """Totals of all frames, for a report that does not show all of them.

    Attributes
    ----------
    marks : number of marks by image and status.
    of_targets : number of marks other than fiducials, by kind and status.
    verdicts : number of frames by (camera, kind of file) and verdict.
    problems : of the frames.
    places_px : distinct positions of the observed marks by axis, see `fractions.places_px`.
    """

    marks: Mapping[str, Mapping[str, int]]
    of_targets: Mapping[tuple[str, str], int]
    verdicts: Mapping[tuple[str, str], Mapping[str, int]]
    problems: tuple[Problem, ...]
    places_px: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class ReportData:
    """Input of a report.

    Attributes
    ----------
    comparator : rows of comparator.csv.
    measurement : scans of measurement.db by image.
    adjustment, check : content of adjustment.json and check.json.
    covariance : content of adjustment.npz.
    frame_mm : width and height of the exposed frame by camera.
    pitch_um : pixel pitch across and down, by scan with known pixel positions.
    thumbnail : returns the thumbnail of a mark from image, point and kind (a fiducial and a target may share a name).
    problems, notes : further ones of the caller.
    made_from : fingerprints of the files by name.
    unit : of the object coordinates.
    given_by : source of the given fiducial coordinates by camera.
    totals : of all frames if these are many; comparator and measurement then hold only the frames shown.
    """

    project: str
    comparator: Sequence[ComparatorPoint] = ()
    measurement: Mapping[str, MeasuredScan] | None = None
    adjustment: AdjustmentRecord | None = None
    covariance: Covariance | None = None
    check: Check | None = None
    frame_mm: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pitch_um: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    thumbnail: Callable[[str, str, str], Thumbnail | None] | None = None
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    made_from: Mapping[str, str] = field(default_factory=dict)
    unit: str = "m"
    given_by: Mapping[str, str] = field(default_factory=dict)
    totals: FrameTotals | None = None

    @property
    def is_film_alone(self) -> bool:
        """Whether only fiducial marks were adjusted and no camera is calibrated."""
        stored = self.adjustment
        return stored is not None and not any(camera.is_calibrated for camera in stored.cameras.values())

    @property
    def is_digital(self) -> bool:
        """Whether image lengths are stated in pixels."""
        return any(unit.is_pixel for unit in self.image_units.values())

    @cached_property
    def image_units(self) -> Mapping[str, ImageUnit]:
        """Unit of image lengths by camera of the adjustment; empty if all are in mm and µm."""
        stored = self.adjustment
        if stored is None or any(camera.fiducials for camera in stored.cameras.values()):
            return {}
        sizes: dict[str, set[float]] = {name: set() for name in stored.cameras}
        for name, image in stored.images.items():
            is_film = image.transformation.kind != "none"
            sizes[stored.image_camera(name)] |= {math.nan} if is_film else {*self.pitch_um.get(name, (math.nan,))}
        if any(len(each) != 1 or math.isnan(min(each)) for each in sizes.values()):
            return {}
        return {name: ImageUnit(min(each)) for name, each in sizes.items()}

    def given_by_of(self, camera: str) -> str:
        """Source of the given fiducial coordinates of a camera."""
        return self.given_by.get(camera, "the given coordinates")

    def unit_of_camera(self, camera: str) -> ImageUnit:
        return self.image_units.get(camera, FILM_UNIT)

    def unit_of_image(self, image: str) -> ImageUnit:
        stored = self.adjustment
        return self.unit_of_camera(stored.image_camera(image)) if stored and image in stored.images else FILM_UNIT
