"""Condition equations F1 to F4: the observations that satisfy them, and their derivatives there.

A target satisfies T(S(x, y)) = image of its ray, a fiducial T(S(x, y)) = its place in the camera frame, with S the
scanner deformation. The derivatives are evaluated at computed observations, which satisfy the equations for the current
unknowns: after convergence these are the adjusted observations. In the adjustment by elements the distortion is
evaluated at the observed camera point instead: then F = T(S(x, y)) - image of the ray - distortion there, which depends
on the observations through T and S alone.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

import compiled
from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.correction import Imaged
from adjust.functional_model.lens import ImageEquations, Lens
from adjust.functional_model.projection import SightVectors, rays, sight_vectors
from adjust.linear_algebra.small_matrices import applied, columns, cross, laid_out, product, take_members, zeros
from adjust.problem.problem import Part, Problem, State

Rows = Indices | slice
ROWS_AT_ONCE = 20_000  # targets imaged together, chosen to fit into the processor's cache


@dataclass(frozen=True)
class Derivatives:
    """Design matrices of F1 to F4.

    by_observation (n, 2, 2): A, with respect to the observations. by_unknowns (n, 2, k): B, with respect to the
    unknowns at `Problem.columns`.
    """

    by_observation: Array
    by_unknowns: Array


@dataclass(frozen=True)
class TargetImages:
    """Images of the targets of one camera for a state."""

    camera: str  # name
    rows: Rows  # rows of the observations
    ray: Array  # (n, 2) rays
    in_camera: Array  # (n, 3) vectors to the points in the camera frame
    imaged: Imaged  # images of the rays


@dataclass(frozen=True)
class Computed:
    """Observations (n, 2) in mm that satisfy F1 to F4, in the comparator, and the images of the targets."""

    xy_mm: Array
    targets: tuple[TargetImages, ...]


def computed_observations(problem: Problem, state: State) -> Array | None:
    """Compute the comparator coordinates (n, 2) in mm that satisfy F1 to F4; None where some point has no image."""
    computed = compute(problem, state)
    return None if computed is None else computed.xy_mm


def compute(problem: Problem, state: State) -> Computed | None:
    """Compute the observations that satisfy F1 to F4, for the derivatives; None where some point has no image."""
    targets = tuple(
        _image_targets(problem, state, name, rows[first : first + ROWS_AT_ONCE])
        for name, rows in problem.targets_by_camera.items()
        for first in range(0, len(rows), ROWS_AT_ONCE)
    )
    camera_xy = _computed_in_camera(problem, state, targets)
    if camera_xy is None:
        return None
    xy_mm, found = _computed_in_comparator(problem, state, camera_xy)
    return Computed(xy_mm, targets) if found.all() else None


def _computed_in_camera(problem: Problem, state: State, targets: Iterable[TargetImages]) -> Array | None:
    """Camera coordinates (n, 2) of all marks; None where some point has no image."""
    camera_xy = state.values[problem.places.T[:2]].T  # fiducials stay, targets follow
    observed = observed_in_camera(problem, state) if problem.by_elements else camera_xy
    for shown in targets:
        lens = _lens(problem, state, shown.camera)
        if lens.interior[0] <= 0.0:
            return None
        displaced_mm = image_displacements(problem, state, shown.rows) if problem.network.boards else np.zeros(2)
        if problem.by_elements:
            at = lens.equations_with_image(observed[shown.rows] - displaced_mm, shown.imaged)
            xy_mm, found = observed[shown.rows] - at.value, np.isfinite(at.value).all(axis=1)
        else:
            xy_mm, found = lens.camera_from_image(shown.imaged)
            xy_mm = xy_mm + displaced_mm
        if not (found & (shown.in_camera[:, 2] < 0.0)).all():
            return None
        camera_xy[shown.rows] = xy_mm
    return camera_xy


def _image_targets(problem: Problem, state: State, camera: str, targets: Indices) -> TargetImages:
    """Image some targets from their stations."""
    rows = _as_slice(targets)
    images, network = problem.image_numbers[rows], problem.network
    if compiled.kernels is not None and network.line_of_sight.is_straight and not network.boards:
        ray, in_camera = zeros(len(images), 2), zeros(len(images), 3)
        compiled.kernels.target_rays(
            state.values, problem.exterior, problem.places[rows], images, state.rotations, ray, in_camera
        )
    else:
        ray, in_camera = rays(take_members(state.rotations, images), _sight(problem, state, rows).vector)
    return TargetImages(camera, rows, ray, in_camera, _lens(problem, state, camera).image(ray))


def _sight(problem: Problem, state: State, rows: Rows) -> SightVectors:
    """Vectors from the stations to the points of some targets."""
    stations = state.values[problem.exterior[:, :3].T[:, problem.image_numbers[rows]]].T
    points = state.values[problem.places.T[:, rows]].T
    if problem.network.boards:
        bends = state.values[problem.board_positions[rows]]  # arbitrary for points on no board: their lift is 0
        points = points + (bends[:, :, None] * problem.board_directions[rows, :, :3]).sum(axis=1)
    return sight_vectors(problem.network.line_of_sight, stations, points)


def _lens(problem: Problem, state: State, camera: str) -> Lens:
    interior, parameters = np.split(state.values[problem.unknowns.camera[camera]], [3])
    return Lens(problem.network.camera_by_name[camera].distortion, interior, parameters)


def observed_in_camera(problem: Problem, state: State) -> Array:
    """Transform the observations to camera coordinates (n, 2)."""
    return camera_places(problem, state, problem.network.observations.xy_mm)


def camera_places(problem: Problem, state: State, xy_mm: Array) -> Array:
    """Transform comparator coordinates (n, 2) of the observations to camera coordinates (n, 2)."""
    camera_xy = np.empty_like(xy_mm)
    straight_mm = _straight(problem, state, xy_mm)
    for films in problem.films:
        parameters = state.values[films.positions][films.image_rows]
        camera_xy[films.rows] = films.kind.apply(parameters, straight_mm[films.rows])
    return camera_xy


def _straight(problem: Problem, state: State, xy_mm: Array) -> Array:
    """Correct comparator coordinates (n, 2) for the scanners."""
    straight_mm = xy_mm.copy() if problem.scans else xy_mm
    for scans in problem.scans:
        straight_mm[scans.rows] = scans.bend.apply(state.values[scans.positions], xy_mm[scans.rows])
    return straight_mm


def image_displacements(problem: Problem, state: State, rows: Rows) -> Array:
    """(n, 2) mm, displacements of the images of some targets in the camera frame."""
    values = state.values[problem.board_positions[rows]]
    return np.asarray((values[:, :, None] * problem.board_directions[rows, :, 3:]).sum(axis=1))


def remove_lens_effects(problem: Problem, state: State, computed_mm: Array, camera: str, image_mm: Array) -> Array:
    """Displacements (n, k, 2) of a camera's images but for what its parameters that are not fixed displace."""
    rows = problem.targets_by_camera[camera]
    shown = _image_targets(problem, state, camera, rows)
    places = camera_places(problem, state, computed_mm)[rows] - image_displacements(problem, state, rows)
    at = _lens(problem, state, camera).equations_with_image(places, shown.imaged)
    by_camera = np.linalg.solve(at.xy_jacobian, at.quantity_jacobian)
    by_camera = by_camera[..., problem.unknowns.sigma[problem.unknowns.camera[camera]] > 0.0].reshape(2 * len(rows), -1)
    flat, rest = image_mm[rows].swapaxes(1, 2).reshape(2 * len(rows), -1), image_mm.copy()
    flat = flat - by_camera @ np.linalg.lstsq(by_camera, flat)[0]
    rest[rows] = flat.reshape(len(rows), 2, -1).swapaxes(1, 2)
    return rest


def _computed_in_comparator(problem: Problem, state: State, camera_xy: Array) -> tuple[Array, Mask]:
    """Comparator coordinates (n, 2) of camera coordinates (n, 2), and the mask of those found."""
    xy_mm = np.empty_like(camera_xy)
    found = np.empty(len(camera_xy), dtype=bool)
    for films in problem.films:
        parameters, rows = state.values[films.positions][films.image_rows], _as_slice(films.rows)
        xy_mm[rows], found[rows] = films.kind.inverse(parameters, camera_xy[rows], films.centers_mm)
    for scans in problem.scans:
        rows = scans.rows
        xy_mm[rows], unfolded = scans.bend.inverse(state.values[scans.positions], xy_mm[rows])
        found[rows] &= unfolded
    return xy_mm, found


def derivatives(problem: Problem, state: State, computed: Computed) -> Derivatives:
    """Compute the derivatives of F1 to F4 (Torlegård) at computed observations."""
    xy_mm, parts = computed.xy_mm, problem.parts
    distorted = problem.network.observations.xy_mm if problem.by_elements else xy_mm  # where distortion is evaluated
    film = _film_derivatives(problem, state, xy_mm)
    at_distorted = _film_derivatives(problem, state, distorted) if problem.by_elements else film
    by_camera_xy = laid_out(np.broadcast_to(np.eye(2), (len(xy_mm), 2, 2)))
    has_films = any(films.kind.names for films in problem.films) or bool(problem.scans)
    count, width = len(xy_mm), parts.width  # stored by rows for the compiled loops, by columns for numpy
    by_rows = compiled.kernels is not None
    by_unknowns = np.zeros((count, 2, width)) if by_rows else np.zeros((width, count, 2)).transpose(1, 2, 0)
    by_unknowns[problem.is_fiducial, :, parts.place.columns] = -np.eye(2, 3)[:, parts.place.members]  # F3, F4
    straight, attitude = problem.network.line_of_sight.is_straight, problem.attitude_by_unknowns(state)
    for shown in computed.targets:
        lens = _lens(problem, state, shown.camera)
        images, rows = problem.image_numbers[shown.rows], shown.rows
        displaced_mm = image_displacements(problem, state, rows) if problem.network.boards else 0.0
        at = lens.equations_with_image(at_distorted.camera_xy[rows] - displaced_mm, shown.imaged)
        if len(at.value) == len(xy_mm):
            by_camera_xy = at.xy_jacobian
        else:
            by_camera_xy[rows] = at.xy_jacobian
        own = [k for k in parts.camera.members if k < len(lens.quantities)]  # other cameras may have other families
        by_camera = np.empty((len(own), 2, len(images)))
        for column, k in zip(by_camera, own, strict=True):
            column[:] = at.quantity_derivative(k).T
        if compiled.kernels is not None and straight and not len(parts.board.members):
            numbers = np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows
            compiled.kernels.target_derivatives(
                numbers, images, state.rotations, attitude, shown.ray, shown.in_camera, at.ray_jacobian,
                parts.exterior.members, parts.place.members, by_camera,
                np.array([parts.camera.columns.start]), by_unknowns,
            )  # fmt: skip
        else:
            _fill_targets(by_unknowns, problem, state, shown, at)
            _fill(by_unknowns, rows, parts.camera, by_camera.swapaxes(1, 2))
    for part, of_film, of_distorted in (
        (parts.film, film.parameter_jacobian, at_distorted.parameter_jacobian),
        (parts.scanner, film.by_scanner, at_distorted.by_scanner),
    ):
        if len(part.members):
            parameter_jacobian = of_film + product(by_camera_xy - np.eye(2), of_distorted)
            _fill(by_unknowns, slice(None), part, [parameter_jacobian[..., k] for k in part.members])
    if problem.by_elements:
        return Derivatives(film.xy_jacobian, by_unknowns)
    return Derivatives(product(by_camera_xy, film.xy_jacobian) if has_films else by_camera_xy, by_unknowns)


def _fill_targets(by_unknowns: Array, problem: Problem, state: State, shown: TargetImages, at: ImageEquations) -> None:
    """Fill the columns of exterior orientation, points and boards from the derivatives of the condition equations."""
    parts, rows, straight = problem.parts, shown.rows, problem.network.line_of_sight.is_straight
    images = problem.image_numbers[rows]
    by_in_plane = at.ray_jacobian / -shown.in_camera[:, 2, None, None]  # the ray is -U/W, -V/W
    by_in_camera = columns([by_in_plane[..., 0], by_in_plane[..., 1], applied(by_in_plane, shown.ray)])
    by_vector = product(by_in_camera, take_members(state.rotations, images))
    by_attitude = cross(shown.in_camera[:, None, :], by_in_camera)
    if problem.keeps_angles.any():
        attitude = problem.attitude_by_unknowns(state)
        by_attitude = product(by_attitude, take_members(attitude, images))
    by_station, by_point = -by_vector, by_vector
    if not straight:
        sight = _sight(problem, state, rows)
        by_station, by_point = product(by_vector, sight.by_station), product(by_vector, sight.by_point)
    by_exterior = by_station, by_attitude
    _fill(by_unknowns, rows, parts.exterior, [by_exterior[k // 3][..., k % 3] for k in parts.exterior.members])
    _fill(by_unknowns, rows, parts.place, [by_point[..., k] for k in parts.place.members])
    boards = problem.board_directions[rows]
    by_boards = [
        applied(by_point, boards[:, k, :3]) - applied(at.xy_jacobian, boards[:, k, 3:]) for k in parts.board.members
    ]
    _fill(by_unknowns, rows, parts.board, by_boards)


def _fill(by_unknowns: Array, rows: Rows, part: Part, derivatives: Iterable[Array]) -> None:
    """Write the derivatives (n, 2) with respect to the members of a part into its columns."""
    for column, derivative in enumerate(derivatives, part.columns.start):
        by_unknowns[..., column][rows] = derivative


@dataclass(frozen=True)
class _FilmDerivatives:
    """Camera coordinates and their derivatives."""

    camera_xy: Array  # (n, 2) camera coordinates
    xy_jacobian: Array  # (n, 2, 2) with respect to the comparator coordinates
    parameter_jacobian: Array  # (n, 2, k) with respect to the films' centred parameters
    by_scanner: Array  # (n, 2, s) with respect to the scanners' parameters


def _film_derivatives(problem: Problem, state: State, xy_mm: Array) -> _FilmDerivatives:
    straight_mm, count = _straight(problem, state, xy_mm), len(xy_mm)
    widths = [max((each.positions.shape[-1] for each in some), default=0) for some in (problem.films, problem.scans)]
    film = _FilmDerivatives(zeros(count, 2), zeros(count, 2, 2), *(zeros(count, 2, width) for width in widths))
    for films in problem.films:
        parameters, rows = state.values[films.positions][films.image_rows], _as_slice(films.rows)
        film.camera_xy[rows] = films.kind.apply(parameters, straight_mm[rows])
        film.xy_jacobian[rows] = films.kind.gradient(parameters, straight_mm[rows])
        design = films.kind.design(parameters, straight_mm[rows], films.centers_mm, films.half_mm[films.image_rows])
        film.parameter_jacobian[rows, :, : design.shape[2]] = design
    for scans in problem.scans:
        rows = scans.rows
        at, gradient = scans.bend.displacement(state.values[scans.positions], xy_mm[rows]), film.xy_jacobian[rows]
        film.by_scanner[rows, :, : len(scans.positions)] = -product(gradient, at.parameter_jacobian)
        film.xy_jacobian[rows] = product(gradient, np.eye(2) - at.xy_jacobian)
    return film


def _as_slice(rows: Indices) -> Rows:
    """Ascending rows as a slice, which avoids a copy, if they are contiguous."""
    whole = len(rows) > 0 and rows[-1] - rows[0] + 1 == len(rows)
    return slice(int(rows[0]), int(rows[-1]) + 1) if whole else rows


def blind_marks(problem: Problem, state: State) -> dict[str, tuple[str, str]]:
    """Find by image the first mark without an image in a state.

    Returns by image name the reason and what to check, empty where all marks have an image. The empty name stands for a
    fault of a whole camera.
    """
    observations, blind = problem.network.observations, dict[str, tuple[str, str]]()
    images = [problem.network.images[number] for number in problem.image_numbers]
    targets = [_image_targets(problem, state, name, rows) for name, rows in problem.targets_by_camera.items()]
    for shown, rows in zip(targets, problem.targets_by_camera.values(), strict=True):
        lens = _lens(problem, state, shown.camera)
        if lens.interior[0] <= 0.0:
            reason = (
                f"the principal distance of camera {shown.camera} is {lens.interior[0]:.6g} mm and must be positive"
            )
            return {"": (reason, "Give a positive one.")}
        _, found = lens.camera_from_image(shown.imaged)
        behind = rows[shown.in_camera[:, 2] >= 0.0]
        for number, row in enumerate([*behind, *rows[~found]]):
            if images[row].name in blind:
                continue
            why, check = "is where the distortion folds over", "the values from which the distortion starts"
            if number < len(behind):
                why = "lies behind the camera"
                check = "the sign of W: M rotates from object to camera, which looks along its negative z axis"
            placed = "the given orientation"
            if images[row].exterior is None:
                placed = "the number and the coordinates of the point"
            reason = f"point {observations.point[row]} {why} in image {images[row].name}"
            blind[images[row].name] = reason, f"Check {placed}, and {check}."
    camera_xy = None if blind else _computed_in_camera(problem, state, targets)
    if camera_xy is not None:
        _, found = _computed_in_comparator(problem, state, camera_xy)
        for row in np.flatnonzero(~found):
            reason = (
                f"{observations.kind[row]} {observations.point[row]} is where the {images[row].transformation} "
                f"transformation of image {images[row].name} folds over"
            )
            check = "Check its number and those of the fiducial marks, or choose a transformation of a lower order."
            blind.setdefault(images[row].name, (reason, check))
    return blind
