"""The datum of the object space: free similarity transformations, minimum constraints and inner constraints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array, Indices
from adjust.errors import DatumError
from adjust.functional_model.lens import Prior
from adjust.functional_model.rotation import angles_near, rotation_from_vector
from adjust.problem.network import Network, ObjectPoint
from adjust.problem.parameter import object_coordinate
from adjust.problem.problem import Problem, State
from adjust.rank_defect.directions import DATUM_DIRECTIONS

EXACT = 1e-9  # relative motion of given quantities below which a direction is free: rounding
FLAT = 1e-3  # the same, where relief below this fraction of the field's extent must not define a datum
DEPENDENT = 1e-6  # fraction of a coordinate's motion that must be independent of the coordinates chosen before
CENTERINGS = 10  # iterations at most; two or three suffice, since the transformation is nearly linear
LEVERAGES = (0.4, 0.1)  # independent fraction of a coordinate's motion: preferred, least


@dataclass(frozen=True)
class ObjectDatum:
    """Similarity transformations of the object space about a centre (3,).

    generators (n, 7): derivatives of all unknowns by three shifts, three rotations and a scale, normalised to a unit
    motion at the distance `extent` from the centre. free (7, d): combinations that no given quantity fixes.
    """

    center: Array
    extent: float
    generators: Array
    free: Array

    def motions(self, positions: Indices) -> Array:
        """(k, d) motions of some unknowns in the free directions."""
        return np.asarray(self.generators[positions] @ self.free)


def object_datum(problem: Problem, state: State, tolerance: float = EXACT) -> ObjectDatum:
    """Find the similarity transformations that leave all given coordinates, stations, attitudes and distances alone."""
    points, stations = problem.point_positions, problem.exterior[:, :3]
    placed = state.values[points if len(points) else stations]
    center = placed.mean(axis=0)
    extent = float(np.sqrt(((placed - center) ** 2).sum(axis=1).mean())) or 1.0
    generators = np.zeros((len(problem.unknowns), 7))
    positions = np.concatenate([points, stations])
    lever = (state.values[positions] - center) / extent
    generators[positions, :3] = np.eye(3)
    for axis in range(3):
        generators[positions, 3 + axis] = np.cross(np.eye(3)[axis], lever)
    generators[positions, 6] = lever
    # A rotation R of the object changes M to M R', that is by the rotation vector -M r.
    turned = np.linalg.solve(problem.attitude_by_unknowns(state), -state.rotations) / extent
    generators[problem.exterior[:, 3:], 3:6] = turned
    for name in problem.network.unoriented:
        generators[problem.unknowns.exterior[name]] = 0.0
    moved = generators.copy()
    moved[problem.exterior[:, 3:]] *= extent  # angles to lengths
    hindered = moved[np.isfinite(problem.unknowns.sigma)]
    rows = [np.zeros((7, 7)), hindered / np.sqrt(max(len(hindered), 1))]
    for further in problem.further:  # normalised, so that short distances count like long ones
        by_unknowns = further.jacobian(state.values)
        motions = by_unknowns @ generators[further.positions]
        lengths = np.linalg.norm(motions, axis=1, keepdims=True)
        strength = lengths[:, 0] > EXACT * np.linalg.norm(by_unknowns, axis=1)
        rows.append(motions[strength] / lengths[strength])
    _, singular, right = np.linalg.svd(np.vstack(rows), full_matrices=False)
    return ObjectDatum(center, extent, generators, right[singular <= tolerance].T)


def minimal_datum(problem: Problem) -> Indices:
    """Choose minimum constraints: positions of the coordinates that fix the free part of the datum.

    These are the planimetric coordinates of two distant points and the heights of these and a third point off their
    line, where nothing else fixes them, of points in at least two images. Heights define no scale in a field flatter
    than a thousandth of its extent.
    """
    state, sigma, positions = problem.start(), problem.unknowns.sigma, problem.point_positions
    free = np.isinf(sigma[positions[:, :2]]).all(axis=1)
    rays = np.bincount(problem.places[~problem.is_fiducial, 0], minlength=len(problem.unknowns))
    usable = positions[free & (rays[positions[:, 0]] >= 2)]
    if len(usable) == 0:
        return np.empty(0, dtype=np.intp)
    given = usable[~np.isnan(problem.unknowns.given[usable]).any(axis=1)]
    usable = given if len(given) >= 3 else usable
    plan = state.values[usable[:, :2]]
    a = int(np.argmax(((plan - plan.mean(axis=0)) ** 2).sum(axis=1)))
    b = int(np.argmax(((plan - plan[a]) ** 2).sum(axis=1)))
    along = plan[b] - plan[a]
    c = int(np.argmax(np.abs((plan - plan[a]) @ np.array([-along[1], along[0]]))))
    candidates = np.array([*usable[a], *usable[b], usable[c, 2], *usable[c, :2]])
    candidates = candidates[np.isinf(sigma[candidates])]
    datum = object_datum(problem, state, FLAT)
    motions, basis = datum.motions(candidates), np.zeros((0, datum.free.shape[1]))
    chosen: list[int] = []
    for leverage in LEVERAGES:
        more, basis = _independent(motions, leverage * np.linalg.norm(motions, axis=1), basis)
        chosen += more
    return np.asarray(candidates[chosen])


def _independent(motions: Array, least: Array | float, basis: Array) -> tuple[list[int], Array]:
    """Select motions (m, d) one by one whose component outside the basis (k, d) exceeds least. Returns their indices
    and the extended orthonormal basis."""
    chosen = []
    for i, (motion, enough) in enumerate(zip(motions, np.broadcast_to(least, len(motions)), strict=True)):
        rest = motion - basis.T @ (basis @ motion)
        if len(basis) < len(motion) and np.linalg.norm(rest) > enough:
            chosen.append(i)
            basis = np.vstack([basis, rest / np.linalg.norm(rest)])
    return chosen, basis


def center_datum(problem: Problem, state: State, members: Indices) -> State:
    """Transform the state by the free similarity that brings some coordinates nearest to their given values, and, as
    far as these leave it open, the others nearest to their approximate values."""
    given = problem.unknowns.given[members]
    is_given = ~np.isnan(given)
    wanted = np.where(is_given, given, problem.unknowns.start[members])
    for _ in range(CENTERINGS):
        datum = object_datum(problem, state, FLAT)
        motion, off = datum.motions(members), wanted - state.values[members]
        stacked = np.vstack([motion[is_given], np.zeros((motion.shape[1], motion.shape[1]))])
        _, strength, right = np.linalg.svd(stacked, full_matrices=False)
        left_open = right[strength <= FLAT * strength.max(initial=0.0)].T
        amount = np.linalg.lstsq(motion[is_given], off[is_given], rcond=FLAT)[0]
        rest = off[~is_given] - motion[~is_given] @ amount
        amount = amount + left_open @ np.linalg.lstsq(motion[~is_given] @ left_open, rest)[0]
        state = _transform_state(problem, state, datum, datum.free @ amount)
        if np.abs(amount).max(initial=0.0) <= EXACT * datum.extent:
            break
    return state


def free_coordinates(problem: Problem, points: Sequence[str] = ()) -> Indices:
    """Positions of the object coordinates without a prior, of some points or of all."""
    of_point = problem.unknowns.point
    positions = np.concatenate([of_point[point] for point in points]) if points else problem.point_positions.ravel()
    return np.asarray(positions[np.isinf(problem.unknowns.sigma[positions])])


def _transform_state(problem: Problem, state: State, datum: ObjectDatum, amounts: Array) -> State:
    shift, turn, scale = amounts[:3], amounts[3:6] / datum.extent, 1.0 + amounts[6] / datum.extent
    if datum.free.shape[1] == len(amounts):  # all free: separate a large rotation from a change of scale
        sine = float(np.linalg.norm(turn))
        turn, scale = turn * (np.arctan2(sine, scale) / sine if sine else 1.0), float(np.hypot(sine, scale))
    rotation = rotation_from_vector(turn)
    values = state.values.copy()
    placed = np.concatenate([problem.point_positions, problem.exterior[:, :3]])
    moved = datum.center + shift + scale * (values[placed] - datum.center) @ rotation.T
    values[placed] = np.where(problem.unknowns.sigma[placed] == 0.0, values[placed], moved)
    rotations = state.rotations @ rotation.T
    for i, positions in enumerate(problem.exterior[:, 3:]):
        if problem.unknowns.sigma[positions].any():
            values[positions] = angles_near(rotations[i], values[positions])
    fixed = (problem.unknowns.sigma[problem.exterior[:, 3:]] == 0.0).all(axis=1)
    return State(values, np.where(fixed[:, None, None], state.rotations, rotations))


def free_motion(problem: Problem, state: State) -> Array:
    """(n, d) motions of all quantities in the free directions of the datum."""
    return object_datum(problem, state, FLAT).motions(np.arange(len(problem.unknowns)))


def held_as_known(network: Network, coordinates: Sequence[str]) -> Network:
    """Network for initial values: coordinates that are to be held, and have a value, count as known."""
    held = {(each.id, each.quantity) for each in map(object_coordinate, coordinates)}
    if not held:
        return network
    points = []
    for point in network.points:
        priors = zip("XYZ", point.priors, strict=True)
        known = (p and Prior(p.value) if (point.id, axis) in held else p for axis, p in priors)
        points.append(ObjectPoint(point.id, *known))
    return replace(network, points=tuple(points))


def chosen_coordinates(problem: Problem, coordinates: Sequence[str]) -> Indices:
    """Positions of the coordinates, "point.X" and so on, chosen by the user as minimum constraints.

    Raises DatumError where one is unknown or has a prior, and where they fix less than the free datum or over-constrain
    it.
    """
    wanted = [object_coordinate(text) for text in coordinates]
    _check_points(problem, [parameter.id for parameter in wanted])
    of_point, sigma = problem.unknowns.point, problem.unknowns.sigma
    positions = np.array([of_point[each.id]["XYZ".index(each.quantity)] for each in wanted], dtype=np.intp)
    for text, given in zip(coordinates, sigma[positions], strict=True):
        if np.isfinite(given):
            raise DatumError(
                f"The datum coordinate {text} is given with the standard deviation {given:g}: it holds the network as "
                "it is. Leave it out of the datum coordinates, or leave its standard deviation blank."
            )
    datum = object_datum(problem, problem.start(), FLAT)
    motions = datum.motions(positions)
    least = DEPENDENT * np.maximum(np.linalg.norm(motions, axis=1), DEPENDENT)
    chosen, basis = _independent(motions, least, np.zeros((0, datum.free.shape[1])))
    strained = [text for i, text in enumerate(coordinates) if i not in chosen]
    if strained:
        others = "the other datum coordinates and" if chosen else ""
        raise DatumError(
            f"The datum is over-constrained: {others} what is given hold {', '.join(strained)} already, and "
            f"a minimal datum takes {datum.free.shape[1]} values here. More would deform the network. Leave "
            f"{'it' if len(strained) == 1 else 'them'} out of the datum coordinates, or say by a standard deviation "
            "in the points how well each is known."
        )
    _check_complete(datum, basis, f"The datum coordinates {', '.join(coordinates)}")
    return positions


def chosen_points(problem: Problem, points: Sequence[str]) -> Indices:
    """Positions of the free coordinates of the points (of all points if none is named) in the inner constraints.

    Raises DatumError where a point is unknown, or where they do not determine the whole free datum.
    """
    _check_points(problem, points)
    members = free_coordinates(problem, points)
    if points:
        datum = object_datum(problem, problem.start(), FLAT)
        motions = datum.motions(members)
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
    """Raise DatumError where motions (k, d), orthonormal rows, leave some free directions (7, d) open."""
    _, _, right = np.linalg.svd(np.vstack([motions, np.zeros((motions.shape[1], motions.shape[1]))]))
    open_directions = datum.free @ right[len(motions) :].T
    if open_directions.shape[1] == 0:
        return
    order = [3, 4, 5, 6, 0, 1, 2]  # rotations and scale first, since they imply shifts
    named, _ = _independent(open_directions[order], FLAT, np.zeros((0, open_directions.shape[1])))
    moving, remedies = zip(*(DATUM_DIRECTIONS[i] for i in sorted(order[k] for k in named)), strict=True)
    raise DatumError(
        f"{what} leave datum defects of the object space: it {'; it '.join(moving)}. Name "
        f"{'; '.join(dict.fromkeys(remedies))}, or leave the choice to the program."
    )
