"""Network to be adjusted: cameras, images, object points and observations, with their priors.

Units: image mm, object units chosen by the user, angles rad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.board import BOARD_NAMES, BoardForm, board_form
from adjust.functional_model.lens import Lens, Prior
from adjust.functional_model.projection import STRAIGHT as STRAIGHT
from adjust.functional_model.projection import LineOfSight as LineOfSight
from adjust.functional_model.scanner import Bend, is_term
from adjust.functional_model.transformation import film_kind
from adjust.problem.camera import Camera, FiducialDistance
from adjust.problem.observations import Calibration, Distance, Observations

Transformation = str  # name as in `adjust.functional_model.transformation`
EXTERIOR_NAMES = ("X0", "Y0", "Z0", "omega", "phi", "kappa")


@dataclass(frozen=True)
class Exterior:
    """Exterior orientation: X0, Y0, Z0 in object units, omega, phi, kappa in rad.

    Attributes
    ----------
    values : (6,) elements.
    sigmas : (6,) inf for an approximation, else the standard deviation of an observed element, 0 fixed.
    """

    values: Array
    sigmas: Array = field(default_factory=lambda: np.full(6, np.inf))

    def __post_init__(self) -> None:
        if self.values.shape != (6,) or self.sigmas.shape != (6,):
            raise ValueError(f"an exterior orientation has six elements ({', '.join(EXTERIOR_NAMES)}) and six sigmas")
        if not np.isfinite(self.values).all() or not (self.sigmas >= 0.0).all():
            raise ValueError(
                f"an exterior orientation must be of finite numbers, its standard deviations 0 (fixed), positive or "
                f"inf (free), not {self.values} and {self.sigmas}"
            )

    @property
    def center(self) -> Array:
        """(3,) projection centre."""
        return self.values[:3]


@dataclass(frozen=True)
class Scanner:
    """Scanner: priors of its terms, common to all its scans (see `functional_model.scanner`).

    Attributes
    ----------
    name : name.
    terms : priors by name of the term.
    center_mm, half_mm : centre and half extent of the scans, in the comparator.
    lens : lens of a digital camera used as scanner, interior orientation in the comparator; else None.
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
        """(k,) given values of the terms."""
        return np.array([prior.value for prior in self.terms.values()])


@dataclass(frozen=True)
class Image:
    """Scan of a frame.

    Attributes
    ----------
    name : name.
    camera : name of the camera.
    transformation : film transformation.
    exterior : exterior orientation, where known.
    scanner : name of the scanner whose terms are adjusted; empty for none.
    part_of : name of the frame if the frame was scanned in several overlapping parts, else empty. Parts have separate
        film transformations and a common exterior orientation; points in two parts are of the kind "join".
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
        """Name of the frame, whose exterior orientation the image has."""
        return self.part_of or self.name

    @property
    def is_observed(self) -> bool:
        """Whether the whole exterior orientation is given with standard deviations."""
        return self.exterior is not None and bool(np.isfinite(self.exterior.sigmas).all())


@dataclass(frozen=True)
class ObjectPoint:
    """Object point: X, Y, Z with their priors; None for unknown coordinates."""

    id: str
    X: Prior | None
    Y: Prior | None
    Z: Prior | None

    @property
    def priors(self) -> tuple[Prior | None, Prior | None, Prior | None]:
        return self.X, self.Y, self.Z


@dataclass(frozen=True, eq=False)
class Board:
    """Flat board with a bend, which displaces its points from the plane, or any other displacement of points.

    places: undeformed coordinates (3,) of all its points by id, including those in no image. bends: priors of the
    parameters, bend_x and bend_y in object units. by_observation: displacements (n, k, 3) of the point of each target,
    or (n, k, 2) of its image in the camera frame, mm, by parameters of 1 that take the place of the bend.
    """

    name: str
    places: Mapping[str, Array]
    bends: tuple[Prior, ...] = (Prior(0.0, np.inf), Prior(0.0, np.inf))
    by_observation: Array | None = None

    def __post_init__(self) -> None:
        if self.by_observation is None:
            _ = self.form  # raises ValueError for points that are not a board

    @cached_property
    def form(self) -> BoardForm:
        return board_form(np.array(list(self.places.values())))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return BOARD_NAMES if self.by_observation is None else tuple(f"by_{k}" for k, _ in enumerate(self.bends))

    @cached_property
    def lift_directions(self) -> dict[str, Array]:
        """(2, 3) displacement of a point by each bend of 1, by id."""
        return dict(zip(self.places, self.form.bend_directions, strict=True))


@dataclass(frozen=True)
class Extent:
    """Extent of an image's observations in the comparator: centre (2,) and half the larger side, mm."""

    center_mm: Array
    half_mm: float


@dataclass(frozen=True, repr=False)
class Network:
    """All input of an adjustment. Names are unique; order does not matter.

    transparent: whether flat boards of given points can be seen from both sides. disk_radius: of the targets, for whose
    perspective the observations are corrected; 0 if they are no disks, None where nothing says what they are.
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
    disk_radius: float | None = None

    @cached_property
    def scanner_by_name(self) -> dict[str, Scanner]:
        return {scanner.name: scanner for scanner in self.scanners}

    @cached_property
    def rows_by_scanner(self) -> dict[str, Indices]:
        """Rows of the observations in the scans of each scanner with deformation."""
        names = np.array([image.scanner for image in self.images])[self.image_numbers]
        bending = (scanner.name for scanner in self.scanners if not scanner.bend.is_identity)
        return {name: np.flatnonzero(names == name) for name in bending}

    @cached_property
    def straight_xy_mm(self) -> Array:
        """(n, 2) observed coordinates, corrected for the given scanner terms."""
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
        """(n,) number of each observation's image."""
        number = {image.name: i for i, image in enumerate(self.images)}
        return np.array([number[name] for name in self.observations.image], dtype=np.intp)

    @cached_property
    def frame_numbers(self) -> Indices:
        """(images,) number of each image's frame, in order of first appearance."""
        number: dict[str, int] = {}
        return np.array([number.setdefault(image.frame, len(number)) for image in self.images], dtype=np.intp)

    @cached_property
    def observed_frames(self) -> Indices:
        """(n,) number of each observation's frame."""
        return self.frame_numbers[self.image_numbers]

    @cached_property
    def joins(self) -> dict[tuple[str, str], Indices]:
        """Rows of the observations of each join, by frame and point."""
        rows: dict[tuple[str, str], list[int]] = {}
        for row in np.flatnonzero(self.observations.has_kind("join")):
            frame = self.images[self.image_numbers[row]].frame
            rows.setdefault((frame, self.observations.point[row]), []).append(int(row))
        return {key: np.array(own, dtype=np.intp) for key, own in rows.items()}

    @cached_property
    def known_places(self) -> dict[str, Array]:
        """(3,) coordinates of the points given in X, Y and Z, by id."""
        return {id_: xyz for id_, xyz in self.coordinates(firm=True).items() if not np.isnan(xyz).any()}

    @cached_property
    def point_priors(self) -> tuple[Array, Array]:
        """Given coordinates of all points (points, 3), nan where unknown, and their sigmas, inf where unknown."""
        priors = [prior for point in self.points for prior in (point.X, point.Y, point.Z)]
        pairs = [(np.nan, np.inf) if prior is None else (prior.value, prior.sigma) for prior in priors]
        values, sigmas = np.array(pairs).reshape(-1, 3, 2).transpose(2, 0, 1)
        return values, sigmas

    @cached_property
    def round_origin(self) -> Array:
        """Round origin (3,) near the centre of the given coordinates; zero where the field includes the origin.

        It is a multiple of a power of two near the field's extent, so that no digit of a reduced coordinate is lost.
        Heights are not reduced where the line of sight depends on them. Where no point is given, stations count.
        """
        xyz, _ = self.point_priors
        if np.isnan(xyz).all():
            stations = [image.exterior.center for image in self.images if image.exterior is not None]
            xyz = np.array(stations).reshape(-1, 3)
        given = [axis[~np.isnan(axis)] for axis in xyz.T]
        middle = np.array([np.median(axis) if len(axis) else 0.0 for axis in given])
        off = [np.abs(axis - center) for axis, center in zip(given, middle, strict=True) if len(axis)]
        extent = max((float(np.median(axis)) for axis in off), default=0.0)
        step = 2.0 ** np.ceil(np.log2(4.0 * extent)) if extent > 0.0 else 1.0
        origin = step * np.round(middle / step)
        if not self.line_of_sight.is_straight:
            origin[2] = 0.0
        return origin if np.isfinite(origin).all() else np.zeros(3)

    def coordinates(self, firm: bool) -> dict[str, Array]:
        """(3,) known coordinates of every point, nan where unknown; firm: without approximations (infinite sigma)."""
        values, sigmas = self.point_priors
        shown = np.where(np.isinf(sigmas), np.nan, values) if firm else values
        return dict(zip((point.id for point in self.points), shown, strict=True))

    @cached_property
    def observed_points(self) -> frozenset[str]:
        """Object points seen in an image."""
        names, of_name = self.observations.numbered_points
        return frozenset(names[i] for i in np.flatnonzero(np.bincount(of_name[~self.observations.is_fiducial])))

    @cached_property
    def observed_fiducials(self) -> frozenset[tuple[str, str]]:
        """(camera, id) of the fiducials seen in an image."""
        rows = np.flatnonzero(self.observations.has_kind("fiducial"))
        return frozenset((self.images[self.image_numbers[row]].camera, self.observations.point[row]) for row in rows)

    @cached_property
    def observed_distances(self) -> tuple[tuple[str, FiducialDistance], ...]:
        """Distances between fiducials, with the camera, both ends seen in images and not both fixed."""
        return tuple(
            (camera.name, each)
            for camera in self.cameras
            for each in camera.distances
            if self.observed_fiducials.issuperset({(camera.name, each.start), (camera.name, each.end)})
            and not (camera.fiducials[each.start].is_fixed and camera.fiducials[each.end].is_fixed)
        )

    @cached_property
    def objectless_images(self) -> frozenset[str]:
        """Images whose frames show no object point."""
        frames = self.frame_numbers
        of_targets = frames[self.image_numbers[~self.observations.is_fiducial]]
        targets = np.bincount(of_targets, minlength=len(self.images))[frames]
        return frozenset(self.images[i].name for i in np.flatnonzero(targets == 0))

    @cached_property
    def unoriented(self) -> frozenset[str]:
        """Images without object points and observed orientation: only their film transformation is adjusted."""
        return frozenset(name for name in self.objectless_images if not self.image_by_name[name].is_observed)

    @cached_property
    def idle_cameras(self) -> frozenset[str]:
        """Cameras without an image of object points: their interior orientation is not adjusted."""
        busy = {image.camera for image in self.images if image.name not in self.objectless_images}
        return frozenset(camera.name for camera in self.cameras if camera.name not in busy)

    @cached_property
    def extent_by_image(self) -> dict[str, Extent]:
        """Extent of the observations by image; 1 mm for an image with fewer than two places."""
        numbers = self.image_numbers
        lowest, highest = np.full((len(self.images), 2), np.inf), np.full((len(self.images), 2), -np.inf)
        for axis, places_mm in enumerate(self.observations.xy_mm.T):  # quicker than both axes at once
            np.minimum.at(lowest[:, axis], numbers, places_mm)
            np.maximum.at(highest[:, axis], numbers, places_mm)
        extents = dict.fromkeys((image.name for image in self.images), Extent(np.zeros(2), 1.0))
        for i in np.flatnonzero(np.isfinite(lowest).all(axis=1)):
            half_mm = float((highest[i] - lowest[i]).max()) / 2.0 or 1.0
            extents[self.images[i].name] = Extent((lowest[i] + highest[i]) / 2.0, half_mm)
        return extents


@dataclass(frozen=True, repr=False)
class Approximations:
    """Initial values by camera, image and point name, in the units of the network.

    Attributes
    ----------
    interior : c, x0', y0' by camera.
    exterior : (6,) by image, equal for parts of a frame.
    transformation : parameters by image, in the order of `functional_model.transformation`.
    points : (3,) by point.
    mirrored : images whose scan is mirrored (the determinant of their transformation is negative); congruent,
        similarity and conformal transformations need this.
    joins : (2,) places in the camera frame, by frame and point.
    distortion : values by parameter, by camera; default the given ones.
    """

    interior: Mapping[str, Array]
    exterior: Mapping[str, Array]
    transformation: Mapping[str, Array]
    points: Mapping[str, Array]
    mirrored: frozenset[str] = frozenset()
    joins: Mapping[tuple[str, str], Array] = field(default_factory=dict)
    distortion: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Approximations({len(self.exterior)} orientations, {len(self.points)} points)"
