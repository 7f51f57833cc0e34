"""What the report is made from: the files of the stages, any of which may be missing."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.check_file import Check
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.covariance_file import Covariance
from pipeline.results.measured_record import MeasuredScan
from pipeline.results.thumbnail import Thumbnail


@dataclass(frozen=True)
class Problem:
    """Something that needs a look: what it is, and what to do about it."""

    what: str
    next_step: str = ""


@dataclass(frozen=True)
class FrameTotals:
    """What a report says of more frames than it shows one by one.

    needs_look: how many of them need a look. marks: their number by image and status; of_targets: of those that are no
    fiducials, by kind and status. verdicts: number of frames by camera and kind of file, and then by verdict. problems:
    what the frames have to say. places_px, sigmas_um: of all marks observed, by axis; as `fractions.places_px` has
    them, and along x and y of the comparator.
    """

    needs_look: int
    marks: Mapping[str, Mapping[str, int]]
    of_targets: Mapping[tuple[str, str], int]
    verdicts: Mapping[tuple[str, str], Mapping[str, int]]
    problems: tuple[Problem, ...]
    places_px: Mapping[str, NDArray[np.float64]]
    sigmas_um: Mapping[str, NDArray[np.float64]]

    def count(self, verdict: str) -> int:
        """The number of frames with a verdict."""
        return sum(counts.get(verdict, 0) for counts in self.verdicts.values())


@dataclass(frozen=True)
class ReportData:
    """Everything a report can show.

    comparator: the rows of comparator.csv. measurement: the scans of measurement.db by image. adjustment, check: as
    adjustment.json and check.json keep them; covariance: adjustment.npz. frame_mm: width and height of the exposed
    frame by camera name. thumbnail: from image, point and kind (a fiducial and a target may share a name) to the mark's
    picture. problems, notes: what the caller has to say beyond the files. made_from: their fingerprints by name. unit:
    of the object coordinates. totals: of all frames where they are many; comparator and measurement are then of those
    that are shown.
    """

    project: str
    comparator: Sequence[ComparatorPoint] = ()
    measurement: Mapping[str, MeasuredScan] | None = None
    adjustment: AdjustmentRecord | None = None
    covariance: Covariance | None = None
    check: Check | None = None
    frame_mm: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    thumbnail: Callable[[str, str, str], Thumbnail | None] | None = None
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    made_from: Mapping[str, str] = field(default_factory=dict)
    unit: str = "m"
    totals: FrameTotals | None = None
