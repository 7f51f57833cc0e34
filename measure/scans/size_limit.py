"""How large a scan may be: what its file claims is held against what the file holds before any memory is taken."""

from pathlib import Path

from measure.errors import TooLargeError

MOST_PIXELS = 4_000_000_000  # 63,000 px a side: film of 23 cm at 4 um
MOST_PER_BYTE = 1000  # bytes of a picture for each of its file: deflate cannot do more, and film's grain allows ten
ALWAYS_BYTES = 128 << 20  # of a picture: a drawn one without any grain may be stored in next to nothing


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
