"""Many disks as blurred edges round ellipses, `gain * Phi(distance / blur) + offset + slopes`, in closed form: the edge
is taken for straight where it is blurred, which changes a disk's size by a few hundredths of a pixel and its place by
nothing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

BLUR_PX = (0.5, 8.0)  # pixels' own width included
LONGEST_STEP = 0.3  # of the radius
DAMPING = 1e-4
GREYS = 4
_GENERATORS = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])


@dataclass(frozen=True, eq=False)
class DiskStates:
    """Of n disks: centers (n, 2) in their windows, shapes (n, 2, 2), blur (n,), all px; greys (n, 4): gain, offset,
    slopes."""

    centers: Array
    shapes: Array
    blur: Array
    greys: Array

    @property
    def radius(self) -> Array:
        return radius_px(self.shapes)

    def part(self, chosen: Mask) -> "DiskStates":
        return DiskStates(self.centers[chosen], self.shapes[chosen], self.blur[chosen], self.greys[chosen])

    def stepped(self, step: Array) -> "DiskStates":
        """After a step (n, unknowns); one beyond what the linearisation tells is shortened."""
        relative = step[:, :5] / self.radius[:, None]
        relative /= np.maximum(np.abs(relative).max(axis=1, keepdims=True) / LONGEST_STEP, 1.0)
        return DiskStates(
            self.centers + relative[:, :2] * self.radius[:, None],
            self.shapes + np.tensordot(relative[:, 2:], _GENERATORS, axes=1) @ self.shapes,
            np.clip(self.blur + np.clip(step[:, 5], -0.5 * self.blur, self.blur), *BLUR_PX),
            self.greys + step[:, -GREYS:],
        )


def radius_px(shapes: Array) -> Array:
    """(n,) of the circles of the same area."""
    return np.asarray(np.sqrt(np.abs(shapes[:, 0, 0] * shapes[:, 1, 1] - shapes[:, 0, 1] * shapes[:, 1, 0])))


class DiskModel:
    """n disks at a state, in windows of side x side pixels, or every so many of their columns and rows.

    distance (n, rows, cols): from the edge, px, positive inside; share (n, rows, cols): of the disk in the pixel.
    """

    def __init__(self, state: DiskStates, side: int, every: int = 1) -> None:
        self._state = state
        along = np.arange(0, side, every)
        self._col = (along - state.centers[:, :1]).astype(np.float32)[:, None, :]
        self._row = (along - state.centers[:, 1:]).astype(np.float32)[:, :, None]
        inverse = np.linalg.inv(state.shapes).astype(np.float32)[..., None, None]
        x = inverse[:, 0, 0] * self._col + inverse[:, 0, 1] * self._row
        y = inverse[:, 1, 0] * self._col + inverse[:, 1, 1] * self._row
        radius = np.maximum(np.sqrt(x * x + y * y), np.float32(1e-6))
        self._by_col = inverse[:, 0, 0] * x + inverse[:, 1, 0] * y
        self._by_row = inverse[:, 0, 1] * x + inverse[:, 1, 1] * y
        self._slope = np.sqrt(self._by_col * self._by_col + self._by_row * self._by_row)
        np.maximum(self._slope, np.float32(1e-9), out=self._slope)
        self.distance = (radius - radius * radius) / self._slope
        self._place = self.distance / self._each(state.blur)
        self.share = ndtr(self._place)

    def grey(self) -> Image:
        """(n, rows, cols) as modelled."""
        gain, offset, by_col, by_row = (self._each(greys) for greys in self._state.greys.T)
        size = self._each(self._state.radius)
        return np.asarray(gain * self.share + (offset + by_col / size * self._col + by_row / size * self._row))

    def design(self) -> Image:
        """(n, unknowns, rows, cols): columns and rows of the centres, the shapes' scale, stretch and shear in radii,
        the blur, the greys."""
        gain, blur, size = (self._each(of) for of in (self._state.greys[:, 0], self._state.blur, self._state.radius))
        edge = gain / (np.float32(np.sqrt(2 * np.pi)) * blur) * np.exp(np.float32(-0.5) * self._place * self._place)
        moved = edge / self._slope
        count, rows, cols = self.distance.shape
        design = np.empty((count, 6 + GREYS, rows, cols), np.float32)
        outward_col = np.multiply(moved, self._by_col, out=design[:, 0])
        outward_row = np.multiply(moved, self._by_row, out=design[:, 1])
        col, row = self._col / size, self._row / size
        along_col, along_row = outward_col * col, outward_row * row
        np.add(along_col, along_row, out=design[:, 2])
        np.subtract(along_col, along_row, out=design[:, 3])
        np.add(outward_col * row, outward_row * col, out=design[:, 4])
        np.multiply(edge, -self._place, out=design[:, 5])
        self._put_greys(design[:, 6:])
        return design

    def grey_design(self) -> Image:
        """(n, GREYS, rows, cols): that of the greys alone."""
        count, rows, cols = self.distance.shape
        design = np.empty((count, GREYS, rows, cols), np.float32)
        self._put_greys(design)
        return design

    def _put_greys(self, design: Image) -> None:
        size = self._each(self._state.radius)
        design[:, 0], design[:, 1], design[:, 2], design[:, 3] = self.share, 1, self._col / size, self._row / size

    @staticmethod
    def _each(values: Array) -> Image:
        """(n, 1, 1)"""
        return np.asarray(values, np.float32)[:, None, None]


def solved(design: Image, residuals: Image, weights: Image) -> Array:
    """(n, unknowns) of weighted least squares, for design (n, unknowns, rows, cols)."""
    flat = design.reshape(*design.shape[:2], -1)
    weighted = flat * weights.reshape(len(weights), 1, -1)
    normal = (weighted @ flat.swapaxes(1, 2)).astype(float)
    right = (weighted @ residuals.reshape(len(residuals), -1, 1)).astype(float)
    size = np.sqrt(np.maximum(np.einsum("nuu->nu", normal), 1e-12))
    scaled = normal / (size[:, :, None] * size[:, None]) + DAMPING * np.eye(normal.shape[1])
    return np.asarray(np.linalg.solve(scaled, right / size[..., None])[..., 0] / size)
