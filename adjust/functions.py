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
from adjust.problem import CAMERA, EXTERIOR, PLACE, TRANSFORMATION, Problem, State
from adjust.projection import camera_from_ray, rays
from adjust.rotation import cross_matrix
from adjust.transformation import affine_design, affine_gradient, apply_affine, comparator_from_camera

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Derivatives:
    """A (n, 2, 2), by the observation, and B (n, 2, k), by the unknowns at `Problem.columns` (n, k)."""

    by_observation: Array
    by_unknowns: Array


def computed_observations(problem: Problem, state: State) -> Array | None:
    """The comparator coordinates (n, 2) in mm that satisfy F1 to F4; None where some point has no image."""
    camera_xy = state.values[problem.places[:, :2]]  # fiducials stay, targets follow
    affines = problem.affines(state)
    observed = apply_affine(affines[problem.image_numbers], problem.network.observations.xy_mm)
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
    if not np.linalg.det(affine_gradient(affines)).all():
        return None
    return comparator_from_camera(affines[problem.image_numbers], camera_xy)


def derivatives(problem: Problem, state: State, xy_mm: Array) -> Derivatives:
    """The derivatives of F1 to F4 (Torlegård) at the observations xy_mm (n, 2)."""
    affines = problem.affines(state)[problem.image_numbers]
    distorted = problem.network.observations.xy_mm if problem.by_elements else xy_mm  # where distortion is taken
    camera_xy = apply_affine(affines, distorted)
    by_camera_xy = np.broadcast_to(np.eye(2), (len(xy_mm), 2, 2)).copy()
    by_unknowns = np.zeros((len(xy_mm), 2, problem.columns.shape[1]))
    by_unknowns[:, :, PLACE.start : PLACE.start + 2] = -np.eye(2)  # F3, F4; those of targets follow
    attitude = problem.attitude_by_unknowns(state)
    for name, rows in problem.targets_by_camera.items():
        ray, in_camera = _rays(problem, state, rows)
        at = _image_equations(problem, state, name, camera_xy[rows], ray)
        images = problem.image_numbers[rows]
        by_in_camera = at.by_ray @ _ray_by_in_camera(in_camera)
        by_point = by_in_camera @ state.rotations[images]
        by_attitude = -by_in_camera @ cross_matrix(in_camera) @ attitude[images]
        by_camera_xy[rows] = at.by_xy
        by_unknowns[rows, :, EXTERIOR] = np.concatenate([-by_point, by_attitude], axis=2)
        by_unknowns[rows, :, PLACE] = by_point
        by_camera = np.concatenate([at.by_interior, at.by_parameters], axis=2)
        by_unknowns[rows, :, CAMERA.start : CAMERA.start + by_camera.shape[2]] = by_camera
    chain = problem.affines_by_parameters(state)[problem.image_numbers]
    by_affine = affine_design(xy_mm) + (by_camera_xy - np.eye(2)) @ affine_design(distorted)
    by_unknowns[:, :, TRANSFORMATION] = by_affine @ chain
    gradient = affine_gradient(affines)
    return Derivatives(gradient if problem.by_elements else by_camera_xy @ gradient, by_unknowns)


def _rays(problem: Problem, state: State, rows: Indices) -> tuple[Array, Array]:
    """The rays (n, 2) of some targets, and their points in the camera's axes (n, 3)."""
    images = problem.image_numbers[rows]
    stations = state.values[problem.exterior[images, :3]]
    return rays(state.rotations[images], stations, state.values[problem.places[rows]])


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


def blind_target(problem: Problem, state: State) -> str:
    """The first target that has no image in a state, and why; empty where all have one."""
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
    return ""
