"""List of all quantities of a network, with priors and initial values, and reduction of object coordinates.

The difference of two coordinates of seven digits has a rounding error of about a nanometre, which keeps an iteration
from converging. All computations therefore use coordinates relative to the centre of the field.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.camera import Camera
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Network, ObjectPoint
from adjust.problem.parameter import Kind, Parameter

Quantity = tuple[str, Prior | None, float | None]  # name, prior, approximation


@dataclass(frozen=True)
class Unknowns:
    """All quantities of a network, numbered.

    Cameras, scanners, boards and points come before the images. Parts of one frame share the exterior orientation.
    """

    parameters: tuple[Parameter, ...]  # keys
    given: Array  # (n,) given values, nan without
    sigma: Array  # (n,) standard deviations of the given values: 0 fixed, inf free
    start: Array  # (n,) initial values
    camera: dict[str, Indices]  # positions by name: c, x0', y0', then the distortion parameters
    fiducial: dict[tuple[str, str], Indices]  # positions by (camera, id)
    # scanner, board: positions by name
    scanner: dict[str, Indices]
    point: dict[str, Indices]  # positions by id
    # transformation, exterior: positions by image name
    transformation: dict[str, Indices]
    exterior: dict[str, Indices]
    join: dict[tuple[str, str], Indices]  # positions by frame and point
    board: dict[str, Indices]

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def has_prior(self) -> Mask:
        """Mask of quantities with a prior observation: F5 to F9 and similar."""
        return np.asarray((self.sigma > 0) & np.isfinite(self.sigma))

    @property
    def shared_count(self) -> int:
        """Number of quantities before those of the images."""
        return min(int(positions.min(initial=len(self))) for positions in self.exterior.values())

    def keeps_angles(self, image: str) -> bool:
        """Whether an image's attitude is updated by its angles: where one of them is observed or fixed."""
        return bool(np.isfinite(self.sigma[self.exterior[image][3:]]).any())

    def fixed(self, positions: Iterable[int]) -> "Unknowns":
        """Fix some quantities at their initial values."""
        sigma = self.sigma.copy()
        sigma[list(positions)] = 0.0
        return replace(self, sigma=sigma)

    def fixed_as_given(self, positions: Indices) -> "Unknowns":
        """Fix some quantities at their given values, or at their initial values if none is given."""
        start = self.start.copy()
        start[positions] = np.where(np.isnan(self.given[positions]), start[positions], self.given[positions])
        return replace(self.fixed(positions), start=start)


def list_unknowns(network: Network, approximations: Approximations) -> Unknowns:
    """List all quantities: cameras with their fiducials, scanners, boards, points, images.

    Cameras without an image and points that were not observed are left out. A free fiducial that was not observed is
    held at its given value. Quantities that only object points determine are held where there are none: the interior
    orientation of an idle camera, the exterior orientation of an image. Raises AdjustmentError where a quantity has
    neither a value nor an approximation.
    """
    rows = _Rows([], [], [])
    camera, fiducial = _add_cameras(rows, network, approximations)
    scanner = {
        each.name: rows.add("scanner", each.name, "", [(name, prior, None) for name, prior in each.terms.items()])
        for each in network.scanners
    }
    board = {
        each.name: rows.add(
            "board", each.name, "", [(name, prior, None) for name, prior in zip(each.names, each.bends, strict=True)]
        )
        for each in network.boards
    }
    point = rows.add_points([each for each in network.points if each.id in network.observed_points], approximations)
    transformation, exterior = _add_images(rows, network, approximations)
    join = {
        (frame, id_): rows.add("join", frame, id_, [("x", None, float(x_mm)), ("y", None, float(y_mm))])
        for (frame, id_), (x_mm, y_mm) in approximations.joins.items()
    }
    given = np.array([np.nan if prior is None else prior.value for prior in rows.priors])
    sigma = np.array([np.inf if prior is None else prior.sigma for prior in rows.priors])
    start = np.array(rows.starts, dtype=np.float64)
    start = np.where(np.isfinite(start) & (sigma > 0.0), start, given)  # fixed quantities start at their given value
    for missing in np.flatnonzero(np.isnan(start)):
        raise AdjustmentError(
            f"{rows.parameters[missing].label} has neither a value nor an approximation. Give one of them, or observe "
            f"it in images whose orientation can be found."
        )
    owned = camera, fiducial, scanner, point, transformation, exterior, join, board
    return Unknowns(tuple(rows.parameters), given, sigma, start, *owned)


def _add_cameras(
    rows: "_Rows", network: Network, approximations: Approximations
) -> tuple[dict[str, Indices], dict[tuple[str, str], Indices]]:
    """List the interior orientations and fiducials of cameras with an image; returns their positions."""
    camera, fiducial = dict[str, Indices](), dict[tuple[str, str], Indices]()
    used = {image.camera for image in network.images}
    for each in network.cameras:
        if each.name not in used:
            continue
        interior = approximations.interior.get(each.name)
        starts = (None, None, None) if interior is None else tuple(float(value) for value in interior)
        priors = (each.principal_distance_mm, each.x0_mm, each.y0_mm)
        quantities: list[Quantity] = list(zip(("c", "x0", "y0"), priors, starts, strict=True))
        given, distortion = each.distortion.parameters, approximations.distortion.get(each.name, {})
        names = parameter_names(each.distortion.family)
        quantities += [(name, given.get(name, Prior(0.0, 0.0)), distortion.get(name)) for name in names]
        idle = each.name in network.idle_cameras
        camera[each.name] = rows.add("interior", each.name, "", _stopped(quantities) if idle else quantities)
        datum = fiducial_datum(each, network.observed_fiducials, idle)
        for id_, mark in each.fiducials.items():
            pair: list[Quantity] = []
            for axis, prior in zip("xy", (mark.x_mm, mark.y_mm), strict=True):
                is_held = (each.name, id_) not in network.observed_fiducials or (id_, axis) in datum
                # A prior makes an unobserved coordinate regular; only a free one is fixed.
                fixed = is_held and np.isinf(prior.sigma)
                pair.append((axis, Prior(prior.value, 0.0) if fixed else prior, None))
            fiducial[each.name, id_] = rows.add("fiducial", each.name, id_, pair)
    return camera, fiducial


def _add_images(
    rows: "_Rows", network: Network, approximations: Approximations
) -> tuple[dict[str, Indices], dict[str, Indices]]:
    """List the exterior orientations of the frames and the film transformations of their scans; returns their
    positions by image."""
    transformation, exterior, of_frame = dict[str, Indices](), dict[str, Indices](), dict[str, Indices]()
    for image in network.images:
        if image.frame not in of_frame:
            start = approximations.exterior.get(image.name)
            starts = [None] * 6 if start is None else [float(value) for value in start]
            priors: list[Prior | None] = [None] * 6
            if image.exterior is not None:
                given = zip(image.exterior.values, image.exterior.sigmas, strict=True)
                priors = [Prior(float(value), float(sigma)) for value, sigma in given]
            quantities: list[Quantity] = list(zip(EXTERIOR_NAMES, priors, starts, strict=True))
            own = _stopped(quantities) if image.name in network.unoriented else quantities
            of_frame[image.frame] = rows.add("exterior", image.frame, "", own)
        exterior[image.name] = of_frame[image.frame]
        names = film_parameter_names(image.transformation)
        film = approximations.transformation.get(image.name, np.full(len(names), np.nan))
        if len(film) != len(names):
            raise AdjustmentError(
                f"image {image.name}: a transformation of the kind {image.transformation} has {len(names)} parameters "
                f"({', '.join(names)}), but {len(film)} approximations are given."
            )
        of_film = [(name, None, float(value)) for name, value in zip(names, film, strict=True)]
        transformation[image.name] = rows.add("film", image.name, "", of_film)
    return transformation, exterior


@dataclass(frozen=True)
class _Rows:
    """Growing list: keys, priors, and initial values (None where unknown)."""

    parameters: list[Parameter]
    priors: list[Prior | None]
    starts: list[float | None]

    def add(self, kind: Kind, owner: str, id: str, quantities: Sequence[Quantity]) -> Indices:
        """Append quantities of one owner; return their positions."""
        first = len(self.parameters)
        for name, prior, start in quantities:
            self.parameters.append(Parameter(kind, owner, id, name))
            self.priors.append(prior)
            self.starts.append(start)
        return np.arange(first, len(self.parameters))

    def add_points(self, points: Sequence[ObjectPoint], approximations: Approximations) -> dict[str, Indices]:
        """Append three coordinates for each point; return their positions by id."""
        first = len(self.parameters)
        self.parameters.extend(Parameter("point", "", point.id, axis) for point in points for axis in "XYZ")
        self.priors.extend(chain.from_iterable(point.priors for point in points))
        nowhere = np.full(3, np.nan)
        places = np.array([approximations.points.get(point.id, nowhere) for point in points], dtype=np.float64)
        self.starts.extend(places.ravel().tolist())
        positions = np.arange(first, len(self.parameters)).reshape(-1, 3)
        return dict(zip((point.id for point in points), positions, strict=True))


def fiducial_datum(camera: Camera, observed: Collection[tuple[str, str]], idle: bool) -> frozenset[tuple[str, str]]:
    """Choose coordinates (fiducial, axis) to hold where only distances place the marks.

    Distances determine neither position nor rotation of the marks: both coordinates of one mark and one of the mark
    farthest from it are minimum constraints. A given principal point determines the position. Empty without distances,
    or where a coordinate is given with a standard deviation.
    """
    marks = {id_: mark for id_, mark in camera.fiducials.items() if (camera.name, id_) in observed}
    priors = [prior for mark in marks.values() for prior in (mark.x_mm, mark.y_mm)]
    if not camera.distances or len(marks) < 2 or any(np.isfinite(prior.sigma) for prior in priors):
        return frozenset()
    places = {id_: np.array([mark.x_mm.value, mark.y_mm.value]) for id_, mark in marks.items()}
    first, last = max(
        combinations(places, 2), key=lambda pair: float(np.linalg.norm(places[pair[1]] - places[pair[0]]))
    )
    along = np.abs(places[last] - places[first])
    across = (last, "y" if along[0] >= along[1] else "x")
    is_placed = not idle and all(
        point is not None and np.isfinite(point.sigma) for point in (camera.x0_mm, camera.y0_mm)
    )
    return frozenset({across} if is_placed else {(first, "x"), (first, "y"), across})


def _stopped(quantities: list[Quantity]) -> list[Quantity]:
    """Fix quantities that are not adjusted at their given values, or at 1 as a placeholder."""
    return [(name, Prior(1.0 if prior is None else prior.value), None) for name, prior, _ in quantities]


@dataclass(frozen=True)
class Reduction:
    """Shift of object coordinates; origin (3,): subtracted from all stations and points."""

    origin: Array

    @classmethod
    def to_centroid(cls, network: Network) -> "Reduction":
        """Reduce a network to its round origin."""
        return cls(network.round_origin)

    @property
    def is_none(self) -> bool:
        return not self.origin.any()

    @property
    def inverse(self) -> "Reduction":
        """Transformation back to the network's own coordinates."""
        return Reduction(-self.origin)

    def network(self, network: Network) -> Network:
        """Reduce a network."""
        if self.is_none:
            return network
        shift, images, points = np.append(self.origin, np.zeros(3)), [], []
        for image in network.images:
            given = image.exterior and replace(image.exterior, values=image.exterior.values - shift)
            images.append(replace(image, exterior=given))
        for point in network.points:
            priors = zip(point.priors, self.origin.tolist(), strict=True)
            moved = (prior and Prior(prior.value - off, prior.sigma) for prior, off in priors)
            points.append(ObjectPoint(point.id, *moved))
        boards = (
            replace(board, places={id_: xyz - self.origin for id_, xyz in board.places.items()})
            for board in network.boards
        )
        return replace(network, images=tuple(images), points=tuple(points), boards=tuple(boards))

    def approximations(self, start: Approximations) -> Approximations:
        """Reduce approximations."""
        if self.is_none:
            return start
        shift = np.append(self.origin, np.zeros(3))
        return replace(
            start,
            exterior={image: values - shift for image, values in start.exterior.items()},
            points={point: xyz - self.origin for point, xyz in start.points.items()},
        )

    def unreduced_values(self, unknowns: Unknowns, values: Array, network: Network) -> Array:
        """Convert values (n,) of reduced unknowns to the network's own coordinates; fixed ones exactly as given."""
        if self.is_none:
            return values
        whole = values.copy()
        for at in [*unknowns.point.values(), *{at[0]: at[:3] for at in unknowns.exterior.values()}.values()]:
            whole[at] += self.origin
        for point in (each for each in network.points if each.id in unknowns.point):
            for at, prior in zip(unknowns.point[point.id], point.priors, strict=True):
                if prior is not None and prior.sigma == 0.0 and unknowns.sigma[at] == 0.0:
                    whole[at] = prior.value
        return whole
