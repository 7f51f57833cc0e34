"""A solution of the bare problem in OpenCV's model, with standard deviations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.families import parameter_names
from adjust.problem.result import Adjustment
from pipeline.opencv_check.bare_problem import COUNTERPARTS, BareProblem
from pipeline.opencv_check.opencv_model import NAMES, Freedom, Refit, image_grid, refit, refit_jacobian

Array = NDArray[np.float64]

STEP_SIGMAS = 0.3  # for derivatives of the refit


@dataclass(frozen=True)
class Converted:
    """A solution in OpenCV's model: the refit and the a-priori standard deviations (18,)."""

    refit: Refit
    sigmas: Array


def converted(problem: BareProblem, solved: Adjustment) -> Converted:
    camera = problem.network.cameras[0]
    family = camera.distortion.family
    names = [f"IO.{camera.name}.{each}" for each in ("c", "x0", "y0", *parameter_names(family))]
    values = np.array([solved.value(name) for name in names])
    interior, parameters = values[:3], values[3:]
    observed = problem.network.observations.xy_mm
    grid = image_grid(np.array([observed.min(axis=0), observed.max(axis=0)]))
    whole = refit(camera.distortion, interior, parameters, grid, _whole(family), _start(family, interior, parameters))
    steps = [STEP_SIGMAS * float(sigma) for sigma in np.sqrt(np.diag(solved.cofactor_of(names)))]
    jacobian = refit_jacobian(camera.distortion, interior, parameters, steps, grid, problem.freedom, whole.parameters)
    variances = np.einsum("ij,jk,ik->i", jacobian, solved.cofactor_of(names), jacobian)
    return Converted(whole, np.sqrt(np.maximum(variances, 0.0)))


def _whole(family: str) -> Freedom:
    """All parameters that a family can need in OpenCV's model: what is not estimated is held at the refit's values."""
    fixed_ratio = ("fx", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    if family == "opencv":
        return Freedom(("fx", "fy", "cx", "cy"))
    return Freedom(("fy", *fixed_ratio) if "fy" in COUNTERPARTS[family].values() else fixed_ratio)


def _start(family: str, interior: Array, parameters: Array) -> Array:
    start = np.zeros(len(NAMES))
    start[:4] = interior[0], interior[0], interior[1], interior[2]
    if family == "opencv":
        given = dict(zip(parameter_names(family), parameters, strict=True))
        start[0] *= 1 + given["b1"]
        start[4:] = [given[name] for name in NAMES[4:]]
    return start
