"""Points of which some are ring-coded, on a sheet or in space: the dots found in a scan, and the codes read about
them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.scans.scan import Scan
from measure.targets.block_search import Candidate
from measure.targets.consistency import along_plane, is_flat
from measure.targets.disk_detection import DiskSearch, disk_candidates
from measure.targets.ring_codes import read_code
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.text.spelling import did_you_mean
from pipeline.text.wording import listed

Array = NDArray[np.float64]

_LEAST_DIAMETER_PX, _GREATEST_SHARE = 8.0, 0.04  # of a dot; the greatest of the picture's diagonal
_LEAST_CONTRAST = 0.06  # of the full scale: coded targets are printed to be seen


@dataclass(frozen=True, eq=False)
class CodedPoints:
    """Points of a sheet or of a field in space: ids and coordinates xyz (n, 3); places (n, 2): on the plane that holds
    them best; is_flat: whether it does; settings: the kind of the targets."""

    ids: tuple[str, ...]
    xyz: Array
    places: Array
    is_flat: bool
    settings: TargetSettings

    @classmethod
    def of(cls, project: Project, settings: TargetSettings) -> "CodedPoints":
        """The points of points.csv. Raises InputError where it holds too few, or lacks a coded one."""
        if project.given_points is None:
            raise InputError(
                f'{project.path}: [targets] kind "coded-ring" names the dots by the sheet, and there is no [object] '
                'points = "...". Give the file of the sheet\'s points.'
            )
        known = {id: [p.value for p in (q.X, q.Y, q.Z) if p] for id, q in project.object_points.items()}
        xyz = {id: values for id, values in known.items() if len(values) == 3}
        for point in settings.numbers.values():
            if point not in xyz:
                raise InputError(
                    f"{project.path}: [targets.codes] {point}: points.csv has no coordinates of such a point."
                    f"{did_you_mean(point, list(xyz))} Name points of the sheet."
                )
        coordinates = np.array(list(xyz.values())).reshape(-1, 3)
        if len(coordinates) < 4:
            raise InputError(
                f"{project.path}: [object] points: {len(coordinates)} points with X, Y and Z name no coded targets; "
                "give 4."
            )
        along = along_plane(coordinates)
        return cls(tuple(xyz), coordinates, along[:, :2], is_flat(along), settings)


def coded_candidates(scan: Scan, coded: CodedPoints) -> list[Candidate]:
    """The dots of the whole scan that may be such points, the strongest first."""
    greatest = max(_GREATEST_SHARE * float(np.hypot(scan.width_px, scan.height_px)), _LEAST_DIAMETER_PX)
    search = DiskSearch((_LEAST_DIAMETER_PX, greatest), coded.settings.polarity, _LEAST_CONTRAST)
    return disk_candidates(scan, search)


def read_numbers(scan: Scan, found: Sequence[Candidate], coded: CodedPoints, mirrored: bool = False) -> dict[int, int]:
    """The number about each dot that has one; mirrored: as the other side of the film shows it."""
    code = coded.settings.code
    read = {index: read_code(scan, dot, code) for index, dot in enumerate(found)} if code else {}
    return {
        index: code.mirrored(number) if mirrored else number
        for index, number in read.items()
        if number is not None and code is not None
    }


def points_read(numbers: Mapping[int, int], coded: CodedPoints) -> dict[int, int]:
    """The point (by index) that the ring about each dot says, right or not."""
    row = {id: i for i, id in enumerate(coded.ids)}
    points = {dot: coded.settings.numbers.get(number, str(number)) for dot, number in numbers.items()}
    return {dot: row[point] for dot, point in points.items() if point in row}


def named_by_code(points: Mapping[int, int], coded: CodedPoints) -> tuple[dict[int, int], tuple[str, ...]]:
    """The same but for those that are read at several places: these say nothing, until the others tell which is right;
    and what is to be said of them."""
    count = Counter(points.values())
    twice = sorted(coded.ids[point] for point in count if count[point] > 1)
    notes = (f"The codes of {listed(twice)} were read at more than one place and name nothing.",) if twice else ()
    return {dot: point for dot, point in points.items() if count[point] == 1}, notes


def none_coded(found: Sequence[Candidate], numbers: dict[int, int], coded: CodedPoints) -> str:
    """Why no dot has a name by its code."""
    bits = coded.settings.code.bits if coded.settings.code else 0
    if not found:
        return "no dot was found"
    if not numbers:
        return f"none of the {len(found)} dots found has a ring of {bits} segments about it that can be read"
    read = ", ".join(str(number) for number in sorted(set(numbers.values()))[:8])
    return f"the codes read ({read}) are those of no point of the sheet, or were read at more than one place"
