"""Inner loops in C, where a compiler was there at the installation; elsewhere `kernels` is None, and the same is done
by numpy and scipy, slower.

Every kernel has one caller, which holds both ways. See docs/method/compiled.md.
"""

from importlib import import_module
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


class Kernels(Protocol):
    """What kernels.c gives. Arrays are of doubles, and of integers (intp) where they number something."""

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

    def square_rows(self, *arrays: NDArray[Any]) -> None:
        """Add the normal equations of pairs of rows, cell by cell: what touches the same unknowns.

        Parameters
        ----------
        matrix : (n, 2, k), right : (n, 2), pairs of rows; columns (w,) : those of the matrix that count.
        order : (n,) the rows cell by cell; first (p + 1,) : where each begins; unknowns (p, w), -1 for none.
        sequence, home : (p,) the cells by their fronts, and the front of each.
        fronts : (f, 5) first unknown, how many are owned, where its square begins in `squares`, where those that it
            meets later begin in `after`, and how many these are; after.
        squares : lower triangles of all fronts, right sides (s,), to both of which is added.
        """
        ...

    def eliminate_blocks(self, *arrays: NDArray[Any]) -> None:
        """Eliminate the own unknowns of many small blocks, and subtract the squares of their borders.

        Parameters
        ----------
        matrix, right : as in `square_rows`.
        order, first, sequence, home : (m,), (b + 1,), (b,) and (b,) of blocks, as of cells there.
        by_own, by_group, by_single : (o,), (w,), (c,) columns of the matrix.
        own : (b, o), group (m,), members (g, w), single (n, c), numbers of unknowns, -1 for none.
        singles : (t,) the single unknowns that blocks touch.
        weight, prior : (b, o) of own unknowns.
        fronts, after : as there.
        triangle, reduced, orthonormal, parts, alone : (b, o, o), (b, o), (o, 2, m), (m, o, w), (b, o, t), to be filled
            as in `adjust.linear_algebra.schur_complement.SparseBlocks`.
        squares, right sides : as there.
        """
        ...

    def border_cofactors(self, *arrays: NDArray[Any]) -> None:
        """Fill cofactors (b, o, o) with B Q B' of the borders B of blocks, as `eliminate_blocks` gives them.

        Parameters
        ----------
        first, sequence, home, group, members, singles, parts, alone, fronts, after : as there.
        squares : the cofactor matrix Q of the shared unknowns, lower triangles of all fronts.
        cofactors : to be filled.
        """
        ...

    def target_rays(self, *arrays: NDArray[Any]) -> None:
        """Fill rays (m, 2), and points in the camera's axes (m, 3).

        Parameters
        ----------
        values : (u,); exterior (images, 6), place (m, 3) : positions in them; image (m,); rotation (images, 3, 3).
        ray, in_camera : to be filled.
        """
        ...

    def target_derivatives(self, *arrays: NDArray[Any]) -> None:
        """Fill columns of derivatives (n, 2, k) at rows: by exterior orientations, by object points, by cameras.

        Parameters
        ----------
        rows, image : (m,) observations and their images; rotation, attitude (images, 3, 3).
        ray : (m, 2), in_camera (m, 3), by_ray (m, 2, 2), of targets.
        exterior, place : which of the six elements, and of the three coordinates, have one of the first columns.
        camera : (c, 2, m) the derivatives by the camera, for columns from first (1,) on.
        derivatives : to be filled.
        """
        ...

    def whiten_rows(self, *arrays: NDArray[Any]) -> None:
        """Divide rows (n, 2, k) by L of A C A' = L L', and A v by it.

        Parameters
        ----------
        by_observation, covariance : (n, 2, 2); differences v (n, 2).
        root : (n, 2, 2) L, to be filled; rows, divided in place; right (n, 2), to be filled.
        """
        ...


def _load() -> Kernels | None:
    """None where nothing was compiled, or only what earlier sources had: all is compiled anew at the next
    installation."""
    try:
        found = import_module("compiled.kernels")
    except ImportError:
        return None
    names = (name for name in vars(Kernels) if not name.startswith("_"))
    return cast(Kernels, found) if all(hasattr(found, name) for name in names) else None


kernels = _load()
