"""Writing of a TIFF file from strips of grey values, without holding the whole image in memory."""

from collections.abc import Iterator
from pathlib import Path

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from synthetic_images.scene import Compression, SceneScanner

Grey = NDArray[np.unsignedinteger]

JPEG_LEVEL = 92


def write_tiff(
    path: Path, strips: Iterator[Grey], width_px: int, height_px: int, strip_px: int, scanner: SceneScanner
) -> None:
    """Write strips from top to bottom: (rows, width) or (rows, width, 3), of strip_px rows, fewer in the last one.

    The resolution tags hold the pixel pitch. Raises OSError if the file cannot be written.
    """
    pitch_x_um, pitch_y_um = scanner.pitch_um
    segments = _tiles(strips, scanner.tile_px) if scanner.tile_px else strips
    tifffile.imwrite(
        path,
        (_encoded(segment, scanner.compression) for segment in segments),
        shape=(height_px, width_px, 3) if scanner.colour else (height_px, width_px),
        dtype=np.uint16 if scanner.bit_depth == 16 else np.uint8,
        photometric="rgb" if scanner.colour else "miniswhite" if scanner.white_is_zero else "minisblack",
        compression=None if scanner.compression == "none" else scanner.compression,
        compressionargs={"outcolorspace": "RGB"} if scanner.colour and scanner.compression == "jpeg" else None,
        tile=(scanner.tile_px, scanner.tile_px) if scanner.tile_px else None,
        rowsperstrip=None if scanner.tile_px else strip_px,
        resolution=(1e4 / pitch_x_um, 1e4 / pitch_y_um),
        resolutionunit="CENTIMETER",
        software="reseau",
        metadata=None,
    )


def _encoded(segment: Grey, compression: Compression) -> bytes:
    """Encode a tile or strip. Given uncoded arrays, the TIFF writer would need all of them at once."""
    if compression == "jpeg":
        space = "RGB" if segment.ndim == 3 else None
        return bytes(imagecodecs.jpeg8_encode(segment, JPEG_LEVEL, colorspace=space, outcolorspace=space))
    data = np.ascontiguousarray(segment).tobytes()
    if compression == "lzw":
        return bytes(imagecodecs.lzw_encode(data))
    if compression == "deflate":
        return bytes(imagecodecs.zlib_encode(data))
    if compression == "zstd":
        return bytes(imagecodecs.zstd_encode(data))
    return data


def _tiles(strips: Iterator[Grey], tile_px: int) -> Iterator[Grey]:
    """Yield tiles row by row, those at the right and bottom edges padded with zeros."""
    held: list[Grey] = []
    for strip in strips:
        held.append(strip)
        rows = np.concatenate(held) if len(held) > 1 else strip
        whole = len(rows) // tile_px * tile_px
        yield from _cut(rows[:whole], tile_px)
        held = [rows[whole:]] if whole < len(rows) else []
    if held:
        yield from _cut(held[0], tile_px)


def _cut(rows: Grey, tile_px: int) -> Iterator[Grey]:
    fill = [(0, -len(rows) % tile_px), (0, -rows.shape[1] % tile_px), *[(0, 0)] * (rows.ndim - 2)]
    padded = np.pad(rows, fill)
    for row in range(0, len(padded), tile_px):
        for column in range(0, padded.shape[1], tile_px):
            yield padded[row : row + tile_px, column : column + tile_px]
