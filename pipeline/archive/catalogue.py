"""Catalogue of the scans in folders and stores: grouped by file head, with copies and unreadable files set apart."""

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from measure.scans.remote import Address, list_addresses
from pipeline.archive.scan_groups import ScanGroup, group_scans
from pipeline.errors import InputError
from pipeline.files.scan_files import folders_below
from pipeline.progress import Count
from pipeline.provenance import content_hash, parts_hash
from pipeline.text.names import SCAN_ENDINGS


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Catalogue of scans.

    Attributes
    ----------
    groups : groups of readable scans, per folder, without copies.
    broken : {file: why it cannot be read}.
    copies : {file: the file with the same bytes that stands for it}.
    endings : number of files that are not scans, by file name ending.
    """

    groups: tuple[ScanGroup, ...]
    broken: Mapping[Path, str]
    copies: Mapping[Path, Path]
    endings: Mapping[str, int]

    @property
    def files(self) -> int:
        """Number of files that were examined."""
        return sum(len(group.paths) for group in self.groups) + len(self.broken) + len(self.copies)


def catalogue(given: Sequence[Path], count: Count, max_pixels: int | None = None) -> Catalogue:
    """Catalogue the scans given as files, addresses and folders (with all subfolders), including stores and servers.

    Only the files' names are held in memory.

    Raises
    ------
    InputError
        There is no scan.
    MeasurementError
        An address cannot be listed.
    """
    files, endings = find_scan_files(given)
    found = group_scans(files, count, max_pixels)
    copies = dict(_copies([path for path in files if path not in found.unread], max_pixels))
    groups = (replace(one, paths=tuple(path for path in one.paths if path not in copies)) for one in found.groups)
    return Catalogue(tuple(group for group in groups if group.paths), found.unread, copies, endings)


def find_scan_files(given: Sequence[Path]) -> tuple[list[Path], Counter[str]]:
    """Return the given files and all scans in and below the folders, sorted by name, and a count of other files by
    ending.

    Hidden files are skipped. Raises InputError where there is no scan.
    """
    files, endings = dict[Path, None](), Counter[str]()
    for path in given:
        is_listed = isinstance(path, Address) and path.suffix.lower() not in SCAN_ENDINGS
        if not is_listed and not path.is_dir():
            files[path] = None
            continue
        for file in list_addresses(path) if isinstance(path, Address) else _files_below(path):
            if file.suffix.lower() in SCAN_ENDINGS:
                files[file] = None
            else:
                endings[file.suffix] += 1
    if not files:
        where, others = ", ".join(map(str, given)), ", ".join(sorted(ending or "nothing" for ending in endings))
        held = f" There are files that end in {others}." if others else ""
        raise InputError(
            f"{where}: no scan there, nor below. Files that end in {', '.join(SCAN_ENDINGS)} are scans.{held}"
        )
    return sorted(files), endings


def _files_below(folder: Path) -> Iterator[Path]:
    """Files in and below a folder that are not hidden."""
    for place in folders_below(folder):
        with suppress(OSError), os.scandir(folder / place) as entries:
            names = [entry.name for entry in entries if not entry.is_dir() and not entry.name.startswith(".")]
            yield from (folder / place / name for name in names)


def _copies(files: Sequence[Path], max_pixels: int | None) -> Iterator[tuple[Path, Path]]:
    """Yield (copy, original) for files with identical bytes.

    The original is the first file with the shortest name, since copies are called `Copy of 0001` or `0001 (1)`. Size
    and a hash of parts of the file are compared first, since they distinguish most files cheaply.
    """
    for of_one_size in _equal_groups(lambda path: path.stat().st_size, files):
        for alike in _equal_groups(lambda path: parts_hash(path, max_pixels), of_one_size):
            for same in _equal_groups(content_hash, alike):
                original, *others = sorted(same, key=lambda path: len(path.name))
                yield from ((path, original) for path in others)


def _equal_groups(value: Callable[[Path], object], paths: Sequence[Path]) -> list[list[Path]]:
    """Group files by a value; a single file is returned without computing it."""
    if len(paths) == 1:
        return [list(paths)]
    groups = defaultdict[object, list[Path]](list)
    for path in paths:
        groups[value(path)].append(path)
    return list(groups.values())
