"""The directories of a TIFF file, looked through before they are believed: where they lie, and the form of their tags.

TIFF 6.0, section 2, and BigTIFF: a directory is a number of entries and the place of the next one; an entry is a tag,
the type and the count of its numbers, and these themselves or, where they take more room, their place.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

Extent = tuple[int, int]

_MOST_DIRECTORIES, _MOST_ENTRIES = 1000, 4096
_WHOLE = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}  # unsigned integers, by their types
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_ONE, _SOME = True, False
_SIZES = (256, 257, 277, 278, 322, 323)  # none of which may be 0
_TAGS = {  # what is read with a picture, and whether it is one number
    254: ("NewSubfileType", _ONE),
    256: ("ImageWidth", _ONE),
    257: ("ImageLength", _ONE),
    258: ("BitsPerSample", _SOME),
    259: ("Compression", _ONE),
    262: ("PhotometricInterpretation", _ONE),
    266: ("FillOrder", _ONE),
    273: ("StripOffsets", _SOME),
    274: ("Orientation", _ONE),
    277: ("SamplesPerPixel", _ONE),
    278: ("RowsPerStrip", _ONE),
    279: ("StripByteCounts", _SOME),
    284: ("PlanarConfiguration", _ONE),
    317: ("Predictor", _ONE),
    320: ("ColorMap", _SOME),
    322: ("TileWidth", _ONE),
    323: ("TileLength", _ONE),
    324: ("TileOffsets", _SOME),
    325: ("TileByteCounts", _SOME),
    338: ("ExtraSamples", _SOME),
    339: ("SampleFormat", _SOME),
}
_CHILDREN = (330, 34665, 34853, 40965)  # places of directories: SubIFDs, Exif, GPS, Interoperability
_STORED = ((273, 279), (324, 325), (513, 514))  # places and numbers of bytes of what no tag holds itself


class BadDirectory(ValueError):
    """What is wrong with a file's directories, a part of a sentence."""


@dataclass(frozen=True)
class _Layout:
    """How a file writes its directories: the byte order, and struct's letters for a number of entries and a place."""

    order: str
    entries: str
    place: str

    @property
    def place_bytes(self) -> int:
        return struct.calcsize(self.place)

    @property
    def entry_bytes(self) -> int:
        return 4 + 2 * self.place_bytes

    def number(self, letter: str, stored: bytes) -> int:
        try:
            return int(struct.unpack(self.order + letter, stored)[0])
        except struct.error:
            raise BadDirectory("its list of tags is cut short") from None


@dataclass(frozen=True)
class _Entry:
    """One tag: its type, the count of its numbers, and where these stand, (first byte, byte after the last)."""

    tag: int
    kind: int
    count: int
    extent: Extent


def check_directories(path: Path) -> list[Extent]:
    """What lies where in the file, (first byte, byte after the last) each: the directories, the numbers of their tags,
    and the pixels that these tell of.

    Raises BadDirectory for a chain of directories that leads back to itself, and for tags of a count, type or value
    that no picture can have.
    """
    file_bytes = path.stat().st_size
    with path.open("rb") as file:
        layout, place = _start(file)
        extents = [(0, file.tell())]
        chain, children = [place], list[int]()
        found = set[int]()
        while chain or children:
            is_picture = bool(chain)
            place = chain.pop() if is_picture else children.pop()
            if not place or (place in found and not is_picture):
                continue
            if place in found:
                raise BadDirectory("its list of pictures leads back to itself")
            if len(found) == _MOST_DIRECTORIES:
                raise BadDirectory(f"it lists more than {_MOST_DIRECTORIES} pictures")
            found.add(place)
            try:
                entries, following = _directory(file, layout, place)
                for entry in entries if is_picture else ():
                    _check(file, file_bytes, layout, entry)
            except BadDirectory:
                if is_picture:
                    raise
                continue  # what is beside the pictures is not read
            chain += [following] if is_picture else []
            children += [
                child for entry in entries if entry.tag in _CHILDREN for child in _numbers(file, layout, entry)
            ]
            extents += [(place, place + len(entries) * layout.entry_bytes), *_extents(file, layout, entries)]
    return extents


def _start(file: BinaryIO) -> tuple[_Layout, int]:
    """The file's layout, and the place of its first directory."""
    start = file.read(4)
    order = "<" if start[:2] == b"II" else ">"
    is_big = start[2:] in (b"+\0", b"\0+")
    layout = _Layout(order, "Q", "Q") if is_big else _Layout(order, "H", "I")
    file.read(4 if is_big else 0)
    return layout, layout.number(layout.place, file.read(layout.place_bytes))


def _directory(file: BinaryIO, layout: _Layout, place: int) -> tuple[list[_Entry], int]:
    """A directory's entries, and the place of the next one."""
    file.seek(place)
    count = layout.number(layout.entries, file.read(struct.calcsize(layout.entries)))
    if count > _MOST_ENTRIES:
        raise BadDirectory(f"a picture has {count} tags")
    first = file.tell()
    stored = file.read(count * layout.entry_bytes)
    following = layout.number(layout.place, file.read(layout.place_bytes))
    size = layout.entry_bytes
    return [_entry(layout, first + at, stored[at : at + size]) for at in range(0, len(stored), size)], following


def _entry(layout: _Layout, at: int, stored: bytes) -> _Entry:
    """at: where in the file it stands."""
    room = layout.place_bytes
    tag, kind = struct.unpack(f"{layout.order}HH", stored[:4])
    count = layout.number(layout.place, stored[4 : 4 + room])
    size = count * _TYPE_BYTES.get(kind, 0)
    first = at + 4 + room if size <= room else layout.number(layout.place, stored[4 + room :])
    return _Entry(tag, kind, count, (first, first + size))


def _check(file: BinaryIO, file_bytes: int, layout: _Layout, entry: _Entry) -> None:
    """One entry, if its tag is one that pictures are read by."""
    if entry.tag not in _TAGS:
        return
    name, is_one = _TAGS[entry.tag]
    if entry.kind not in _WHOLE:
        raise BadDirectory(f"its tag {name} is no whole number (type {entry.kind})")
    if entry.count < 1 or (is_one and entry.count != 1):
        raise BadDirectory(f"its tag {name} holds {entry.count} numbers" + (", not one" if is_one else ""))
    if entry.extent[1] > file_bytes:
        raise BadDirectory(f"the {entry.count} numbers of its tag {name} lie beyond its end of {file_bytes} bytes")
    if entry.tag in _SIZES and _numbers(file, layout, entry) == (0,):
        raise BadDirectory(f"its tag {name} is 0")


def _extents(file: BinaryIO, layout: _Layout, entries: list[_Entry]) -> Iterator[Extent]:
    """Of the numbers of a directory's tags, and of the pixels that they tell of."""
    by_tag = {entry.tag: entry for entry in entries}
    yield from (entry.extent for entry in entries if entry.extent[1] - entry.extent[0] > layout.place_bytes)
    for places, counts in _STORED:
        if places in by_tag and counts in by_tag:
            both = (_numbers(file, layout, by_tag[tag]) for tag in (places, counts))
            yield from ((place, place + count) for place, count in zip(*both, strict=False) if count)


def _numbers(file: BinaryIO, layout: _Layout, entry: _Entry) -> tuple[int, ...]:
    """None where the tag holds no whole numbers, or the file does not hold them."""
    first, after = entry.extent
    file.seek(first)
    stored = file.read(after - first) if entry.kind in _WHOLE else b""
    if not stored or len(stored) < after - first:
        return ()
    return struct.unpack(f"{layout.order}{entry.count}{_WHOLE[entry.kind]}", stored)
