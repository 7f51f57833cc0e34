"""Names of images, as tables and files of all kinds have them."""

import os
from collections.abc import Collection
from pathlib import Path

SCAN_ENDINGS = (".tif", ".tiff", ".jpg", ".jpeg", ".png")


def image_name(text: str) -> str:
    """An image's name: its file's, with the folders before it and `/` between, without a picture's ending, and without
    blanks at its ends, which no table keeps."""
    folder, slash, file = text.strip().rpartition("/")
    name, ending = os.path.splitext(file)
    return folder + slash + (name if ending.lower() in SCAN_ENDINGS else file).strip()


def names_below(files: Collection[str | Path], others: Collection[str | Path] | None = None) -> list[str]:
    """The names of images, in the order of their files: the path below the folder that all the files share. others:
    whose names are asked for, if not those of the files."""
    given = {text[: text.rfind(os.sep) + 1] for text in map(str, files)}
    places = [text.rpartition(os.sep) for text in map(str, files if others is None else others)]
    folders = {folder: os.path.abspath(folder) for folder in given.union(folder + sign for folder, sign, _ in places)}
    shared = os.path.commonpath([folders[folder] for folder in given] or [os.sep])
    below = {folder: Path(os.path.relpath(path, shared)).as_posix() for folder, path in folders.items()}
    before = {folder: "" if path == os.curdir else f"{path}/" for folder, path in below.items()}
    return [image_name(before[folder + sign] + name) for folder, sign, name in places]
