"""Marks of another program, before they are written as this one's."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForeignMark:
    """place (2,): column and row, the first pixel's centre (0, 0); of a camera's fiducial (image "") mm, y up.
    covariance_px2 (2, 2): None where the other program has none."""

    image: str
    point: str
    place: Array
    covariance_px2: Array | None
