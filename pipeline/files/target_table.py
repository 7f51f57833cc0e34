"""The tables [targets] and [ties] of project.toml: what is to be measured in addition to the fiducials."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from measure.boards import specs
from measure.boards.specs import BoardSpec
from measure.marks.shapes import Polarity
from measure.targets.ring_codes import RingCode
from measure.tie_points.find_points import TieOptions
from pipeline.text.table_models import NotNegative, Positive, WrongKey, read_kind, table_model, whole
from pipeline.text.toml_tables import Table

_MOST_OF_A_BOARD = 500  # limit of columns and of rows
_Count = Annotated[int, whole(1, _MOST_OF_A_BOARD)]


@dataclasses.dataclass(frozen=True)
class TargetSettings:
    """Description of the targets: single disks or crosses, or a board with corners or dots.

    Attributes
    ----------
    kind : one of TARGET_TABLES.
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
    board: BoardSpec | None = None
    code: RingCode | None = None
    numbers: Mapping[int, str] = dataclasses.field(default_factory=dict)
    transparent: bool = False


@table_model
class TargetTable:
    """Keys of every table [targets]."""

    kind: Annotated[str, "What the targets are."]
    transparent: Annotated[bool, "Whether a flat field is visible from both sides."] = False

    def settings(self, table: Table) -> TargetSettings:
        """Settings of the targets, by the names of the keys. table: for messages. Raises ValueError where they are
        impossible."""
        names = (field.name for field in dataclasses.fields(TargetSettings))
        return TargetSettings(**{name: getattr(self, name) for name in names if hasattr(self, name)})


@table_model
class SingleTargetTable(TargetTable):
    """Keys of targets that are not part of a board."""

    polarity: Annotated[Polarity, "Whether marks are lighter than their background."] = "auto"


@table_model
class DiskTable(SingleTargetTable):
    """[targets] of disks."""

    diameter_mm: Annotated[Positive, "In object space, for the eccentricity correction."]


@table_model
class CrossTargetTable(SingleTargetTable):
    """[targets] of crosses."""

    arm_mm: Annotated[Positive, "Half the length of a bar in object space."]
    line_mm: Annotated[Positive, "Width of the bars in object space."]

    def settings(self, table: Table) -> TargetSettings:
        arm, line = self.arm_mm, self.line_mm
        if line >= arm:
            raise table.error("line_mm", f"a line of {line:g} mm is no line for arms of {arm:g} mm. Give its width.")
        return dataclasses.replace(super().settings(table), cross_line=line / arm)


@table_model
class CodedRingTable(SingleTargetTable):
    """[targets] of dots, some with a ring of coded segments around them."""

    diameter_mm: Annotated[Positive | None, "Of the dots, in object space."] = None
    bits: Annotated[int | None, "Segments of a ring; absent: 12."] = None
    ring: Annotated[tuple[float, float] | None, "Inner and outer radius of the ring in units of the dot's."] = None
    codes: Annotated[
        Mapping[str, int], "Points with rings and their numbers; absent: a point is named by its number."
    ] = dataclasses.field(default_factory=dict)

    def settings(self, table: Table) -> TargetSettings:
        usual = RingCode()
        code = RingCode(usual.bits if self.bits is None else self.bits, self.ring or usual.ring)
        codes, numbers = table.table("codes"), dict[int, str]()  # by the number as decoded from an image
        for point, written in self.codes.items():
            if not 0 < written < 2**code.bits - 1:
                raise codes.error(point, f"{written} is no number of {code.bits} bits with some set and some not.")
            number = code.least_turn(written)
            if number in numbers:
                raise codes.error(
                    point, f"{written} is, turned, the code of {numbers[number]} too. Codes are to differ."
                )
            numbers[number] = point
        return dataclasses.replace(super().settings(table), code=code, numbers=numbers)


@table_model
class BoardTable(TargetTable):
    """Keys of every board; the other keys are those of its specification."""

    spec: ClassVar[type[BoardSpec]]
    columns: Annotated[_Count, "Inner corners, squares, dots or markers."]
    rows: Annotated[_Count, "As columns."]

    @property
    def board(self) -> BoardSpec:
        """Specification of the board. Raises ValueError where it is impossible."""
        keys: dict[str, Any] = {field.name: getattr(self, field.name) for field in dataclasses.fields(self.spec)}
        return self.spec(**keys)


@table_model
class ChessboardTable(BoardTable):
    """[targets] of a chessboard."""

    spec: ClassVar[type[BoardSpec]] = specs.ChessboardSpec
    square_mm: Annotated[Positive, "Side of a square."]


@table_model
class CircleGridTable(BoardTable):
    """[targets] of a grid of dots."""

    spacing_mm: Annotated[Positive, "Between the centres of neighbours in a row."]
    diameter_mm: Annotated[Positive, "Of a dot."]
    asymmetric: Annotated[bool, "Whether every second row is staggered."] = False
    row_spacing_mm: Annotated[Positive | None, "Between rows, where it is another."] = None

    @property
    def board(self) -> BoardSpec:
        counts_dots = self.kind == "asymmetric-circle-grid"  # dots per row, as in OpenCV; else grid places
        columns, staggered = self.columns * (2 if counts_dots else 1), self.asymmetric or counts_dots
        sizes_mm = self.spacing_mm, self.diameter_mm
        return specs.CircleGridSpec(columns, self.rows, *sizes_mm, staggered, self.row_spacing_mm)


@table_model
class SquaresTable(ChessboardTable):
    """[targets] of a grid of single squares."""

    spec = specs.SquareGridSpec
    gap_mm: Annotated[Positive, "Between squares."]


@table_model
class CharucoTable(ChessboardTable):
    """[targets] of a ChArUco board."""

    spec = specs.CharucoSpec
    dictionary: Annotated[str, 'Of the markers, such as "4X4_50".']
    marker_mm: Annotated[Positive, "Side of a marker."]
    legacy: Annotated[bool | None, "The older layout; absent: both are tried."] = None
    first_id: Annotated[int, "Number of the first marker."] = 0


@table_model
class ArucoTable(BoardTable):
    """[targets] of a grid of ArUco markers."""

    spec = specs.ArucoSpec
    dictionary: Annotated[str, 'Of the markers, such as "4X4_50".']
    marker_mm: Annotated[Positive, "Side of a marker."]
    gap_mm: Annotated[Positive, "Between markers."]
    first_marker: Annotated[int, "Number of the first marker."] = 0


@table_model
class AprilGridTable(BoardTable):
    """[targets] of Kalibr's grid of AprilTags."""

    marker_mm: Annotated[Positive, "Side of a tag with its black border."]
    spacing: Annotated[Positive, "Gap between tags, in their sides."] = 0.3
    first_id: Annotated[int, "Number of the tag at the lower left."] = 0
    dictionary: Annotated[str, "Of the tags."] = "APRILTAG_36h11"

    @property
    def board(self) -> BoardSpec:
        size = self.columns, self.rows, self.marker_mm, self.spacing * self.marker_mm
        return specs.AprilGridSpec(self.dictionary, *size, self.first_id)


TARGET_TABLES: Mapping[str, type[TargetTable]] = {
    "disk": DiskTable,
    "cross": CrossTargetTable,
    "coded-ring": CodedRingTable,
    "chessboard": ChessboardTable,
    "circle-grid": CircleGridTable,
    "asymmetric-circle-grid": CircleGridTable,
    "aruco": ArucoTable,
    "aprilgrid": AprilGridTable,
    "charuco": CharucoTable,
    "squares": SquaresTable,
}


def read_targets(table: Table) -> TargetSettings:
    """Read the table. Raises InputError with the key that is wrong."""
    given = read_kind(table, TARGET_TABLES)
    try:
        return given.settings(table)
    except ValueError as error:
        raise table.error("kind", f"this {given.kind} is impossible: {error}.") from None


@table_model
class TieSettings:
    """The table [ties]."""

    wanted: Annotated[int | None, whole(1), "Natural points in all; absent: 300."] = None
    images: Annotated[
        int | None,
        whole(3),
        "Scans that must show a point; absent: 3. Two rays cannot contradict each other along the epipolar line.",
    ] = None
    height: Annotated[float | None, "Of flat ground, object units."] = None
    height_sigma: Annotated[NotNegative | None, "Its standard deviation, object units; goes with height."] = None

    def __post_init__(self) -> None:
        """Raises WrongKey for a height without its standard deviation, or the reverse."""
        for key, other in (("height", "height_sigma"), ("height_sigma", "height")):
            if getattr(self, key) is None and getattr(self, other) is not None:
                raise WrongKey(key, "is missing. Add it.")

    @property
    def options(self) -> TieOptions:
        given = {"wanted": self.wanted, "images": self.images}
        return TieOptions(**{key: value for key, value in given.items() if value is not None})
