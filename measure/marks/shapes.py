"""Fiducial marks as drawings: unions of simple shapes in mm about the point that is measured, x right and y up.

The kinds are shorthands that give parts; everything after them knows parts only.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from measure.array_types import Array, Mask

Point = tuple[float, float]
Polarity = Literal["light", "dark", "auto"]
Side = Literal["left", "right", "top", "bottom"]

LEARNED_ORIGIN = 0.25  # of a learned mark's size: standard deviation of its template's origin about the mark
MOST_GIVEN_SIGMA_MM = 0.1  # of a given place: a datum's sigma may be a millimetre, and its place is better than that
_CORNER_RAD = np.deg2rad(30.0)  # of an outline: an arc is drawn by vertices of less
_SEARCHED = 0.3  # of a frame corner's reach: the square that it is searched by


@dataclass(frozen=True)
class Disk:
    """A filled circle."""

    center_mm: Point
    radius_mm: float


@dataclass(frozen=True)
class Ring:
    """A circle drawn with a line: radius_mm is the line's middle, line_mm its width."""

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
    """A mark that is drawn. Overlapping parts count once.

    perspective: of a plane seen obliquely, per mm: a point u of the parts is drawn at u / (1 + perspective u).
    known_mm: the least and the greatest corner of the part of the plane in which anything is known of the mark; None:
    all of it. true_mm: likewise of that in which the drawing is true to the last pixel, and that it is fitted by.
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
        """Where points (n, 2) of the parts are drawn."""
        return np.asarray(places_mm / (1.0 + places_mm @ self.perspective)[:, None])


@dataclass(frozen=True)
class FrameCorner(MarkShape):
    """Where two edges of the exposed frame meet; its parts, a square of the frame, serve the search alone.

    toward: (±1, ±1), where from the corner the frame lies. reach_mm: how far along the edges they are measured, from
    radius_mm on, that of a rounded corner.
    """

    toward: Point = (1.0, 1.0)
    reach_mm: float = 1.0
    radius_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class MarkTemplate:
    """A mark that is a chip cut from a scan.

    image: (rows, columns), any scale of grey values; origin_px: (column, row) of the measured point in it. detail_mm:
    its finest detail, 0 where that is not known: then two of its pixels. noise_dn: of one pixel of the scans that it is
    made of, by whose names shares says how much of the chip is each one's own picture. slope_noise_dn: standard
    deviation of noise in the chip's own slopes, per pixel, as a fit sees them. steady: which of its pixels look alike
    in all of them, None where all do. steadiness: (rows, columns), 1 where a picture differs from the chip by noise,
    and less where it differs by more: the ratio of the standard deviations; None where that is not known.
    learned_mm: the side of the square that was learned, 0 of a chip that somebody cut out. alike: the poses that take
    the camera's learned marks, with their origins, to one another.
    """

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


Mark = MarkShape | MarkTemplate


@dataclass(frozen=True)
class LearnedMark:
    """A mark that nobody has drawn: a square of size_mm about it is averaged over the camera's scans, and that is its
    template."""

    size_mm: float


@dataclass(frozen=True)
class LayoutMark:
    """A fiducial as the camera file gives it: xy_mm (2,) with standard deviations sigma_mm (2,), inf where free."""

    id: str
    xy_mm: Point
    sigma_mm: Point
    mark: Mark


@dataclass(frozen=True)
class WrittenPlace:
    """Where a camera writes on its film: beside which side of the frame, x' to the right and y' up. pose: how the
    writing lies in the drawing, "90" where it reads upward; None where nobody says. plate: whether it is the camera's
    own plate, with its type, number and principal distance, or titles."""

    side: Side
    pose: str | None = None
    plate: bool = False


@dataclass(frozen=True)
class FiducialLayout:
    """The camera's marks, the size of its exposed frame (width, height), and where it writes on its film, as far as
    anybody says."""

    marks: tuple[LayoutMark, ...]
    frame_mm: Point
    writing: tuple[WrittenPlace, ...] = ()


def cross(arm_mm: float, line_mm: float, gap_mm: float = 0.0, angle_deg: float = 0.0) -> tuple[Part, ...]:
    """Four arms from gap_mm to arm_mm off the centre, each line_mm wide; two whole bars where there is no gap."""
    if gap_mm == 0.0:
        bars: tuple[Part, ...] = (
            Bar((-arm_mm, 0.0), (arm_mm, 0.0), line_mm),
            Bar((0.0, -arm_mm), (0.0, arm_mm), line_mm),
        )
    else:
        directions = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
        bars = tuple(Bar((gap_mm * x, gap_mm * y), (arm_mm * x, arm_mm * y), line_mm) for x, y in directions)
    return tuple(turned_part(bar, angle_deg) for bar in bars)


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
    """A ring of mean radius ring_mm about a cross."""
    return (Ring((0.0, 0.0), ring_mm, ring_line_mm), *cross(arm_mm, line_mm, gap_mm, angle_deg))


def ring_dot(ring_mm: float, ring_line_mm: float, radius_mm: float) -> tuple[Part, ...]:
    """A ring of mean radius ring_mm about a dot."""
    return (Ring((0.0, 0.0), ring_mm, ring_line_mm), *dot(radius_mm))


def polygon(vertices_mm: Sequence[Point]) -> tuple[Part, ...]:
    """A wedge, a notch or a wing."""
    return (Polygon(tuple((float(x), float(y)) for x, y in vertices_mm)),)


def frame_corner(xy_mm: Point, reach_mm: float, radius_mm: float = 0.0, polarity: Polarity = "auto") -> FrameCorner:
    """The corner of the frame at a place in it, polarity that of the frame against the border."""
    toward = (-1.0 if xy_mm[0] > 0 else 1.0, -1.0 if xy_mm[1] > 0 else 1.0)
    size = max(_SEARCHED * reach_mm, 2 * radius_mm)
    turn = np.linspace(0.0, np.pi / 2, 9)
    arc = [(radius_mm * (1 - float(np.sin(t))), radius_mm * (1 - float(np.cos(t)))) for t in turn] if radius_mm else []
    square = polygon(
        [(x * toward[0], y * toward[1]) for x, y in (*(arc or [(0.0, 0.0)]), (size, 0.0), (size, size), (0.0, size))]
    )
    return FrameCorner(square, polarity, toward, reach_mm, radius_mm)


def turned(mark: Mark, angle_deg: float) -> Mark:
    """The mark turned counter-clockwise about its origin."""
    if isinstance(mark, MarkTemplate):
        return replace(mark, turn_deg=mark.turn_deg + angle_deg)
    parts = tuple(turned_part(part, angle_deg) for part in mark.parts)
    true = mark.true_mm and _turned_rectangle(mark.true_mm, angle_deg)
    return replace(mark, parts=parts, perspective=_turned_point(mark.perspective, angle_deg), true_mm=true)


def turned_part(part: Part, angle_deg: float) -> Part:
    """The part turned counter-clockwise about the mark's origin; quarter turns are exact."""

    def turn(point: Point) -> Point:
        return _turned_point(point, angle_deg)

    if isinstance(part, Polygon):
        return Polygon(tuple(turn(vertex) for vertex in part.vertices_mm))
    if isinstance(part, Bar):
        return Bar(turn(part.from_mm), turn(part.to_mm), part.line_mm)
    return replace(part, center_mm=turn(part.center_mm))


def _turned_rectangle(rectangle: tuple[Point, Point], angle_deg: float) -> tuple[Point, Point]:
    """An upright rectangle, by its least and its greatest corner, after a turn: of its own shape after a quarter turn,
    else as large as lies in the turned one."""
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


def thinnest_mm(mark: Mark) -> float:
    """The width of the mark's thinnest line, as far as its parts tell."""
    if isinstance(mark, MarkTemplate):
        return mark.detail_mm or mark.pitch_um / 1000 * 2
    widths = []
    for part in mark.parts:
        if isinstance(part, Bar | Ring):
            widths.append(part.line_mm)
        elif isinstance(part, Disk):
            widths.append(2 * part.radius_mm)
        elif isinstance(part, Polygon):
            vertices = np.asarray(part.vertices_mm)
            widths.append(float(np.ptp(vertices, axis=0).min()) / 3)
    return min(widths)


def finest_detail_mm(mark: Mark) -> float:
    """The width of the mark's thinnest line, or the shortest straight edge from corner to corner of its outline."""
    if isinstance(mark, MarkTemplate):
        return thinnest_mm(mark)
    outlines = (np.asarray(part.vertices_mm) for part in mark.parts if isinstance(part, Polygon))
    return min([thinnest_mm(mark), *(length for outline in outlines for length in _straight_edges_mm(outline))])


def _straight_edges_mm(outline: Array) -> list[float]:
    """Lengths of the edges of a polygon (n, 2) that end in corners, and do not go on as an arc."""
    edges = np.roll(outline, -1, axis=0) - outline
    angles = np.angle(edges @ (1, 1j))
    turns = np.abs(np.angle(np.exp(1j * (angles - np.roll(angles, 1)))))  # at the beginning of each edge
    is_corner = turns > _CORNER_RAD
    return [float(np.hypot(*edge)) for edge in edges[is_corner & np.roll(is_corner, -1)]]
