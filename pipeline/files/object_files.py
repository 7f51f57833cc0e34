"""points.csv, with normals of disks where they are known, distances.csv, and images.csv: exterior orientations, camera
and scanner of each image."""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.problem.network import Exterior, ObjectPoint
from adjust.problem.observations import Distance
from measure.scans.remote import Window
from pipeline.errors import InputError
from pipeline.text.csv_table import Row, read_csv
from pipeline.text.files import FilePath, image_name, read_bytes, split_lines, write_atomically

REQUIRED = ("point", "X", "Y", "Z")
OPTIONAL = ("sX", "sY", "sZ", "nX", "nY", "nZ")
COLUMNS = ("from", "to", "distance", "sigma")


@dataclass(frozen=True)
class GivenPoints:
    """Object points in the user's unit, sorted by id, and unit normals (3,) of disks by id, where they are given."""

    points: tuple[ObjectPoint, ...]
    normals: Mapping[str, NDArray[np.float64]]


def read_points(path: FilePath) -> GivenPoints:
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
    """Prior of a coordinate: fixed by sigma 0 or without that column, freed by a blank sigma, unknown if blank."""
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
    distances = []
    for row in read_csv(path, COLUMNS):
        start, end = row.name("from"), row.name("to")
        if start == end:
            raise row.error("to", f"{end!r} stands at both ends. Give two points, or two images for their stations.")
        value = row.number("distance")
        if value is None or value <= 0.0:
            raise row.error("distance", f"must be a positive length, not {row.text('distance')!r}.")
        sigma = row.sigma("sigma")
        if sigma is None:
            raise row.error("sigma", "is blank: every distance needs its standard deviation.")
        if sigma == 0.0:
            raise row.error(
                "sigma",
                "is 0, but an exact distance is not offered. Give it a hundredth of the standard deviations of its "
                "ends.",
            )
        distances.append(GivenDistance(Distance(start, end, value, sigma), row))
    if not distances:
        raise InputError(f"{path}: holds no distance, only a header.")
    return tuple(distances)


ELEMENTS = ("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg")
SIGMAS = tuple(f"s{element}" for element in ELEMENTS)
_FURTHER = ("camera", "scanner", "part_of", "page", "window", "turned_deg")
WRITTEN = ("run", "frame", "date", "time", "height", "scale", "camera_number")  # columns for the writing on the film


@dataclass(frozen=True)
class GivenImages:
    """Content of images.csv, by image name.

    Attributes
    ----------
    exterior : exterior orientation; None where the line gives none. All parts of a frame have the one given at any of
        them.
    camera, scanner : names of the camera file and the scanner; "" where none is given.
    asks_writing : whether there is a column for writing on the film.
    turned_deg : counter-clockwise rotation of a digital image, where it was rotated.
    part_of : frame of which the scan is one of several overlapping parts; "" for a whole frame.
    cuts : page and window of the scan's file, where either is given.
    """

    exterior: Mapping[str, Exterior | None]
    camera: Mapping[str, str]
    scanner: Mapping[str, str] = field(default_factory=dict)
    asks_writing: bool = False
    turned_deg: Mapping[str, int] = field(default_factory=dict)
    part_of: Mapping[str, str] = field(default_factory=dict)
    cuts: Mapping[str, tuple[int | None, Window | None]] = field(default_factory=dict)


def read_images(path: FilePath) -> GivenImages:
    """Read images.csv. Images may be named with or without the file's ending. Raises InputError with the line."""
    exterior: dict[str, Exterior | None] = {}
    camera, scanner, part_of, cuts, asks_writing = {}, {}, {}, dict[str, tuple[int | None, Window | None]](), False
    turned_deg = dict[str, int]()
    for row in read_csv(path, ("image",), (*ELEMENTS, *SIGMAS, *_FURTHER, *WRITTEN)):
        name = image_name(row.name("image"))
        if name in exterior:
            raise InputError(f"{path}, line {row.line}: image {name!r} is given twice. Remove one of the lines.")
        exterior[name] = _exterior(row)
        camera[name], scanner[name], part_of[name] = row.text("camera"), row.text("scanner"), row.text("part_of")
        if any(cut := _page_and_window(row)):
            cuts[name] = cut
        text = row.text("turned_deg")
        if text not in ("", "0", "90", "180", "270"):
            raise row.error(
                "turned_deg", f"is {text!r}: 0, 90, 180 or 270 is right, the counter-clockwise turn of a picture."
            )
        if turned := int(text or 0):
            turned_deg[name] = turned
        asks_writing = any(column in row.cells for column in WRITTEN)
    _join(Path(path), exterior, camera, part_of)
    return GivenImages(exterior, camera, scanner, asks_writing, turned_deg, part_of, cuts)


def _page_and_window(row: Row) -> tuple[int | None, Window | None]:
    """Page and window of the scan's file, None where they are not given."""
    page, window, numbers = row.text("page"), row.text("window"), row.text("window").split()
    if page and (not page.isdecimal() or int(page) < 1):
        raise row.error("page", f"is {page!r}: the number of a page in the file, from 1, is right.")
    if window and (len(numbers) != 4 or not all(map(str.isdecimal, numbers)) or "0" in numbers[2:]):
        raise row.error("window", f'is {window!r}: "col row width height" in px of the scan is right.')
    number = int(page) if page else None
    if not window:
        return number, None
    col, row_px, width, height = map(int, numbers)
    return number, (col, row_px, width, height)


def _join(
    path: Path, exterior: dict[str, Exterior | None], camera: Mapping[str, str], part_of: Mapping[str, str]
) -> None:
    """Copy the orientation of a frame to its parts. Raises InputError for contradictions, and for a single part."""
    for frame in sorted({frame for frame in part_of.values() if frame}):
        parts = [image for image in part_of if part_of[image] == frame]
        if len(parts) == 1:
            raise InputError(
                f"{path}: image {parts[0]!r} is the only part of {frame!r} (column part_of). Give the same name to the "
                "other scans of that frame, or leave the cell blank."
            )
        if frame in part_of:
            raise InputError(f"{path}: part_of {frame!r} is an image itself. Name the frame otherwise than its scans.")
        given = [image for image in parts if exterior[image] is not None]
        if len(given) > 1 and len({str(exterior[image]) for image in given}) > 1:
            raise InputError(
                f"{path}: {given[0]!r} and {given[1]!r} are parts of frame {frame!r}, but have different orientations. "
                "Give it at one of them."
            )
        if len({camera[image] for image in parts}) > 1:
            raise InputError(f"{path}: the parts of frame {frame!r} have different cameras. Give them one.")
        for image in parts:
            exterior[image] = exterior[given[0]] if given else None


def fill_images(path: Path, values: Mapping[str, Mapping[str, str]]) -> None:
    """Fill empty cells of images.csv with values by image and column; everything else stays unchanged. Raises
    InputError where the file cannot be read or written."""
    text = read_bytes(path).decode("utf-8")
    lines = split_lines(text)
    header: list[str] = []
    for index, line in enumerate(lines):
        if not line.strip() or line.lstrip("\ufeff ").startswith("#"):
            continue
        body = line.rstrip("\r\n")
        cells = next(csv.reader([body.lstrip("\ufeff")]))
        if not header:
            header = [cell.strip() for cell in cells]
            continue
        own = values.get(image_name(cells[header.index("image")]), {})
        filled = [own.get(name, "") if not cell.strip() else cell for name, cell in zip(header, cells, strict=False)]
        if filled != cells[: len(header)]:
            written = io.StringIO()
            csv.writer(written, lineterminator=line[len(body) :]).writerow([*filled, *cells[len(header) :]])
            lines[index] = written.getvalue()
    changed = "".join(lines)
    if changed != text:
        write_atomically(path, changed)


def _exterior(row: Row) -> Exterior | None:
    values = [row.number(element) for element in ELEMENTS]
    if all(value is None for value in values):
        return None
    for element, value in zip(ELEMENTS, values, strict=True):
        if value is None:
            raise row.error(
                element, "is blank, but other elements of this orientation are given. Give all six or none."
            )
    sigmas = [row.sigma(sigma) for sigma in SIGMAS]
    to_rad = np.array([1.0, 1.0, 1.0, *[math.pi / 180.0] * 3])
    return Exterior(
        np.array(values, dtype=np.float64) * to_rad,
        np.array([math.inf if sigma is None else sigma for sigma in sigmas]) * to_rad,
    )
