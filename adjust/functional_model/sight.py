"""What one image sees, freed of film, principal point and distortion."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.correction import DistortionModel
from adjust.functional_model.projection import ideal_from_observed

Array = NDArray[np.float64]


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


def freed_sight(
    points: tuple[str, ...],
    camera_mm: Array,
    sigma_mm: float,
    interior: Array,
    distortion: DistortionModel,
    known: Array,
) -> Sight:
    """The sight of points observed at camera_mm (n, 2), freed of the distortion as far as its parameters `known` have
    it; a coordinate that it cannot have produced stays as it is. interior: c, x0', y0' (3,)."""
    ideal, found = ideal_from_observed(distortion, interior, known, camera_mm)
    xy_mm = np.where(found[:, np.newaxis], ideal, camera_mm) - interior[1:]
    return Sight(points, xy_mm, float(interior[0]), sigma_mm)
