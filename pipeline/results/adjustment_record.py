"""Content of `adjustment.json`: one class per table of the file.

Angles are in degrees; other units are in the names. NaN: undefined, null in the file. Defaults serve files of earlier
versions.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Distortion, Lens
from adjust.functional_model.scanner import Bend, is_term
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.least_squares.iteration import Iteration
from adjust.problem.estimates import GivenGroup, NullDirection
from adjust.quality.run import Group
from adjust.quality.significance import Correlation
from adjust.solution.explanations import Explanation
from pipeline.results import assessment_record
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.results.record_json import FOREIGN, Finite, Flag, Number, NumberOrNone, Sigma, Whole, WithRest
from pipeline.types import Array

_UNKNOWN = 0.1  # standard deviation over the radius from which nothing is known of the distortion


@dataclass(frozen=True, slots=True)
class GivenQuantity:
    """Prior value of a quantity; sigma 0: fixed, NaN: free."""

    value: Number
    sigma: Number


@dataclass(frozen=True, slots=True)
class Quantity:
    """Estimate with its a-posteriori standard deviation, 0 if fixed and NaN without a solution.

    sigma_clusters: standard deviation by leaving out one image at a time, valid where errors within an image are
    correlated, with unmodelled errors; the larger of both is the one to use. given: prior; t, p: statistic and p-value
    of its significance test, None if not tested.
    """

    value: Number
    sigma: Sigma
    given: GivenQuantity | None = None
    t: NumberOrNone = None
    p: NumberOrNone = None
    sigma_clusters: NumberOrNone = None


@dataclass(frozen=True, slots=True)
class GroupTestRecord:
    """F-test of several parameters together."""

    group: str
    parameters: tuple[str, ...]
    F: Number
    p: Number


@dataclass(frozen=True, slots=True, kw_only=True)
class DistortionRecord(WithRest):
    """Distortion family with its settings. axes: None if those of the camera; parameters: estimates by name."""

    rest: ClassVar = "parameters"
    family: str
    r0_mm: Number = 0.0
    decentering: Literal["reduced", "paper"] | None = None
    half_mm: tuple[Number, Number] | None = None
    axes: str | None = None
    parameters: Mapping[str, Quantity] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises ValueError for invalid settings."""
        self.settings()

    def settings(self) -> Distortion:
        """Distortion family with its settings, without parameters."""
        return Distortion(
            self.family, decentering=self.decentering or "reduced", r0_mm=self.r0_mm, half_mm=self.half_mm or (0.0, 0.0)
        )

    @classmethod
    def from_distortion(cls, distortion: Distortion, parameters: Mapping[str, Quantity]) -> "DistortionRecord":
        """Record of a distortion with the estimates of its parameters."""
        model = family(distortion.family)
        return cls(
            family=distortion.family,
            r0_mm=distortion.r0_mm,
            decentering=distortion.decentering if distortion.family == "torlegard" else None,
            half_mm=distortion.half_mm if model.needs == "half_mm" else None,
            axes="x right, y down" if model.y_down else None,
            parameters=parameters,
        )


@dataclass(frozen=True, slots=True)
class PrincipalPointRecord:
    """x0', y0' in mm."""

    x: Quantity
    y: Quantity


@dataclass(frozen=True, slots=True)
class FiducialRecord:
    """Fiducial mark of a camera. rho: correlation of x and y."""

    x_mm: Quantity
    y_mm: Quantity
    rho: Number

    @property
    def xy_mm(self) -> tuple[float, float]:
        return self.x_mm.value, self.y_mm.value

    @property
    def given_mm(self) -> tuple[float, float] | None:
        x, y = self.x_mm.given, self.y_mm.given
        return None if x is None or y is None else (x.value, y.value)


@dataclass(frozen=True, slots=True)
class LensReachRecord:
    """Extent of the observations of a lens (see `LensReach`). share: radius_mm as a fraction of corner_mm."""

    radius_mm: Number
    corner_mm: Number
    sigma_um: Number
    corner_sigma_um: Number
    frame_mm: tuple[tuple[Number, Number], tuple[Number, Number]] | None
    share: Number

    def sentence(self, camera: str, unit: ImageUnit = FILM_UNIT) -> str:
        """State the radius up to which the distortion is known, and its precision within and beyond."""
        sizes = (float(f"{um * unit.per_um:.2g}") for um in (self.sigma_um, self.corner_sigma_um))
        inside, corner = (f"{size:.9g} {unit.short_name}" for size in sizes)
        is_known = self.corner_sigma_um < 1000.0 * _UNKNOWN * self.corner_mm
        beyond = f"there its standard deviation is {corner}" if is_known else "the lens shows nothing there"
        within = f", with a standard deviation of up to {inside}" if math.isfinite(self.sigma_um) else ""
        return (
            f"The distortion of {camera} is known up to {self.radius_mm * unit.per_mm:.3g} {unit.long_name} from the "
            f"principal point{within}, {100.0 * self.share:.0f} % of the way to the corner of the picture; beyond it "
            f"is extrapolated, {beyond}."
        )


@dataclass(frozen=True, slots=True)
class ProjectionRecord:
    """Standard deviations of projected points at the nodes of a grid over the image, both axes ascending.

    distance: of the points, object units, NaN at infinity; sigma_um: one row for each y_mm.
    """

    distance: Number
    x_mm: tuple[Number, ...]
    y_mm: tuple[Number, ...]
    sigma_um: tuple[tuple[Number, ...], ...]


@dataclass(frozen=True, slots=True)
class ConvertedFrom:
    """Source of a converted lens. source: its distortion before conversion; same: whether the two models agree;
    largest_um, rms_um: their difference over the frame."""

    source: Annotated[DistortionRecord, Field(alias="from")]
    same: Flag
    largest_um: Number
    rms_um: Number


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRecord:
    """Interior orientation, distortion and fiducial marks by name.

    significance: F-tests of groups of parameters; lens_known: None without observations or a solution; projection:
    empty if it was not computed; converted: source of a converted lens; is_loose: whether a warning says that the
    images hardly determine the principal distance.
    """

    principal_distance_mm: Quantity
    principal_point_mm: PrincipalPointRecord
    distortion: DistortionRecord
    significance: tuple[GroupTestRecord, ...] = ()
    fiducials: Mapping[str, FiducialRecord]
    lens_known: LensReachRecord | None = None
    projection: tuple[ProjectionRecord, ...] = ()
    converted: ConvertedFrom | None = None
    is_loose: bool = False

    @property
    def is_calibrated(self) -> bool:
        """Whether the interior orientation was determined, not only the fiducials."""
        return math.isfinite(self.principal_distance_mm.sigma)

    @property
    def interior(self) -> Mapping[str, Quantity]:
        """c, x0, y0 and the distortion parameters by name."""
        point = self.principal_point_mm
        return {"c": self.principal_distance_mm, "x0": point.x, "y0": point.y, **self.distortion.parameters}

    def lens(self) -> Lens:
        """Lens without its covariance."""
        distortion, known = self.distortion.settings(), self.interior
        values = [known[name].value if name in known else 0.0 for name in parameter_names(distortion.family)]
        interior = np.array([known[name].value for name in INTERIOR_NAMES])
        return Lens(distortion, interior, np.array(values, dtype=float))


@dataclass(frozen=True, slots=True)
class TakingLensRecord:
    """Lens of a digital camera that photographed the film. interior_mm: c, x0', y0' in comparator coordinates."""

    family: str
    interior_mm: tuple[Number, Number, Number]
    parameters: Mapping[str, Number]

    @classmethod
    def from_lens(cls, lens: Lens) -> "TakingLensRecord":
        c, x0, y0 = lens.interior.tolist()
        names = parameter_names(lens.distortion.family)
        return cls(lens.distortion.family, (c, x0, y0), dict(zip(names, lens.parameters.tolist(), strict=True)))

    def lens(self) -> Lens:
        values = [self.parameters.get(name, 0.0) for name in parameter_names(self.family)]
        return Lens(Distortion(self.family), np.array(self.interior_mm), np.array(values, dtype=float))


@dataclass(frozen=True, slots=True)
class ScannerRecord:
    """Geometric error of a scanner, mm: products of Legendre polynomials over an extent given by center_mm and half_mm.
    lens: that of the digital camera used as a scanner, None otherwise."""

    center_mm: tuple[Number, Number]
    half_mm: tuple[Number, Number]
    terms: Mapping[str, Quantity]
    significance: tuple[GroupTestRecord, ...] = ()
    lens: TakingLensRecord | None = None

    def __post_init__(self) -> None:
        """Raises ValueError for an unknown term."""
        unknown = [name for name in self.terms if not is_term(name)]
        if unknown:
            raise ValueError(f"has the term {unknown[0]!r}, which no bend has")

    def bend(self) -> tuple[Bend, Array]:
        """Scanner error model and the values (k,) of its terms."""
        values = np.array([term.value for term in self.terms.values()], dtype=float)
        lens = None if self.lens is None else self.lens.lens()
        return Bend(tuple(self.terms), self.center_mm, self.half_mm, lens), values


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardRecord(WithRest):
    """Bending of a board: deflection of its middle from its plane, object units. points: number of its points."""

    rest: ClassVar = "terms"
    points: Whole
    terms: Mapping[str, Quantity]
    significance: tuple[GroupTestRecord, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmRecord(WithRest):
    """Film transformation of an image; parameters by their keys in the file."""

    rest: ClassVar = "parameters"
    kind: str
    mirrored: Flag = False
    parameters: Mapping[str, Quantity] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises ValueError for an unknown kind or a missing parameter."""
        for name in film_parameter_names(self.kind):
            if not self.parameters.keys() & {name, f"{name}_deg"}:
                raise ValueError(f"has no key {name!r}")

    def film(self, middle_mm: Array) -> Film:
        """Film transformation. middle_mm: (2,) approximate centre of the image in comparator coordinates."""
        known = self.parameters
        values = [
            known[name].value if name in known else math.radians(known[f"{name}_deg"].value)
            for name in film_parameter_names(self.kind)
        ]
        return Film(self.kind, np.array(values, dtype=float), middle_mm, self.mirrored)


@dataclass(frozen=True, slots=True)
class ExteriorRecord:
    """Exterior orientation, object units and degrees."""

    X0: Quantity
    Y0: Quantity
    Z0: Quantity
    omega_deg: Quantity
    phi_deg: Quantity
    kappa_deg: Quantity

    @property
    def elements(self) -> Mapping[str, Quantity]:
        return {name: getattr(self, name) for name in self.__slots__}

    @property
    def is_oriented(self) -> bool:
        return all(math.isfinite(each.sigma) for each in self.elements.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageRecord:
    """Image. scanner: "" without one; part_of: the frame of which it is a partial scan, None if whole."""

    camera: str = ""
    scanner: str = ""
    part_of: str | None = None
    transformation: FilmRecord
    exterior: ExteriorRecord


@dataclass(frozen=True, slots=True)
class PointRecord:
    """Object point, in object units."""

    X: Quantity
    Y: Quantity
    Z: Quantity

    @property
    def axes(self) -> tuple[Quantity, Quantity, Quantity]:
        return self.X, self.Y, self.Z

    @property
    def xyz(self) -> Array:
        return np.array([each.value for each in self.axes])


@dataclass(frozen=True, slots=True)
class PartRecord:
    """Partial scan of a frame. corner_sigma_um: largest standard deviation of its film transformation at a corner."""

    corner_sigma_um: Number


@dataclass(frozen=True, slots=True)
class JoinRecord:
    """Tie point of two partial scans of a frame.

    images: the two scans; x_mm, y_mm: mean camera coordinates; dx_um, dy_um: second scan minus first.
    """

    point: str
    images: tuple[str, ...]
    x_mm: Number
    y_mm: Number
    dx_um: Number
    dy_um: Number


@dataclass(frozen=True, slots=True)
class PartMarkRecord:
    """Mark of a frame scanned in parts: camera coordinates, standard deviations and correlation.

    image: the partial scan in which it was measured.
    """

    image: str
    point: str
    kind: str
    x_mm: Number
    y_mm: Number
    sx_mm: Number
    sy_mm: Number
    rho: Number


@dataclass(frozen=True, slots=True)
class JoinedFrameRecord:
    """Frame scanned in parts."""

    parts: Mapping[str, PartRecord]
    joins: tuple[JoinRecord, ...]
    marks: tuple[PartMarkRecord, ...]


@dataclass(frozen=True, slots=True)
class Sigma0Record:
    """Basis of sigma0 (see `VarianceFactor`)."""

    redundancy: Finite
    a_priori: Flag
    left_out: tuple[Annotated[GivenGroup, FOREIGN], ...]


@dataclass(frozen=True, kw_only=True)
class AdjustmentRecord:
    """Adjustment as stored: the results with their input.

    Attributes
    ----------
    made_from : fingerprints of the input by kind.
    observations, conditions : a prior counts as one, a measured point as two.
    sigma0_from : None in files of earlier versions; see `variance_factor`.
    covariance : description of the content of adjustment.npz.
    left_out : reason for each image that was left out.
    variance_factors, variance_sigmas : estimated variance factors of groups of observations, and their standard
        deviations.
    cameras, scanners, boards, images, frames, points : by name; frames are those scanned in parts.
    """

    file_name: ClassVar[str] = "adjustment.json"
    reseau: str
    made_from: Mapping[str, str] = field(default_factory=dict)
    converged: Flag
    termination: str
    iterations: Whole
    observations: Whole
    conditions: Whole
    unknowns: Whole
    redundancy: Whole
    vpv: Number = math.nan
    sigma0: Number
    sigma0_from: Sigma0Record | None = None
    covariance: str = ""
    singular: tuple[Annotated[NullDirection, FOREIGN], ...]
    correlations: tuple[Annotated[Correlation, FOREIGN], ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    unmodelled_mm: Mapping[str, Number] = field(default_factory=dict)
    variance_factors: Mapping[str, Number]
    variance_sigmas: Mapping[str, Number]
    explanations: tuple[Annotated[Explanation, FOREIGN], ...] = ()
    suspects: tuple[assessment_record.SuspectRecord, ...]
    reliability: assessment_record.ReliabilityRecord | None
    cameras: Mapping[str, CameraRecord]
    scanners: Mapping[str, ScannerRecord] = field(default_factory=dict)
    boards: Mapping[str, BoardRecord] = field(default_factory=dict)
    images: Mapping[str, ImageRecord]
    frames: Mapping[str, JoinedFrameRecord] = field(default_factory=dict)
    points: Mapping[str, PointRecord]
    residuals: tuple[assessment_record.ResidualRecord, ...]
    refraction: Flag = False
    earth_curvature: Flag = False
    distances: tuple[assessment_record.DistanceRecord, ...]
    fiducial_distances: tuple[assessment_record.FiducialDistanceRecord, ...] = ()
    calibrations: tuple[assessment_record.ObservedQuantity, ...]
    calibration_tests: tuple[assessment_record.ContradictionRecord, ...] = ()
    groups: Mapping[str, Annotated[Group, FOREIGN]]
    history: tuple[Annotated[Iteration, FOREIGN], ...] = ()

    def __post_init__(self) -> None:
        """Raises ValueError for references to undefined cameras or images."""
        for name, image in self.images.items():
            if image.camera not in (*self.cameras, ""):
                raise ValueError(f"images[{name!r}].camera is {image.camera!r}, which cameras do not hold")
        for number, row in enumerate(self.residuals):
            if row.image not in self.images:
                raise ValueError(f"residuals[{number}].image is {row.image!r}, which images do not hold")

    @property
    def variance_factor(self) -> Sigma0Record:
        """Basis of sigma0; derived from the redundancy for files of earlier versions."""
        return self.sigma0_from or Sigma0Record(self.redundancy, self.redundancy <= 0, ())

    @property
    def has_sigma0(self) -> bool:
        """Whether sigma0 was estimated, so that standard deviations are a posteriori."""
        return not self.variance_factor.a_priori

    def image_camera(self, image: str) -> str:
        """Name of an image's camera; the only camera if the file gives none."""
        return self.images[image].camera or next(iter(self.cameras))

    def camera_images(self, camera: str) -> list[str]:
        return [image for image in self.images if self.image_camera(image) == camera]

    def films(self, images: Iterable[str]) -> dict[str, Film]:
        """Film transformations of images, in the given order."""
        places = defaultdict[str, list[tuple[float, float]]](list)
        for row in self.residuals:
            places[row.image].append((row.x_mm, row.y_mm))
        middles = {image: (np.min(places[image], axis=0) + np.max(places[image], axis=0)) / 2.0 for image in images}
        return {image: self.images[image].transformation.film(middle) for image, middle in middles.items()}

    def estimated_lenses(self) -> Iterator[tuple[str, LensReachRecord]]:
        """Extents of the lenses with an estimated distortion parameter and a known frame size, by camera."""
        for name, camera in self.cameras.items():
            reach = camera.lens_known
            is_estimated = any(each.sigma > 0.0 for each in camera.distortion.parameters.values())
            if reach is not None and math.isfinite(reach.corner_mm) and is_estimated:
                yield name, reach

    def observed_mm(self, camera: str) -> Array:
        """(n, 2) camera coordinates of a camera's observations, mm."""
        rows = (row for row in self.residuals if self.image_camera(row.image) == camera)
        places = np.array([(row.camera_x_mm, row.camera_y_mm) for row in rows], dtype=float).reshape(-1, 2)
        return np.asarray(places[np.isfinite(places).all(axis=1)])
