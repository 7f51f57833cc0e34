"""Fiducial marks in a camera file: drawn marks, templates with their images, and learned marks."""

import dataclasses
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from measure.errors import MeasurementError
from measure.geometry import POSES
from measure.marks import shapes
from measure.marks.shapes import MarkTemplate, Point
from pipeline.text.atomic import write_atomically
from pipeline.text.names import image_name
from pipeline.text.table_models import (
    FLAG,
    NOT_NEGATIVE,
    NUMBER,
    PAIR,
    POSITIVE,
    TABLE,
    TEXT,
    TEXTS,
    Key,
    choice,
    read_model,
    subtable,
)
from pipeline.text.tables import Table
from pipeline.text.wording import numbers, quoted

Array = NDArray[np.float64]
Picture = NDArray[np.uint16]
Picture01 = Array | None  # pixels of a template, values between 0 and 1
SavePicture = Callable[[str, Picture], str]

_FULL = 65535
_ANY_CORNER = (-1.0, -1.0)  # placeholder: the fiducial's place determines the quadrant


def _vertices(table: Table, key: str) -> tuple[Point, ...]:
    vertices = table.pairs(key)
    if len(vertices) < 3:
        raise table.error(key, f"a polygon needs at least three vertices, not {len(vertices)}.")
    x, y = np.transpose(vertices)
    if np.isclose(x @ np.roll(y, 1), y @ np.roll(x, 1), rtol=1e-9, atol=0.0):
        raise table.error(key, "the polygon encloses no area. Give its corners in the order of its outline.")
    return vertices


VERTICES = Key("list of [x, y]", _vertices)


@dataclasses.dataclass(frozen=True)
class Clicks:
    """Clicked places of the marks in one scan.

    Attributes
    ----------
    scan : image name.
    px : column and row by fiducial.
    sha256 : of the scan's file when it was clicked; "" where the camera file has the clicks.
    who : the person; "" where the camera file has the clicks.
    """

    scan: str
    px: Mapping[str, Point]
    sha256: str = ""
    who: str = ""


@dataclass(frozen=True, config=TABLE)
class LearnedFrom:
    """[learned_from] of a camera file.

    Attributes
    ----------
    scan : scan from which the first templates were cut.
    sha256 : of its file.
    pose : scan orientation.
    clicked : whether the pose is known from clicks.
    alike : scans in the same orientation: the scan itself, or all scans where the marks were found by recurring in one
        place.
    """

    scan: Annotated[str, TEXT]
    sha256: Annotated[str, TEXT]
    pose: Annotated[str, choice(*POSES)]
    clicked: Annotated[bool, FLAG] = False
    alike: Annotated[tuple[str, ...], TEXTS] = ()


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Drawn mark. is_radial: whether it is rotated with its place."""

    mark: shapes.Mark | shapes.LearnedMark
    is_radial: bool


def read_clicks(table: Table, learned: Sequence[str]) -> Clicks:
    """Read clicks on learned marks. Raises InputError where some of them are not clicked."""
    scan = image_name(table.text("scan"))
    places = table.table("px")
    px = {id: places.pair(id) for id in learned if id in places}
    places.done()
    table.done()
    missing = [id for id in learned if id not in px]
    if missing or not px:
        raise table.error(
            "px", f"says nothing of {', '.join(missing) or 'any mark'}. Click all learned marks, or none."
        )
    return Clicks(scan, px)


# Template of a mark in a camera file, with its images in files beside it: `[mark.NAME]` of kind "template".
#
# `[mark.NAME.learned]` holds what was learned from scans; a manually cut chip has no such table.


def picture_writer(folder: Path, prefix: str = "") -> SavePicture:
    """Function that stores images in a folder, under names that begin with the prefix."""

    def save(name: str, picture: Picture) -> str:
        file = f"{prefix}{name}.tif"
        write_atomically(folder / file, picture_file(picture))
        return file

    return save


def picture_file(picture: Picture) -> bytes:
    """Image as the content of the TIFF file that `picture_writer` stores."""
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(file, picture, metadata=None, software="reseau")
    return file.getvalue()


def template_lines(template: MarkTemplate, name: str, save: SavePicture) -> list[str]:
    """Lines of the table [mark.NAME]. save(name, picture) stores an image and returns its path there."""
    least, range_dn = float(template.image.min()), float(np.ptp(template.image))
    image = save(name, _picture((template.image - least) / (range_dn or 1.0)))
    lines = ['kind = "template"', f"image = {quoted(image)}", f"pitch_um = {template.pitch_um!r}"]
    lines += [f"origin_px = {numbers(template.origin_px)}", f"polarity = {quoted(template.polarity)}"]
    lines += [f"detail_mm = {template.detail_mm!r}"]
    if template.turn_deg:
        lines.append(f"turn_deg = {template.turn_deg!r}")
    return [*lines, *_learned_lines(template, range_dn, name, save)] if template.learned_mm else lines


def _learned_lines(template: MarkTemplate, range_dn: float, name: str, save: SavePicture) -> list[str]:
    lines = [f"[mark.{name}.learned]", f"size_mm = {template.learned_mm!r}"]
    if template.alike:
        lines.append(f"alike = [{', '.join(map(quoted, template.alike))}]")
    lines += [f"range_dn = {range_dn!r}", f"noise_dn = {template.noise_dn!r}"]
    lines.append(f"slope_noise_dn = {template.slope_noise_dn!r}")
    for key, values in (("steadiness", template.steadiness), ("steady", template.steady)):
        if values is not None:
            lines.append(f"{key} = {quoted(save(f'{name}-{key}', _picture(values)))}")
    shares = [f"{quoted(scan)} = {share!r}" for scan, share in template.shares.items()]
    return [*lines, f"[mark.{name}.learned.shares]", *shares]


def _picture(shares: NDArray[np.float64] | NDArray[np.bool_]) -> Picture:
    """16-bit image of values between 0 and 1."""
    return np.asarray(np.rint(np.asarray(shares, float) * _FULL), np.uint16)


def read_template(table: Table) -> MarkTemplate:
    """Read a template. Raises InputError with the key that is wrong."""
    return read_model(table, TemplateTable).mark(table)


def read_marks(table: Table) -> dict[str, Drawing]:
    """Read all drawn marks by name. Raises InputError with the key that is wrong."""
    marks = {}
    for name in table.names():
        entry = table.table(name)
        given = read_model(entry, MARK_TABLES[entry.text("kind", choices=tuple(MARK_TABLES))])
        marks[name] = Drawing(given.mark(entry), given.rotate == "radial")
    return marks


@dataclass(frozen=True, kw_only=True, config=TABLE)
class MarkTable(ABC):
    """Keys of every table [mark.NAME]."""

    kind: Annotated[str, TEXT] = Field(description="Shape of the mark.")
    rotate: Annotated[str, choice("none", "radial")] = Field(
        default="none", description="radial: drawn as on the positive x axis, turned with its place."
    )

    @abstractmethod
    def mark(self, table: Table) -> shapes.Mark | shapes.LearnedMark:
        """Mark of the table. table: for messages."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class LearnedTable(MarkTable):
    """Mark to be learned from the scans."""

    size_mm: Annotated[float, POSITIVE] = Field(description="Width of the template.")

    def mark(self, table: Table) -> shapes.LearnedMark:
        return shapes.LearnedMark(self.size_mm)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class PaintedTable(MarkTable):
    """Mark that is lighter or darker than its background."""

    polarity: Annotated[shapes.Polarity, choice("auto", "light", "dark")] = Field(
        default="auto", description="Whether the mark is lighter than its background."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class FrameCornerTable(PaintedTable):
    """Corner of the exposed frame."""

    reach_mm: Annotated[float, NOT_NEGATIVE] = Field(
        default=0.0, description="How far along its edges it is measured; 0: a sixth of half the frame."
    )
    radius_mm: Annotated[float, NOT_NEGATIVE] = Field(default=0.0, description="Of a rounded corner.")

    def mark(self, table: Table) -> shapes.Mark:
        if self.radius_mm and self.reach_mm and self.radius_mm >= self.reach_mm:
            raise table.error(
                "radius_mm", f"must be smaller than reach_mm ({self.reach_mm:g}), not {self.radius_mm:g}."
            )
        return shapes.frame_corner(_ANY_CORNER, self.reach_mm, self.radius_mm, self.polarity)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class LearnedPicture:
    """[mark.NAME.learned]: properties of a template estimated from scans, as the program writes them."""

    size_mm: Annotated[float, POSITIVE]
    range_dn: Annotated[float, POSITIVE]
    noise_dn: Annotated[float, NOT_NEGATIVE]
    slope_noise_dn: Annotated[float, NOT_NEGATIVE] = 0.0
    alike: Annotated[tuple[str, ...], TEXTS] = ()
    steadiness: Annotated[Picture01, Key("path", lambda table, key: _image(table, key) / _FULL)] = None
    steady: Annotated[Picture01, Key("path", lambda table, key: _image(table, key) / _FULL)] = None
    shares: Annotated[Mapping[str, float], Key("numbers by scan", lambda table, key: _shares(table.table(key)))] = (
        Field(default_factory=dict)
    )

    def applied(self, template: MarkTemplate, table: Table) -> MarkTemplate:
        """Template with its learned properties."""
        for key, values in (("steadiness", self.steadiness), ("steady", self.steady)):
            if values is not None and values.shape != template.image.shape:
                px = template.image.shape[::-1]
                raise table.error(key, f"is a picture of {values.shape[::-1]} px, and the template has {px}.")
        return replace(
            template,
            image=template.image * (self.range_dn / float(np.ptp(template.image))),
            noise_dn=self.noise_dn,
            slope_noise_dn=self.slope_noise_dn,
            shares=self.shares,
            steadiness=self.steadiness,
            steady=None if self.steady is None else self.steady > 0.5,
            learned_mm=self.size_mm,
            alike=self.alike,
        )


def _shares(table: Table) -> dict[str, float]:
    return {scan: table.number(scan, above=0.0) for scan in table.names()}


def _image(table: Table, key: str) -> Array:
    from measure.scans.opening import open_scan

    try:
        with open_scan(table.path_value(key)) as chip:
            return chip.window(0, 0, chip.width_px, chip.height_px).astype(np.float64)
    except MeasurementError as error:
        raise table.error(key, str(error)) from error


@dataclass(frozen=True, kw_only=True, config=TABLE)
class TemplateTable(PaintedTable):
    """Chip cut from a scan."""

    image: Annotated[Array, Key("path", _image)] = Field(description="The chip.")
    pitch_um: Annotated[float, POSITIVE] = Field(description="Of its pixels.")
    origin_px: Annotated[Point, PAIR] = Field(description="Column and row of the point that is measured.")
    turn_deg: Annotated[float, NUMBER] = Field(default=0.0, description="By which the chip is turned.")
    detail_mm: Annotated[float, NOT_NEGATIVE] = Field(default=0.0, description="Size of its finest detail.")
    learned: Annotated[LearnedPicture | None, subtable(LearnedPicture)] = Field(
        default=None, description="As the program writes it."
    )

    def mark(self, table: Table) -> MarkTemplate:
        if np.ptp(self.image) == 0.0:
            path = table.path_value("image")
            raise table.error(
                "image", f"{path} shows nothing: all its pixels are alike. Cut out the mark with its background."
            )
        template = MarkTemplate(
            self.image,
            self.pitch_um,
            self.origin_px,
            polarity=self.polarity,
            turn_deg=self.turn_deg,
            detail_mm=self.detail_mm,
        )
        return self.learned.applied(template, table.table("learned")) if self.learned else template


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DrawnTable(PaintedTable):
    """Mark drawn by its dimensions."""

    true_mm: Annotated[tuple[Point, Point] | None, Key("[[x, y], [x, y]]", lambda table, key: _true_mm(table))] = Field(
        default=None, description="Corners of the rectangle in which the drawing is true; absent: everywhere."
    )

    def mark(self, table: Table) -> shapes.MarkShape:
        return shapes.MarkShape(self.parts(table), self.polarity, true_mm=self.true_mm)

    @abstractmethod
    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        """Primitive shapes of the mark. table: for messages."""


def _true_mm(table: Table) -> tuple[Point, Point]:
    corners = table.pairs("true_mm")
    if len(corners) != 2 or not np.all(np.less(*corners)):
        corner = "[[least x, least y], [greatest x, greatest y]]"
        raise table.error("true_mm", f"must be two corners of the rectangle in which the drawing is true, {corner}.")
    return corners[0], corners[1]


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DotTable(DrawnTable):
    """Disk."""

    radius_mm: Annotated[float, POSITIVE] = Field(description="Of the disk.")

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.dot(self.radius_mm)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class RingTable(DrawnTable):
    """Mark with a ring."""

    ring_mm: Annotated[float, POSITIVE] = Field(description="Mean radius of the ring.")
    ring_line_mm: Annotated[float, POSITIVE] = Field(description="Width of the ring.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class RingDotTable(RingTable, DotTable):
    """Disk in a ring."""

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.ring_dot(self.ring_mm, self.ring_line_mm, self.radius_mm)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CrossTable(DrawnTable):
    """Cross."""

    arm_mm: Annotated[float, POSITIVE] = Field(description="Half its length.")
    line_mm: Annotated[float, POSITIVE] = Field(description="Width of its bars.")
    gap_mm: Annotated[float, NOT_NEGATIVE] = Field(default=0.0, description="Half the gap in its middle.")
    angle_deg: Annotated[float, NUMBER] = Field(default=0.0, description="0 upright, 45 diagonal.")

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.cross(*self.sizes(table))

    def sizes(self, table: Table) -> tuple[float, float, float, float]:
        """Arm, line width, gap (mm) and angle (deg). table: for messages."""
        if self.gap_mm >= self.arm_mm:
            message = f"must be smaller than arm_mm ({self.arm_mm:g}), not {self.gap_mm:g}: no arm would be left."
            raise table.error("gap_mm", message)
        return self.arm_mm, self.line_mm, self.gap_mm, self.angle_deg


@dataclass(frozen=True, kw_only=True, config=TABLE)
class RingCrossTable(RingTable, CrossTable):
    """Cross in a ring."""

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.ring_cross(self.ring_mm, self.ring_line_mm, *self.sizes(table))


@dataclass(frozen=True, kw_only=True, config=TABLE)
class PolygonTable(DrawnTable):
    """Wedge, notch or wing."""

    vertices_mm: Annotated[tuple[Point, ...], VERTICES] = Field(description="Corners in the order of the outline.")

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.polygon(self.vertices_mm)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class PartsTable(DrawnTable):
    """Combination of disks, rings, bars and polygons."""

    part: Annotated[tuple[shapes.Part, ...], Key("tables", lambda table, key: _parts(table))] = Field(
        description="The simple shapes, one table each."
    )

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return self.part


MARK_TABLES: Mapping[str, type[MarkTable]] = {
    "cross": CrossTable,
    "dot": DotTable,
    "ring-cross": RingCrossTable,
    "ring-dot": RingDotTable,
    "polygon": PolygonTable,
    "parts": PartsTable,
    "template": TemplateTable,
    "learned": LearnedTable,
    "frame-corner": FrameCornerTable,
}


def _parts(table: Table) -> tuple[shapes.Part, ...]:
    parts = tuple(_part(part) for part in table.tables("part"))
    if not parts:
        raise table.error("part", f"a mark of kind 'parts' needs at least one [[{table.place}.part]].")
    return parts


def _part(table: Table) -> shapes.Part:
    shape = table.text("shape", choices=("disk", "ring", "bar", "polygon"))
    part: shapes.Part
    if shape == "disk":
        part = shapes.Disk(table.pair("center_mm", (0.0, 0.0)), table.number("radius_mm", above=0.0))
    elif shape == "ring":
        center, radius = table.pair("center_mm", (0.0, 0.0)), table.number("radius_mm", above=0.0)
        part = shapes.Ring(center, radius, table.number("line_mm", above=0.0))
    elif shape == "bar":
        part = shapes.Bar(table.pair("from_mm"), table.pair("to_mm"), table.number("line_mm", above=0.0))
        if part.from_mm == part.to_mm:
            raise table.error("to_mm", "is the same as from_mm: a bar needs two different ends.")
    else:
        part = shapes.Polygon(_vertices(table, "vertices_mm"))
    table.done()
    return part
