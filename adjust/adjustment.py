"""The simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9)."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adjust.approximations import approximate
from adjust.cofactor import NoCofactor, free_cofactor, inner_cofactor
from adjust.datum import CENTERINGS, EXACT, centered, minimal_datum, object_datum
from adjust.datum_choice import chosen_coordinates, chosen_points, with_held
from adjust.diagnosis import undetermined, weak_directions
from adjust.errors import AdjustmentError
from adjust.iteration import factorise
from adjust.network import STRAIGHT, Approximations, Network
from adjust.options import Datum, Method, Options
from adjust.problem import Problem, number
from adjust.reliability import Misfits, reliability
from adjust.residuals import further_residuals, groups, residuals
from adjust.result import Adjustment, Cofactor
from adjust.runs import ROUNDS, Run, again, run
from adjust.snooping import contradictions, search, suspects
from adjust.suspicions import suspicions
from adjust.tested import TestedUnits
from adjust.transformation import marks_needed
from adjust.validation import validate
from adjust.variance_components import factor_sigmas

__all__ = ["Datum", "Method", "Options", "adjust", "adjust_problem", "with_datum"]

Indices = NDArray[np.intp]


def adjust(network: Network, approximations: Approximations, options: Options | None = None) -> Adjustment:
    """Adjust a network by least squares, all unknowns together.

    The combined model A v + B dx = w is relinearised at the adjusted observations and unknowns until both stand still
    (Torlegård, equations F1 to F9). The cofactor matrix is that of all unknowns, nothing held fixed but what a standard
    deviation of 0 fixes. A singular network is a result with its null directions, not an error: its values are the
    approximations, its cofactor matrix is zero and means nothing. Where the iteration does not come to rest it is begun
    anew from approximations found from the network itself, and a warning says so.

    Raises AdjustmentError where the network is empty or contradictory, where the approximations put a point where it
    has no image, or where the chosen datum does not hold the object space.
    """
    validate(network)
    options = options or Options()
    result = adjust_problem(number(network, approximations, options.method == "elements"), options)
    if result.termination in ("converged", "singular"):
        return result
    return _begun_anew(network, approximations, options, result)


def _begun_anew(network: Network, approximations: Approximations, options: Options, stopped: Adjustment) -> Adjustment:
    """The adjustment from the network's own approximations; what is there already where these are no better."""
    try:
        own = approximate(with_held(network, options.datum_coordinates))
    except AdjustmentError:
        return stopped
    if all(np.array_equal(own.exterior[name], approximations.exterior.get(name, [])) for name in own.exterior):
        return stopped
    result = adjust_problem(number(network, own, options.method == "elements"), options)
    if not result.converged:
        return stopped
    warning = (
        f"From the given approximations the iteration did not come to rest ({stopped.termination} after "
        f"{stopped.iterations} steps); it was begun anew from approximations found from the network itself. Check "
        "those given."
    )
    return replace(result, warnings=(warning, *result.warnings))


def adjust_problem(problem: Problem, options: Options, held: Iterable[int] = ()) -> Adjustment:
    """The same with a network whose quantities are numbered; those at the positions `held` stay where they start."""
    members = chosen_points(problem, options.datum_points)
    solved = with_datum(problem, options)
    solution = run(replace(solved, unknowns=solved.unknowns.fixed(held)), options)
    if options.datum == "free":
        solution = _freed(problem, solution, members, options)
    result = _result(solution, _cofactor(problem, solution, members if options.datum == "free" else None), options)
    return replace(result, network=problem.network)


def with_datum(problem: Problem, options: Options) -> Problem:
    """The problem that is solved: with a minimal datum held fixed, unless what is given is to be the datum."""
    unknowns = problem.unknowns
    if options.datum_coordinates:
        unknowns = unknowns.fixed_as_given(chosen_coordinates(problem, options.datum_coordinates))
    elif options.datum != "control":
        unknowns = unknowns.fixed(minimal_datum(problem))
    return _without_bending_for_a_datum(replace(problem, unknowns=unknowns))


def _without_bending_for_a_datum(problem: Problem) -> Problem:
    """Straight lines of sight where the datum is lacking: bent ones would hold it, but by next to nothing."""
    bent = not problem.network.line_of_sight.is_straight
    if bent and object_datum(problem, problem.start()).free.shape[1] > 0:
        return replace(problem, network=replace(problem.network, line_of_sight=STRAIGHT))
    return problem


def _freed(problem: Problem, last: Run, members: Indices, options: Options) -> Run:
    """A run with minimal datum, brought to inner constraints over some coordinates; as it is where nothing was fixed.

    Where priors leave only some of the similarity transformations free, these are so to the first order alone: after
    each the network is adjusted again.
    """
    if not _was_fixed(problem, last):
        return last
    extent = object_datum(problem, last.end.state).extent
    for _ in range(CENTERINGS):
        if not last.converged:
            return last
        state, before = centered(problem, last.end.state, members), last
        if np.abs(state.values - before.end.state.values)[members].max(initial=0.0) <= EXACT * extent:
            break
        last = again(before, before.weighting, options.iteration_limit, state)
        history = before.solution.history + last.solution.history
        last = replace(last, settled=before.settled, solution=replace(last.solution, history=history))
    return last


def _was_fixed(problem: Problem, last: Run) -> bool:
    return bool((last.problem.unknowns.sigma != problem.unknowns.sigma).any())


def _cofactor(problem: Problem, last: Run, members: Indices | None) -> Cofactor:
    """The cofactor matrix in the datum of a run, or over the coordinates that carry inner constraints."""
    state, factor = last.end.state, last.solution.factor
    if factor is None:
        return NoCofactor(len(problem.unknowns))
    if members is None or not (last.converged and _was_fixed(problem, last)):
        return free_cofactor(last.numbering, state, factor)
    return inner_cofactor(problem, last.numbering, state, factor, members)


def _result(last: Run, cofactor: Cofactor, options: Options) -> Adjustment:
    problem, state, weighting = last.problem, last.end.state, last.weighting
    observed = len(last.end.v_mm)
    further_rows = sum(len(each.observed) for each in problem.further)
    conditions = int(TestedUnits(problem).sizes[weighting.used].sum()) + further_rows
    further_blocks, delta = last.end.rows.further, options.probabilities.noncentrality(1)
    further = tuple(further_residuals(problem, state, further_blocks, last.solution.factor, delta))
    found = last.found if last.has_solution else None
    of_marks = residuals(last.end.v_mm, found, weighting)
    doubts = suspicions(problem.network.observations, of_marks) if last.converged else []
    result = Adjustment(
        network=problem.network,
        termination=last.solution.termination,
        iterations=len(last.solution.history),
        conditions=conditions,
        unknowns=len(last.numbering.free),
        redundancy=conditions - len(last.numbering.free),
        vpv=last.end.vpv,
        names=problem.unknowns.names,
        values=np.where(_meaningless(problem), np.nan, state.values),
        cofactor=cofactor,
        residuals=of_marks,
        groups=groups(problem, state, last.end.v_mm, found, weighting, further),
        further=further,
        singular=last.singular if last.solution.termination == "singular" else (),
        warnings=(*_warnings(last, cofactor), *doubts),
        history=last.solution.history,
        mirrored=problem.mirrored,
        weights=weighting.weights[:observed],
        variance_factors=weighting.factors,
    )
    return result if found is None else _tested(result, last, found, options)


def _tested(result: Adjustment, last: Run, found: Misfits, options: Options) -> Adjustment:
    """The result with its reliability, its suspects and the sigmas of its variance factors."""
    probabilities, weighting = options.probabilities, last.weighting
    at = (last.numbering, last.end, last.factor, found)
    reliable = reliability(*at, weighting.weights, result.sigma0, result.redundancy, probabilities)
    tests = search(*at, weighting, probabilities)
    contradicting = contradictions(tests)
    return replace(
        result,
        variance_sigmas=factor_sigmas(*at, weighting) if weighting.factors else {},
        reliability=reliable,
        suspects=suspects(tests, contradicting, last.removed, reliable, probabilities, result.redundancy),
    )


def _meaningless(problem: Problem) -> NDArray[np.bool_]:
    """The quantities (n,) that nothing is given of and that nothing tells, for no object point is seen."""
    network, unknowns = problem.network, problem.unknowns
    meaningless = np.zeros(len(unknowns), dtype=bool)
    for name in network.unoriented:
        meaningless[unknowns.exterior[name]] = True
    for name in network.idle_cameras & unknowns.camera.keys():
        camera = network.camera_by_name[name]
        given = (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm)
        meaningless[unknowns.camera[name][:3]] = [prior is None for prior in given]
    return meaningless


def _warnings(last: Run, cofactor: Cofactor) -> tuple[str, ...]:
    """What the user should look at in a result."""
    problem = last.numbering.problem
    warnings = []
    if last.solution.termination == "iteration limit":
        warnings.append(
            f"The iteration did not stand still within {len(last.solution.history)} steps: the values are not final. "
            f"The largest residuals are those of {_worst(last)}."
        )
    if last.solution.termination == "diverged":
        warnings.append(
            f"The iteration diverged: it came to no minimum. Look for wrong point numbers and wrong approximations; "
            f"the largest residuals are those of {_worst(last)}."
        )
        warnings += [f"Where it ended, the equations are singular: {each.cause}" for each in last.singular]
    if not last.settled:
        warnings.append(
            f"The weights did not settle within {ROUNDS} rounds of robust estimation, variance components or data "
            f"snooping."
        )
    without_priors = factorise(last.numbering, last.end, camera_priors=False)
    weak = weak_directions(problem, last.end.state, last.numbering.free, without_priors, last.singular)
    warnings += [
        f"Practically singular without priors: {', '.join(each.parameters)}. {each.cause} {each.remedy}"
        for each in weak
    ]
    if last.converged:
        warnings += filter(None, [undetermined(problem, last.end.state, cofactor.variances)])
    return tuple(warnings + _unseen(problem) + _films_by_targets(problem))


def _worst(last: Run) -> str:
    """The observations with the largest residuals."""
    observations = last.numbering.problem.network.observations
    size = np.abs(last.end.v_mm).max(axis=1)
    rows = np.argsort(-size)[:3]
    return ", ".join(
        f"{observations.kind[i]} {observations.point[i]} in image {observations.image[i]} ({size[i]:.3g} mm)"
        for i in rows
    )


def _unseen(problem: Problem) -> list[str]:
    """What is given and that no image shows."""
    points = [point.id for point in problem.network.points if point.id not in problem.unknowns.point]
    if not points:
        return []
    shown = ", ".join(points[:5]) + (f" and {len(points) - 5} more" if len(points) > 5 else "")
    return [f"No image shows the object points {shown}: they take no part."]


def _films_by_targets(problem: Problem) -> list[str]:
    """Images whose film transformation takes more than their fiducial marks."""
    images = problem.network.images
    shown = np.bincount(problem.image_numbers[problem.is_fiducial], minlength=len(images))
    few = [i for i, image in enumerate(images) if shown[i] < marks_needed(image.transformation)]
    if not few:
        return []
    first = images[few[0]]
    others = f" {len(few) - 1} more images are alike." if len(few) > 1 else ""
    return [
        f"Image {first.name} shows {shown[few[0]]} fiducial marks, and its {first.transformation} transformation takes "
        f"{marks_needed(first.transformation)} of its own: the targets determine the rest of it.{others}"
    ]
