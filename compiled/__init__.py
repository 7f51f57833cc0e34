"""Inner loops in C, where a compiler was there at the installation; elsewhere `kernels` is None, and the same is done
by numpy and scipy, slower.

Every kernel has one caller, which holds both ways. See docs/method/compiled.md.
"""

from importlib import import_module
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Integers = NDArray[np.intp]


class Kernels(Protocol):
    """What kernels.c gives. Buffers are C-contiguous, of doubles where nothing else is said."""

    def spline_samples(
        self, coefficients: Doubles, width: int, rows: Doubles, columns: Doubles, degree: int, samples: NDArray[Any]
    ) -> int:
        """Fill samples (n,), of 8 or 16 bits, with a spline's values at places (n,), rounded and clamped.

        Parameters
        ----------
        coefficients : (height, width), as `scipy.ndimage.spline_filter` gives them, mirrored at the edges.
        degree : 3 or 5.

        Returns
        -------
        How many were clamped to what can be stored.
        """
        ...

    def square_rows(
        self,
        matrix: Doubles,
        right: Doubles,
        columns: Integers,
        order: Integers,
        first: Integers,
        unknowns: Integers,
        sequence: Integers,
        home: Integers,
        fronts: Integers,
        after: Integers,
        squares: Doubles,
        shared: Doubles,
    ) -> None:
        """Add the normal equations of pairs of rows, cell by cell: what touches the same unknowns.

        Parameters
        ----------
        matrix : (k, n, 2), right : (n, 2), pairs of rows; columns (w,) : those of the matrix that count.
        order : (n,) the rows cell by cell; first (p + 1,) : where each begins; unknowns (p, w), -1 for none.
        sequence, home : (p,) the cells by their fronts, and the front of each.
        fronts : (f, 5) first unknown, how many are owned, where its square begins in `squares`, where those that it
            meets later begin in `after`, and how many these are.
        squares : lower triangles of all fronts, shared (s,) : right sides, to both of which is added.
        """  # fmt: skip
        ...

    def eliminate_blocks(
        self,
        matrix: Doubles,
        right: Doubles,
        order: Integers,
        first: Integers,
        sequence: Integers,
        home: Integers,
        by_own: Integers,
        by_group: Integers,
        by_single: Integers,
        own: Integers,
        group: Integers,
        members: Integers,
        single: Integers,
        singles: Integers,
        weight: Doubles,
        prior: Doubles,
        fronts: Integers,
        after: Integers,
        triangle: Doubles,
        reduced: Doubles,
        orthonormal: Doubles,
        parts: Doubles,
        alone: Doubles,
        squares: Doubles,
        shared: Doubles,
    ) -> None:
        """Eliminate the own unknowns of many small blocks, and subtract the squares of their borders.

        Parameters
        ----------
        order, first, sequence, home : (m,), (b + 1,), (b,) and (b,) of blocks, as of cells in `square_rows`.
        by_own, by_group, by_single : (o,), (w,), (c,) columns of the matrix.
        own : (b, o), members (g, w), single (n, c) : numbers of unknowns, -1 for none; group (n,).
        singles : (t,) the single unknowns that blocks touch.
        weight, prior : (b, o) of own unknowns.
        triangle, reduced, orthonormal, parts, alone : (b, o, o), (b, o), (o, 2, m), (m, o, w), (b, o, t), to be filled
            as in `adjust.linear_algebra.schur_complement.SparseBlocks`.
        matrix, right, fronts, after, squares, shared : as in `square_rows`.
        """  # fmt: skip
        ...

    def border_cofactors(
        self,
        first: Integers,
        sequence: Integers,
        home: Integers,
        group: Integers,
        members: Integers,
        singles: Integers,
        parts: Doubles,
        alone: Doubles,
        fronts: Integers,
        after: Integers,
        squares: Doubles,
        cofactors: Doubles,
    ) -> None:
        """Fill cofactors (b, o, o) with B Q B' of the borders B of blocks, as `eliminate_blocks` gives them.

        squares : the cofactor matrix Q of the shared unknowns, lower triangles of all fronts.
        """  # fmt: skip
        ...

    def target_derivatives(
        self,
        rows: Integers,
        image: Integers,
        rotation: Doubles,
        attitude: Doubles,
        ray: Doubles,
        in_camera: Doubles,
        by_ray: Doubles,
        exterior: Integers,
        place: Integers,
        derivatives: Doubles,
    ) -> None:
        """Fill the first columns of derivatives (n, 2, k): by exterior orientations and by object points.

        Parameters
        ----------
        rows, image : (m,) observations and their images; rotation, attitude (images, 3, 3).
        ray : (m, 2), in_camera (m, 3), by_ray (m, 2, 2), of targets.
        exterior, place : which of the six elements, and of the three coordinates, have a column.
        """  # fmt: skip
        ...

    def whiten_rows(
        self,
        by_observation: Doubles,
        covariance: Doubles,
        differences: Doubles,
        root: Doubles,
        rows: Doubles,
        right: Doubles,
    ) -> None:
        """Divide rows (n, 2, k) by L of A C A' = L L' (n, 2, 2), and A v (n, 2); root and right are filled."""  # fmt: skip
        ...


try:
    kernels: Kernels | None = cast(Kernels, import_module("compiled.kernels"))
except ImportError:
    kernels = None
