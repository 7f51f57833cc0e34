"""comparator.csv: comparator coordinates of every mark, also of those that were not found."""

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from itertools import chain, takewhile
from pathlib import Path
from sys import intern
from types import MappingProxyType
from typing import NamedTuple, get_args

import numpy as np

from adjust.problem.observations import ObservationKind
from measure.flags import Status
from measure.results import FrameMeasurement
from pipeline.errors import InputError
from pipeline.text.atomic import atomic_path
from pipeline.text.csv_table import Row, csv_line, csv_rows
from pipeline.text.names import image_name
from pipeline.text.text_file import read_bytes
from pipeline.types import Array

COLUMNS = (
    "image", "point", "kind", "x_mm", "y_mm", "sx_mm", "sy_mm", "rho", "col_px", "row_px", "status", "reason",
)  # fmt: skip
PIXEL_SIGMAS = ("scol_px", "srow_px")  # of lists of pixels; rho then is that of column and row
_KINDS: dict[str, ObservationKind] = {kind: kind for kind in get_args(ObservationKind)}

CameraPerson = tuple[str, str]  # camera, and who
_NOBODY: Mapping[CameraPerson, int] = MappingProxyType({})
_DECISIONS = re.compile(r'^"?# (\d+) decisions of (.+), camera (.+?)"?$', re.MULTILINE)
_HEAD = 4096
_PITCH = re.compile(r'^"?# pitch of (.+): ([0-9.e+-]+) um across, ([0-9.e+-]+) um down"?$', re.MULTILINE)


@dataclass(frozen=True, slots=True)  # archives have many
class ComparatorPoint:
    """A mark in an image. xy_mm (2,) and sigma_mm (2,), None where it has none; rho: correlation of x and y."""

    image: str
    point: str
    kind: ObservationKind
    xy_mm: Array | None
    sigma_mm: Array | None
    rho: float
    status: Status
    reason: str
    line: int = 0


class MarkRow(NamedTuple):
    """A mark in an image as it was measured. center_px: column and row; covariance_px2: variances of the column and the
    row, and their covariance. None where it has none."""

    image: str
    point: str
    kind: str
    center_px: tuple[float, float] | None
    covariance_px2: tuple[float, float, float] | None
    status: str
    reason: str


def mark_rows(frames: Iterable[FrameMeasurement]) -> Iterator[MarkRow]:
    """Every mark of every frame, by the frames' names."""
    for frame in sorted(frames, key=lambda frame: frame.image):
        for mark in frame.marks:
            center = None if mark.center_px is None else (float(mark.center_px[0]), float(mark.center_px[1]))
            px2 = mark.covariance_px2
            spread = None if px2 is None else (float(px2[0, 0]), float(px2[1, 1]), float(px2[0, 1]))
            yield MarkRow(frame.image, mark.point, mark.kind, center, spread, str(mark.status), str(mark.reason))


def write_comparator(
    path: Path,
    marks: Iterable[MarkRow],
    pitch_um: Mapping[str, tuple[float, float]],
    measurement: str = "",
    decided: Mapping[CameraPerson, int] | None = None,
) -> None:
    """Write every mark, in their order. Raises InputError where the file cannot be written.

    pitch_um: by image, NaN of a scan that could not be measured. measurement: the digest of the judging in
    measurement.db that has the same marks. decided: how many decisions of whom stand behind the marks of a camera.
    """
    rows = (_line(mark, *pitch_um[mark.image]) for mark in marks)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(
            f"{line}\n" for line in chain(_head(pitch_um, measurement, decided or {}), rows)
        )  # an archive's are many
        file.flush()
        os.fsync(file.fileno())


def points_text(points: Sequence[ComparatorPoint], pitch_um: Mapping[str, tuple[float, float]]) -> str:
    """The same file of marks that were read, or came otherwise; pixels stay empty where no pitch is known."""
    lines = _head(pitch_um)
    return "\n".join([*lines, *(_point_line(point, pitch_um.get(point.image)) for point in points)]) + "\n"


def _point_line(point: ComparatorPoint, pitch_um: tuple[float, float] | None) -> str:
    place = [None, None] if point.xy_mm is None else point.xy_mm.tolist()
    sigma = [None, None] if point.sigma_mm is None else point.sigma_mm.tolist()
    pixel = [None, None] if point.xy_mm is None or pitch_um is None else pixel_from_comparator(point.xy_mm, pitch_um)
    numbers = [*place, *sigma, point.rho, *pixel]
    cells = ["" if number is None else f"{number:.7f}" for number in numbers]
    return csv_line([point.image, point.point, point.kind, *cells, str(point.status), point.reason])


def _head(
    pitch_um: Mapping[str, tuple[float, float]], measurement: str = "", decided: Mapping[CameraPerson, int] = _NOBODY
) -> list[str]:
    known_pitches = [(image, pitch) for image, pitch in sorted(pitch_um.items()) if math.isfinite(pitch[0])]
    return [
        f"# comparator coordinates, reseau {version('reseau')}",
        *([f"# measurement {measurement}"] if measurement else []),
        *(
            f"# {count} decisions of {_single_line(who)}, camera {_single_line(by)}"
            for (by, who), count in decided.items()
        ),
        "# x_mm to the right, y_mm UP, origin at the centre of the scan's top-left pixel; sx_mm, sy_mm their sigmas",
        "# col_px to the right, row_px down; the CENTRE of the top-left pixel is (0, 0)",
        *(f"# pitch of {image}: {x:.10g} um across, {y:.10g} um down" for image, (x, y) in known_pitches),
        "# status: only measured and weak are observations",
        ",".join(COLUMNS),
    ]


def _single_line(name: str) -> str:
    return " ".join(name.split())


def comparator_from_pixel(center_px: Array, pitch_um: tuple[float, float]) -> Array:
    """(..., 2) column and row to x (right) and y (up) in mm."""
    return np.multiply(center_px, np.array([pitch_um[0], -pitch_um[1]]) / 1000.0)


def pixel_from_comparator(xy_mm: Array, pitch_um: tuple[float, float]) -> Array:
    """(..., 2) x (right) and y (up) in mm to column and row."""
    return np.divide(xy_mm, np.array([pitch_um[0], -pitch_um[1]]) / 1000.0)


def _line(mark: MarkRow, across_um: float, down_um: float) -> str:
    """As `comparator_from_pixel` has it, one by one: an archive has many."""
    place = pixel = ","
    sigma_rho = ",,"
    x_mm, y_mm = across_um / 1000.0, -down_um / 1000.0
    if mark.center_px is not None:
        col, row = mark.center_px
        place, pixel = f"{col * x_mm:.7f},{row * y_mm:.7f}", f"{col:.4f},{row:.4f}"
    if mark.covariance_px2 is not None:
        of_col, of_row, both = mark.covariance_px2
        sx, sy = math.sqrt(of_col * x_mm * x_mm), math.sqrt(of_row * y_mm * y_mm)
        sigma_rho = f"{sx:.7f},{sy:.7f},{both * x_mm * y_mm / (sx * sy):.4f}"
    name = _start(mark.image, mark.point, mark.kind)
    return f"{name},{place},{sigma_rho},{pixel},{csv_line([mark.status, mark.reason])}"


@lru_cache(maxsize=4096)
def _start(image: str, point: str, kind: str) -> str:
    return csv_line([image, point, kind])


def comparator_points(
    marks: Iterable[MarkRow], pitch_um: Mapping[str, tuple[float, float]]
) -> Iterator[ComparatorPoint]:
    """What `read_comparator` reads of the marks that were written, but for the last digits and the lines."""
    for mark in marks:
        x_mm, y_mm = pitch_um[mark.image][0] / 1000.0, -pitch_um[mark.image][1] / 1000.0
        xy = sigma = None
        rho = 0.0
        if mark.center_px is not None:
            xy = np.array([mark.center_px[0] * x_mm, mark.center_px[1] * y_mm])
        if mark.covariance_px2 is not None:
            of_col, of_row, both = mark.covariance_px2
            sigma = np.array([math.sqrt(of_col) * x_mm, -math.sqrt(of_row) * y_mm])
            rho = both * x_mm * y_mm / float(sigma[0] * sigma[1])
        kind, status = _KINDS[mark.kind], Status(mark.status)
        yield ComparatorPoint(mark.image, mark.point, kind, xy, sigma, rho, status, mark.reason)


def read_measurement_hash(path: Path) -> str:
    """The fingerprint of the measurement that a comparator file was written from; "" of one that does not say so, as
    one that a user made."""
    with path.open("rb") as file:
        found = re.search(rb"^\W*# measurement ([0-9a-f]{64})\b", file.read(_HEAD), re.MULTILINE)
    return found[1].decode() if found else ""


def read_decision_counts(path: Path) -> dict[CameraPerson, int]:
    """How many decisions of whom stand behind the marks of each camera, as the lines above the table tell it."""
    with path.open("rb") as file:
        head = takewhile(lambda line: line.lstrip(b'"\xef\xbb\xbf').startswith(b"#"), file)
        text = b"".join(line for line in head if b" decisions of " in line).decode("utf-8", "replace")
    return {(camera, who): int(count) for count, who, camera in _DECISIONS.findall(text)}


def describe_decisions(decided: Mapping[CameraPerson, int]) -> str:
    """That in a sentence; "" where there are none."""
    cameras = sorted({camera for camera, _ in decided})
    parts = [
        ", ".join(f"{count} of {who}" for (own, who), count in sorted(decided.items()) if own == camera)
        for camera in cameras
    ]
    named = parts if len(parts) == 1 else [f"{camera}: {part}" for camera, part in zip(cameras, parts, strict=True)]
    return f"Decisions stand behind these marks: {'; '.join(named)}." if named else ""


def read_pitches(path: Path) -> dict[str, tuple[float, float]]:
    """The pitch of every scan in um, across and down, as the lines above the table tell it; of those that they tell."""
    text = read_bytes(path).decode("utf-8", "replace")
    return {image: (float(x), float(y)) for image, x, y in _PITCH.findall(text)}


def read_comparator(path: Path, pitch_um: tuple[float, float] | None = None) -> tuple[ComparatorPoint, ...]:
    """Read comparator.csv.

    Parameters
    ----------
    path : the file
    pitch_um : width and height of a pixel, where a list of pixels (col_px, row_px) may give no mm; None refuses it

    Raises
    ------
    InputError
        Names the line: a duplicated mark, an unknown kind, no number, neither mm nor pixels.
    """
    points: dict[tuple[str, str, str], ComparatorPoint] = {}
    for row in csv_rows(path, COLUMNS[:2], COLUMNS[2:] + PIXEL_SIGMAS):
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
    """Whether a comparator file has columns of pixels and none of mm. Raises InputError where it has neither."""
    row = next(csv_rows(path, COLUMNS[:2], COLUMNS[2:] + PIXEL_SIGMAS), None)
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
    if kind not in _KINDS:
        raise row.error("kind", f"is {kind!r}; possible are {', '.join(_KINDS)}.")
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
    x, y, sx, sy = row.number(names[0]), row.number(names[1]), row.sigma(names[2]), row.sigma(names[3])
    xy = None if x is None or y is None else np.array([x, y])
    if xy is None and Status(status).is_observation:
        raise row.error(
            names[0], f"is blank, but the status is {status!r}. Give {names[0]} and {names[1]}, or the status absent."
        )
    if sx == 0.0 or sy == 0.0:
        raise row.error(
            names[2], "an observation's standard deviation cannot be 0; leave it blank for the project's own."
        )
    rho = row.number("rho") or 0.0
    if not math.fabs(rho) < 1.0:
        raise row.error("rho", f"is a correlation and must lie between -1 and 1, not {rho:g}.")
    sigma = None if sx is None or sy is None else np.array([sx, sy])
    if names[0] == "col_px" and pitch_um is not None:
        xy = None if xy is None else comparator_from_pixel(xy, pitch_um)
        sigma = None if sigma is None else sigma * pitch_um / 1000.0
        rho = -rho  # y is turned round
    return ComparatorPoint(
        image=intern(image_name(row.name("image"))),
        point=intern(row.name("point")),
        kind=_KINDS[kind],
        xy_mm=xy,
        sigma_mm=sigma,
        rho=rho,
        status=Status(status),
        reason=row.text("reason"),
        line=row.line,
    )
