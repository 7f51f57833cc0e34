"""Names of images, as tables and files of all kinds have them."""

import os
from collections.abc import Iterable
from pathlib import Path

SCAN_ENDINGS = (".tif", ".tiff", ".jpg", ".jpeg", ".png")


def image_name(text: str) -> str:
    """An image's name: its file's, with the folders before it and `/` between, without a picture's ending, and without
    blanks at its ends, which no table keeps."""
    folder, slash, file = text.strip().rpartition("/")
    name, ending = os.path.splitext(file)
    return folder + slash + (name if ending.lower() in SCAN_ENDINGS else file).strip()


def names_below(files: Iterable[Path], others: Iterable[Path] | None = None) -> dict[Path, str]:
    """The names of images by their files: the path below the folder that all the files share. others: whose names are
    asked for, if not those of the files."""
    absolute = {file: os.path.abspath(file) for file in files}
    shared = os.path.commonpath([os.path.dirname(path) for path in absolute.values()]) if absolute else ""
    asked = absolute if others is None else {file: os.path.abspath(file) for file in others}
    return {file: image_name(Path(os.path.relpath(path, shared)).as_posix()) for file, path in asked.items()}
