"""Progress display on stderr: a line with a bar on a terminal, occasional plain lines elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from pipeline.terminal import PlainConsole

_EVERY_S = 20.0  # between plain lines of a stage
_HOUR_S, _MINUTE_S = 3600.0, 60.0


Count = Callable[[str, int, int], None]  # current item, steps done, total


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
