"""Images for COLMAP: resampled frames on one pixel grid per camera, and masks of what is fixed to the camera."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from measure.scans.opening import open_scan
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.resampling.canvas import Canvas, FrameChain
from pipeline.resampling.resample_stage import ResampleTask
from pipeline.text.names import file_word, path_below
from pipeline.types import Array, Mask

Picture = NDArray[np.uint8]

_BORDER = 0.02  # fraction of the frame's side: vignetting, edge of the frame
_MARK = 0.03  # masked around fiducials, which would match themselves in every frame; fraction of the frame's side
_DARKEST, _LIGHTEST = 0.5, 99.5  # percentiles that are mapped to black and white


@dataclass(frozen=True)
class BlockScan:
    """Scan of a frame: name of its image, transformation from the frame, and size."""

    image: str
    chain: FrameChain
    width_px: int
    height_px: int

    def depths_px(self, pixels: Array) -> Array:
        """(n,) distances of pixels (n, 2) from the nearest edge of the scan, px; negative outside."""
        col, row = pixels.T
        edges = [col + 0.5, self.width_px - 0.5 - col, row + 0.5, self.height_px - 0.5 - row]
        return np.asarray(np.min(edges, axis=0))


@dataclass(frozen=True)
class BlockPicture:
    """Image of one frame.

    Attributes
    ----------
    image, camera : names.
    name : file, in its camera's folder.
    lattice : pixel grid of its camera's images.
    scans : scan of the frame, or several of its parts.
    """

    image: str
    camera: str
    name: str
    lattice: Canvas
    scans: tuple[BlockScan, ...]

    def scan_place(self, camera_mm: Array) -> tuple[BlockScan, Array] | None:
        """Scan in which a place (2,) of the camera frame is farthest from the edges, and its pixel (2,); None where no
        transformation succeeds."""
        candidates = [(scan, scan.chain.scan_from_frame(camera_mm[None])) for scan in self.scans]
        places = [(scan, pixels[0]) for scan, (pixels, found) in candidates if found[0]]
        return max(places, key=lambda place: place[0].depths_px(place[1][None])[0], default=None)


def camera_lattice(camera: CameraFile, pitch_mm: float) -> Canvas:
    """Pixel grid of the exposed frame, at integer multiples of the pitch. Raises InputError where the frame's size is
    unknown."""
    if camera.frame_mm is None or not camera.fiducials:
        raise InputError(
            f"{camera.path}: frame_mm and fiducials are needed to make pictures of one lattice. Give them."
        )
    columns, rows = (int(np.floor(side / 2.0 / pitch_mm)) for side in camera.frame_mm)
    return Canvas(-columns * pitch_mm, rows * pitch_mm, pitch_mm, 2 * columns + 1, 2 * rows + 1)


def write_pictures(
    tasks: Sequence[ResampleTask], cameras: Mapping[str, CameraFile], folder: Path
) -> tuple[BlockPicture, ...]:
    """Write frames as 8-bit images below folder/pictures, and their masks below folder/masks."""
    made = []
    for task in tasks:
        camera = cameras[task.camera]
        lattice = camera_lattice(camera, task.pitch_mm)
        picture, mask = _cut(task.target, lattice)
        mask = mask & _usable(camera, lattice)
        name = f"{file_word(task.camera)}/{task.image.replace('/', '_')}.png"
        for kind, content in (("pictures", _eight_bits(picture, mask)), ("masks", mask.astype(np.uint8) * 255)):
            path = path_below(folder / kind, name, "" if kind == "pictures" else ".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), content):
                raise InputError(f"{path}: cannot be written. Make room there, or set another output folder.")
        made.append(BlockPicture(task.image, task.camera, name, lattice, _scans(task)))
    return tuple(made)


def _scans(task: ResampleTask) -> tuple[BlockScan, ...]:
    scans = []
    for each in task.scans:
        with open_scan(each.scan, task.max_pixels) as scan:
            scans.append(BlockScan(each.image, each.chain, scan.width_px, scan.height_px))
    return tuple(scans)


def _cut(path: Path, lattice: Canvas) -> tuple[Array, Mask]:
    """Grey values of a resampled frame on the grid, and the mask of valid pixels."""
    with tifffile.TiffFile(path) as file:
        description = json.loads(file.pages.first.description)
        pixels, inside = file.pages[0].asarray(), file.pages[1].asarray().astype(bool)
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(np.float64)
    col = round((lattice.x_mm - description["x_mm"]) / lattice.pitch_mm)
    row = round((description["y_mm"] - lattice.y_mm) / lattice.pitch_mm)
    shape = (lattice.height_px, lattice.width_px)
    picture, mask = np.zeros(shape), np.zeros(shape, bool)
    rows = slice(max(row, 0), min(row + lattice.height_px, grey.shape[0]))
    cols = slice(max(col, 0), min(col + lattice.width_px, grey.shape[1]))
    there = (slice(rows.start - row, rows.stop - row), slice(cols.start - col, cols.stop - col))
    picture[there], mask[there] = grey[rows, cols], inside[rows, cols]
    return picture, mask


def _usable(camera: CameraFile, lattice: Canvas) -> Mask:
    """Mask of the frame without its border and the fiducials."""
    assert camera.frame_mm is not None
    x = lattice.x_mm + lattice.pitch_mm * np.arange(lattice.width_px)
    y = lattice.y_mm - lattice.pitch_mm * np.arange(lattice.height_px)
    width, height = camera.frame_mm
    inside = (np.abs(x) < (0.5 - _BORDER) * width)[None, :] & (np.abs(y) < (0.5 - _BORDER) * height)[:, None]
    reach = _MARK * max(camera.frame_mm)
    for mark in camera.fiducials:
        left, up = mark.xy_mm
        inside &= ~((np.abs(x - left) < reach)[None, :] & (np.abs(y - up) < reach)[:, None])
    return np.asarray(inside)


def _eight_bits(picture: Array, mask: Mask) -> Picture:
    if not mask.any():
        return np.zeros(picture.shape, np.uint8)
    dark, light = np.percentile(picture[mask], (_DARKEST, _LIGHTEST))
    scaled = (picture - dark) * (255.0 / max(light - dark, 1e-9))
    return np.asarray(np.clip(np.rint(scaled), 0, 255).astype(np.uint8))
