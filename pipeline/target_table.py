"""The table [targets] of project.toml: what is to be measured beside the fiducials."""

from dataclasses import dataclass
from typing import cast

from measure.board_specs import ArucoSpec, BoardSpec, CharucoSpec, ChessboardSpec, CircleGridSpec
from measure.shapes import Polarity
from pipeline.tables import Table

KINDS = ("disk", "chessboard", "circle-grid", "aruco", "charuco")
NOT_YET = ("cross", "coded-ring")


@dataclass(frozen=True)
class TargetSettings:
    """What the targets are: single disks, or a board whose corners or dots have their places on it.

    diameter_mm: of the disks, also those of a board, in object space; None for corners.
    """

    kind: str
    diameter_mm: float | None = None
    polarity: Polarity = "auto"
    board: BoardSpec | None = None


def read_targets(table: Table) -> TargetSettings:
    """Read the table. Raises InputError naming the key that is wrong."""
    kind = table.text("kind")
    if kind in NOT_YET:
        raise table.error("kind", f"{kind} targets cannot be measured yet. Give their comparator.csv instead.")
    kind = table.text("kind", choices=KINDS)
    if kind == "disk":
        settings = TargetSettings(kind, table.number("diameter_mm", above=0.0), _polarity(table))
    else:
        try:
            board = _board(kind, table)
        except ValueError as error:
            raise table.error("kind", f"this {kind} is impossible: {error}.") from None
        diameter = board.diameter_mm if isinstance(board, CircleGridSpec) else None
        settings = TargetSettings(kind, diameter, board=board)
    table.done()
    return settings


def _polarity(table: Table) -> Polarity:
    return cast(Polarity, table.text("polarity", "auto", ("auto", "light", "dark")))


def _board(kind: str, table: Table) -> BoardSpec:
    columns, rows = table.whole("columns", least=1), table.whole("rows", least=1)
    if kind == "chessboard":
        return ChessboardSpec(columns, rows, table.number("square_mm", above=0.0))
    if kind == "circle-grid":
        spacing, diameter = table.number("spacing_mm", above=0.0), table.number("diameter_mm", above=0.0)
        row_spacing = table.number("row_spacing_mm", above=0.0) if "row_spacing_mm" in table else None
        return CircleGridSpec(columns, rows, spacing, diameter, table.flag("asymmetric", False), row_spacing)
    dictionary, marker = table.text("dictionary"), table.number("marker_mm", above=0.0)
    if kind == "charuco":
        return CharucoSpec(dictionary, columns, rows, table.number("square_mm", above=0.0), marker)
    first = table.whole("first_marker", 0)
    return ArucoSpec(dictionary, columns, rows, marker, table.number("gap_mm", above=0.0), first)
