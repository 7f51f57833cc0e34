"""Lists and counts as the program words them."""

from collections.abc import Sequence

LISTED = 8  # so many names are listed; the rest are counted


def listed(names: Sequence[str]) -> str:
    """The first names, and how many there are beyond them."""
    more = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {more} more" if more > 0 else "")


def counted(number: int, one: str, many: str = "") -> str:
    """The number with its noun."""
    return f"{number} {one if number == 1 else many or one + 's'}"
