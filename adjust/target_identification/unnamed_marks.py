"""Unidentified marks of an image: nearest neighbours and the probability of chance agreement."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from adjust.array_types import Array, Indices, Mask

_CELLS = 600  # cells of the look-up table along each side of the frame
_COARSE_CELLS = 60  # cells of the density table along each side
_CROWD = 6  # nearest marks from which the local density is estimated


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of an image; all lengths in principal distances.

    Attributes
    ----------
    places : (m, 2) ideal image coordinates relative to the principal point, y up.
    least, greatest : (2,) corners of the searched area.
    sigma : standard deviation of one coordinate.
    c : principal distance, mm.
    c_sigma : its relative standard deviation.
    tree : of the places.
    nearest_of_cell, density_of_cell : look-up tables of the nearest mark and of the density of marks.
    """

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
        """Make marks from coordinates (m, 2) in mm, m > 0, in an area between two corners."""
        places, least, greatest = xy_mm / c, np.asarray(least_mm) / c, np.asarray(greatest_mm) / c
        tree = cKDTree(places)
        nearest = np.asarray(tree.query(_centres(least, greatest, _CELLS))[1], dtype=np.intp)
        density = mark_density(tree, _centres(least, greatest, _COARSE_CELLS))
        mean = len(places) / float(np.prod(greatest - least))
        return cls(
            places, least, greatest, sigma_mm / c, c, c_sigma, tree, nearest, np.maximum(density, mean)
        )  # fmt: skip

    def inside(self, places: Array) -> Mask:
        """Mask of places (..., 2) inside the searched area."""
        return np.asarray(((places >= self.least) & (places <= self.greatest)).all(axis=-1))

    def nearest(self, places: Array) -> Indices:
        """Nearest mark of each place (..., 2), to the resolution of the look-up table."""
        return self.nearest_of_cell[self._cell(places, _CELLS)]

    def chance(self, places: Array, reach: Array) -> Array:
        """Probability of a mark within reach (...) of places (..., 2), for random marks of the local density."""
        return chance_of_a_mark(self.density_of_cell[self._cell(places, _COARSE_CELLS)], reach)

    def _cell(self, places: Array, cells: int) -> Indices:
        share = (places - self.least) / (self.greatest - self.least)
        with np.errstate(invalid="ignore"):
            cell = np.clip(np.nan_to_num(share * cells), 0, cells - 1).astype(np.intp)
        return np.asarray(cell[..., 1] * cells + cell[..., 0], dtype=np.intp)


def mark_density(tree: cKDTree, places: Array) -> Array:
    """(n,) local density of marks at places (n, 2), from the distance of the k-th nearest mark."""
    crowd = min(_CROWD, tree.n)
    reach = np.asarray(tree.query(places, k=[crowd])[0])[:, 0]
    return np.asarray(crowd / (np.pi * np.maximum(reach, 1e-12) ** 2))


def chance_of_a_mark(density: Array, reach: Array | float) -> Array:
    """Probability of a mark within reach of a place, for randomly distributed marks of a density (Poisson)."""
    return np.asarray(-np.expm1(-density * np.pi * np.square(reach)))


def log10_of_agreement(agreeing: int, of: int, chance: float) -> float:
    """log10 of the binomial probability that at least `agreeing` of `of` points agree by chance."""
    with np.errstate(divide="ignore"):  # underflow gives -inf
        return float(np.log10(bdtrc(agreeing - 1, of, chance)))


def _centres(least: Array, greatest: Array, cells: int) -> Array:
    """(cells², 2) centres of the cells, row by row."""
    share = (np.arange(cells) + 0.5) / cells
    x, y = (low + share * (high - low) for low, high in zip(least, greatest, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
