"""Calibration certificates: fit of the table of radial distortion, and conversion between its two principal distances.

A table gives r - C tan t for rays at the angle t, with the equivalent or the calibrated principal distance C (Manual of
Photogrammetry). In the model of this program c is the equivalent one; c - C, k3, k5, k7 are fitted linearly:

    r - C tan t = (c - C) tan t + k3 r³ + k5 r⁵ + k7 r⁷

The model has one principal point, of autocollimation (PPA). Distortion about a point of symmetry (PPS) d away gets
a decentering part P = -k_n d R^(n-3) 6 (3 n + 1) / (10 (n + 3)), fitted over the table's radius R; exact for n = 3.

Of a certificate with distances between fiducials alone their figure gives approximate coordinates for the adjustment.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.distance import pdist

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import FiducialDistance
from adjust.quality.lens_uncertainty import balanced_distance
from measure.marks.shapes import Point
from pipeline.errors import InputError
from pipeline.exchange.formats import Convention
from pipeline.exchange.incoming import ImportOptions, Incoming
from pipeline.files.camera_file import CameraFile, GivenFiducial, fiducial_distances
from pipeline.files.camera_tables import DEFAULT_SIGMA_MM, FiducialDistanceTable, FiducialTable
from pipeline.text.table_models import Key, Positive, WrongKey, numbers, read_model, table_model
from pipeline.text.toml_tables import read_toml
from pipeline.types import Array

CERTIFICATE = Convention(
    (float("nan"), float("nan")),
    "radial distortion in µm, positive away from the centre, at angles from the axis or at radii in mm",
    "U.S. Geological Survey, Report of Calibration of Aerial Mapping Camera (OSL): Lens Distortion by field angle",
)
POWERS = (3, 5, 7)
_ROUNDED_UM = 1.0 / np.sqrt(12.0)  # standard deviation of values rounded to 1 µm
LARGEST_CONDITION = 1e7  # of the scaled columns: their normal equations have its square
_CURVE = 400  # samples of the curve whose extremes are balanced
NUMBERS = Key("list of numbers", numbers)
REACH_MM = (10.0, 500.0)  # from the axis to the last value of a table, of any film camera
SMALLEST_UM = 0.1  # largest distortion of a table; no camera has less
CONTRADICTING = 5.0  # standard deviations by which a distance is off
DISTANCE_SIGMA_MM = 0.01  # of a distance between fiducials, where none is given
MARKS_REACH = 4.0  # of a table and its fiducials: largest ratio
STARTS = 20  # random figures: some minima are figures with a fiducial on the wrong side of others
LEAST_SINGULAR = 1e-3  # of the distances' derivatives: below, a fiducial can move without changing a distance
AS_GOOD = 25.0  # difference of chi-squares up to which another figure is not ruled out
ALIKE_MM = 1.0  # largest difference of the distances in figures that are the same
FIRST_RAD = -0.75 * np.pi  # direction of the first fiducial from the middle: lower left


@dataclass(frozen=True)
class FittedTable:
    """Fit of the distortion table.

    Attributes
    ----------
    equivalent_mm, calibrated_mm : principal distances.
    coefficients : (3,) of r^3, r^5, r^7.
    sigmas : (4,) standard deviations of equivalent_mm and the coefficients.
    residuals_um : (n,) values of the table less the curve.
    """

    equivalent_mm: float
    calibrated_mm: float
    coefficients: Array
    sigmas: Array
    residuals_um: Array


def import_certificate(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Read certificates from TOML files, as camera files with the equivalent principal distance and tables of the
    residuals."""
    cameras, notes, tables = [], list[str](), dict[str, str]()
    for path in paths:
        certificate = read_certificate(path)
        fitted = fit(certificate)
        cameras.append(_camera(certificate, fitted))
        notes += _notes(certificate, fitted)
        name = f"{path.stem}-residuals.csv"
        if name in tables:
            raise InputError(f"{path}: another certificate has the same file name {path.stem!r}. Rename one of them.")
        tables[name] = _residuals(certificate, fitted)
    return Incoming(cameras=tuple(cameras), notes=tuple(notes), tables=tables)


@table_model
class Certificate:
    """Certificate as printed: the distortions at angles or at radii, and one principal point or two.

    sigma_um: standard deviation of one value; principal_point_mm: the only point of a certificate; else
    autocollimation_mm and symmetry_mm; fiducial_distance_mm: distances "1-2" between fiducials, of one standard
    deviation.
    """

    name: str = ""
    refers_to: Literal["calibrated", "equivalent"] = "calibrated"
    calibrated_principal_distance_mm: Positive | None = None
    equivalent_principal_distance_mm: Positive | None = None
    radial_um: Annotated[tuple[float, ...], NUMBERS]
    angle_deg: Annotated[tuple[float, ...] | None, NUMBERS] = None
    radius_mm: Annotated[tuple[float, ...] | None, NUMBERS] = None
    sigma_um: Positive = float(_ROUNDED_UM)
    principal_point_mm: Point | None = None
    autocollimation_mm: Point | None = None
    symmetry_mm: Point | None = None
    fiducial: tuple[FiducialTable, ...] = ()
    fiducial_distance: tuple[FiducialDistanceTable, ...] = ()
    fiducial_distance_mm: Mapping[str, Positive] = field(default_factory=dict)
    fiducial_distance_sigma_mm: Positive = DISTANCE_SIGMA_MM

    def __post_init__(self) -> None:
        """Raises WrongKey for keys that are missing or contradict each other."""
        if not self.distance_mm:
            key = f"{self.refers_to}_principal_distance_mm"
            raise WrongKey(key, f"is missing: the table refers to the {self.refers_to} principal distance.")
        if (self.angle_deg is None) == (self.radius_mm is None):
            raise WrongKey("angle_deg", "or radius_mm must be given, one of the two: the places of radial_um.")
        key, places = ("angle_deg", self.angle_deg) if self.angle_deg else ("radius_mm", self.radius_mm or ())
        count = len(self.radial_um)
        if len(places) != count or count < 2:
            raise WrongKey(
                key, f"has {len(places)} places for {count} values of radial_um: give one a value, two or more."
            )
        if min(places) <= 0.0 or len(set(places)) < count:
            raise WrongKey(key, "must be positive and different: leave out the axis, and what is there twice.")
        if self.angle_deg and max(self.angle_deg) >= 90.0:
            raise WrongKey(key, "must lie below 90 degrees.")
        ids = [one.id for one in self.fiducial]
        for name in self.fiducial_distance_mm:
            ends = name.split("-")
            if len(ends) != 2 or ends[0] == ends[1] or (ids and not {*ends} <= {*ids}):
                raise WrongKey(
                    "fiducial_distance_mm",
                    f'has {name!r}: write the names of two fiducials, "1-2" = 299.81. Where a name has a hyphen, '
                    "[[fiducial_distance]] with from, to, mm and sigma_mm.",
                )
        self._check_units(key)
        self._check_distances()
        has_two = self.autocollimation_mm is not None or self.symmetry_mm is not None
        if self.principal_point_mm is not None and has_two:
            raise WrongKey(
                "principal_point_mm", "is one point, autocollimation_mm and symmetry_mm are two. Give either."
            )
        if self.symmetry_mm is not None and self.autocollimation_mm is None:
            raise WrongKey(
                "symmetry_mm", "needs autocollimation_mm. Give the only point that there is as principal_point_mm."
            )

    def _check_units(self, key: str) -> None:
        """Raise WrongKey where sizes fit no film camera, or the table not its fiducials; key: of the places."""
        radius_mm, tangent, radial_mm = self.curve
        reach_mm = float(np.max(radius_mm))
        given = (
            f"the table reaches from the axis to {reach_mm:.4g} mm ({np.degrees(np.arctan(tangent.max())):.3g} degrees)"
        )
        if not REACH_MM[0] < reach_mm < REACH_MM[1]:
            raise WrongKey(key, f"or the principal distance has another unit: {given}. Give degrees and mm.")
        marks_mm = max((math.hypot(*one.xy_mm) for one in self.fiducials), default=reach_mm)
        if not reach_mm / MARKS_REACH < marks_mm < MARKS_REACH * reach_mm:
            raise WrongKey(
                key, f"or xy_mm of the fiducials has another unit: {given}, the fiducials to {marks_mm:.4g} mm."
            )
        if 0.0 < np.abs(radial_mm).max() < SMALLEST_UM / 1000.0:
            largest_um = 1000.0 * np.abs(radial_mm).max()
            raise WrongKey("radial_um", f"is {largest_um:.2g} µm at most. Give µm: 3.0, not 0.003.")

    def _check_distances(self) -> None:
        """Raise WrongKey where a distance contradicts the others, or the coordinates of the fiducials."""
        place = {one.id: np.array([one.xy_mm, np.broadcast_to(one.sigma_mm, 2)]) for one in self.fiducials}
        if not self.fiducial:  # of which the distances make the figure
            place = {id: each * [[1.0], [0.0]] for id, each in place.items()}
        off = []
        for one in self.distances:
            if {one.start, one.end} <= place.keys():
                (start, start_sigma), (end, end_sigma) = place[one.start], place[one.end]
                found_mm = float(np.linalg.norm(end - start))
                sigma_mm = float(np.hypot(one.sigma_mm, np.hypot(start_sigma, end_sigma).max()))
                off.append((abs(found_mm - one.value_mm) / sigma_mm, found_mm, sigma_mm, one))
        sigmas, found_mm, sigma_mm, worst = max(off, key=lambda each: each[0], default=(0.0, 0.0, 0.0, None))
        if worst is not None and sigmas > CONTRADICTING:
            where = "with the coordinates of the fiducials" if self.fiducial else "in the figure that fits all best"
            raise WrongKey(
                "fiducial_distance_mm" if self.fiducial_distance_mm else "fiducial_distance",
                f"contradicts itself: {worst.start} to {worst.end} is {worst.value_mm:g} mm, but {found_mm:.3f} mm "
                f"{where}, more than {CONTRADICTING:g} standard deviations ({sigma_mm:.2g} mm) off. Look for a "
                "misprint, or give a larger fiducial_distance_sigma_mm.",
            )

    @property
    def distance_mm(self) -> float:
        """Principal distance to which the distortions refer; 0 if it is missing."""
        is_equivalent = self.refers_to == "equivalent"
        own = self.equivalent_principal_distance_mm if is_equivalent else self.calibrated_principal_distance_mm
        return own or 0.0

    @property
    def point_mm(self) -> Point | None:
        """Principal point of autocollimation."""
        return self.principal_point_mm or self.autocollimation_mm

    @cached_property
    def curve(self) -> tuple[Array, Array, Array]:
        """(n,) radii in mm, tangents of the angles from the axis, and distortions in mm."""
        radial_mm = np.array(self.radial_um, dtype=float) / 1000.0
        if self.angle_deg is not None:
            tangent = np.tan(np.radians(self.angle_deg))
            return self.distance_mm * tangent + radial_mm, tangent, radial_mm
        radius_mm = np.array(self.radius_mm, dtype=float)
        return radius_mm, (radius_mm - radial_mm) / self.distance_mm, radial_mm

    @cached_property
    def distances(self) -> tuple[FiducialDistance, ...]:
        tables = [FiducialDistance(one.start, one.end, one.mm, one.sigma_mm) for one in self.fiducial_distance]
        sigma_mm = self.fiducial_distance_sigma_mm
        return *tables, *(
            FiducialDistance(start, end, mm, sigma_mm)
            for name, mm in self.fiducial_distance_mm.items()
            for start, _, end in [name.partition("-")]
        )

    @cached_property
    def fiducials(self) -> tuple[FiducialTable, ...]:
        """The fiducials, where only distances are given with the coordinates that these tell. Raises WrongKey where
        they tell none."""
        if self.fiducial or not self.distances:
            return self.fiducial
        ids = list(dict.fromkeys(name for one in self.distances for name in (one.start, one.end)))
        xy_mm = figure_from_distances(ids, self.distances)
        if xy_mm is None:
            raise WrongKey(
                "fiducial_distance_mm" if self.fiducial_distance_mm else "fiducial_distance",
                f"does not tell where the {len(ids)} fiducials lie. Add distances, or approximate coordinates as "
                "[[fiducial]] with id and xy_mm.",
            )
        places = ((float(x), float(y)) for x, y in xy_mm)
        return tuple(FiducialTable(id=name, xy_mm=place) for name, place in zip(ids, places, strict=True))


def read_certificate(path: Path) -> Certificate:
    """Read a certificate. Raises InputError, with the key, for a missing principal distance, for both or none of angles
    and radii, and for lists of different lengths."""
    table = read_toml(path)
    given = read_model(table, Certificate)
    fiducial_distances(table.tables("fiducial_distance"), given.fiducial_distance, [one.id for one in given.fiducials])
    return replace(given, name=given.name or path.stem)


def fit(certificate: Certificate) -> FittedTable:
    """Fit the distortion curve by least squares, with as many of the three powers as leave one redundant value.

    The standard deviations are based on sigma_um, or on the residuals where these are larger.
    """
    radius, tangent, observed = certificate.curve
    count = max(min(len(POWERS), len(radius) - 2), 0)
    design = np.column_stack([tangent, *(radius**power for power in POWERS[:count])])
    scale = np.linalg.norm(design, axis=0)
    with np.errstate(invalid="ignore"):
        is_singular = not np.linalg.cond(design / scale) < LARGEST_CONDITION
    if is_singular:
        raise InputError(
            f"{certificate.name}: no curve can be fitted to this table: its angles or radii lie too close together or "
            "too far apart, or a radial_um is too large. Look for a misprint."
        )
    solution = np.linalg.lstsq(design / scale, observed)[0] / scale
    residuals = observed - design @ solution
    redundancy = len(radius) - design.shape[1]
    sigma = certificate.sigma_um / 1000.0
    if redundancy > 0:
        sigma = max(sigma, float(np.sqrt(residuals @ residuals / redundancy)))
    cofactor = np.linalg.inv((design / scale).T @ (design / scale)) / np.outer(scale, scale)
    sigmas = np.zeros(1 + len(POWERS))
    sigmas[: design.shape[1]] = sigma * np.sqrt(np.diag(cofactor))
    coefficients = np.zeros(len(POWERS))
    coefficients[:count] = solution[1:]
    equivalent = certificate.distance_mm + float(solution[0])
    along = np.linspace(0.0, radius.max(), _CURVE)[1:]
    displacement = np.asarray(sum(k * along**power for k, power in zip(coefficients, POWERS, strict=True)))
    calibrated, *_ = balanced_distance(along, (along - displacement) / equivalent)
    return FittedTable(equivalent, calibrated, coefficients, sigmas, 1000.0 * residuals)


def decentering(certificate: Certificate, fitted: FittedTable) -> Array:
    """P1 and P2 (2,) that move the origin of the distortion from the point of symmetry to that of autocollimation."""
    if certificate.symmetry_mm is None or certificate.point_mm is None:
        return np.zeros(2)
    off_mm = np.subtract(certificate.symmetry_mm, certificate.point_mm)
    reach_mm, powers = float(certificate.curve[0].max()), np.array(POWERS)
    parts = fitted.coefficients * reach_mm ** (powers - 3) * 0.6 * (3 * powers + 1) / (powers + 3)
    return np.asarray(-off_mm * parts.sum())


def _camera(certificate: Certificate, fitted: FittedTable) -> CameraFile:
    names = [f"k{power}" for power in POWERS]
    off = {name: Prior(p) for name, p in zip(("p1", "p2"), decentering(certificate, fitted).tolist(), strict=True) if p}
    point_sigma = math.inf if certificate.point_mm is None else DEFAULT_SIGMA_MM
    given = zip(names, fitted.coefficients.tolist(), fitted.sigmas[1:].tolist(), strict=True)
    return CameraFile(
        path=Path(certificate.name),
        name=certificate.name,
        frame_mm=None,
        principal_distance_mm=fitted.equivalent_mm,
        principal_point_mm=certificate.point_mm,
        principal_distance_sigma_mm=float(fitted.sigmas[0]),
        principal_point_sigma_mm=(point_sigma, point_sigma),
        distortion=Distortion("torlegard", {name: Prior(k, sigma) for name, k, sigma in given if sigma > 0.0} | off),
        fiducials=tuple(GivenFiducial(one.id, one.xy_mm, one.sigma_mm, None) for one in certificate.fiducials),
        distances=certificate.distances,
    )


def _notes(certificate: Certificate, fitted: FittedTable) -> list[str]:
    largest = float(np.abs(fitted.residuals_um).max())
    rms = float(np.sqrt((fitted.residuals_um**2).mean()))
    k3, k5, k7 = fitted.coefficients
    point = (
        "gives no principal point: it is left to the points"
        if certificate.point_mm is None
        else f"gives no standard deviation of the principal point: {DEFAULT_SIGMA_MM:g} mm is assumed"
    )
    off = decentering(certificate, fitted)
    apart = (
        f"{certificate.name}: the distortion counts from the principal point of symmetry, the camera file's principal "
        f"point is that of autocollimation: p1 {off[0]:.3g}, p2 {off[1]:.3g} stand for their distance."
    )
    over = len(certificate.radial_um) - int((fitted.sigmas > 0.0).sum())
    return [
        f"{certificate.name}: equivalent principal distance {fitted.equivalent_mm:.4f} mm, its standard deviation "
        f"{fitted.sigmas[0]:.4f}; calibrated {fitted.calibrated_mm:.4f} mm, by the balance of the fitted curve; the "
        f"table refers to {certificate.distance_mm:.4f} mm. The camera file has the equivalent one.",
        f"{certificate.name}: k3 {k3:.4g}, k5 {k5:.4g}, k7 {k7:.4g}; residuals of the table {rms:.2f} µm rms, "
        f"{largest:.2f} µm at most, {over} values more than unknowns.",
        f"{certificate.name}: the certificate {point}.",
        *([apart] if off.any() else []),
        *_distance_notes(certificate),
    ]


def _distance_notes(certificate: Certificate) -> list[str]:
    notes = []
    if certificate.fiducials and not certificate.fiducial:
        notes.append(
            f"{certificate.name}: gives no coordinates of fiducials. They are approximated by the distances, with "
            f"{certificate.fiducials[0].id} at the lower left: turn or mirror them if it lies elsewhere."
        )
    if certificate.fiducial_distance_mm:
        sigma_mm = certificate.fiducial_distance_sigma_mm
        notes.append(f"{certificate.name}: each distance has a standard deviation of {sigma_mm:g} mm.")
    return notes


def _residuals(certificate: Certificate, fitted: FittedTable) -> str:
    """CSV table of the certificate's values with the residuals of the fit."""
    lines = [
        f"# radial distortion of {certificate.name}, against c = {certificate.distance_mm!r} mm",
        "angle_deg,radius_mm,radial_um,fitted_um,residual_um",
    ]
    radius_mm, tangent, _ = certificate.curve
    angles = np.degrees(np.arctan(tangent))
    for row in zip(angles, radius_mm, certificate.radial_um, fitted.residuals_um, strict=True):
        angle, radius, value, residual = (float(number) for number in row)
        lines.append(f"{angle:.4f},{radius:.4f},{value:.3f},{value - residual:.3f},{residual:.3f}")
    return "\n".join(lines) + "\n"


def figure_from_distances(ids: Sequence[str], distances: Sequence[FiducialDistance]) -> Array | None:
    """Coordinates whose distances are the given ones, by least squares, about their middle.

    Distances tell neither rotation nor reflection: the first fiducial lies at the lower left, and the next one that is
    not opposite to it on the way clockwise from there.

    Parameters
    ----------
    ids : names of n fiducials.
    distances : distances between them.

    Returns
    -------
    (n, 2) array or None
        Coordinates, mm; None if the distances do not determine the figure.
    """
    if len(ids) < 3 or len(distances) < 2 * len(ids) - 3:
        return None
    start = np.array([ids.index(one.start) for one in distances])
    end = np.array([ids.index(one.end) for one in distances])
    given_mm, sigma_mm = np.array([(one.value_mm, one.sigma_mm) for one in distances]).T

    def residuals(flat: Array) -> Array:
        xy = flat.reshape(-1, 2)
        return np.asarray((np.linalg.norm(xy[end] - xy[start], axis=1) - given_mm) / sigma_mm)

    rng = np.random.default_rng(0)
    starts = rng.normal(0.0, given_mm.mean(), (STARTS, 2 * len(ids)))
    best, *others = sorted((least_squares(residuals, each) for each in starts), key=lambda solution: solution.cost)
    singular = np.linalg.svd(np.asarray(best.jac) * sigma_mm[:, None], compute_uv=False)
    as_good = [each for each in others if 2 * (each.cost - best.cost) < AS_GOOD]
    figure, *figures = (each.x.reshape(-1, 2) for each in (best, *as_good))
    apart_mm = max((float(np.abs(pdist(each) - pdist(figure)).max()) for each in figures), default=0.0)
    if singular[2 * len(ids) - 4] < LEAST_SINGULAR or apart_mm > ALIKE_MM:
        return None
    return _turned(figure)


def _turned(xy_mm: Array) -> Array:
    """The figure with its first fiducial at the lower left and the next ones clockwise from there."""
    complex_mm = (xy_mm - xy_mm.mean(axis=0)) @ [1.0, 1j]
    complex_mm = complex_mm / complex_mm[0] * abs(complex_mm[0])
    off_axis = complex_mm[np.abs(complex_mm.imag) > 0.1 * np.abs(complex_mm)]
    if len(off_axis) and off_axis[0].imag > 0:
        complex_mm = complex_mm.conj()
    complex_mm = complex_mm * np.exp(1j * FIRST_RAD)
    return np.column_stack([complex_mm.real, complex_mm.imag])
