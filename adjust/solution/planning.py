"""Network planning: adjustment with computed observations of a network not yet measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr

from adjust.array_types import Array
from adjust.errors import AdjustmentError
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import linearise
from adjust.problem.condition_equations import blind_marks, computed_observations
from adjust.problem.estimates import NullDirection
from adjust.problem.further_observations import error_free
from adjust.problem.network import Approximations, Network
from adjust.problem.parameter import Parameter
from adjust.problem.problem import Problem, number_reduced
from adjust.quality.cofactor import free_cofactor
from adjust.rank_defect.diagnosis import null_vectors
from adjust.solution.options import Options
from adjust.solution.result import Adjustment, adjust_problem, settle_datum
from adjust.validation import validate_plan

STILL = 1e-6  # fraction of a null direction's motion that is rounding: quantities that move less are determined


@dataclass(frozen=True)
class Plan:
    """Expected precision of a network.

    Attributes
    ----------
    adjustment : adjustment of error-free observations. Its cofactor matrix, redundancy numbers and the given sigma0 are
        the expected ones.
    sigma0 : given factor on the a-priori standard deviations.
    singular : null directions.
    null : (n, d) motion of all unknowns in these directions. The adjustment then holds d unknowns; quantities that do
        not move are the same whichever are held.
    """

    adjustment: Adjustment
    sigma0: float
    singular: tuple[NullDirection, ...]
    null: Array

    def sigma(self, parameter: Parameter | str) -> float:
        """Expected standard deviation of an unknown: 0 where fixed, inf where undetermined."""
        i = self.adjustment.index(parameter)
        return np.inf if self.null[i].any() else self.sigma0 * float(np.sqrt(self.adjustment.cofactor.variances[i]))

    def sigmas(self, parameters: Sequence[Parameter | str], functions: Array) -> Array:
        """Expected standard deviations (m,) of linear functions (m, k) of k unknowns; inf where undetermined."""
        rows = [self.adjustment.index(each) for each in parameters]
        variances = ((functions @ self.adjustment.cofactor_of(parameters)) * functions).sum(axis=1)
        moved = np.abs(functions @ self.null[rows])
        could_move = np.abs(functions) @ np.abs(self.null[rows])
        determined = (moved <= STILL * could_move).all(axis=1)
        return np.where(determined, self.sigma0 * np.sqrt(np.maximum(variances, 0.0)), np.inf)


def plan(network: Network, values: Approximations, options: Options | None = None, sigma0: float = 1.0) -> Plan:
    """Compute the expected precision of a network whose unknowns have given values.

    The coordinates of the observations are computed and priors are taken as true, so that no iteration is needed.
    sigma0: expected factor on the a-priori standard deviations, known from earlier adjustments.

    Raises AdjustmentError where the network is empty or contradictory, or where a point has no image.
    """
    options = options or Options()
    validate_plan(network)
    numbered, reduction = number_reduced(network, values)
    unknowns, xy_mm = numbered.unknowns, computed_observations(numbered, numbered.start())
    if xy_mm is None:
        reason, _ = next(iter(blind_marks(numbered, numbered.start()).values()))
        raise AdjustmentError(
            f"The network cannot be planned: {reason}. Turn the camera towards the field, or leave the point out of "
            "that image."
        )
    computed = error_free(numbered.network, unknowns, unknowns.start)
    computed = replace(computed, observations=replace(computed.observations, xy_mm=xy_mm))
    given = np.where(np.isnan(unknowns.given), np.nan, unknowns.start)
    problem = replace(numbered, network=computed, unknowns=replace(unknowns, given=given))
    result = adjust_problem(problem, options)
    singular = result.singular
    null = np.zeros((len(problem.unknowns), 0))
    if singular:
        held, null = _regularise(settle_datum(problem, options))
        result = adjust_problem(problem, options, held)
    own = reduction.inverse.network(result.network)
    adjusted = reduction.unreduced_values(problem.unknowns, result.values, own)
    variance = replace(result.variance, sigma0=sigma0)
    expected = replace(result, network=own, values=adjusted, vpv=sigma0**2 * result.redundancy, variance=variance)
    return Plan(expected, sigma0, singular, null)


def _regularise(problem: Problem) -> tuple[list[int], Array]:
    """Positions of unknowns that make a singular problem regular when held, and its null vectors (n, d)."""
    # The pivots of the null vectors are held, one for each: minimal constraints of the free unknowns.
    held: list[int] = []
    null = np.zeros((len(problem.unknowns), 0))
    while True:
        numbering = Numbering(replace(problem, unknowns=problem.unknowns.fixed(held)))
        at = linearise(numbering, problem.network.observations.covariance_mm2, problem.start())
        assert at is not None  # its observations are computed
        scaled = null_vectors(at.factor)
        if scaled.shape[1] == 0:
            return held, null
        pivots = qr(scaled.T, mode="r", pivoting=True)[1][: scaled.shape[1]]
        held += [int(position) for position in numbering.free[pivots]]
        still = np.abs(scaled) <= STILL * np.abs(scaled).max(axis=0)
        by_free = free_cofactor(at).by_free
        vectors = np.where(still, 0.0, scaled) / at.factor.scale[:, None]
        moved, could_move = by_free @ vectors, abs(by_free) @ np.abs(vectors)
        null = np.hstack([null, np.where(np.abs(moved) <= STILL * could_move, 0.0, moved)])
