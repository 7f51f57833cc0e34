"""Specifications of calibration boards: the printed pattern and the object coordinates of its points.

Board coordinate system: x right, y up, z towards the viewer in the intended orientation, origin at the lower left
point, units those of the specification.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import ClassVar

import cv2
import numpy as np

from measure.array_types import Array
from measure.flags import NO_REASON, Reason

Point3 = tuple[float, float, float]


class _Spec:
    """Base of boards with columns and rows; validates counts and lengths."""

    fewest: ClassVar[int] = 3  # columns, and rows

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in ("columns", "rows") and value < self.fewest:
                raise ValueError(f"{name} is {value}; {self.fewest} or more is right")
            if name.endswith("_mm") and value is not None and not (value > 0 and np.isfinite(value)):
                raise ValueError(f"{name} is {value}; a positive number is right")


@dataclass(frozen=True)
class ChessboardSpec(_Spec):
    """Chessboard of columns x rows INNER corners. A point's id is r{row}c{column}; row 0 is the upper one."""

    columns: int
    rows: int
    square_mm: float

    def object_points(self) -> dict[str, Point3]:
        """Id to (X, Y, 0) in mm."""
        step, last = self.square_mm, self.rows - 1
        places = product(range(self.rows), range(self.columns))
        return {f"r{row}c{column}": (column * step, (last - row) * step, 0.0) for row, column in places}


@dataclass(frozen=True)
class CircleGridSpec(_Spec):
    """Grid of columns x rows dots. A point's id is r{row}c{column}.

    spacing_mm: between neighbouring columns and rows; asymmetric: only places with even row + column hold a dot (every
    other row is shifted by one column), while columns and rows count all places; row_spacing_mm: spacing of the rows if
    it differs from that of the columns (hexagonal grid: sqrt(3) times that).
    """

    columns: int
    rows: int
    spacing_mm: float
    diameter_mm: float
    asymmetric: bool = False
    row_spacing_mm: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.diameter_mm >= self.shortest_distance_mm:
            raise ValueError(
                f"diameter_mm is {self.diameter_mm}; dots less than {self.shortest_distance_mm} wide are right"
            )

    def places(self) -> list[tuple[int, int]]:
        """(row, column) of every dot."""
        places = product(range(self.rows), range(self.columns))
        return [(row, column) for row, column in places if not self.asymmetric or (row + column) % 2 == 0]

    @property
    def shortest_distance_mm(self) -> float:
        """Distance between the centres of neighbouring dots."""
        across, down = self.spacing_mm, self._row_step_mm
        return min(2 * across, 2 * down, float(np.hypot(across, down))) if self.asymmetric else min(across, down)

    @property
    def _row_step_mm(self) -> float:
        return self.spacing_mm if self.row_spacing_mm is None else self.row_spacing_mm

    def object_points(self) -> dict[str, Point3]:
        """Id to (X, Y, 0) in mm."""
        return {
            f"r{row}c{column}": (column * self.spacing_mm, (self.rows - 1 - row) * self._row_step_mm, 0.0)
            for row, column in self.places()
        }


@dataclass(frozen=True)
class ArucoSpec(_Spec):
    """Board of columns x rows ArUco markers, the first in the upper left corner, then row by row.

    dictionary: OpenCV's name, e.g. "4X4_50". A point's id is {marker}.{corner}; corner 0 is the marker's upper left
    one, then clockwise.
    """

    dictionary: str
    columns: int
    rows: int
    marker_mm: float
    gap_mm: float
    first_marker: int = 0
    fewest = 1
    border_modules: ClassVar[int] = 1  # modules of black border around a marker's code

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_markers(self.dictionary, self.first_marker, self.columns * self.rows)

    @property
    def modules(self) -> int:
        """Number of modules along the side of a marker."""
        return int(aruco_dictionary(self.dictionary).markerSize) + 2 * self.border_modules

    def marker(self, row: int, column: int) -> int:
        """The number of the marker at a place."""
        return self.first_marker + row * self.columns + column

    def object_points(self) -> dict[str, Point3]:
        """Id to (X, Y, 0) in mm."""
        corners = _corners(self.columns, self.rows, self.marker_mm, self.gap_mm)
        return {f"{self.marker(row, column)}.{k}": point for (row, column, k), point in corners.items()}


@dataclass(frozen=True)
class AprilGridSpec(ArucoSpec):
    """Kalibr's grid of AprilTags. The first marker is in the LOWER left corner, then row by row upwards.

    Markers have two modules of border, or one as some programs print it. A dark square in each gap touches the markers'
    corners. Corners are named as in `ArucoSpec`.
    """

    border_modules = 2

    def marker(self, row: int, column: int) -> int:
        """The number of the marker at a place."""
        return super().marker(self.rows - 1 - row, column)


@dataclass(frozen=True)
class SquareGridSpec(_Spec):
    """Grid of columns x rows separate dark squares, like Zhang's pattern.

    A point's id is r{row}c{column}.{corner}; row 0 is the upper one, corner 0 the square's upper left one, then
    clockwise.
    """

    columns: int
    rows: int
    square_mm: float
    gap_mm: float

    def places(self) -> list[tuple[int, int]]:
        """(row, column) of every square."""
        return list(product(range(self.rows), range(self.columns)))

    def object_points(self) -> dict[str, Point3]:
        """Id to (X, Y, 0) in mm."""
        corners = _corners(self.columns, self.rows, self.square_mm, self.gap_mm)
        return {f"r{row}c{column}.{corner}": at for (row, column, corner), at in corners.items()}


@dataclass(frozen=True)
class CharucoSpec(_Spec):
    """ChArUco board: chessboard of columns x rows SQUARES with ArUco markers in the white ones, as printed by OpenCV.

    A point's id is c{number} of the inner corner, row by row from the upper left one. legacy: layout of OpenCV before
    4.6, with a marker in the upper left square if the number of rows is even; None: determined from the markers.
    first_id: number of the first marker.
    """

    dictionary: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    legacy: bool | None = None
    first_id: int = 0
    fewest = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm is {self.marker_mm}; less than the square's {self.square_mm} is right")
        _check_markers(self.dictionary, self.first_id, self.columns * self.rows // 2)

    def object_points(self) -> dict[str, Point3]:
        """Id to (X, Y, 0) in mm."""
        step, last, across = self.square_mm, self.rows - 2, self.columns - 1
        places = product(range(self.rows - 1), range(across))
        return {f"c{row * across + column}": (column * step, (last - row) * step, 0.0) for row, column in places}


BoardSpec = ChessboardSpec | CircleGridSpec | ArucoSpec | CharucoSpec | SquareGridSpec


def _corners(columns: int, rows: int, side_mm: float, gap_mm: float) -> dict[tuple[int, int, int], Point3]:
    """Object points by (row, column, corner) of separate squares, clockwise from the upper left corner of each."""
    step = side_mm + gap_mm
    top = (rows - 1) * step + side_mm
    corners = ((0.0, 0.0), (side_mm, 0.0), (side_mm, side_mm), (0.0, side_mm))
    return {
        (row, column, corner): (column * step + right, top - row * step - down, 0.0)
        for row, column, (corner, (right, down)) in product(range(rows), range(columns), enumerate(corners))
    }


def aruco_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined dictionary of that name, with or without the prefix DICT_."""
    code = getattr(cv2.aruco, "DICT_" + name.upper().removeprefix("DICT_"), None)
    if code is None:
        # OpenCV has some names twice: APRILTAG_36h11 and APRILTAG_36H11.
        known = ", ".join(sorted({known[5:].replace("H", "h") for known in dir(cv2.aruco) if known[:5] == "DICT_"}))
        raise ValueError(f"dictionary is {name!r}; one of {known} is right")
    return cv2.aruco.getPredefinedDictionary(code)


def _check_markers(name: str, first: int, count: int) -> None:
    size = len(aruco_dictionary(name).bytesList)
    if first < 0 or first + count > size:
        raise ValueError(
            f"the board needs markers {first} to {first + count - 1}; dictionary {name} has 0 to {size - 1}"
        )


@dataclass(frozen=True)
class FoundCorner:
    """Corner detected to about a pixel. center_px (2,) in the scan; steps_px (2, 2): its columns are the edges that
    leave the corner, to the right and lower neighbour or along the sides of a marker."""

    center_px: Array
    steps_px: Array


@dataclass(frozen=True)
class FoundBoard:
    """Board found in a scan.

    Attributes
    ----------
    corners : by id; empty if the board was not found.
    reason : why it was not found.
    refused : by number, markers that were read but are not used, with the reason.
    off_corners : by id, corners that contradict the adjacent markers, with the reason.
    others_px : centres of further boards that look the same.
    notes : messages to the user.
    is_mirrored : whether the image shows the board mirrored.
    is_of_other_count : whether a whole chessboard of another count was found.
    """

    corners: dict[str, FoundCorner]
    reason: Reason = NO_REASON
    refused: Mapping[int, Reason] = field(default_factory=dict)
    off_corners: Mapping[str, Reason] = field(default_factory=dict)
    others_px: tuple[Array, ...] = ()
    notes: tuple[str, ...] = ()
    is_mirrored: bool = False
    is_of_other_count: bool = False

    def mirror(self, width_px: int) -> "FoundBoard":
        """Convert to the board of the image mirrored left to right."""
        sign = np.array([-1.0, 1.0])
        corners = {
            name: FoundCorner(corner.center_px * sign + [width_px - 1, 0], corner.steps_px * sign[:, None])
            for name, corner in self.corners.items()
        }
        return replace(self, corners=corners, is_mirrored=not self.is_mirrored)


def corners_of_square(name: str, corners: Array) -> dict[str, FoundCorner]:
    """Convert the four corners (4, 2) of a square or marker to FoundCorners, with the sides that leave them."""
    found = {}
    for index, corner in enumerate(corners):
        sides = np.stack([corners[(index + 1) % 4] - corner, corners[(index - 1) % 4] - corner], axis=-1)
        found[f"{name}.{index}"] = FoundCorner(corner, sides)
    return found
