"""Names of images, and safe conversion of names to paths below a folder."""

import os
from collections.abc import Collection
from pathlib import Path

from pipeline.errors import InputError
from pipeline.text.text_file import quote_value

SCAN_ENDINGS = (".tif", ".tiff", ".jpg", ".jpeg", ".jp2", ".j2k", ".png")


def image_name(text: str) -> str:
    """Name of an image from its file: folders separated by `/`, without the file ending of an image format, and without
    leading or trailing blanks, which tables do not preserve."""
    folder, slash, file = text.strip().rpartition("/")
    name, ending = os.path.splitext(file)
    return folder + slash + (name if ending.lower() in SCAN_ENDINGS else file).strip()


def names_below(files: Collection[str | Path], others: Collection[str | Path] | None = None) -> list[str]:
    """Names of images in the order of their files: paths relative to the common folder of all files. others: files to
    name instead, relative to the same folder."""
    given = {text[: text.rfind(os.sep) + 1] for text in map(str, files)}
    places = [text.rpartition(os.sep) for text in map(str, files if others is None else others)]
    folders = {folder: os.path.abspath(folder) for folder in given.union(folder + sign for folder, sign, _ in places)}
    shared = os.path.commonpath([folders[folder] for folder in given] or [os.sep])
    below = {folder: Path(os.path.relpath(path, shared)).as_posix() for folder, path in folders.items()}
    before = {folder: "" if path == os.curdir else f"{path}/" for folder, path in below.items()}
    return [image_name(before[folder + sign] + name) for folder, sign, name in places]


def path_below(folder: Path, name: str, suffix: str = "") -> Path:
    """Path of a name below a folder, with sub-folders for each `/`. suffix: appended to the name.

    Raises InputError for a name that would lead out of the folder, or that is no valid file name on some system.
    """
    parts = name.split("/")
    if not name.isprintable() or any(map(_leads_elsewhere, parts)):
        raise InputError(
            f"the name {quote_value(name)} cannot be that of a file below {folder}: nothing was written. A name is a "
            "file's, with folders before it and `/` between, without .. and backslash. Rename the image, frame or "
            "camera."
        )
    return folder.joinpath(*parts[:-1], f"{parts[-1]}{suffix}")


def _leads_elsewhere(part: str) -> bool:
    return part.strip() in ("", ".", "..") or "\\" in part or part[1:2] == ":"  # a Windows drive


def file_word(name: str) -> str:
    """Convert a name to part of a file name: characters other than letters, digits, `-`, `_` and `.` become `-`."""
    word = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
    return word if word.strip(".") else "-"
