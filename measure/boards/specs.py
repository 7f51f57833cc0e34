"""Calibration boards as their makers describe them: what is printed, and where on the board its points lie.

A board's frame: x right, y up, z towards the viewer, seen as it is meant to be seen, origin at its lower left point;
units are those of the specification.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.flags import NO_REASON, Reason

Point3 = tuple[float, float, float]
Array = NDArray[np.float64]


class _Spec:
    """A board of columns and rows; its lengths are positive."""

    fewest: ClassVar[int] = 3  # columns, and rows

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in ("columns", "rows") and value < self.fewest:
                raise ValueError(f"{name} is {value}; {self.fewest} or more is right")
            if name.endswith("_mm") and value is not None and not (value > 0 and np.isfinite(value)):
                raise ValueError(f"{name} is {value}; a positive number is right")


@dataclass(frozen=True)
class ChessboardSpec(_Spec):
    """A chessboard of columns x rows INNER corners; a point's id is r{row}c{column}, row 0 the upper one."""

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
    """A grid of columns x rows dots; a point's id is r{row}c{column}.

    spacing_mm: between neighbouring columns and rows. Asymmetric: only the places where row + column is even hold a dot
    (every other row is moved by one column), columns and rows still counting places. row_spacing_mm: where rows lie at
    another distance than columns (a hexagonal grid: sqrt(3) times the columns').
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
        """Between the centres of neighbouring dots."""
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
    """A board of columns x rows ArUco markers, the first in the upper left corner, then row by row.

    dictionary: OpenCV's name, "4X4_50" say. A point's id is {marker}.{corner}, the corner 0 being the marker's upper
    left one, then clockwise.
    """

    dictionary: str
    columns: int
    rows: int
    marker_mm: float
    gap_mm: float
    first_marker: int = 0
    fewest = 1
    border_modules: ClassVar[int] = 1  # of a marker, about its code

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_markers(self.dictionary, self.first_marker, self.columns * self.rows)

    @property
    def modules(self) -> int:
        """Along the side of a marker."""
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
    """Kalibr's grid of AprilTags: two modules of border, or one as some programs print it, a dark square in each gap
    that touches the markers' corners, the first marker in the LOWER left corner, then row by row upwards.

    Corners are named as those of `ArucoSpec`.
    """

    border_modules = 2

    def marker(self, row: int, column: int) -> int:
        """The number of the marker at a place."""
        return super().marker(self.rows - 1 - row, column)


@dataclass(frozen=True)
class SquareGridSpec(_Spec):
    """A grid of columns x rows separate dark squares, as Zhang's pattern.

    A point's id is r{row}c{column}.{corner}, row 0 the upper one, the corner 0 being the square's upper left one, then
    clockwise.
    """

    columns: int
    rows: int
    square_mm: float
    gap_mm: float

    def places(self) -> list[tuple[int, int]]:
        """(row, column) of every square."""
        return list(product(range(self.rows), range(self.columns)))

    @staticmethod
    def square_name(place: tuple[int, int]) -> str:
        """Of a square by its row and column."""
        return f"r{place[0]}c{place[1]}"

    def object_points(self) -> dict[str, Point3]:
        """Id to (X, Y, 0) in mm."""
        corners = _corners(self.columns, self.rows, self.square_mm, self.gap_mm)
        return {f"{self.square_name((row, column))}.{corner}": at for (row, column, corner), at in corners.items()}


@dataclass(frozen=True)
class CharucoSpec(_Spec):
    """A chessboard of columns x rows SQUARES with ArUco markers in its white ones, as OpenCV prints it.

    A point's id is c{number} of the inner corner, row by row from the upper left one. legacy: whether the board has the
    layout of OpenCV before 4.6, a marker in the upper left square where the rows are even; None: the markers tell it.
    first_id: the number of the first marker.
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
    """By row, column and corner: those of squares side by side, clockwise from the upper left one of each."""
    step = side_mm + gap_mm
    top = (rows - 1) * step + side_mm
    corners = ((0.0, 0.0), (side_mm, 0.0), (side_mm, side_mm), (0.0, side_mm))
    return {
        (row, column, corner): (column * step + right, top - row * step - down, 0.0)
        for row, column, (corner, (right, down)) in product(range(rows), range(columns), enumerate(corners))
    }


def aruco_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined dictionary of that name, with or without DICT_ before it."""
    code = getattr(cv2.aruco, "DICT_" + name.upper().removeprefix("DICT_"), None)
    if code is None:
        known = ", ".join(sorted(known[5:] for known in dir(cv2.aruco) if known.startswith("DICT_")))
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
    """A corner to a pixel. center_px (2,) in the scan; steps_px (2, 2): its columns are the sides of the square that
    begins here (its right and its lower neighbour), or of the marker: the edges leaving the corner."""

    center_px: Array
    steps_px: Array


@dataclass(frozen=True)
class FoundBoard:
    """The corners found, by id; none, and the reason why; refused: the markers that were read and are not used, by
    number, and why; off_corners: the corners that do not lie where the markers beside them put them, and why;
    others_px: the middles of further boards that look the same; notes: what the user should know; is_mirrored: whether
    the picture shows the board as a mirror does."""

    corners: dict[str, FoundCorner]
    reason: Reason = NO_REASON
    refused: Mapping[int, Reason] = field(default_factory=dict)
    off_corners: Mapping[str, Reason] = field(default_factory=dict)
    others_px: tuple[Array, ...] = ()
    notes: tuple[str, ...] = ()
    is_mirrored: bool = False

    def mirrored(self, width_px: int) -> "FoundBoard":
        """The board of a picture of which this is the mirror image, left to right."""
        sign = np.array([-1.0, 1.0])
        corners = {
            name: FoundCorner(corner.center_px * sign + [width_px - 1, 0], corner.steps_px * sign[:, None])
            for name, corner in self.corners.items()
        }
        return replace(self, corners=corners, is_mirrored=not self.is_mirrored)


def corners_of_square(name: str, corners: Array) -> dict[str, FoundCorner]:
    """The four corners (4, 2) of a square or marker, with its sides that leave them."""
    found = {}
    for index, corner in enumerate(corners):
        sides = np.stack([corners[(index + 1) % 4] - corner, corners[(index - 1) % 4] - corner], axis=-1)
        found[f"{name}.{index}"] = FoundCorner(corner, sides)
    return found
