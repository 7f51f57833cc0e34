"""The simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9)."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from adjust.cofactor import NoCofactor, free_cofactor, inner_cofactor
from adjust.datum import CENTERINGS, EXACT, centered, minimal_datum, object_datum
from adjust.datum_choice import chosen_coordinates, chosen_points
from adjust.diagnosis import singular_directions, undetermined, weak_directions
from adjust.errors import AdjustmentError
from adjust.functions import blind_target
from adjust.iteration import Linearised, Solution, factorise, iterate, linearise
from adjust.network import Approximations, Network
from adjust.numbering import Numbering
from adjust.problem import Problem, State, number
from adjust.residuals import further_residuals, groups, residuals
from adjust.result import Adjustment, Cofactor, NullDirection, Residuals
from adjust.reweighting import Weighting, robust_weights, variance_factor
from adjust.validation import validate

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]

REWEIGHTINGS = 30  # rounds of robust estimation or of variance components at most


@dataclass(frozen=True)
class Options:
    """How to adjust.

    datum: "control", what is given of points and stations and nothing else; "minimal", as many coordinates fixed as
    these leave free; "free", inner constraints over points of which nothing is given.
    datum_coordinates: those that "minimal" fixes, at their given values: "12.X" and so on; none: chosen automatically.
    datum_points: the points that carry the inner constraints of "free"; none: all.
    robust: marks with large residuals lose weight (Huber). variance_components: the variances of targets and fiducials
    are each multiplied by what their residuals say. method: "combined", the strict combined model (Gauss-Helmert);
    "elements", Torlegård's adjustment by elements, which takes the distortion at the observed point: the same as long
    as distortion changes little over a residual, and what programs do that correct the measured points first.
    """

    datum: Datum = "control"
    datum_coordinates: tuple[str, ...] = ()
    datum_points: tuple[str, ...] = ()
    robust: bool = False
    variance_components: bool = False
    iteration_limit: int = 50
    method: Method = "combined"

    def __post_init__(self) -> None:
        if self.datum not in get_args(Datum):
            raise ValueError(f"the datum must be one of {', '.join(get_args(Datum))}, not {self.datum}")
        for key, datum in (("datum_coordinates", "minimal"), ("datum_points", "free")):
            if getattr(self, key) and self.datum != datum:
                raise ValueError(f'{key} is for the datum "{datum}", not for "{self.datum}"')
        if self.method not in get_args(Method):
            raise ValueError(f"the method must be one of {', '.join(get_args(Method))}, not {self.method}")
        if self.iteration_limit < 1:
            raise ValueError(f"the iteration limit must be at least 1, not {self.iteration_limit}")


def adjust(network: Network, approximations: Approximations, options: Options | None = None) -> Adjustment:
    """Adjust a network by least squares, all unknowns together.

    The combined model A v + B dx = w is relinearised at the adjusted observations and unknowns until both stand still
    (Torlegård, equations F1 to F9). The cofactor matrix is that of all unknowns, nothing held fixed but what a standard
    deviation of 0 fixes. A singular network is a result with its null directions, not an error: its values are the
    approximations, its cofactor matrix is zero and means nothing.

    Raises AdjustmentError where the network is empty or contradictory, where the approximations put a point where it
    has no image, or where the chosen datum does not hold the object space.
    """
    validate(network)
    options = options or Options()
    return adjust_problem(number(network, approximations, options.method == "elements"), options)


def adjust_problem(problem: Problem, options: Options, held: Iterable[int] = ()) -> Adjustment:
    """The same with a network whose quantities are numbered; those at the positions `held` stay where they start."""
    members = chosen_points(problem, options.datum_points)
    solved = with_datum(problem, options)
    run = _settled_run(Numbering(replace(solved, unknowns=solved.unknowns.fixed(held))), options)
    if options.datum == "free":
        run = _freed(problem, run, members, options)
    return _result(problem, run, options)


def with_datum(problem: Problem, options: Options) -> Problem:
    """The problem that is solved: with a minimal datum held fixed, unless what is given is to be the datum."""
    unknowns = problem.unknowns
    if options.datum_coordinates:
        unknowns = unknowns.fixed_as_given(chosen_coordinates(problem, options.datum_coordinates))
    elif options.datum != "control":
        unknowns = unknowns.fixed(minimal_datum(problem))
    return replace(problem, unknowns=unknowns)


@dataclass(frozen=True)
class _Run:
    """One adjustment with given weights: where it ended, its cofactor matrix, its residuals.

    settled: whether the residuals ask for no other weights.
    """

    numbering: Numbering
    weighting: Weighting
    solution: Solution
    singular: tuple[NullDirection, ...]
    cofactor: Cofactor
    residuals: Residuals
    settled: bool = True

    @property
    def end(self) -> Linearised:
        return self.solution.end

    @property
    def converged(self) -> bool:
        return self.solution.termination == "converged"


def _settled_run(numbering: Numbering, options: Options) -> _Run:
    """Adjust until the weights that robust estimation and variance components ask for are those that were used."""
    weighting = Weighting(np.ones(len(numbering.problem.network.observations)))
    run = _run(numbering, weighting, numbering.problem.start(), options.iteration_limit)
    for _ in range(REWEIGHTINGS):
        refined = _reweighted(run, options)
        if not refined.differs(run.weighting):
            return run
        run = _run(numbering, refined, run.end.state, options.iteration_limit)
    return replace(run, settled=False)


def _run(numbering: Numbering, weighting: Weighting, state: State, limit: int) -> _Run:
    problem = numbering.problem
    covariance = weighting.covariance(problem)
    start = linearise(numbering, covariance, state)
    if start is None:
        raise AdjustmentError(
            f"The adjustment cannot start: with the approximations, {blind_target(problem, state)}. Check the "
            f"approximate orientation of the image, and the sign of W: M rotates from object to camera, which looks "
            f"along its negative z axis."
        )
    singular = singular_directions(problem, state, numbering.free, factorise(numbering, start))
    if singular:
        return _unsolved(numbering, weighting, Solution(start, None, "singular", ()), singular)
    solution = iterate(numbering, covariance, start, limit)
    factor = solution.factor or factorise(numbering, solution.end)
    singular = singular_directions(problem, solution.end.state, numbering.free, factor)
    if singular:
        return _unsolved(numbering, weighting, replace(solution, termination="singular"), singular)
    if solution.factor is None:
        return _unsolved(numbering, weighting, solution, ())
    cofactor = free_cofactor(numbering, solution.end.state, solution.factor)
    observed = residuals(numbering, solution.end, solution.factor, covariance)
    return _Run(numbering, weighting, solution, (), cofactor, observed)


def _unsolved(
    numbering: Numbering, weighting: Weighting, solution: Solution, singular: tuple[NullDirection, ...]
) -> _Run:
    count = len(numbering.problem.unknowns)
    nothing = np.zeros_like(solution.end.v_mm)
    observed = Residuals(solution.end.v_mm, nothing, nothing)
    return _Run(numbering, weighting, solution, singular, NoCofactor(count), observed)


def _reweighted(run: _Run, options: Options) -> Weighting:
    """The weights that the residuals of a run ask for."""
    weighting = run.weighting
    if not run.converged:
        return weighting
    problem = run.numbering.problem
    covariance = weighting.covariance(problem)
    if options.variance_components:
        weighting = replace(
            weighting,
            target=weighting.target * variance_factor(covariance, run.residuals, ~problem.is_fiducial),
            fiducial=weighting.fiducial * variance_factor(covariance, run.residuals, problem.is_fiducial),
        )
    if options.robust:
        weighting = replace(weighting, weights=robust_weights(covariance, run.residuals, weighting.weights))
    return weighting


def _freed(problem: Problem, run: _Run, members: Indices, options: Options) -> _Run:
    """A run with minimal datum, brought to inner constraints over some coordinates; as it is where nothing was fixed.

    Where priors leave only some of the similarity transformations free, these are so to the first order alone: after
    each the network is adjusted again.
    """
    fixed = run.numbering.problem.unknowns.sigma != problem.unknowns.sigma
    if not fixed.any():
        return run
    extent = object_datum(problem, run.end.state).extent
    for _ in range(CENTERINGS):
        if not run.converged:
            return run
        state, before = centered(problem, run.end.state, members), run
        if np.abs(state.values - before.end.state.values)[members].max(initial=0.0) <= EXACT * extent:
            break
        run = _run(before.numbering, before.weighting, state, options.iteration_limit)
        history = before.solution.history + run.solution.history
        run = replace(run, settled=before.settled, solution=replace(run.solution, history=history))
    factor = run.solution.factor
    if factor is None:
        return run
    return replace(run, cofactor=inner_cofactor(problem, run.numbering, run.end.state, factor, members))


def _result(problem: Problem, run: _Run, options: Options) -> Adjustment:
    numbering, weighting, unknowns = run.numbering, run.weighting, problem.unknowns
    state = run.end.state
    covariance = weighting.covariance(problem)
    observed = run.residuals
    # The test w of a mark that robust estimation has lost is that of the mark as it was given.
    given = replace(observed, w=observed.w / np.sqrt(weighting.weights)[:, None])
    values = np.where(_meaningless(problem), np.nan, state.values)
    further_rows = sum(len(each.observed) for each in problem.further)
    conditions = 2 * len(problem.network.observations) + int(unknowns.has_prior.sum()) + further_rows
    further = tuple(further_residuals(problem, state, run.cofactor))
    factors = {"target": weighting.target, "fiducial": weighting.fiducial} if options.variance_components else {}
    return Adjustment(
        network=problem.network,
        termination=run.solution.termination,
        iterations=len(run.solution.history),
        conditions=conditions,
        unknowns=len(numbering.free),
        redundancy=conditions - len(numbering.free),
        vpv=run.end.vpv,
        names=unknowns.names,
        values=values,
        cofactor=run.cofactor,
        residuals=given,
        groups=groups(problem, state, run.cofactor.variances, observed, covariance, further),
        singular=run.singular,
        warnings=_warnings(run),
        history=run.solution.history,
        mirrored=problem.mirrored,
        weights=weighting.weights,
        variance_factors=factors,
        further=further,
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


def _warnings(run: _Run) -> tuple[str, ...]:
    """What the user should look at in a result."""
    problem = run.numbering.problem
    warnings = []
    if run.solution.termination == "iteration limit":
        warnings.append(
            f"The iteration did not stand still within {len(run.solution.history)} steps: the values are not final."
        )
    if run.solution.termination == "diverged":
        warnings.append(
            f"The iteration diverged: no step from the last values makes the residuals smaller. Look for wrong point "
            f"numbers and wrong approximations; the largest residuals are those of {_worst(run)}."
        )
    if not run.settled:
        warnings.append(
            f"The weights did not settle within {REWEIGHTINGS} rounds of robust estimation or variance components."
        )
    if run.converged:
        weak = weak_directions(
            problem, run.end.state, run.numbering.free, factorise(run.numbering, run.end, camera_priors=False)
        )
        warnings += [
            f"Practically singular without priors: {', '.join(each.parameters)}. {each.cause} {each.remedy}"
            for each in weak
        ]
        blind = undetermined(problem, run.cofactor.variances)
        if blind:
            warnings.append(
                f"The observations say nothing about {', '.join(blind)}: their standard deviations stay as given."
            )
    return tuple(warnings + _unseen(problem))


def _worst(run: _Run) -> str:
    """The observations with the largest residuals."""
    observations = run.numbering.problem.network.observations
    size = np.abs(run.end.v_mm).max(axis=1)
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
