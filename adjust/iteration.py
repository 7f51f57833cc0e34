"""Relinearise and solve until unknowns and adjusted observations stand still."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.elimination import Factor, eliminate
from adjust.functions import Derivatives, computed_observations, derivatives
from adjust.further_observations import square_sum
from adjust.numbering import Numbering
from adjust.problem import Problem, State
from adjust.result import Termination
from adjust.rows import WhitenedRows, of_cameras, prior_differences, prior_root_weights, whitened_rows

Array = NDArray[np.float64]

STANDSTILL_SIGMAS = 1e-8  # a step below this, in standard deviations, is none
ROUNDING_SIGMAS = 1e-5  # steps below this that no longer shrink are rounding
VPV_ROUNDING = 1e-9  # relative increase of v'Pv that is not an increase
FIRST_DAMPING = 1e-4
LEAST_DAMPING = 1e-6
LARGEST_DAMPING = 1e8


@dataclass(frozen=True)
class Linearised:
    """The equations at a state: computed observations and residuals (n, 2) in mm, derivatives, whitened rows, v'Pv."""

    state: State
    computed_mm: Array
    v_mm: Array
    at: Derivatives
    rows: WhitenedRows
    vpv: float


@dataclass(frozen=True)
class Solution:
    """Where the iteration ended, and the factor there: None where the equations could not be solved."""

    end: Linearised
    factor: Factor | None
    termination: Termination
    history: tuple[tuple[float, float], ...]


def linearise(numbering: Numbering, covariance_mm2: Array, state: State) -> Linearised | None:
    """The equations at a state; None where some point has no image there."""
    problem = numbering.problem
    computed = computed_observations(problem, state)
    if computed is None:
        return None
    v = computed - problem.network.observations.xy_mm
    at = derivatives(problem, state, computed)
    rows = whitened_rows(numbering, state.values, at, covariance_mm2, v)
    return Linearised(state, computed, v, at, rows, weighted_square_sum(problem, state, v, covariance_mm2))


def weighted_square_sum(problem: Problem, state: State, v_mm: Array, covariance_mm2: Array) -> float:
    """v'Pv of the observations, of the priors and of further observations."""
    weighted = np.linalg.solve(covariance_mm2, v_mm[..., None])[..., 0]
    prior = problem.unknowns.has_prior
    normalised = prior_differences(problem, state)[prior] / problem.unknowns.sigma[prior]
    return float((v_mm * weighted).sum() + (normalised**2).sum()) + square_sum(problem.further, state.values)


def factorise(numbering: Numbering, at: Linearised, damping: float = 0.0, camera_priors: bool = True) -> Factor:
    """The square root of the normal equations, with or without the priors of the cameras (F5 to F9)."""
    weights = prior_root_weights(numbering)
    if not camera_priors:
        weights = np.where(of_cameras(numbering), 0.0, weights)
    differences = prior_differences(numbering.problem, at.state)[numbering.free]
    # Without these priors the factor tells what is weak: nothing is solved with it.
    return eliminate(at.rows, len(numbering.free), weights, weights * differences, damping, at.rows.sums, camera_priors)


def iterate(numbering: Numbering, covariance_mm2: Array, start: Linearised, limit: int) -> Solution:
    """Gauss-Newton steps; one that would increase v'Pv is damped (Levenberg and Marquardt) until it decreases it."""
    at = start
    damping = 0.0
    history: list[tuple[float, float]] = []
    while len(history) < limit:
        moved = _step(numbering, covariance_mm2, at, damping)
        if moved is None:
            return Solution(at, None, "diverged", tuple(history))
        at, step, damping = moved
        history.append((at.vpv, step))
        if damping == 0.0 and _stands_still(history):
            return Solution(at, factorise(numbering, at), "converged", tuple(history))
        damping = damping / 10.0 if damping > LEAST_DAMPING else 0.0
    return Solution(at, factorise(numbering, at), "iteration limit", tuple(history))


def _stands_still(history: list[tuple[float, float]]) -> bool:
    steps = [step for _, step in history[-2:]]
    if steps[-1] < STANDSTILL_SIGMAS:
        return True
    return len(steps) == 2 and max(steps) < ROUNDING_SIGMAS and steps[1] > 0.5 * steps[0]


def _step(
    numbering: Numbering, covariance_mm2: Array, at: Linearised, damping: float
) -> tuple[Linearised, float, float] | None:
    """The next state, the step's length in standard deviations and its damping; None: no step helps."""
    problem = numbering.problem
    while damping < LARGEST_DAMPING:
        try:
            factor = factorise(numbering, at, damping)
            solution = factor.solution()
        except np.linalg.LinAlgError:
            return None
        step = np.zeros(len(problem.unknowns))
        step[numbering.free] = solution
        moved = linearise(numbering, covariance_mm2, problem.moved(at.state, step)) if np.isfinite(step).all() else None
        if moved is not None and moved.vpv <= at.vpv + VPV_ROUNDING * (1.0 + at.vpv):
            return moved, factor.length(), damping
        damping = max(10.0 * damping, FIRST_DAMPING)
    return None
