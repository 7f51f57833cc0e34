"""Image points of one image, reduced for film transformation, principal point and distortion."""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array


@dataclass(frozen=True)
class Sight:
    """Points of one image, in the order of their ids.

    Attributes
    ----------
    points : (n,) ids.
    xy_mm : (n, 2) ideal coordinates relative to the principal point, y up.
    principal_distance_mm : principal distance.
    sigma_mm : typical standard deviation of one coordinate.
    """

    points: tuple[str, ...]
    xy_mm: Array
    principal_distance_mm: float
    sigma_mm: float

    @property
    def rays(self) -> Array:
        """(n, 3) directions to the points in the camera frame: (x', y', -c)."""
        return np.column_stack([self.xy_mm, np.full(len(self.xy_mm), -self.principal_distance_mm)])
