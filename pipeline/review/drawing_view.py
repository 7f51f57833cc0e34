"""Camera drawing as shown on the page, its changes by dragging, clicking and fitting, and answers to requests.

Handles are points that the user drags on the page, each of which changes one value of a table [mark.NAME]. The page
does not depend on the kind of mark: it shows handles and sends the place to which one was dragged.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from measure.detection.localisation import MarkPrediction
from measure.errors import MeasurementError
from measure.fiducials.mark_fit import Detection, detect_mark
from measure.fiducials.measure_frame import LEAST_LIKENESS
from measure.geometry import Affine, linear_scale
from measure.marks.rendering import reach_px
from measure.marks.shapes import FrameCorner, Mark, MarkShape, Point, limit_to_frame
from measure.matching.models import MatchOptions
from measure.scans.scan import Scan
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.mark_table import MARK_TABLES, Clicks, MarkJson, scaled_mark
from pipeline.review import camera_drawing
from pipeline.review.frame_view import camera_as_shown, check_clicks, outlines_px
from pipeline.review.pictures import Pictures, window_start
from pipeline.review.requests import DrawnCamera, Query, ShownMarks, parse_json, parse_values, whole
from pipeline.review.session import Session
from pipeline.text.table_models import key_rows
from pipeline.types import Array

_LEAST_MM = 1e-3
_RING_DEG, _LINE_DEG = 22.5, -22.5  # degrees, handles on a ring, clear of upright and diagonal arms
_LINE_AT = 0.7  # fraction of an arm's length at which the handle of its width lies
_QUARTER_DEG = 90.0  # degrees, rotational symmetry of a cross
Json = dict[str, Any]

_WIDEST_PX = 2000  # px, largest half width of the window around a mark
_START_PX = 20.0  # px, half size of a new drawing
_LEAST_PX, _SIZES = 30, 1.8  # half width of the window around a mark: minimum, px, and in sizes of the mark
_SEARCH_PX, _SEARCH_MM = 6.0, 0.3  # px and mm, search radius around a click; the larger one applies
_NO_FILE = Path("camera.toml")  # placeholder for a drawing that is not saved yet
_CHOICES = {"polarity": ("auto", "light", "dark"), "rotate": ("none", "radial")}


@dataclass(frozen=True)
class Handle:
    """Handle. key: value that it changes; place_mm: in the mark's axes; dragged: returns the mark with the handle at
    another place."""

    key: str
    place_mm: Point
    dragged: Callable[[Array], MarkJson]


@dataclass(frozen=True, eq=False)
class ShownMark:
    """Mark shown on the page.

    Attributes
    ----------
    clicked, xy_mm : clicked mark and its camera coordinates.
    mark : None if the drawing is incomplete.
    pixel_from_mark : (2, 3) affine matrix from its position, the rotation and scale of the frame, and its fitted
        rotation.
    problem : why the drawing is incomplete.
    """

    clicked: camera_drawing.ClickedMark
    xy_mm: Point
    mark: Mark | None
    pixel_from_mark: Array
    problem: str = ""

    @property
    def toward(self) -> Point:
        """Signs (x, y) of the quadrant around the mark in which the frame lies."""
        return -1.0 if self.xy_mm[0] > 0 else 1.0, -1.0 if self.xy_mm[1] > 0 else 1.0


def drawn_mark(drawing: camera_drawing.CameraDrawing, placement: camera_drawing.FramePlacement) -> ShownMark | None:
    """Mark shown, None if none is selected."""
    clicked = next((one for one in drawing.marks if one.id == drawing.point), None)
    if clicked is None:
        return None
    xy = clicked.given_mm or placement.camera_mm(clicked.px)
    matrix = _pixel_from_mark(placement, clicked)
    try:
        camera = camera_drawing.drawn_camera(drawing, placement, _NO_FILE)
    except InputError as error:
        sentence = str(error).removeprefix(f"{_NO_FILE}: ").replace(f"[mark.{camera_drawing.MARK}] ", "")
        return ShownMark(clicked, xy, None, matrix, sentence)
    mark = next(one.mark for one in camera.fiducials if one.id == clicked.id)
    return ShownMark(clicked, xy, mark if isinstance(mark, Mark) else None, matrix)


def _pixel_from_mark(placement: camera_drawing.FramePlacement, clicked: camera_drawing.ClickedMark) -> Array:
    turn = camera_drawing.rotation(math.radians(clicked.turn_deg))
    return np.column_stack([turn @ placement.pixel_from_camera[:, :2], clicked.px])


def drawing_json(drawing: camera_drawing.CameraDrawing, placement: camera_drawing.FramePlacement) -> Json:
    """JSON of a drawing as shown on the page, without images."""
    shown = drawn_mark(drawing, placement)
    frame_mm = camera_drawing.frame_size_mm(drawing, placement)
    kind, form = drawing.mark["kind"], []  # of the scalar keys, as in the mark's table in a camera file
    for row in key_rows(MARK_TABLES["learned" if kind == "template" else kind]):
        choices = _CHOICES.get(row.name, ())
        if choices or row.type.startswith("number"):
            value = drawing.mark.get(row.name, choices[0] if choices else 0.0)
            form.append({"key": row.name, "unit": row.unit, "meaning": row.meaning, "choices": choices, "value": value})
    return {
        "mark": drawing.mark,
        "marks": [{**asdict(one), "found_mm": placement.camera_mm(one.px)} for one in drawing.marks],
        "pitch_um": list(placement.pitch_um),
        "pitch_source": placement.pitch_source,
        "frame_mm": None if frame_mm is None else list(frame_mm),
        "form": form,
        "problem": shown.problem if shown else "",
        "shown": None if shown is None else _shown_json(drawing, shown),
    }


def _shown_json(drawing: camera_drawing.CameraDrawing, shown: ShownMark) -> Json:
    own = list(handles(drawing.mark, shown.toward))
    place = _handle_affine(drawing, shown)
    lines = [] if shown.mark is None else outlines_px(shown.mark, shown.pixel_from_mark)
    if drawing.is_picture:
        half = drawing.mark["size_mm"] / 2
        square = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
        lines = [place.apply(square).round(3).tolist()]
    handles_px = [place.apply(np.array(one.place_mm)) for one in own]
    points = [*(point for line in lines for point in line), *handles_px]
    off = float(np.abs(np.array(points or [shown.clicked.px]) - shown.clicked.px).max())
    if isinstance(shown.mark, MarkShape):
        off = max(off, reach_px(shown.mark, shown.pixel_from_mark[:, :2]))
    half_px = max(_LEAST_PX, math.ceil(_SIZES * off))
    return {
        "center": list(shown.clicked.px),
        "half": half_px,
        "start": list(window_start(shown.pixel_from_mark, half_px)),
        "outlines": lines,
        "handles": [{"key": one.key, "px": px.round(3).tolist()} for one, px in zip(own, handles_px, strict=True)],
        "has_picture": isinstance(shown.mark, MarkShape),
    }


def _handle_affine(drawing: camera_drawing.CameraDrawing, shown: ShownMark) -> Affine:
    """Affine from the axes in which a mark is drawn to the scan; those of a radial mark turn with its position."""
    linear = shown.pixel_from_mark[:, :2]
    if drawing.mark.get("rotate") == "radial":
        x, y = np.array(shown.xy_mm) / (math.hypot(*shown.xy_mm) or 1.0)
        linear = linear @ np.array([[x, -y], [y, x]])
    return Affine.from_linear(linear, shown.clicked.px)


def take_step(
    drawing: camera_drawing.CameraDrawing, placement: camera_drawing.FramePlacement, step: Mapping[str, Any], scan: Scan
) -> camera_drawing.CameraDrawing:
    """Apply a step of the user to the drawing.

    Parameters
    ----------
    step : {"kind": kind of mark}, {"part": shape}, {"click": px} in the image of the mark, {"drag": key of a handle,
        "px": new place}, {"remove": key of a handle} or {"fit": True}.

    Raises
    ------
    InputError
        If the step is invalid.
    """
    mark, shown = drawing.mark, drawn_mark(drawing, placement)
    size_mm = _START_PX / linear_scale(placement.pixel_from_camera)
    match step:
        case {"kind": str(kind)}:
            return replace(drawing, mark=dict(first_drawing(kind, size_mm)))
        case {"part": str(shape)}:
            return replace(drawing, mark={**mark, "part": [*mark.get("part", ()), first_part(shape, size_mm / 2)]})
        case {"fit": True}:
            return fit_drawing(drawing, placement, scan)
    if shown is None:
        raise InputError("choose a mark first.")
    match step:
        case {"click": [float() | int() as col, float() | int() as row]}:
            if mark["kind"] != "polygon":
                return _move_drawing(drawing, (float(col), float(row)))
            place = _handle_affine(drawing, shown).inverse.apply(np.array([col, row], float))
            return replace(drawing, mark=dict(add_vertex(mark, place)))
        case {"drag": str(key), "px": [float() | int() as col, float() | int() as row]}:
            if key == "place":
                return _move_drawing(drawing, (float(col), float(row)))
            handle = next((one for one in handles(mark, shown.toward) if one.key == key), None)
            if handle is None:
                raise InputError(f"the drawing has no {key!r} to drag.")
            place = _handle_affine(drawing, shown).inverse.apply(np.array([col, row], float))
            return replace(drawing, mark=dict(handle.dragged(place)))
        case {"remove": str(key)}:
            return replace(drawing, mark=dict(remove_part(mark, key)))
    raise InputError("that is no step of a drawing.")


def _move_drawing(drawing: camera_drawing.CameraDrawing, px: Point) -> camera_drawing.CameraDrawing:
    marks = tuple(replace(one, px=px, unfitted="") if one.id == drawing.point else one for one in drawing.marks)
    return replace(drawing, marks=marks)


def fit_drawing(
    drawing: camera_drawing.CameraDrawing, placement: camera_drawing.FramePlacement, scan: Scan
) -> camera_drawing.CameraDrawing:
    """Fit the drawing to all marks by the method of `measure`.

    Each mark gets its own position and blur. All get the median rotation, and the drawing is scaled by the median
    scale. Marks at the frame's edge are limited to the frame. Raises InputError if the drawing fits no mark.
    """
    if drawing.is_picture:
        raise InputError("a square of the scan is its own picture: there is nothing to fit.")
    camera = camera_drawing.drawn_camera(drawing, placement, _NO_FILE)
    marks, scales, turns_deg, reasons = list[camera_drawing.ClickedMark](), list[float](), list[float](), list[str]()
    known = camera.layout_marks if camera.frame_mm is None else limit_to_frame(camera.layout()).marks
    for one, fiducial in zip(drawing.marks, known, strict=True):
        start = _pixel_from_mark(placement, replace(one, turn_deg=0.0))
        found = _match(scan, fiducial.mark, start)
        if found.fit is None or found.fit.likeness < LEAST_LIKENESS:
            reason = str(found.reason) or "no mark like its drawing there"
            reasons.append(f"{one.id}: {reason}")
            marks.append(replace(one, unfitted=reason))
            continue
        change = found.fit.pixel_from_mark[:, :2] @ np.linalg.inv(start[:, :2])
        col, row = found.fit.center_px.round(3).tolist()
        turns_deg.append(math.degrees(math.atan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1])))
        marks.append(replace(one, px=(col, row), blur_px=max(float(found.fit.blur_px), 0.1), unfitted=""))
        if not isinstance(fiducial.mark, FrameCorner):
            scales.append(linear_scale(change))
    if len(reasons) == len(marks):
        of_edge = "" if camera.frame_mm else " Of a mark at the frame's edge give the frame's size first."
        raise InputError(f"nothing was fitted. {'; '.join(reasons) or 'Click a mark first'}.{of_edge}")
    mark = scaled_mark(drawing.mark, median(scales)) if scales else drawing.mark
    turned = tuple(replace(one, turn_deg=median(turns_deg)) for one in marks)
    return replace(drawing, marks=turned, mark=dict(mark))


def _match(scan: Scan, mark: Any, start: Array) -> Detection:
    """Detect a mark at a place; the better of both polarities if the drawing does not specify one."""
    search_px = max(_SEARCH_PX, _SEARCH_MM * linear_scale(start))
    polarities = {"light": (1,), "dark": (-1,)}.get(mark.polarity, (1, -1))
    found = [detect_mark(scan, MarkPrediction(mark, start, search_px, one), MatchOptions()) for one in polarities]
    return max(found, key=lambda one: -1.0 if one.fit is None else one.fit.likeness)


class DrawingAnswers:
    """Answers to requests about drawings. Stateless: each request contains the whole drawing."""

    def __init__(self, session: Session, pictures: Pictures) -> None:
        self._session, self._pictures = session, pictures

    def draw(self, query: Query, body: Any) -> Any:
        """Apply a step to the drawing; returns the drawing as shown."""
        given = parse_values(DrawnCamera, body)
        drawing = camera_drawing.parse_drawing(given.drawing)
        placement = self._placement(drawing)
        if step := given.step:
            scan = self._session.scan_location(drawing.image)
            drawing = self._pictures.compute(scan, lambda file: take_step(drawing, placement, step, file))
        return drawing_json(drawing, self._placement(drawing))

    def picture(self, query: Query) -> bytes:
        """Rendered drawing or residual image around the mark shown."""
        drawing = camera_drawing.parse_drawing(parse_json(query.get("drawing", "")))
        half, shown = whole(query, "half", 8, _WIDEST_PX), drawn_mark(drawing, self._placement(drawing))
        if shown is None or not isinstance(shown.mark, MarkShape):
            raise MeasurementError("nothing is drawn there")
        matrix, blur_px = shown.pixel_from_mark, shown.clicked.blur_px
        if query.get("of", "") == "drawing":
            return self._pictures.drawing(shown.mark, matrix, blur_px, half)
        return self._pictures.residual(self._session.scan_location(drawing.image), shown.mark, matrix, blur_px, half)

    def save(self, query: Query, body: Any) -> Any:
        """Write the camera file; returns a message with the next step."""
        given = parse_values(DrawnCamera, body)
        drawing = camera_drawing.parse_drawing(given.drawing)
        placement = self._placement(drawing)
        project, path = self._session.project, camera_drawing.camera_path(self._session.folder, given.file)
        if drawing.mark.get("kind") == "learned" and drawing.marks:
            camera = camera_drawing.drawn_camera(drawing, placement, path)
            camera.layout()
            known = replace(project, pitch_um=placement.pitch_um, pose="auto")
            clicks = Clicks(drawing.image, {one.id: one.px for one in drawing.marks}, who=self._session.who)
            learned = camera_as_shown(known, camera, clicks)
            return self._save_message(camera_drawing.save_learned(learned, drawing.image, path))
        scan = self._session.scan_location(drawing.image)
        return self._save_message(
            self._pictures.compute(scan, lambda file: camera_drawing.save_drawing(drawing, placement, file, path))
        )

    def save_learned(self, query: Query, body: Any) -> Any:
        """Write a camera of the project with marks learned at clicked places of one scan."""
        given = parse_values(ShownMarks, body)
        path, project = camera_drawing.camera_path(self._session.folder, given.file), self._session.project
        self._session.scan_location(given.image)  # raises KeyError for an unknown image
        camera = project.image_camera(given.image)
        check_clicks(camera, given.image, given.px)
        learned = camera_as_shown(project, camera, Clicks(given.image, given.px, who=self._session.who))
        return self._save_message(camera_drawing.save_learned(learned, given.image, path))

    def _save_message(self, camera: CameraFile) -> Any:
        file, project = camera.path.name, self._session.project
        names = {project.missing_camera, *(one.path.name for one in project.cameras.values())}
        first = "" if file in names else f'name it in the project, camera = "{file}", then '
        return {"text": f"Saved {camera.path} with {len(camera.fiducials)} marks. Next: {first}reseau measure."}

    def _placement(self, drawing: camera_drawing.CameraDrawing) -> camera_drawing.FramePlacement:
        project = self._session.project
        size_px, file_um = self._pictures.size(self._session.scan_location(drawing.image))
        known_um: Point | None = project.pitch_um or file_um
        return camera_drawing.place_frame(
            drawing, size_px, known_um, "as the project says" if project.pitch_um else "as the file says"
        )


def handles(mark: MarkJson, toward: Point = (1.0, 1.0)) -> Iterator[Handle]:
    """Yield the handles of a mark or of a part of one, by the values that it has.

    toward: signs (x, y) of the quadrant in which the frame lies, used for a frame corner.
    """
    center = np.array(mark.get("center_mm", (0.0, 0.0)))
    if "center_mm" in mark:
        yield _place(mark, "center_mm")
    if "ring_mm" in mark:
        yield _length(mark, "ring_mm", _RING_DEG)
        yield _length(mark, "ring_line_mm", _LINE_DEG, 2.0, mark["ring_mm"])
    if "arm_mm" in mark:
        yield from _cross(mark)
    if mark.get("kind") == "frame-corner":
        yield _length(mark, "reach_mm", 0.0 if toward[0] > 0 else 180.0)
        yield _length(mark, "radius_mm", 90.0 if toward[1] > 0 else -90.0)
    elif "radius_mm" in mark:
        yield _length(mark, "radius_mm", 0.0, side=center)
    if mark.get("shape") == "ring":
        yield _length(mark, "line_mm", 90.0, 2.0, mark["radius_mm"], center)
    if "from_mm" in mark:
        start, end = np.array(mark["from_mm"]), np.array(mark["to_mm"])
        angle = math.degrees(math.atan2(*(end - start)[::-1]))
        yield _place(mark, "from_mm")
        yield _place(mark, "to_mm")
        yield _length(mark, "line_mm", angle + 90.0, 2.0, side=(start + end) / 2)
    if "size_mm" in mark:
        half, key = mark["size_mm"] / 2, "size_mm"
        yield Handle(key, (half, half), lambda place: _set_value(mark, key, max(2 * np.abs(place).max(), _LEAST_MM)))
    for at, vertex in enumerate(mark.get("vertices_mm", ())):
        yield Handle(
            f"vertices_mm.{at}",
            camera_drawing.as_point(vertex),
            partial(_drag_item, mark, "vertices_mm", at, np.ndarray.tolist),
        )
    for at, part in enumerate(mark.get("part", ())):
        for one in handles(part):
            yield Handle(f"part.{at}.{one.key}", one.place_mm, partial(_drag_item, mark, "part", at, one.dragged))


def first_drawing(kind: str, size_mm: float) -> MarkJson:
    """Initial drawing of a kind of mark, with a half size of about size_mm."""
    arm, line, ring = size_mm, size_mm / 8, size_mm / 2
    cross = {"arm_mm": arm, "line_mm": line, "gap_mm": 0.0, "angle_deg": 0.0}
    rings = {"ring_mm": ring, "ring_line_mm": line}
    starts: dict[str, MarkJson] = {
        "cross": cross,
        "dot": {"radius_mm": ring},
        "ring-cross": {**rings, **cross},
        "ring-dot": {**rings, "radius_mm": ring / 3},
        "polygon": {"vertices_mm": []},
        "parts": {"part": [first_part("disk", ring)]},
        "template": {"size_mm": 2 * size_mm},
        "learned": {"size_mm": 2 * size_mm},
        "frame-corner": {"reach_mm": 4 * size_mm, "radius_mm": 0.0},
    }
    if kind not in starts:
        raise InputError(f"{kind!r} is no kind of mark; {', '.join(starts)} are.")
    return scaled_mark({"kind": kind, **starts[kind]})


def first_part(shape: str, size_mm: float) -> MarkJson:
    """Initial part of a shape."""
    corners = [[0.0, size_mm], [-size_mm, -size_mm], [size_mm, -size_mm]]
    parts: dict[str, MarkJson] = {
        "disk": {"center_mm": [0.0, 0.0], "radius_mm": size_mm},
        "ring": {"center_mm": [0.0, 0.0], "radius_mm": size_mm, "line_mm": size_mm / 4},
        "bar": {"from_mm": [-size_mm, 0.0], "to_mm": [size_mm, 0.0], "line_mm": size_mm / 4},
        "polygon": {"vertices_mm": corners},
    }
    if shape not in parts:
        raise InputError(f"{shape!r} is no shape of a part; {', '.join(parts)} are.")
    return scaled_mark({"shape": shape, **parts[shape]})


def add_vertex(mark: MarkJson, place_mm: Array) -> MarkJson:
    """Add a vertex to a polygon: in the side nearest to it, or at the end if there are fewer than three vertices."""
    vertices = [*mark["vertices_mm"]]
    at = len(vertices)
    if at >= 3:
        starts = np.array(vertices)
        sides = np.roll(starts, -1, axis=0) - starts
        along = np.sum((place_mm - starts) * sides, axis=1) / np.maximum(np.sum(sides**2, axis=1), 1e-12)
        nearest = starts + np.clip(along, 0.0, 1.0)[:, None] * sides
        at = int(np.hypot(*(place_mm - nearest).T).argmin()) + 1
    return scaled_mark({**mark, "vertices_mm": [*vertices[:at], place_mm.tolist(), *vertices[at:]]})


def remove_part(mark: MarkJson, key: str) -> MarkJson:
    """Remove the vertex or the part named by a handle's key."""
    name, *rest = key.split(".")
    if name not in ("vertices_mm", "part") or not rest:
        raise InputError("only corners of a polygon and parts can be taken out.")
    try:
        at = int(rest[0])
        part = mark[name][at]
        if rest[1:2] == ["vertices_mm"] and len(part["vertices_mm"]) > 3:
            part = {**part, "vertices_mm": _remove_item(part["vertices_mm"], int(rest[2]))}
            return {**mark, name: [*mark[name][:at], part, *mark[name][at + 1 :]]}
        return {**mark, name: _remove_item(mark[name], at)}
    except (LookupError, ValueError):
        raise InputError(f"the drawing has no {key!r} to take out.") from None


def _remove_item(values: list[Any], at: int) -> list[Any]:
    """Values without one. Raises IndexError where there is none at this place."""
    rest = [*values]
    del rest[at]
    return rest


def _unit(angle_deg: float) -> Array:
    angle = math.radians(angle_deg)
    return np.array([math.cos(angle), math.sin(angle)])


def _length(
    mark: MarkJson, key: str, angle_deg: float, factor: float = 1.0, offset: float = 0.0, side: Array | None = None
) -> Handle:
    """Handle of a length: value = factor (distance from side in the direction of angle_deg - offset)."""
    along, start = _unit(angle_deg), np.zeros(2) if side is None else side

    def dragged(place: Array) -> MarkJson:
        value = factor * (float(along @ (place - start)) - offset)
        return _set_value(mark, key, max(value, 0.0 if key in ("gap_mm", "reach_mm") else _LEAST_MM))

    return Handle(key, camera_drawing.as_point(start + along * (offset + mark.get(key, 0.0) / factor)), dragged)


def _place(mark: MarkJson, key: str) -> Handle:
    return Handle(key, camera_drawing.as_point(mark[key]), lambda place: _set_value(mark, key, place.tolist()))


def _set_value(mark: MarkJson, key: str, value: Any) -> MarkJson:
    return scaled_mark({**mark, key: value})


def _drag_item(mark: MarkJson, key: str, at: int, dragged: Callable[[Array], Any], place: Array) -> MarkJson:
    """Mark with an item of a list dragged to a place."""
    return _set_value(mark, key, [*mark[key][:at], dragged(place), *mark[key][at + 1 :]])


def _cross(mark: MarkJson) -> Iterator[Handle]:
    angle = mark.get("angle_deg", 0.0)

    def turned(place: Array) -> MarkJson:
        degrees = math.degrees(math.atan2(place[1], place[0]))
        return {**mark, "angle_deg": round(degrees % _QUARTER_DEG, 1) % _QUARTER_DEG}

    yield _length(mark, "arm_mm", angle)
    yield _length(mark, "line_mm", angle + 90.0, 2.0, side=_unit(angle) * _LINE_AT * mark["arm_mm"])
    yield _length(mark, "gap_mm", angle + 90.0)
    yield Handle("angle_deg", camera_drawing.as_point(-_unit(angle) * mark["arm_mm"]), turned)
