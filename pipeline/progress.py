"""How long work shows itself: a bar on a terminal, plain lines elsewhere, always on stderr."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from pipeline.terminal import PlainConsole

Count = Callable[[str, int, int], None]


class Reporter:
    """Where the stages say how far they are."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or PlainConsole(stderr=True, soft_wrap=True)

    @property
    def is_terminal(self) -> bool:
        return self._console.is_terminal

    @contextmanager
    def stage(self, title: str) -> Iterator[Count]:
        """A stage: call what it yields with the thing in hand, the steps done and their total."""
        if self._console.is_terminal:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TaskProgressColumn(),
                TimeRemainingColumn(),
            )
            with Progress(*columns, console=self._console, transient=True) as bar:
                task = bar.add_task(title)
                yield lambda what, done, total: bar.update(
                    task, description=f"{title} {what}", completed=done, total=total
                )
        else:
            yield self._lines(title)

    def say(self, text: str) -> None:
        """A line that stays, above the bar where there is one."""
        self._console.print(text, markup=False, highlight=False)

    def _lines(self, title: str) -> Count:
        """A plain line whenever another thing is in hand."""
        last = ""

        def line(what: str, _done: int, _total: int) -> None:
            nonlocal last
            if what and what != last:
                self.say(f"{title} {what}")
            last = what

        return line
