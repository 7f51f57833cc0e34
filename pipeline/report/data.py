"""What the report is made from: the files of the stages, any of which may be missing."""

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
    """Something that needs a look: what it is, and what to do about it.

    images: the frames that it is about; marks: those that it is about, the first of which the report shows; section: of
    the report, that has more of it.
    """

    what: str
    next_step: str = ""
    images: tuple[str, ...] = field(default=(), compare=False)
    marks: tuple[MarkKey, ...] = field(default=(), compare=False)
    section: str = field(default="", compare=False)

    @property
    def cause(self) -> str:
        """Its first sentence."""
        return _SENTENCE.split(self.what, maxsplit=1)[0]

    @property
    def detail(self) -> str:
        """What follows it."""
        return "".join(_SENTENCE.split(self.what, maxsplit=1)[1:])


@dataclass(frozen=True)
class FrameTotals:
    """What a report says of more frames than it shows one by one.

    marks: their number by image and status; of_targets: of those that are no
    fiducials, by kind and status. verdicts: number of frames by camera and kind of file, and then by verdict. problems:
    what the frames have to say. places_px: of all marks observed, by axis; as `fractions.places_px` has them.
    """

    marks: Mapping[str, Mapping[str, int]]
    of_targets: Mapping[tuple[str, str], int]
    verdicts: Mapping[tuple[str, str], Mapping[str, int]]
    problems: tuple[Problem, ...]
    places_px: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class ReportData:
    """Everything a report can show.

    comparator: the rows of comparator.csv. measurement: the scans of measurement.db by image. adjustment, check: as
    adjustment.json and check.json keep them; covariance: adjustment.npz. frame_mm: width and height of the exposed
    frame by camera name. pitch_um: of the scans whose pixel positions are known, across and down. thumbnail: from
    image, point and kind (a fiducial and a target may share a name) to the mark's picture. problems, notes: what the
    caller has to say beyond the files. made_from: their fingerprints by name. unit: of the object coordinates.
    given_by: by camera what its fiducials' given coordinates come from. totals: of all frames where they are many;
    comparator and measurement are then of those that are shown.
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
        """Whether fiducial marks are all there was to adjust."""
        stored = self.adjustment
        return stored is not None and not any(camera.is_calibrated for camera in stored.cameras.values())

    @property
    def is_digital(self) -> bool:
        """Whether all is stated in pixels."""
        return any(unit.is_pixel for unit in self.image_units.values())

    @cached_property
    def image_units(self) -> Mapping[str, ImageUnit]:
        """By camera of the adjustment the unit of lengths in its images: all in px, or all in mm and µm."""
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
        """What the given coordinates of a camera's fiducials come from."""
        return self.given_by.get(camera, "the given coordinates")

    def unit_of_camera(self, camera: str) -> ImageUnit:
        return self.image_units.get(camera, FILM_UNIT)

    def unit_of_image(self, image: str) -> ImageUnit:
        stored = self.adjustment
        return self.unit_of_camera(stored.image_camera(image)) if stored and image in stored.images else FILM_UNIT
