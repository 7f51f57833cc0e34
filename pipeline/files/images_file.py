"""images.csv: exterior orientations (approximate or observed), camera and scanner of each image."""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from adjust.problem.network import Exterior
from measure.scans.remote import Window
from pipeline.errors import InputError
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import Row, read_csv
from pipeline.text.names import image_name
from pipeline.text.text_file import read_bytes

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


def read_images(path: Path, antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> GivenImages:
    """Read images.csv. Images may be named with or without the file's ending. Raises InputError with the line.

    antenna: offset of the point with the given X0, Y0, Z0 from the projection centre, as in `Exterior`.
    """
    exterior: dict[str, Exterior | None] = {}
    camera, scanner, part_of, cuts, asks_writing = {}, {}, {}, dict[str, tuple[int | None, Window | None]](), False
    turned_deg = dict[str, int]()
    for row in read_csv(path, ("image",), (*ELEMENTS, *SIGMAS, *_FURTHER, *WRITTEN)):
        name = image_name(row.name("image"))
        if name in exterior:
            raise InputError(f"{path}, line {row.line}: image {name!r} is given twice. Remove one of the lines.")
        exterior[name] = _exterior(row, antenna)
        camera[name], scanner[name], part_of[name] = row.text("camera"), row.text("scanner"), row.text("part_of")
        page, window = _page(row), _window(row)
        if page or window:
            cuts[name] = page, window
        if turned := _turned(row):
            turned_deg[name] = turned
        asks_writing = any(column in row.cells for column in WRITTEN)
    _join(path, exterior, camera, part_of)
    return GivenImages(exterior, camera, scanner, asks_writing, turned_deg, part_of, cuts)


def _turned(row: Row) -> int:
    text = row.text("turned_deg")
    if text not in ("", "0", "90", "180", "270"):
        raise row.error(
            "turned_deg", f"is {text!r}: 0, 90, 180 or 270 is right, the counter-clockwise turn of a picture."
        )
    return int(text or 0)


def _page(row: Row) -> int | None:
    text = row.text("page")
    if not text:
        return None
    if not text.isdecimal() or int(text) < 1:
        raise row.error("page", f"is {text!r}: the number of a page in the file, from 1, is right.")
    return int(text)


def _window(row: Row) -> Window | None:
    text = row.text("window")
    if not text:
        return None
    numbers = text.split()
    if len(numbers) != 4 or not all(number.isdecimal() for number in numbers) or "0" in numbers[2:]:
        raise row.error("window", f'is {text!r}: "col row width height" in px of the scan is right.')
    col, row_px, width, height = map(int, numbers)
    return col, row_px, width, height


def _join(
    path: Path, exterior: dict[str, Exterior | None], camera: Mapping[str, str], part_of: Mapping[str, str]
) -> None:
    """Copy the orientation of a frame to all its parts. Raises InputError where parts contradict each other, or a frame
    has only one part."""
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
    lines = text.splitlines(keepends=True)
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
        filled = [
            own.get(column, "") if not cell.strip() else cell for column, cell in zip(header, cells, strict=False)
        ]
        if filled != cells[: len(header)]:
            written = io.StringIO()
            csv.writer(written, lineterminator=line[len(body) :]).writerow([*filled, *cells[len(header) :]])
            lines[index] = written.getvalue()
    changed = "".join(lines)
    if changed != text:
        write_atomically(path, changed)


def _exterior(row: Row, antenna: tuple[float, float, float]) -> Exterior | None:
    values = [row.number(element) for element in ELEMENTS]
    if all(value is None for value in values):
        return None
    for element, value in zip(ELEMENTS, values, strict=True):
        if value is None:
            raise row.error(
                element, "is blank, but other elements of this orientation are given. Give all six or none."
            )
    sigmas = [row.sigma(sigma) for sigma in SIGMAS]
    if any(antenna) and 0.0 in sigmas[:3]:
        raise row.error(SIGMAS[sigmas.index(0.0)], "is 0, but an antenna can be observed only: give it a positive one.")
    to_rad = np.array([1.0, 1.0, 1.0, *[math.pi / 180.0] * 3])
    return Exterior(
        np.array(values, dtype=np.float64) * to_rad,
        np.array([math.inf if sigma is None else sigma for sigma in sigmas]) * to_rad,
        antenna,
    )
