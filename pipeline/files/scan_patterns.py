"""Files that a pattern finds in a folder, `**` being any number of folders: each real file once."""

import glob
import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

_ANY_DEPTH = "**"


def found_names(pattern: str, folder: Path) -> set[str]:
    """Files, and folders, by their paths from the folder; what is hidden is not looked at."""
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
    """The folder itself, "", and all below it but hidden ones, by their paths from it.

    Each real folder comes once, by a path without links where there is one. A link to a folder that contains it is not
    followed.
    """
    entered = set[str]()
    waiting, links = deque([("", os.path.realpath(root))]), deque[tuple[str, str]]()
    while waiting or links:
        place, real = (waiting or links).popleft()
        if real in entered:
            continue
        entered.add(real)
        yield place
        for name, is_link in _folders_in(real):
            below, target = os.path.join(place, name), os.path.join(real, name)
            if not is_link:
                waiting.append((below, target))
            elif not _contains(target := os.path.realpath(target), real):
                links.append((below, target))


def each_once(files: Mapping[str, bool], without: Iterable[str]) -> set[str]:
    """The paths that are kept: of several to one real file the first that was named as it stands (True), else its own,
    else the first; none to a file to which a path of `without` leads, too."""
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


def _folders_in(folder: str) -> list[tuple[str, bool]]:
    """The names of its folders, and whether each is a link; none of a folder that may not be listed."""
    with suppress(OSError), os.scandir(folder) as entries:
        return sorted((one.name, one.is_symlink()) for one in entries if one.is_dir() and not one.name.startswith("."))
    return []


def _contains(folder: str, path: str) -> bool:
    return os.path.commonpath([folder, path]) == folder
