"""A part of a scan's file that is an image of its own: one of its pages, or a window of one."""

import re
from pathlib import PosixPath

Window = tuple[int, int, int, int]  # first column and row, width and height, px

_PART = re.compile(r"(.+)#(?=page|window)(?:page=(\d+))?,?(?:window=(\d+),(\d+),(\d+),(\d+))?")


class ScanPart(PosixPath):
    """`FILE#page=2` or `FILE#page=1,window=100,200,4000,4000`: the path of a file of which one page, or a window of
    one, is meant. Pages count from 1, pixels as the page stores them."""

    def __fspath__(self) -> str:
        return self._groups()[0]

    def __reduce__(self) -> tuple[type["ScanPart"], tuple[str]]:
        return ScanPart, (str(self),)

    @property
    def page(self) -> int | None:
        """From 1; None: the first picture."""
        page = self._groups()[1]
        return int(page) if page else None

    @property
    def window(self) -> Window | None:
        """Of the page; None: all of it."""
        col, row, width, height = self._groups()[2:]
        return (int(col), int(row), int(width), int(height)) if col else None

    def _groups(self) -> tuple[str, ...]:
        match = _PART.fullmatch(str(self))
        assert match is not None, f"{self} names no part of a scan: `is_scan_part` tells"
        return match.groups()


def is_scan_part(text: str) -> bool:
    return _PART.fullmatch(text) is not None


def whole_file(text: str) -> str:
    """The file without what is said of its part."""
    match = _PART.fullmatch(text) if "#" in text else None
    return match.group(1) if match else text


def part_text(file: str, page: int | None, window: Window | None) -> str:
    """What `ScanPart` reads."""
    parts = [f"page={page}"] if page else []
    parts += [f"window={','.join(map(str, window))}"] if window else []
    return f"{file}#{','.join(parts)}" if parts else file
