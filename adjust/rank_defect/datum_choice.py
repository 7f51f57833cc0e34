"""The datum of the object space as the user chooses it: coordinates that are held, points that carry a free network."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adjust.array_types import Array, Indices
from adjust.errors import DatumError
from adjust.functional_model.lens import Prior
from adjust.problem.network import Network, ObjectPoint
from adjust.problem.parameter import Parameter, object_coordinate
from adjust.problem.problem import Problem
from adjust.rank_defect.datum import FLAT, ObjectDatum, free_coordinates, object_datum
from adjust.rank_defect.named_directions import DATUM_DIRECTIONS

DEPENDENT = 1e-6  # part of a coordinate's motion that those before it must leave open, or it is theirs already


def held_as_known(network: Network, coordinates: Sequence[str]) -> Network:
    """The network for approximations: coordinates that are to be held, and have a value, count as known."""
    held = {object_coordinate(text) for text in coordinates}
    return replace(network, points=tuple(_known_point(point, held) for point in network.points))


def _known_point(point: ObjectPoint, held: set[Parameter]) -> ObjectPoint:
    priors = [
        Prior(prior.value) if prior is not None and Parameter.point(point.id, axis) in held else prior
        for axis, prior in zip("XYZ", (point.X, point.Y, point.Z), strict=True)
    ]
    return ObjectPoint(point.id, *priors)


def chosen_coordinates(problem: Problem, coordinates: Sequence[str]) -> Indices:
    """Positions of the coordinates, "point.X" and so on, that a minimal datum is to hold.

    Raises DatumError where one is unknown or given already, where they hold less than is free of the datum, or
    more: that would strain the network.
    """
    positions = [_position(problem, text) for text in coordinates]
    datum = object_datum(problem, problem.start(), FLAT)
    motions = np.zeros((0, datum.free.shape[1]))
    strained = []
    for text, position in zip(coordinates, positions, strict=True):
        motion = datum.generators[position] @ datum.free
        rest = motion - motions.T @ (motions @ motion)
        if np.linalg.norm(rest) > DEPENDENT * max(float(np.linalg.norm(motion)), DEPENDENT):
            motions = np.vstack([motions, rest / np.linalg.norm(rest)])
        else:
            strained.append(text)
    if strained:
        others = "the other datum coordinates and" if len(motions) else ""
        raise DatumError(
            f"The datum is over-constrained: {others} what is given hold {', '.join(strained)} already, and "
            f"a minimal datum takes {datum.free.shape[1]} values here. To hold more would strain the network. "
            f"Leave {'it' if len(strained) == 1 else 'them'} out of the datum coordinates, or say by a standard "
            f"deviation in the points how well each is known."
        )
    _check_complete(datum, motions, f"The datum coordinates {', '.join(coordinates)}")
    return np.array(positions, dtype=np.intp)


def _position(problem: Problem, coordinate: str) -> int:
    parameter = object_coordinate(coordinate)
    _check_points(problem, [parameter.id])
    position = int(problem.unknowns.point[parameter.id]["XYZ".index(parameter.quantity)])
    if np.isfinite(problem.unknowns.sigma[position]):
        raise DatumError(
            f"The datum coordinate {coordinate} is given with the standard deviation "
            f"{problem.unknowns.sigma[position]:g}: it holds the network as it is. Leave it out of the datum "
            f"coordinates, or leave its standard deviation blank."
        )
    return position


def chosen_points(problem: Problem, points: Sequence[str]) -> Indices:
    """Positions of the free coordinates of the points (all points if none is named) that carry the inner constraints.

    Raises DatumError where one is unknown, or where they do not carry all that is free of the datum.
    """
    _check_points(problem, points)
    members = free_coordinates(problem, points)
    if points:
        datum = object_datum(problem, problem.start(), FLAT)
        motions = datum.generators[members] @ datum.free
        _, strength, right = np.linalg.svd(np.vstack([motions, np.zeros((7, motions.shape[1]))]), full_matrices=False)
        _check_complete(datum, right[strength > FLAT], f"The datum points {', '.join(points)}")
    return members


def _check_points(problem: Problem, points: Sequence[str]) -> None:
    for point in points:
        if point not in problem.unknowns.point:
            given = point in problem.network.point_by_id
            why = "is shown by no image" if given else "is not among the object points"
            raise DatumError(f"Point {point}, which the datum names, {why}. Name another point, or correct it.")


def _check_complete(datum: ObjectDatum, motions: Array, what: str) -> None:
    """Refuse a choice whose motions (k, d), orthonormal rows, leave some of the free directions (7, d) open."""
    _, _, right = np.linalg.svd(np.vstack([motions, np.zeros((motions.shape[1], motions.shape[1]))]))
    open_directions = datum.free @ right[len(motions) :].T
    if open_directions.shape[1] == 0:
        return
    numbers = _telling_rows(open_directions)
    raise DatumError(
        f"{what} do not hold the object space: it {'; it '.join(DATUM_DIRECTIONS[number][0] for number in numbers)}. "
        f"Name {'; '.join(dict.fromkeys(DATUM_DIRECTIONS[number][1] for number in numbers))}, or leave the choice to "
        f"the program."
    )


def _telling_rows(directions: Array) -> list[int]:
    """The generators by which directions (7, k) are called: turns and scale first, which move along with shifts."""
    chosen: list[int] = []
    rest = directions.copy()
    for number in (3, 4, 5, 6, 0, 1, 2):
        length = np.linalg.norm(rest[number])
        if length > FLAT and len(chosen) < directions.shape[1]:
            chosen.append(number)
            unit = rest[number] / length
            rest = rest - np.outer(rest @ unit, unit)
    return sorted(chosen)
