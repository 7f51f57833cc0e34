"""What one image sees, freed of film, principal point and distortion."""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array


@dataclass(frozen=True)
class Sight:
    """Points seen in one image, in the order of their ids.

    points (n,) ids; xy_mm (n, 2) ideal coordinates about the principal point, y up; sigma_mm: the typical standard
    deviation of one coordinate.
    """

    points: tuple[str, ...]
    xy_mm: Array
    principal_distance_mm: float
    sigma_mm: float

    @property
    def rays(self) -> Array:
        """Directions (n, 3) from the lens to the points, in the camera frame: (x', y', -c)."""
        return np.column_stack([self.xy_mm, np.full(len(self.xy_mm), -self.principal_distance_mm)])
