"""The functions F1 to F4 of all observations: the observations that satisfy them, and their derivatives there.

A target obeys T(x, y) = image of its ray, a fiducial T(x, y) = its place in the camera frame. The derivatives are taken
at computed observations, those that satisfy the functions for the unknowns of the moment: after convergence these are
the adjusted observations. By elements the distortion is taken at the observed camera point instead: then
F = T(x, y) - image of the ray - distortion there, which depends on the observations by T alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.distortion import ImageEquations, image_equations
from adjust.line_of_sight import SightVectors, sight_vectors
from adjust.problem import EXTERIOR, PLACE, Problem, State
from adjust.projection import camera_from_ray, rays
from adjust.rotation import cross_matrix

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Derivatives:
    """A (n, 2, 2), by the observation, and B (n, 2, k), by the unknowns at `Problem.columns` (n, k)."""

    by_observation: Array
    by_unknowns: Array


def computed_observations(problem: Problem, state: State) -> Array | None:
    """The comparator coordinates (n, 2) in mm that satisfy F1 to F4; None where some point has no image."""
    camera_xy = _computed_in_camera(problem, state)
    if camera_xy is None:
        return None
    xy_mm, found = _computed_in_comparator(problem, state, camera_xy)
    return xy_mm if found.all() else None


def _computed_in_camera(problem: Problem, state: State) -> Array | None:
    """The camera coordinates (n, 2) of all marks; None where some point has no image."""
    camera_xy = state.values[problem.places[:, :2]]  # fiducials stay, targets follow
    observed = _observed_in_camera(problem, state) if problem.by_elements else camera_xy
    for name, rows in problem.targets_by_camera.items():
        interior, parameters = np.split(state.values[problem.unknowns.camera[name]], [3])
        if interior[0] <= 0.0:
            return None
        ray, in_camera = _rays(problem, state, rows)
        distortion = problem.network.camera_by_name[name].distortion
        if problem.by_elements:
            at = image_equations(distortion, interior, parameters, observed[rows], ray)
            camera_xy[rows], found = observed[rows] - at.value, np.isfinite(at.value).all(axis=1)
        else:
            camera_xy[rows], found = camera_from_ray(distortion, interior, parameters, ray)
        if not (found & (in_camera[:, 2] < 0.0)).all():
            return None
    return camera_xy


def _observed_in_camera(problem: Problem, state: State) -> Array:
    """The camera coordinates (n, 2) of the observations as they were made."""
    camera_xy = np.empty_like(problem.network.observations.xy_mm)
    for films in problem.films:
        parameters = state.values[films.positions][films.of]
        camera_xy[films.rows] = films.kind.apply(parameters, problem.network.observations.xy_mm[films.rows])
    return camera_xy


def _computed_in_comparator(problem: Problem, state: State, camera_xy: Array) -> tuple[Array, Mask]:
    """The comparator coordinates (n, 2) of camera coordinates (n, 2), and which the film transformations give."""
    xy_mm = np.empty_like(camera_xy)
    found = np.empty(len(camera_xy), dtype=bool)
    for films in problem.films:
        parameters, center_mm = state.values[films.positions][films.of], films.center_mm[films.of]
        xy_mm[films.rows], found[films.rows] = films.kind.inverse(parameters, camera_xy[films.rows], center_mm)
    return xy_mm, found


def derivatives(problem: Problem, state: State, xy_mm: Array) -> Derivatives:
    """The derivatives of F1 to F4 (Torlegård) at the observations xy_mm (n, 2)."""
    distorted = problem.network.observations.xy_mm if problem.by_elements else xy_mm  # where distortion is taken
    film = _film_derivatives(problem, state, xy_mm)
    at_distorted = _film_derivatives(problem, state, distorted) if problem.by_elements else film
    camera_xy = at_distorted.camera_xy
    by_camera_xy = np.broadcast_to(np.eye(2), (len(xy_mm), 2, 2)).copy()
    by_unknowns = np.zeros((len(xy_mm), 2, problem.columns.shape[1]))
    by_unknowns[:, :, PLACE.start : PLACE.start + 2] = -np.eye(2)  # F3, F4; those of targets follow
    attitude = problem.attitude_by_unknowns(state)
    for name, rows in problem.targets_by_camera.items():
        ray, in_camera = _rays(problem, state, rows)
        at = _image_equations(problem, state, name, camera_xy[rows], ray)
        images = problem.image_numbers[rows]
        by_in_camera = at.by_ray @ _ray_by_in_camera(in_camera)
        by_vector = by_in_camera @ state.rotations[images]
        by_attitude = -by_in_camera @ cross_matrix(in_camera) @ attitude[images]
        by_camera_xy[rows] = at.by_xy
        seen = _sight(problem, state, rows)
        of_targets = np.zeros((len(rows), *by_unknowns.shape[1:]))
        of_targets[:, :, EXTERIOR] = np.concatenate([by_vector @ seen.by_station, by_attitude], axis=2)
        of_targets[:, :, PLACE] = by_vector @ seen.by_point
        by_camera = np.concatenate([at.by_interior, at.by_parameters], axis=2)
        first = problem.camera_columns.start
        of_targets[:, :, first : first + by_camera.shape[2]] = by_camera
        by_unknowns[rows] = of_targets
    by_film = film.by_parameters + (by_camera_xy - np.eye(2)) @ at_distorted.by_parameters
    by_unknowns[:, :, problem.film_columns] = by_film
    return Derivatives(film.by_xy if problem.by_elements else by_camera_xy @ film.by_xy, by_unknowns)


@dataclass(frozen=True)
class _FilmDerivatives:
    """Camera coordinates (n, 2), their derivatives by the comparator's (n, 2, 2) and centred parameters (n, 2, k)."""

    camera_xy: Array
    by_xy: Array
    by_parameters: Array


def _film_derivatives(problem: Problem, state: State, xy_mm: Array) -> _FilmDerivatives:
    width = problem.film_columns.stop - problem.film_columns.start
    result = _FilmDerivatives(np.empty_like(xy_mm), np.empty((*xy_mm.shape, 2)), np.zeros((*xy_mm.shape, width)))
    for films in problem.films:
        rows, xy, count = films.rows, xy_mm[films.rows], films.positions.shape[1]
        parameters = state.values[films.positions][films.of]
        design = films.kind.design(parameters, xy, films.center_mm[films.of], films.half_mm[films.of])
        result.camera_xy[rows] = films.kind.apply(parameters, xy)
        result.by_xy[rows] = films.kind.gradient(parameters, xy)
        result.by_parameters[rows, :, :count] = design
    return result


def _rays(problem: Problem, state: State, rows: Indices) -> tuple[Array, Array]:
    """The rays (n, 2) of some targets, and their points in the camera's axes (n, 3)."""
    return rays(state.rotations[problem.image_numbers[rows]], _sight(problem, state, rows).vector)


def _sight(problem: Problem, state: State, rows: Indices) -> SightVectors:
    """Some targets as they appear from their stations."""
    stations = state.values[problem.exterior[problem.image_numbers[rows], :3]]
    return sight_vectors(problem.network.line_of_sight, stations, state.values[problem.places[rows]])


def _image_equations(problem: Problem, state: State, camera: str, camera_xy: Array, ray: Array) -> ImageEquations:
    interior, parameters = np.split(state.values[problem.unknowns.camera[camera]], [3])
    distortion = problem.network.camera_by_name[camera].distortion
    return image_equations(distortion, interior, parameters, camera_xy, ray)


def _ray_by_in_camera(in_camera: Array) -> Array:
    """Derivative (n, 2, 3) of the ray -U/W, -V/W by U, V, W."""
    u, v, w = in_camera.T
    zero = np.zeros_like(u)
    first = np.stack([-1.0 / w, zero, u / w**2], axis=1)
    second = np.stack([zero, -1.0 / w, v / w**2], axis=1)
    return np.stack([first, second], axis=1)


def blind_mark(problem: Problem, state: State) -> str:
    """The first mark that has no image in a state, and why; empty where all have one."""
    observations = problem.network.observations
    for name, rows in problem.targets_by_camera.items():
        interior, parameters = np.split(state.values[problem.unknowns.camera[name]], [3])
        if interior[0] <= 0.0:
            return f"the principal distance of camera {name} is {interior[0]:.6g} mm and must be positive"
        ray, in_camera = _rays(problem, state, rows)
        distortion = problem.network.camera_by_name[name].distortion
        _, found = camera_from_ray(distortion, interior, parameters, ray)
        for bad, why in (
            (in_camera[:, 2] >= 0.0, "lies behind the camera"),
            (~found, "is where the distortion folds over"),
        ):
            if bad.any():
                row = rows[int(np.argmax(bad))]
                return f"point {observations.point[row]} {why} in image {observations.image[row]}"
    camera_xy = _computed_in_camera(problem, state)
    if camera_xy is not None:
        _, found = _computed_in_comparator(problem, state, camera_xy)
        row = int(np.argmin(found))
        image = problem.network.images[problem.image_numbers[row]]
        return (
            f"{observations.kind[row]} {observations.point[row]} is where the {image.transformation} transformation of "
            f"image {image.name} folds over"
        )
    return ""
