"""What a terminal is given: no control characters from names in files, and letters that it lacks spelled out."""

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

from measure.scans.remote import public_text

SPELLED = {
    "σ": "sigma", "µ": "u", "μ": "u", "±": "+-", "₀": "0", "²": "^2", "°": " deg", "×": "x", "′": "'", "–": "-",
    "—": "-", "−": "-", "…": "...", "·": ".", "√": "sqrt", "≤": "<=", "≥": ">=",
}  # fmt: skip
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    """The text with control characters as their codes: a name could recolour a terminal, or rewrite what it shows. And
    without the credentials and signatures of addresses."""
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], public_text(text))


class PlainConsole(Console):
    """A console whose own colours and bars work, and in which no name does anything but be read."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(plain(segment.text), segment.style)


def outlive_readers() -> None:
    """From now on the streams of this process drop what nobody reads any more: `reseau status | head` ends with the
    code that the command has without `head`."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # there is none, or it is a test's
            continue
        raw = _Patient(stream.fileno(), "wb", closefd=False)
        buffered = io.BufferedWriter(raw)
        lines = stream.line_buffering or stream.write_through
        setattr(sys, name, io.TextIOWrapper(buffered, stream.encoding, stream.errors, line_buffering=lines))


class _Patient(io.FileIO):
    """A file that takes everything once its pipe is closed."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return super().write(data)


def spell_out_missing_letters() -> None:
    """From now on the streams of this process print what their encoding lacks (Latin-1, ASCII) in letters it has."""
    codecs.register_error(_NAME, _spelled)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=_NAME)


_NAME = "reseau-spelled"


def _spelled(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_letter(letter) for letter in error.object[error.start : error.end]), error.end


def _letter(letter: str) -> str:
    return SPELLED.get(letter) or unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode() or "?"
