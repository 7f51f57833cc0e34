"""Options of the measurement of fiducials; priors of the film."""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from measure.annotations.lines import KnownLine
from measure.array_types import Array
from measure.fiducials.interior_orientation import film_terms
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout
from measure.matching.models import MatchOptions

SCATTER_MM = 0.005  # mm, scatter of a mark along an axis by default; a project may state film_sigma_um
SCATTER_DEGREES = 4.0  # degrees of freedom of the scatter: it is known to a third
MOST_BENT_MM = 0.3  # mm, largest deviation from an affine transformation
_PERSPECTIVE = 1.5e-5  # mm per mm2 of a frame's span: film photographed from 0.6 m at 5 degrees, less a similarity
Reads = Literal["none", "pose", "all"]
CLICK_SIGMA_PX = 0.5  # px, standard deviation of a click in an enlarged image


class TakingLens(Protocol):
    """Calibrated lens of a digital camera that photographed the film.

    It converts between pixels of the scan, which is the camera's image, and of the ideal image without distortion.
    """

    def ideal_px(self, scan_px: Array) -> Array:
        """Convert pixels (..., 2) of the scan to the ideal image."""

    def scan_px(self, ideal_px: Array) -> Array:
        """Convert pixels (..., 2) of the ideal image to the scan."""

    def covariance_px2(self, scan_px: Array) -> Array:
        """(2n, 2n) joint covariance of the ideal pixels of scan pixels (n, 2), due to the uncertainty of the lens."""

    def crop(self, col: int, row: int) -> "TakingLens":
        """Return the lens for a crop of the scan that begins at a pixel."""


@dataclass(frozen=True)
class BelievedFilm:
    """Prior of the film.

    Attributes
    ----------
    sigma_mm : scatter of marks by film and scanner, along an axis.
    is_stated : whether the project states the scatter; the adjustment then adds it to every mark. Otherwise the
        covariances of a frame that scatters more must contain all of its scatter.
    model : film deformation model of the project.
    lens : of the camera that photographed the film, None for a scanner.
    """

    sigma_mm: float = SCATTER_MM
    is_stated: bool = False
    model: str = "affine"
    lens: TakingLens | None = None


ANY_FILM = BelievedFilm()


@dataclass(frozen=True)
class Click:
    """Place of a mark as clicked by a person, in pixels of the scan."""

    point: str
    col_px: float
    row_px: float


@dataclass(frozen=True)
class FiducialOptions:
    """Options of the measurement of fiducials.

    Attributes
    ----------
    pose : "auto", or one of the eight scan orientations if the user knows it.
    rotation_deg : largest rotation of the frame against its pose.
    scale_tolerance : largest relative error of the scale against the pitch.
    pitch_is_right : whether a given pitch is certain to some per cent; otherwise pitches at which the frame fills the
        scan are tried too.
    misfit_mm : constant part of the largest deviation of a mark from its given place in the search.
    affinity : part proportional to the constellation's span, as a fraction of it.
    gate_mm : largest deviation of a measured mark from the place predicted by the others.
    film_sigma_mm : scatter of marks by film and scanner.
    film_model : film deformation model of the project.
    match : options of least-squares matching; a polygon is matched with the rotation and scale of the frame.
    writing : in which scans the writing around the frame is read: "none", those where nothing else decides the "pose",
        or "all".
    known_lines : lines of the same roll; if one is read at its place, no more is read for the pose.
    part : the scan shows the part of its frame around the scan's centre; two marks then suffice, since the other parts
        check them.
    clicks : places clicked by a person, from which the marks are matched; three or more give the place of the frame.
    lens : of the camera that photographed the film, None for a scanner.

    Raises
    ------
    ValueError
        Names the option whose value is invalid.
    """

    pose: str = "auto"
    rotation_deg: float = 6.0
    scale_tolerance: float = 0.04
    pitch_is_right: bool = False
    misfit_mm: float = 0.15
    affinity: float = 0.003
    gate_mm: float = 0.3
    film_sigma_mm: float = SCATTER_MM
    film_model: str = "affine"
    match: MatchOptions = field(default_factory=lambda: MatchOptions(linear_sigma=0.05))
    writing: Reads = "none"
    known_lines: tuple[KnownLine, ...] = ()
    part: bool = False
    clicks: tuple[Click, ...] = ()
    lens: TakingLens | None = None

    def __post_init__(self) -> None:
        if self.pose != "auto" and self.pose not in POSES:
            raise ValueError(f"pose is {self.pose!r}; auto or one of {', '.join(POSES)} is right")
        for name in ("rotation_deg", "scale_tolerance", "misfit_mm", "affinity", "gate_mm", "film_sigma_mm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a positive number is right")
        film_terms(self.film_model, np.zeros((1, 2)))  # raises ValueError for a model that is not known

    @property
    def is_oblique(self) -> bool:
        """Whether the film was photographed obliquely, so that its picture has a perspective."""
        return self.film_model == "projective"

    def search_mm(self, layout: FiducialLayout) -> float:
        """Largest deviation of a mark of the layout from its given place in the search."""
        places = layout.places_mm
        span_mm = float(np.hypot(*np.ptp(places, axis=0)))
        tilted_mm = _PERSPECTIVE * span_mm**2 if film_terms(self.film_model, places).shape[1] else 0.0
        return self.misfit_mm + self.affinity * span_mm + tilted_mm
