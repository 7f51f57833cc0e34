"""Scans that a project names by files, addresses and patterns: each real file once, with the names of their images."""

import glob
import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from measure.errors import MeasurementError
from measure.scans.remote import find_addresses, is_address, part_text, public_text, scan_path
from pipeline.errors import InputError
from pipeline.files.object_files import GivenImages
from pipeline.text.files import names_below
from pipeline.text.toml_tables import Table

_ANY_DEPTH = "**"
Named = str | Path  # a file as text, which is fast; an address as an object, which caches what its store reported


def found_names(pattern: str, folder: Path) -> set[str]:
    """Paths of the files and folders that a pattern matches, relative to the folder; hidden ones are skipped."""
    parts = pattern.split(os.sep)
    if _ANY_DEPTH not in parts:
        return set(glob.glob(pattern, root_dir=folder))
    depth = parts.index(_ANY_DEPTH)
    before, after = os.sep.join([*parts[:depth], ""]), os.sep.join(parts[depth + 1 :] if parts[depth + 1 :] else ["*"])
    names = set[str]()
    for start in glob.glob(before, root_dir=folder) if before else [""]:
        for place in folders_below(folder / start):
            here = os.path.join(start, place)
            names |= {os.path.join(here, name) for name in found_names(after, folder / here)}
    return names


def folders_below(root: Path) -> Iterator[str]:
    """Yield the folder itself, "", and all folders below it that are not hidden, as relative paths.

    Each real folder is yielded once, by a path without links if there is one. A link to a folder that contains it is
    not followed.
    """
    entered = set[str]()
    waiting, links = deque([("", os.path.realpath(root))]), deque[tuple[str, str]]()
    while waiting or links:
        place, real = (waiting or links).popleft()
        if real in entered:
            continue
        entered.add(real)
        yield place
        inner = list[tuple[str, bool]]()  # with links; a folder that may not be listed has none
        with suppress(OSError), os.scandir(real) as entries:
            folders = (one for one in entries if one.is_dir() and not one.name.startswith("."))
            inner = sorted((one.name, one.is_symlink()) for one in folders)
        for name, is_link in inner:
            below, target = os.path.join(place, name), os.path.join(real, name)
            if not is_link:
                waiting.append((below, target))
            elif os.path.commonpath([target := os.path.realpath(target), real]) != target:
                links.append((below, target))


def each_once(files: Mapping[str, bool], without: Iterable[str]) -> set[str]:
    """Keep one path for each real file.

    Among several paths the first explicitly named one (True) is kept, else the file's own path, else the first one.
    Files to which a path of `without` leads are dropped.
    """
    folder_of = cache(os.path.realpath)

    def real_path(file: str) -> str:
        if os.path.islink(file):
            return os.path.realpath(file)
        parent, name = os.path.split(file)
        return os.path.join(folder_of(parent or os.curdir), name)

    left_out, kept = {real_path(file) for file in without}, dict[str, str]()
    for file in files:
        real = real_path(file)
        if real in left_out:
            continue
        kept[real] = max(kept.get(real, file), file, key=lambda one: (files[one], os.path.abspath(one) == real))
    return set(kept.values())


class ScanFiles(Mapping[str, Path]):
    """Paths by image name. A Path is created on access: creating fifty thousand takes longer than finding the files."""

    def __init__(self, named: Mapping[str, Named]) -> None:
        self.named = named

    def __getitem__(self, name: str) -> Path:
        return scan_path(self.named[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self.named)

    def __len__(self) -> int:
        return len(self.named)


def find_scans(
    table: Table, patterns: Sequence[str], exclude: Sequence[str]
) -> tuple[Mapping[str, Path], frozenset[str]]:
    """Find the scan files that patterns match: by image name, in their order; and the names of the images that
    `exclude` leaves out.

    Raises InputError for a pattern that matches nothing, and for files whose images would share a name.
    """
    folder = table.file.parent
    found, is_named = dict[str, Named](), dict[str, bool]()  # texts as keys, since hashing paths is slow
    for pattern in patterns:
        try:
            own = _find_files(pattern, folder)
        except MeasurementError as error:
            raise table.error("scans", str(error)) from error
        if not own and is_address(pattern):
            raise table.error(
                "scans", f"{public_text(pattern)!r} finds no object. Check the bucket, the folder and the ending."
            )
        if not own:
            raise table.error("scans", public_text(_nothing_found(pattern, folder / pattern)))
        found |= {str(file): file for file in own}
        if not is_address(pattern):
            is_named |= {str(file): own == [str(folder / pattern)] for file in own}
    left_out = {str(file): file for pattern in exclude for file in _find_files(pattern, folder)}
    repeated = is_named.keys() - each_once(is_named, [text for text in left_out if not is_address(text)])
    files = [file for text, file in found.items() if text not in left_out and text not in repeated]
    if not files:
        what = "leaves no scan of those that scans names. Shorten it." if found else ""
        raise table.error(
            "exclude" if found else "scans",
            what or 'is an empty list. Name files or patterns, such as ["scans/**/*.tif"].',
        )
    scans: dict[str, Named] = {}
    for file, name in zip(files, names_below(files), strict=True):
        if not name.isprintable():
            message = f"the file name {Path(file).name!a} is not text in UTF-8 on one line. Rename it."
            raise table.error("scans", message)
        if name in scans:
            raise table.error("scans", f"{scans[name]} and {file} have the same name {name!r}. Rename one of them.")
        scans[name] = file
    return ScanFiles(scans), frozenset(names_below(files, left_out.values()))


def add_cuts(scans: Mapping[str, Path], images: GivenImages | None, path: Path | None) -> Mapping[str, Path]:
    """Replace scans by the pages and windows of them that images.csv names.

    The name of such an image begins with that of its scan. Raises InputError where it does not.
    """
    if images is None or not images.cuts:
        return scans
    named = dict(as_named(scans))
    cut, replaced = dict[str, Named](), set[str]()
    for image, (page, window) in images.cuts.items():
        names = [name for name in named if image.startswith(name)]
        if not names:
            raise InputError(
                f"{path}: image {image!r} has a page or a window, but no scan is called as it begins. Name it as its "
                "scan, or so with something behind: 0001-left of 0001.tif."
            )
        scan = max(names, key=len)
        if is_address(str(named[scan])):
            raise InputError(f"{path}: image {image!r}: pages and windows are of files, not of {named[scan]}. Copy it.")
        cut[image] = part_text(str(named[scan]), page, window)
        replaced.add(scan)
    replaced -= images.exterior.keys()  # a scan with a line of its own stays an image as well
    return ScanFiles({name: file for name, file in named.items() if name not in replaced} | cut)


def as_named(scans: Mapping[str, Path]) -> Mapping[str, Named]:
    """The scans as texts or addresses, without creating paths."""
    return scans.named if isinstance(scans, ScanFiles) else scans


def _find_files(pattern: str, folder: Path) -> Sequence[Named]:
    """Files of a pattern in the folder. `**` stands for any number of folders.

    A file with exactly that name has precedence, even with brackets in it. Broken links are included, so that they are
    reported when opened.
    """
    if is_address(pattern):
        return find_addresses(pattern)
    if (folder / pattern).is_file():
        return [str(folder / pattern)]
    names = sorted(found_names(pattern, folder))
    places = [(name[: (end := name.rfind(os.sep) + 1)], name[end:]) for name in names]
    begins = {place: str(folder / place / "_")[:-1] for place in {place for place, _ in places}}
    # Names that end with a separator are folders; so may others be. Each parent folder is listed only once.
    files = [begins[place] + name for place, name in places if name]
    folders = set[str]()
    for parent in {text[: text.rfind(os.sep) + 1] for text in files}:
        with suppress(OSError), os.scandir(parent or os.curdir) as entries:  # it may be accessible but not listable
            folders |= {parent + entry.name for entry in entries if entry.is_dir()}
    return [text for text in files if text not in folders]


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
