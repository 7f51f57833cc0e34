"""TIFF and BigTIFF files by tiles and strips: every compression that tifffile and imagecodecs know."""

import logging
import struct
from mmap import ACCESS_READ, ALLOCATIONGRANULARITY, mmap
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from tifffile import TIFF, TiffFile, TiffFileError, TiffPage

from measure.errors import MeasurementError
from measure.scans.quantisation import rounding_step_dn
from measure.scans.radiometry import Radiometry, Samples
from measure.scans.resolution import NO_TAGS, TIFF_UNIT, Pitch, pitch_from_density
from measure.scans.segments import Segments

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it finds odd is said in our own messages

_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_JPEG_COMPRESSIONS = (6, 7, 34892, 33007)
_JPEG_HEADERS_BYTES = 4096  # tables, size and resolution take fewer
_INTO_MEMORY = (5, 8, 32946, 34926, 50000)  # LZW, deflate, zstd: their decoders write into memory that they are given
_LARGE_BYTES = 4 << 20  # decoded; from here on numpy asks the system for memory in large pages
_MAPPED_BYTES = 4 << 20  # of an uncompressed file, taken at a time; larger tiles and strips are not copied
_REDUCED_IMAGE, _TRANSPARENCY_MASK = 1, 4  # bits of NewSubfileType
DECODING_ERRORS = (RuntimeError, ValueError, OSError, IndexError, TypeError, struct.error, TiffFileError)


def open_tiff(path: Path) -> tuple[Segments, Pitch, tuple[str, ...]]:
    """The first full-resolution picture of a TIFF file, its pitch, and notes.

    Raises MeasurementError for a truncated file and for pictures that are no grey, palette or colour scan of up to
    16 bits a sample.
    """
    try:
        file = TiffFile(path)
    except DECODING_ERRORS as error:
        raise broken(path, str(error)) from error
    try:
        page, notes = _main_page(file, path)
        _check_extent(page, path)
        segments: Segments = (RawRows if _is_raw(page) else TiffSegments)(file, page, path)
        return segments, tag_pitch(page), notes
    except BaseException:
        file.close()
        raise


def broken(path: Path, what: str) -> MeasurementError:
    return MeasurementError(
        f"{path} is damaged or truncated ({what.rstrip('.')}): copy it anew from the original, or rescan"
    )


def _main_page(file: TiffFile, path: Path) -> tuple[TiffPage, tuple[str, ...]]:
    """The first page that is neither a thumbnail nor a mask."""
    try:
        pages = [page.aspage() for page in file.pages]
    except DECODING_ERRORS as error:
        raise broken(path, str(error)) from error
    full = [page for page in pages if not int(page.subfiletype) & (_REDUCED_IMAGE | _TRANSPARENCY_MASK)]
    full = [page for page in full if page.imagewidth > 0 and page.imagelength > 0]
    if not full:
        raise broken(path, "it holds no picture")
    notes = []
    if len(full) > 1:
        notes.append(f"the file holds {len(full)} pictures: the first was taken")
    return full[0], (*notes, *orientation_notes(full[0]))


def orientation_notes(page: TiffPage) -> tuple[str, ...]:
    """A viewer may show the picture turned: whoever reads places off one must know."""
    orientation = int(page.tags.valueof(274, default=1))
    if orientation == 1:
        return ()
    return (f"the file's orientation tag ({orientation}) is not applied: columns and rows are as stored",)


def _check_extent(page: TiffPage, path: Path) -> None:
    """A file whose tiles or strips lie beyond its end is truncated: better said now than at the last window."""
    size = path.stat().st_size
    ends = [
        offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False) if offset and count
    ]
    if not ends:
        raise broken(path, "it says nowhere in the file where the picture's data are")
    if max(ends) > size:
        missing = sum(end > size for end in ends)
        part = "tiles" if page.is_tiled else "strips"
        raise broken(path, f"{missing} of {len(ends)} {part} lie beyond its end of {size} bytes")


def _is_raw(page: TiffPage) -> bool:
    """Rows stand one after the other, uncompressed."""
    return (
        page.is_contiguous
        and not page.is_tiled
        and page.predictor == 1
        and page.fillorder == 1
        and (page.planarconfig == 1 or page.samplesperpixel == 1)
    )


def tag_pitch(page: TiffPage) -> Pitch:
    """From XResolution, YResolution and ResolutionUnit (inch where it is absent, as TIFF 6.0 says)."""
    try:
        density = [tuple(page.tags[name].value) for name in ("XResolution", "YResolution")]
    except KeyError:
        return NO_TAGS
    x, y = (numerator / denominator if denominator else 0.0 for numerator, denominator in density)
    return pitch_from_density(x, y, TIFF_UNIT.get(int(page.tags.valueof("ResolutionUnit", default=2))))


def _page_radiometry(page: TiffPage, path: Path) -> Radiometry:
    """How the page's samples become grey or colour values."""
    bits, kind, samples = page.bitspersample, int(page.photometric), page.samplesperpixel
    if page.sampleformat != 1 or not 1 < bits <= 16:
        number = {1: "integers", 2: "signed integers", 3: "floating-point numbers"}.get(page.sampleformat, "numbers")
        raise _unsupported(path, f"samples are {number} of {bits} bits")
    if page.imagedepth != 1:
        raise _unsupported(path, f"it is a volume of {page.imagedepth} slices")
    if kind == _PALETTE and page.colormap is not None:
        return Radiometry.of_palette(page.colormap)
    is_colour = kind == _RGB or (kind == _YCBCR and page.compression in _JPEG_COMPRESSIONS)  # its decoder gives RGB
    if not (kind in (_WHITE_IS_ZERO, _BLACK_IS_ZERO) or (is_colour and samples >= 3)):
        name = getattr(page.photometric, "name", str(page.photometric))
        raise _unsupported(path, f"its colours are {name} with {samples} samples a pixel")
    return Radiometry(3 if is_colour else 1, float(2**bits - 1), inverted=kind == _WHITE_IS_ZERO)


def _page_rounding_step_dn(file: TiffFile, page: TiffPage) -> float:
    """Of a page compressed as JPEG: its tables stand in a tag, or else at the beginning of every tile or strip."""
    if page.compression not in _JPEG_COMPRESSIONS:
        return 0.0
    start = page.jpegtables or page.jpegheader
    if start is None:
        first = next(index for index, count in enumerate(page.databytecounts) if count)
        file.filehandle.seek(page.dataoffsets[first])
        start = file.filehandle.read(min(page.databytecounts[first], _JPEG_HEADERS_BYTES))
    return rounding_step_dn(start)


def _unsupported(path: Path, what: str) -> MeasurementError:
    return MeasurementError(
        f"{path} is a TIFF of a kind that is not read ({what}): save it as grey or RGB with 8 or 16 bits a sample"
    )


class TiffSegments:
    """The tiles or strips of a TIFF page."""

    def __init__(self, file: TiffFile, page: TiffPage, path: Path) -> None:
        self._file, self._page, self._path = file, page, path
        self._reading = Lock()
        self._radiometry = _page_radiometry(page, path)
        self.rounding_step_dn = _page_rounding_step_dn(file, page)
        self.channels, self.full_scale_dn = self._radiometry.channels, self._radiometry.full_scale_dn
        self.sample_bytes = self._radiometry.sample_bytes
        self.height_px, self.width_px = page.imagelength, page.imagewidth
        self.segment_height_px = page.tilelength if page.is_tiled else min(page.rowsperstrip, self.height_px)
        self.segment_width_px = page.tilewidth if page.is_tiled else self.width_px
        self._grid = (-(-self.height_px // self.segment_height_px), -(-self.width_px // self.segment_width_px))
        self._planes = self._radiometry.channels if page.planarconfig == 2 else 1
        self._stored_dtype = np.dtype(page.dtype).newbyteorder(file.byteorder)
        self._samples = page.samplesperpixel if page.planarconfig == 1 else 1
        decoded_bytes = self.segment_height_px * self.segment_width_px * self._samples * self._stored_dtype.itemsize
        self._is_large_and_plain = (
            decoded_bytes >= _LARGE_BYTES
            and page.compression in _INTO_MEMORY
            and page.predictor == 1
            and page.fillorder == 1
            and page.bitspersample in (8, 16)
        )
        wanted = self._planes * self._grid[0] * self._grid[1]
        if min(len(page.dataoffsets), len(page.databytecounts)) < wanted:
            raise broken(path, f"{len(page.dataoffsets)} of {wanted} tiles or strips are listed")

    def read(self, row: int, column: int) -> Samples:
        """Segment (row, column): the planes of a file that keeps them apart are put together."""
        index = row * self._grid[1] + column
        plane_step = self._grid[0] * self._grid[1]
        planes = [self._decoded(index + plane * plane_step) for plane in range(self._planes)]
        samples = planes[0] if len(planes) == 1 else np.concatenate(planes, axis=-1)
        height = min(self.segment_height_px, self.height_px - row * self.segment_height_px)
        width = min(self.segment_width_px, self.width_px - column * self.segment_width_px)
        if samples.shape[0] < height or samples.shape[1] < width:
            raise broken(self._path, f"tile or strip {index} is cut short")
        return self._radiometry.apply(samples[:height, :width])

    def _decoded(self, index: int) -> NDArray[np.generic]:
        """(height, width, samples) of the stored numbers; a tile that was left out of the file is all zeros."""
        page = self._page
        try:
            data = self._stored(index) if page.databytecounts[index] else None
            if data is not None and self._is_large_and_plain:
                samples = self._decoded_into_memory(index, data)
                if samples is not None:
                    return samples
            decoded, _, shape = page.decode(data, index, jpegtables=page.jpegtables, jpegheader=page.jpegheader)
        except DECODING_ERRORS as error:
            raise broken(self._path, f"tile or strip {index}: {error}") from error
        except NotImplementedError as error:
            raise _unsupported(self._path, str(error)) from error
        if decoded is None:
            return np.zeros(shape[1:], page.dtype)
        return np.asarray(np.asarray(decoded)[0])

    def _decoded_into_memory(self, index: int, data: bytes | memoryview) -> NDArray[np.generic] | None:
        """A large tile or strip into memory that the system gives by large pages, which takes a quarter less time than
        the decoder's own, given by small ones; None where it holds less than it should."""
        height = self.segment_height_px
        if not self._page.is_tiled:
            height = min(height, self.height_px - index % self._grid[0] * height)
        samples = np.empty((height, self.segment_width_px, self._samples), self._stored_dtype)
        decoded = TIFF.DECOMPRESSORS[self._page.compression](data, out=samples.reshape(-1).view(np.uint8))
        return samples.astype(self._page.dtype, copy=False) if len(decoded) == samples.nbytes else None

    def _stored(self, index: int) -> bytes | memoryview:
        """A tile or strip as the file has it: mapped where it is so large that a copy would take long, for a mapping
        takes longer than the copy of a small one."""
        offset, size = self._page.dataoffsets[index], self._page.databytecounts[index]
        if size > _MAPPED_BYTES:
            before = offset % ALLOCATIONGRANULARITY
            length = before + size
            mapped = mmap(self._file.filehandle.fileno(), length, access=ACCESS_READ, offset=offset - before)
            return memoryview(mapped)[before:]
        with self._reading:
            self._file.filehandle.seek(offset)
            return self._file.filehandle.read(size)

    def close(self) -> None:
        self._file.close()


class RawRows(TiffSegments):
    """An uncompressed file whose rows stand one after the other: any part can be read, whatever its strips, and none
    need be kept."""

    def __init__(self, file: TiffFile, page: TiffPage, path: Path) -> None:
        super().__init__(file, page, path)
        self.segment_height_px, self.segment_width_px = 1, self.width_px
        self._row_bytes = self.width_px * page.samplesperpixel * self._stored_dtype.itemsize

    def read(self, row: int, column: int) -> Samples:
        samples = np.empty((1, self.width_px, self.channels), np.uint8 if self.sample_bytes == 1 else np.uint16)
        self.fill(samples, row, 0)
        return samples

    def fill(self, samples: Samples, row0: int, col0: int) -> None:
        """Samples (height, width, channels) of the picture from a row and column on."""
        rows = max(_MAPPED_BYTES // self._row_bytes, 1)
        for first in range(0, len(samples), rows):
            self._fill(samples[first : first + rows], row0 + first, col0)

    def _fill(self, samples: Samples, row0: int, col0: int) -> None:
        height, width, _ = samples.shape
        start = int(self._page.dataoffsets[0]) + row0 * self._row_bytes
        before = start % ALLOCATIONGRANULARITY
        size = before + height * self._row_bytes
        try:
            # Of the rows only the pages with these columns are read, and none of them is held afterwards.
            with mmap(self._file.filehandle.fileno(), size, access=ACCESS_READ, offset=start - before) as mapped:
                shape = (height, self.width_px, self._page.samplesperpixel)
                rows = np.ndarray(shape, self._stored_dtype, mapped, before)
                samples[:] = self._radiometry.apply(rows[:, col0 : col0 + width])
                del rows
        except (ValueError, OSError) as error:
            raise broken(self._path, f"rows {row0} to {row0 + height - 1} lie beyond its end") from error
