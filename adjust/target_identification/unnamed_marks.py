"""The marks of an image before they have names: which one is nearest to a place, and how likely by chance."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from adjust.array_types import Array, Indices, Mask

_CELLS = 600  # of the look-up along either side of the frame
_COARSE_CELLS = 60  # of that of the density
_CROWD = 6  # marks about a place that tell how dense they are there


@dataclass(frozen=True, eq=False)
class Marks:
    """places (m, 2): ideal image coordinates about the principal point, y up, over the principal distance; least,
    greatest (2,): the corners of the frame that was searched; sigma: of one coordinate. All in principal distances.
    c: that distance, mm; c_sigma: how well it is known, relative."""

    places: Array
    least: Array
    greatest: Array
    sigma: float
    c: float
    c_sigma: float
    tree: cKDTree
    nearest_of_cell: Indices
    density_of_cell: Array

    @classmethod
    def from_mm(
        cls, xy_mm: Array, least_mm: Array, greatest_mm: Array, sigma_mm: float, c: float, c_sigma: float
    ) -> "Marks":
        """Marks (m, 2) in mm, of which there is at least one, in a frame between two corners."""
        places, least, greatest = xy_mm / c, np.asarray(least_mm) / c, np.asarray(greatest_mm) / c
        tree = cKDTree(places)
        nearest = np.asarray(tree.query(_centres(least, greatest, _CELLS))[1], dtype=np.intp)
        density = mark_density(tree, _centres(least, greatest, _COARSE_CELLS))
        mean = len(places) / float(np.prod(greatest - least))
        return cls(
            places, least, greatest, sigma_mm / c, c, c_sigma, tree, nearest, np.maximum(density, mean)
        )  # fmt: skip

    def inside(self, places: Array) -> Mask:
        """Which of the places (..., 2) lie in the frame."""
        return np.asarray(((places >= self.least) & (places <= self.greatest)).all(axis=-1))

    def nearest(self, places: Array) -> Indices:
        """The mark next to each place (..., 2) in the frame, to the fineness of the look-up."""
        return self.nearest_of_cell[self._cell(places, _CELLS)]

    def chance(self, places: Array, reach: Array) -> Array:
        """The probability that some mark lies within reach (...) of places (..., 2) if marks lie where they like, as
        dense as they are there."""
        return chance_of_a_mark(self.density_of_cell[self._cell(places, _COARSE_CELLS)], reach)

    def _cell(self, places: Array, cells: int) -> Indices:
        share = (places - self.least) / (self.greatest - self.least)
        with np.errstate(invalid="ignore"):
            cell = np.clip(np.nan_to_num(share * cells), 0, cells - 1).astype(np.intp)
        return np.asarray(cell[..., 1] * cells + cell[..., 0], dtype=np.intp)


def mark_density(tree: cKDTree, places: Array) -> Array:
    """(n,) how dense marks are about places (n, 2), by how far the nearest few reach."""
    crowd = min(_CROWD, tree.n)
    reach = np.asarray(tree.query(places, k=[crowd])[0])[:, 0]
    return np.asarray(crowd / (np.pi * np.maximum(reach, 1e-12) ** 2))


def chance_of_a_mark(density: Array, reach: Array | float) -> Array:
    """The probability that a mark lies within reach of a place if marks lie where they like, as dense as this."""
    return np.asarray(-np.expm1(-density * np.pi * np.square(reach)))


def log10_of_agreement(agreeing: int, of: int, chance: float) -> float:
    """The logarithm of the probability that so many or more agree, of so many that agree by chance independently."""
    with np.errstate(divide="ignore"):  # -inf below the smallest number
        return float(np.log10(bdtrc(agreeing - 1, of, chance)))


def _centres(least: Array, greatest: Array, cells: int) -> Array:
    """(cells², 2) the centres of the cells, row by row."""
    share = (np.arange(cells) + 0.5) / cells
    x, y = (low + share * (high - low) for low, high in zip(least, greatest, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
