"""Distortion parameters that do the same within the observed field: a flat valley of v'Pv, which the iteration must not
wander along.

Numerator and denominator of a rational lens trade off where targets stand in the middle of the picture: the distortion
is known there, its parameters are not. No datum would change that. Each free parameter of such a lens is held by a
pseudo-observation: at one standard deviation it moves the edge of the observed field, alone, by a part of its radius
(REACHES). That is hundreds of times what marks are measured to: beside what the observations determine it is nothing,
along the valley it leads to the smallest parameters (Tikhonov's regularisation). Where the observations contradict it,
a weaker one takes its place (Morozov's discrepancy principle), and none where they separate the parameters.
"""

from collections.abc import Mapping

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array, Indices
from adjust.functional_model.families import family
from adjust.least_squares.iteration import Linearised
from adjust.problem.condition_equations import observed_in_camera
from adjust.problem.parameter import enumeration
from adjust.problem.problem import Problem, State

REACHES = (0.3, 1.0, 3.0, 10.0)  # parts of the radius, the first that the observations do not contradict
CONTRADICTED = 0.01  # probability of so large parameters, below which a pseudo-observation is contradicted
UNRESOLVED = 0.3  # standard deviation, over that of its pseudo-observation, above which a parameter is not separable


def trading_off(problem: Problem) -> dict[str, list[int]]:
    """By camera the positions of its free distortion parameters, where numerator and denominator are both free."""
    unknowns, found = problem.unknowns, {}
    for name, positions in unknowns.camera.items():
        of = family(problem.network.camera_by_name[name].distortion.family)
        free = {
            each: int(i) for each, i in zip(of.parameters, positions[3:], strict=True) if np.isinf(unknowns.sigma[i])
        }
        if not free.keys().isdisjoint(of.alike_at_zero) and len(problem.targets_by_camera[name]):
            found[name] = list(free.values())
    return found


def edge_motions(problem: Problem, at: Linearised) -> dict[int, float]:
    """By position, of the parameters that trade off: the change that alone moves the edge of the observed field by its
    radius.
    """
    found: dict[int, float] = {}
    for name, free in trading_off(problem).items():
        rows, radius_mm = problem.targets_by_camera[name], observed_radius_mm(problem, at.state, name)
        found |= {i: radius_mm / moved for i in free if (moved := _largest_motion_mm(problem, at, rows, i))}
    return found


def is_contradicted(problem: Problem, state: State) -> bool:
    """Whether the observations want larger parameters than the pseudo-observations allow."""
    return bool(chdtrc(len(problem.pseudo_observed), pseudo_square_sum(problem, state)) < CONTRADICTED)


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


def pseudo_square_sum(problem: Problem, state: State) -> float:
    """The part of the pseudo-observations in v'Pv."""
    unknowns = problem.unknowns
    return sum(
        float((state.values[i] - unknowns.given[i]) / sigma) ** 2 for i, sigma in problem.pseudo_observed.items()
    )


def held_directions(problem: Problem, variances: Array) -> int:
    """How many directions pseudo-observations determine in place of the observations: the sum of 1 - r of them."""
    return round(sum(float(variances[i]) / sigma**2 for i, sigma in problem.pseudo_observed.items()))


def inseparable(problem: Problem, state: State, variances: Array) -> list[str]:
    """A sentence on every camera of which parameters are not separable."""
    inseparable_positions = set(unresolved(problem.pseudo_observed, variances))
    sentences = []
    for name, positions in problem.unknowns.camera.items():
        of = family(problem.network.camera_by_name[name].distortion.family)
        names = [each for each, i in zip(of.parameters, positions[3:], strict=True) if int(i) in inseparable_positions]
        if names:
            radius_mm = observed_radius_mm(problem, state, name)
            sentences.append(
                f"{enumeration(names)} of camera {name} cannot be separated: up to {radius_mm:.3g} mm from the "
                "principal point, as far as targets were observed, they do the same. The distortion itself is known "
                "there. Use its parameters together, not one by one, or estimate fewer of them."
            )
    return sentences


def _largest_motion_mm(problem: Problem, at: Linearised, rows: Indices, position: int) -> float:
    """By how much a change of 1 of a parameter moves the target that it moves most."""
    step = np.zeros(len(problem.unknowns))
    step[position] = 1.0
    return float(np.linalg.norm(at.rows.change_mm(at.by_observation, step)[rows], axis=1).max())
