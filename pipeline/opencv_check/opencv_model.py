"""OpenCV's camera model beside the adjustment's: conversion by a refit over the image, with propagated sigmas.

Parameters are those of cv2.calibrateCamera in the camera frame's unit: fx, fy, cx, cy in mm, cx and cy being the
principal point x0', y0' (y up); k1 to s4 without unit and the sensor's tilt tau_x, tau_y in rad, in
OpenCV's own signs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.projection import ideal_from_observed
from adjust.problem.network import Distortion

Array = NDArray[np.float64]

NAMES = (
    "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y",
)  # fmt: skip
GRID = 25  # points a side of the grid over the image on which the refit is made
ITERATIONS = 30
Y_UP = np.array([1.0, -1.0])


@dataclass(frozen=True)
class Freedom:
    """Which of OpenCV's parameters are estimated. "fx" alone of the two: one focal length, the ratio fx/fy is kept."""

    names: tuple[str, ...]

    def basis(self, start: Array) -> Array:
        """(18, k): what a change of each estimated parameter changes."""
        basis = np.eye(len(NAMES))[:, [NAMES.index(name) for name in self.names]]
        if "fx" in self.names and "fy" not in self.names:
            basis[NAMES.index("fy"), self.names.index("fx")] = start[1] / start[0]
        return basis


@dataclass(frozen=True)
class Refit:
    """OpenCV's parameters (18,) that image the same rays to the same places; what is left, rms a point, in mm."""

    parameters: Array
    residual_mm: float


def image_grid(corners_mm: Array) -> Array:
    """Camera points (n, 2) over the rectangle between two opposite corners (2, 2)."""
    along = np.linspace(0.0, 1.0, GRID)
    x, y = np.meshgrid(along, along)
    fractions = np.stack([x, y], axis=-1).reshape(-1, 2)
    return np.asarray(corners_mm[0] + fractions * (corners_mm[1] - corners_mm[0]))


def refit(
    distortion: Distortion, interior: Array, parameters: Array, grid_mm: Array, freedom: Freedom, fixed: Array
) -> Refit:
    """The OpenCV model nearest to the adjustment's over a grid of observed camera points.

    interior (3,): c, x0', y0' in mm; parameters in the order of `families.parameter_names`. fixed (18,): the values of
    the parameters that are not estimated, and the start for the others. Both models are given the same rays: the
    adjustment's corrects the observed point, OpenCV's distorts the ideal one, and no finite conversion is exact.
    """
    ideal_mm, found = ideal_from_observed(distortion, interior, parameters, grid_mm)
    rays, observed_mm = (ideal_mm[found] - interior[1:]) / interior[0], grid_mm[found]
    values, basis = fixed.copy(), freedom.basis(fixed)
    for _ in range(ITERATIONS):
        imaged_mm, by_parameters = project(values, rays)
        design = (by_parameters @ basis).reshape(-1, basis.shape[1])
        scale = np.linalg.norm(design, axis=0)
        step = np.linalg.lstsq(design / scale, (observed_mm - imaged_mm).ravel())[0] / scale
        values = values + basis @ step
        if np.abs(step * scale).max(initial=0.0) < 1e-12 * interior[0]:
            break
    left = observed_mm - project(values, rays)[0]
    return Refit(values, float(np.sqrt((left**2).sum(axis=1).mean())))


def refit_jacobian(
    distortion: Distortion,
    interior: Array,
    parameters: Array,
    steps: Sequence[float],
    grid_mm: Array,
    freedom: Freedom,
    fixed: Array,
) -> Array:
    """Derivative (18, 3 + k) of the refit by c, x0', y0' and the distortion parameters, by central differences.

    steps (3 + k): how far each is moved, a part of its standard deviation; 0 where it is fixed.
    """
    middle = np.concatenate([interior, parameters])
    jacobian = np.zeros((len(NAMES), len(middle)))
    for column, step in enumerate(steps):
        if step == 0.0:
            continue
        sides = []
        for sign in (1.0, -1.0):
            moved = middle.copy()
            moved[column] += sign * step
            sides.append(refit(distortion, moved[:3], moved[3:], grid_mm, freedom, fixed).parameters)
        jacobian[:, column] = (sides[0] - sides[1]) / (2 * step)
    return jacobian


def project(values: Array, rays: Array) -> tuple[Array, Array]:
    """Camera coordinates (n, 2) in mm, y up, of rays (n, 2), and their derivatives (n, 2, 18), by cv2.projectPoints."""
    points = np.column_stack([rays * Y_UP, np.ones(len(rays))])
    projected, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera_matrix(values), values[4:])
    by_values = jacobian[:, 6 : 6 + len(NAMES)].reshape(-1, 2, len(NAMES)) * Y_UP[:, None]
    by_values[..., NAMES.index("cy")] *= -1.0
    return projected.reshape(-1, 2) * Y_UP, by_values


def camera_matrix(values: Array) -> Array:
    """OpenCV's camera matrix (3, 3), in mm with y down."""
    fx, fy, cx, cy = values[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, -cy], [0.0, 0.0, 1.0]])
