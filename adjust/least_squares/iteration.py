"""Relinearise and solve until unknowns and adjusted observations stand still."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array
from adjust.least_squares.numbering import Numbering
from adjust.least_squares.rows import WhitenedRows, camera_mask, prior_differences, prior_root_weights, whitened_rows
from adjust.linear_algebra.elimination import eliminate
from adjust.linear_algebra.factor import Factor
from adjust.problem.condition_equations import compute, computed_observations, derivatives
from adjust.problem.estimates import Termination
from adjust.problem.further_observations import square_sum
from adjust.problem.problem import State

STANDSTILL_SIGMAS = 1e-8  # a step below this, in standard deviations, is none
FORESEEN = 0.1  # of that: a next step that would be smaller if it shrank as the last two did need not be taken
ROUNDING_SIGMAS = 1e-5  # steps below this that no longer shrink are rounding
VPV_ROUNDING = 1e-9  # relative increase of v'Pv that is not an increase
FIRST_DAMPING = 1e-4
LEAST_DAMPING = 1e-9
LARGEST_DAMPING = 1e8
POOR_GAIN = 0.25  # of the promised decrease of v'Pv, below which the next step is damped
LARGEST_EASING = 0.1  # of the damping after a good step
PROBE = 0.1  # part of a step over which its curvature is taken
LARGEST_TURN = 0.75  # of a step's length that its second-order part may have
SLOW = 0.5  # of the step before, above which a step shrinks slowly
LARGEST_STRETCH = 10.0  # times as long as a step that an accelerated one may be


class Iteration(NamedTuple):
    """A step of the iteration: v'Pv after it, how far it moves what moves most, its damping, the attempts.

    A step that would have increased v'Pv, or after which some point would have had no image, was tried again with more
    damping (0: an undamped Gauss-Newton step).
    """

    vpv: float
    largest_step_sigmas: float
    damping: float
    attempts: int


@dataclass(frozen=True)
class Linearised:
    """The equations at a state: computed observations and residuals (n, 2) in mm, whitened rows, v'Pv.

    by_observation (n, 2, 2): A, the derivatives of the functions by the observations.
    """

    state: State
    computed_mm: Array
    v_mm: Array
    by_observation: Array
    rows: WhitenedRows
    vpv: float

    @cached_property
    def factor(self) -> Factor:
        """The square root of the normal equations, undamped."""
        return factorise(self.rows.numbering, self)


@dataclass(frozen=True)
class Solution:
    """Where the iteration ended, and the factor there: None where the equations could not be solved."""

    end: Linearised
    factor: Factor | None
    termination: Termination
    history: tuple[Iteration, ...]


def linearise(numbering: Numbering, covariance_mm2: Array, state: State) -> Linearised | None:
    """The equations at a state; None where some point has no image there."""
    problem = numbering.problem
    computed = compute(problem, state)
    if computed is None:
        return None
    v = computed.xy_mm - problem.network.observations.xy_mm
    at = derivatives(problem, state, computed)
    rows = whitened_rows(numbering, state.values, at, covariance_mm2, v)
    sigma = problem.prior_sigma
    prior = (sigma > 0.0) & np.isfinite(sigma)
    normalised = prior_differences(problem, state)[prior] / sigma[prior]
    vpv = float((rows.right**2).sum() + (normalised**2).sum()) + square_sum(problem.further, state.values)
    return Linearised(state, computed.xy_mm, v, at.by_observation, rows, vpv)


def factorise(numbering: Numbering, at: Linearised, damping: float = 0.0, camera_priors: bool = True) -> Factor:
    """The square root of the normal equations, with or without the priors of the cameras (F5 to F9)."""
    weights = prior_root_weights(numbering)
    if not camera_priors:
        weights = np.where(camera_mask(numbering), 0.0, weights)
    differences = prior_differences(numbering.problem, at.state)[numbering.free]
    system = len(numbering.free), weights, weights * differences
    # Without these priors the factor tells what is weak: nothing is solved with it.
    return eliminate(at.rows, *system, damping, at.rows.sparse, camera_priors, numbering.fronts)


def iterate(
    numbering: Numbering, covariance_mm2: Array, state: State, limit: int, is_singular: Callable[[Linearised], bool]
) -> Solution | None:
    """Gauss-Newton steps, damped where they fail (Levenberg and Marquardt), until nothing moves any more.

    A step is taken when it makes v'Pv smaller; if not, or where a point would have no image after it, the damping
    grows. How much of the promised decrease came about, the gain, decides on the next damping (Nielsen 1999, Damping
    parameter in Marquardt's method). Damped steps are bent along the curve on which the linear residuals stay
    (`_bent`): that follows the valleys in which the principal distance changes with heights and scale. Undamped steps
    that shrink slowly are accelerated (`_accelerated`).

    is_singular: whether the equations say so, asked at the state where it begins. None: some point has no image there.
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
        moved = _step(numbering, covariance_mm2, at, damping, lately, moved)
        if moved is None:
            return Solution(at, None, "diverged", tuple(history))
        at = moved.end
        history.append(Iteration(at.vpv, moved.sigmas, moved.damping, moved.attempts))
        if moved.damping == 0.0 and _stands_still(history):
            return Solution(at, at.factor, "converged", tuple(history))
        damping, lately = _eased(moved.damping, moved.gain), moved.damping or lately
    return Solution(at, at.factor, "iteration limit", tuple(history))


def _stands_still(history: list[Iteration]) -> bool:
    """Whether the last step was none, or rounding, or so much smaller than those before that the next will be none."""
    steps = [each.largest_step_sigmas for each in history[-3:]]
    if steps[-1] < STANDSTILL_SIGMAS:
        return True
    if len(steps) > 1 and max(steps[-2:]) < ROUNDING_SIGMAS and steps[-1] > 0.5 * steps[-2]:
        return True
    undamped = len(steps) == 3 and not any(each.damping for each in history[-3:])
    return undamped and steps[2] * max(steps[1] / steps[0], steps[2] / steps[1]) < FORESEEN * STANDSTILL_SIGMAS


def _eased(damping: float, gain: float) -> float:
    """The damping of the next step: less where the linear equations told the truth, more where they did not."""
    if damping == 0.0:
        return 0.0 if gain > POOR_GAIN else FIRST_DAMPING
    eased = damping * max(LARGEST_EASING, 1.0 - (2.0 * gain - 1.0) ** 3)
    return eased if eased > LEAST_DAMPING else 0.0


@dataclass(frozen=True)
class _Moved:
    """A step that was taken: where it leads, its length in standard deviations, and how it came about.

    solution (n,): that of the linear equations; taken (n,): what was made of it.
    """

    end: Linearised
    sigmas: float
    damping: float
    gain: float
    attempts: int
    solution: Array
    taken: Array


def _step(
    numbering: Numbering, covariance_mm2: Array, at: Linearised, damping: float, lately: float, before: _Moved | None
) -> _Moved | None:
    """The first step from a state that makes v'Pv smaller, with more and more damping; None: there is none.

    lately: the damping that helped lately, to be tried where it takes some. before: the step before.
    """
    problem = numbering.problem
    attempts = 0
    if damping == 0.0 and before is not None and before.damping == 0.0:
        accelerated = _accelerated(numbering, covariance_mm2, at, before)
        if accelerated is not None:
            return accelerated
    while damping < LARGEST_DAMPING:
        attempts += 1
        try:
            factor = factorise(numbering, at, damping) if damping else at.factor
            solution = factor.solution
        except np.linalg.LinAlgError:
            return None
        step = np.zeros(len(problem.unknowns))
        step[numbering.free] = solution
        if np.isfinite(step).all():
            # The damping's rows, which hold the scaled unknowns where they are, take their part of the decrease.
            promised = factor.length() ** 2 + damping * float(((factor.scale * solution) ** 2).sum())
            bent = step if damping == 0.0 else _bent(numbering, at, damping, step)
            moved = None if bent is None else linearise(numbering, covariance_mm2, problem.step_state(at.state, bent))
            is_rounding = damping == 0.0 and factor.length() < ROUNDING_SIGMAS  # and so is what it does to v'Pv
            is_better = moved is not None and (is_rounding or moved.vpv <= at.vpv + VPV_ROUNDING * (1.0 + at.vpv))
            if bent is not None and moved is not None and is_better:
                gain = (at.vpv - moved.vpv) / promised if promised > VPV_ROUNDING * (1.0 + at.vpv) else 1.0
                return _Moved(moved, factor.length(), damping, gain, attempts, step, bent)
        damping = 10.0 * damping or lately
    return None


def _accelerated(numbering: Numbering, covariance_mm2: Array, at: Linearised, before: _Moved) -> _Moved | None:
    """An undamped step with what the one before tells of its error; None where that is no better.

    Where observations hardly determine a direction, the second derivatives of large residuals make Gauss-Newton's steps
    shrink slowly, or overshoot. The combination of the last two steps of least length takes their place (Anderson 1965,
    Iterative procedures for nonlinear integral equations; of depth one).
    """
    problem, factor = numbering.problem, at.factor
    step = np.zeros(len(problem.unknowns))
    step[numbering.free] = factor.solution
    length = factor.length()
    if not SLOW * before.sigmas < length < 1.0:
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


def _bent(numbering: Numbering, at: Linearised, damping: float, step: Array) -> Array | None:
    """A damped step with its second-order part; None where that is too large to be trusted, or cannot be found.

    The second derivative of the observations along the step, by a difference, takes the place of an observation:
    geodesic acceleration (Transtrum and Sethna 2012, Improvements to the Levenberg-Marquardt algorithm).
    """
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
