"""Adjusted quantities of a network with their covariance, and adjusted images as models that project points."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.scanner import NO_BEND
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Network
from adjust.problem.parameter import Kind, Parameter, as_parameter

Termination = Literal["converged", "singular", "iteration limit", "diverged"]


@dataclass(frozen=True)
class NullDirection:
    """Null direction: unknowns that move together without changing the observations, the cause and the remedy."""

    parameters: tuple[Parameter, ...]
    cause: str
    remedy: str


class GivenGroup(NamedTuple):
    """Given values of one owner in a file, by group: `datum` of a camera, `interior` of a camera and so on."""

    group: str
    owner: str


@dataclass(frozen=True, eq=False)
class VarianceFactor:
    """sigma0, the square root of the variance factor, and its source."""

    sigma0: float  # 1 without sufficient redundancy; standard deviations are then a priori
    redundancy: float  # redundancy of the observations used; 0 where none have enough
    # given values that only define the datum or agree better than their standard deviations allow. They are not used
    # for sigma0 and not multiplied by it.
    left_out: tuple[GivenGroup, ...] = ()
    positions: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))  # (k,) positions of these unknowns

    @property
    def is_a_priori(self) -> bool:
        return self.redundancy == 0.0


class Cofactor(Protocol):
    """A-priori covariance (sigma0 = 1) of n quantities: variances (n,) and, on demand, any block."""

    @property
    def variances(self) -> Array: ...

    def part(self, at: Indices) -> Array:
        """Matrix (k, k) of some quantities by position."""
        ...

    def parts(self, groups: Indices) -> Array:
        """Matrices (g, k, k) of groups of quantities (g, k), each of one point or of one image."""
        ...


@dataclass(frozen=True, repr=False)
class Estimates:
    """Values of all quantities of a network and their covariance.

    Attributes
    ----------
    network : adjusted network.
    termination : how the iteration ended.
    variance : sigma0 and its source.
    parameters : keys of all quantities, in the order of values and covariance (omega, phi, kappa in rad); fixed ones
        included, with zero rows. `value`, `sigma` and similar methods take a key, or its text in the files.
    values : (n,) adjusted values.
    cofactor : computed on demand; the covariance is sigma0² times the cofactor matrix. It is the a-priori covariance
        (sigma0 = 1) where sigma0 multiplies all given values; for the values that `variance` leaves out it uses the
        given variances over sigma0². Without a solution (termination "singular", "diverged") it is zero and has no
        meaning.
    mirrored : images whose scan is mirrored, as in `Approximations`.
    """

    network: Network
    termination: Termination
    variance: VarianceFactor
    parameters: tuple[Parameter, ...]
    values: Array
    cofactor: Cofactor
    mirrored: frozenset[str]

    @property
    def converged(self) -> bool:
        return self.termination == "converged"

    @property
    def sigma0(self) -> float:
        """A-posteriori standard deviation of unit weight; 1 where standard deviations are a priori."""
        return self.variance.sigma0

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Texts of the quantities in files: `IO.<camera>.k3`, `FID.<camera>.<id>.x`, `EO.<image>.X0`, `PT.<id>.X`."""
        return tuple(each.text for each in self.parameters)

    def has(self, parameter: Parameter | str) -> bool:
        return as_parameter(parameter) in self._positions

    def index(self, parameter: Parameter | str) -> int:
        return self._positions[as_parameter(parameter)]

    @cached_property
    def _positions(self) -> dict[Parameter, int]:
        return {each: i for i, each in enumerate(self.parameters)}

    def value(self, parameter: Parameter | str) -> float:
        return float(self.values[self.index(parameter)])

    def values_of(self, parameters: Iterable[Parameter | str]) -> Array:
        """(k,) values of some quantities."""
        return self.values[[self.index(each) for each in parameters]]

    def cofactor_of(self, parameters: Sequence[Parameter | str]) -> Array:
        """(k, k) cofactor matrix of some quantities."""
        return self.cofactor.part(np.array([self.index(each) for each in parameters], dtype=np.intp))

    def sigma(self, parameter: Parameter | str) -> float:
        """A-posteriori standard deviation of a quantity."""
        return self.sigma0 * float(np.sqrt(self.cofactor.variances[self.index(parameter)]))

    @property
    def approximations(self) -> Approximations:
        """The values as initial values of another adjustment."""
        network, collected = self.network, dict[tuple[Kind, str, str], dict[str, float]]()
        for each, value in zip(self.parameters, self.values.tolist(), strict=True):
            collected.setdefault((each.kind, each.owner, each.id), {})[each.quantity] = value
        values = {owner: np.array([*each.values()]) for owner, each in collected.items()}
        cameras = {camera: each for (kind, camera, _), each in collected.items() if kind == "interior"}
        return Approximations(
            interior={camera: values["interior", camera, ""][: len(INTERIOR_NAMES)] for camera in cameras},
            exterior={image.name: values["exterior", image.frame, ""] for image in network.images},
            transformation={image.name: values.get(("film", image.name, ""), np.empty(0)) for image in network.images},
            points={id: each for (kind, _, id), each in values.items() if kind == "point"},
            mirrored=self.mirrored,
            joins={(frame, point): values["join", frame, point] for frame, point in network.joins},
            distortion=cameras,
        )


def adjusted_image(estimates: Estimates, name: str) -> ImageModel:
    """Make the image model of an image from adjusted values."""
    network = estimates.network
    image = network.image_by_name[name]

    def values(kind: Kind, owner: str, quantities: tuple[str, ...]) -> Array:
        return estimates.values_of(Parameter(kind, owner, "", each) for each in quantities)

    exterior = values("exterior", image.frame, EXTERIOR_NAMES)
    parameters = values("film", name, film_parameter_names(image.transformation))
    middle_mm, mirrored = network.extent_by_image[name].center_mm, name in estimates.mirrored
    bend = network.scanner_by_name[image.scanner].bend if image.scanner else NO_BEND
    return ImageModel(
        lens=adjusted_lens(estimates, image.camera),
        rotation=rotation_from_angles(exterior[3:]),
        station=exterior[:3],
        film=Film(image.transformation, parameters, middle_mm, mirrored),
        line_of_sight=network.line_of_sight,
        bend=bend,
        bend_parameters=values("scanner", image.scanner, bend.terms),
    )


def adjusted_lens(estimates: Estimates, camera: str) -> Lens:
    """Make a camera's lens from adjusted values, without covariance."""
    distortion = estimates.network.camera_by_name[camera].distortion
    names = (*INTERIOR_NAMES, *parameter_names(distortion.family))
    interior, parameters = np.split(estimates.values_of(Parameter.interior(camera, each) for each in names), [3])
    return Lens(distortion, interior, parameters)


def observed_places(estimates: Estimates, camera: str, xy_mm: Array) -> tuple[Indices, Array]:
    """Rows of a camera's observations, image by image, and their camera coordinates (m, 2) from comparator ones
    (n, 2)."""
    network = estimates.network
    rows, places = [np.empty(0, dtype=np.intp)], [np.empty((0, 2))]
    for number, image in enumerate(network.images):
        if image.camera == camera:
            rows.append(np.flatnonzero(network.image_numbers == number))
            places.append(adjusted_image(estimates, image.name).camera_from_comparator(xy_mm[rows[-1]]))
    return np.concatenate(rows), np.concatenate(places)


def adjusted_places(estimates: Estimates, points: Sequence[str]) -> Array:
    """(n, 3) adjusted coordinates of object points, including the bends of their boards."""
    places = estimates.values_of(Parameter.point(point, axis) for point in points for axis in "XYZ").reshape(-1, 3)
    for board in estimates.network.boards:
        bends = estimates.values_of(Parameter.board(board.name, name) for name in board.names)
        for row, point in enumerate(points):
            if point in board.places:
                places[row] += bends @ board.lift_directions[point]
    return places
