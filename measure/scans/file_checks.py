"""Checks of a scan file: messages for damaged and unsupported ones, and how large a scan may be."""

import struct
from pathlib import Path

from tifffile import TiffFileError

from measure.errors import MeasurementError, MissingError, TooLargeError

# What libraries raise of a file that is not as it should be.
DECODING_ERRORS = (
    RuntimeError,
    ValueError,
    OSError,
    LookupError,
    ArithmeticError,
    TypeError,
    AttributeError,
    MemoryError,
    struct.error,
    TiffFileError,
)
MOST_PIXELS = 4_000_000_000  # 63,000 px a side: film of 23 cm at 4 um
MOST_PER_BYTE = 1000  # bytes of a picture for each of its file: deflate cannot do more, and film's grain allows ten
ALWAYS_BYTES = 128 << 20  # of a picture: a drawn one without any grain may be stored in next to nothing


def damage_error(path: Path, what: str) -> MeasurementError:
    """what: a part of a sentence."""
    return MeasurementError(
        f"{path} is damaged or truncated ({what.rstrip('.')}): copy it anew from the original, or rescan"
    )


def unsupported_error(path: Path, what: str) -> MeasurementError:
    """what: a part of a sentence."""
    return MeasurementError(
        f"{path} is a TIFF of a kind that is not read ({what}): save it as grey or RGB with 8 or 16 bits a sample"
    )


def check_size(
    path: Path, what: str, size_px: tuple[int, int], decoded_bytes: int, stored_bytes: int, max_pixels: int | None
) -> None:
    """Raises TooLargeError for a picture, or a part of one, that claims more than the stated bounds.

    what: the word for it; size_px: (width, height); decoded_bytes, stored_bytes: what it takes in memory and in the
    file; max_pixels: the bound that a user sets, in place of both: pixels in all, and pixels for what is stored.
    """
    width, height = size_px
    pixels = width * height
    if max_pixels is None:
        if pixels <= MOST_PIXELS and decoded_bytes <= max(ALWAYS_BYTES, MOST_PER_BYTE * stored_bytes):
            return
        bound = (
            f"without --max-pixels at most {MOST_PIXELS} pixels are read, and beyond {ALWAYS_BYTES >> 20} MiB at most "
            f"{MOST_PER_BYTE} bytes for each that is stored"
        )
    elif pixels <= max_pixels:
        return
    else:
        bound = f"--max-pixels allows {max_pixels}"
    raise TooLargeError(
        f"{path} claims {what} of {width} x {height} pixels ({decoded_bytes} bytes), stored in {stored_bytes} bytes: "
        f"{bound}. If it is truly so large, give --max-pixels {pixels}; else the file is damaged: copy it anew"
    )


def no_picture_error(path: Path, start: bytes) -> MeasurementError:
    """Of a file that begins so."""
    return MeasurementError(
        f"{path} is no TIFF, JPEG or PNG picture (it begins with {start[:8]!r}): give the scan itself, or convert it"
    )


def first_bytes(path: Path) -> bytes:
    """The file's first 16 bytes, or why there are none. A pipe or a device is not opened: either may never end."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise MeasurementError(f"{path} is no regular file, but a pipe or a device: give the file of a scan")
        with path.open("rb") as file:
            start = file.read(16)
    except FileNotFoundError:
        raise MissingError(
            f"there is no scan {path} (looked for {path.absolute()}): check its name and its folder"
        ) from None
    except OSError as error:
        raise MeasurementError(
            f"{path} cannot be read: {error.strerror}; check that it is a file you may read"
        ) from error
    if not start:
        raise MeasurementError(f"{path} is empty (0 bytes): copy or scan it anew")
    return start
