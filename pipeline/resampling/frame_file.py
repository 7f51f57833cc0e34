"""TIFF file of a resampled frame: tiles, reduced pages, a mask, and a description of the position of its pixels."""

import json
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tifffile import TiffFile, TiffFileError, TiffWriter

from pipeline.resampling.canvas import Canvas
from pipeline.resampling.interpolation import Tile
from pipeline.text.files import atomic_path
from pipeline.types import Mask, Samples

TILE_PX = 512
_REDUCTION = 4  # factor between a page and the next smaller one
_SMALLEST_PX = 512
_LARGEST_REDUCED_BYTES = 32 << 20  # largest size of the first reduced page, which is held in memory
_CLASSIC_BYTES = 3_900_000_000  # above it BigTIFF is written: classic TIFF has 32-bit offsets
_REDUCED, _MASK = 1, 4  # TIFF 6.0, NewSubfileType


def read_description(path: Path) -> dict[str, Any] | None:
    """Read the description of a resampled frame; None for any other or missing file."""
    try:
        with TiffFile(path) as file:
            content = json.loads(file.pages.first.description)
    except (OSError, ValueError, TiffFileError, IndexError):
        return None
    return content if isinstance(content, dict) and {"reseau", "x_mm", "y_mm", "pitch_mm"} <= content.keys() else None


def write_frame(
    path: Path,
    canvas: Canvas,
    description: Mapping[str, object],
    channels: int,
    dtype: type,
    make_tile: Callable[[int, int], Tile],
) -> int:
    """Write the frame, tile by tile.

    Memory holds one tile, the first reduced page, and the masks of tiles at the scan's edge.

    Parameters
    ----------
    description : stored in the file as JSON, with the canvas: x_mm, y_mm are of the centre of the first pixel.
    make_tile : returns the tile at (col0, row0).

    Returns
    -------
    The number of clamped samples.

    Raises
    ------
    InputError : the file cannot be written.
    """
    reduced = _Reduced(canvas, channels, dtype)
    masks: dict[tuple[int, int], NDArray[np.uint8] | bool] = {}  # most tiles are entirely inside or outside
    clamped = 0

    def tiles() -> Iterator[Samples]:
        nonlocal clamped
        for row0 in range(0, canvas.height_px, TILE_PX):
            for col0 in range(0, canvas.width_px, TILE_PX):
                tile = make_tile(col0, row0)
                clamped += tile.clamped
                reduced.take(tile.samples, col0, row0)
                inside = bool(tile.is_inside.flat[0])
                is_even = bool((tile.is_inside == inside).all())
                masks[row0, col0] = inside if is_even else np.packbits(tile.is_inside, axis=1)
                yield tile.samples if channels > 1 else tile.samples[..., 0]

    def masked() -> Iterator[Mask]:
        for (row0, col0), mask in masks.items():  # in the order of the tiles
            tile = np.unpackbits(mask, axis=1) if isinstance(mask, np.ndarray) else np.full((TILE_PX,) * 2, mask)
            part = tile[: canvas.height_px - row0, : canvas.width_px - col0].astype(bool)
            yield np.pad(part, ((0, TILE_PX - part.shape[0]), (0, TILE_PX - part.shape[1])))

    pages = reduced.count
    size = canvas.width_px * canvas.height_px * channels * np.dtype(dtype).itemsize
    shape = (canvas.height_px, canvas.width_px, *([channels] if channels > 1 else []))
    per_cm = 10.0 / canvas.pitch_mm
    place = {"x_mm": canvas.x_mm, "y_mm": canvas.y_mm, "pitch_mm": canvas.pitch_mm}
    options: dict[str, Any] = {"compression": "zlib", "photometric": "rgb" if channels > 1 else "minisblack"}
    options |= {"tile": (TILE_PX, TILE_PX), "metadata": None, "resolutionunit": "CENTIMETER"}
    with atomic_path(path) as temporary, TiffWriter(temporary, bigtiff=size > _CLASSIC_BYTES) as file:
        file.write(
            tiles(),
            shape=shape,
            dtype=dtype,
            predictor=True,
            subifds=pages,
            resolution=(per_cm, per_cm),
            description=json.dumps({"reseau": version("reseau"), **place, **description}),
            **options,
        )
        for factor, page in reduced.pages():
            scale = (per_cm / factor, per_cm / factor)
            file.write(page, predictor=True, subfiletype=_REDUCED, resolution=scale, **options)
        options["photometric"] = "minisblack"
        file.write(masked(), shape=shape[:2], dtype=bool, subfiletype=_MASK, resolution=(per_cm, per_cm), **options)
    return clamped


class _Reduced:
    """Reduced pages by area averaging: the first one from the tiles, each other one from the page before it."""

    def __init__(self, canvas: Canvas, channels: int, dtype: type) -> None:
        self.factor = _REDUCTION
        pixel_bytes = channels * np.dtype(dtype).itemsize
        while canvas.width_px * canvas.height_px * pixel_bytes / self.factor**2 > _LARGEST_REDUCED_BYTES:
            self.factor *= 2
        shape = (-(-canvas.height_px // self.factor), -(-canvas.width_px // self.factor), channels)
        self.first: Samples = np.zeros(shape, dtype)
        larger = max(canvas.width_px, canvas.height_px)
        self.count = 0
        while larger / (self.factor * _REDUCTION**self.count) >= _SMALLEST_PX or self.count == 0:
            self.count += 1

    def take(self, samples: Samples, col0: int, row0: int) -> None:
        small = _averaged(samples, self.factor)
        part = self.first[row0 // self.factor :, col0 // self.factor :][: small.shape[0], : small.shape[1]]
        part[:] = small[: part.shape[0], : part.shape[1]]

    def pages(self) -> Iterator[tuple[int, Samples]]:
        page: Samples = self.first
        for level in range(self.count):
            yield self.factor * _REDUCTION**level, page if page.shape[2] > 1 else page[..., 0]
            page = _averaged(page, _REDUCTION)


def _averaged(samples: Samples, factor: int) -> Samples:
    height, width = (-(-side // factor) * factor for side in samples.shape[:2])
    whole = np.pad(samples, ((0, height - samples.shape[0]), (0, width - samples.shape[1]), (0, 0)), mode="edge")
    means = whole.reshape(height // factor, factor, width // factor, factor, -1).mean(axis=(1, 3))
    return np.asarray(np.rint(means).astype(samples.dtype))
