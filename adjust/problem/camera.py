"""Camera before an adjustment: interior orientation, distortion and fiducial marks, with their priors.

Lengths in mm. A standard deviation of 0 fixes a quantity, inf frees it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.lens import Distortion, Prior

Corners = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Fiducial:
    """Fiducial mark in the camera frame: the datum observations F5 and F6."""

    x_mm: Prior
    y_mm: Prior

    @property
    def is_fixed(self) -> bool:
        return self.x_mm.sigma == 0.0 and self.y_mm.sigma == 0.0


@dataclass(frozen=True)
class FiducialDistance:
    """Measured distance between two fiducial marks, from certificates without coordinates."""

    start: str
    end: str
    value_mm: float
    sigma_mm: float

    @property
    def name(self) -> str:
        return f"{self.start} to {self.end}"


@dataclass(frozen=True)
class Camera:
    """Interior orientation, distortion and fiducial marks (by id), with their priors F5 to F9.

    Attributes
    ----------
    name : name.
    principal_distance_mm : prior; None: unknown, an approximation is computed from the points.
    x0_mm, y0_mm : priors of the principal point; None: unknown, it starts at `center_mm`.
    distortion : distortion family with priors.
    fiducials : fiducial marks by id.
    center_mm : centre of the frame in the camera frame.
    frame_mm : width and height of the image, 0 where unknown.
    distances : distances between fiducials, observed in addition to, or instead of, their coordinates.
    pixel_mm : side of a pixel of a digital camera, whose messages are then in px; else None.
    """

    name: str
    principal_distance_mm: Prior | None
    x0_mm: Prior | None
    y0_mm: Prior | None
    distortion: Distortion = field(default_factory=Distortion)
    fiducials: Mapping[str, Fiducial] = field(default_factory=dict)
    center_mm: tuple[float, float] = (0.0, 0.0)
    frame_mm: tuple[float, float] = (0.0, 0.0)
    distances: tuple[FiducialDistance, ...] = ()
    pixel_mm: float | None = None

    def image_unit(self, per_mm: float = 1.0, name: str = "mm") -> tuple[Array, str]:
        """Units of x and y in messages per mm, and their name: px, y down, of known pixels; else the given one."""
        if self.pixel_mm is None:
            return np.full(2, per_mm), name
        return np.array([1.0, -1.0]) / self.pixel_mm, "px"

    def frame_corners(self, xy_mm: Array, frame_mm: tuple[float, float] | None = None) -> Corners | None:
        """Lower left and upper right corner of the image in the camera frame; None where its size is unknown.

        xy_mm (n, 2): places of marks in the camera frame; frame_mm: size of the image, if not the camera's own. The
        image is centred on 0 with fiducial marks, and where all marks lie inside then and not inside otherwise; else it
        extends right and down from the first pixel of the scan.
        """
        width, height = frame_mm or self.frame_mm
        if not width or not height:
            return None
        half = np.array([width, height]) / 2.0
        inside_centred, inside = ((np.abs(xy_mm - middle) <= half).all() for middle in ((0.0, 0.0), half * [1.0, -1.0]))
        centred = self.fiducials or (inside_centred and not inside)
        left, top = (-width / 2.0, height / 2.0) if centred else (0.0, 0.0)
        return (left, top - height), (left + width, top)
