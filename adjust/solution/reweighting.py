"""Iterative reweighting: adjust repeatedly until the weights no longer change."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from adjust.errors import NoImageError
from adjust.functional_model.families import family
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import Linearised, iterate
from adjust.problem.condition_equations import blind_marks
from adjust.problem.estimates import NullDirection, Termination
from adjust.problem.problem import Problem, State
from adjust.quality.cofactor import free_cofactor
from adjust.quality.critical_values import NO_WEIGHT, TestedUnits, WeightFunction, Weighting, robust_weights
from adjust.quality.reliability import Snooping
from adjust.quality.run import GrossError, Run
from adjust.quality.variance_components import refined_factors
from adjust.rank_defect.diagnosis import REACHES, edge_motions, is_contradicted, singular_directions, unresolved_motions
from adjust.solution.options import Options

ROUNDS = 30  # largest number of rounds of robust estimation, variance components or data snooping
STEPS_WITHOUT = 40  # iterations without gross errors, which may have led far away
ITERATIONS_A_ROUND = 8  # iterations per round of robust estimation, whose weights will change anyway


def run(
    problem: Problem,
    options: Options,
    doubted: Collection[int] = (),
    mismatched: Mapping[int, tuple[int, ...]] = MappingProxyType({}),
) -> Run:
    """Adjust a problem, whose datum is settled, from its start.

    doubted: positions of quantities whose given values robust estimation and data snooping leave out at first;
    mismatched: rows of observations that every method leaves out at first, with those that could be wrong in their
    place. They return where they agree with the rest. Raises NoImageError where a point has no image at the start.
    """
    units = TestedUnits(problem)
    alone = np.isin(units.positions[:, 0], list(doubted))
    of_given = (len(units) - len(units.positions) + np.flatnonzero(alone)).tolist()
    doubted_units = [*mismatched, *of_given]
    weights = np.ones(len(units))
    weights[doubted_units] = NO_WEIGHT
    factors = {group: 1.0 for group in options.groups if (units.groups == group).any()}
    rejects = options.snooping or bool(mismatched and not options.robust)
    begun = Weighting(weights, {} if rejects else factors)
    last = _run(problem, begun, problem.start(), options.iteration_limit)
    if not rejects:
        return _settle(last, options, doubted_units)
    # Variance components come second: those of contaminated groups would mask the outliers.
    if doubted_units and last.is_tested:
        tests = last.statistics
        removed = (
            GrossError(unit, float(tests.statistic[unit]), 0.0, tests.error[unit], mismatched.get(unit, ()))
            for unit in doubted_units
        )
        last = replace(last, removed=tuple(removed))
    last = snoop(last, replace(options, variance_components=False))
    if not options.groups:
        return last
    return snoop(_settle(replace(last, weighting=replace(last.weighting, factors=factors)), options), options)


def _settle(last: Run, options: Options, doubted: Sequence[int] = ()) -> Run:
    """Adjust until robust estimation and variance components no longer change the weights."""
    # doubted: units that start with no weight until the redescending function takes over: the small weight that Huber's
    # function gives to an error of many thousand sigma would still distort the network.
    limit = min(options.iteration_limit, ITERATIONS_A_ROUND) if options.robust else options.iteration_limit
    for function in options.weight_functions or (None,):
        for _ in range(ROUNDS):
            refined = _reweight(last, function)
            if function in options.weight_functions[:-1]:
                refined.weights[list(doubted)] = NO_WEIGHT
            if not refined.differs(last.weighting):
                break
            last = again(last, refined, limit)
        else:
            last = replace(last, settled=False)
    if options.robust and last.solution.termination == "iteration limit":
        last = replace(again(last, last.weighting, options.iteration_limit), settled=last.settled)
    return last


def _reweight(last: Run, function: WeightFunction | None) -> Weighting:
    """Compute the weights from the residuals of a run; unchanged where these are not usable."""
    if not (function or (last.weighting.factors and last.converged)) or not last.is_tested:
        return last.weighting
    weighting = refined_factors(last)
    if function is None:
        return weighting
    tests = last.statistics
    return replace(weighting, weights=robust_weights(tests.statistic, tests.sizes, len(last.end.v_mm), function))


def again(last: Run, weighting: Weighting, limit: int, state: State | None = None) -> Run:
    """Adjust again with other weights, from the end of the last run or from another state."""
    return replace(_run(last.problem, weighting, state or last.end.state, limit), removed=last.removed)


def without(last: Run, units: Sequence[int]) -> Run:
    """Adjust again, from the end of the last run, with its weights but without some units."""
    weights = last.weighting.weights.copy()
    weights[list(units)] = NO_WEIGHT
    return again(last, replace(last.weighting, weights=weights), STEPS_WITHOUT)


def snoop(last: Run, options: Options) -> Run:
    """Remove outliers and adjust until none remains and every removed one would be rejected again."""
    earlier: set[frozenset[int]] = set()
    for _ in range(ROUNDS):
        if not last.is_tested:
            return last
        search = Snooping(last, options.probabilities)
        limits = search.limits
        confirmed = [each for each in last.removed if last.statistics.statistic[each.unit] > limits[each.unit]]
        removed = (*confirmed, *(search.contradictions if options.snooping else ()))
        out = frozenset(each.unit for each in removed)
        if out == {each.unit for each in last.removed}:
            return last
        if out in earlier:
            break
        earlier.add(out)
        weights = np.ones(len(last.weighting.weights))
        weights[list(out)] = NO_WEIGHT
        last = replace(last, removed=removed)
        last = _settle(again(last, replace(last.weighting, weights=weights), options.iteration_limit), options)
    return replace(last, settled=False)


def _run(problem: Problem, weighting: Weighting, state: State, limit: int) -> Run:
    """Iterate from a state; where the cameras' parameters lead nowhere, hold them first, then release them."""
    # Those of a denominator are like others where they are 0, and mislead the iteration where they are not; principal
    # point, decentering and prism are alike at the start of boards that are seen from little tilts.
    last = _iterate(problem, weighting, state, limit)
    is_lost = not last.converged and bool(last.solution.history)
    alike = [at for positions in _alike_at_zero(problem, state, is_lost).values() for at in positions]
    of_cameras = np.concatenate([*problem.unknowns.camera.values()])
    free = of_cameras[np.isinf(problem.unknowns.sigma[of_cameras])].tolist()
    for held in (alike,) if is_lost else (alike, free):
        if held and (is_lost or (last.singular and not last.solution.history)):
            begun = _run(replace(problem, unknowns=problem.unknowns.fixed(held)), weighting, state, limit)
            if begun.converged:
                freed = _release_cameras(problem, weighting, begun, limit)
                last = freed if freed.converged or not (is_lost or freed.singular) else last
    return last


def _release_cameras(problem: Problem, weighting: Weighting, begun: Run, limit: int) -> Run:
    """Release all parameters, starting from the end of a run that held some."""
    # It starts apart from it, at nearly the same images, in which the derivatives of the free distortion parameters
    # differ. Where the observations do not separate these, they get pseudo-observations, as weak as possible.
    state, unknowns = begun.end.state, problem.unknowns
    values = state.values.copy()
    for camera in (name for name, alike in _alike_at_zero(problem, state).items() if alike):
        own = unknowns.camera[camera][3:]
        apart = family(problem.network.camera_by_name[camera].distortion.family).apart(values[own])
        values[own] = np.where(np.isinf(unknowns.sigma[own]), apart, values[own])
    start, at = State(values, state.rotations), begun.linearised(problem, state)
    motions = edge_motions(problem, at) if at is not None else {}
    for reach in REACHES if motions else ():
        held = replace(problem, pseudo_observed={i: reach * motion for i, motion in motions.items()})
        at = begun.linearised(held, start)
        if at is None or not unresolved_motions(held.pseudo_observed, free_cofactor(at).variances):
            break
        last = _iterate(held, weighting, state, limit)
        if last.converged and not is_contradicted(held, last.end.state):
            return last
        if last.converged:
            state = start = last.end.state
    return _iterate(problem, weighting, start, limit)


def _alike_at_zero(problem: Problem, state: State, with_others: bool = False) -> dict[str, list[int]]:
    """Free distortion parameters by camera that are 0, and then have the derivatives of other parameters. with_others:
    those too that could be and are not."""
    unknowns, found = problem.unknowns, {}
    for camera in unknowns.camera:
        positions = problem.lens_positions(camera)
        alike = family(problem.network.camera_by_name[camera].distortion.family).alike_at_zero
        free = [positions[each] for each in alike if np.isinf(unknowns.sigma[positions[each]])]
        found[camera] = [at for at in free if with_others or state.values[at] == 0.0]
    return found


def _iterate(problem: Problem, weighting: Weighting, state: State, limit: int) -> Run:
    weighted, covariance = weighting.apply(problem)
    numbering = Numbering(weighted)

    def null_directions(at: Linearised) -> tuple[NullDirection, ...]:
        return singular_directions(numbering, at.state, at.factor)

    solution = iterate(numbering, covariance, state, limit, lambda start: bool(null_directions(start)))
    if solution is None:
        reasons = {name: f"{reason}. {check}" for name, (reason, check) in blind_marks(problem, state).items()}
        of_name = problem.network.image_by_name
        raise NoImageError(
            f"The adjustment cannot start: with the approximations, {next(iter(reasons.values()), '')}",
            {of_name[name].frame: reason for name, reason in reasons.items() if name},
        )
    singular = null_directions(solution.end)
    if singular:
        ended: Termination = "singular" if solution.termination in ("converged", "singular") else "diverged"
        solution = replace(solution, factor=None, termination=ended)
    return Run(problem, weighting, solution, singular)
