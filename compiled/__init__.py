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


try:
    kernels: Kernels | None = cast(Kernels, import_module("compiled.kernels"))
except ImportError:
    kernels = None
