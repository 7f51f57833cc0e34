"""TIFF and BigTIFF files: checks of their directories, and their full-size picture.

TIFF 6.0, section 2, and BigTIFF: a directory is a number of entries and the place of the next directory; an entry is a
tag, the type and count of its numbers, and the numbers themselves or, if they do not fit, their place.

Tiles and strips are decoded separately: damage of one does not affect the others.
"""

import logging
import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path
from threading import Lock

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from tifffile import TIFF, TiffFile, TiffFileError, TiffPage, TiffTag
from tifffile.tifffile import jpeg_decode_colorspace

from measure.errors import MeasurementError
from measure.scans.cache import LostPart, OpenedPicture, Place, Segments
from measure.scans.jpeg import decode_checked, quantisation_step_dn
from measure.scans.metadata import (
    DECODING_ERRORS,
    JPEG_COMPRESSIONS,
    WHITE_IS_ZERO,
    WORD_DN,
    Radiometry,
    Samples,
    check_size,
    damage_error,
    exif_tags,
    orientation_notes,
    orientation_tag,
    page_radiometry,
    tag_pitch,
    unsupported_error,
)
from measure.scans.remote import Address, Extent, ScanPart
from measure.tone.curve import ColourTags

_MOST_DIRECTORIES, _MOST_TAGS = 1000, 4096  # of a file and of a directory: more are damage
_WHOLE = (1, 3, 4, 13, 16, 18)  # types of unsigned integers
_TYPE_BYTES = {int(kind): struct.calcsize(f"={form}") for kind, form in TIFF.DATA_FORMATS.items()}
# Tags needed to read a picture: those with one number, and those with several.
_ONE_NUMBER = frozenset((254, 256, 257, 259, 262, 266, 274, 277, 278, 284, 317, 322, 323))
_NUMBERS = frozenset((258, 273, 279, 320, 324, 325, 338, 339))
_SIZES = (256, 257, 277, 278, 322, 323)  # none of which may be 0
_SUB_IFDS, _CHILDREN = 330, (34665, 34853, 40965)  # tags of further directories; Exif, GPS, Interoperability
_STORED = ((273, 279), (324, 325), (513, 514))  # tags with places and byte counts of data outside of the directory
_TRANSFER_FUNCTION, _ICC_PROFILE = 301, 34675  # tags of the tone curve (TIFF 6.0; ICC.1:2022, B.4)
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # our own messages cover its warnings

TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the first bytes of TIFF and BigTIFF files
_UNCOMPRESSED = 1  # of Compression (TIFF 6.0)
_TRAILING_BYTES = 1 << 16  # checked after the last extent of a file
_JPEG_HEADERS_BYTES = 4096  # tables, size and resolution need fewer
_REDUCED_IMAGE, _NOT_WHOLE = 1, 1 | 4  # bits of NewSubfileType: reduced, and reduced or a transparency mask
_ALPHA = (1, 2)  # of ExtraSamples: associated and unassociated transparency
_FULL_SIZE = 0.6  # fraction of the largest picture's side: a smaller picture is an overview
_INTO_MEMORY = (5, 8, 32773, 32946, 34926, 50000)  # LZW, deflate, PackBits, zstd: these give bytes
_FLOAT_PREDICTOR = 3  # of Predictor (TIFF Technical Note 3)
_MAPPED_BYTES = 4 << 20  # read at a time from an uncompressed file; larger tiles and strips are not copied


class BadDirectory(ValueError):
    """Damage of a file's directories; the message is a part of a sentence."""


def check_directories(file: TiffFile) -> list[Extent]:
    """Check a file's directories and list the occupied extents, (first byte, byte after the last) each: directories,
    the numbers of their tags, and pixels.

    Raises BadDirectory for a chain of directories that leads back to itself, and for tags with a count, type or value
    that is impossible for a picture.
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
            tags, following = _directory(file, place, is_picture)
        except BadDirectory:
            if is_picture:
                raise
            continue  # directories other than pictures are not needed
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


def _directory(file: TiffFile, place: int, is_picture: bool) -> tuple[list[TiffTag], int]:
    """Read a directory's tags and the place of the next directory; check the tags needed to read a picture."""
    file.filehandle.seek(place)
    count = _number(file, file.tiff.tagnoformat)
    if count > _MOST_TAGS:
        raise BadDirectory(f"a picture has {count} tags")
    first = file.filehandle.tell()
    stored = file.filehandle.read(count * file.tiff.tagsize)
    following = _number(file, file.tiff.offsetformat)
    steps = range(0, len(stored), file.tiff.tagsize)
    heads = ((first + step, stored[step : step + file.tiff.tagsize]) for step in steps)
    tags = [TiffTag.fromfile(file, offset=at, header=head, validate=False) for at, head in heads]
    file_bytes = file.filehandle.size
    for tag in (tag for tag in tags if is_picture and tag.code in _ONE_NUMBER | _NUMBERS):
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
    return tags, following


def _extents(tags: Sequence[TiffTag], file: TiffFile) -> Iterator[Extent]:
    """List the extents of the numbers of a directory's tags, and of the pixels to which they point."""
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
    """Numbers of a tag; empty if they are not whole numbers, or lie beyond the end of the file."""
    if tag.dtype not in _WHOLE or tag.valueoffset + tag.valuebytecount > tag.parent.filehandle.size:
        return []
    return [int(number) for number in np.ravel(tag.value)]


def open_tiff(path: Path, max_pixels: int | None) -> OpenedPicture:
    """Open the first full-resolution picture of a TIFF file, or the page that the path names.

    Overviews are opened for addresses only. For a local file the picture itself is averaged, since it is unknown how
    another program averaged. Raises MeasurementError for a truncated file, for pictures of a kind that
    `page_radiometry` does not know, and for sizes that exceed the limits of `check_size`.
    """
    try:
        file = _tiff_file(path)
    except DECODING_ERRORS as error:
        # Other errors come from tags that are not numbers, or hold several.
        reason = str(error) if isinstance(error, OSError | TiffFileError) else "its list of tags is damaged"
        raise damage_error(path, reason) from error
    try:
        taken = check_directories(file)
        page, problems = _main_page(file, path)
        if re.match(r'\s*\{"reseau": .*"pitch_mm": ', page.description):
            # A resampled frame lacks the film's deformation, and its noise no longer gives the marks' uncertainty.
            raise MeasurementError(
                f"{path}: is a frame that reseau has resampled, and no scan. Measure the scan that it was made of."
            )
        radiometry = page_radiometry(page, path)
        _check_sizes(page, path, max_pixels)
        _check_extent(page, path, taken)
        has_rows_in_order = page.is_contiguous and not page.is_tiled and page.predictor == 1 and page.fillorder == 1
        is_raw = has_rows_in_order and (page.planarconfig == 1 or page.samplesperpixel == 1)
        kind = RawRows if is_raw else TiffSegments
        segments: Segments = kind(file, page, path, radiometry, _page_quantisation_step_dn(file, page))
        overviews = _overviews(file, page, path) if isinstance(path, Address) else ()
        orientation = orientation_tag(page)
        notes = (*orientation_notes(orientation), *_band_notes(page, radiometry))
        bits = page.bitspersample
        return OpenedPicture(segments, tag_pitch(page), notes, problems, overviews, orientation, bits)
    except DECODING_ERRORS as error:
        file.close()
        raise damage_error(path, str(error)) from error
    except BaseException:
        file.close()
        raise


def _tiff_file(path: Path) -> TiffFile:
    """Open a local or remote TIFF file. Raises one of DECODING_ERRORS, or as `Address` does."""
    return TiffFile(path.open("rb") if isinstance(path, Address) else path)


def _main_page(file: TiffFile, path: Path) -> tuple[TiffPage, tuple[str, ...]]:
    """Page that the path names, or else the first picture; and problems, one sentence each, if there are others."""
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
    """Full-size pictures by the number of their page, from 1: of the page and its SubIFDs, the largest first. Masks,
    thumbnails and overviews are left out, also where the file does not declare them as such."""
    held: dict[int, list[TiffPage]] = {}
    for number, page in enumerate((page.aspage() for page in file.pages), 1):
        whole = [one for one in (page, *_pages_below(page)) if not int(one.subfiletype) & _NOT_WHOLE]
        own = [one for one in whole if one.imagewidth > 0 and one.imagelength > 0]
        held[number] = sorted(own, key=_mean_side, reverse=True)
    side = max((_mean_side(page) for own in held.values() for page in own), default=0.0)
    full = {number: [page for page in own if _mean_side(page) > _FULL_SIZE * side] for number, own in held.items()}
    return {number: own for number, own in full.items() if own}


def _pages_below(page: TiffPage) -> list[TiffPage]:
    """SubIFDs of a page."""
    return [one.aspage() for one in page.pages] if page.subifds and page.pages is not None else []


def _mean_side(page: TiffPage) -> float:
    return math.sqrt(page.imagewidth * page.imagelength)


def _band_notes(page: TiffPage, radiometry: Radiometry) -> tuple[str, ...]:
    """Notes on the bands used, if the picture has more; transparency does not count."""
    bands = page.samplesperpixel - sum(int(kind) in _ALPHA for kind in page.extrasamples)
    notes = (radiometry.note,) if radiometry.note else ()
    if bands <= max(radiometry.bands, radiometry.channels):
        return notes
    used = {1: "the first is used", 3: "the first three are used, as red, green and blue"}[radiometry.channels]
    if radiometry.bands:
        used = f"the first {radiometry.bands} are used"
    return (f"the picture has {bands} bands: {used}", *notes)


def _overviews(file: TiffFile, full: TiffPage, path: Path) -> tuple[Segments, ...]:
    """Open the reduced copies of the picture: other pages or SubIFDs with the same kind of samples and, within a pixel,
    the same ratio of sides."""
    samples = full.bitspersample, full.samplesperpixel, full.photometric
    small = list[TiffPage]()
    for page in (*(page.aspage() for page in file.pages), *_pages_below(full)):
        is_reduced = int(page.subfiletype) & _NOT_WHOLE == _REDUCED_IMAGE
        if not is_reduced or (page.bitspersample, page.samplesperpixel, page.photometric) != samples:
            continue
        if page.imagewidth > 0 and page.imagelength > 0:
            factor = full.imagewidth / page.imagewidth
            if factor > 1.5 and abs(full.imagelength / factor - page.imagelength) <= 1.5:
                small.append(page)
    return tuple(TiffSegments(file, page, path, page_radiometry(page, path), 0.0) for page in small)


def _check_sizes(page: TiffPage, path: Path, max_pixels: int | None) -> None:
    """Check the sizes of the picture and of its largest tile."""
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
    """Refuse a file whose tiles or strips lie beyond its end: it is truncated.

    In an uncompressed picture wrong places show in no other way, so that extents that overlap, and bytes that belong to
    no extent, are refused, too. taken: extents by all tags of the file.
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
        return  # another picture's tags lie after the pixels, where expected: no bytes were inserted before them
    with path.open("rb") as file:
        last = max(end for _, end in taken)
        file.seek(last)
        if any(file.read(_TRAILING_BYTES)):
            raise damage_error(
                path, f"its last {size - last} bytes are not part of any page: bytes may have been inserted before"
            )


def _page_quantisation_step_dn(file: TiffFile, page: TiffPage) -> float:
    """Quantisation step of a page compressed as JPEG, else 0. Its tables are in a tag, or at the beginning of every
    tile or strip."""
    if page.compression not in JPEG_COMPRESSIONS:
        return 0.0
    start = page.jpegtables or page.jpegheader
    if start is None:
        first = next(index for index, count in enumerate(page.databytecounts) if count)
        file.filehandle.seek(page.dataoffsets[first])
        start = file.filehandle.read(min(page.databytecounts[first], _JPEG_HEADERS_BYTES))
    return quantisation_step_dn(start)


def tiff_colour_tags(path: Path) -> ColourTags:
    """Read the tags of a TIFF file's first page that declare its tone curve. Raises one of DECODING_ERRORS."""
    with _tiff_file(path) as file:
        page = file.pages.first.aspage()
        profile, transfer = page.tags.valueof(_ICC_PROFILE), page.tags.valueof(_TRANSFER_FUNCTION)
        exif = exif_tags(page)
        if transfer is None or int(page.photometric) == WHITE_IS_ZERO:
            return ColourTags(bytes(profile or b""), exif=exif)
        first = np.asarray(transfer, float).ravel()[: 2**page.bitspersample]
        return ColourTags(bytes(profile or b""), first, exif)


class TiffSegments(Segments):
    """The tiles or strips of a TIFF page."""

    def __init__(
        self, file: TiffFile, page: TiffPage, path: Path, radiometry: Radiometry, quantisation_step_dn: float
    ) -> None:
        self._file, self._page, self._path, self._radiometry = file, page, path, radiometry
        self._reading = Lock()
        self._address = path if isinstance(path, Address) else None
        self.quantisation_step_dn = quantisation_step_dn
        self.channels, self.full_scale_dn = radiometry.channels, radiometry.full_scale_dn
        self.sample_bytes = radiometry.sample_bytes
        self.height_px, self.width_px = page.imagelength, page.imagewidth
        self.segment_height_px = page.tilelength if page.is_tiled else min(page.rowsperstrip, self.height_px)
        self.segment_width_px = page.tilewidth if page.is_tiled else self.width_px
        self._grid = (-(-self.height_px // self.segment_height_px), -(-self.width_px // self.segment_width_px))
        self._planes = radiometry.used_samples if page.planarconfig == 2 else 1
        self._stored_dtype = np.dtype(page.dtype).newbyteorder(file.byteorder)
        self._samples = page.samplesperpixel if page.planarconfig == 1 else 1
        self._row_bytes = -(-self.segment_width_px * self._samples * page.bitspersample // 8)
        self._is_float, self._spanning = self._stored_dtype.kind == "f", Lock()
        self._lost: dict[tuple[int, int], LostPart] = {}
        wanted = self._planes * self._grid[0] * self._grid[1]
        if min(len(page.dataoffsets), len(page.databytecounts)) < wanted:
            raise damage_error(path, f"{len(page.dataoffsets)} of {wanted} tiles or strips are listed")
        if not (page.compression == _UNCOMPRESSED or page.compression in TIFF.DECOMPRESSORS):
            raise unsupported_error(path, f"compression {int(page.compression)}")
        known = (1, 2, _FLOAT_PREDICTOR) if self._is_float else (1, 2)
        if page.predictor not in known and page.compression in (_UNCOMPRESSED, *_INTO_MEMORY):
            raise unsupported_error(path, f"predictor {int(page.predictor)}")
        if page.compression == _UNCOMPRESSED:
            self._check_bytes()

    def _check_bytes(self) -> None:
        """Compare the size of an uncompressed picture by its tags with its number of bytes: rows read from wrong places
        look like rows."""
        wide, tall = self._row_bytes, self.segment_height_px
        rows = self._grid[1] * self._planes * (self._grid[0] * tall if self._page.is_tiled else self.height_px)
        stored = sum(count or tall * wide for count in self._page.databytecounts)
        padded = self._grid[1] * self._planes * self._grid[0] * tall * wide
        if not rows * wide <= stored < (rows + 1) * wide and stored != padded:
            raise damage_error(self._path, f"its tiles or strips hold {stored} bytes, and should {rows * wide}")

    @property
    def lost(self) -> Sequence[LostPart]:
        """Tiles and strips that could not be decoded."""
        return tuple(self._lost.values())

    def fetch(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        """Fetch segments of an address by one request; those of a local file are read when they are decoded."""
        if self._address is None or not places:
            return {}
        indices = [self._indices(*place) for place in places]
        counts, offsets = self._page.databytecounts, self._page.dataoffsets
        extents = [(offsets[index], offsets[index] + counts[index]) for own in indices for index in own]
        parts = iter(self._address.ranges(extents))
        return {place: [next(parts) for _ in own] for place, own in zip(places, indices, strict=True)}

    def _indices(self, row: int, column: int) -> list[int]:
        """Indices of a segment's tiles or strips, one for each plane."""
        rows, columns = self._grid
        return [row * columns + column + plane * rows * columns for plane in range(self._planes)]

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """Decode segment (row, column); separate planes are joined."""
        height = min(self.segment_height_px, self.height_px - row * self.segment_height_px)
        width = min(self.segment_width_px, self.width_px - column * self.segment_width_px)
        indices = self._indices(row, column)
        given: Sequence[bytes | None] = stored or [None] * len(indices)
        try:
            planes = [self._decode(*own, height, width) for own in zip(indices, given, strict=True)]
            samples = planes[0] if len(planes) == 1 else np.concatenate(planes, axis=-1)
            if samples.shape[0] < height or samples.shape[1] < width:
                raise ValueError("it is cut short")
        except NotImplementedError as error:
            raise unsupported_error(self._path, str(error)) from error
        except DECODING_ERRORS as error:
            place = column * self.segment_width_px, row * self.segment_height_px
            part = "tile" if self._page.is_tiled else "strip"
            self._lost[row, column] = LostPart(*place, width, height, f"{part} {indices[0]}: {error}")
            dtype = np.uint8 if self.sample_bytes == 1 else np.uint16
            return np.full((height, width, self.channels), self.full_scale_dn // 2, dtype)
        return self._values(samples[:height, :width])

    def _values(self, stored: NDArray[np.generic]) -> Samples:
        """Convert stored numbers to values. The scale of floating-point numbers takes one pass over the picture."""
        if self._is_float:
            with self._spanning:
                if self._radiometry.span is None:
                    self._radiometry = replace(self._radiometry, span=self._float_span())
        return self._radiometry.apply(stored)

    def _float_span(self) -> tuple[float, float]:
        """Floating-point numbers that map to 0 and full scale: the smallest usual scale that holds all finite numbers
        of the picture, else the extremes. Undecodable parts are ignored."""
        extremes = list[float]()
        page = TiffSegments(self._file, self._page, self._path, self._radiometry, self.quantisation_step_dn)
        page._reading = self._reading  # threads of both move the position in one file
        rows, columns = page._grid
        for row, column in product(range(rows), range(columns)):
            height = min(page.segment_height_px, self.height_px - row * page.segment_height_px)
            width = min(page.segment_width_px, self.width_px - column * page.segment_width_px)
            for index in page._indices(row, column):
                with suppress(*DECODING_ERRORS):
                    stored = np.asarray(page._decode(index, None, height, width))[:height, :width]
                    finite = stored[..., : self.channels][np.isfinite(stored[..., : self.channels])]
                    extremes += [float(finite.min()), float(finite.max())] if finite.size else []
        low, greatest = min(min(extremes, default=0.0), 0.0), max(extremes, default=1.0)
        usual = (full for full in (1.0, 255.0, WORD_DN) if low == 0.0 and greatest <= full)
        return low, next(usual, max(greatest, low + 1e-9))

    def _decode(self, index: int, given: bytes | None, height_px: int, width_px: int) -> NDArray[np.generic]:
        """Decode a tile or strip: (height, width, samples) stored numbers, at least height_px by width_px; zeros for a
        tile that the file omits. given: its bytes, None to read them. Raises one of DECODING_ERRORS."""
        page = self._page
        if not page.databytecounts[index]:
            return np.zeros((height_px, self.segment_width_px, self._samples), page.dtype)
        data = self._stored_bytes(index) if given is None else given
        if page.compression in JPEG_COMPRESSIONS:
            return self._decode_jpeg(bytes(data), height_px, width_px)
        if page.predictor != _FLOAT_PREDICTOR and page.compression in (_UNCOMPRESSED, *_INTO_MEMORY):
            return self._decode_bytes(data, height_px)
        samples, _, _ = page.decode(bytes(data), index)
        if samples is None:
            raise ValueError("it holds nothing")
        return np.asarray(samples[0])

    def _decode_jpeg(self, data: bytes, height_px: int, width_px: int) -> NDArray[np.generic]:
        page = self._page
        colours = jpeg_decode_colorspace(page.photometric, page.planarconfig, page.extrasamples, page.is_jfif)

        def decode(stream: bytes) -> NDArray[np.generic]:
            return np.asarray(
                imagecodecs.jpeg_decode(
                    stream,
                    bitspersample=page.bitspersample,
                    tables=page.jpegtables,
                    header=page.jpegheader,
                    colorspace=colours[0],
                    outcolorspace=colours[1],
                    shape=(self.segment_height_px, self.segment_width_px),
                )
            )

        samples, damage = decode_checked(data, decode, page.jpegtables)
        if damage:
            raise ValueError(damage)
        right = (height_px, width_px), (self.segment_height_px, self.segment_width_px)
        if samples.shape[:2] not in ((tall, wide) for tall, _ in right for _, wide in right):
            raise ValueError(f"it holds {samples.shape[1]} x {samples.shape[0]} px")
        return samples.reshape(*samples.shape[:2], self._samples)

    def _decode_bytes(self, data: bytes | NDArray[np.uint8], height_px: int) -> NDArray[np.generic]:
        """Decode a tile or strip of rows that begin at whole bytes. The last strip may be as tall as the others."""
        page, shape = self._page, (-1, self.segment_width_px, self._samples)
        if page.fillorder == 2:
            data = bytes(imagecodecs.bitorder_decode(bytes(data)))
        full = self.segment_height_px * self._row_bytes
        if page.compression == _UNCOMPRESSED:
            stored = np.frombuffer(data, np.uint8)
        else:
            # NumPy allocates large pages, which takes a quarter less time than the decoder's own memory. One byte more
            # than needed shows a stream that holds too much.
            memory = np.empty(full + 1, np.uint8)
            stored = memory[: len(TIFF.DECOMPRESSORS[page.compression](data, out=memory))]
        right = (full,) if page.is_tiled else (full, height_px * self._row_bytes)
        if len(stored) not in right:
            more = "more" if len(stored) > full else len(stored)
            raise ValueError(f"it holds {more} bytes, and should {right[-1]}")
        if page.bitspersample in (8, 16):
            numbers = stored.view(self._stored_dtype).reshape(shape)
        else:
            run = self.segment_width_px * self._samples
            numbers = imagecodecs.packints_decode(bytes(stored), self._stored_dtype, page.bitspersample, runlen=run)
            numbers = numbers.reshape(shape)
        numbers = numbers.astype(page.dtype, copy=False)
        return np.asarray(numbers if page.predictor == 1 else TIFF.UNPREDICTORS[page.predictor](numbers, axis=-2))

    def _stored_bytes(self, index: int) -> bytes | NDArray[np.uint8]:
        """Read the stored bytes of a tile or strip. Large ones are mapped instead of copied; for small ones a copy is
        quicker."""
        offset, size = self._page.dataoffsets[index], self._page.databytecounts[index]
        if self._address is not None:
            return self._address.ranges([(offset, offset + size)])[0]
        with self._reading:
            if size > _MAPPED_BYTES:
                return self._file.filehandle.memmap_array(np.uint8, (size,), offset)
            self._file.filehandle.seek(offset)
            return bytes(self._file.filehandle.read(size))

    def close(self) -> None:
        self._file.close()


class RawRows(TiffSegments):
    """Uncompressed file with its rows in order: any part is read directly, regardless of strips, and not cached."""

    def __init__(
        self, file: TiffFile, page: TiffPage, path: Path, radiometry: Radiometry, quantisation_step_dn: float
    ) -> None:
        super().__init__(file, page, path, radiometry, quantisation_step_dn)
        self.segment_height_px, self.segment_width_px = 1, self.width_px

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        samples = np.empty((1, self.width_px, self.channels), np.uint8 if self.sample_bytes == 1 else np.uint16)
        self.fill(samples, row, 0)
        return samples

    def fill(self, samples: Samples, row0: int, col0: int) -> None:
        """Fill samples (height, width, channels) with the part of the picture that begins at a row and column."""
        at_a_time = max(_MAPPED_BYTES // self._row_bytes, 1)
        for first in range(0, len(samples), at_a_time):
            part, row = samples[first : first + at_a_time], row0 + first
            rows = self._stored_rows(row, len(part))
            part[:] = self._values(rows[:, col0 : col0 + part.shape[1]])

    def _stored_rows(self, row0: int, height: int) -> NDArray[np.generic]:
        """(height, width, samples) stored numbers from a row on. Those of a local file are mapped: only the memory
        pages of the columns that are used are read, and none is kept."""
        start = int(self._page.dataoffsets[0]) + row0 * self._row_bytes
        shape = (height, self.width_px, self._page.samplesperpixel)
        if self._address is not None:
            (data,) = self._address.ranges([(start, start + height * self._row_bytes)])
            return np.ndarray(shape, self._stored_dtype, data)
        try:
            with self._reading:
                return self._file.filehandle.memmap_array(self._stored_dtype, shape, start)
        except (ValueError, OSError) as error:
            raise damage_error(self._path, f"rows {row0} to {row0 + height - 1} lie beyond its end") from error
