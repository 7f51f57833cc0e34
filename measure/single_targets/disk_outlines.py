"""Outlines of patches, seen along rays from their middles: where the grey values fall to half of the patch's height.

A disk's picture is seen whole from its middle: each ray leaves it once. So the outlines of many patches are found at
once, to a fraction of a pixel, and the ellipse with the moments of each is compared with it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.single_targets.block import joined

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Sampled = Callable[[NDArray[np.intp], Array], Image]

_RAYS, _FEW_RAYS = 32, (8, 16)  # of an outline, and of the looks before: half of the blobs do not outlast the first
REACH = 3.0  # radii of a blob: where its patch must have ended
_CORE, _AROUND = 0.5, (1.5, 2.5)  # radii of a blob: within, that it is as high as; between, that there is ground
_GROUND_SHARE = 1 / 3  # of the rays, that are lower there: other things may stand about
_LEAST_HEIGHT = 0.5  # of the blob's contrast
_CHUNK = 1 << 18  # samples taken at a time: they take a few MiB


@dataclass(frozen=True, eq=False)
class Blobs:
    """What stands out: places (n, 2) in whole columns and rows, radius (n,) px and contrast (n,) of a disk that would
    stand out as much."""

    places: NDArray[np.intp]
    radius: Array
    contrast: Array

    def part(self, chosen: Mask | slice | NDArray[np.intp]) -> "Blobs":
        return Blobs(self.places[chosen], self.radius[chosen], self.contrast[chosen])


@dataclass(frozen=True, eq=False)
class Outlines:
    """Of n patches: centers (n, 2), moments (n, 2, 2) of their area about them, px²; misfit (n,): rms distance of the
    outline from the ellipse of these moments, in its radii; height (n,) above the ground."""

    centers: Array
    moments: Array
    misfit: Array
    height: Array

    def part(self, chosen: Mask) -> "Outlines":
        return Outlines(self.centers[chosen], self.moments[chosen], self.misfit[chosen], self.height[chosen])

    @property
    def radius(self) -> Array:
        """(n,) of the circle of the same area."""
        return np.asarray(2.0 * np.maximum(np.linalg.det(self.moments), 0.0) ** 0.25)


_NONE = Outlines(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0))


def outlines_about(image: Image, blobs: Blobs) -> Outlines:
    """Of those blobs, light ones, that end on every ray; most of what stands out of a landscape runs on along some."""
    near, between = partial(_nearest, image), partial(_interpolated, image)
    found = []
    for radius in np.unique(blobs.radius).tolist():
        alike = blobs.part(blobs.radius == radius)
        for rays in _FEW_RAYS:
            ends = [_Profiles(near, some, radius, rays, 1.0).ends for some in _chunks(alike, rays * REACH * radius)]
            alike = alike.part(np.concatenate([np.zeros(0, bool), *ends]))
        for some in _chunks(alike, _RAYS * REACH * radius / 0.5):
            profiles = _Profiles(between, some, radius, _RAYS, 0.5)
            found.append(_outlines(some.places[profiles.ends], profiles))
    return joined(_NONE, *found)


def _chunks(blobs: Blobs, samples: float) -> Iterator[Blobs]:
    """Blobs of which each takes so many samples."""
    count = max(int(_CHUNK / samples), 1)
    return (blobs.part(slice(first, first + count)) for first in range(0, len(blobs.radius), count))


class _Profiles:
    """Grey values (steps, rays, n) along rays from blobs of one radius, at steps of so many px; ends (n,): whether all
    fall below half of the blob's height."""

    def __init__(self, sampled: Sampled, blobs: Blobs, radius: float, rays: int, step_px: float) -> None:
        self.step_px = step_px
        along = step_px * np.arange(int(np.ceil(REACH * radius / step_px)) + 1)
        angle = 2 * np.pi * np.arange(rays) / rays
        self.directions = np.stack([np.cos(angle), np.sin(angle)])
        self.values = sampled(blobs.places, along[:, None] * self.directions[:, None])
        core, around = (along <= _CORE * radius), (along >= _AROUND[0] * radius) & (along <= _AROUND[1] * radius)
        top, outer = self.values[core].mean(axis=(0, 1)), self.values[around].mean(axis=0)
        self.ground = np.partition(outer, int(_GROUND_SHARE * rays), axis=0)[int(_GROUND_SHARE * rays)]
        self.height = top - self.ground
        self.level = (top + self.ground) / 2
        is_below = (self.values[1:].min(axis=0) < self.level).all(axis=0)
        self.ends = (self.values[0, 0] >= self.level) & is_below & (self.height >= _LEAST_HEIGHT * blobs.contrast)

    def radii(self) -> Image:
        """(rays, those that end) px to where the rays fall below half of the height."""
        values, level = self.values[..., self.ends], self.level[self.ends]
        last = (values < level).argmax(axis=0)[None] - 1
        inner, outer = np.take_along_axis(values, last, axis=0)[0], np.take_along_axis(values, last + 1, axis=0)[0]
        share = (inner - level) / np.maximum(inner - outer, np.float32(1e-9))
        return np.asarray(self.step_px * (last[0] + np.clip(share, 0.0, 1.0)), np.float32)


def _nearest(image: Image, places: NDArray[np.intp], offsets: Array) -> Image:
    """(steps, rays, n) pixels nearest to offsets (2, steps, rays) from places (n, 2), within the image."""
    col, row = np.rint(offsets).astype(np.intp)
    width = image.shape[1]
    at = (col + width * row)[..., None] + places @ (1, width)
    return np.asarray(image.ravel().take(at), np.float32)


def _interpolated(image: Image, places: NDArray[np.intp], offsets: Array) -> Image:
    """(steps, rays, n) grey values at offsets (2, steps, rays) from places (n, 2)."""
    at, off = places.T.astype(np.float32), offsets.reshape(2, -1, 1).astype(np.float32)
    values = cv2.remap(image, at[0] + off[0], at[1] + off[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(*offsets.shape[1:], len(places))


def _outlines(places: NDArray[np.intp], profiles: _Profiles) -> Outlines:
    """Of the patches that end: the moments of the polygons that the rays' ends make, by Green's theorem."""
    x, y = profiles.directions[..., None].astype(np.float32) * profiles.radii()
    x1, y1 = (np.roll(each, -1, axis=0) for each in (x, y))
    twice = x * y1 - x1 * y
    area = twice.sum(axis=0) / 2
    col, row = ((twice * (a + b)).sum(axis=0) / (6 * area) for a, b in ((x, x1), (y, y1)))
    xx, yy = ((twice * (a * a + a * b + b * b)).sum(axis=0) / (12 * area) for a, b in ((x, x1), (y, y1)))
    xy = (twice * (2 * (x * y + x1 * y1) + x * y1 + x1 * y)).sum(axis=0) / (24 * area)
    xx, xy, yy = xx - col * col, xy - col * row, yy - row * row
    x, y = x - col, y - row
    squares = (yy * x * x - 2 * xy * x * y + xx * y * y) / (4 * (xx * yy - xy * xy))
    misfit = np.sqrt(np.mean((np.sqrt(np.maximum(squares, 0.0)) - 1) ** 2, axis=0))
    center, moments = np.stack([col, row], axis=1), np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    height = profiles.height[profiles.ends]
    return Outlines(places + center.astype(float), moments.astype(float), misfit.astype(float), height.astype(float))
