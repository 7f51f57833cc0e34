"""points.csv, with normals of disks where they are known, and distances.csv."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.problem.network import ObjectPoint
from adjust.problem.observations import Distance
from pipeline.errors import InputError
from pipeline.text.csv_table import Row, read_csv

REQUIRED = ("point", "X", "Y", "Z")
OPTIONAL = ("sX", "sY", "sZ", "nX", "nY", "nZ")
COLUMNS = ("from", "to", "distance", "sigma")


@dataclass(frozen=True)
class GivenPoints:
    """Object points in the user's unit, sorted by id, and unit normals (3,) of disks by id, where they are given."""

    points: tuple[ObjectPoint, ...]
    normals: Mapping[str, NDArray[np.float64]]


def read_points(path: Path) -> GivenPoints:
    """Read points.csv. Raises InputError with the line of a repeated point, a sigma without a value, or an invalid
    number."""
    points: dict[str, ObjectPoint] = {}
    lines: dict[str, int] = {}
    normals = {}
    for row in read_csv(path, REQUIRED, OPTIONAL):
        id = row.name("point")
        if id in points:
            raise InputError(
                f"{path}, line {row.line}: point {id!r} is given already, in line {lines[id]}. Remove or rename one."
            )
        points[id] = ObjectPoint(id, *(_coordinate(row, axis) for axis in "XYZ"))
        lines[id] = row.line
        normal = _normal(row)
        if normal is not None:
            normals[id] = normal
    if not points:
        raise InputError(f"{path}: holds no point, only a header.")
    # Sorted, so that results do not depend on the order in the file: sums, random draws and the order of disk fits
    # follow it.
    return GivenPoints(tuple(points[id] for id in sorted(points)), normals)


def _coordinate(row: Row, axis: str) -> Prior | None:
    """Prior of a coordinate. A sigma of 0 fixes it, a blank sigma frees it, a blank coordinate is unknown. Without a
    sigma column the value is fixed."""
    value, sigma = row.number(axis), row.sigma(f"s{axis}")
    if value is None:
        if sigma is not None:
            raise row.error(axis, f"is blank, but s{axis} is {sigma:g}. Give the coordinate, or leave both blank.")
        return None
    if f"s{axis}" not in row.cells:
        return Prior(value, 0.0)
    return Prior(value, math.inf if sigma is None else sigma)


def _normal(row: Row) -> NDArray[np.float64] | None:
    parts = [row.number(f"n{axis}") for axis in "XYZ"]
    if all(part is None for part in parts):
        return None
    normal = np.array([0.0 if part is None else part for part in parts])
    length = float(np.linalg.norm(normal))
    if any(part is None for part in parts) or length == 0.0:
        raise row.error("nX", "a normal needs three numbers, nX, nY and nZ, not all zero; or leave all three blank.")
    return normal / length


@dataclass(frozen=True)
class GivenDistance:
    """Distance and its line in the file, for messages."""

    distance: Distance
    row: Row


def read_distances(path: Path) -> tuple[GivenDistance, ...]:
    """Read distances.csv, in the unit of the object coordinates. Raises InputError with line and column."""
    distances = tuple(GivenDistance(_distance(row), row) for row in read_csv(path, COLUMNS))
    if not distances:
        raise InputError(f"{path}: holds no distance, only a header.")
    return distances


def _distance(row: Row) -> Distance:
    start, end = row.name("from"), row.name("to")
    if start == end:
        raise row.error("to", f"{end!r} stands at both ends. Give two points, or two images for their stations.")
    value, sigma = _positive(row, "distance"), row.sigma("sigma")
    if sigma is None:
        raise row.error("sigma", "is blank: every distance needs its standard deviation.")
    if sigma == 0.0:
        raise row.error(
            "sigma",
            "is 0, but an exact distance is not offered. Give it a hundredth of the standard deviations of its ends.",
        )
    return Distance(start, end, value, sigma)


def _positive(row: Row, column: str) -> float:
    value = row.number(column)
    if value is None or value <= 0.0:
        raise row.error(column, f"must be a positive length, not {row.text(column)!r}.")
    return value
