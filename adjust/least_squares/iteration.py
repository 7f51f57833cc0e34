"""Gauss-Newton iteration with damping: linearise and solve until the unknowns and adjusted observations converge."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array
from adjust.least_squares.equations import Numbering, WhitenedRows, prior_differences, prior_root_weights, whitened_rows
from adjust.linear_algebra.elimination import eliminate
from adjust.linear_algebra.factor import Factor
from adjust.problem.condition_equations import compute, computed_observations, derivatives
from adjust.problem.estimates import Termination
from adjust.problem.further_observations import square_sum
from adjust.problem.problem import State

STANDSTILL_SIGMAS = 1e-8  # in standard deviations: largest step at convergence
FORESEEN = 0.1  # fraction of that: a next step predicted to be smaller, from the last ones, need not be taken
NEGLIGIBLE_SIGMAS = 1e-7  # in standard deviations: steps that change derivatives by less than rounding errors
ROUNDING_SIGMAS = 1e-5  # in standard deviations: smaller steps that no longer shrink are rounding errors
VPV_ROUNDING = 1e-9  # relative increase of v'Pv that may be rounding
FIRST_DAMPING = 1e-4
LEAST_DAMPING = 1e-9
LARGEST_DAMPING = 1e8
POOR_GAIN = 0.25  # fraction of the predicted decrease of v'Pv below which the next step is damped
LARGEST_EASING = 0.1  # smallest factor of the damping after a good step
PROBE = 0.1  # fraction of a step used for the difference quotient of its curvature
LARGEST_TURN = 0.75  # largest second-order part, as a fraction of the step's length
SLOW = 0.5  # ratio to the step before above which convergence is slow
LARGEST_STRETCH = 10.0  # largest ratio of an accelerated step to the plain one


class Iteration(NamedTuple):
    """Record of a step of the iteration."""

    vpv: float  # v'Pv after the step
    largest_step_sigmas: float  # length of the step: the largest change of any function of the unknowns, in its sigmas
    damping: float  # 0 for an undamped Gauss-Newton step
    attempts: int  # trials, each with more damping, until v'Pv did not increase and every point had an image


@dataclass(frozen=True)
class Linearised:
    """Observation equations linearised at a state."""

    state: State
    # computed_mm, v_mm: (n, 2) computed observations and residuals
    computed_mm: Array
    v_mm: Array
    by_observation: Array  # (n, 2, 2) A, derivatives of the condition equations with respect to the observations
    rows: WhitenedRows  # whitened rows
    vpv: float  # v'Pv
    factor_nearby: Factor | None = None  # at a state NEGLIGIBLE_SIGMAS away

    @cached_property
    def factor(self) -> Factor:
        """Square root of the undamped normal equations."""
        return self.factor_nearby or factorise(self.rows.numbering, self)

    @cached_property
    def step(self) -> Array | None:
        """Undamped step (n,) of the unknowns; None where the equations are singular in the computer's digits."""
        step = np.zeros(len(self.rows.numbering.problem.unknowns))
        try:
            step[self.rows.numbering.free] = self.factor.solution
        except np.linalg.LinAlgError:
            return None
        return step


@dataclass(frozen=True)
class Solution:
    """Final state of the iteration, and the factor there; None if the equations could not be solved."""

    end: Linearised
    factor: Factor | None
    termination: Termination
    history: tuple[Iteration, ...]


def linearise(numbering: Numbering, covariance_mm2: Array, state: State) -> Linearised | None:
    """Linearise the observation equations at a state; None if some point has no image there."""
    problem = numbering.problem
    computed = compute(problem, state)
    if computed is None:
        return None
    v = computed.xy_mm - problem.network.observations.xy_mm
    at = derivatives(problem, state, computed)
    rows = whitened_rows(numbering, state.values, at, covariance_mm2, v)
    return Linearised(state, computed.xy_mm, v, at.by_observation, rows, _vpv(rows, state))


def _vpv(rows: WhitenedRows, state: State) -> float:
    """v'Pv of observations and given values."""
    problem = rows.numbering.problem
    sigma = problem.prior_sigma
    prior = (sigma > 0.0) & np.isfinite(sigma)
    normalised = prior_differences(problem, state)[prior] / sigma[prior]
    return float((rows.right**2).sum() + (normalised**2).sum()) + square_sum(problem.further, state.values)


def factorise(numbering: Numbering, at: Linearised, damping: float = 0.0, camera_priors: bool = True) -> Factor:
    """Factorise the normal equations, with or without the priors of the cameras (F5 to F9) and scanners."""
    weights = prior_root_weights(numbering)
    if not camera_priors:
        unknowns = numbering.problem.unknowns
        positions = [*unknowns.camera.values(), *unknowns.fiducial.values(), *unknowns.scanner.values()]
        weights = np.where(np.isin(numbering.free, np.concatenate(positions)), 0.0, weights)
    differences = prior_differences(numbering.problem, at.state)[numbering.free]
    system = len(numbering.free), weights, weights * differences
    # Without these priors the factor only serves to find weak directions, so it need not be sharp.
    return eliminate(at.rows, *system, damping, at.rows.sparse, camera_priors, numbering.fronts)


def iterate(
    numbering: Numbering, covariance_mm2: Array, state: State, limit: int, is_singular: Callable[[Linearised], bool]
) -> Solution | None:
    """Iterate Gauss-Newton steps, damped where they fail (Levenberg and Marquardt), until convergence.

    Parameters
    ----------
    covariance_mm2 : (n, 2, 2) covariance matrices of the observations.
    state : initial values.
    limit : largest number of steps.
    is_singular : decides at the initial values whether the equations are singular.

    Returns
    -------
    Solution; None if some point has no image at the initial values.

    Notes
    -----
    A step is accepted if it decreases v'Pv. Otherwise, or if a point would have no image after it, the damping is
    increased. The gain, the ratio of the actual to the predicted decrease, determines the next damping (Nielsen 1999,
    Damping parameter in Marquardt's method). Damped steps are corrected to the second order
    (`_second_order_step`), to follow curved valleys in which the principal distance is correlated with heights and
    scale. Undamped steps that shrink slowly are accelerated (`_accelerate`).
    """
    at = linearise(numbering, covariance_mm2, state)
    if at is None:
        return None
    if is_singular(at):
        return Solution(at, None, "singular", ())
    damping, lately = 0.0, FIRST_DAMPING
    history: list[Iteration] = []
    moved: _Moved | None = None
    while len(history) < limit:
        if damping == 0.0 and (end := _end(at, history)) is not None:
            return Solution(end, end.factor, "converged", (*history, Iteration(end.vpv, at.factor.length(), 0.0, 1)))
        moved = _step(numbering, covariance_mm2, at, damping, lately, moved)
        if moved is None:
            return Solution(at, None, "diverged", tuple(history))
        at = moved.end
        history.append(Iteration(at.vpv, moved.sigmas, moved.damping, moved.attempts))
        if moved.damping == 0.0 and _stands_still(history):
            return Solution(at, at.factor, "converged", tuple(history))
        damping, lately = moved.next_damping, moved.damping or lately
    return Solution(at, at.factor, "iteration limit", tuple(history))


def _end(at: Linearised, history: list[Iteration]) -> Linearised | None:
    """State after a negligible step that ends the iteration, with the derivatives before it; None after others."""
    problem, length = at.rows.numbering.problem, at.factor.length()
    if length > NEGLIGIBLE_SIGMAS or not _stands_still([*history, Iteration(at.vpv, length, 0.0, 1)]):
        return None
    if at.step is None:
        return None
    state = problem.step_state(at.state, at.step)
    computed_mm = computed_observations(problem, state)
    if computed_mm is None:
        return None
    v_mm = computed_mm - problem.network.observations.xy_mm
    rows = at.rows.replace_discrepancies(at.by_observation, v_mm)
    return Linearised(state, computed_mm, v_mm, at.by_observation, rows, _vpv(rows, state), at.factor)


def _stands_still(history: list[Iteration]) -> bool:
    """Whether the iteration converged: the last step was negligible or rounding, or the next one will be negligible."""
    steps = [each.largest_step_sigmas for each in history[-3:]]
    if steps[-1] < STANDSTILL_SIGMAS:
        return True
    if len(steps) > 1 and max(steps[-2:]) < ROUNDING_SIGMAS and steps[-1] > 0.5 * steps[-2]:
        return True
    undamped = len(steps) == 3 and not any(each.damping for each in history[-3:])
    return undamped and steps[2] * max(steps[1] / steps[0], steps[2] / steps[1]) < FORESEEN * STANDSTILL_SIGMAS


@dataclass(frozen=True)
class _Moved:
    """Accepted step."""

    end: Linearised  # equations after the step
    sigmas: float  # length of the step, in standard deviations
    # damping, gain, attempts: damping, ratio of the actual to the predicted decrease of v'Pv, number of trials
    damping: float
    gain: float
    attempts: int
    solution: Array  # (n,) solution of the linear equations
    taken: Array  # (n,) the step taken: this solution, or the corrected or accelerated one

    @property
    def next_damping(self) -> float:
        """Damping of the next step: smaller if the linear prediction was good, larger if it was not (Nielsen 1999)."""
        if self.damping == 0.0:
            return 0.0 if self.gain > POOR_GAIN else FIRST_DAMPING
        eased = self.damping * max(LARGEST_EASING, 1.0 - (2.0 * self.gain - 1.0) ** 3)
        return eased if eased > LEAST_DAMPING else 0.0


def _step(
    numbering: Numbering, covariance_mm2: Array, at: Linearised, damping: float, lately: float, before: _Moved | None
) -> _Moved | None:
    """Take the first step that decreases v'Pv, with increasing damping; None if there is none."""
    # lately: damping of the last successful damped step, tried first where damping is needed. before: the step before.
    problem = numbering.problem
    attempts = 0
    if damping == 0.0 and before is not None and before.damping == 0.0:
        accelerated = _accelerate(numbering, covariance_mm2, at, before)
        if accelerated is not None:
            return accelerated
    while damping < LARGEST_DAMPING:
        attempts += 1
        try:
            factor = factorise(numbering, at, damping) if damping else at.factor
            solution = factor.solution
        except np.linalg.LinAlgError:  # singular in the computer's digits, which damping mends
            damping = 10.0 * damping or lately
            continue
        step = np.zeros(len(problem.unknowns))
        step[numbering.free] = solution
        if np.isfinite(step).all():
            # Predicted decrease of v'Pv: factor.length() belongs to the damped equations, so add the damping term.
            promised = factor.length() ** 2 + damping * float(((factor.scale * solution) ** 2).sum())
            bent = step if damping == 0.0 else _second_order_step(numbering, at, damping, step)
            moved = None if bent is None else linearise(numbering, covariance_mm2, problem.step_state(at.state, bent))
            is_rounding = damping == 0.0 and factor.length() < ROUNDING_SIGMAS  # and so is the change of v'Pv
            is_better = moved is not None and (is_rounding or moved.vpv <= at.vpv + VPV_ROUNDING * (1.0 + at.vpv))
            if bent is not None and moved is not None and is_better:
                gain = (at.vpv - moved.vpv) / promised if promised > VPV_ROUNDING * (1.0 + at.vpv) else 1.0
                return _Moved(moved, factor.length(), damping, gain, attempts, step, bent)
        damping = 10.0 * damping or lately
    return None


def _accelerate(numbering: Numbering, covariance_mm2: Array, at: Linearised, before: _Moved) -> _Moved | None:
    """Accelerate an undamped step by the one before; None if that is not possible or no better."""
    # In weakly determined directions, the second derivatives neglected with large residuals make Gauss-Newton steps
    # shrink slowly, or overshoot. The combination of the last two steps of least length replaces the step (Anderson
    # 1965, Iterative procedures for nonlinear integral equations; depth one).
    problem, factor, step = numbering.problem, at.factor, at.step
    length = factor.length()
    if step is None or not SLOW * before.sigmas < length < 1.0:
        return None
    change = (step - before.solution)[numbering.free] * factor.scale
    part = float(change @ (step[numbering.free] * factor.scale)) / float(change @ change)
    taken = step - part * (before.taken + step - before.solution)
    sizes = [float(np.linalg.norm(each[numbering.free] * factor.scale)) for each in (step, taken)]
    if not sizes[1] <= LARGEST_STRETCH * sizes[0]:
        return None
    moved = linearise(numbering, covariance_mm2, problem.step_state(at.state, taken))
    if moved is None or moved.vpv > at.vpv + VPV_ROUNDING * (1.0 + at.vpv):
        return None
    return _Moved(moved, length, 0.0, 1.0, 1, step, taken)


def _second_order_step(numbering: Numbering, at: Linearised, damping: float, step: Array) -> Array | None:
    """Add the second-order correction to a damped step; None if it is too large or cannot be computed."""
    # Geodesic acceleration (Transtrum and Sethna 2012, Improvements to the Levenberg-Marquardt algorithm): the second
    # derivative of the observations along the step, by a difference quotient, is added to the discrepancies.
    problem = numbering.problem
    ahead = computed_observations(problem, problem.step_state(at.state, PROBE * step))
    if ahead is None:
        return None
    change_mm = at.rows.change_mm(at.by_observation, step)
    half_curvature_mm = ((ahead - at.computed_mm) / PROBE - change_mm) / PROBE
    rows = at.rows.replace_discrepancies(at.by_observation, at.v_mm + half_curvature_mm)
    factor = factorise(numbering, replace(at, rows=rows), damping)
    bent = np.zeros_like(step)
    bent[numbering.free] = factor.solution
    length, turn = (float(np.linalg.norm(each[numbering.free] * factor.scale)) for each in (step, bent - step))
    return bent if turn <= LARGEST_TURN * length and np.isfinite(bent).all() else None
