"""Safe output to a terminal: without control characters from file names, with replacements for missing letters."""

import codecs
import io
import os
import re
import sys
import unicodedata
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Column, Table

from measure.scans.remote import public_text

SPELLED = {
    "σ": "sigma", "µ": "u", "μ": "u", "±": "+-", "₀": "0", "²": "^2", "°": " deg", "×": "x", "′": "'", "–": "-",
    "—": "-", "−": "-", "…": "...", "·": ".", "√": "sqrt", "≤": "<=", "≥": ">=",
}  # fmt: skip
_MINUS = re.compile(r"(?<!\w)−(?=\d)")
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    """Text with control characters escaped, since names could recolour or rewrite the terminal, without credentials and
    signatures in addresses, and with the minus sign that calculators take."""
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], _MINUS.sub("-", public_text(text)))


class PlainConsole(Console):
    """Console that escapes control characters in text, but keeps its own colours and bars."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(plain(segment.text), segment.style)


def uncut_table(columns: Iterable[str], title: str) -> Table:
    """Empty table whose cells are wrapped where the terminal is too narrow: a number that is cut cannot be read."""
    return Table(*(Column(name, overflow="fold") for name in columns), title=title, title_justify="left")


def outlive_readers() -> None:
    """Make the standard streams ignore a closed pipe, so that `reseau status | head` returns the exit code that it has
    without `head`."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # no stream, or a test's
            continue
        raw = _Patient(stream.fileno(), "wb", closefd=False)
        buffered = io.BufferedWriter(raw)
        lines = stream.line_buffering or stream.write_through
        setattr(sys, name, io.TextIOWrapper(buffered, stream.encoding, stream.errors, line_buffering=lines))


class _Patient(io.FileIO):
    """File that discards everything once its pipe is closed."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return super().write(data)


def spell_out_missing_letters() -> None:
    """Make the standard streams replace characters that their encoding lacks (Latin-1, ASCII)."""
    codecs.register_error(_NAME, _escape_letter)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=_NAME)


_NAME = "reseau-spelled"


def _escape_letter(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    bare = {letter: unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode() for letter in letters}
    return "".join(SPELLED.get(letter) or bare[letter] or "?" for letter in letters), error.end
