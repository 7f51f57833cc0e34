"""What some scans of a project tell all others, kept: it stays as it is when scans come or go, and so do the results of
all that were measured by it."""

from typing import Any, Protocol

Json = dict[str, Any]


class Memory(Protocol):
    """Values by keys, which name all that a value depends on."""

    def told(self, key: str) -> Json | None:
        """What was told by that key; None: nothing yet."""

    def tell(self, key: str, value: Json) -> None:
        """Keep a value."""
