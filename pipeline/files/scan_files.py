"""The scans that a project names: files and addresses, and patterns of them at any depth; what their images are
called."""

import glob
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from measure.errors import MeasurementError
from measure.scans.addresses import found_addresses, is_address
from pipeline.text.image_names import names_below
from pipeline.text.tables import Table


@dataclass(frozen=True, eq=False)
class FoundScans:
    """files: by image name, in their order; left_out: the names of the images that `exclude` leaves out."""

    files: Mapping[str, Path]
    left_out: frozenset[str]


def find_scans(table: Table, patterns: Sequence[str], exclude: Sequence[str]) -> FoundScans:
    """The scan files that the patterns find, without those that `exclude` names or finds. Raises InputError for a
    pattern that finds nothing, and for files whose images would have the same name."""
    folder = table.file.parent
    found = dict[str, Path]()  # paths are slow keys
    for pattern in patterns:
        try:
            own = _found(pattern, folder)
        except MeasurementError as error:
            raise table.error("scans", str(error)) from error
        if not own and is_address(pattern):
            raise table.error("scans", f"{pattern!r} finds no object. Check the bucket, the folder and the ending.")
        if not own:
            raise table.error("scans", _nothing_found(pattern, folder / pattern))
        found |= {str(file): file for file in own}
    left_out = {str(file): file for pattern in exclude for file in _found(pattern, folder)}
    files = [file for text, file in found.items() if text not in left_out]
    if not files:
        what = "leaves no scan of those that scans names. Shorten it." if found else ""
        raise table.error(
            "exclude" if found else "scans",
            what or 'is an empty list. Name files or patterns, such as ["scans/**/*.tif"].',
        )
    scans: dict[str, Path] = {}
    for file, name in zip(files, names_below(files), strict=True):
        if not name.isprintable():
            raise table.error("scans", f"the file name {file.name!a} is not text in UTF-8 on one line. Rename it.")
        if name in scans:
            raise table.error("scans", f"{scans[name]} and {file} have the same name {name!r}. Rename one of them.")
        scans[name] = file
    return FoundScans(scans, frozenset(names_below(files, left_out.values())))


def _found(pattern: str, folder: Path) -> list[Path]:
    """The file of that very name, brackets and all, or those that the pattern finds in the folder, also links
    that lead nowhere: a scan that is named is opened or refused. `**` is any number of folders."""
    if is_address(pattern):
        return found_addresses(pattern)
    if (folder / pattern).is_file():
        return [folder / pattern]
    names = glob.glob(pattern, root_dir=folder, recursive=True)
    return _without_folders([folder / name for name in sorted(names)])


def _without_folders(paths: Sequence[Path]) -> list[Path]:
    """What is a folder is asked once for all that stands in one."""
    folders = set[str]()
    for parent in {text[: text.rfind(os.sep) + 1] for text in map(str, paths)}:
        with suppress(OSError), os.scandir(parent or os.curdir) as entries:  # it may be opened, and not listed
            folders |= {parent + entry.name for entry in entries if entry.is_dir()}
    return [path for path in paths if str(path) not in folders]


def _nothing_found(pattern: str, whole: Path) -> str:
    folder = whole.parent
    if whole.is_dir():
        return f"{pattern!r} is a folder. Name the files in it by a pattern, such as {f'{pattern}/*.tif'!r}."
    if glob.has_magic(str(Path(pattern).parent)):
        return f"{pattern!r} finds no file. Looked for {whole}."
    if not folder.is_dir():
        return f"{pattern!r} finds no file: there is no folder {folder.resolve()}."
    endings = sorted({file.suffix for file in folder.iterdir() if file.is_file() and file.suffix})
    holds = f"It holds files that end in {', '.join(endings)}." if endings else "It holds no files."
    return f"{pattern!r} finds no file in {folder.resolve()}. {holds}"
