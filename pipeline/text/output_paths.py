"""Names from tables and other programs' files as paths: below the folder they are meant for, or refused."""

from pathlib import Path

from pipeline.errors import InputError
from pipeline.text.text_file import shown


def path_below(folder: Path, name: str, suffix: str = "") -> Path:
    """The path of a name in a folder, with sub-folders where the name has `/`. suffix: after the name.

    Raises InputError for a name that would lead out of the folder, or that no file can have on some system.
    """
    parts = name.split("/")
    if not name.isprintable() or any(map(_leads_elsewhere, parts)):
        raise InputError(
            f"the name {shown(name)} cannot be that of a file below {folder}: nothing was written. A name is a file's, "
            "with folders before it and `/` between, without .. and backslash. Rename the image, frame or camera."
        )
    return folder.joinpath(*parts[:-1], f"{parts[-1]}{suffix}")


def _leads_elsewhere(part: str) -> bool:
    return part.strip() in ("", ".", "..") or "\\" in part or part[1:2] == ":"  # a drive, on some systems


def file_word(name: str) -> str:
    """A name as a part of a file's name: letters, digits, `-`, `_` and `.`, with `-` in the place of all others."""
    word = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
    return word if word.strip(".") else "-"
