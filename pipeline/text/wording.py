"""Lists and counts as the program words them."""

from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath

LISTED = 8  # so many names are listed; the rest are counted


def listed(names: Sequence[str]) -> str:
    """The first names, and how many there are beyond them."""
    more = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {more} more" if more > 0 else "")


def counted(number: int, one: str, many: str = "") -> str:
    """The number with its noun."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def without_file(sentence: str, file: str) -> str:
    """The sentence without the name of the file that it begins with."""
    name = f"{PurePosixPath(file.replace(chr(92), '/')).name}: "
    head, found, rest = sentence.partition(name)
    return rest if found and ": " not in head else sentence


def gathered(told: Iterable[tuple[str, str, str]]) -> list[str]:
    """What images have to say, each with its name and file: once where many say the same, with their number."""
    alike: dict[str, list[tuple[str, str]]] = {}
    for image, file, sentence in told:
        alike.setdefault(without_file(sentence, file), []).append((image, sentence))
    return [
        f"{len(own)} scans ({listed([image for image, _ in own])}): {same}" if len(own) > 1 else own[0][1]
        for same, own in alike.items()
    ]
