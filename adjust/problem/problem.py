"""Network with numbered quantities, its observations indexed into them, and the state of the unknowns."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.functional_model.rotation import angles_near, rotation_from_angles, rotation_from_vector, vector_by_angles
from adjust.functional_model.scanner import Bend
from adjust.functional_model.transformation import FilmKind, film_kind
from adjust.problem.further_observations import FurtherObservation, further_observations
from adjust.problem.network import Approximations, Network, Transformation
from adjust.problem.unknowns import Reduction, Unknowns, list_unknowns

_NOWHERE = np.full(3, -1, dtype=np.intp)
ABSENT = -1  # position in a column that an observation does not use


def number(network: Network, approximations: Approximations, by_elements: bool = False) -> "Problem":
    """Number the quantities of a validated network; by_elements as in `Problem`.

    Raises AdjustmentError where a quantity has neither a value nor an approximation.
    """
    return Problem(network, list_unknowns(network, approximations), approximations.mirrored, by_elements)


def number_reduced(
    network: Network, approximations: Approximations, by_elements: bool = False
) -> tuple["Problem", Reduction]:
    """Number the quantities of a validated network in coordinates reduced to its centroid; see `number`."""
    reduction = Reduction.to_centroid(network)
    return number(reduction.network(network), reduction.approximations(approximations), by_elements), reduction


@dataclass(frozen=True)
class State:
    """Current values (n,) of the unknowns, and rotation matrices (images, 3, 3).

    The angles among the values follow the rotations, except in images whose angles are observed or fixed: there the
    rotations follow the angles.
    """

    values: Array
    rotations: Array


@dataclass(frozen=True)
class Films:
    """Images with one kind of film transformation, and their observations."""

    kind: FilmKind  # formula
    images: Indices  # (m,) numbers of the images
    positions: Indices  # (m, k) positions of their parameters
    # center_mm, half_mm: (m, 2), (m,) centre and half size of their extents
    center_mm: Array
    half_mm: Array
    rows: Indices  # (n,) rows of their observations
    image_rows: Indices  # (n,) index of each observation's image among the m

    @cached_property
    def centers_mm(self) -> Array:
        """(n, 2) centre of the extent of each observation's image."""
        return np.asarray(self.center_mm.T[:, self.image_rows].T)


@dataclass(frozen=True)
class Scans:
    """Scans of one scanner with deformation: positions (k,) of its parameters, rows (n,) of the observations."""

    bend: Bend
    positions: Indices
    rows: Indices


@dataclass(frozen=True)
class Part:
    """Block of columns of an observation's derivatives.

    members: indices among the elements of an exterior orientation, the coordinates of a place, or the parameters of a
    film, camera, scanner or board. columns: where the block stands.
    """

    members: Indices
    columns: slice


class Parts(NamedTuple):
    """Column blocks of an observation's derivatives."""

    exterior: Part
    place: Part
    film: Part
    camera: Part
    scanner: Part
    board: Part

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.board.columns.stop)


@dataclass(frozen=True)
class Problem:
    """Network with its list of unknowns."""

    network: Network  # the network
    unknowns: Unknowns  # all quantities, numbered
    mirrored: frozenset[str]  # names of the images whose scan is mirrored
    # evaluate the distortion at the observed camera point instead of the adjusted one, so that every observation is an
    # explicit function of the unknowns (adjustment by elements, of indirect observations)
    by_elements: bool = False
    # standard deviations of pseudo-observations that hold free unknowns near their given values, by position (see
    # `rank_defect.diagnosis`). They are not observations and do not appear in the result.
    pseudo_observed: Mapping[int, float] = field(default_factory=dict)

    @cached_property
    def prior_sigma(self) -> Array:
        """(n,) standard deviations of priors and pseudo-observations: 0 fixed, inf without either."""
        sigma = self.unknowns.sigma.copy()
        for position, own in self.pseudo_observed.items():
            sigma[position] = min(sigma[position], own)
        return sigma

    def start(self) -> State:
        values = self.unknowns.start
        return State(values, rotation_from_angles(values[self.exterior[:, 3:]]))

    def step_state(self, state: State, step: Array) -> State:
        """Apply a step (n,) of the unknowns to a state.

        In the step, rotation vectors take the places of the angles, and centred film parameters those of the film
        parameters.
        """
        values = state.values + step
        for positions, centred_jacobian in self.films_by_centred(state):
            values[positions] = state.values[positions] + (centred_jacobian @ step[positions][..., None])[..., 0]
        rotations = rotation_from_vector(step[self.exterior[:, 3:]]) @ state.rotations
        kept, free = self.exterior[self.keeps_angles, 3:], self.exterior[~self.keeps_angles, 3:]
        if len(kept):
            rotations[self.keeps_angles] = rotation_from_angles(values[kept])
        values[free] = angles_near(rotations[~self.keeps_angles], state.values[free])
        return State(values, rotations)

    def attitude_by_unknowns(self, state: State) -> Array:
        """(images, 3, 3) derivatives of the rotation vector with respect to the attitude unknowns: vector or angles."""
        if not self.keeps_angles.any():
            return np.broadcast_to(np.eye(3), state.rotations.shape)
        by_angles = vector_by_angles(state.values[self.exterior[:, 3:]])
        return np.where(self.keeps_angles[:, None, None], by_angles, np.eye(3))

    def films_by_centred(self, state: State) -> list[tuple[Indices, Array]]:
        """Positions (m, k) of film parameters, and their derivatives (m, k, k) with respect to the centred ones."""
        return [
            (
                films.positions,
                films.kind.centred_jacobian(state.values[films.positions], films.center_mm, films.half_mm),
            )
            for films in self.films
        ]

    @cached_property
    def films(self) -> list[Films]:
        """Film transformations of all images, grouped by kind."""
        network, found = self.network, []
        members: dict[tuple[Transformation, bool], list[int]] = {}
        for i, image in enumerate(network.images):
            members.setdefault((image.transformation, image.name in self.mirrored), []).append(i)
        for key, images in members.items():
            names = [network.images[i].name for i in images]
            place = np.full(len(network.images), ABSENT, dtype=np.intp)
            place[images] = np.arange(len(images))
            rows = np.flatnonzero(place[self.image_numbers] != ABSENT)
            positions = np.array([self.unknowns.transformation[name] for name in names], dtype=np.intp)
            center_mm = np.array([network.extent_by_image[name].center_mm for name in names])
            half_mm = np.array([network.extent_by_image[name].half_mm for name in names])
            image_rows = place[self.image_numbers[rows]]
            found.append(Films(film_kind(*key), np.array(images), positions, center_mm, half_mm, rows, image_rows))
        return found

    @cached_property
    def scans(self) -> list[Scans]:
        """Scans with scanner deformation, grouped by scanner."""
        return [
            Scans(self.network.scanner_by_name[name].bend, self.unknowns.scanner[name], rows)
            for name, rows in self.network.rows_by_scanner.items()
        ]

    @cached_property
    def parts(self) -> Parts:
        """Column blocks of an observation's derivatives: columns of a free unknown in some observation."""
        free = np.append(self.unknowns.sigma > 0.0, False)  # the last stands for ABSENT
        shown = np.flatnonzero(np.bincount(self.image_numbers[~self.is_fiducial]))
        exterior, film, camera, scanner = self._image_positions
        positions = exterior[shown], self.places, film, camera[shown], scanner, self.board_positions
        used = [np.flatnonzero(free[each].any(axis=0)) for each in positions]
        ends = np.cumsum([len(members) for members in used])
        return Parts(*(Part(members, slice(end - len(members), end)) for members, end in zip(used, ends, strict=True)))

    @cached_property
    def _image_positions(self) -> tuple[Indices, Indices, Indices, Indices]:
        """(images, k) positions of exterior orientation, film, camera and scanner, padded with ABSENT."""
        unknowns, images, none = self.unknowns, self.network.images, np.empty(0, dtype=np.intp)
        cameras = side_by_side([unknowns.camera[image.camera] for image in images])
        scanners = side_by_side([unknowns.scanner.get(image.scanner, none) for image in images])
        return self.exterior, self.film_positions, cameras, scanners

    def lens_positions(self, camera: str) -> dict[str, int]:
        """Positions of the distortion parameters of a camera by their names."""
        names = parameter_names(self.network.camera_by_name[camera].distortion.family)
        return dict(zip(names, self.unknowns.camera[camera][len(INTERIOR_NAMES) :].tolist(), strict=True))

    @cached_property
    def film_positions(self) -> Indices:
        """(images, k) positions of the film parameters, padded with ABSENT."""
        return side_by_side([self.unknowns.transformation[image.name] for image in self.network.images])

    @cached_property
    def further(self) -> tuple[FurtherObservation, ...]:
        """Observations other than image points and priors of single unknowns."""
        return further_observations(self.network, self.unknowns)

    @cached_property
    def image_numbers(self) -> Indices:
        """(n,) number of each observation's image in the network."""
        return self.network.image_numbers

    @cached_property
    def is_fiducial(self) -> Mask:
        """(n,) mask of observations of a place in the camera frame instead of an object point."""
        return self.network.observations.is_fiducial

    @cached_property
    def targets_by_camera(self) -> dict[str, Indices]:
        """Rows of the observations of object points, by camera."""
        cameras = np.array([image.camera for image in self.network.images])[self.image_numbers]
        return {name: np.flatnonzero((cameras == name) & ~self.is_fiducial) for name in self.unknowns.camera}

    @cached_property
    def exterior(self) -> Indices:
        """(images, 6) positions of the exterior orientations."""
        return np.array([self.unknowns.exterior[image.name] for image in self.network.images])

    @cached_property
    def point_positions(self) -> Indices:
        """(points, 3) positions of all object coordinates."""
        return np.array(list(self.unknowns.point.values()), dtype=np.intp).reshape(-1, 3)

    @cached_property
    def keeps_angles(self) -> Mask:
        """(images,) mask of images whose attitude is updated by its angles instead of a rotation vector."""
        return np.array([self.unknowns.keeps_angles(image.name) for image in self.network.images])

    @cached_property
    def places(self) -> Indices:
        """(n, 3) positions of the point's coordinates; for a fiducial or join its two coordinates and ABSENT."""
        images, observations = self.network.images, self.network.observations
        names, of_name = observations.numbered_points
        places = np.array([self.unknowns.point.get(name, _NOWHERE) for name in names], dtype=np.intp)[of_name]
        for key, rows in self.network.joins.items():
            places[rows] = *self.unknowns.join[key], ABSENT
        for row in np.flatnonzero(observations.has_kind("fiducial")):
            camera = images[self.image_numbers[row]].camera
            places[row] = *self.unknowns.fiducial[camera, observations.point[row]], ABSENT
        return places

    @cached_property
    def board_positions(self) -> Indices:
        """(n, k) positions of the parameters of each point's boards, padded with ABSENT."""
        names, of_name = self.network.observations.numbered_points
        none = np.empty(0, dtype=np.intp)
        of_boards = [
            [
                self.unknowns.board[each.name]
                for each in self.network.boards
                if each.by_observation is not None or name in each.places
            ]
            for name in names
        ]
        positions = side_by_side([np.concatenate([none, *own]) for own in of_boards])[of_name]
        positions[self.is_fiducial] = ABSENT
        return positions

    @cached_property
    def board_directions(self) -> Array:
        """(n, k, 5) displacement of the point, and of its image in the camera frame in mm, by each parameter of its
        boards of 1; 0 where there is none."""
        names, of_name = self.network.observations.numbered_points
        found = np.zeros((*self.board_positions.shape, 5))
        for board in self.network.boards:
            row, column = np.nonzero(self.board_positions == self.unknowns.board[board.name][0])
            if board.by_observation is not None:
                directions = board.by_observation[row]
            else:
                directions = np.array([board.lift_directions[names[i]] for i in of_name[row]])
            members = slice(0, 3) if directions.shape[2] == 3 else slice(3, 5)
            for k in range(len(board.bends)):
                found[row, column + k, members] = directions[:, k]
        return found

    @cached_property
    def columns(self) -> Indices:
        """(n, k) positions of the unknowns in an observation's derivatives, as in `parts`."""
        exterior, place, film, camera, scanner, board = self.parts
        by_image = np.empty((len(self.network.images), self.parts.width), dtype=np.intp)
        for part, positions in zip((exterior, film, camera, scanner), self._image_positions, strict=True):
            by_image[:, part.columns] = positions[:, part.members]
        columns = by_image[self.image_numbers]
        for part in (exterior, camera):
            columns[self.is_fiducial, part.columns] = ABSENT
        columns[:, place.columns] = self.places[:, place.members]
        columns[:, board.columns] = self.board_positions[:, board.members]
        return columns


def side_by_side(rows: list[Indices]) -> Indices:
    """Stack rows of different lengths in one array, padded with ABSENT."""
    array = np.full((len(rows), max(len(row) for row in rows)), ABSENT, dtype=np.intp)
    for own, row in zip(array, rows, strict=True):
        own[: len(row)] = row
    return array
