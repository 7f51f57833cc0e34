"""Inseparable distortion parameters: a flat valley of v'Pv, held by weak pseudo-observations.

Numerator and denominator of a rational lens are correlated where targets cover only the centre of the image: the
distortion is determined there, its parameters are not, and no datum would change that. Each free parameter of such a
lens gets a pseudo-observation whose standard deviation alone moves the edge of the observed field by a fraction of its
radius (REACHES). That is hundreds of times the precision of marks: negligible where the observations determine a
combination, while along the valley it leads to the smallest parameters (Tikhonov regularisation). If the observations
contradict it, a weaker one is used (Morozov's discrepancy principle), and none where they separate the parameters.
"""

from collections.abc import Mapping

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array
from adjust.functional_model.families import family
from adjust.least_squares.iteration import Linearised
from adjust.problem.condition_equations import observed_in_camera
from adjust.problem.parameter import enumeration
from adjust.problem.problem import Problem, State

REACHES = (0.3, 1.0, 3.0, 10.0)  # in radii; the first one that the observations do not contradict is used
CONTRADICTED = 0.01  # p-value of the parameters' size below which the pseudo-observations are contradicted
UNRESOLVED = 0.3  # ratio to the pseudo-observation's standard deviation above which a parameter is not separable


def trading_off(problem: Problem) -> dict[str, list[int]]:
    """Positions of the free distortion parameters of each camera with a free numerator and denominator."""
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
    """Change of each correlated parameter, by position, that alone moves the edge of the observed field by its
    radius."""
    found: dict[int, float] = {}
    for name, free in trading_off(problem).items():
        rows, radius_mm = problem.targets_by_camera[name], observed_radius_mm(problem, at.state, name)
        for position in free:
            change = at.rows.change_mm(at.by_observation, np.arange(len(problem.unknowns)) == position)[rows]
            if moved := float(np.linalg.norm(change, axis=1).max()):
                found[position] = radius_mm / moved
    return found


def is_contradicted(problem: Problem, state: State) -> bool:
    """Whether the observations contradict the pseudo-observations (chi-square test)."""
    return bool(chdtrc(len(problem.pseudo_observed), pseudo_square_sum(problem, state)) < CONTRADICTED)


def observed_radius_mm(problem: Problem, state: State, camera: str) -> float:
    """Distance from the principal point to the outermost observed target."""
    xy_mm = observed_in_camera(problem, state)[problem.targets_by_camera[camera]]
    principal_point = state.values[problem.unknowns.camera[camera][1:3]]
    return float(np.linalg.norm(xy_mm - principal_point, axis=1).max())


def unresolved(pseudo_observed: Mapping[int, float], variances: Array) -> list[int]:
    """Positions of the pseudo-observed parameters that the observations do not separate. variances (n,): a priori."""
    return [i for i, sigma in pseudo_observed.items() if np.sqrt(variances[i]) > UNRESOLVED * sigma]


def pseudo_square_sum(problem: Problem, state: State) -> float:
    """Contribution of the pseudo-observations to v'Pv."""
    unknowns = problem.unknowns
    return sum(
        float((state.values[i] - unknowns.given[i]) / sigma) ** 2 for i, sigma in problem.pseudo_observed.items()
    )


def held_directions(problem: Problem, variances: Array) -> int:
    """Number of directions that the pseudo-observations determine: the sum of 1 - r over them."""
    return round(sum(float(variances[i]) / sigma**2 for i, sigma in problem.pseudo_observed.items()))


def inseparable(problem: Problem, state: State, variances: Array) -> dict[str, tuple[list[str], str]]:
    """Inseparable parameters of each camera that has some, and a sentence on them."""
    inseparable_positions = set(unresolved(problem.pseudo_observed, variances))
    found = {}
    for name, positions in problem.unknowns.camera.items():
        of = family(problem.network.camera_by_name[name].distortion.family)
        names = [each for each, i in zip(of.parameters, positions[3:], strict=True) if int(i) in inseparable_positions]
        if names:
            radius_mm = observed_radius_mm(problem, state, name)
            sentence = (
                f"{enumeration(names)} of camera {name} cannot be separated: up to {radius_mm:.3g} mm from the "
                "principal point, as far as targets were observed, they do the same. The distortion itself is known "
                "there. Use its parameters together, not one by one, or estimate fewer of them."
            )
            found[name] = names, sentence
    return found
