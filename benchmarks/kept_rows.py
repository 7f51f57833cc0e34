"""Rows of a table that takes hours, each kept in a file as soon as it is there: a run that is stopped goes on later,
and several processes may each take a part of the rows."""

from collections.abc import Callable
from pathlib import Path


class KeptRows:
    """path: of the file, one line a row: what it is of, a tab, the row; None keeps nothing."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path and path.exists() else []
        self._rows = dict(line.split("\t", 1) for line in lines)

    def print(self, of: str, compute: Callable[[], str]) -> None:
        """Print the row, from the file where that has it."""
        if of not in self._rows:
            self._rows[of] = compute()
            if self._path:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(f"{of}\t{self._rows[of]}\n")
        print(self._rows[of], flush=True)
