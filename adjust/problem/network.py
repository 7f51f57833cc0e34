"""What is adjusted: cameras, images, object points and observations, each with what is known of it beforehand.

Units: image mm, object units of the user's choice, angles rad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.board import board_form
from adjust.functional_model.lens import Lens, Prior
from adjust.functional_model.line_of_sight import STRAIGHT as STRAIGHT
from adjust.functional_model.line_of_sight import LineOfSight as LineOfSight
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.scanner import Bend, is_term
from adjust.functional_model.transformation import film_kind
from adjust.problem.camera import Camera, FiducialDistance
from adjust.problem.observations import Calibration, Distance, Observations

Transformation = str  # as `adjust.functional_model.transformation` spells it


EXTERIOR_NAMES = ("X0", "Y0", "Z0", "omega", "phi", "kappa")


@dataclass(frozen=True)
class Exterior:
    """An exterior orientation: X0, Y0, Z0 in object units, omega, phi, kappa in rad.

    values (6,); sigmas (6,): inf for a mere approximation, else the standard deviation of an observed element, 0 fixed.
    antenna: X0, Y0, Z0 are those of a point, an antenna say, that lies so far from the projection centre along the
    camera's axes, in object units.
    """

    values: Array
    sigmas: Array = field(default_factory=lambda: np.full(6, np.inf))
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.values.shape != (6,) or self.sigmas.shape != (6,):
            raise ValueError(f"an exterior orientation has six elements ({', '.join(EXTERIOR_NAMES)}) and six sigmas")
        if not np.isfinite(self.values).all() or not (self.sigmas >= 0.0).all():
            raise ValueError(
                f"an exterior orientation must be of finite numbers, its standard deviations 0 (fixed), positive or "
                f"inf (free), not {self.values} and {self.sigmas}"
            )

    @property
    def has_antenna(self) -> bool:
        return any(self.antenna)

    @property
    def center(self) -> Array:
        """The projection centre (3,)."""
        return np.asarray(self.values[:3] - rotation_from_angles(self.values[3:]).T @ np.array(self.antenna))


@dataclass(frozen=True)
class Scanner:
    """A scanner as all its scans have it: the terms of its bend with their priors, see `functional_model.scanner`.

    center_mm, half_mm: middle and half the extent of the scans, in the comparator. lens: of a digital camera that is
    the scanner, its interior orientation in the comparator; None of any other.
    """

    name: str
    terms: Mapping[str, Prior] = field(default_factory=dict)
    center_mm: tuple[float, float] = (0.0, 0.0)
    half_mm: tuple[float, float] = (1.0, 1.0)
    lens: Lens | None = None

    def __post_init__(self) -> None:
        unknown = sorted(name for name in self.terms if not is_term(name))
        if unknown:
            raise ValueError(
                f"a scanner's bend has no term {unknown[0]}; it has stretch, shear, tilt_x, tilt_y, and a20, b11 and "
                f"the like with the degrees in x and y, together 2 to 6"
            )
        if not (np.isfinite(self.center_mm).all() and all(0.0 < half < np.inf for half in self.half_mm)):
            raise ValueError(f"half the extent of a scan must be two positive lengths in mm, not {self.half_mm}")

    @property
    def bend(self) -> Bend:
        return Bend(tuple(self.terms), self.center_mm, self.half_mm, self.lens)

    @property
    def given(self) -> Array:
        """The given values (k,) of the terms."""
        return np.array([prior.value for prior in self.terms.values()])


@dataclass(frozen=True)
class Image:
    """One scan of a frame: its camera's name, its film transformation, its exterior orientation where it is known.

    scanner: the name of the scanner whose bend is adjusted with it, empty where none is. part_of: the name of the frame
    of which it is one of several overlapping scans, empty where it is the frame's only one. Parts of a frame have
    transformations of their own and one exterior orientation; points that two of them show are of the kind "join".
    """

    name: str
    camera: str
    transformation: Transformation = "affine"
    exterior: Exterior | None = None
    scanner: str = ""
    part_of: str = ""

    def __post_init__(self) -> None:
        film_kind(self.transformation)

    @property
    def frame(self) -> str:
        """The name of its frame, whose exterior orientation it has."""
        return self.part_of or self.name

    @property
    def is_observed(self) -> bool:
        """Whether its whole exterior orientation is given with standard deviations."""
        return self.exterior is not None and bool(np.isfinite(self.exterior.sigmas).all())


@dataclass(frozen=True)
class ObjectPoint:
    """An object point: X, Y, Z, each with its prior; None where nothing is known of the coordinate."""

    id: str
    X: Prior | None
    Y: Prior | None
    Z: Prior | None


@dataclass(frozen=True, eq=False)
class Board:
    """A flat board that is bent: its points stand off their plane, see `functional_model.board`.

    places: the flat coordinates (3,) of all its points by id, also of those that no image shows. bends: of bend_x and
    bend_y, in object units, with their priors.
    """

    name: str
    places: Mapping[str, Array]
    bends: tuple[Prior, Prior] = (Prior(0.0, np.inf), Prior(0.0, np.inf))

    def __post_init__(self) -> None:
        board_form(np.array(list(self.places.values())))  # refuses what is no board

    @cached_property
    def lift_directions(self) -> dict[str, Array]:
        """(2, 3) by id: where a bend of 1 along each axis moves a point."""
        form = board_form(np.array(list(self.places.values())))
        return {id_: shape[:, None] * form.normal for id_, shape in zip(self.places, form.shapes, strict=True)}


@dataclass(frozen=True)
class Extent:
    """Where the observations of an image lie in the comparator: the middle (2,) and half the larger side, mm."""

    center_mm: Array
    half_mm: float


@dataclass(frozen=True, repr=False)
class Network:
    """Everything that one adjustment knows. Names are unique; the order of things does not matter.

    transparent: a flat board of given points can be seen from both sides.
    """

    cameras: tuple[Camera, ...]
    images: tuple[Image, ...]
    points: tuple[ObjectPoint, ...]
    observations: Observations
    distances: tuple[Distance, ...] = ()
    calibrations: tuple[Calibration, ...] = ()
    line_of_sight: LineOfSight = STRAIGHT
    scanners: tuple[Scanner, ...] = ()
    boards: tuple[Board, ...] = ()
    transparent: bool = False

    @cached_property
    def scanner_by_name(self) -> dict[str, Scanner]:
        return {scanner.name: scanner for scanner in self.scanners}

    @cached_property
    def rows_by_scanner(self) -> dict[str, Indices]:
        """The observations in the scans of every scanner that bends them."""
        names = np.array([image.scanner for image in self.images])[self.image_numbers]
        bending = (scanner.name for scanner in self.scanners if not scanner.bend.is_identity)
        return {name: np.flatnonzero(names == name) for name in bending}

    @cached_property
    def straight_xy_mm(self) -> Array:
        """The observed coordinates (n, 2), freed of the scanners' bends as far as these are given."""
        xy_mm = self.observations.xy_mm
        if self.rows_by_scanner:
            xy_mm = xy_mm.copy()
        for name, rows in self.rows_by_scanner.items():
            scanner = self.scanner_by_name[name]
            xy_mm[rows] = scanner.bend.apply(scanner.given, xy_mm[rows])
        return xy_mm

    def __repr__(self) -> str:
        return (
            f"Network({len(self.cameras)} cameras, {len(self.images)} images, {len(self.points)} points, "
            f"{len(self.observations)} observations)"
        )

    @cached_property
    def camera_by_name(self) -> dict[str, Camera]:
        return {camera.name: camera for camera in self.cameras}

    @cached_property
    def image_by_name(self) -> dict[str, Image]:
        return {image.name: image for image in self.images}

    @cached_property
    def point_by_id(self) -> dict[str, ObjectPoint]:
        return {point.id: point for point in self.points}

    @cached_property
    def image_numbers(self) -> Indices:
        """(n,) the image of every observation, by its number."""
        number = {image.name: i for i, image in enumerate(self.images)}
        return np.array([number[name] for name in self.observations.image], dtype=np.intp)

    @cached_property
    def frame_numbers(self) -> Indices:
        """(images,) the frame of every image, by its number in the order of their first images."""
        number: dict[str, int] = {}
        return np.array([number.setdefault(image.frame, len(number)) for image in self.images], dtype=np.intp)

    @cached_property
    def has_parts(self) -> bool:
        """Whether a frame was scanned in several parts."""
        return any(image.part_of for image in self.images)

    @cached_property
    def joins(self) -> dict[tuple[str, str], Indices]:
        """The observations of every join, by frame and point."""
        rows: dict[tuple[str, str], list[int]] = {}
        for row in np.flatnonzero(self.observations.has_kind("join")):
            frame = self.images[self.image_numbers[row]].frame
            rows.setdefault((frame, self.observations.point[row]), []).append(int(row))
        return {key: np.array(own, dtype=np.intp) for key, own in rows.items()}

    @cached_property
    def known_places(self) -> dict[str, Array]:
        """The coordinates (3,) of the points that are given in X, Y and Z, by id."""
        given = {point.id: [each for each in (point.X, point.Y, point.Z) if each] for point in self.points}
        return {
            id_: np.array([each.value for each in priors])
            for id_, priors in given.items()
            if len(priors) == len("XYZ") and all(np.isfinite(each.sigma) for each in priors)
        }

    @cached_property
    def observed_points(self) -> frozenset[str]:
        """The object points that are seen in an image."""
        names, of_name = self.observations.numbered_points
        return frozenset(names[i] for i in np.flatnonzero(np.bincount(of_name[~self.observations.is_fiducial])))

    @cached_property
    def observed_fiducials(self) -> frozenset[tuple[str, str]]:
        """(camera, id) of the fiducials that are seen in an image."""
        rows = np.flatnonzero(self.observations.has_kind("fiducial"))
        return frozenset((self.images[self.image_numbers[row]].camera, self.observations.point[row]) for row in rows)

    @cached_property
    def observed_distances(self) -> tuple[tuple[str, FiducialDistance], ...]:
        """Distances between fiducials, with the camera, of which images show both ends; none between fixed marks."""
        return tuple(
            (camera.name, each)
            for camera in self.cameras
            for each in camera.distances
            if self.observed_fiducials.issuperset({(camera.name, each.start), (camera.name, each.end)})
            and not (camera.fiducials[each.start].is_fixed and camera.fiducials[each.end].is_fixed)
        )

    @cached_property
    def objectless_images(self) -> frozenset[str]:
        """The images whose frames show no object point, only fiducials or nothing."""
        frames = self.frame_numbers
        of_targets = frames[self.image_numbers[~self.observations.is_fiducial]]
        targets = np.bincount(of_targets, minlength=len(self.images))[frames]
        return frozenset(self.images[i].name for i in np.flatnonzero(targets == 0))

    @cached_property
    def unoriented(self) -> frozenset[str]:
        """Those of them whose exterior orientation is not observed either: a film transformation is all they have."""
        return frozenset(name for name in self.objectless_images if not self.image_by_name[name].is_observed)

    @cached_property
    def idle_cameras(self) -> frozenset[str]:
        """The cameras none of whose images shows an object point: their interior orientation has no part."""
        busy = {image.camera for image in self.images if image.name not in self.objectless_images}
        return frozenset(camera.name for camera in self.cameras if camera.name not in busy)

    @cached_property
    def extent_by_image(self) -> dict[str, Extent]:
        numbers = self.image_numbers
        lowest, highest = np.full((len(self.images), 2), np.inf), np.full((len(self.images), 2), -np.inf)
        np.minimum.at(lowest, numbers, self.observations.xy_mm)
        np.maximum.at(highest, numbers, self.observations.xy_mm)
        return {image.name: _extent(lowest[i], highest[i]) for i, image in enumerate(self.images)}


def _extent(lowest: Array, highest: Array) -> Extent:
    """An image that shows less than two places has the extent of a millimetre."""
    if not np.isfinite(lowest).all():
        return Extent(np.zeros(2), 1.0)
    return Extent((lowest + highest) / 2.0, float((highest - lowest).max()) / 2.0 or 1.0)


@dataclass(frozen=True, repr=False)
class Approximations:
    """Where the iteration starts: by camera, image and point name, in the units of the network.

    interior (c, x0', y0'); exterior (6,), parts of a frame alike; transformation: the parameters of the image's kind in
    the order of `functional_model.transformation`; points (3,); joins (2,): places in the camera frame, by frame and
    point. mirrored: the images whose scan is mirrored (the determinant of
    their transformation is negative), which a congruent, similarity or conformal one has to be told.
    """

    interior: Mapping[str, Array]
    exterior: Mapping[str, Array]
    transformation: Mapping[str, Array]
    points: Mapping[str, Array]
    mirrored: frozenset[str] = frozenset()
    joins: Mapping[tuple[str, str], Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Approximations({len(self.exterior)} orientations, {len(self.points)} points)"
