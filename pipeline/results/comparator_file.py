"""comparator.csv: comparator coordinates of all marks, including those not found."""

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from itertools import takewhile
from pathlib import Path
from sys import intern
from typing import get_args

import numpy as np

from adjust.problem.observations import ObservationKind
from measure.flags import Status
from pipeline.errors import InputError
from pipeline.text.csv_table import Row, csv_line, read_csv
from pipeline.text.files import RESULT_MB, SMALLEST_SIGMA, FilePath, atomic_path, image_name, read_bytes
from pipeline.types import Array

COLUMNS = (
    "image", "point", "kind", "x_mm", "y_mm", "sx_mm", "sy_mm", "rho", "col_px", "row_px", "status", "reason",
)  # fmt: skip
LARGEST_RHO = 1.0 - 1e-7  # written: correlations of 1 are not read
PIXEL_SIGMAS = ("scol_px", "srow_px")  # columns of files in pixels only; rho then correlates column and row
KINDS: dict[str, ObservationKind] = {kind: kind for kind in get_args(ObservationKind)}

CameraPerson = tuple[str, str]  # camera and name of the reviewer
_DECISIONS = re.compile(r'^"?# (\d+) decisions of (.+), camera (.+?)"?$', re.MULTILINE)
_HEAD = 4096
_PITCH = re.compile(r'^"?# pitch of (.+): ([0-9.e+-]+) [uµ]m across, ([0-9.e+-]+) [uµ]m down"?$', re.MULTILINE)


@dataclass(frozen=True, slots=True)  # archives have many
class ComparatorPoint:
    """Mark in an image, in comparator coordinates.

    Attributes
    ----------
    xy_mm, sigma_mm : (2,) coordinates and standard deviations, None if unknown.
    rho : correlation of x and y.
    line : line number in the file, 0 if it was not read from one.
    """

    image: str
    point: str
    kind: ObservationKind
    xy_mm: Array | None
    sigma_mm: Array | None
    rho: float
    status: Status
    reason: str
    line: int = 0


def write_comparator(
    path: Path,
    points: Iterable[ComparatorPoint],
    pitch_um: Mapping[str, tuple[float, float]],
    measurement: str = "",
    decided: Mapping[CameraPerson, int] | None = None,
) -> None:
    """Write comparator.csv, marks in the given order, line by line: an archive has many. Parameters as in
    `comparator_lines`. Raises InputError if the file cannot be written."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(comparator_lines(points, pitch_um, measurement, decided))
        file.flush()
        os.fsync(file.fileno())


def comparator_lines(
    points: Iterable[ComparatorPoint],
    pitch_um: Mapping[str, tuple[float, float]],
    measurement: str = "",
    decided: Mapping[CameraPerson, int] | None = None,
) -> Iterator[str]:
    """Yield the lines of comparator.csv; pixel coordinates stay empty if the pitch is unknown.

    Parameters
    ----------
    pitch_um : pixel pitch across and down by image; NaN for a scan that could not be measured.
    measurement : digest of the checked results in measurement.db with the same marks.
    decided : number of review decisions by camera and reviewer.
    """
    yield f"# comparator coordinates, reseau {version('reseau')}\n"
    if measurement:
        yield f"# measurement {measurement}\n"
    for (by, who), count in (decided or {}).items():
        yield f"# {count} decisions of {_single_line(who)}, camera {_single_line(by)}\n"
    yield "# x_mm to the right, y_mm UP, origin at the centre of the scan's top-left pixel\n"
    yield "# sx_mm, sy_mm: standard deviations\n"
    yield "# col_px to the right, row_px down; the CENTRE of the top-left pixel is (0, 0)\n"
    for image, (x, y) in sorted(pitch_um.items()):
        if math.isfinite(x):
            yield f"# pitch of {image}: {x:.10g} µm across, {y:.10g} µm down\n"
    yield "# status: only measured and weak are observations\n"
    yield f"{','.join(COLUMNS)}\n"
    for point in points:
        place, pixel, sigma_rho = ("", ""), ("", ""), ("", "", "")
        if point.xy_mm is not None:
            x, y = point.xy_mm.tolist()
            across, down = pitch_um.get(point.image, (math.nan, math.nan))
            place = f"{x:.7f}", f"{y:.7f}"
            if math.isfinite(across):
                pixel = f"{1000.0 * x / across:.4f}", f"{-1000.0 * y / down:.4f}"
        if point.sigma_mm is not None:
            sx, sy = (_sigma_text(each) for each in point.sigma_mm.tolist())
            rho = f"{point.rho:.4f}"
            if float(rho) in (-1.0, 1.0):  # rounded
                rho = f"{min(max(point.rho, -LARGEST_RHO), LARGEST_RHO):.7f}"
            sigma_rho = sx, sy, rho
        names, ends = csv_line((point.image, point.point, point.kind)), csv_line((point.status, point.reason))
        yield f"{','.join((names, *place, *sigma_rho, *pixel, ends))}\n"


def _sigma_text(sigma_mm: float) -> str:
    """A standard deviation, never rounded to 0, which would not be read."""
    text = f"{sigma_mm:.7f}"
    return text if float(text) else f"{max(sigma_mm, SMALLEST_SIGMA):.3g}"


def _single_line(name: str) -> str:
    return " ".join(name.split())


def comparator_from_pixel(center_px: Array, pitch_um: tuple[float, float]) -> Array:
    """Convert (..., 2) column and row to x (right) and y (up), mm."""
    return np.multiply(center_px, np.array([pitch_um[0], -pitch_um[1]]) / 1000.0)


def pixel_from_comparator(xy_mm: Array, pitch_um: tuple[float, float]) -> Array:
    """Convert (..., 2) x (right) and y (up), mm, to column and row."""
    return np.divide(xy_mm, np.array([pitch_um[0], -pitch_um[1]]) / 1000.0)


def read_measurement_hash(path: Path) -> str:
    """Fingerprint of the measurement from which a comparator file was written; "" if the file has none, such as one
    made by a user."""
    with path.open("rb") as file:
        found = re.search(rb"^\W*# measurement ([0-9a-f]{64})\b", file.read(_HEAD), re.MULTILINE)
    return found[1].decode() if found else ""


def read_decision_counts(path: Path) -> dict[CameraPerson, int]:
    """Read the numbers of review decisions by camera and reviewer from the lines above the table."""
    with path.open("rb") as file:
        head = takewhile(lambda line: line.lstrip(b'"\xef\xbb\xbf').startswith(b"#"), file)
        text = b"".join(line for line in head if b" decisions of " in line).decode("utf-8", "replace")
    return {(camera, who): int(count) for count, who, camera in _DECISIONS.findall(text)}


def describe_decisions(decided: Mapping[CameraPerson, int]) -> str:
    """State the numbers of review decisions in a sentence; "" if there are none."""
    cameras = sorted({camera for camera, _ in decided})
    parts = [
        ", ".join(f"{count} of {who}" for (own, who), count in sorted(decided.items()) if own == camera)
        for camera in cameras
    ]
    named = parts if len(parts) == 1 else [f"{camera}: {part}" for camera, part in zip(cameras, parts, strict=True)]
    return f"Decisions stand behind these marks: {'; '.join(named)}." if named else ""


def read_pitches(path: Path) -> dict[str, tuple[float, float]]:
    """Read the pixel pitch by image, µm across and down, from the lines above the table."""
    text = read_bytes(path, RESULT_MB).decode("utf-8", "replace")
    pitches = {}
    for found in _PITCH.finditer(text):
        image, *given = found.groups()
        try:
            x, y = map(float, given)
        except ValueError:
            x = y = math.nan
        if not min(x, y) > 0.0 or math.isinf(max(x, y)):
            line = text.count("\n", 0, found.start()) + 1
            raise InputError(f"{path}, line {line}: the pitch of {image} is to be two numbers in µm. Correct the line.")
        pitches[image] = (x, y)
    return pitches


def read_comparator(path: FilePath, pitch_um: tuple[float, float] | None = None) -> tuple[ComparatorPoint, ...]:
    """Read comparator.csv.

    Parameters
    ----------
    pitch_um : pixel width and height for files without mm columns; None: such files are refused

    Raises
    ------
    InputError
        Names the line of a duplicate mark, an unknown kind, an invalid number, or a mark with neither mm nor pixels.
    """
    points: dict[tuple[str, str, str], ComparatorPoint] = {}
    for row in read_csv(path, COLUMNS[:2], COLUMNS[2:] + PIXEL_SIGMAS, RESULT_MB):
        point = _point(row, pitch_um)
        key = (point.image, point.point, "fiducial" if point.kind == "fiducial" else "object")
        if key in points:
            raise InputError(
                f"{path}, line {row.line}: {point.kind} {point.point!r} of image {point.image!r} is given already, "
                f"in line {points[key].line}. Remove one of the lines."
            )
        points[key] = point
    if not points:
        raise InputError(f"{path}: holds no mark, only a header.")
    return tuple(points.values())


def has_pixels_alone(path: Path) -> bool:
    """Whether a comparator file has pixel columns but no mm columns. Raises InputError if it has neither."""
    row = next(read_csv(path, COLUMNS[:2], COLUMNS[2:] + PIXEL_SIGMAS, RESULT_MB), None)
    return row is not None and _has_pixels_alone(row)


def _has_pixels_alone(row: Row) -> bool:
    if row.cells.keys() >= {"x_mm", "y_mm"}:
        return False
    if not row.cells.keys() >= {"col_px", "row_px"}:
        raise InputError(
            f"{row.file}: the header lacks the columns x_mm, y_mm or col_px, row_px: where the marks are. Add them."
        )
    return True


def _point(row: Row, pitch_um: tuple[float, float] | None) -> ComparatorPoint:
    kind, status = row.text("kind") or "target", row.text("status") or Status.MEASURED
    if kind not in KINDS:
        raise row.error("kind", f"is {kind!r}; possible are {', '.join(KINDS)}.")
    if status not in list(Status):
        raise row.error("status", f"is {status!r}; possible are {', '.join(Status)}.")
    names = ("x_mm", "y_mm", "sx_mm", "sy_mm")
    if _has_pixels_alone(row):
        names = ("col_px", "row_px", *PIXEL_SIGMAS)
        if pitch_um is None:
            raise InputError(
                f"{row.file}: gives pixels but no mm, and nothing says how large a pixel is. Set pitch_um in "
                "project.toml. A digital camera needs none if its camera file gives no length in mm."
            )
    x, y = row.number(names[0]), row.number(names[1])
    sx, sy = (row.sigma(name, "Leave it blank for the project's own.") for name in names[2:4])
    xy = None if x is None or y is None else np.array([x, y])
    if xy is None and Status(status).is_observation:
        raise row.error(
            names[0], f"is blank, but the status is '{status}'. Give {names[0]} and {names[1]}, or the status absent."
        )
    if sx == 0.0 or sy == 0.0:
        raise row.error(
            names[2], "an observation's standard deviation cannot be 0; leave it blank for the project's own."
        )
    for given, name in ((sx, names[2]), (sy, names[3])):
        if given is None and not (sx is None and sy is None):
            raise row.error(name, f"is blank, but {names[2]} and {names[3]} go together. Give both, or none.")
    rho = row.number("rho") or 0.0
    if not math.fabs(rho) < 1.0:
        raise row.error("rho", f"is a correlation and must lie between -1 and 1, not {rho:g}.")
    sigma = None if sx is None or sy is None else np.array([sx, sy])
    if names[0] == "col_px" and pitch_um is not None:
        xy = None if xy is None else comparator_from_pixel(xy, pitch_um)
        sigma = None if sigma is None else sigma * pitch_um / 1000.0
        rho = -rho  # y counts upward, row downward
    return ComparatorPoint(
        image=intern(image_name(row.name("image"))),
        point=intern(row.name("point")),
        kind=KINDS[kind],
        xy_mm=xy,
        sigma_mm=sigma,
        rho=rho,
        status=Status(status),
        reason=row.text("reason"),
        line=row.line,
    )
