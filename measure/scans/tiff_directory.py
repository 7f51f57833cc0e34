"""The directories of a TIFF file, looked through before they are believed: where they lie, and the form of their tags.

TIFF 6.0, section 2, and BigTIFF: a directory is a number of entries and the place of the next one; an entry is a tag,
the type and the count of its numbers, and these themselves or, where they take more room, their place.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_MOST_DIRECTORIES, _MOST_ENTRIES = 1000, 4096
_WHOLE = {1: "B", 3: "H", 4: "I", 16: "Q"}  # unsigned integers, by their types
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


class BadDirectory(ValueError):
    """What is wrong with a file's directories, a part of a sentence."""


@dataclass(frozen=True)
class _Layout:
    """How a file writes its directories: the byte order, and struct's letters for a number of entries and a place."""

    order: str
    entries: str
    place: str

    @property
    def entry_bytes(self) -> int:
        return 4 + 2 * struct.calcsize(self.place)


def check_directories(path: Path) -> list[tuple[int, int]]:
    """Where the directories lie in the file, (first byte, byte after the last) each.

    Raises BadDirectory for a chain of them that leads back to itself, and for tags of a count, type or value that no
    picture can have.
    """
    file_bytes = path.stat().st_size
    with path.open("rb") as file:
        layout, place = _start(file)
        found: dict[int, int] = {}
        for first, after, entries in _directories(file, layout, place):
            if first in found:
                raise BadDirectory("its list of pictures leads back to itself")
            if len(found) == _MOST_DIRECTORIES:
                raise BadDirectory(f"it lists more than {_MOST_DIRECTORIES} pictures")
            found[first] = after
            for entry in range(0, len(entries), layout.entry_bytes):
                _check(file_bytes, layout, entries[entry : entry + layout.entry_bytes])
    return list(found.items())


def _start(file: BinaryIO) -> tuple[_Layout, int]:
    """The file's layout, and the place of its first directory."""
    start = file.read(16)
    order = "<" if start[:2] == b"II" else ">"
    is_big = start[2:4] in (b"+\0", b"\0+")
    layout = _Layout(order, "Q", "Q") if is_big else _Layout(order, "H", "I")
    at = 8 if is_big else 4
    return layout, _number(layout, layout.place, start[at : at + struct.calcsize(layout.place)])


def _directories(file: BinaryIO, layout: _Layout, place: int) -> Iterator[tuple[int, int, bytes]]:
    """Each directory's first byte, the byte after its last, and its entries, as far as the file holds them."""
    while place:
        file.seek(place)
        count = _number(layout, layout.entries, file.read(struct.calcsize(layout.entries)))
        if count > _MOST_ENTRIES:
            raise BadDirectory(f"a picture has {count} tags")
        entries = file.read(count * layout.entry_bytes)
        following = file.read(struct.calcsize(layout.place))
        yield place, file.tell(), entries
        place = _number(layout, layout.place, following)


def _check(file_bytes: int, layout: _Layout, entry: bytes) -> None:
    """One entry, if its tag is one that pictures are read by."""
    tag, kind = struct.unpack(f"{layout.order}HH", entry[:4])
    if tag not in _TAGS:
        return
    name, is_one = _TAGS[tag]
    room = struct.calcsize(layout.place)
    count = _number(layout, layout.place, entry[4 : 4 + room])
    if kind not in _WHOLE:
        raise BadDirectory(f"its tag {name} is no whole number (type {kind})")
    if count < 1 or (is_one and count != 1):
        raise BadDirectory(f"its tag {name} holds {count} numbers" + (", not one" if is_one else ""))
    size = count * struct.calcsize(_WHOLE[kind])
    if size > room:
        if _number(layout, layout.place, entry[4 + room :]) + size > file_bytes:
            raise BadDirectory(f"the {count} numbers of its tag {name} lie beyond its end of {file_bytes} bytes")
    elif tag in _SIZES and _number(layout, _WHOLE[kind], entry[4 + room :][:size]) == 0:
        raise BadDirectory(f"its tag {name} is 0")


def _number(layout: _Layout, letter: str, stored: bytes) -> int:
    try:
        return int(struct.unpack(layout.order + letter, stored)[0])
    except struct.error:
        raise BadDirectory("its list of tags is cut short") from None
