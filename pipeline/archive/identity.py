"""What stands in the telling parts of a scan's file, and in the whole of it."""

import hashlib
from pathlib import Path

import numpy as np

from measure.errors import MeasurementError, MissingError, UnreachableError
from measure.scans.metadata import DECODING_ERRORS
from measure.scans.opening import open_scan
from measure.scans.remote import Address, tiff_file, whole_file
from measure.scans.scan import Scan
from pipeline.results.fingerprints import of_scan

_HEAD_BYTES = 1 << 16
_MIDDLE_PX = 256
_PIECE_BYTES = 1 << 20


def parts_hash(path: Path, max_pixels: int | None = None) -> str:
    """SHA-256 (hexadecimal) of the first 64 KiB, of the tables of tile offsets and byte counts, of the 256 x 256 px in
    the middle, and of pieces spread over the file. Head and tables alone would not do: uncompressed scans of one
    scanner share them.

    A file that cannot be opened as a scan has a hash of its first bytes; "" where not even these can be read. Of an
    object, what its store calls its content stands for all this: nothing of it is read.
    """
    try:
        if isinstance(path, Address) and path.etag:
            return hashlib.sha256(f"{path.etag} {path.stat().st_size}".encode()).hexdigest()
        part = str(path).removeprefix(whole_file(str(path)))  # two parts of one file are two scans
        digest = hashlib.sha256(f"{of_scan(path)}{part}".encode())
        with path.open("rb") as file:
            digest.update(file.read(_HEAD_BYTES))
    except (OSError, MissingError, UnreachableError):
        return ""
    try:
        with open_scan(path, max_pixels) as scan:
            digest.update(_tables(path))
            digest.update(_middle(scan))
    except (MeasurementError, *DECODING_ERRORS):
        digest.update(b"cannot be opened")
    return digest.hexdigest()


def content_hash(path: Path) -> str:
    """SHA-256 (hexadecimal) of the whole file; "" where it cannot be read. It takes 0.6 s of CPU a GB, so it is made
    where it decides, and not of every scan."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                digest.update(piece)
    except (OSError, MissingError, UnreachableError):
        return ""
    return digest.hexdigest()


def _tables(path: Path) -> bytes:
    """Where the tiles or strips of all its pictures stand in a TIFF file; empty for other files, which have none."""
    if not _is_tiff(path):
        return b""
    with tiff_file(path) as file:
        pages = [page.aspage() for page in file.pages]
        tables = [np.array([*page.dataoffsets, *page.databytecounts], dtype="<u8") for page in pages]
    return b"".join(table.tobytes() for table in tables)


def _is_tiff(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) in (b"II", b"MM")


def _middle(scan: Scan) -> bytes:
    width, height = min(_MIDDLE_PX, scan.width_px), min(_MIDDLE_PX, scan.height_px)
    return scan.samples((scan.width_px - width) // 2, (scan.height_px - height) // 2, width, height).tobytes()
