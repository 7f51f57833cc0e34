"""TIFF and BigTIFF files opened: their directories checked before they are believed, and their picture of full size.

TIFF 6.0, section 2, and BigTIFF: a directory is a number of entries and the place of the next one; an entry is a tag,
the type and the count of its numbers, and these themselves or, where they take more room, their place.
"""

import logging
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from tifffile import TiffFile, TiffPage

from measure.errors import MeasurementError
from measure.scans.cache import OpenedPicture, Segments
from measure.scans.jpeg import rounding_step_dn
from measure.scans.metadata import (
    DECODING_ERRORS,
    JPEG_COMPRESSIONS,
    WHITE_IS_ZERO,
    Radiometry,
    check_size,
    damage_error,
    exif_tags,
    orientation_notes,
    orientation_tag,
    page_radiometry,
    tag_pitch,
)
from measure.scans.remote import Address, ScanPart, tiff_file
from measure.scans.tiff_segments import RawRows, TiffSegments
from measure.tone.declared import ColourTags

Extent = tuple[int, int]

_MOST_DIRECTORIES, _MOST_ENTRIES = 1000, 4096  # of a file and of a directory: more are damage
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
_TRANSFER_FUNCTION, _ICC_PROFILE = 301, 34675  # tags of the tone curve (TIFF 6.0; ICC.1:2022, B.4)
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it finds odd is said in our own messages

TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the first bytes of TIFF and BigTIFF files
_UNCOMPRESSED = 1  # of Compression (TIFF 6.0)
_LOOKED_AT_BYTES = 1 << 16  # after the last that a file accounts for
_JPEG_HEADERS_BYTES = 4096  # tables, size and resolution take fewer
_REDUCED_IMAGE, _TRANSPARENCY_MASK = 1, 4  # bits of NewSubfileType
_ALPHA = (1, 2)  # of ExtraSamples: associated and unassociated transparency
_FULL_SIZE = 0.6  # of the largest picture's side: what is smaller is an overview


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


def open_tiff(path: Path, max_pixels: int | None = None) -> OpenedPicture:
    """The first full-resolution picture of a TIFF file, or that of the page that the path names.

    Parameters
    ----------
    path : of an address the overviews are opened, too. Of a local file the picture itself is averaged, for how others
        averaged is not known.
    max_pixels : as `check_size` takes it.

    Raises
    ------
    MeasurementError
        For a truncated file, for pictures that are no grey, palette or colour scan of up to 16 bits a sample, and for
        those that claim more than such a file can hold.
    """
    try:
        taken = check_directories(path)
        file = tiff_file(path)
    except (BadDirectory, *DECODING_ERRORS) as error:
        raise damage_error(path, str(error)) from error
    try:
        page, problems = _main_page(file, path)
        _check_original(page, path)
        radiometry = page_radiometry(page, path)
        _check_sizes(page, path, max_pixels)
        _check_extent(page, path, taken)
        kind = RawRows if _is_raw(page) else TiffSegments
        segments: Segments = kind(file, page, path, radiometry, _page_rounding_step_dn(file, page))
        overviews = _overviews(file, page, path) if isinstance(path, Address) else ()
        orientation = orientation_tag(page)
        notes = (*orientation_notes(orientation), *_band_notes(page, radiometry))
        return OpenedPicture(segments, tag_pitch(page), notes, problems, overviews, orientation)
    except DECODING_ERRORS as error:
        file.close()
        raise damage_error(path, str(error)) from error
    except BaseException:
        file.close()
        raise


def _main_page(file: TiffFile, path: Path) -> tuple[TiffPage, tuple[str, ...]]:
    """The page that the path names, or else the first one that is a picture; and what it leaves out."""
    pictures = _full_pictures(file)
    if not pictures:
        raise damage_error(path, "it holds no picture")
    pages = ", ".join(map(str, pictures))
    if isinstance(path, ScanPart) and path.page:
        if path.page not in pictures:
            raise MeasurementError(
                f"{path}: page {path.page} of this file is no picture of full size; such are {pages}"
            )
        return pictures[path.page], ()
    first, page = next(iter(pictures.items()))
    if len(pictures) == 1:
        return page, ()
    message = f"the file holds {len(pictures)} pictures of full size (pages {pages}), and page {first} was measured"
    return page, (f"{message}: name those that are frames in images.csv, by the column page",)


def _full_pictures(file: TiffFile) -> dict[int, TiffPage]:
    """The pictures by their pages, from 1: each the largest of what stands on the page and below it, without masks and
    without what is small beside others, a thumbnail or an overview, whether the file says so or not."""
    largest: dict[int, TiffPage] = {}
    for number, page in enumerate((page.aspage() for page in file.pages), 1):
        below = page.pages if page.subifds and page.pages is not None else ()
        own = [one for one in (page, *(one.aspage() for one in below)) if _is_picture(one)]
        if own:
            largest[number] = max(own, key=lambda one: one.imagewidth * one.imagelength)
    side = max((np.sqrt(page.imagewidth * page.imagelength) for page in largest.values()), default=0.0)
    return {
        number: page
        for number, page in largest.items()
        if np.sqrt(page.imagewidth * page.imagelength) > _FULL_SIZE * side
    }


def _is_picture(page: TiffPage) -> bool:
    """Whether it is neither a reduced picture nor a mask by its tags, and has pixels."""
    is_reduced = int(page.subfiletype) & (_REDUCED_IMAGE | _TRANSPARENCY_MASK)
    return not is_reduced and page.imagewidth > 0 and page.imagelength > 0


def _band_notes(page: TiffPage, radiometry: Radiometry) -> tuple[str, ...]:
    """Which of several bands is used; transparency is none."""
    bands = page.samplesperpixel - sum(int(kind) in _ALPHA for kind in page.extrasamples)
    if bands <= radiometry.channels:
        return ()
    used = "the first is used" if radiometry.channels == 1 else "the first three are used, as red, green and blue"
    return (f"the picture has {bands} bands: {used}",)


def _overviews(file: TiffFile, full: TiffPage, path: Path) -> tuple[Segments, ...]:
    """The same picture made small, of the same form and samples: further pages, or below the page itself."""
    below = full.pages if full.subifds and full.pages is not None else ()
    pages = [page.aspage() for page in (*file.pages, *below)]
    small = [page for page in pages if int(page.subfiletype) & (_REDUCED_IMAGE | _TRANSPARENCY_MASK) == _REDUCED_IMAGE]
    alike = [page for page in small if _is_overview(page, full)]
    return tuple(TiffSegments(file, page, path, page_radiometry(page, path), 0.0) for page in alike)


def _is_overview(page: TiffPage, full: TiffPage) -> bool:
    """Whether it has the full picture's samples, and its sides but for a factor and what is left of a pixel."""
    if (page.bitspersample, page.samplesperpixel) != (full.bitspersample, full.samplesperpixel):
        return False
    if page.photometric != full.photometric or page.imagewidth < 1 or page.imagelength < 1:
        return False
    factor = full.imagewidth / page.imagewidth
    return factor > 1.5 and abs(full.imagelength / factor - page.imagelength) <= 1.5


def _check_original(page: TiffPage, path: Path) -> None:
    """Marks are measured where the scanner saw them: in a resampled frame the film is gone from their places, and the
    noise from their standard deviations."""
    if re.match(r'\s*\{"reseau": .*"pitch_mm": ', page.description):
        raise MeasurementError(
            f"{path}: is a frame that reseau has resampled, and no scan. Measure the scan that it was made of."
        )


def _check_sizes(page: TiffPage, path: Path, max_pixels: int | None) -> None:
    """Of the picture, and of its largest tile or strip."""
    pixel_bytes = page.samplesperpixel * -(-page.bitspersample // 8)
    size = page.imagewidth, page.imagelength
    file_bytes = path.stat().st_size
    stored = min(sum(page.databytecounts), file_bytes)
    check_size(path, "a picture", size, size[0] * size[1] * pixel_bytes, stored, max_pixels)
    if page.is_tiled:
        side = page.tilewidth, page.tilelength
        largest = min(max(page.databytecounts, default=0), file_bytes)
        check_size(path, "a tile", side, side[0] * side[1] * pixel_bytes, largest, max_pixels)


def _check_extent(page: TiffPage, path: Path, taken: list[Extent]) -> None:
    """A file whose tiles or strips lie beyond its end is truncated: better said now than at the last window. Where
    nothing but the pixels is stored, wrong places show nowhere else: by what is taken twice, and what by nothing.

    taken: what lies where, by all tags of the file.
    """
    size = path.stat().st_size
    stored = [
        (offset, offset + count)
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False)
        if offset and count
    ]
    part = "tiles" if page.is_tiled else "strips"
    if not stored:
        raise damage_error(path, "it says nowhere in the file where the picture's data are")
    missing = sum(end > size for _, end in stored)
    if missing:
        raise damage_error(path, f"{missing} of {len(stored)} {part} lie beyond its end of {size} bytes")
    if page.compression != _UNCOMPRESSED:
        return
    starts, ends = np.array(sorted(set(stored))).T
    lies_over = (starts[1:] < ends[:-1]).any()
    for first, after in set(taken) - set(stored):
        beyond = int(np.searchsorted(ends, first, "right"))
        lies_over |= beyond < len(starts) and starts[beyond] < after
    if lies_over:
        raise damage_error(path, f"its {part} lie over one another or over its tags")
    if any(other.offset >= ends[-1] for other in page.parent.pages):
        return  # another picture's tags stand behind the pixels, where they are said to: nothing was put in before them
    with path.open("rb") as file:
        last = max(end for _, end in taken)
        file.seek(last)
        if any(file.read(_LOOKED_AT_BYTES)):
            raise damage_error(
                path, f"its last {size - last} bytes belong to nothing, as if some had been put in before"
            )


def _is_raw(page: TiffPage) -> bool:
    """Rows stand one after the other, uncompressed."""
    return (
        page.is_contiguous
        and not page.is_tiled
        and page.predictor == 1
        and page.fillorder == 1
        and (page.planarconfig == 1 or page.samplesperpixel == 1)
    )


def _page_rounding_step_dn(file: TiffFile, page: TiffPage) -> float:
    """Of a page compressed as JPEG: its tables stand in a tag, or else at the beginning of every tile or strip."""
    if page.compression not in JPEG_COMPRESSIONS:
        return 0.0
    start = page.jpegtables or page.jpegheader
    if start is None:
        first = next(index for index, count in enumerate(page.databytecounts) if count)
        file.filehandle.seek(page.dataoffsets[first])
        start = file.filehandle.read(min(page.databytecounts[first], _JPEG_HEADERS_BYTES))
    return rounding_step_dn(start)


def tiff_colour_tags(path: Path) -> ColourTags:
    """What the tags of a TIFF file's first page say of its tone curve. Raises one of DECODING_ERRORS."""
    with tiff_file(path) as file:
        page = file.pages.first.aspage()
        profile, transfer = page.tags.valueof(_ICC_PROFILE), page.tags.valueof(_TRANSFER_FUNCTION)
        exif = exif_tags(page)
        if transfer is None or int(page.photometric) == WHITE_IS_ZERO:
            return ColourTags(bytes(profile or b""), exif=exif)
        first = np.asarray(transfer, float).ravel()[: 2**page.bitspersample]
        return ColourTags(bytes(profile or b""), first, exif)
