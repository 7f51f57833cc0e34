"""What a user may set about the measurement of fiducial marks, and prior knowledge of film and scanner."""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from measure.annotations.fields import KnownLine
from measure.array_types import Array
from measure.fiducials.film_model import film_terms
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout
from measure.matching.options import MatchOptions

SCATTER_MM = 0.005  # of a mark, along an axis: a project's film_sigma_um says it better
AFFINITY_SIGMA = 5e-3  # film stretches by a few parts in ten thousand, an office scanner by several thousandths
SCATTER_DEGREES = 4.0  # of freedom that it is known with: to a third
MOST_BENT_MM = 0.3  # beside an affine transformation
_PERSPECTIVE = 1.5e-5  # mm a mm2 of a frame's span: film photographed from 0.6 m at 5 degrees, less a similarity
Reads = Literal["none", "pose", "all"]
CLICK_SIGMA_PX = 0.5  # of a place at which a person points, in a picture that is enlarged for it


class TakingLens(Protocol):
    """The lens of a digital camera that photographed the film, as calibrated: between pixels of the scan, which is its
    picture, and the ideal pixels of a picture without distortion."""

    def ideal_px(self, scan_px: Array) -> Array:
        """Pixels (..., 2) of the scan in the ideal picture."""

    def scan_px(self, ideal_px: Array) -> Array:
        """Pixels (..., 2) of the ideal picture in the scan."""

    def covariance_px2(self, scan_px: Array) -> Array:
        """(2n, 2n) of ideal pixels, by what is not known of the lens, all of pixels (n, 2) together."""

    def crop(self, col: int, row: int) -> "TakingLens":
        """The lens of a part of the scan that begins at a pixel."""


@dataclass(frozen=True)
class BelievedFilm:
    """The scatter of marks by film and scanner, along an axis. is_stated: somebody says so, and adds it to every mark
    where it is adjusted; else a frame that scatters more has to bring all of its scatter along. model: the film
    deformation model that the project states. lens: of the camera that photographed the film, None of a scanner."""

    sigma_mm: float = SCATTER_MM
    is_stated: bool = False
    model: str = "affine"
    lens: TakingLens | None = None

    @property
    def added_later_mm(self) -> float:
        return self.sigma_mm if self.is_stated else 0.0


ANY_FILM = BelievedFilm()


@dataclass(frozen=True)
class Click:
    """A mark where a person sees it, in the scan's pixels."""

    point: str
    col_px: float
    row_px: float


@dataclass(frozen=True)
class FiducialOptions:
    """How fiducial marks are measured.

    pose: "auto", or one of the eight where the user knows it. rotation_deg, scale_tolerance: how far the frame may be
    turned and scaled against its pose and the pitch. pitch_is_right: whether a given pitch is right to some per cents
    for sure; else the frame may also fill the scan. misfit_mm, affinity: how far a mark may lie from its given place
    when it is searched, plus what share of the constellation's span. gate_mm: how far a measured mark may lie from
    where the others put it. film_sigma_mm: scatter of marks by film and scanner. film_model: of its
    deformation, as the project states it. match: of the fit at full resolution;
    a polygon is matched with the rotation and scale of the frame. writing: what is written about the frame is read in
    "none", where nothing else decides the "pose", or in "all". known_lines: of the same roll; where one of them is read
    at its place, the pose asks for no more. part: the scan shows a part of its frame, that about the scan's middle: two
    marks are enough then, for the other parts check them. clicks: where a person sees marks: they are matched from
    there, and three or more say where the frame is. lens: of the camera that photographed the film, None of a scanner.
    Raises ValueError, naming the option, for a value that is none.
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

    def search_mm(self, layout: FiducialLayout) -> float:
        """How far from its given place a mark of the layout is searched."""
        places = np.array([mark.xy_mm for mark in layout.marks])
        span_mm = float(np.hypot(*np.ptp(places, axis=0)))
        tilted_mm = _PERSPECTIVE * span_mm**2 if film_terms(self.film_model, places).shape[1] else 0.0
        return self.misfit_mm + self.affinity * span_mm + tilted_mm
