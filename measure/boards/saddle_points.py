"""Saddle points of the grey values arranged like a chessboard's crossings: a fast test for the presence of a board."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from measure.array_types import Array, Mask

Bytes = NDArray[np.uint8]
Strength = NDArray[np.float32]

_SMOOTHING_PX = 1.5
_APART_PX = 3  # px, a saddle point is the maximum within this distance
_STRENGTH = 0.02  # fraction of the known strength; contrast enters squared, so a seventh of it suffices
_RING_PX, _RING_PLACES = 4.0, 16  # px and samples, ring around a saddle point with two periods of light and dark
_TWICE = 2.0  # power of two periods over that of all others together
_NEIGHBOURS = 8
_LIKE = 3.0  # largest ratio of contrasts of neighbours
_LEAST_SINE = 0.3  # sine of the angle between the two lines
_HALFWAY = 0.3  # in steps, tolerance of a crossing against the midpoint of its neighbours


@dataclass(frozen=True, eq=False)
class SaddlePoints:
    """Saddle points. places_px (n, 2); waves (n,) complex: modulus is the contrast, phase twice the light direction."""

    places_px: Array
    waves: NDArray[np.complexfloating]


def saddle_strength(picture: Bytes) -> Strength:
    """(height, width) negative determinant of the Hessian of the smoothed grey values."""
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTHING_PX)
    across, down, both = (cv2.Sobel(smooth, cv2.CV_16S, *order) for order in ((2, 0), (0, 2), (1, 1)))
    squares = cv2.multiply(both, both, dtype=cv2.CV_32F)
    return np.asarray(cv2.subtract(squares, cv2.multiply(across, down, dtype=cv2.CV_32F)), np.float32)


def largest_lattice(picture: Bytes, strength: Strength, known_strength: float) -> int:
    """Size of the largest connected set of saddle points arranged like a chessboard's crossings.

    A crossing is connected with its neighbours along both lines if they have the opposite sign and it lies midway
    between them. strength: from `saddle_strength`, 0 where nothing is to be found; known_strength: that of known
    crossings; much weaker ones are ignored.
    """
    points = _saddle_points(picture, strength, known_strength)
    number = len(points.places_px)
    if number <= _NEIGHBOURS:
        return number
    near = np.asarray(cKDTree(points.places_px).query(points.places_px, _NEIGHBOURS + 1)[1])[:, 1:]
    middles, ends = np.nonzero(_line_neighbours(points, near))
    links = coo_array((np.ones(len(ends)), (middles, near[middles, ends])), shape=(number, number))
    return int(np.bincount(connected_components(links, directed=False)[1]).max())


def _line_neighbours(points: SaddlePoints, near: NDArray[np.intp]) -> Mask:
    """(n, k) mask of the k neighbours that lie on the two lines through a saddle point; empty without two lines."""
    steps = points.places_px[near] - points.places_px[:, None]
    lengths, products = np.linalg.norm(steps, axis=-1), points.waves[near] * points.waves[:, None].conj()
    contrast = np.abs(points.waves[near]) / np.abs(points.waves[:, None])
    fits = (products.real < -0.5 * np.abs(products)) & (contrast < _LIKE) & (contrast > 1 / _LIKE)
    off = np.linalg.norm(steps[:, :, None] + steps[:, None], axis=-1)
    halfway = off < _HALFWAY * np.minimum(lengths[:, :, None], lengths[:, None])
    paired = (halfway & fits[:, :, None] & fits[:, None]).any(axis=2)
    columns, rows = np.moveaxis(steps / lengths[..., None], -1, 0)
    crossing = np.abs(columns[:, :, None] * rows[:, None] - rows[:, :, None] * columns[:, None]) > _LEAST_SINE
    return np.asarray((crossing & paired[:, :, None] & paired[:, None]).any(axis=2))


def _saddle_points(picture: Bytes, strength: Strength, known_strength: float) -> SaddlePoints:
    highest = cv2.dilate(strength, np.ones((2 * _APART_PX + 1, 2 * _APART_PX + 1)))
    is_top = (strength == highest) & (strength > _STRENGTH * known_strength)
    rows, columns = np.nonzero(is_top)
    # Keep one of equal neighbours: a crossing midway between four pixels is equally strong in all of them.
    earlier = np.pad(is_top, 1)[:-1]
    is_first = ~(earlier[rows, columns] | earlier[rows, columns + 1] | earlier[rows, columns + 2])
    is_first &= ~earlier[1:][rows, columns]
    rows, columns = rows[is_first], columns[is_first]
    angles = np.arange(_RING_PLACES) * 2 * np.pi / _RING_PLACES
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTHING_PX)
    ring = [
        np.add.outer(place, _RING_PX * turn(angles)).astype(np.float32)
        for place, turn in ((columns, np.cos), (rows, np.sin))
    ]
    if not len(rows):
        return SaddlePoints(np.zeros((0, 2)), np.zeros(0, complex))
    grey = cv2.remap(smooth, ring[0], ring[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    waves = np.fft.rfft(grey.astype(float), axis=1)[:, 1:]
    power = np.abs(waves) ** 2
    is_saddle = power[:, 1] > _TWICE * (power.sum(axis=1) - power[:, 1])
    return SaddlePoints(np.stack([columns, rows], axis=1)[is_saddle].astype(float), waves[is_saddle, 1])
