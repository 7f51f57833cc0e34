"""Files of `reseau calibrate`: a project that `reseau run` can continue, OpenCV's camera.yaml and ROS's camera info."""

import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from adjust.functional_model.opencv_family import FISHEYE_NAMES, OPENCV_NAMES
from measure.boards.specs import AprilGridSpec, ArucoSpec, BoardSpec, CharucoSpec
from pipeline.calibration.intrinsics import CameraIntrinsics, LensModel, LensSetting, free_lens
from pipeline.calibration.pictures import BoardPictureFiles, CameraPictures
from pipeline.errors import InputError
from pipeline.files.opencv_file import COVARIANCE
from pipeline.files.project_file import ASSUMED_PITCH_UM, Project, read_project
from pipeline.files.target_table import TARGET_TABLES, BoardTable
from pipeline.results.image_unit import CENTRE
from pipeline.text.csv_table import csv_line
from pipeline.text.files import check_replaceable, make_folder, write_atomically
from pipeline.text.wording import did_you_mean, quoted, table_lines

BoardKind = Literal["chessboard", "charuco", "aprilgrid", "aruco", "circle-grid", "asymmetric-circle-grid"]
MOST = 500  # largest number of columns or rows in `[targets]`
KALIBR_SPACING = 0.3  # default gap between the tags of an AprilGrid, in sides of a tag
MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
_HEAD = "# Written by `reseau calibrate`"
OPENCV_COUNTS = (4, 5, 8, 12, 14)  # numbers of coefficients that OpenCV accepts


@dataclass(frozen=True)
class BoardOptions:
    """Description of a board.

    Attributes
    ----------
    columns, rows : inner corners (chessboard), squares (charuco), markers (aprilgrid, aruco) or circles; 16.5 columns
        of an asymmetric grid are rows of 17 and 16 circles in turn.
    spacing_mm : side of a square, or distance from one marker or circle to the next; of an asymmetric grid the distance
        of its rows, which is half the distance between two circles of a row.
    size_mm : of a marker or a circle.
    row_spacing_mm : distance of the rows of circles, where it is another than spacing_mm, which is then that of the
        columns: half the distance in a row of an asymmetric grid.
    """

    kind: BoardKind
    columns: float
    rows: int
    spacing_mm: float
    size_mm: float | None = None
    dictionary: str | None = None
    legacy: bool = False
    first_id: int = 0
    row_spacing_mm: float | None = None

    def __post_init__(self) -> None:
        """Raise InputError where an option of its kind is missing, before anything is read."""
        _ = self.table

    @property
    def chessboards(self) -> tuple[str, ...]:
        """Options that name this board, if it is a chessboard."""
        sizes = (f"{self.columns:g}x{self.rows}", f"{self.rows}x{self.columns:g}")
        return tuple(f"--board {size}" for size in sizes) if self.kind == "chessboard" else ()

    @property
    def table(self) -> str:
        """Text of the table [targets] in project.toml."""
        keys: dict[str, object] = {"kind": self.kind, "columns": self.columns, "rows": self.rows}
        match self.kind:
            case "chessboard":
                keys |= {"square_mm": self.spacing_mm}
            case "charuco":
                keys |= {"square_mm": self.spacing_mm, "marker_mm": self._size, "dictionary": self._dictionary}
                keys |= {"legacy": True} if self.legacy else {}
                keys |= {"first_id": self.first_id}
            case "aruco":
                gap_mm = self.spacing_mm - self._size
                keys |= {"marker_mm": self._size, "gap_mm": gap_mm, "dictionary": self._dictionary}
                keys |= {"first_marker": self.first_id}
            case "aprilgrid":
                marker_mm = self.spacing_mm / (1.0 + KALIBR_SPACING) if self.size_mm is None else self._size
                keys |= {"marker_mm": marker_mm, "spacing": self.spacing_mm / marker_mm - 1.0}
                keys |= {"dictionary": self.dictionary} if self.dictionary else {}
                keys |= {"first_id": self.first_id}
            case "circle-grid" | "asymmetric-circle-grid":
                keys |= {"spacing_mm": self.spacing_mm, "diameter_mm": self._size}
                keys |= {"row_spacing_mm": self.row_spacing_mm} if self.row_spacing_mm else {}
                if self.columns % 1:
                    keys |= {"kind": "circle-grid", "columns": round(2 * self.columns), "asymmetric": True}
        return "\n".join(["[targets]", *table_lines(keys), ""])

    @property
    def spec(self) -> BoardSpec:
        """The board. Raises ValueError where there is none."""
        return cast(BoardTable, TARGET_TABLES[self.kind](**tomllib.loads(self.table)["targets"])).board

    def differing_options(self, other: ArucoSpec | CharucoSpec | None) -> str:
        """Options of another board of markers, as far as they differ from these; "" for the same board, or none."""
        if other is None:
            return ""
        first_id = other.first_id if isinstance(other, CharucoSpec) else other.first_marker
        kinds = {CharucoSpec: "charuco", AprilGridSpec: "aprilgrid", ArucoSpec: "aruco"}
        options = {
            f"--kind {kinds[type(other)]}": kinds[type(other)] != self.kind,
            f"--board {other.columns}x{other.rows}": (other.columns, other.rows) != (self.columns, self.rows),
            f"--first-id {first_id}": first_id != self.first_id,
            "without --legacy": self.legacy and not getattr(other, "legacy", True),
        }
        return " ".join(option for option, differs in options.items() if differs)

    @property
    def _size(self) -> float:
        if self.size_mm is None:
            what = "the diameter of a circle" if "circle" in self.kind else "the side of a marker"
            raise InputError(f"--marker is missing: {what}, such as --marker 18mm, is needed for {self.kind}.")
        across_mm, down_mm = self.spacing_mm, self.row_spacing_mm or self.spacing_mm
        nearest_mm = min(across_mm, down_mm)
        if self.kind == "asymmetric-circle-grid":
            nearest_mm = min(2.0 * nearest_mm, math.hypot(across_mm, down_mm))
        if not self.size_mm < nearest_mm:
            raise InputError(
                f"--marker {self.size_mm:g} mm is not smaller than the distance from one to the next, {nearest_mm:.4g} "
                f"mm by --square {self.spacing_mm:g} mm. Exchange the two, or measure them again."
            )
        return self.size_mm

    @property
    def _dictionary(self) -> str:
        if self.dictionary is None:
            raise InputError(f"--dictionary is missing: the markers of {self.kind}, such as --dictionary 4X4_50.")
        return self.dictionary


def board_options(
    kind: str,
    board: str,
    square: str,
    marker: str | None = None,
    dictionary: str | None = None,
    legacy: bool = False,
    first_id: int = 0,
) -> BoardOptions:
    """Build the board from command-line options. Raises InputError with the name of the wrong option."""
    kinds: dict[str, BoardKind] = {each: each for each in get_args(BoardKind)}
    if kind not in kinds:
        raise InputError(
            f"--kind {kind}: there is no such board; possible are {', '.join(kinds)}.{did_you_mean(kind, kinds)}"
        )
    own = {"chessboard": (), "circle-grid": ("--marker",), "asymmetric-circle-grid": ("--marker",)}
    options = {"--marker": marker, "--dictionary": dictionary, "--legacy": legacy, "--first-id": first_id}
    for option, value in options.items():
        if value and option not in own.get(kind, options):
            raise InputError(
                f"{option}: a {kind} has none. Leave it out, or name the board's kind: --kind charuco, say."
            )
    half = r"(?:\.5)?" if kind == "asymmetric-circle-grid" else ""
    counts = re.fullmatch(rf"(\d{{1,3}}{half}) ?[x×*] ?(\d{{1,3}})", board.strip(), flags=re.IGNORECASE)
    if counts is None or not all(1 <= float(each) <= MOST for each in counts.groups()):
        raise InputError(f"--board {board}: must be two counts of 1 to {MOST}, COLUMNSxROWS, such as 9x6.")
    size_mm = None if marker is None else _length_mm("--marker", marker)
    columns, rows = (float(each) if "." in each else int(each) for each in counts.groups())
    both = re.fullmatch(r"([\d.]+) ?[x×*] ?([\d.]+ ?(mm|cm|m|in))", square.strip()) if "circle" in kind else None
    spacing_mm = _length_mm("--square", f"{both[1]}{both[3]}" if both else square)
    row_spacing_mm = _length_mm("--square", both[2]) if both else None
    found = BoardOptions(
        kinds[kind], columns, int(rows), spacing_mm, size_mm, dictionary, legacy, first_id, row_spacing_mm
    )
    try:
        _ = found.spec
    except ValueError as error:
        raise InputError(f"--kind {kind} --board {board}: {error}.") from None
    return found


def _length_mm(option: str, text: str) -> float:
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m|in)", text.strip())
    if found is None or float(found[1]) == 0.0:
        raise InputError(f"{option} {text}: must be a length with its unit (mm, cm, m, in), such as 25mm.")
    return float(found[1]) * MM[found[2]]


OPENCV_ORDER, FISHEYE_ORDER = OPENCV_NAMES[:-2], FISHEYE_NAMES[:-2]  # without b1 and b2


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a calibration. pitch_um: pixel pitch, None if unknown; ros: whether ROS's camera info is written,
    too."""

    board: BoardOptions
    lens: LensSetting = "auto"
    square_pixels: bool = False
    pitch_um: float | None = None
    ros: bool = False

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel in the project; assumed if unknown."""
        return (self.pitch_um or ASSUMED_PITCH_UM) / 1000.0


def check_folder(out: Path, pictures: BoardPictureFiles) -> None:
    """Raise InputError where a file to be written exists and was not written by `reseau calibrate`."""
    stems = ["camera", *(camera.name for camera in pictures.cameras)]
    files = [f"{stem}{ending}" for stem in stems for ending in (".toml", ".yaml", "-ros.yaml")]
    for name in ("project.toml", "images.csv", *files):
        check_replaceable(out / name, rf"(%YAML:1\.0\n---\n)?{_HEAD}".encode(), "name another folder with --out")


def write_project(
    out: Path, pictures: BoardPictureFiles, options: CalibrationOptions, lenses: Mapping[str, LensModel]
) -> Project:
    """Write project.toml, a camera file for each camera, and images.csv where images differ; then read the project."""
    make_folder(out)
    for camera in pictures.cameras:
        write_atomically(out / f"{camera.name}.toml", _camera_text(camera, options, lenses[camera.name]))
    has_lines = len(pictures.cameras) > 1 or any(camera.turned_deg for camera in pictures.cameras)
    if has_lines:
        lines = [_HEAD, "image,camera,turned_deg"]
        for each in pictures.cameras:
            cells = ((name, f"{each.name}.toml", each.turned_deg.get(name) or "") for name in each.images)
            lines += [csv_line([name, file, str(turned)]) for name, file, turned in cells]
        write_atomically(out / "images.csv", "\n".join([*lines, ""]))
    write_atomically(out / "project.toml", _project_text(out, pictures, options, has_lines))
    return read_project(out / "project.toml")


def _project_text(out: Path, pictures: BoardPictureFiles, options: CalibrationOptions, has_lines: bool) -> str:
    files = (pictures.files[name] for camera in pictures.cameras for name in camera.images)
    scans = ", ".join(quoted(os.path.relpath(path, out)) for path in files)
    unknown = "" if options.pitch_um else "# The pixel size is not given: of all in mm only ratios count.\n"
    images = 'images = "images.csv"\n' if has_lines else ""
    return f"""{_HEAD}; `reseau run` goes on with it.
camera = "{pictures.cameras[0].name}.toml"
scans = [{scans}]
{unknown}pitch_um = {1000.0 * options.pixel_mm!r}

{options.board.table}
[object]
unit = "mm"
{images}
[adjust]
transformation = "none"
unmodelled = "estimate"
"""


def _camera_text(camera: CameraPictures, options: CalibrationOptions, lens: LensModel) -> str:
    distortion = free_lens(lens, options.square_pixels)
    free = "".join(f'{name} = "free"\n' for name in distortion.parameters)
    width_mm, height_mm = (size * options.pixel_mm for size in (camera.width_px, camera.height_px))
    return f"""{_HEAD}
name = {quoted(camera.name)}
frame_mm = [{width_mm!r}, {height_mm!r}]
principal_distance_mm = {width_mm!r}

[sigma]
principal_distance_mm = "free"
principal_point_mm = "free"

[distortion]
family = "{distortion.family}"
[distortion.sigma]
{free}"""


def camera_files(cameras: Sequence[CameraIntrinsics], out: Path, ros: bool) -> Iterator[tuple[Path, str]]:
    """Paths and texts of the files of all cameras: camera.yaml for a single one, else one file per camera, by its
    name."""
    for camera in cameras:
        stem = "camera" if len(cameras) == 1 else camera.pictures.name
        yield out / f"{stem}.yaml", opencv_yaml(camera)
        if ros:
            yield out / f"{stem}-ros.yaml", ros_yaml(camera)


def opencv_yaml(camera: CameraIntrinsics) -> str:
    """Text for cv2.FileStorage."""
    distortion = _distortion(camera)
    lines = ["%YAML:1.0", "---", _HEAD]
    lines += [f"image_width: {camera.pictures.width_px}", f"image_height: {camera.pictures.height_px}"]
    lines += _opencv_matrix("camera_matrix", 3, _camera_matrix(camera))
    lines += _opencv_matrix("distortion_coefficients", 1, distortion)
    if camera.is_fisheye:
        lines.append('distortion_model: "fisheye"')
    lines += _opencv_matrix("std_deviations_fx_fy_cx_cy", 1, [camera.values[name].sigma for name in CENTRE])
    order = [*CENTRE, *(FISHEYE_ORDER if camera.is_fisheye else OPENCV_ORDER)[: len(distortion)]]
    # Covariances of what was not estimated are 0.
    rows = [list(camera.values).index(name) if name in camera.values else -1 for name in order]
    covariance = np.pad(camera.covariance, (0, 1))[np.ix_(rows, rows)]
    lines += _opencv_matrix(COVARIANCE, len(order), covariance.ravel().tolist())
    return "\n".join([*lines, f"avg_reprojection_error: {camera.rms_px:.10g}", ""])


def ros_yaml(camera: CameraIntrinsics) -> str:
    """Text of ROS's camera info: plumb_bob, rational_polynomial or equidistant."""
    distortion, matrix = _distortion(camera), _camera_matrix(camera)
    model = "equidistant" if camera.is_fisheye else "rational_polynomial" if len(distortion) == 8 else "plumb_bob"
    if model == "plumb_bob":
        distortion = [*distortion, 0.0][:5]
    projection = [value for row in range(3) for value in (*matrix[3 * row : 3 * row + 3], 0.0)]
    lines = [_HEAD, f"image_width: {camera.pictures.width_px}", f"image_height: {camera.pictures.height_px}"]
    lines += [f"camera_name: {camera.pictures.name}", *_ros_matrix("camera_matrix", 3, matrix)]
    lines += [f"distortion_model: {model}", *_ros_matrix("distortion_coefficients", 1, distortion)]
    lines += _ros_matrix("rectification_matrix", 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    return "\n".join([*lines, *_ros_matrix("projection_matrix", 3, projection), ""])


def _camera_matrix(camera: CameraIntrinsics) -> list[float]:
    fx, fy, cx, cy = (camera.values[name].value for name in CENTRE)
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _distortion(camera: CameraIntrinsics) -> list[float]:
    """Coefficients in OpenCV's order, in a number that OpenCV accepts."""
    order = FISHEYE_ORDER if camera.is_fisheye else OPENCV_ORDER
    last = max((order.index(name) + 1 for name in camera.values if name in order), default=0)
    count = next(count for count in OPENCV_COUNTS if count >= last)
    return [camera.values[name].value if name in camera.values else 0.0 for name in order[:count]]


def _opencv_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    data = ", ".join(f"{value:.17g}" if value else "0." for value in values)
    size = [f"   rows: {rows}", f"   cols: {len(values) // rows}"]
    return [f"{name}: !!opencv-matrix", *size, "   dt: d", f"   data: [ {data} ]"]


def _ros_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    data = ", ".join(map(repr, values))
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(values) // rows}", f"  data: [{data}]"]
