"""A camera as it is known before an adjustment: interior orientation, distortion, fiducial marks, each with its prior.

Lengths in mm. A standard deviation of 0 fixes a quantity, inf frees it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from adjust.functional_model.lens import Distortion, Prior

Corners = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Fiducial:
    """A fiducial mark in the camera frame: the datum observations F5 and F6."""

    x_mm: Prior
    y_mm: Prior

    @property
    def is_fixed(self) -> bool:
        return self.x_mm.sigma == 0.0 and self.y_mm.sigma == 0.0


@dataclass(frozen=True)
class FiducialDistance:
    """A measured distance between two fiducial marks, as certificates give it that know no coordinates."""

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

    principal_distance_mm None: unknown, an approximation is found from the points. The principal point likewise; it
    then starts at the centre of the frame, `center_mm` in the camera frame. frame_mm: width and height of the picture,
    0 where they are not known. distances: between fiducials, observed beside their coordinates or in place of them.
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

    def frame_corners(self, frame_mm: tuple[float, float] | None = None) -> Corners | None:
        """The lower left and the upper right corner of the picture in the camera frame; None where its size is unknown.

        frame_mm: its size where it is not the camera's own. It lies about 0 with fiducial marks, else below and to the
        right of the scan's first pixel.
        """
        width, height = frame_mm or self.frame_mm
        if not width or not height:
            return None
        left, top = (-width / 2.0, height / 2.0) if self.fiducials else (0.0, 0.0)
        return (left, top - height), (left + width, top)
