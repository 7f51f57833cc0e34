"""The tables [targets] and [ties] of project.toml: what is to be measured in addition to the fiducials."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from adjust.functional_model.lens import Prior
from adjust.problem.network import ObjectPoint
from measure.marks.shapes import Polarity
from pipeline.text.table_models import (
    FLAG,
    NOT_NEGATIVE,
    NUMBER,
    PAIR,
    POSITIVE,
    TABLE,
    TEXT,
    Key,
    choice,
    read_model,
    whole,
)
from pipeline.text.tables import Table

if TYPE_CHECKING:
    from measure.boards.specs import BoardSpec
    from measure.targets.ring_codes import RingCode

KINDS = (
    "disk",
    "cross",
    "coded-ring",
    "chessboard",
    "circle-grid",
    "asymmetric-circle-grid",
    "aruco",
    "aprilgrid",
    "charuco",
    "squares",
)

_MOST_OF_A_BOARD = 500  # limit of columns and of rows
POLARITY = choice("auto", "light", "dark")
if TYPE_CHECKING:
    from measure.tie_points.find_points import TieOptions


@dataclasses.dataclass(frozen=True)
class TargetSettings:
    """Description of the targets: single disks or crosses, or a board with corners or dots.

    Attributes
    ----------
    kind : one of KINDS.
    diameter_mm : of disks, also those of a board, in object space; None for corners, and where no eccentricity is
        corrected.
    arm_mm : half the length of a cross in object space.
    cross_line : width of a cross's bars in units of arm_mm; None where the targets are no crosses.
    polarity : whether targets are lighter or darker than their background.
    board : specification of a board.
    code : of the rings around some of the disks.
    numbers : {code number: point}; a number that is not listed is itself the name of its point.
    transparent : whether a flat field is visible from both sides.
    """

    kind: str
    diameter_mm: float | None = None
    arm_mm: float | None = None
    cross_line: float | None = None
    polarity: Polarity = "auto"
    board: "BoardSpec | None" = None
    code: "RingCode | None" = None
    numbers: Mapping[int, str] = dataclasses.field(default_factory=dict)
    transparent: bool = False


@dataclass(frozen=True, kw_only=True, config=TABLE)
class TargetTable:
    """Keys of every table [targets]."""

    kind: Annotated[str, choice(*KINDS)] = Field(description="What the targets are.")
    transparent: Annotated[bool, FLAG] = Field(
        default=False, description="Whether a flat field is visible from both sides."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class SingleTargetTable(TargetTable):
    """Keys of targets that are not part of a board."""

    polarity: Annotated[Polarity, POLARITY] = Field(
        default="auto", description="Whether marks are lighter than their background."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DiskTable(SingleTargetTable):
    """[targets] of disks."""

    diameter_mm: Annotated[float, POSITIVE] = Field(description="In object space, for the eccentricity correction.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CrossTable(SingleTargetTable):
    """[targets] of crosses."""

    arm_mm: Annotated[float, POSITIVE] = Field(description="Half the length of a bar in object space.")
    line_mm: Annotated[float, POSITIVE] = Field(description="Width of the bars in object space.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CodedRingTable(SingleTargetTable):
    """[targets] of dots, some with a ring of coded segments around them."""

    diameter_mm: Annotated[float | None, POSITIVE] = Field(default=None, description="Of the dots, in object space.")
    bits: Annotated[int | None, whole()] = Field(default=None, description="Segments of a ring; absent: 12.")
    ring: Annotated[tuple[float, float] | None, PAIR] = Field(
        default=None, description="Inner and outer radius of the ring in units of the dot's."
    )
    codes: Annotated[object, Key("table of numbers by point", Table.table)] = Field(
        default=None, description="Points with rings and their numbers; absent: a point is named by its number."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class BoardTable(TargetTable):
    """Keys of every board."""

    columns: Annotated[int, whole(1, _MOST_OF_A_BOARD)] = Field(description="Inner corners, squares, dots or markers.")
    rows: Annotated[int, whole(1, _MOST_OF_A_BOARD)] = Field(description="As columns.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ChessboardTable(BoardTable):
    """[targets] of a chessboard."""

    square_mm: Annotated[float, POSITIVE] = Field(description="Side of a square.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CircleGridTable(BoardTable):
    """[targets] of a grid of dots."""

    spacing_mm: Annotated[float, POSITIVE] = Field(description="Between the centres of neighbours in a row.")
    diameter_mm: Annotated[float, POSITIVE] = Field(description="Of a dot.")
    asymmetric: Annotated[bool, FLAG] = Field(default=False, description="Whether every second row is staggered.")
    row_spacing_mm: Annotated[float | None, POSITIVE] = Field(
        default=None, description="Between rows, where it is another."
    )


@dataclass(frozen=True, kw_only=True, config=TABLE)
class SquaresTable(ChessboardTable):
    """[targets] of a grid of single squares."""

    gap_mm: Annotated[float, POSITIVE] = Field(description="Between squares.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class CharucoTable(ChessboardTable):
    """[targets] of a ChArUco board."""

    dictionary: Annotated[str, TEXT] = Field(description='Of the markers, such as "4X4_50".')
    marker_mm: Annotated[float, POSITIVE] = Field(description="Side of a marker.")
    legacy: Annotated[bool | None, FLAG] = Field(default=None, description="The older layout; absent: both are tried.")
    first_id: Annotated[int, whole()] = Field(default=0, description="Number of the first marker.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ArucoTable(BoardTable):
    """[targets] of a grid of ArUco markers."""

    dictionary: Annotated[str, TEXT] = Field(description='Of the markers, such as "4X4_50".')
    marker_mm: Annotated[float, POSITIVE] = Field(description="Side of a marker.")
    gap_mm: Annotated[float, POSITIVE] = Field(description="Between markers.")
    first_marker: Annotated[int, whole()] = Field(default=0, description="Number of the first marker.")


@dataclass(frozen=True, kw_only=True, config=TABLE)
class AprilGridTable(BoardTable):
    """[targets] of Kalibr's grid of AprilTags."""

    marker_mm: Annotated[float, POSITIVE] = Field(description="Side of a tag with its black border.")
    spacing: Annotated[float, POSITIVE] = Field(default=0.3, description="Gap between tags, in their sides.")
    first_id: Annotated[int, whole()] = Field(default=0, description="Number of the tag at the lower left.")
    dictionary: Annotated[str, TEXT] = Field(default="APRILTAG_36h11", description="Of the tags.")


TARGET_TABLES: Mapping[str, type[TargetTable]] = dict(
    zip(
        KINDS,
        (
            DiskTable,
            CrossTable,
            CodedRingTable,
            ChessboardTable,
            CircleGridTable,
            CircleGridTable,
            ArucoTable,
            AprilGridTable,
            CharucoTable,
            SquaresTable,
        ),
        strict=True,
    )
)


def read_targets(table: Table) -> TargetSettings:
    """Read the table. Raises InputError with the key that is wrong."""
    kind = table.text("kind", choices=KINDS)
    given = read_model(table, TARGET_TABLES[kind])
    try:
        return _settings(given, table)
    except ValueError as error:
        raise table.error("kind", f"this {kind} is impossible: {error}.") from None


def _settings(given: TargetTable, table: Table) -> TargetSettings:
    kind, transparent = given.kind, given.transparent
    match given:
        case DiskTable():
            return TargetSettings(kind, given.diameter_mm, polarity=given.polarity, transparent=transparent)
        case CrossTable():
            arm, line = given.arm_mm, given.line_mm
            if line >= arm:
                raise table.error(
                    "line_mm", f"a line of {line:g} mm is no line for arms of {arm:g} mm. Give its width."
                )
            return TargetSettings(
                kind, arm_mm=arm, cross_line=line / arm, polarity=given.polarity, transparent=transparent
            )
        case CodedRingTable():
            from measure.targets.ring_codes import RingCode

            usual = RingCode()
            code = RingCode(usual.bits if given.bits is None else given.bits, given.ring or usual.ring)
            numbers, diameter = _numbers(table, code), given.diameter_mm
            return TargetSettings(
                kind, diameter, polarity=given.polarity, code=code, numbers=numbers, transparent=transparent
            )
    board = _board(given)
    return TargetSettings(kind, getattr(board, "diameter_mm", None), board=board, transparent=transparent)


def _numbers(table: Table, code: "RingCode") -> dict[int, str]:
    """{number as decoded from an image: point} for the numbers in the table."""
    codes = table.table("codes")
    points: dict[int, str] = {}
    for point in codes.names():
        written = codes.whole(point)
        if not 0 < written < 2**code.bits - 1:
            raise codes.error(point, f"{written} is no number of {code.bits} bits with some set and some not.")
        number = code.least_turn(written)
        if number in points:
            raise codes.error(point, f"{written} is, turned, the code of {points[number]} too. Codes are to differ.")
        points[number] = point
    return points


def _board(given: TargetTable) -> "BoardSpec":
    from measure.boards import specs

    match given:
        case CircleGridTable():
            counts_dots = given.kind == "asymmetric-circle-grid"  # dots per row, as in OpenCV; else grid places
            columns, staggered = given.columns * (2 if counts_dots else 1), given.asymmetric or counts_dots
            return specs.CircleGridSpec(
                columns, given.rows, given.spacing_mm, given.diameter_mm, staggered, given.row_spacing_mm
            )
        case SquaresTable():
            return specs.SquareGridSpec(given.columns, given.rows, given.square_mm, given.gap_mm)
        case CharucoTable():
            square, marker, first = given.square_mm, given.marker_mm, given.first_id
            return specs.CharucoSpec(given.dictionary, given.columns, given.rows, square, marker, given.legacy, first)
        case ArucoTable():
            marker, gap, first = given.marker_mm, given.gap_mm, given.first_marker
            return specs.ArucoSpec(given.dictionary, given.columns, given.rows, marker, gap, first)
        case AprilGridTable():
            marker, first = given.marker_mm, given.first_id
            return specs.AprilGridSpec(
                given.dictionary, given.columns, given.rows, marker, given.spacing * marker, first
            )
    assert isinstance(given, ChessboardTable)
    return specs.ChessboardSpec(given.columns, given.rows, given.square_mm)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class TieTable:
    """The table [ties]."""

    wanted: Annotated[int | None, whole()] = Field(default=None, description="Natural points of an image; absent: 300.")
    images: Annotated[int | None, whole()] = Field(
        default=None, description="Images that a point is to be in; absent: 2."
    )
    height: Annotated[float | None, NUMBER] = Field(default=None, description="Of flat ground, object units.")
    height_sigma: Annotated[float | None, NOT_NEGATIVE] = Field(
        default=None, description="Its standard deviation, object units; goes with height."
    )


@dataclasses.dataclass(frozen=True)
class TieSettings:
    """Settings of the natural points. height: of the ground on which they lie, with its standard deviation, object
    units; None if unknown."""

    options: "TieOptions"
    height: Prior | None = None

    def point(self, id: str) -> ObjectPoint:
        """Natural point as an object point: unknown except for its height, where that is given."""
        return ObjectPoint(id, None, None, self.height)


def read_ties(table: Table) -> TieSettings:
    """Read the table. Raises InputError with the key that is wrong."""
    from measure.tie_points.find_points import TieOptions

    given, usual = read_model(table, TieTable), TieOptions()
    try:
        options = TieOptions(
            usual.wanted if given.wanted is None else given.wanted,
            usual.images if given.images is None else given.images,
        )
    except ValueError as error:
        raise table.error("wanted", f"these natural points are impossible: {error}.") from None
    height = None
    if given.height is not None or given.height_sigma is not None:
        height = Prior(table.number("height"), table.number("height_sigma", least=0.0))
    return TieSettings(options, height)
