"""Camera drawn by a user in one scan: the drawing sent by the page, the placement of its frame, and its file."""

import math
import re
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass as checked_dataclass

from measure.fiducials.clicked_frame import LEAST_CLICKS, are_collinear
from measure.geometry import POSES, UP_FROM_CAMERA, Affine, linear_scale
from measure.marks.shapes import MarkTemplate, Point
from measure.marks.templates import cut, learn_template
from measure.scans.scan import Scan
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, camera_text, parse_camera, read_camera
from pipeline.files.camera_tables import DEFAULT_SIGMA_MM
from pipeline.files.mark_table import picture_writer, template_values
from pipeline.measuring.first_pictures import fit_clicks
from pipeline.review.requests import parse_values
from pipeline.text.files import write_atomically
from pipeline.text.toml_tables import Table
from pipeline.text.wording import listed, table_lines
from pipeline.types import Array

MARK = "drawn"  # NAME of the table [mark.NAME]
_DRAWN_BY = f"# Drawn on the review page by reseau {version('reseau')}"
_FILE_NAME = re.compile(r"\w[\w .-]{0,99}")
_ONE_SIDE = 0.5  # fraction of half the marks' extent; marks farther out belong to one side of the frame
_FLIP = np.diag([1.0, -1.0])  # (right, up) to (column, row)
_NO_PITCH = (
    "what a pixel of the scan measures is not known. Give its size in µm, or the coordinates of two marks, or the "
    "frame's size and two of its opposite corners."
)


@checked_dataclass(frozen=True)
class ClickedMark:
    """Clicked mark.

    Attributes
    ----------
    px : column and row.
    xy_mm : given camera coordinates, None if unknown.
    turn_deg : fitted rotation of the image of the mark against the drawing, clockwise in the scan.
    blur_px : fitted blur.
    unfitted : why the drawing did not fit here; "" if it did.
    """

    id: str
    px: tuple[float, float]
    xy_mm: tuple[float | None, float | None] = (None, None)
    turn_deg: float = 0.0
    blur_px: float = 0.8
    unfitted: str = ""

    @property
    def given_mm(self) -> Point | None:
        x, y = self.xy_mm
        return None if x is None or y is None else (x, y)


@checked_dataclass(frozen=True)
class CameraDrawing:
    """Drawing of a camera, as sent by the page. None: unknown.

    Attributes
    ----------
    mark : content of the table [mark.NAME].
    point : name of the mark shown; "" for none.
    pose : scan orientation.
    frame_mm : width and height of the exposed frame.
    corners_px : two opposite corners of the exposed frame.
    sigma_mm : standard deviation of the given coordinates.
    """

    image: str
    mark: dict[str, Any]
    marks: tuple[ClickedMark, ...] = ()
    point: str = ""
    name: str = ""
    pose: str = "0"
    pitch_um: float | None = None
    principal_distance_mm: float | None = None
    frame_mm: tuple[float | None, float | None] = (None, None)
    corners_px: tuple[tuple[float, float], ...] = ()
    sigma_mm: float | None = None

    @property
    def given_frame_mm(self) -> Point | None:
        width, height = self.frame_mm
        return None if width is None or height is None else (width, height)

    @property
    def is_picture(self) -> bool:
        """Whether the mark is an image patch of the scan instead of a drawing."""
        return self.mark.get("kind") in ("template", "learned")


@dataclass(frozen=True, eq=False)
class FramePlacement:
    """Placement of a frame in a scan. pixel_from_camera: (2, 3) affine matrix; pitch_um: pixel pitch across and down;
    pitch_source: its source, in words."""

    pixel_from_camera: Array
    pitch_um: Point
    pitch_source: str

    def camera_mm(self, px: Point) -> Point:
        """Camera coordinates of a place in the scan, rounded to 1 µm."""
        x, y = Affine(self.pixel_from_camera).inverse.apply(np.array(px)).round(3).tolist()
        return x, y


def parse_drawing(given: Any) -> CameraDrawing:
    """Parse the drawing of a request. Raises InputError for invalid content."""
    drawing = parse_values(CameraDrawing, given, "the drawing")
    ids = [one.id for one in drawing.marks]
    if drawing.pose not in POSES:
        raise InputError(f"{drawing.pose!r} is no pose; {', '.join(POSES)} are.")
    if repeated := next((id for id in ids if ids.count(id) > 1), None):
        raise InputError(f"two marks are called {repeated!r}. Every mark has a name of its own.")
    return drawing


def place_frame(
    drawing: CameraDrawing, size_px: tuple[int, int], known_um: Point | None, source: str
) -> FramePlacement:
    """Place the frame in the scan.

    With two or more given coordinates the frame is fitted to them. Otherwise it lies in the given scan orientation
    (pose), with axes through the means of the marks on opposite sides.

    Parameters
    ----------
    known_um, source : pixel pitch from the project or the file, and which of them.

    Raises
    ------
    InputError
        If the pixel pitch is unknown.
    """
    known = [(one.px, one.given_mm) for one in drawing.marks if one.given_mm is not None]
    pitch_um, source = _pitch(drawing, known_um, source)
    if len(known) >= 2:
        places, given = (np.array(values, dtype=float) for values in zip(*known, strict=True))
        pixel_mm = np.array(pitch_um or (1000.0, 1000.0)) / 1000.0
        up_mm = places * pixel_mm * (1.0, -1.0)
        # Mirrored if that fits better, or, with too few points to decide, if the pose is.
        tells_mirror = len(given) >= LEAST_CLICKS and not are_collinear(given)
        mirrors = ("0", "0m") if tells_mirror else ("0m" if "m" in drawing.pose else "0",)
        up = fit_clicks(given, up_mm, mirrors)
        if pitch_um is None:
            pixel_mm = pixel_mm / linear_scale(up)
            up, source = up / linear_scale(up), "the coordinates of the marks"
        return FramePlacement(_FLIP @ up / pixel_mm[:, None], as_point(1000.0 * pixel_mm), source)
    if pitch_um is None:
        raise InputError(_NO_PITCH)
    linear = _FLIP @ UP_FROM_CAMERA[drawing.pose] / (np.array(pitch_um)[:, None] / 1000.0)
    places = np.array([one.px for one in drawing.marks], dtype=float).reshape(-1, 2)
    linear = linear @ rotation(_skew_rad(places @ np.linalg.inv(linear).T))
    camera = places @ np.linalg.inv(linear).T
    middle = np.array(drawing.corners_px or [(-0.5, -0.5), np.subtract(size_px, 0.5)]).mean(axis=0)
    if len(known) == 1:
        px, xy = known[0]
        origin = np.array(px) - linear @ xy
    else:
        origin = linear @ (camera.min(axis=0) + camera.max(axis=0)) / 2 if len(places) >= LEAST_CLICKS else middle
    return FramePlacement(np.column_stack([linear, origin]), pitch_um, source)


def _pitch(drawing: CameraDrawing, known_um: Point | None, source: str) -> tuple[Point | None, str]:
    frame_mm, corners = drawing.given_frame_mm, np.array(drawing.corners_px, dtype=float)
    if drawing.pitch_um is not None:
        if not 0.0 < drawing.pitch_um < math.inf:
            raise InputError(f"a pixel measures more than 0 µm, not {drawing.pitch_um:g}.")
        return (drawing.pitch_um, drawing.pitch_um), "as given"
    if frame_mm and len(corners) == 2:
        pitch = 1000.0 * math.hypot(*frame_mm) / float(np.hypot(*(corners[1] - corners[0])))
        return (pitch, pitch), "the frame's size and corners"
    return known_um, source


def _skew_rad(places_mm: Array) -> float:
    """Rotation of the marks against the axes, by lines through the means of the marks on opposite sides."""
    if len(places_mm) < 2:
        return 0.0
    middle, half = (places_mm.max(axis=0) + places_mm.min(axis=0)) / 2, np.ptp(places_mm, axis=0) / 2
    skews = []
    for axis in (0, 1):
        if half[axis] < _ONE_SIDE * half.max():
            continue
        off = places_mm[:, axis] - middle[axis]
        ends = [places_mm[side * off > _ONE_SIDE * half[axis]].mean(axis=0) for side in (1, -1)]
        x, y = ends[0] - ends[1]
        skews.append(math.atan2(y, x) if axis == 0 else math.atan2(-x, y))
    return float(np.mean(skews))


def rotation(angle_rad: float) -> Array:
    """(2, 2) counter-clockwise rotation."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def as_point(values: Array) -> Point:
    return float(values[0]), float(values[1])


def frame_size_mm(drawing: CameraDrawing, placement: FramePlacement) -> Point | None:
    """Frame size as given, or from the clicked corners, rounded to 0.1 mm; None if unknown."""
    if drawing.given_frame_mm or len(drawing.corners_px) != 2:
        return drawing.given_frame_mm
    first, second = (np.array(placement.camera_mm(px)) for px in drawing.corners_px)
    return as_point(np.abs(second - first).round(1))


def camera_content(drawing: CameraDrawing, placement: FramePlacement) -> dict[str, Any]:
    """Content of the camera file without the table of its mark."""
    frame_mm, content = frame_size_mm(drawing, placement), dict[str, Any]()
    if drawing.name:
        content["name"] = drawing.name
    if frame_mm:
        content["frame_mm"] = list(frame_mm)
    if drawing.principal_distance_mm is not None:
        content["principal_distance_mm"] = drawing.principal_distance_mm
    content["fiducial"] = []
    for one in drawing.marks:
        given = one.given_mm
        sigma = DEFAULT_SIGMA_MM if given is None or drawing.sigma_mm is None else drawing.sigma_mm
        xy_mm = list(given or placement.camera_mm(one.px))
        content["fiducial"].append({"id": one.id, "xy_mm": xy_mm, "sigma_mm": sigma, "mark": MARK})
    return content


def drawn_camera(drawing: CameraDrawing, placement: FramePlacement, path: Path) -> CameraFile:
    """Camera as read from its file; a mark that is an image patch is to be learned. Raises InputError if invalid."""
    content = camera_content(drawing, placement)
    content["mark"] = {MARK: {**drawing.mark, "kind": "learned"} if drawing.is_picture else drawing.mark}
    if drawing.is_picture and drawing.marks:
        content["clicks"] = {"scan": drawing.image, "px": {one.id: list(one.px) for one in drawing.marks}}
    return parse_camera(Table(content, path, ""))


def camera_path(folder: Path, name: str) -> Path:
    """Path of a camera file of that name. Raises InputError for an invalid name, and for an existing file that was not
    drawn on the page."""
    name = name.strip().removesuffix(".toml")
    if not _FILE_NAME.fullmatch(name):
        raise InputError(f"{name!r} can be no file's name here. Give one such as camera.toml, without a folder.")
    path = folder / f"{name}.toml"
    if path.exists() and not path.read_bytes().startswith(_DRAWN_BY.rpartition(" ")[0].encode()):
        raise InputError(f"{path.name} is there already, and was not drawn here. Give another name.")
    return path


def save_drawing(drawing: CameraDrawing, placement: FramePlacement, scan: Scan, path: Path) -> CameraFile:
    """Write a camera whose mark is drawn or one image patch of the scan, and read it again. Raises InputError if the
    drawing is incomplete or invalid."""
    if not drawing.marks:
        raise InputError("click the marks first.")
    if not frame_size_mm(drawing, placement):
        raise InputError("the frame's size is not known. Give it in mm, or click two of its opposite corners.")
    drawn_camera(drawing, placement, path).layout()
    mark = dict(drawing.mark)
    if drawing.is_picture:  # cut around the mark shown or the first one
        size_mm = float(drawing.mark["size_mm"])
        one = next((mark for mark in drawing.marks if mark.id == drawing.point), drawing.marks[0])
        place = np.column_stack([placement.pixel_from_camera[:, :2], one.px])
        learned = learn_template([cut(scan, place, size_mm)], size_mm)
        chip = MarkTemplate(learned.image, learned.pitch_um, learned.origin_px, 0.0, "light", learned.detail_mm)
        mark = template_values(chip, MARK, picture_writer(path.parent, f"{path.stem}-"))
    body = table_lines({**camera_content(drawing, placement), "mark": {MARK: mark}})
    write_atomically(path, "\n".join([*_remarks(drawing, placement), "", *body]) + "\n")
    return read_camera(path)


def save_learned(camera: CameraFile, image: str, path: Path) -> CameraFile:
    """Write a camera with marks learned from one scan, and read it again."""
    remark = f"{_DRAWN_BY}: its marks were learned from their places in {_join_lines(image)}."
    text = camera_text(replace(camera, path=path, clicks=None), picture_writer(path.parent, f"{path.stem}-"))
    write_atomically(path, "\n".join([remark, "", text]))
    return read_camera(path)


def _remarks(drawing: CameraDrawing, placement: FramePlacement) -> list[str]:
    """Comment lines on the sources of the values in the file."""
    pixel = " x ".join(f"{um:.4g}" for um in dict.fromkeys(np.round(placement.pitch_um, 6).tolist()))
    found = [one.id for one in drawing.marks if one.given_mm is None]
    lines = [f"{_DRAWN_BY} in {drawing.image}, a pixel of {pixel} µm ({placement.pitch_source})."]
    if found:
        lines.append(f"xy_mm of {listed(found)}: from their places in the scan and its pixel, not from a certificate.")
    if len(found) < len(drawing.marks):
        lines.append(f"xy_mm of {listed([one.id for one in drawing.marks if one.given_mm])}: as given.")
    if unfitted := [one.id for one in drawing.marks if one.unfitted]:
        lines.append(f"The drawing did not fit at {listed(unfitted)}: as they were clicked.")
    if not drawing.given_frame_mm:
        lines.append("frame_mm: between two corners clicked in the scan.")
    if drawing.principal_distance_mm is None:
        lines.append("principal_distance_mm is not known: the adjustment finds it from the points.")
    return [_join_lines(f"# {line.removeprefix('# ')}") for line in lines]


def _join_lines(text: str) -> str:
    return "".join(one if one.isprintable() else "?" for one in text)
