"""Distortion parameters that do the same within the observed field: a flat valley of v'Pv, which the iteration must not
wander along.

The numerator and the denominator of a rational lens trade off where targets stand in the middle of the picture: the
distortion is known there, its parameters are not. No observation of the object would change that, so this is no datum
defect. Each parameter of such a lens is held by a pseudo-observation: alone, it moves the edge of the observed field by
REACH of its radius at most. That is what no lens does, a thousand times what marks are measured to, and nothing beside
what determines a parameter that can be determined; along the valley it leads to the parameters that are smallest
(Tikhonov's regularisation).
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.families import family
from adjust.least_squares.iteration import Linearised
from adjust.problem.functions import observed_in_camera
from adjust.problem.problem import Problem, State

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

REACH = 0.1  # of the radius of the outermost target, by which a parameter alone may move it
UNRESOLVED = 0.3  # standard deviation, over that of its pseudo-observation, above which a parameter is not separable


def possible_pseudo_observations(problem: Problem, at: Linearised) -> dict[int, float]:
    """By position, the standard deviations of pseudo-observations of the free distortion parameters of cameras whose
    family has a numerator and a denominator that are both free.
    """
    found: dict[int, float] = {}
    for name, positions in problem.unknowns.camera.items():
        free = [int(i) for i in positions[3:] if np.isinf(problem.unknowns.sigma[i])]
        rows = problem.targets_by_camera[name]
        if len(rows) and not _denominator(problem, name).isdisjoint(free):
            radius_mm = observed_radius_mm(problem, at.state, name)
            found |= {i: REACH * radius_mm / moved for i in free if (moved := _largest_motion_mm(problem, at, rows, i))}
    return found


def observed_radius_mm(problem: Problem, state: State, camera: str) -> float:
    """From the principal point to the outermost target that was observed, in the camera frame."""
    xy_mm = observed_in_camera(problem, state)[problem.targets_by_camera[camera]]
    principal_point = state.values[problem.unknowns.camera[camera][1:3]]
    return float(np.linalg.norm(xy_mm - principal_point, axis=1).max())


def unresolved(pseudo_observed: Mapping[int, float], variances: Array) -> list[int]:
    """Positions of the pseudo-observed parameters that the observations do not separate from others.

    variances (n,): of all quantities, a priori.
    """
    return [i for i, sigma in pseudo_observed.items() if np.sqrt(variances[i]) > UNRESOLVED * sigma]


def _denominator(problem: Problem, camera: str) -> set[int]:
    of = family(problem.network.camera_by_name[camera].distortion.family)
    positions = problem.unknowns.camera[camera][3:]
    return {int(positions[of.parameters.index(each)]) for each in of.alike_at_zero}


def _largest_motion_mm(problem: Problem, at: Linearised, rows: Indices, position: int) -> float:
    """By how much a change of 1 of a parameter moves the target that it moves most."""
    step = np.zeros(len(problem.unknowns))
    step[position] = 1.0
    return float(np.linalg.norm(at.rows.change_mm(at.by_observation, step)[rows], axis=1).max())
