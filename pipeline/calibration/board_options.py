"""Options of the board of `reseau calibrate`, from the command line to project.toml."""

import math
import re
from dataclasses import dataclass
from typing import Literal, get_args

from pipeline.errors import InputError
from pipeline.text.wording import did_you_mean, table_lines

BoardKind = Literal["chessboard", "charuco", "aprilgrid", "aruco", "circle-grid", "asymmetric-circle-grid"]
MOST = 500  # largest number of columns or rows in `[targets]`
KALIBR_SPACING = 0.3  # default gap between the tags of an AprilGrid, in sides of a tag
MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}


@dataclass(frozen=True)
class BoardOptions:
    """Description of a board.

    Attributes
    ----------
    columns, rows : inner corners (chessboard), squares (charuco), markers (aprilgrid, aruco) or circles.
    spacing_mm : side of a square, or distance from one marker or circle to the next; of an asymmetric grid the distance
        of its rows, which is half the distance between two circles of a row.
    size_mm : of a marker or a circle.
    first_id : number of the first marker.
    """

    kind: BoardKind
    columns: int
    rows: int
    spacing_mm: float
    size_mm: float | None = None
    dictionary: str | None = None
    legacy: bool = False
    first_id: int = 0

    def __post_init__(self) -> None:
        """Raise InputError where an option of its kind is missing, before anything is read."""
        assert self.table

    @property
    def table(self) -> str:
        """Text of the table [targets] in project.toml."""
        keys: dict[str, object] = {"kind": self.kind, "columns": self.columns, "rows": self.rows}
        match self.kind:
            case "chessboard":
                keys |= {"square_mm": self.spacing_mm}
            case "charuco":
                keys |= {"square_mm": self.spacing_mm, "marker_mm": self._size, "dictionary": self._dictionary}
                keys |= {"legacy": True} if self.legacy else {}
                keys |= {"first_id": self.first_id}
            case "aruco":
                gap_mm = self.spacing_mm - self._size
                keys |= {"marker_mm": self._size, "gap_mm": gap_mm, "dictionary": self._dictionary}
                keys |= {"first_marker": self.first_id}
            case "aprilgrid":
                marker_mm = self.spacing_mm / (1.0 + KALIBR_SPACING) if self.size_mm is None else self._size
                keys |= {"marker_mm": marker_mm, "spacing": self.spacing_mm / marker_mm - 1.0}
                keys |= {"dictionary": self.dictionary} if self.dictionary else {}
                keys |= {"first_id": self.first_id}
            case "circle-grid" | "asymmetric-circle-grid":
                keys |= {"spacing_mm": self.spacing_mm, "diameter_mm": self._size}
        return "\n".join(["[targets]", *table_lines(keys), ""])

    @property
    def _size(self) -> float:
        if self.size_mm is None:
            what = "the diameter of a circle" if "circle" in self.kind else "the side of a marker"
            raise InputError(f"--marker is missing: {what}, such as --marker 18mm, is needed for {self.kind}.")
        nearest_mm = self.spacing_mm * (math.sqrt(2.0) if self.kind == "asymmetric-circle-grid" else 1.0)
        if not self.size_mm < nearest_mm:
            raise InputError(
                f"--marker {self.size_mm:g} mm is not smaller than the distance from one to the next, {nearest_mm:.4g} "
                f"mm by --square {self.spacing_mm:g} mm. Exchange the two, or measure them again."
            )
        return self.size_mm

    @property
    def _dictionary(self) -> str:
        if self.dictionary is None:
            raise InputError(f"--dictionary is missing: the markers of {self.kind}, such as --dictionary 4X4_50.")
        return self.dictionary


def board_options(
    kind: str,
    board: str,
    square: str,
    marker: str | None = None,
    dictionary: str | None = None,
    legacy: bool = False,
    first_id: int = 0,
) -> BoardOptions:
    """Build the board from command-line options. Raises InputError with the name of the wrong option."""
    kinds: dict[str, BoardKind] = {each: each for each in get_args(BoardKind)}
    if kind not in kinds:
        raise InputError(
            f"--kind {kind}: there is no such board; possible are {', '.join(kinds)}.{did_you_mean(kind, kinds)}"
        )
    counts = re.fullmatch(r"(\d{1,3})[x×*](\d{1,3})", board.strip(), flags=re.IGNORECASE)
    if counts is None or not all(1 <= int(each) <= MOST for each in counts.groups()):
        raise InputError(f"--board {board}: must be two counts of 1 to {MOST}, COLUMNSxROWS, such as 9x6.")
    size_mm = None if marker is None else _length_mm("--marker", marker)
    columns, rows = map(int, counts.groups())
    spacing_mm = _length_mm("--square", square)
    return BoardOptions(kinds[kind], columns, rows, spacing_mm, size_mm, dictionary, legacy, first_id)


def _length_mm(option: str, text: str) -> float:
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m|in)", text.strip())
    if found is None or float(found[1]) == 0.0:
        raise InputError(f"{option} {text}: must be a length with its unit (mm, cm, m, in), such as 25mm.")
    return float(found[1]) * MM[found[2]]
