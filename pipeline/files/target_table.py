"""The tables [targets] and [ties] of project.toml: what is to be measured apart from the fiducials."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

from adjust.functional_model.lens import Prior
from adjust.problem.network import ObjectPoint
from measure.marks.shapes import Polarity
from pipeline.text.tables import Table

if TYPE_CHECKING:
    from measure.boards.specs import BoardSpec
    from measure.targets.ring_codes import RingCode

KINDS = ("disk", "cross", "coded-ring", "chessboard", "circle-grid", "aruco", "charuco", "squares")

_MOST_OF_A_BOARD = 500  # columns, and rows
if TYPE_CHECKING:
    from measure.tie_points.find_points import TieOptions


@dataclass(frozen=True)
class TargetSettings:
    """What the targets are: single disks or crosses, or a board whose corners or dots have their places on it.

    diameter_mm: of the disks, also those of a board, in object space; None for corners, and where nothing is to be
    corrected. arm_mm: half the length of a cross in object space; cross_line: the width of its bars in that unit, None
    where the targets are no crosses. code: the ring about some of the disks; numbers: the point that each number of
    that code is, those of numbers that are not named here having the number as their name.
    """

    kind: str
    diameter_mm: float | None = None
    arm_mm: float | None = None
    cross_line: float | None = None
    polarity: Polarity = "auto"
    board: "BoardSpec | None" = None
    code: "RingCode | None" = None
    numbers: Mapping[int, str] = field(default_factory=dict)
    transparent: bool = False


def read_targets(table: Table) -> TargetSettings:
    """Read the table. Raises InputError naming the key that is wrong."""
    kind = table.text("kind", choices=KINDS)
    if kind == "disk":
        settings = TargetSettings(kind, table.number("diameter_mm", above=0.0), polarity=_polarity(table))
    elif kind == "cross":
        settings = _crosses(table)
    elif kind == "coded-ring":
        settings = _coded(table)
    else:
        try:
            board = _board(kind, table)
        except ValueError as error:
            raise table.error("kind", f"this {kind} is impossible: {error}.") from None
        diameter = getattr(board, "diameter_mm", None)
        settings = TargetSettings(kind, diameter, board=board)
    settings = replace(settings, transparent=table.flag("transparent", False))
    table.done()
    return settings


def _crosses(table: Table) -> TargetSettings:
    arm, line = table.number("arm_mm", above=0.0), table.number("line_mm", above=0.0)
    if line >= arm:
        raise table.error("line_mm", f"a line of {line:g} mm is no line for arms of {arm:g} mm. Give its width.")
    return TargetSettings("cross", arm_mm=arm, cross_line=line / arm, polarity=_polarity(table))


def _coded(table: Table) -> TargetSettings:
    from measure.targets.ring_codes import RingCode

    default = RingCode()
    diameter = table.number("diameter_mm", above=0.0) if "diameter_mm" in table else None
    bits = table.whole("bits", default.bits)
    try:
        code = RingCode(bits, table.pair("ring", default.ring))
    except ValueError as error:
        raise table.error("kind", f"this coded-ring is impossible: {error}.") from None
    return TargetSettings("coded-ring", diameter, polarity=_polarity(table), code=code, numbers=_numbers(table, code))


def _numbers(table: Table, code: "RingCode") -> dict[int, str]:
    """The point of each number that the table names, the number as it is read from a picture."""
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


def _polarity(table: Table) -> Polarity:
    return cast(Polarity, table.text("polarity", "auto", ("auto", "light", "dark")))


def _board(kind: str, table: Table) -> "BoardSpec":
    from measure.boards.specs import (
        ArucoSpec,
        CharucoSpec,
        ChessboardSpec,
        CircleGridSpec,
        SquareGridSpec,
    )

    columns, rows = (table.whole(key, least=1, most=_MOST_OF_A_BOARD) for key in ("columns", "rows"))
    if kind == "chessboard":
        return ChessboardSpec(columns, rows, table.number("square_mm", above=0.0))
    if kind == "circle-grid":
        spacing, diameter = table.number("spacing_mm", above=0.0), table.number("diameter_mm", above=0.0)
        row_spacing = table.number("row_spacing_mm", above=0.0) if "row_spacing_mm" in table else None
        return CircleGridSpec(columns, rows, spacing, diameter, table.flag("asymmetric", False), row_spacing)
    if kind == "squares":
        return SquareGridSpec(columns, rows, table.number("square_mm", above=0.0), table.number("gap_mm", above=0.0))
    dictionary, marker = table.text("dictionary"), table.number("marker_mm", above=0.0)
    if kind == "charuco":
        square = table.number("square_mm", above=0.0)
        legacy = table.flag("legacy", False) if "legacy" in table else None
        return CharucoSpec(dictionary, columns, rows, square, marker, legacy, table.whole("first_id", 0))
    first = table.whole("first_marker", 0)
    return ArucoSpec(dictionary, columns, rows, marker, table.number("gap_mm", above=0.0), first)


@dataclass(frozen=True)
class TieSettings:
    """height: of the ground on which the natural points lie, object units, with its standard deviation; None where it
    is not known."""

    options: "TieOptions"
    height: Prior | None = None

    def point(self, id: str) -> ObjectPoint:
        """A natural point as an object point: unknown but for its height, where that is given."""
        return ObjectPoint(id, None, None, self.height)


def read_ties(table: Table) -> TieSettings:
    """Read the table. Raises InputError naming the key that is wrong."""
    from measure.tie_points.find_points import TieOptions

    usual = TieOptions()
    wanted, images = table.whole("wanted", usual.wanted), table.whole("images", usual.images)
    try:
        options = TieOptions(wanted, images)
    except ValueError as error:
        raise table.error("wanted", f"these natural points are impossible: {error}.") from None
    height = None
    if "height" in table or "height_sigma" in table:
        height = Prior(table.number("height"), table.number("height_sigma", least=0.0))
    table.done()
    return TieSettings(options, height)
