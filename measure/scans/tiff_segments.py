"""The tiles and strips of a TIFF page, each decoded on its own: what is damaged in one costs none of the others."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from mmap import ACCESS_READ, ALLOCATIONGRANULARITY, mmap
from pathlib import Path
from threading import Lock

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from tifffile import TIFF, TiffFile, TiffPage
from tifffile.tifffile import jpeg_decode_colorspace

from measure.scans.cache import LostPart, Place, Segments
from measure.scans.jpeg import decode_checked
from measure.scans.metadata import (
    DECODING_ERRORS,
    JPEG_COMPRESSIONS,
    Radiometry,
    Samples,
    damage_error,
    float_span,
    unsupported_error,
)
from measure.scans.remote import Address

_PLAIN = 1  # of Compression: no compression (TIFF 6.0)
_INTO_MEMORY = (5, 8, 32773, 32946, 34926, 50000)  # LZW, deflate, PackBits, zstd: these give bytes
_FLOAT_PREDICTOR = 3  # of Predictor (TIFF Technical Note 3)
_MAPPED_BYTES = 4 << 20  # of an uncompressed file, taken at a time; larger tiles and strips are not copied


class TiffSegments(Segments):
    """The tiles or strips of a TIFF page."""

    def __init__(
        self, file: TiffFile, page: TiffPage, path: Path, radiometry: Radiometry, rounding_step_dn: float
    ) -> None:
        self._file, self._page, self._path, self._radiometry = file, page, path, radiometry
        self._reading = Lock()
        self._address = path if isinstance(path, Address) else None
        self.rounding_step_dn = rounding_step_dn
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
        if not (page.compression == _PLAIN or page.compression in TIFF.DECOMPRESSORS):
            raise unsupported_error(path, f"compression {int(page.compression)}")
        known = (1, 2, _FLOAT_PREDICTOR) if self._is_float else (1, 2)
        if page.predictor not in known and page.compression in (_PLAIN, *_INTO_MEMORY):
            raise unsupported_error(path, f"predictor {int(page.predictor)}")
        if page.compression == _PLAIN:
            self._check_bytes()

    def _check_bytes(self) -> None:
        """What tags of an uncompressed picture say of its size is held against the bytes that there are: rows that
        begin at wrong places look like rows."""
        wide, tall = self._row_bytes, self.segment_height_px
        rows = self._grid[1] * self._planes * (self._grid[0] * tall if self._page.is_tiled else self.height_px)
        stored = sum(count or tall * wide for count in self._page.databytecounts)
        padded = self._grid[1] * self._planes * self._grid[0] * tall * wide
        if not rows * wide <= stored < (rows + 1) * wide and stored != padded:
            raise damage_error(self._path, f"its tiles or strips hold {stored} bytes, and should {rows * wide}")

    @property
    def lost(self) -> Sequence[LostPart]:
        """The tiles and strips that could not be decoded."""
        return tuple(self._lost.values())

    def fetch(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        """Of an address, by one request for all; a local file is read as each segment is decoded."""
        if self._address is None or not places:
            return {}
        indices = [self._indices(*place) for place in places]
        counts, offsets = self._page.databytecounts, self._page.dataoffsets
        extents = [(offsets[index], offsets[index] + counts[index]) for own in indices for index in own]
        parts = iter(self._address.ranges(extents))
        return {place: [next(parts) for _ in own] for place, own in zip(places, indices, strict=True)}

    def _indices(self, row: int, column: int) -> list[int]:
        """Of a segment's tiles or strips, one for each plane."""
        rows, columns = self._grid
        return [row * columns + column + plane * rows * columns for plane in range(self._planes)]

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """Segment (row, column): the planes of a file that keeps them apart are put together."""
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
        """Values of stored numbers; of floating-point ones all are read once for their scale."""
        if self._is_float:
            with self._spanning:
                if self._radiometry.span is None:
                    self._radiometry = replace(self._radiometry, span=float_span(*self._stored_extremes()))
        return self._radiometry.apply(stored)

    def _stored_extremes(self) -> tuple[float, float]:
        """The least and the greatest finite number of the picture; what cannot be decoded is passed over."""
        extremes = list[float]()
        page = TiffSegments(self._file, self._page, self._path, self._radiometry, self.rounding_step_dn)
        rows, columns = page._grid
        for row, column in product(range(rows), range(columns)):
            height = min(page.segment_height_px, self.height_px - row * page.segment_height_px)
            width = min(page.segment_width_px, self.width_px - column * page.segment_width_px)
            for index in page._indices(row, column):
                with suppress(*DECODING_ERRORS):
                    stored = np.asarray(page._decode(index, None, height, width))[:height, :width]
                    finite = stored[..., : self.channels][np.isfinite(stored[..., : self.channels])]
                    extremes += [float(finite.min()), float(finite.max())] if finite.size else []
        return min(extremes, default=0.0), max(extremes, default=1.0)

    def _decode(self, index: int, given: bytes | None, height_px: int, width_px: int) -> NDArray[np.generic]:
        """(height, width, samples) of the stored numbers, height_px by width_px or more of them; a tile that was left
        out of the file is all zeros. given: what is stored of it, None where it is still to be read. Raises one of
        DECODING_ERRORS."""
        page = self._page
        if not page.databytecounts[index]:
            return np.zeros((height_px, self.segment_width_px, self._samples), page.dtype)
        data = self._stored_bytes(index) if given is None else given
        if page.compression in JPEG_COMPRESSIONS:
            return self._decode_jpeg(bytes(data), height_px, width_px)
        if page.predictor != _FLOAT_PREDICTOR and page.compression in (_PLAIN, *_INTO_MEMORY):
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

    def _decode_bytes(self, data: bytes | memoryview, height_px: int) -> NDArray[np.generic]:
        """Of a tile or strip that holds rows of bytes. The last strip may be as tall as the others."""
        page = self._page
        if page.fillorder == 2:
            data = bytes(imagecodecs.bitorder_decode(bytes(data)))
        full = self.segment_height_px * self._row_bytes
        if page.compression == _PLAIN:
            stored = np.frombuffer(data, np.uint8)
        else:
            # NumPy's memory comes by large pages, which takes a quarter less time than the decoder's own. A byte more
            # than what is right tells a stream that holds more.
            memory = np.empty(full + 1, np.uint8)
            stored = memory[: len(TIFF.DECOMPRESSORS[page.compression](data, out=memory))]
        right = (full,) if page.is_tiled else (full, height_px * self._row_bytes)
        if len(stored) not in right:
            more = "more" if len(stored) > full else len(stored)
            raise ValueError(f"it holds {more} bytes, and should {right[-1]}")
        return self._unpack(stored)

    def _unpack(self, stored: NDArray[np.uint8]) -> NDArray[np.generic]:
        """The numbers of whole rows, each of which begins with a byte of its own, as the machine has them."""
        page, shape = self._page, (-1, self.segment_width_px, self._samples)
        if page.bitspersample in (8, 16):
            numbers = stored.view(self._stored_dtype).reshape(shape)
        else:
            run = self.segment_width_px * self._samples
            numbers = imagecodecs.packints_decode(bytes(stored), self._stored_dtype, page.bitspersample, runlen=run)
            numbers = numbers.reshape(shape)
        numbers = numbers.astype(page.dtype, copy=False)
        if page.predictor == 1:
            return np.asarray(numbers)
        return np.asarray(TIFF.UNPREDICTORS[page.predictor](numbers, axis=-2))

    def _stored_bytes(self, index: int) -> bytes | memoryview:
        """A tile or strip as the file has it: mapped where it is so large that a copy would take long, for a mapping
        takes longer than the copy of a small one."""
        offset, size = self._page.dataoffsets[index], self._page.databytecounts[index]
        if self._address is not None:
            return self._address.ranges([(offset, offset + size)])[0]
        if size > _MAPPED_BYTES:
            before = offset % ALLOCATIONGRANULARITY
            length = before + size
            mapped = mmap(self._file.filehandle.fileno(), length, access=ACCESS_READ, offset=offset - before)
            return memoryview(mapped)[before:]
        with self._reading:
            self._file.filehandle.seek(offset)
            return bytes(self._file.filehandle.read(size))

    def close(self) -> None:
        self._file.close()


class RawRows(TiffSegments):
    """An uncompressed file whose rows stand one after the other: any part can be read, whatever its strips, and none
    need be kept."""

    def __init__(
        self, file: TiffFile, page: TiffPage, path: Path, radiometry: Radiometry, rounding_step_dn: float
    ) -> None:
        super().__init__(file, page, path, radiometry, rounding_step_dn)
        self.segment_height_px, self.segment_width_px = 1, self.width_px

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
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
        shape = (height, self.width_px, self._page.samplesperpixel)
        if self._address is not None:
            (data,) = self._address.ranges([(start, start + height * self._row_bytes)])
            samples[:] = self._values(np.ndarray(shape, self._stored_dtype, data)[:, col0 : col0 + width])
            return
        before = start % ALLOCATIONGRANULARITY
        size = before + height * self._row_bytes
        try:
            # Of the rows only the pages with these columns are read, and none of them is held afterwards.
            with mmap(self._file.filehandle.fileno(), size, access=ACCESS_READ, offset=start - before) as mapped:
                rows = np.ndarray(shape, self._stored_dtype, mapped, before)
                samples[:] = self._values(rows[:, col0 : col0 + width])
                del rows
        except (ValueError, OSError) as error:
            raise damage_error(self._path, f"rows {row0} to {row0 + height - 1} lie beyond its end") from error
