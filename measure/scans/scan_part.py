"""A part of a scan's file that is an image of its own: one of its pages, or a window of one."""

import re
from pathlib import PosixPath

Window = tuple[int, int, int, int]  # first column and row, width and height, px

_PART = re.compile(r"(.+)#page=(\d+)(?:,window=(-?\d+),(-?\d+),(\d+),(\d+))?")


class ScanPart(PosixPath):
    """`FILE#page=2` or `FILE#page=1,window=100,200,4000,4000`: the path of a file of which one page, or a window of
    it, is meant. Pages count from 1, pixels as the page stores them."""

    def __fspath__(self) -> str:
        return self._parts_of_text()[0]

    def __reduce__(self) -> tuple[type["ScanPart"], tuple[str]]:
        return ScanPart, (str(self),)

    @property
    def page(self) -> int:
        """From 1."""
        return int(self._parts_of_text()[1])

    @property
    def window(self) -> Window | None:
        """Of the page; None: all of it."""
        numbers = self._parts_of_text()[2:]
        if numbers[0] is None:
            return None
        col, row, width, height = map(int, numbers)
        return col, row, width, height

    def _parts_of_text(self) -> tuple[str, ...]:
        match = _PART.fullmatch(str(self))
        assert match is not None, f"{self} names no part of a scan: `is_scan_part` tells"
        return match.groups()


def is_scan_part(text: str) -> bool:
    return _PART.fullmatch(text) is not None


def part_text(file: str, page: int, window: Window | None) -> str:
    """What `ScanPart` reads."""
    return f"{file}#page={page}" + ("" if window is None else f",window={','.join(map(str, window))}")
