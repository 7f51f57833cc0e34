"""What was asked for last, held as far as a limit of memory allows."""

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Kept = TypeVar("Kept")


class Held(Generic[Kept]):
    """Things by a key each. The one asked for longest ago goes first where there is no room."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self._kept: OrderedDict[Hashable, tuple[Kept, int]] = OrderedDict()
        self._bytes = 0

    def find(self, key: Hashable) -> Kept | None:
        """What is held of a key, None if nothing is."""
        if key not in self._kept:
            return None
        self._kept.move_to_end(key)
        return self._kept[key][0]

    def keep(self, key: Hashable, kept: Kept, size_bytes: int) -> None:
        """Hold what is not held yet."""
        self.make_room(size_bytes)
        self._kept[key] = kept, size_bytes
        self._bytes += size_bytes

    def make_room(self, size_bytes: int) -> None:
        """Let go of the oldest until so much more can be held, or nothing is."""
        while self._kept and self._bytes + size_bytes > self.limit_bytes:
            self._bytes -= self._kept.popitem(last=False)[1][1]
