"""The simultaneous adjustment of cameras, fiducial marks, images and object points (Torlegård's F1 to F9)."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Indices
from adjust.errors import AdjustmentError, DatumError, NoImageError, UnorientedError
from adjust.initial_values.approximations import initial_values
from adjust.least_squares.malloc_tuning import keep_freed_memory
from adjust.problem.network import STRAIGHT, Approximations, Network
from adjust.problem.problem import Problem, number
from adjust.problem.reduction import Reduction
from adjust.quality.run import Run
from adjust.rank_defect.datum import (
    CENTERINGS,
    EXACT,
    centered,
    chosen_coordinates,
    chosen_points,
    held_as_known,
    minimal_datum,
    object_datum,
)
from adjust.solution.blunder_hypotheses import blunder_sentence, stations_elsewhere
from adjust.solution.coordinate_blunders import Slip, coordinate_slips, far_points, few_points, free_points
from adjust.solution.left_out_images import adopt_lens, fitting, leave_out
from adjust.solution.options import Datum, Method, Options
from adjust.solution.plausibility import check_plausibility
from adjust.solution.result import Adjustment, is_fixed, run_result
from adjust.solution.reweighting import again, run
from adjust.validation import validate

__all__ = ["Datum", "Method", "Options", "adjust", "adjust_problem", "settle_datum"]


GUESSED = 0.1  # standard deviation of a principal distance, over it, from which on it is a guess
TRIAL_STEPS = 6  # of an adjustment that only has to show whether the observations agree: v'Pv falls with every one


def adjust(
    network: Network, approximations: Approximations | None = None, options: Options | None = None
) -> Adjustment:
    """Adjust a network by least squares, all unknowns together.

    The combined model A v + B dx = w is relinearised at the adjusted observations and unknowns until both stand still
    (Torlegård, equations F1 to F9); object coordinates count from the middle of the field. The cofactor matrix is that
    of all unknowns, nothing held fixed but what a standard deviation of 0 fixes. A singular network is a result with
    its null directions, not an error: its values are the approximations, its cofactor matrix is zero and means nothing.
    Where no approximations are given, or the iteration does not come to rest from them, it begins with those found from
    the network itself. Given points that are far off are named where the observations do not agree for them; robust
    estimation and data snooping begin without them. Images for which no orientation is found are left out, and tried
    again once the lens is known (`Adjustment.left_out`); so are those in which some point has no image to begin with.

    Raises AdjustmentError where the network is empty or contradictory, where the approximations put a point where it
    has no image, where the chosen datum does not hold the object space, or where a slip that concerns the whole network
    explains what else contradicts itself everywhere (see `blunder_sentence`).
    """
    keep_freed_memory()
    validate(network)
    options = options or Options()
    tried, family = partial(_try_network, options=options), options.probabilities.family
    if approximations is not None:
        return check_plausibility(_as_a_whole(network, approximations, None, options), tried, family)
    result, left_out = _leave_out_blind(*_orientable(network, options), options)
    found = _try_again(network, result, left_out, options) if left_out else result
    return check_plausibility(found, tried, family)


def _orientable(network: Network, options: Options) -> tuple[Network, Approximations | None, dict[str, str]]:
    """The network without the images for which no orientation is found, its own approximations, and why these are left
    out. The whole network without approximations where too little would be left, or something else is wrong.
    """
    try:
        return network, initial_values(held_as_known(network, options.datum_coordinates)), {}
    except UnorientedError as error:
        part, reasons = leave_out(network, error.reasons), error.reasons
    except AdjustmentError:
        return network, None, {}
    start = None if part is None else _own_start(part, options)
    return (network, None, {}) if part is None or start is None else (part, start, reasons)


def _leave_out_blind(
    part: Network, start: Approximations | None, left_out: dict[str, str], options: Options
) -> tuple[Adjustment, dict[str, str]]:
    """The adjustment of a network without those images, too, in which some point has no image to begin with, and why
    images are left out. Raises NoImageError where too little would be left."""
    try:
        return _as_a_whole(part, None, start, options), left_out
    except NoImageError as error:
        rest = leave_out(part, error.reasons) if error.reasons else None
        begun = None if rest is None else _own_start(rest, options)
        if rest is None or begun is None:
            raise
        reasons = error.reasons
    return _leave_out_blind(rest, begun, left_out | reasons, options)


def _try_again(network: Network, rest: Adjustment, left_out: dict[str, str], options: Options) -> Adjustment:
    """The adjustment with those images that were left out and that fit once the lens is known."""
    found = rest
    if rest.converged:
        _, start, reasons = _orientable(adopt_lens(network, rest), options)
        came = left_out.keys() - reasons.keys()
        while start is not None and came:
            part = leave_out(network, left_out.keys() - came)
            if part is None:
                break
            try:
                tried = _adjust_points(part, start, options)
                fit = fitting(tried, came, rest.sigma0) if tried.converged else set()
            except NoImageError as error:
                tried, fit = rest, came - error.reasons.keys()
            if fit == came:
                found = tried
                break
            came = fit
    frames = {image.frame for image in found.network.images}
    return replace(found, left_out={name: reason for name, reason in left_out.items() if name not in frames})


def _as_a_whole(
    network: Network, approximations: Approximations | None, own: Approximations | None, options: Options
) -> Adjustment:
    """The adjustment of a network; own: its own approximations, where these are known already."""
    weighs_anew = options.plain != options
    if weighs_anew:  # what is wrong with all would be weighed away here and there
        own = own or _own_start(network, options)
        _check_whole(network, _plainly(network, own, options), options)
    try:
        start = approximations or own or initial_values(held_as_known(network, options.datum_coordinates))
        result = _adjust_points(network, start, options)
    except DatumError:  # whatever the observations say
        raise
    except AdjustmentError:
        if not weighs_anew:
            _check_whole(network, None, options)
        raise
    if result.termination == "singular":
        return result
    if not weighs_anew:
        _check_whole(network, result, options)
    if elsewhere := stations_elsewhere(network, result):
        result = replace(result, remarks=(*result.remarks, elsewhere))
    return result


def _check_whole(network: Network, given: Adjustment | None, options: Options) -> None:
    """Raise AdjustmentError where a slip of the whole network explains what the network as it is given does not."""
    slip = blunder_sentence(network, given, partial(_try_network, options=options), options.probabilities.family)
    if slip:
        raise AdjustmentError(slip)


def _try_network(network: Network, options: Options) -> Adjustment | None:
    """Another network adjusted from its own approximations; None where it cannot begin."""
    return _plainly(network, _own_start(network, options), options)


def _own_start(network: Network, options: Options) -> Approximations | None:
    """A network's own approximations; None where it has none."""
    try:
        return initial_values(held_as_known(network, options.datum_coordinates))
    except AdjustmentError:
        return None


def _plainly(network: Network, start: Approximations | None, options: Options) -> Adjustment | None:
    """A network adjusted with the weights as they are given; None where it cannot begin."""
    if start is None:
        return None
    plain = replace(options.plain, iteration_limit=min(options.iteration_limit, TRIAL_STEPS))
    try:
        return _solve(network, start, plain)
    except AdjustmentError:
        return None


def _adjust_points(network: Network, approximations: Approximations, options: Options) -> Adjustment:
    """The adjustment, and what is to be said of single given points."""
    begun = _start_robustly(network, approximations, options) if options.robust or options.snooping else None
    if begun is not None and begun.converged:
        return begun if _agrees(begun, options) else _report_slips(begun, network, approximations, options)
    try:
        result = _solve(network, approximations, options)
    except NoImageError as error:
        if found := _slips(network, approximations, options):
            raise AdjustmentError(" ".join(slip.sentence for slip in found)) from error
        raise
    if result.termination not in ("converged", "singular"):
        result = _begin_anew(network, approximations, options, result)
    if result.termination == "singular" or _agrees(result, options):
        return result
    return _report_slips(result, network, approximations, options)


def _report_slips(result: Adjustment, network: Network, approximations: Approximations, options: Options) -> Adjustment:
    """The same, with what is to be said of given points where the observations do not agree."""
    if found := _slips(network, approximations, options):
        return replace(result, slips=tuple(slip.sentence for slip in found))
    return result if result.converged else replace(result, remarks=(*result.remarks, *few_points(network)))


def _solve(
    network: Network, approximations: Approximations, options: Options, doubted_points: Iterable[str] = ()
) -> Adjustment:
    """A network adjusted about its centroid, in its own coordinates; without the given places of some points to begin
    with.
    """
    reduction = Reduction.to_centroid(network)
    problem = _numbered(reduction.network(network), reduction.approximations(approximations), options)
    unknowns = problem.unknowns
    doubted = [int(position) for name in doubted_points for position in unknowns.point[name]]
    result = adjust_problem(problem, options, doubted=doubted)
    return replace(result, network=network, values=reduction.unreduced_values(unknowns, result.values, network))


def _numbered(network: Network, approximations: Approximations, options: Options) -> Problem:
    return number(network, approximations, options.method == "elements")


def _agrees(result: Adjustment, options: Options) -> bool:
    """Whether chance alone explains v'Pv."""
    chance = result.redundancy < 1 or chdtrc(result.redundancy, result.vpv) > options.probabilities.family
    return result.converged and bool(chance)


def _start_robustly(network: Network, approximations: Approximations, options: Options) -> Adjustment | None:
    """Robust estimation or data snooping that begins without the given points that are slips; None without any.

    From an adjustment with a slip in it neither finds back: its linear equations say nothing of errors so large.
    """
    found = _slips(network, approximations, options)
    if not found:
        return None
    _, start = free_points(network, approximations, [slip.far for slip in found])
    try:
        return _solve(network, start, options, [slip.far.name for slip in found])
    except NoImageError:
        return None


def _slips(network: Network, approximations: Approximations, options: Options) -> list[Slip]:
    """The given points that contradict, beyond chance, an adjustment that knows nothing of their coordinates."""
    far = far_points(_numbered(network, approximations, options), options.probabilities.family)
    if not far:
        return []
    without, start = free_points(network, approximations, far)
    plain = options.plain
    try:
        return coordinate_slips(network, far, _solve(without, start, plain), options)
    except AdjustmentError:  # without these points it cannot even begin
        return []


def _begin_anew(network: Network, approximations: Approximations, options: Options, stopped: Adjustment) -> Adjustment:
    """The adjustment from the network's own approximations; what is there already where these are no better."""
    for known in (*_free_guesses(network), network):
        try:
            own = initial_values(held_as_known(known, options.datum_coordinates))
        except AdjustmentError:
            continue
        if all(np.array_equal(own.exterior[name], approximations.exterior.get(name, [])) for name in own.exterior):
            continue
        result = _solve(network, own, options)
        if result.converged:
            warning = (
                f"From the given approximations the iteration did not come to rest ({stopped.termination} after "
                f"{stopped.iterations} steps); it was begun anew from approximations found from the network itself. "
                "Check those given."
            )
            return replace(result, remarks=(warning, *result.remarks))
    return stopped


def _free_guesses(network: Network) -> Iterator[Network]:
    """The network without principal distances of which so little is known that images of known points tell more."""
    guessed = {
        camera.name
        for camera in network.cameras
        if (c := camera.principal_distance_mm) is not None and c.sigma > GUESSED * abs(c.value)
    }
    if guessed:
        cameras = (
            replace(camera, principal_distance_mm=None) if camera.name in guessed else camera
            for camera in network.cameras
        )
        yield replace(network, cameras=tuple(cameras))


def adjust_problem(
    problem: Problem, options: Options, held: Iterable[int] = (), doubted: Collection[int] = ()
) -> Adjustment:
    """The same with a network whose quantities are numbered; those at the positions `held` stay where they start, the
    given values of those `doubted` are left out to begin with (see `run`).
    """
    members = chosen_points(problem, options.datum_points)
    solved = settle_datum(problem, options)
    solution = run(replace(solved, unknowns=solved.unknowns.fixed(held)), options, doubted)
    if options.datum == "free":
        solution = _center_datum(problem, solution, members, options)
    result = run_result(problem, solution, members if options.datum == "free" else None, options.probabilities)
    return replace(result, network=problem.network)


def settle_datum(problem: Problem, options: Options) -> Problem:
    """The problem that is solved: with a minimal datum held fixed, unless what is given is to be the datum."""
    unknowns = problem.unknowns
    if options.datum_coordinates:
        unknowns = unknowns.fixed_as_given(chosen_coordinates(problem, options.datum_coordinates))
    elif options.datum != "control":
        unknowns = unknowns.fixed(minimal_datum(problem))
    return _straighten_sight(replace(problem, unknowns=unknowns))


def _straighten_sight(problem: Problem) -> Problem:
    """Straight lines of sight where the datum is lacking: bent ones would hold it, but by next to nothing."""
    bent = not problem.network.line_of_sight.is_straight
    if bent and object_datum(problem, problem.start()).free.shape[1] > 0:
        return replace(problem, network=replace(problem.network, line_of_sight=STRAIGHT))
    return problem


def _center_datum(problem: Problem, last: Run, members: Indices, options: Options) -> Run:
    """A run with minimal datum, brought to inner constraints over some coordinates; as it is where nothing was fixed.

    Where priors leave only some of the similarity transformations free, these are so to the first order alone: after
    each the network is adjusted again.
    """
    if not is_fixed(problem, last):
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
