"""Output to a terminal: without control characters from file names, with replacements for missing letters; and progress
on stderr, a line with a bar on a terminal, occasional plain lines elsewhere."""

import codecs
import io
import os
import re
import sys
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, TextColumn
from rich.segment import Segment
from rich.table import Column, Table

from measure.scans.remote import public_text

SPELLED = {
    "σ": "sigma", "µ": "u", "μ": "u", "±": "+-", "₀": "0", "²": "^2", "°": " deg", "×": "x", "′": "'", "–": "-",
    "—": "-", "−": "-", "…": "...", "·": ".", "√": "sqrt", "≤": "<=", "≥": ">=",
}  # fmt: skip
_MINUS = re.compile(r"(?<!\w)−(?=\d)")
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")
_EVERY_S = 20.0  # between plain lines of a stage
_HOUR_S, _MINUTE_S = 3600.0, 60.0


Count = Callable[[str, int, int], None]  # current item, steps done, total


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


class TimedCount(Protocol):
    """`Count` with an optional remaining time."""

    def __call__(self, what: str, done: int, total: int, /, left_s: float | None = None) -> None:
        """left_s: remaining time, s; None: extrapolated from the time so far."""


def time_left(seconds: float) -> str:
    """Remaining time in words."""
    minutes = round(seconds / _MINUTE_S)
    if seconds >= 2 * _HOUR_S:
        return f"about {seconds / _HOUR_S:.1f} hours left"
    return f"about {minutes} minutes left" if minutes > 1 else "about a minute left"


class Reporter:
    """Progress display of the stages. quiet: none."""

    def __init__(self, console: Console | None = None, quiet: bool = False) -> None:
        self._console = console or PlainConsole(stderr=True, soft_wrap=True, quiet=quiet)

    @contextmanager
    def stage(self, title: str) -> Iterator[TimedCount]:
        """Begin a stage; the yielded function reports its progress."""
        started_s, shown_s, bar = time.monotonic(), -_EVERY_S, None

        def show(what: str, done: int, total: int, /, left_s: float | None = None) -> None:
            nonlocal shown_s
            now_s = time.monotonic()
            if left_s is None and done > 1 and now_s - started_s > _EVERY_S:
                left_s = (now_s - started_s) / done * (total - done)
            count = f"{done} of {total}" if total > 1 else ""
            left = f", {time_left(left_s)}" if left_s is not None and done < total else ""
            line = ", ".join(filter(None, (f"{title} {count}", what))) if count else f"{title} {what}"
            if bar is not None:
                bar.update(bar.task_ids[0], description=line + left, completed=done, total=total)
            elif now_s - shown_s >= _EVERY_S or (done == total and total > 1):  # the first, the last, and at intervals
                shown_s = now_s
                self.say(line + left)

        if self._console.is_terminal and not self._console.quiet:
            columns = TextColumn("{task.description}", markup=False), BarColumn()
            with Progress(*columns, console=self._console, transient=True) as bar:
                bar.add_task(title)
                yield show
        else:
            yield show

    def say(self, text: str) -> None:
        """Print a permanent line, above the bar if there is one."""
        self._console.print(text, markup=False, highlight=False)
