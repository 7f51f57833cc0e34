"""Drawings of fiducial marks: unions of simple shapes in mm relative to the measured point, x right and y up.

The kinds (cross, dot, ...) are shorthands that return parts; all other modules use parts only. A new kind also needs a
table in `pipeline.files.mark_table.MARK_TABLES`, a start in `pipeline.review.drawing_view.first_drawing`, and an entry
in `pipeline.files.library.MARK_KINDS`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from scipy.spatial import cKDTree

from measure.array_types import Array, Mask

Point = tuple[float, float]
Polarity = Literal["light", "dark", "auto"]
_NEGATIVE: Mapping[Polarity, Polarity] = {"light": "dark", "dark": "light", "auto": "auto"}
Side = Literal["left", "right", "top", "bottom"]

LEARNED_ORIGIN = 0.25  # fraction of a learned mark's size: standard deviation of its template's origin on the mark
MOST_GIVEN_SIGMA_MM = 0.1  # mm, limit of a given place's sigma: a datum may state 1 mm although the place is better
_CORNER_RAD = np.deg2rad(30.0)  # rad, smallest turn of a corner; the vertices of an arc turn by less
_SEARCHED = 0.3  # fraction of a frame corner's reach: side of the square used as its template
_EDGE_MM = 0.1  # mm, tolerance within which a drawing ends on the frame's edge
_TO_NEXT = 0.45  # fraction of the distance to the next mark: longer arms are continuous lines
_LINE_WIDTHS = 5.0  # in line widths, half side of the square used around a crossing


@dataclass(frozen=True)
class Disk:
    """A filled circle."""

    center_mm: Point
    radius_mm: float


@dataclass(frozen=True)
class Ring:
    """A circle drawn as a line: radius_mm to the centre of the line, line_mm its width."""

    center_mm: Point
    radius_mm: float
    line_mm: float


@dataclass(frozen=True)
class Bar:
    """A straight line with square ends at from_mm and to_mm."""

    from_mm: Point
    to_mm: Point
    line_mm: float


@dataclass(frozen=True)
class Polygon:
    """A filled simple polygon; the last vertex joins the first."""

    vertices_mm: tuple[Point, ...]


Part = Disk | Ring | Bar | Polygon


@dataclass(frozen=True)
class MarkShape:
    """A drawn mark, the union of its parts.

    Attributes
    ----------
    parts : shapes in mm.
    polarity : light or dark against the background, or "auto".
    perspective : per mm, of a plane imaged obliquely: a point u of the parts is drawn at u / (1 + perspective u).
    known_mm : smallest and largest corner of the rectangle in which the drawing is known; None: everywhere.
    true_mm : smallest and largest corner of the rectangle in which the drawing is exact and is fitted; None: everywhere
        it is known.
    """

    parts: tuple[Part, ...]
    polarity: Polarity = "auto"
    perspective: Point = field(default=(0.0, 0.0), kw_only=True)
    known_mm: tuple[Point, Point] | None = field(default=None, kw_only=True)
    true_mm: tuple[Point, Point] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("a mark needs at least one part")

    def perspective_places(self, places_mm: Array) -> Array:
        """Apply the perspective to points (n, 2) of the parts."""
        return np.asarray(places_mm / (1.0 + places_mm @ self.perspective)[:, None])

    @property
    def thinnest_mm(self) -> float:
        """Width of the thinnest line, estimated from the parts."""
        widths = []
        for part in self.parts:
            if isinstance(part, Bar | Ring):
                widths.append(part.line_mm)
            elif isinstance(part, Disk):
                widths.append(2 * part.radius_mm)
            elif isinstance(part, Polygon):
                vertices = np.asarray(part.vertices_mm)
                widths.append(float(np.ptp(vertices, axis=0).min()) / 3)
        return min(widths)

    @property
    def known_outline_mm(self) -> Array:
        """(n, 2) corners of a region that contains the known part of the drawing."""
        drawn = drawn_outline_mm(self)
        if self.known_mm is None:
            return drawn
        least, greatest = np.add(self.known_mm, [[_EDGE_MM], [-_EDGE_MM]])
        parts = [self.perspective_places(outline_mm(part)) for part in self.parts]
        for axis in (0, 1):
            parts = [_below(_below(part, axis, 1.0, greatest[axis]), axis, -1.0, -least[axis]) for part in parts]
        known = np.concatenate(parts)
        return known if len(known) else drawn

    @property
    def is_round(self) -> bool:
        """Whether the mark is invariant under rotation."""
        centred = all(isinstance(part, Disk | Ring) and part.center_mm == (0.0, 0.0) for part in self.parts)
        return centred and not any(self.perspective)

    @property
    def is_cross(self) -> bool:
        """Whether the mark consists of bars only, with the ends of all arms known."""
        return self.known_mm is None and all(isinstance(part, Bar) for part in self.parts)

    @property
    def is_solid(self) -> bool:
        """Whether the mark has an outline only, whose place depends on the slope of the background."""
        return all(isinstance(part, Polygon | Disk) for part in self.parts)

    @property
    def is_held_by_frame(self) -> bool:
        """Whether rotation and scale have to come from the other marks: the edges of a wedge or a notch do not separate
        scale from place."""
        return all(isinstance(part, Polygon) for part in self.parts)


@dataclass(frozen=True)
class FrameCorner(MarkShape):
    """Intersection of two edges of the exposed frame. Its parts, a square of the frame, serve the search only.

    toward: (±1, ±1) direction from the corner into the frame; reach_mm: length along which the edges are measured;
    radius_mm: radius of a rounded corner, where the measured part begins.
    """

    toward: Point = (1.0, 1.0)
    reach_mm: float = 1.0
    radius_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class MarkTemplate:
    """A mark given as a template, a chip cut from a scan or averaged over several.

    Attributes
    ----------
    image : (rows, columns) grey values on any scale.
    pitch_um : pixel pitch of the template.
    origin_px : (column, row) of the measured point.
    turn_deg : rotation of the mark, counter-clockwise.
    polarity : light or dark, or "auto".
    detail_mm : width of the finest detail; 0 where unknown, then two pixels are assumed.
    noise_dn : standard deviation of the noise of one pixel in the scans it is made of.
    slope_noise_dn : standard deviation of the noise in the template's gradient, per pixel, after the smoothing of a
        fit.
    shares : by the name of the scan, its share of the template.
    steady : (rows, columns) mask of the pixels that look alike in all scans; None: all.
    steadiness : (rows, columns) standard deviation of the noise over that of the differences between scans and
        template, at most 1; None where unknown.
    learned_mm : side of the learned square; 0 for a chip supplied by the user.
    alike : scan orientations that map the camera's learned marks, with their origins, onto one another.
    """

    is_round: ClassVar[bool] = False
    is_solid: ClassVar[bool] = False
    is_held_by_frame: ClassVar[bool] = True

    image: Array
    pitch_um: float
    origin_px: Point
    turn_deg: float = 0.0
    polarity: Polarity = "auto"
    detail_mm: float = 0.0
    noise_dn: float = 0.0
    slope_noise_dn: float = 0.0
    shares: Mapping[str, float] = field(default_factory=dict)
    steady: Mask | None = None
    steadiness: Array | None = None
    learned_mm: float = 0.0
    alike: tuple[str, ...] = ()

    @property
    def thinnest_mm(self) -> float:
        """Width of the thinnest line; two pixels where it is unknown."""
        return self.detail_mm or self.pitch_um / 1000 * 2


Mark = MarkShape | MarkTemplate


@dataclass(frozen=True)
class LearnedMark:
    """A mark without a drawing. A square of size_mm around it, averaged over the camera's scans, becomes its
    template."""

    size_mm: float


@dataclass(frozen=True)
class LayoutMark:
    """A fiducial of the camera file: xy_mm (2,), standard deviations sigma_mm (2,), inf where free, and its mark."""

    id: str
    xy_mm: Point
    sigma_mm: Point
    mark: Mark


def places_mm(marks: Sequence[LayoutMark]) -> Array:
    """(n, 2) coordinates of marks."""
    return np.array([mark.xy_mm for mark in marks])


@dataclass(frozen=True)
class WrittenPlace:
    """Place of a camera's writing on its film.

    side: side of the frame, with x' to the right and y' up; pose: orientation of the writing in the drawing, "90" if it
    reads upwards, None if unknown; plate: True for the camera's data plate (type, number, principal distance), False
    for titles.
    """

    side: Side
    pose: str | None = None
    plate: bool = False


@dataclass(frozen=True)
class FiducialLayout:
    """Layout of a camera: its marks, the size of the exposed frame (width, height) in mm, and the places of writing, as
    far as known."""

    marks: tuple[LayoutMark, ...]
    frame_mm: Point
    writing: tuple[WrittenPlace, ...] = ()

    @property
    def places_mm(self) -> Array:
        """(n, 2) coordinates of the marks."""
        return places_mm(self.marks)

    @property
    def negative(self) -> "FiducialLayout":
        """The layout as a negative shows it: marks drawn light are dark there, and the reverse."""
        marks = (replace(each, mark=replace(each.mark, polarity=_NEGATIVE[each.mark.polarity])) for each in self.marks)
        return replace(self, marks=tuple(marks))


def cross(arm_mm: float, line_mm: float, gap_mm: float = 0.0, angle_deg: float = 0.0) -> tuple[Part, ...]:
    """Four arms from gap_mm to arm_mm from the centre, each line_mm wide; two full bars if there is no gap."""
    if gap_mm == 0.0:
        bars: tuple[Part, ...] = (
            Bar((-arm_mm, 0.0), (arm_mm, 0.0), line_mm),
            Bar((0.0, -arm_mm), (0.0, arm_mm), line_mm),
        )
    else:
        directions = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
        bars = tuple(Bar((gap_mm * x, gap_mm * y), (arm_mm * x, arm_mm * y), line_mm) for x, y in directions)
    return tuple(rotate_part(bar, angle_deg) for bar in bars)


def dot(radius_mm: float) -> tuple[Part, ...]:
    """One filled disk."""
    return (Disk((0.0, 0.0), radius_mm),)


def ring_cross(
    ring_mm: float,
    ring_line_mm: float,
    arm_mm: float,
    line_mm: float,
    gap_mm: float = 0.0,
    angle_deg: float = 0.0,
) -> tuple[Part, ...]:
    """A ring of mean radius ring_mm around a cross."""
    return (Ring((0.0, 0.0), ring_mm, ring_line_mm), *cross(arm_mm, line_mm, gap_mm, angle_deg))


def ring_dot(ring_mm: float, ring_line_mm: float, radius_mm: float) -> tuple[Part, ...]:
    """A ring of mean radius ring_mm around a dot."""
    return (Ring((0.0, 0.0), ring_mm, ring_line_mm), *dot(radius_mm))


def polygon(vertices_mm: Sequence[Point]) -> tuple[Part, ...]:
    """A wedge, a notch or a wing."""
    return (Polygon(tuple((float(x), float(y)) for x, y in vertices_mm)),)


def frame_corner(xy_mm: Point, reach_mm: float, radius_mm: float = 0.0, polarity: Polarity = "auto") -> FrameCorner:
    """The frame corner at xy_mm. polarity: of the frame against its border."""
    toward = (-1.0 if xy_mm[0] > 0 else 1.0, -1.0 if xy_mm[1] > 0 else 1.0)
    size = max(_SEARCHED * reach_mm, 2 * radius_mm)
    turn = np.linspace(0.0, np.pi / 2, 9)
    arc = [(radius_mm * (1 - float(np.sin(t))), radius_mm * (1 - float(np.cos(t)))) for t in turn] if radius_mm else []
    square = polygon(
        [(x * toward[0], y * toward[1]) for x, y in (*(arc or [(0.0, 0.0)]), (size, 0.0), (size, size), (0.0, size))]
    )
    return FrameCorner(square, polarity, toward, reach_mm, radius_mm)


def rotate_mark(mark: Mark, angle_deg: float) -> Mark:
    """Rotate a mark counter-clockwise around its origin."""
    if isinstance(mark, MarkTemplate):
        return replace(mark, turn_deg=mark.turn_deg + angle_deg)
    parts = tuple(rotate_part(part, angle_deg) for part in mark.parts)
    true = mark.true_mm and _turned_rectangle(mark.true_mm, angle_deg)
    return replace(mark, parts=parts, perspective=_turned_point(mark.perspective, angle_deg), true_mm=true)


def rotate_part(part: Part, angle_deg: float) -> Part:
    """Rotate a part counter-clockwise around the mark's origin; quarter turns are exact."""
    if isinstance(part, Polygon):
        return Polygon(tuple(_turned_point(vertex, angle_deg) for vertex in part.vertices_mm))
    if isinstance(part, Bar):
        return Bar(_turned_point(part.from_mm, angle_deg), _turned_point(part.to_mm, angle_deg), part.line_mm)
    return replace(part, center_mm=_turned_point(part.center_mm, angle_deg))


def _turned_rectangle(rectangle: tuple[Point, Point], angle_deg: float) -> tuple[Point, Point]:
    """Rotate an upright rectangle, given by its smallest and largest corner. After quarter turns the result is exact,
    otherwise the largest upright rectangle of the same proportions inside the rotated one."""
    quarter = round(angle_deg / 90)
    rest = abs(math.radians(angle_deg - 90 * quarter))
    middle = _turned_point(tuple(np.mean(rectangle, axis=0).tolist()), angle_deg)
    wide, tall = (np.diff(rectangle, axis=0)[0] / 2).tolist()[:: -1 if quarter % 2 else 1]
    within = min(one / (one * math.cos(rest) + other * math.sin(rest)) for one, other in ((wide, tall), (tall, wide)))
    half = within * wide, within * tall
    return (middle[0] - half[0], middle[1] - half[1]), (middle[0] + half[0], middle[1] + half[1])


def _turned_point(point: Point, angle_deg: float) -> Point:
    quarter, rest = divmod(angle_deg, 90.0)
    if rest == 0.0:
        c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter) % 4]
    else:
        c, s = float(np.cos(np.deg2rad(angle_deg))), float(np.sin(np.deg2rad(angle_deg)))
    return (c * point[0] - s * point[1], s * point[0] + c * point[1])


def widen_lines(mark: MarkShape, ratio: float) -> MarkShape:
    """Multiply the widths of a mark's bars by a ratio."""
    widened = (replace(part, line_mm=ratio * part.line_mm) if isinstance(part, Bar) else part for part in mark.parts)
    return replace(mark, parts=tuple(widened))


def is_made_of_areas(mark: LayoutMark) -> bool:
    """Whether a mark consists of areas only, like wings, notches and arrows."""
    return isinstance(mark.mark, MarkShape) and mark.mark.is_held_by_frame


def finest_detail_mm(mark: Mark) -> float:
    """Width of the mark's thinnest line, or length of the shortest straight edge between corners of its outline."""
    if isinstance(mark, MarkTemplate):
        return mark.thinnest_mm
    finest_mm = mark.thinnest_mm
    for outline in (np.asarray(part.vertices_mm) for part in mark.parts if isinstance(part, Polygon)):
        edges = np.roll(outline, -1, axis=0) - outline
        angles = np.angle(edges @ (1, 1j))
        turns = np.abs(np.angle(np.exp(1j * (angles - np.roll(angles, 1)))))  # at the start of each edge
        is_corner = turns > _CORNER_RAD
        straight = edges[is_corner & np.roll(is_corner, -1)]  # without the edges of arcs
        finest_mm = min([finest_mm, *(float(np.hypot(*edge)) for edge in straight)])
    return finest_mm


# Known part of a mark's drawing, at the border of the exposed frame and along the lines of a réseau.
#
# Solid marks at the border are wings and blocks that project from it, and notches cut into it. Nothing is exposed
# beyond the frame. A wing merges there into the unexposed border; a notch is exposed like the frame and merges into it.
# The drawing of a wing is therefore known within the frame only, that of a notch beyond its edge only. A dark mark
# beyond the edge lies in an exposed pocket: all of it is known.
#
# A réseau of continuous lines is drawn as crosses whose arms reach to the next ones. A crossing is determined by the
# lines close to it; farther parts take computing time and meet stars.


def limit_to_frame(layout: FiducialLayout) -> FiducialLayout:
    """Limit the drawings of solid marks to their known part.

    Marks whose point lies within the frame and that reach its edge are limited to the frame. Marks whose point lies on
    the edge or beyond are limited to the area beyond the edge, unless they are dark.
    """
    return replace(layout, marks=tuple(_limit_mark(mark, np.array(layout.frame_mm) / 2) for mark in layout.marks))


def limit_to_crossings(layout: FiducialLayout) -> FiducialLayout:
    """Limit crosses whose arms reach halfway to the next mark to a few line widths around their points."""
    if len(layout.marks) < 2:
        return layout
    xy, marks = layout.places_mm, []
    for mark, next_mm in zip(layout.marks, np.asarray(cKDTree(xy).query(xy, k=2)[0])[:, 1], strict=True):
        shape = mark.mark
        if isinstance(shape, MarkShape) and shape.is_cross:
            half_mm = _LINE_WIDTHS * max(part.line_mm for part in shape.parts if isinstance(part, Bar))
            if np.abs(drawn_outline_mm(shape)).max() >= max(_TO_NEXT * next_mm, half_mm):
                limited = replace(shape, known_mm=((-half_mm, -half_mm), (half_mm, half_mm)))
                mark = replace(mark, mark=limited)
        marks.append(mark)
    return replace(layout, marks=tuple(marks))


def _limit_mark(mark: LayoutMark, half_mm: Array) -> LayoutMark:
    shape, at = mark.mark, np.array(mark.xy_mm)
    if not isinstance(shape, MarkShape) or isinstance(shape, FrameCorner):
        return mark
    if not all(isinstance(part, Polygon) for part in shape.parts):
        return mark
    drawn = at + drawn_outline_mm(shape)
    beyond = np.abs(at) >= half_mm - _EDGE_MM
    if beyond.any() and shape.polarity == "dark":
        return mark
    if beyond.any():
        outwards = np.where(beyond, np.sign(at), 0.0)
        if beyond.all() or (drawn @ outwards).min() > half_mm[beyond][0] + _EDGE_MM:
            return mark
        least = np.where(outwards > 0, half_mm, -np.inf)
        greatest = np.where(outwards < 0, -half_mm, np.inf)
    elif np.any(np.abs(drawn) >= half_mm - _EDGE_MM):
        least, greatest = -half_mm, half_mm
    else:
        return mark
    (left, bottom), (right, top) = (least - at).tolist(), (greatest - at).tolist()
    return replace(mark, mark=replace(shape, known_mm=((left, bottom), (right, top))))


def outline_mm(part: Part) -> Array:
    """(n, 2) corners of a convex region that contains the part."""
    if isinstance(part, Polygon):
        return np.asarray(part.vertices_mm, dtype=float)
    if isinstance(part, Bar):
        start, end = np.asarray(part.from_mm), np.asarray(part.to_mm)
        along = (end - start) / np.hypot(*(end - start))
        side = np.array([-along[1], along[0]]) * part.line_mm / 2
        return np.stack([start - side, start + side, end + side, end - side])
    reach = part.radius_mm + (part.line_mm / 2 if isinstance(part, Ring) else 0.0)
    return np.asarray(part.center_mm) + reach * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])


def drawn_outline_mm(mark: MarkShape) -> Array:
    """(n, 2) corners of a region that contains the whole drawing."""
    return mark.perspective_places(np.concatenate([outline_mm(part) for part in mark.parts]))


def _below(polygon: Array, axis: int, sign: float, limit: float) -> Array:
    """Clip a polygon (n, 2) to the half plane sign * coordinate <= limit (Sutherland and Hodgman)."""
    corners = []
    over = sign * polygon[:, axis] - limit
    for start, end, begins, ends in zip(polygon, np.roll(polygon, -1, axis=0), over, np.roll(over, -1), strict=True):
        if begins <= 0:
            corners.append(start)
        if begins * ends < 0:
            corners.append(start + (end - start) * begins / (begins - ends))
    return np.array(corners).reshape(-1, 2)
