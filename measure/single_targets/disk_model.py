"""Many disks as blurred edges round ellipses, `gain * Phi(distance / blur) + offset + slopes`, in closed form: the edge
is taken for straight where it is blurred, which changes a disk's size by a few hundredths of a pixel and its place by
nothing."""

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_BLUR_PX = (0.5, 8.0)  # pixels' own width included
_LONGEST_STEP = 0.3  # of the radius
DAMPING = 1e-4  # of a step: a disk that hardly shows has unknowns that are not told apart
GREYS, UNKNOWNS = 4, 10
_TAIL = 0.2316419, np.array([1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.319381530]) / np.sqrt(2 * np.pi)
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
        return _radius_px(self.shapes)

    def moved(self, by: NDArray[np.intp]) -> "DiskStates":
        """By (n, 2) columns and rows."""
        return replace(self, centers=self.centers + by)

    def part(self, chosen: Mask | NDArray[np.intp]) -> "DiskStates":
        return DiskStates(self.centers[chosen], self.shapes[chosen], self.blur[chosen], self.greys[chosen])

    def stepped(self, step: Array) -> "DiskStates":
        """After a step (n, unknowns); one beyond what the linearisation tells is shortened."""
        relative = step[:, :5] / self.radius[:, None]
        relative /= np.maximum(np.abs(relative).max(axis=1, keepdims=True) / _LONGEST_STEP, 1.0)
        return DiskStates(
            self.centers + relative[:, :2] * self.radius[:, None],
            self.shapes + np.tensordot(relative[:, 2:], _GENERATORS, axes=1) @ self.shapes,
            np.clip(self.blur + np.clip(step[:, 5], -0.5 * self.blur, self.blur), *_BLUR_PX),
            self.greys + step[:, -GREYS:],
        )


def _radius_px(shapes: Array) -> Array:
    """(n,) of the circles of the same area."""
    return np.asarray(np.sqrt(np.abs(shapes[:, 0, 0] * shapes[:, 1, 1] - shapes[:, 0, 1] * shapes[:, 1, 0])))


class _Edges(NamedTuple):
    """Each (n, pixels): col, row: px from the centres; along_col, along_row, length: a vector at right angles to the
    ellipse, and its length; distance: from the edge, px, positive inside; place: distance in blurs; density: of the
    normal distribution there, over its largest; share: of the disk in the pixel.
    """

    col: Image
    row: Image
    along_col: Image
    along_row: Image
    length: Image
    distance: Image
    place: Image
    density: Image
    share: Image


class DiskModel:
    """n disks at a state, in pixels whose columns and rows are col, row (n, pixels)."""

    def __init__(self, state: DiskStates, col: NDArray[np.intp], row: NDArray[np.intp]) -> None:
        self.state = state
        self._col, self._row = col, row

    def at(self, state: DiskStates) -> "DiskModel":
        return DiskModel(state, self._col, self._row)

    def with_greys(self, greys: Array) -> "DiskModel":
        model = copy(self)
        model.state = replace(self.state, greys=greys)
        return model

    @cached_property
    def _edges(self) -> _Edges:
        state = self.state
        col = (self._col - state.centers[:, :1]).astype(np.float32)
        row = (self._row - state.centers[:, 1:]).astype(np.float32)
        inverse = np.linalg.inv(state.shapes)
        form = (inverse.swapaxes(1, 2) @ inverse).astype(np.float32)[..., None]  # col, row: squares of radii
        along_col = form[:, 0, 0] * col + form[:, 0, 1] * row
        along_row = form[:, 1, 0] * col + form[:, 1, 1] * row
        radius = np.sqrt(np.maximum(along_col * col + along_row * row, np.float32(0)))
        length = np.maximum(np.sqrt(along_col * along_col + along_row * along_row), np.float32(1e-12))
        distance = (1 - radius) * radius / length
        place = distance / each(state.blur)
        density = np.exp(np.float32(-0.5) * place * place)
        return _Edges(col, row, along_col, along_row, length, distance, place, density, _normal_share(place, density))

    def grey(self) -> Image:
        """(n, pixels) as modelled."""
        gain, offset, by_col, by_row = (each(greys) for greys in self.state.greys.T)
        size, edges = each(self.state.radius), self._edges
        return np.asarray(gain * edges.share + (offset + by_col / size * edges.col + by_row / size * edges.row))

    def design(self) -> Image:
        """(n, unknowns, pixels): columns and rows of the centres, the shapes' scale, stretch and shear in radii,
        the blur, the greys."""
        gain, blur, size = (each(of) for of in (self.state.greys[:, 0], self.state.blur, self.state.radius))
        edges = self._edges
        design = np.empty((len(gain), UNKNOWNS, edges.share.shape[1]), np.float32)
        steepness = gain / (np.float32(np.sqrt(2 * np.pi)) * blur) * edges.density
        moved = steepness / edges.length
        outward_col = np.multiply(moved, edges.along_col, out=design[:, 0])
        outward_row = np.multiply(moved, edges.along_row, out=design[:, 1])
        col, row = edges.col / size, edges.row / size
        along_col, along_row = outward_col * col, outward_row * row
        np.add(along_col, along_row, out=design[:, 2])
        np.subtract(along_col, along_row, out=design[:, 3])
        np.add(outward_col * row, outward_row * col, out=design[:, 4])
        np.multiply(steepness, -edges.place, out=design[:, 5])
        design[:, -GREYS:] = self.grey_design()
        return design

    def grey_design(self) -> Image:
        """(n, GREYS, pixels): that of the greys alone."""
        size, edges = each(self.state.radius), self._edges
        design = np.empty((len(size), GREYS, edges.share.shape[1]), np.float32)
        design[:, 0], design[:, 1], design[:, 2], design[:, 3] = edges.share, 1, edges.col / size, edges.row / size
        return design


def _normal_share(place: Image, density: Image) -> Image:
    """Of a normal distribution below a place in its sigmas, to some 1e-7, for its density there over the largest
    (Abramowitz and Stegun, 1964, 26.2.17): in single precision ten times as fast as the error function."""
    falling, (first, *others) = _TAIL
    near = 1 / (1 + np.float32(falling) * np.abs(place))
    tail = np.float32(first) * near
    for coefficient in others:
        tail += np.float32(coefficient)
        tail *= near
    tail *= density
    return np.asarray(np.copysign(np.float32(0.5) - tail, place) + np.float32(0.5))


def each(values: Array) -> Image:
    """(n, 1)"""
    return np.asarray(values, np.float32)[:, None]
