"""The picture of a mark as film and scanner show it: its coverage, or a chip cut from a scan, under a Gaussian blur,
with the derivatives that least-squares matching needs."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from measure.coverage import CELLS, cell_coverage, outline_mm
from measure.shapes import Mark, MarkTemplate

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Rendering:
    """A mark's picture and its derivatives, each (height, width): by column and row in px, and the second derivative
    by place, which is twice that by the blur's variance."""

    value: Array
    by_col: Array
    by_row: Array
    laplacian: Array


def render(mark: Mark, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Rendering:
    """The mark under a Gaussian of standard deviation blur_px, in a window of width x height px.

    A drawn mark is 1 inside and 0 outside; a chip, to whose blur this one is added, spans 0 to 1.
    pixel_from_mark: (2, 3), from (x_mm, y_mm, 1) to (col, row) of the window.
    """
    sharp, cells = _sharp(mark, pixel_from_mark, width, height, blur_px)
    over, across, twice_across = _averages(blur_px, cells, width, sharp.shape[1])
    along, down, twice_down = _averages(blur_px, cells, height, sharp.shape[0])
    smooth_rows = along @ sharp
    return Rendering(
        value=np.asarray(smooth_rows @ over.T, float),
        by_col=np.asarray(smooth_rows @ across.T, float),
        by_row=np.asarray(down @ sharp @ over.T, float),
        laplacian=np.asarray(smooth_rows @ twice_across.T + twice_down @ sharp @ over.T, float),
    )


def picture(mark: Mark, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Array:
    """(height, width): the mark as `render` makes it, without derivatives."""
    sharp, cells = _sharp(mark, pixel_from_mark, width, height, blur_px)
    over, _, _ = _averages(blur_px, cells, width, sharp.shape[1])
    along, _, _ = _averages(blur_px, cells, height, sharp.shape[0])
    return np.asarray(along @ sharp @ over.T, float)


def _sharp(mark: Mark, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> tuple[Single, int]:
    """The mark without blur in a window as much larger as the blur reaches, in cells, so many along a pixel's side."""
    pad = int(np.ceil(4 * blur_px)) + 2
    shifted = np.array(pixel_from_mark, dtype=float)
    shifted[:, 2] += pad
    size = width + 2 * pad, height + 2 * pad
    if isinstance(mark, MarkTemplate):
        cells = max(1, round(_pixels_per_sample(mark, pixel_from_mark) ** -1))
        sharp = _sampled(mark, shifted, *size, cells)
    else:
        cells = CELLS if blur_px < 1.5 else CELLS - 1  # blur hides what coarser cells get wrong
        sharp = cell_coverage(mark, shifted, *size, cells)
    return sharp.astype(np.float32), cells


def extent_px(mark: Mark, pixel_from_mark: Array) -> tuple[Array, Array]:
    """(2,) least and (2,) greatest column and row that the mark reaches."""
    if isinstance(mark, MarkTemplate):
        rows, cols = mark.image.shape
        corners = np.array([(0, 0), (cols - 1, 0), (cols - 1, rows - 1), (0, rows - 1)], dtype=float)
        chip_from_mark = _chip_from_mark(mark)
        outline = (corners - chip_from_mark[:, 2]) @ np.linalg.inv(chip_from_mark[:, :2]).T
    else:
        outline = np.concatenate([outline_mm(part) for part in mark.parts])
    points = outline @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2]
    return points.min(axis=0), points.max(axis=0)


def chip_mask(mark: MarkTemplate, pixel_from_mark: Array, width: int, height: int) -> NDArray[np.bool_]:
    """(height, width): which pixels lie on the chip, where it is steady."""
    col, row = _chip_positions(mark, pixel_from_mark, width, height, 1)
    rows, cols = mark.image.shape
    inside = (col >= 1) & (col <= cols - 2) & (row >= 1) & (row <= rows - 2)
    if mark.steady is not None:
        nearest = np.clip(np.rint(row), 0, rows - 1).astype(int), np.clip(np.rint(col), 0, cols - 1).astype(int)
        inside &= mark.steady[nearest]
    return np.asarray(inside)


def _averages(blur_px: float, cells: int, pixels: int, padded: int) -> tuple[Single, Single, Single]:
    """Three matrices (pixels, padded cells): the mean over every pixel of the blurred cells, and of their first and
    second derivative in px. Blur and mean in one product cost a fraction of a filter over the cells."""
    first = (padded - pixels * cells) // 2 + cells * np.arange(pixels)
    matrices = []
    for kernel, per_px in zip(_kernels(blur_px * cells), (1, cells, cells**2), strict=True):
        mean = np.convolve(kernel, np.full(cells, per_px / cells))
        reach = len(kernel) // 2
        matrix = np.zeros((pixels, padded), np.float32)
        matrix[np.arange(pixels)[:, None], first[:, None] - reach + np.arange(len(mean))] = mean
        matrices.append(matrix)
    return matrices[0], matrices[1], matrices[2]


@lru_cache(maxsize=256)
def _kernels(sigma: float) -> tuple[Array, Array, Array]:
    """A sampled Gaussian and its first and second derivative, normalised so that polynomials come out right."""
    reach = int(np.ceil(4 * sigma)) + 2
    place = np.arange(-reach, reach + 1, dtype=float)
    smooth = np.exp(-0.5 * (place / max(sigma, 1e-3)) ** 2)
    smooth /= smooth.sum()
    if sigma < 0.5:
        slope, bend = np.zeros_like(smooth), np.zeros_like(smooth)
        # A chip's own detail is hardly coarser than its pixels: differences of the fourth order, over five of them.
        slope[reach - 2 : reach + 3] = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
        bend[reach - 2 : reach + 3] = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12
        return smooth, slope, bend
    slope = place * smooth / (place**2 * smooth).sum()
    bend = (place**2 - sigma**2) * smooth
    bend -= smooth * bend.sum()
    return smooth, slope, bend * 2 / (place**2 * bend).sum()


def _pixels_per_sample(mark: MarkTemplate, pixel_from_mark: Array) -> float:
    """How many pixels of the scan one pixel of the chip spans."""
    scale = float(np.sqrt(abs(np.linalg.det(pixel_from_mark[:, :2]))))
    return max(scale * mark.pitch_um / 1000, 1e-3)


def _sampled(mark: MarkTemplate, pixel_from_mark: Array, width: int, height: int, cells: int) -> Array:
    col, row = _chip_positions(mark, pixel_from_mark, width, height, cells)
    sampled = ndimage.map_coordinates(mark.image, [row, col], order=3, mode="nearest")
    return np.asarray((sampled - mark.image.min()) / max(np.ptp(mark.image), 1e-12), dtype=float)


def _chip_positions(
    mark: MarkTemplate, pixel_from_mark: Array, width: int, height: int, cells: int
) -> tuple[Array, Array]:
    """Column and row in the chip of every cell's centre."""
    place = [(np.arange(size * cells) + 0.5) / cells - 0.5 for size in (width, height)]
    offset = np.stack(np.meshgrid(*place)) - pixel_from_mark[:, 2, None, None]
    chip_from_mark = _chip_from_mark(mark)
    chip_from_pixel = chip_from_mark[:, :2] @ np.linalg.inv(pixel_from_mark[:, :2])
    col, row = np.tensordot(chip_from_pixel, offset, axes=1) + chip_from_mark[:, 2, None, None]
    return col, row


def _chip_from_mark(mark: MarkTemplate) -> Array:
    """(2, 3) affine matrix from the mark's mm to the chip's column and row; a turned mark is turned back first."""
    angle = np.deg2rad(mark.turn_deg)
    c, s = np.cos(angle), np.sin(angle)
    scale = 1000 / mark.pitch_um
    linear = scale * np.array([[1.0, 0.0], [0.0, -1.0]]) @ np.array([[c, s], [-s, c]])
    return np.column_stack([linear, mark.origin_px])
