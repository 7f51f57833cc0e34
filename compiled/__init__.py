"""Inner loops in C. Without a compiler at installation, `kernels` is None, and numpy and scipy do the same more slowly.

Every kernel has one caller, which contains both versions; where it eliminates, dense blocks take the other one's place.
See docs/method/theory.md, section 13.
"""

from importlib import import_module
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Singles = NDArray[np.float32]


class Kernels(Protocol):
    """Functions of kernels.c. Arrays hold doubles; numbers and indices are integers (intp)."""

    def spline_samples(
        self, coefficients: Doubles, width: int, rows: Doubles, columns: Doubles, degree: int, samples: NDArray[Any]
    ) -> int:
        """Evaluate a B-spline at places (n,) and store the values, rounded and clamped, in samples of 8 or 16 bits.

        Parameters
        ----------
        coefficients : (height, width) spline coefficients from `scipy.ndimage.spline_filter`, mirrored at the edges.
        width : of the coefficients.
        rows, columns : (n,) places.
        degree : 3 or 5.
        samples : (n,), filled.

        Returns
        -------
        Number of values that were clamped to the range of the samples.
        """
        ...

    def cover_cells(
        self, start: Doubles, end: Doubles, first: NDArray[np.int64], covered: Singles, columns: int
    ) -> None:
        """Add the parts of a drawing to the covered fractions of cells.

        Parameters
        ----------
        start, end : (n, 2) lines of the outlines, in cells, column first.
        first : (parts + 1,) number of each part's first line.
        covered : (rows, columns), added to.
        """
        ...

    def blurred_images(
        self,
        sharp: Singles,
        columns: int,
        taps: Singles,
        orders: int,
        shift: tuple[int, int],
        cells: int,
        images: Singles,
        width: int,
    ) -> None:
        """Blur cells to pixels.

        Parameters
        ----------
        sharp : (rows, columns) cells, cells x cells to a pixel.
        taps : (2, orders, taps) weights of cells along columns and rows, by the order of the derivative.
        shift : column and row of the cell on which the first tap of the first pixel falls.
        images : (1 or 6, height, width), added to: the value, or it and its derivatives by column, row, column twice,
            both, row twice.
        """
        ...

    def square_rows(self, *arrays: NDArray[Any]) -> None:
        """Accumulate the normal equations of pairs of rows, cell by cell: a cell holds rows with the same unknowns.

        Parameters
        ----------
        matrix, right : (n, 2, k), (n, 2) pairs of rows.
        columns : (w,) columns of the matrix used.
        order : (n,) rows, cell by cell.
        first : (p + 1,) index in `order` of each cell's first row.
        unknowns : (p, w) numbers of the unknowns of each cell, -1 for none.
        sequence, home : (p,) cells sorted by front, and the front of each cell.
        fronts : (f, 5) first unknown, number of own unknowns, offset of the normal matrix in `squares`, offset of the
            later unknowns in `after`, and their number.
        after : later unknowns of all fronts.
        squares : normal matrices of all fronts; the sums are added to the lower triangles.
        right sides : (s,), added to.
        """
        ...

    def eliminate_blocks(self, *arrays: NDArray[Any]) -> None:
        """Eliminate the own unknowns of many small blocks, and reduce the normal equations of the shared ones.

        The reduction subtracts B'B of the borders B (Schur complement).

        Parameters
        ----------
        matrix, right : as in `square_rows`.
        order, first, sequence, home : (m,), (b + 1,), (b,), (b,) for blocks as for cells in `square_rows`.
        by_own, by_group, by_single : (o,), (w,), (c,) columns of the matrix for these unknowns.
        own : (b, o) numbers of the own unknowns, -1 for none.
        group : (m,) group of each pair of rows.
        members, single : (g, w), (n, c) numbers of the shared unknowns, -1 for none.
        singles : (t,) single unknowns in rows with own unknowns.
        weight, prior : (b, o) root weights and right sides of the own unknowns' priors.
        fronts, after : as in `square_rows`.
        triangle, reduced, orthonormal, parts, alone : (b, o, o), (b, o), (o, 2, m), (m, o, w), (b, o, t), filled; as in
            `adjust.linear_algebra.elimination.SparseBlocks`.
        squares, right sides : as in `square_rows`, reduced in place.
        """
        ...

    def border_cofactors(self, *arrays: NDArray[Any]) -> None:
        """Compute B Q B' of blocks with borders B from `eliminate_blocks`.

        Parameters
        ----------
        first, sequence, home, group, members, singles, parts, alone, fronts, after : as in `eliminate_blocks`.
        squares : cofactor matrix Q of the shared unknowns, lower triangles of all fronts.
        cofactors : (b, o, o), filled.
        """
        ...

    def target_rays(self, *arrays: NDArray[Any]) -> None:
        """Compute rays (m, 2), and the points in camera axes (m, 3).

        Parameters
        ----------
        values : (u,) all quantities.
        exterior, place : (images, 6), (m, 3) positions in `values` of exterior orientations and object points.
        image : (m,) image of each observation.
        rotation : (images, 3, 3).
        ray, in_camera : (m, 2), (m, 3), filled.
        """
        ...

    def target_derivatives(self, *arrays: NDArray[Any]) -> None:
        """Compute derivatives with respect to exterior orientations, object points and cameras.

        Parameters
        ----------
        rows, image : (m,) observations and their images.
        rotation, attitude : (images, 3, 3).
        ray, in_camera, by_ray : (m, 2), (m, 3), (m, 2, 2) of the targets.
        exterior, place : which of the six elements, and of the three coordinates, occupy the first columns.
        camera : (c, 2, m) derivatives with respect to the camera.
        first : (1,) first column of the derivatives with respect to the camera.
        derivatives : (n, 2, k), filled at `rows`.
        """
        ...

    def whiten_rows(self, *arrays: NDArray[Any]) -> None:
        """Whiten pairs of rows: multiply them, and A v, by L^-1, where A C A' = L L'.

        Parameters
        ----------
        by_observation, covariance : (n, 2, 2) A and C.
        differences : (n, 2) v.
        root : (n, 2, 2) L, filled.
        rows : (n, 2, k), whitened in place.
        right : (n, 2) L^-1 A v, filled.
        """
        ...


def _load() -> Kernels | None:
    """Import the compiled module; None if it is missing or compiled from older sources without all of these functions.

    The next installation compiles it again.
    """
    try:
        found = import_module("compiled.kernels")
    except ImportError:
        return None
    names = (name for name in vars(Kernels) if not name.startswith("_"))
    return cast(Kernels, found) if all(hasattr(found, name) for name in names) else None


kernels = _load()
