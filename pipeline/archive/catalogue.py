"""What scans there are: the head of every file, which are alike, which are copies, and which cannot be taken."""

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from measure.errors import MeasurementError
from measure.scans.opening import ScanHead, read_head
from measure.scans.remote import Address, list_addresses
from pipeline.errors import InputError
from pipeline.files.scan_files import folders_below
from pipeline.progress import Count
from pipeline.provenance import content_hash, parts_hash
from pipeline.text.names import SCAN_ENDINGS

_ALIKE = 0.03  # of their sides: scans of one roll are cut by hand
_SAME_PITCH = 0.01
_EVERY = 200  # files after which it is told how far it is


@dataclass(frozen=True, eq=False)
class Group:
    """Scans of one folder that are alike. head: that of the first of them."""

    folder: Path
    head: ScanHead
    paths: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class Catalogue:
    """groups: of whole scans, by folder; broken: by file why it cannot be read; copies: by file the first one of the
    same bytes; endings: how many files were not looked at, by how their names end."""

    groups: tuple[Group, ...]
    broken: Mapping[Path, str]
    copies: Mapping[Path, Path]
    endings: Mapping[str, int]

    @property
    def files(self) -> int:
        """How many were looked at."""
        return sum(len(group.paths) for group in self.groups) + len(self.broken) + len(self.copies)


def catalogue(given: Sequence[Path], count: Count, max_pixels: int | None = None) -> Catalogue:
    """All scans among the files and addresses, and in and below the folders, also those of stores and servers. Of each
    some kilobytes are read, and held is its name. Raises InputError where there is none, MeasurementError for an
    address that is not listed."""
    files, endings = _files(given)
    if not files:
        raise InputError(_no_scan(given, endings))
    heads = _Kinds()
    broken, sizes = dict[Path, str](), defaultdict[int, list[Path]](list)
    of_group = defaultdict[tuple[Path, int], list[Path]](list)
    for done, path in enumerate(files):
        if done % _EVERY == 0:
            count(f"{done} of {len(files)}", done, len(files))
        try:
            kind = heads.index(read_head(path, max_pixels))
        except MeasurementError as error:
            broken[path] = str(error)
            continue
        sizes[path.stat().st_size].append(path)
        of_group[path.parent, kind].append(path)
    copies = dict(_copies(sizes.values(), max_pixels))
    groups = (
        Group(folder, heads.heads[kind], tuple(path for path in paths if path not in copies))
        for (folder, kind), paths in sorted(of_group.items())
    )
    return Catalogue(tuple(group for group in groups if group.paths), broken, copies, endings)


def _files(given: Sequence[Path]) -> tuple[list[Path], Counter[str]]:
    """In the order of their names; what is hidden is not looked at."""
    files, endings = dict[Path, None](), Counter[str]()
    for path in given:
        if isinstance(path, Address) and path.suffix.lower() not in SCAN_ENDINGS:
            for below in list_addresses(path):
                if below.suffix.lower() in SCAN_ENDINGS:
                    files[below] = None
                else:
                    endings[below.suffix] += 1
            continue
        if not path.is_dir():
            files[path] = None
            continue
        for place in folders_below(path):
            for name in _file_names(path / place):
                file = path / place / name
                if file.suffix.lower() in SCAN_ENDINGS:
                    files[file] = None
                else:
                    endings[file.suffix] += 1
    return sorted(files), endings


def _file_names(folder: Path) -> list[str]:
    """Those that are not hidden."""
    with suppress(OSError), os.scandir(folder) as entries:
        return [entry.name for entry in entries if not entry.is_dir() and not entry.name.startswith(".")]
    return []


def _no_scan(given: Sequence[Path], endings: Mapping[str, int]) -> str:
    where = ", ".join(map(str, given))
    others = ", ".join(sorted(ending or "nothing" for ending in endings))
    held = f" There are files that end in {others}." if others else ""
    return f"{where}: no scan there, nor below. Files that end in {', '.join(SCAN_ENDINGS)} are looked for.{held}"


class _Kinds:
    """Heads that stand for all that are alike: of one format, one number of channels and bits, one pitch, about one
    size."""

    def __init__(self) -> None:
        self.heads: list[ScanHead] = []
        self._like = defaultdict[tuple[object, ...], list[int]](list)

    def index(self, head: ScanHead) -> int:
        alike = self._like[head.file_format, head.channels, head.bits, head.pitch.um is None]
        for index in alike:
            if _is_like(self.heads[index], head):
                return index
        self.heads.append(head)
        alike.append(len(self.heads) - 1)
        return alike[-1]


def _is_like(one: ScanHead, other: ScanHead) -> bool:
    sides = (one.width_px, other.width_px), (one.height_px, other.height_px)
    pitches = zip(one.pitch.um or (), other.pitch.um or (), strict=True)
    return all(abs(a - b) <= _ALIKE * a for a, b in sides) and all(abs(a - b) <= _SAME_PITCH * a for a, b in pitches)


def _copies(of_one_size: Iterable[list[Path]], max_pixels: int | None) -> Iterator[tuple[Path, Path]]:
    """Files with the same bytes as another one, and that one: of the shortest name, for copies are called `Copy of
    0001` or `0001 (1)`, and the first of these. What tells most files apart is read first."""
    for paths in of_one_size:
        for alike in _by(lambda path: parts_hash(path, max_pixels), paths):
            for same in _by(content_hash, alike):
                original, *others = sorted(same, key=lambda path: len(path.name))
                yield from ((path, original) for path in others)


def _by(told: Callable[[Path], str], paths: Sequence[Path]) -> list[list[Path]]:
    """The files, those together of which the same is told; nothing is asked of a single one."""
    if len(paths) == 1:
        return [list(paths)]
    groups = defaultdict[str, list[Path]](list)
    for path in paths:
        groups[told(path)].append(path)
    return list(groups.values())
