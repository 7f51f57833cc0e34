"""TIFF and BigTIFF files by tiles and strips: every compression that tifffile and imagecodecs know."""

import logging
import re
from pathlib import Path

import numpy as np
from tifffile import TiffFile, TiffPage

from measure.errors import MeasurementError
from measure.scans.addresses import Address, tiff_file
from measure.scans.broken import DECODING_ERRORS, broken, unsupported
from measure.scans.compression import rounding_step_dn
from measure.scans.radiometry import Radiometry
from measure.scans.resolution import NO_TAGS, TIFF_UNIT, Pitch, pitch_from_density
from measure.scans.scan_part import ScanPart
from measure.scans.segments import OpenedPicture, Segments
from measure.scans.size_limit import check_size
from measure.scans.tiff_directory import BadDirectory, Extent, check_directories
from measure.scans.tiff_segments import JPEG_COMPRESSIONS, RawRows, TiffSegments

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it finds odd is said in our own messages

TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the first bytes of TIFF and BigTIFF files
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_UNCOMPRESSED = 1
_LOOKED_AT_BYTES = 1 << 16  # after the last that a file accounts for
_JPEG_HEADERS_BYTES = 4096  # tables, size and resolution take fewer
_REDUCED_IMAGE, _TRANSPARENCY_MASK = 1, 4  # bits of NewSubfileType
_ALPHA = (1, 2)  # of ExtraSamples: associated and unassociated transparency
_FULL_SIZE = 0.6  # of the largest picture's side: what is smaller is an overview


def open_tiff(path: Path, max_pixels: int | None = None) -> OpenedPicture:
    """The first full-resolution picture of a TIFF file, or that of the page that the path names; of an address its
    overviews too: a file is read sooner than their makers' ways of averaging are known. max_pixels: as `check_size`
    takes it.

    Raises MeasurementError for a truncated file, for pictures that are no grey, palette or colour scan of up to
    16 bits a sample, and for those that claim more than such a file can hold.
    """
    try:
        taken = check_directories(path)
        file = tiff_file(path)
    except (BadDirectory, *DECODING_ERRORS) as error:
        raise broken(path, str(error)) from error
    try:
        page, problems = _main_page(file, path)
        _check_original(page, path)
        radiometry = _page_radiometry(page, path)
        _check_sizes(page, path, max_pixels)
        _check_extent(page, path, taken)
        kind = RawRows if _is_raw(page) else TiffSegments
        segments: Segments = kind(file, page, path, radiometry, _page_rounding_step_dn(file, page))
        overviews = _overviews(file, page, path) if isinstance(path, Address) else ()
        orientation = orientation_of(page)
        notes = (*orientation_notes(orientation), *_band_notes(page, radiometry))
        return OpenedPicture(segments, tag_pitch(page), notes, problems, overviews, orientation)
    except DECODING_ERRORS as error:
        file.close()
        raise broken(path, str(error)) from error
    except BaseException:
        file.close()
        raise


def _main_page(file: TiffFile, path: Path) -> tuple[TiffPage, tuple[str, ...]]:
    """The page that the path names, or else the first one that is a picture; and what it leaves out."""
    pictures = _full_pictures(file)
    if not pictures:
        raise broken(path, "it holds no picture")
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
    told = f"the file holds {len(pictures)} pictures of full size (pages {pages}), and page {first} was measured"
    return page, (f"{told}: name those that are frames in images.csv, by the column page",)


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
    return tuple(TiffSegments(file, page, path, _page_radiometry(page, path), 0.0) for page in alike)


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


def orientation_of(page: TiffPage) -> int:
    """The tag by which a viewer turns the picture; 1 where it does not."""
    return int(page.tags.valueof(274, default=1))


def orientation_notes(orientation: int) -> tuple[str, ...]:
    """A viewer may show the picture turned: whoever reads places off one must know."""
    if orientation == 1:
        return ()
    return (f"the file's orientation tag ({orientation}) is not applied: columns and rows are as stored",)


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
        raise broken(path, "it says nowhere in the file where the picture's data are")
    missing = sum(end > size for _, end in stored)
    if missing:
        raise broken(path, f"{missing} of {len(stored)} {part} lie beyond its end of {size} bytes")
    if page.compression != _UNCOMPRESSED:
        return
    starts, ends = np.array(sorted(set(stored))).T
    lies_over = (starts[1:] < ends[:-1]).any()
    for first, after in set(taken) - set(stored):
        beyond = int(np.searchsorted(ends, first, "right"))
        lies_over |= beyond < len(starts) and starts[beyond] < after
    if lies_over:
        raise broken(path, f"its {part} lie over one another or over its tags")
    if any(other.offset >= ends[-1] for other in page.parent.pages):
        return  # another picture's tags stand behind the pixels, where they are said to: nothing was put in before them
    with path.open("rb") as file:
        last = max(end for _, end in taken)
        file.seek(last)
        if any(file.read(_LOOKED_AT_BYTES)):
            raise broken(path, f"its last {size - last} bytes belong to nothing, as if some had been put in before")


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
    stored = [page.tags.valueof(name) for name in ("XResolution", "YResolution")]
    if None in stored:
        return NO_TAGS
    try:
        x, y = (numerator / denominator if denominator else 0.0 for numerator, denominator in stored)
        unit = TIFF_UNIT.get(int(page.tags.valueof("ResolutionUnit", default=2)))
    except (TypeError, ValueError):
        return Pitch(None, "the file's resolution tags hold no resolution")
    return pitch_from_density(x, y, unit)


def _page_radiometry(page: TiffPage, path: Path) -> Radiometry:
    """How the page's samples become grey or colour values."""
    bits, kind, samples = page.bitspersample, int(page.photometric), page.samplesperpixel
    if not isinstance(bits, int):
        raise unsupported(path, f"samples are of {' and '.join(map(str, bits))} bits")
    if page.sampleformat != 1 or not 1 < bits <= 16:
        number = {1: "integers", 2: "signed integers", 3: "floating-point numbers"}.get(page.sampleformat, "numbers")
        raise unsupported(path, f"samples are {number} of {bits} bits")
    if page.imagedepth != 1:
        raise unsupported(path, f"it is a volume of {page.imagedepth} slices")
    if kind == _PALETTE and page.colormap is not None:
        return Radiometry.of_palette(page.colormap)
    is_colour = kind == _RGB or (kind == _YCBCR and page.compression in JPEG_COMPRESSIONS)  # its decoder gives RGB
    if not (kind in (_WHITE_IS_ZERO, _BLACK_IS_ZERO) or (is_colour and samples >= 3)):
        name = getattr(page.photometric, "name", str(page.photometric))
        raise unsupported(path, f"its colours are {name} with {samples} samples a pixel")
    return Radiometry(3 if is_colour else 1, float(2**bits - 1), inverted=kind == _WHITE_IS_ZERO)


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
