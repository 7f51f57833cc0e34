"""CSV files with a header line and checked columns; lines that begin with # are comments.

A cell that a spreadsheet would evaluate as a formula is written with a leading apostrophe, which is removed in reading.
"""

import csv
import math
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import InputError
from pipeline.text import files
from pipeline.text.wording import did_you_mean

SEPARATORS = {";": "semicolons", "\t": "tabs"}

_LONGEST_NAME = 1000
_NO_UTF_8 = "{}: is not text in UTF-8. Save it as such: in a spreadsheet as CSV UTF-8, separated by commas."
_FORMULA = re.compile(r"'*[=+\-@]")
_NO_FORMULA = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|-")  # a number, or a dash for none
_TAKEN_FOR_TEXT = re.compile(r"'+[=+\-@]")


@dataclass(frozen=True)
class Row:
    """Row of a CSV file, with file and line for messages."""

    file: Path
    line: int
    cells: dict[str, str]

    def error(self, column: str, message: str) -> InputError:
        return InputError(f"{self.file}, line {self.line}, column {column}: {message}")

    def text(self, column: str) -> str:
        """Cell without surrounding blanks; "" if the column is absent."""
        return self.cells.get(column, "")

    def name(self, column: str) -> str:
        """Cell as a name: not empty, not too long, and printable. Raises InputError otherwise."""
        value = self.text(column)
        if not value:
            raise self.error(column, "is empty; every line needs it.")
        if len(value) > _LONGEST_NAME or any(unicodedata.category(letter) in ("Cc", "Cs") for letter in value):
            raise self.error(
                column, f"{files.quote_value(value)} is not a valid name: at most {_LONGEST_NAME} printable characters."
            )
        return value

    def number(self, column: str) -> float | None:
        """Cell as a finite number; None if it is blank or the column absent. Raises InputError otherwise."""
        value = self.text(column)
        if not value:
            return None
        try:
            number = float(value.replace("_", " ").replace("\N{MINUS SIGN}", "-"))  # float() reads 1_5 as 15
        except ValueError:
            raise self.error(
                column, f"must be a number with a decimal point or blank, not {files.quote_value(value)}."
            ) from None
        if not math.isfinite(number):
            raise self.error(column, f"must be a finite number or blank, not {files.quote_value(value)}.")
        if abs(number) > files.LARGEST:
            raise self.error(
                column, f"{files.quote_value(value)} is larger than anything that is measured. Correct it."
            )
        return number

    def sigma(self, column: str, remedy: str = "Write 0 to fix the value.") -> float | None:
        """Cell as a standard deviation, 0 or positive; None if it is blank. Raises InputError otherwise.

        remedy: for one that is too small.
        """
        sigma = self.number(column)
        if sigma is not None and sigma < 0.0:
            raise self.error(column, f"is a standard deviation and cannot be negative ({sigma:g}).")
        if sigma is not None and 0.0 < sigma < files.SMALLEST_SIGMA:
            raise self.error(column, f"a standard deviation of {sigma:g} is too small. {remedy}")
        return sigma


def csv_line(cells: Sequence[str]) -> str:
    """Format cells as a line of CSV without line end, which `read_csv` reads back unchanged. Cells are quoted if
    necessary, also if the line would otherwise be a comment."""
    written = []
    for cell in cells:
        text = f"'{cell}" if _FORMULA.match(cell) and not _NO_FORMULA.fullmatch(cell) else cell
        needs_quotes = text.startswith("#") or any(letter in text for letter in ',"\r\n')
        written.append('"' + text.replace('"', '""') + '"' if needs_quotes else text)
    return ",".join(written)


def read_csv(
    path: files.FilePath, required: Sequence[str], optional: Sequence[str] = (), most_mb: int = files.MOST_MB
) -> Iterator[Row]:
    """Yield the rows of a CSV file. Raises InputError for a missing file, a missing or unknown column, or an incomplete
    line."""
    path = Path(path)
    try:
        lines = enumerate(files.split_lines(files.read_bytes(path, most_mb).decode("utf-8-sig")), 1)
    except FileNotFoundError:
        raise InputError(files.no_such_file(path)) from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a CSV file is needed here. Name one.") from None
    except UnicodeDecodeError:
        raise InputError(_NO_UTF_8.format(path)) from None
    header: list[str] = []
    for number, text in lines:
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        if not header and "\0" in text:  # as of UTF-16 without its mark
            raise InputError(_NO_UTF_8.format(path))
        cells = _cells(path, number, text)
        if not header:
            header = cells
            _check_header(path, number, header, required, optional)
            continue
        if len(cells) > len(header) and any(cells[len(header) :]):
            raise InputError(
                f"{path}, line {number}: has {len(cells)} values, but the header names {len(header)} columns. "
                "Decimal commas must be points; text with a comma stands in quotes."
            )
        if len(cells) < len(header):
            raise InputError(
                f"{path}, line {number}: is cut short: it has {len(cells)} of the {len(header)} values that the header "
                "names. Complete it; a value that is not given is left blank between its commas."
            )
        yield Row(path, number, dict(zip(header, cells, strict=False)))
    if not header:
        raise InputError(f"{path}: is empty; its first line must name the columns: {','.join(required)}.")


def _cells(path: Path, line: int, text: str) -> list[str]:
    try:
        cells = map(str.strip, next(csv.reader([text])))
        return [cell[1:] if _TAKEN_FOR_TEXT.match(cell) else cell for cell in cells]
    except csv.Error as error:
        raise InputError(f"{path}, line {line}: is no line of CSV ({error}). Mend it.") from None


def _check_header(
    path: Path, line: int, header: Sequence[str], required: Sequence[str], optional: Sequence[str]
) -> None:
    known = [*required, *optional]
    other = next((name for mark, name in SEPARATORS.items() if len(header) == 1 and mark in header[0]), None)
    if other:
        raise InputError(
            f"{path}, line {line}: its columns are separated by {other}; commas are needed, with decimal points. Save "
            "the file so, or replace them in an editor."
        )
    missing = [column for column in required if column not in header]
    if missing:
        raise InputError(
            f"{path}, line {line}: the header lacks the column {missing[0]!r}. It must name {','.join(required)}"
            + (f"; also possible are {','.join(optional)}." if optional else ".")
        )
    for column in header:
        if column and column not in known:
            hint = did_you_mean(column, known)
            raise InputError(
                f"{path}, line {line}: {files.quote_value(column)} is no column of this file.{hint} Known: "
                f"{','.join(known)}."
            )
    twice = [column for column in header if header.count(column) > 1]
    if twice:
        raise InputError(f"{path}, line {line}: the column {files.quote_value(twice[0])} is named twice.")
