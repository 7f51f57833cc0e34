"""One frame stored in every way and damaged by chance, and what measuring it came to, for tests of damaged scans."""

from collections.abc import Callable, Mapping
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import tifffile
from drawn import NUMBERED, PITCH_UM, frame_picture, pixel_from_camera
from numpy.typing import NDArray

from measure import FrameMeasurement, MeasurementError, Status, measure_fiducials, open_scan

Damage = Callable[[bytearray, np.random.Generator], None]

MOVED_PX = 0.1  # a measured mark that moves farther is a wrong one
_MOST_LOST = 60  # bytes
_HEADERS = 800  # bytes at either end of a file: where tags and tables stand


def _tiff(grey: NDArray[Any], **options: Any) -> bytes:
    memory = BytesIO()
    tifffile.imwrite(memory, grey, **options)
    return memory.getvalue()


def _jpeg(grey: NDArray[Any], **options: Any) -> bytes:
    memory = BytesIO()
    PIL.Image.fromarray(grey).save(memory, "jpeg", quality=90, **options)
    return memory.getvalue()


def _png(grey: NDArray[Any]) -> bytes:
    memory = BytesIO()
    PIL.Image.fromarray(grey).save(memory, "png")
    return memory.getvalue()


@cache
def stored() -> Mapping[str, bytes]:
    """The frame as files, by how they store it."""
    fine = np.clip(frame_picture(NUMBERED, pixel_from_camera("0")), 0, 65535).astype(np.uint16)
    grey = (fine >> 7).clip(0, 255).astype(np.uint8)
    colour = np.dstack([grey, grey, grey])
    in_jpeg: dict[str, Any] = {"compression": "jpeg", "compressionargs": {"level": 90}}
    return {
        "jpeg": _jpeg(grey),
        "jpeg colour": _jpeg(colour),
        "jpeg optimised": _jpeg(grey, optimize=True),
        "jpeg progressive": _jpeg(grey, progressive=True),
        "jpeg restarts": _jpeg(grey, restart_marker_rows=5),
        "tiff jpeg tiles": _tiff(grey, tile=(128, 128), **in_jpeg),
        "tiff jpeg strips": _tiff(grey, rowsperstrip=64, **in_jpeg),
        "tiff lzw": _tiff(grey, rowsperstrip=40, compression="lzw"),
        "tiff lzw predictor": _tiff(grey, rowsperstrip=40, compression="lzw", predictor=True),
        "tiff lzw 16": _tiff(fine, compression="lzw", tile=(128, 128)),
        "tiff deflate": _tiff(grey, rowsperstrip=40, compression="zlib", predictor=True),
        "tiff zstd": _tiff(grey, rowsperstrip=40, compression="zstd"),
        "tiff zstd predictor 16": _tiff(fine, rowsperstrip=40, compression="zstd", predictor=True),
        "tiff packbits": _tiff(np.minimum(grey & 0xF8, 120), rowsperstrip=40, compression="packbits"),
        "tiff uncompressed": _tiff(grey, rowsperstrip=40),
        "tiff uncompressed 16": _tiff(fine),
        "png": _png(grey),
    }


def flipped(data: bytearray, rng: np.random.Generator) -> None:
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)


def flipped_in_headers(data: bytearray, rng: np.random.Generator) -> None:
    data[rng.integers(-_HEADERS, _HEADERS)] ^= 1 << rng.integers(8)


def dropped(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    del data[at : at + rng.integers(1, _MOST_LOST)]


def inserted(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    data[at:at] = rng.bytes(int(rng.integers(1, _MOST_LOST)))


def zeroed(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    size = min(int(rng.integers(1, 4096)), len(data) - at)
    data[at : at + size] = bytes(size)


def cut_short(data: bytearray, rng: np.random.Generator) -> None:
    """Its last two bytes kept: of a JPEG file the end marker."""
    end = bytes(data[-2:])
    del data[rng.integers(len(data)) :]
    data += end


DAMAGES: dict[str, Damage] = {
    one.__name__: one for one in (flipped, flipped_in_headers, dropped, inserted, zeroed, cut_short)
}


def measure_file(path: Path) -> FrameMeasurement:
    with open_scan(path) as scan:
        return measure_fiducials(scan, NUMBERED, (PITCH_UM, PITCH_UM))


def outcome(path: Path, right: FrameMeasurement) -> str:
    """What measuring a damaged file came to, beside the whole one: `message` where it was refused, `right` where every
    measured mark lies where it did, and `wrong` with the marks that do not."""
    try:
        found = measure_file(path)
    except MeasurementError:
        return "message"
    moved = [
        f"{mark.point} by {np.hypot(*(mark.center_px - true.center_px)):.2f} px"
        for mark, true in zip(found.marks, right.marks, strict=True)
        if mark.status is Status.MEASURED and mark.center_px is not None and true.center_px is not None
        if np.hypot(*(mark.center_px - true.center_px)) > MOVED_PX
    ]
    return f"wrong: {', '.join(moved)}" if moved else "right"


HEIGHT, WIDTH = 203, 317


def picture(dtype: type[np.unsignedinteger[Any]] = np.uint16, channels: int = 1) -> NDArray[Any]:
    """Smooth and detailed, over the whole range of its type, no two channels alike."""
    rows, cols = np.mgrid[0:HEIGHT, 0:WIDTH]
    planes = [
        0.5 + 0.4 * np.sin(cols / (9 + k)) * np.cos(rows / 13) + 0.1 * ((rows + cols + k) % 2) for k in range(channels)
    ]
    top = float(np.iinfo(dtype).max)
    values = np.stack(planes, -1) * top
    return np.asarray(np.clip(values, 0, top).astype(dtype)[..., 0 if channels == 1 else slice(None)])


def whole(path: Path) -> NDArray[np.float32]:
    with open_scan(path) as scan:
        return scan.window(0, 0, scan.width_px, scan.height_px)
