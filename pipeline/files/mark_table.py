"""Fiducial marks in a camera file: drawn marks, templates with their images, and learned marks."""

import dataclasses
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.geometry import POSES
from measure.marks import shapes
from measure.marks.shapes import MarkTemplate, Point
from pipeline.text import table_models as models
from pipeline.text.files import FORMS, check_replaceable, write_atomically
from pipeline.text.toml_tables import Table
from pipeline.types import Array

Picture = NDArray[np.uint16]
SavePicture = Callable[[str, Picture], str]
Drawing = tuple[shapes.Mark | shapes.LearnedMark, bool]
MarkJson = Mapping[str, Any]  # content of a table [mark.NAME]

_FULL = 65535
_DECIMALS = 4  # of values in mm: 0.1 µm
_ANY_CORNER = (-1.0, -1.0)  # placeholder: the fiducial's place determines the quadrant


def _vertices(value: Any) -> tuple[Point, ...]:
    vertices = models.points(value)
    if len(vertices) < 3:
        raise ValueError(f"a polygon needs at least three vertices, not {len(vertices)}.")
    x, y = np.transpose(vertices)
    if np.isclose(x @ np.roll(y, 1), y @ np.roll(x, 1), rtol=1e-9, atol=0.0):
        raise ValueError("the polygon encloses no area. Give its corners in the order of its outline.")
    return vertices


def _true_mm(value: Any) -> tuple[Point, ...]:
    corners = models.points(value)
    if len(corners) != 2 or not np.all(np.less(*corners)):
        corner = "[[least x, least y], [greatest x, greatest y]]"
        raise ValueError(f"must be two corners of the rectangle in which the drawing is true, {corner}.")
    return corners


Vertices = Annotated[tuple[Point, ...], models.Key("list of [x, y]", _vertices), "Corners in the order of the outline."]


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


@models.table_model
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

    scan: str
    sha256: str
    pose: Annotated[str, models.choice(*POSES)]
    clicked: bool = False
    alike: tuple[str, ...] = ()


def picture_writer(folder: Path, prefix: str = "") -> SavePicture:
    """Function that stores images in a folder, under names that begin with the prefix."""

    def save(name: str, picture: Picture) -> str:
        file = f"{prefix}{name}.tif"
        check_replaceable(folder / file, FORMS[".tif"], "give the camera file another name")
        write_atomically(folder / file, picture_file(picture))
        return file

    return save


def picture_file(picture: Picture) -> bytes:
    """Image as the content of the TIFF file that `picture_writer` stores."""
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(file, picture, metadata=None, software="reseau")
    return file.getvalue()


def template_values(template: MarkTemplate, name: str, save: SavePicture) -> dict[str, Any]:
    """Content of the table [mark.NAME]. save(name, picture) stores an image and returns its path there."""
    least, range_dn = float(template.image.min()), float(np.ptp(template.image))
    values: dict[str, Any] = {
        "kind": "template",
        "image": save(name, _picture((template.image - least) / (range_dn or 1.0))),
        "pitch_um": template.pitch_um,
        "origin_px": list(map(float, template.origin_px)),
        "polarity": template.polarity,
        "detail_mm": template.detail_mm,
        "turn_deg": template.turn_deg or None,
    }
    if template.learned_mm:
        pictures = {"steadiness": template.steadiness, "steady": template.steady}
        values["learned"] = {
            "size_mm": template.learned_mm,
            "alike": template.alike or None,
            "range_dn": range_dn,
            "noise_dn": template.noise_dn,
            "slope_noise_dn": template.slope_noise_dn,
            **{key: save(f"{name}-{key}", _picture(each)) for key, each in pictures.items() if each is not None},
            "shares": dict(template.shares),
        }
    return values


def _picture(shares: NDArray[np.float64] | NDArray[np.bool_]) -> Picture:
    """16-bit image of values between 0 and 1."""
    return np.asarray(np.rint(np.asarray(shares, float) * _FULL), np.uint16)


def read_marks(table: Table) -> dict[str, Drawing]:
    """Read all drawn marks by name, and whether they are rotated with their places. Raises InputError with the key that
    is wrong."""
    marks = {}
    for name in table.values:
        entry = table.table(name)
        given = models.read_kind(entry, MARK_TABLES)
        marks[name] = given.mark(entry), given.rotate == "radial"
    return marks


@models.table_model
class MarkTable(ABC):
    """Keys of every table [mark.NAME]."""

    kind: Annotated[str, "Shape of the mark."]
    rotate: Annotated[Literal["none", "radial"], "radial: drawn as on the positive x axis, turned with its place."] = (
        "none"
    )

    @abstractmethod
    def mark(self, table: Table) -> shapes.Mark | shapes.LearnedMark:
        """Mark of the table. table: for messages."""


@models.table_model
class LearnedTable(MarkTable):
    """Mark to be learned from the scans."""

    size_mm: Annotated[models.Positive, "Width of the template."]

    def mark(self, table: Table) -> shapes.LearnedMark:
        return shapes.LearnedMark(self.size_mm)


@models.table_model
class PaintedTable(MarkTable):
    """Mark that is lighter or darker than its background."""

    polarity: Annotated[shapes.Polarity, "Whether the mark is lighter than its background."] = "auto"


@models.table_model
class FrameCornerTable(PaintedTable):
    """Corner of the exposed frame."""

    reach_mm: Annotated[models.NotNegative, "How far along its edges it is measured; 0: a sixth of half the frame."] = (
        0.0
    )
    radius_mm: Annotated[models.NotNegative, "Of a rounded corner."] = 0.0

    def mark(self, table: Table) -> shapes.Mark:
        if self.radius_mm and self.reach_mm and self.radius_mm >= self.reach_mm:
            raise table.error(
                "radius_mm", f"must be smaller than reach_mm ({self.reach_mm:g}), not {self.radius_mm:g}."
            )
        return shapes.frame_corner(_ANY_CORNER, self.reach_mm, self.radius_mm, self.polarity)


@models.table_model
class LearnedPicture:
    """[mark.NAME.learned]: properties of a template estimated from scans, as the program writes them. A manually cut
    chip has none."""

    size_mm: models.Positive
    range_dn: models.Positive
    noise_dn: models.NotNegative
    slope_noise_dn: models.NotNegative = 0.0
    alike: tuple[str, ...] = ()
    steadiness: models.FilePath | None = None
    steady: models.FilePath | None = None
    shares: Mapping[str, models.Positive] = dataclasses.field(default_factory=dict)

    def apply_to(self, template: MarkTemplate, table: Table) -> MarkTemplate:
        """Template with its learned properties."""
        pictures = {key: _image(table, key) / _FULL if key in table else None for key in ("steadiness", "steady")}
        for key, values in pictures.items():
            if values is not None and values.shape != template.image.shape:
                px = template.image.shape[::-1]
                raise table.error(key, f"is a picture of {values.shape[::-1]} px, and the template has {px}.")
        steady = pictures["steady"]
        return replace(
            template,
            image=template.image * (self.range_dn / float(np.ptp(template.image))),
            noise_dn=self.noise_dn,
            slope_noise_dn=self.slope_noise_dn,
            shares=self.shares,
            steadiness=pictures["steadiness"],
            steady=None if steady is None else steady > 0.5,
            learned_mm=self.size_mm,
            alike=self.alike,
        )


def _image(table: Table, key: str) -> Array:
    from measure.scans.opening import open_scan

    try:
        with open_scan(table.file.parent / table.values[key]) as chip:
            return chip.window(0, 0, chip.width_px, chip.height_px).astype(np.float64)
    except MeasurementError as error:
        raise table.error(key, str(error)) from error


@models.table_model
class TemplateTable(PaintedTable):
    """Chip cut from a scan."""

    image: Annotated[models.FilePath, "The chip."]
    pitch_um: Annotated[models.Positive, "Of its pixels."]
    origin_px: Annotated[Point, "Column and row of the point that is measured."]
    turn_deg: Annotated[float, "By which the chip is turned."] = 0.0
    detail_mm: Annotated[models.NotNegative, "Size of its finest detail."] = 0.0
    learned: Annotated[LearnedPicture | None, "As the program writes it."] = None

    def mark(self, table: Table) -> MarkTemplate:
        image = _image(table, "image")
        if np.ptp(image) == 0.0:
            path = table.file.parent / self.image
            raise table.error(
                "image", f"{path} shows nothing: all its pixels are alike. Cut out the mark with its background."
            )
        template = MarkTemplate(
            image,
            self.pitch_um,
            self.origin_px,
            polarity=self.polarity,
            turn_deg=self.turn_deg,
            detail_mm=self.detail_mm,
        )
        return self.learned.apply_to(template, table.table("learned")) if self.learned else template


@models.table_model
class DrawnTable(PaintedTable):
    """Mark drawn by its dimensions."""

    true_mm: Annotated[
        tuple[Point, Point] | None,
        models.Key("[[x, y], [x, y]]", _true_mm),
        "Corners of the rectangle in which the drawing is true; absent: everywhere.",
    ] = None

    def mark(self, table: Table) -> shapes.MarkShape:
        return shapes.MarkShape(self.parts(table), self.polarity, true_mm=self.true_mm)

    @abstractmethod
    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        """Primitive shapes of the mark. table: for messages."""


@models.table_model
class DotTable(DrawnTable):
    """Disk."""

    radius_mm: Annotated[models.Positive, "Of the disk."]

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.dot(self.radius_mm)


@models.table_model
class RingTable(DrawnTable):
    """Mark with a ring."""

    ring_mm: Annotated[models.Positive, "Mean radius of the ring."]
    ring_line_mm: Annotated[models.Positive, "Width of the ring."]


@models.table_model
class RingDotTable(RingTable, DotTable):
    """Disk in a ring."""

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.ring_dot(self.ring_mm, self.ring_line_mm, self.radius_mm)


@models.table_model
class CrossTable(DrawnTable):
    """Cross."""

    arm_mm: Annotated[models.Positive, "Half its length."]
    line_mm: Annotated[models.Positive, "Width of its bars."]
    gap_mm: Annotated[models.NotNegative, "Half the gap in its middle."] = 0.0
    angle_deg: Annotated[float, "0 upright, 45 diagonal."] = 0.0

    def __post_init__(self) -> None:
        """Raises WrongKey for a gap that leaves no arm."""
        if self.gap_mm >= self.arm_mm:
            message = f"must be smaller than arm_mm ({self.arm_mm:g}), not {self.gap_mm:g}: no arm would be left."
            raise models.WrongKey("gap_mm", message)

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.cross(self.arm_mm, self.line_mm, self.gap_mm, self.angle_deg)


@models.table_model
class RingCrossTable(RingTable, CrossTable):
    """Cross in a ring."""

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        sizes = self.arm_mm, self.line_mm, self.gap_mm, self.angle_deg
        return shapes.ring_cross(self.ring_mm, self.ring_line_mm, *sizes)


@models.table_model
class PolygonTable(DrawnTable):
    """Wedge, notch or wing."""

    vertices_mm: Vertices

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        return shapes.polygon(self.vertices_mm)


@models.table_model
class PartsTable(DrawnTable):
    """Combination of disks, rings, bars and polygons."""

    part: Annotated[models.Entries, "The simple shapes, one table each."]

    def parts(self, table: Table) -> tuple[shapes.Part, ...]:
        if not self.part:
            raise table.error("part", f"a mark of kind 'parts' needs at least one [[{table.place}.part]].")
        parts = []
        for entry in table.tables("part"):
            given: Any = models.read_kind(entry, _PARTS, "shape")
            plain: type[shapes.Part] = type(given).__bases__[0]  # the class of `shapes` that the model is derived from
            parts.append(plain(**{field.name: getattr(given, field.name) for field in dataclasses.fields(plain)}))
        return tuple(parts)


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


@models.table_model
class _Disk(shapes.Disk):
    shape: str
    radius_mm: models.Positive
    center_mm: Point = (0.0, 0.0)


@models.table_model
class _Ring(shapes.Ring):
    shape: str
    radius_mm: models.Positive
    line_mm: models.Positive
    center_mm: Point = (0.0, 0.0)


@models.table_model
class _Bar(shapes.Bar):
    shape: str
    line_mm: models.Positive

    def __post_init__(self) -> None:
        if self.from_mm == self.to_mm:
            raise models.WrongKey("to_mm", "is the same as from_mm: a bar needs two different ends.")


@models.table_model
class _Polygon(shapes.Polygon):
    shape: str
    vertices_mm: Vertices


_PARTS = {"disk": _Disk, "ring": _Ring, "bar": _Bar, "polygon": _Polygon}


def scaled_mark(mark: MarkJson, factor: float = 1.0) -> MarkJson:
    """Scale all lengths of a mark by a factor, and round its numbers to 0.1 µm."""

    def scaled(key: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: scaled(name, one) for name, one in value.items()}
        if isinstance(value, list):
            return [scaled(key, one) for one in value]
        if isinstance(value, float | int):
            return round(float(value) * (factor if key.endswith("_mm") else 1.0), _DECIMALS)
        return value

    return {key: scaled(key, value) for key, value in mark.items()}
