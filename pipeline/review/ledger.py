"""What stands of a file of decisions, while other windows and other people write it, too."""

from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path

from pipeline.files.decisions_file import (
    LEARNED,
    About,
    Decision,
    decisions_bytes,
    learned_from,
    parse_decisions,
    put_on,
)

_COMPARED = 4096  # bytes before what is new, by which a file that goes on is told from another one


class Ledger:
    """The decisions that stand. Of a file that goes on only the new lines are read, however many there are."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int, int] | None = None  # which file, its size, and when it was written
        self._forget()

    def read_on(self) -> frozenset[str] | None:
        """The images about which there is something new; None where the whole file is another one."""
        before, self._seen = self._seen, _state(self._path)
        if self._seen == before:
            return frozenset()
        more = self._more() if before and self._seen and before[0] == self._seen[0] else None
        if more is None:
            self._forget()
            self._take(decisions_bytes(self._path))
            return None
        return self._take(more)

    def get(self, about: About) -> Decision | None:
        stack = self._stacks.get(about)
        return stack[-1] if stack else None

    def of_image(self, image: str) -> Iterable[Decision]:
        """Of its marks and its pose, in the order in which somebody first decided about each."""
        return (one for about in self._abouts.get(image, ()) if (one := self.get(about)) and about[2] != LEARNED)

    def learned(self, images: Collection[str]) -> Decision | None:
        """From which the marks of a camera that has these images are learned."""
        return learned_from(self._learned, images)

    def _forget(self) -> None:
        self._stacks: dict[About, list[Decision]] = {}
        self._abouts: dict[str, dict[About, None]] = defaultdict(dict)
        self._learned: list[Decision] = []
        self._end, self._lines, self._tail = 0, 0, b""

    def _more(self) -> bytes | None:
        """What stands behind all that was read; None where that is not there any more as it was."""
        if not self._tail.endswith(b"\n"):
            return None
        data = decisions_bytes(self._path, self._end - len(self._tail))
        return data[len(self._tail) :] if data.startswith(self._tail) else None

    def _take(self, data: bytes) -> frozenset[str]:
        new = parse_decisions(self._path, data, self._lines + 1)
        for one in new:
            put_on(self._stacks, one)
            self._abouts[one.image][one.about] = None
        self._learned += [one for one in new if one.about[2] == LEARNED]
        self._end, self._lines = self._end + len(data), self._lines + data.count(b"\n")
        self._tail = (self._tail + data)[-_COMPARED:]
        return frozenset(one.image for one in new)


def _state(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns
