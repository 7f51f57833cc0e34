"""TIFF and BigTIFF files opened: their directories checked before they are believed, and their picture of full size.

TIFF 6.0, section 2, and BigTIFF: a directory is a number of entries and the place of the next one; an entry is a tag,
the type and the count of its numbers, and these themselves or, where they take more room, their place.
"""

import logging
import math
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from tifffile import TIFF, TiffFile, TiffFileError, TiffPage, TiffTag

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

_MOST_DIRECTORIES, _MOST_TAGS = 1000, 4096  # of a file and of a directory: more are damage
_WHOLE = (1, 3, 4, 13, 16, 18)  # types of unsigned integers
_TYPE_BYTES = {int(kind): struct.calcsize(f"={form}") for kind, form in TIFF.DATA_FORMATS.items()}
# What is read with a picture: tags of one number, and of several.
_ONE_NUMBER = frozenset((254, 256, 257, 259, 262, 266, 274, 277, 278, 284, 317, 322, 323))
_NUMBERS = frozenset((258, 273, 279, 320, 324, 325, 338, 339))
_SIZES = (256, 257, 277, 278, 322, 323)  # none of which may be 0
_SUB_IFDS, _CHILDREN = 330, (34665, 34853, 40965)  # tags of further directories; Exif, GPS, Interoperability
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


def check_directories(file: TiffFile) -> list[Extent]:
    """What lies where in the file, (first byte, byte after the last) each: the directories, the numbers of their tags,
    and the pixels that these tell of.

    Raises BadDirectory for a chain of directories that leads back to itself, and for tags of a count, type or value
    that no picture can have.
    """
    file.filehandle.seek(file.tiff.offsetsize if file.is_bigtiff else 4)
    chain = [_number(file, file.tiff.offsetformat)]
    extents, children, found = [(0, file.filehandle.tell())], list[int](), set[int]()
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
            tags, following = _directory(file, place)
            for tag in tags if is_picture else ():
                _check_tag(tag, file.filehandle.size)
        except BadDirectory:
            if is_picture:
                raise
            continue  # what is beside the pictures is not read
        chain += [following] if is_picture else []
        children += [number for tag in tags if tag.code == _SUB_IFDS for number in _numbers(tag)]
        children += [tag.valueoffset for tag in tags if tag.code in _CHILDREN]
        extents += [(place, place + file.tiff.tagnosize + len(tags) * file.tiff.tagsize), *_extents(tags, file)]
    return extents


def _number(file: TiffFile, form: str) -> int:
    try:
        return int(struct.unpack(form, file.filehandle.read(struct.calcsize(form)))[0])
    except struct.error:
        raise BadDirectory("its list of tags is cut short") from None


def _directory(file: TiffFile, place: int) -> tuple[list[TiffTag], int]:
    """A directory's tags, and the place of the next one."""
    file.filehandle.seek(place)
    count = _number(file, file.tiff.tagnoformat)
    if count > _MOST_TAGS:
        raise BadDirectory(f"a picture has {count} tags")
    first = file.filehandle.tell()
    stored = file.filehandle.read(count * file.tiff.tagsize)
    following = _number(file, file.tiff.offsetformat)
    steps = range(0, len(stored), file.tiff.tagsize)
    heads = ((first + step, stored[step : step + file.tiff.tagsize]) for step in steps)
    return [TiffTag.fromfile(file, offset=at, header=head, validate=False) for at, head in heads], following


def _check_tag(tag: TiffTag, file_bytes: int) -> None:
    """One tag, if it is one that pictures are read by."""
    if tag.code not in _ONE_NUMBER | _NUMBERS:
        return
    name = TIFF.TAGS[tag.code]
    if tag.dtype not in _WHOLE:
        raise BadDirectory(f"its tag {name} is no whole number (type {int(tag.dtype)})")
    if tag.count < 1 or (tag.code in _ONE_NUMBER and tag.count != 1):
        only = ", not one" if tag.code in _ONE_NUMBER else ""
        raise BadDirectory(f"its tag {name} holds {tag.count} numbers{only}")
    if tag.valueoffset + tag.valuebytecount > file_bytes:
        raise BadDirectory(f"the {tag.count} numbers of its tag {name} lie beyond its end of {file_bytes} bytes")
    if tag.code in _SIZES and _numbers(tag) == [0]:
        raise BadDirectory(f"its tag {name} is 0")


def _extents(tags: Sequence[TiffTag], file: TiffFile) -> Iterator[Extent]:
    """Of the numbers of a directory's tags, and of the pixels that they tell of."""
    for tag in tags:
        size = tag.count * _TYPE_BYTES.get(int(tag.dtype), 0)
        if size > file.tiff.tagoffsetthreshold:
            yield tag.valueoffset, tag.valueoffset + size
    by_code = {tag.code: tag for tag in tags}
    for places, counts in _STORED:
        if places in by_code and counts in by_code:
            both = zip(_numbers(by_code[places]), _numbers(by_code[counts]), strict=False)
            yield from ((place, place + count) for place, count in both if count)


def _numbers(tag: TiffTag) -> list[int]:
    """None where the tag holds no whole numbers, or the file does not hold them."""
    if tag.dtype not in _WHOLE or tag.valueoffset + tag.valuebytecount > tag.parent.filehandle.size:
        return []
    return [int(number) for number in np.ravel(tag.value)]


def open_tiff(path: Path, max_pixels: int | None = None) -> OpenedPicture:
    """The first full-resolution picture of a TIFF file, or that of the page that the path names.

    Of an address the overviews are opened, too. Of a local file the picture itself is averaged, for how others averaged
    is not known. Raises MeasurementError for a truncated file, for pictures of a kind that `page_radiometry` does not
    know, and for those that claim more than such a file can hold.
    """
    try:
        file = tiff_file(path)
    except DECODING_ERRORS as error:
        # Others than these are of tags that are no numbers, or several.
        reason = str(error) if isinstance(error, OSError | TiffFileError) else "its list of tags is damaged"
        raise damage_error(path, reason) from error
    try:
        taken = check_directories(file)
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
    number = path.page if isinstance(path, ScanPart) and path.page else next(iter(pictures))
    if number not in pictures:
        raise MeasurementError(f"{path}: page {number} of this file is no picture of full size; such are {pages}")
    page, *others = pictures[number]
    problems = []
    if len(pictures) > 1 and not (isinstance(path, ScanPart) and path.page):
        message = (
            f"the file holds {len(pictures)} pictures of full size (pages {pages}), and page {number} was measured"
        )
        problems.append(f"{message}: name those that are frames in images.csv, by the column page")
    if others:
        message = f"page {number} holds {1 + len(others)} pictures of full size (SubIFDs), and one of them was measured"
        problems.append(f"{message}: save the others as pages or files of their own if they are frames")
    return page, tuple(problems)


def _full_pictures(file: TiffFile) -> dict[int, list[TiffPage]]:
    """The pictures of each page, from 1, and of its SubIFDs, the largest first, without masks and without what is small
    beside others, a thumbnail or an overview, whether the file says so or not."""
    held: dict[int, list[TiffPage]] = {}
    for number, page in enumerate((page.aspage() for page in file.pages), 1):
        below = page.pages if page.subifds and page.pages is not None else ()
        own = [one for one in (page, *(one.aspage() for one in below)) if _is_picture(one)]
        held[number] = sorted(own, key=_mean_side, reverse=True)
    side = max((_mean_side(page) for own in held.values() for page in own), default=0.0)
    full = {number: [page for page in own if _mean_side(page) > _FULL_SIZE * side] for number, own in held.items()}
    return {number: own for number, own in full.items() if own}


def _mean_side(page: TiffPage) -> float:
    return math.sqrt(page.imagewidth * page.imagelength)


def _is_picture(page: TiffPage) -> bool:
    """Whether it is neither a reduced picture nor a mask by its tags, and has pixels."""
    is_reduced = int(page.subfiletype) & (_REDUCED_IMAGE | _TRANSPARENCY_MASK)
    return not is_reduced and page.imagewidth > 0 and page.imagelength > 0


def _band_notes(page: TiffPage, radiometry: Radiometry) -> tuple[str, ...]:
    """Which of several bands is used; transparency is none."""
    bands = page.samplesperpixel - sum(int(kind) in _ALPHA for kind in page.extrasamples)
    notes = (radiometry.note,) if radiometry.note else ()
    if bands <= max(radiometry.bands, radiometry.channels):
        return notes
    used = {1: "the first is used", 3: "the first three are used, as red, green and blue"}[radiometry.channels]
    if radiometry.bands:
        used = f"the first {radiometry.bands} are used"
    return (f"the picture has {bands} bands: {used}", *notes)


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
                path, f"its last {size - last} bytes are not part of any page: bytes may have been inserted before"
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
